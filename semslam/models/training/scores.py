"""How good boxes and masks are: average precision as COCO computes it, precision and recall at a score, mask overlap.

Pure functions over lists with one entry a picture. Boxes are left, top, right, bottom in pixels, right and bottom
exclusive. Objects that do not count (`SeenObject.counts`) are ignore regions, COCO's `iscrowd`: a detection of their
class that lies in them (overlap over its own area) is neither right nor wrong, and nobody misses them.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import Detections, Floats
from semslam.models.training.pictures import Picture

MIN_IOU = 0.5
"""Overlap from which a detection has found an object."""
MAX_DETECTIONS = 100
"""Of one class in a picture, best first; COCO's."""


@dataclass(frozen=True)
class Wanted:
    """An object as truth has it."""

    box: tuple[float, float, float, float]
    class_id: int
    counts: bool = True
    """False makes it an ignore region."""


@dataclass(frozen=True)
class BoxScores:
    """Average precision by class, 0 to 1; None for a class without an object that counts."""

    class_names: tuple[str, ...]
    ap50: tuple[float | None, ...]
    """At an overlap of 0.5."""
    ap50_95: tuple[float | None, ...]
    """Mean over overlaps of 0.5 to 0.95 in steps of 0.05."""
    objects: tuple[int, ...]
    """Objects that count."""
    ignored: tuple[int, ...] = ()
    """Objects that do not."""

    @property
    def map50(self) -> float | None:
        """Mean over the classes that occur; None if none does."""
        return mean(self.ap50)

    @property
    def map50_95(self) -> float | None:
        """Mean over the classes that occur; None if none does."""
        return mean(self.ap50_95)


@dataclass(frozen=True)
class Hits:
    """What became of objects and detections at one score."""

    wanted: int
    """Objects that count."""
    found: int
    """Those of them that a detection found."""
    false: int
    """Detections that found nothing, second ones of an object included, those in ignore regions not."""

    @property
    def recall(self) -> float | None:
        """None without an object."""
        return self.found / self.wanted if self.wanted else None

    @property
    def precision(self) -> float | None:
        """None without a detection."""
        return self.found / (self.found + self.false) if self.found + self.false else None


@dataclass(frozen=True)
class MaskScores:
    """Overlap (intersection over union) of masks with the true ones."""

    class_names: tuple[str, ...]
    by_class: tuple[float | None, ...]
    """Mean over the objects of a class that have a mask; None without one."""
    by_class_missed_0: tuple[float | None, ...]
    """The same with objects without a mask as 0; None without objects."""
    by_object: float | None
    """Mean over all objects that have a mask."""
    by_object_missed_0: float | None
    objects: int
    missed: int
    """Objects without a mask: no detection of their class overlaps them enough."""

    @property
    def by_classes(self) -> float | None:
        """Mean over classes: mIoU."""
        return mean(self.by_class)

    @property
    def by_classes_missed_0(self) -> float | None:
        """Mean over classes with missed objects as 0."""
        return mean(self.by_class_missed_0)


def mean(values: Iterable[float | None]) -> float | None:
    """Of those that are not None; None if all are."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


# -------------------------------------------------------------------------------------------------- what is compared


def wanted_of(picture: Picture) -> list[Wanted]:
    """The objects of a picture in their order; its glimpses as ignore regions."""
    height, width = picture.instances.shape
    return [
        Wanted((item.left, item.top, item.right, item.bottom), item.class_id, item.counts(width, height))
        for item in picture.objects
    ]


def in_classes(found: Detections, class_of: Mapping[int, int]) -> Detections:
    """Detections with other class ids; those of classes that the mapping lacks are left out."""
    kept = np.flatnonzero([int(number) in class_of for number in found.class_ids])
    numbers = np.array([class_of[int(found.class_ids[index])] for index in kept], np.int64)
    masks = None if found.masks is None else found.masks[kept]
    return replace(found, boxes=found.boxes[kept], scores=found.scores[kept], class_ids=numbers, masks=masks)


def of_class_names(names: Sequence[str], class_names: Sequence[str], aliases: Mapping[str, str]) -> dict[int, int]:
    """Which class a detector's class is: the one of its name, or of what `aliases` call it; others are absent."""
    called = [aliases.get(name, name) for name in names]
    return {number: list(class_names).index(name) for number, name in enumerate(called) if name in class_names}


def box_overlaps(first: Floats, second: Floats) -> NDArray[np.float64]:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4)."""
    shared = _shared(first, second)
    total = _areas(first)[:, None] + _areas(second)[None] - shared
    return np.asarray(shared / np.maximum(total, 1e-9))


def _shared(first: Floats, second: Floats) -> NDArray[np.float64]:
    """(N, M) areas of intersections."""
    a, b = (np.asarray(boxes, np.float64).reshape(-1, 4) for boxes in (first, second))
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])  # (N, M, 2)
    return np.asarray(np.prod(np.maximum(high - low, 0.0), axis=-1))


def _areas(boxes: Floats) -> NDArray[np.float64]:
    sides = np.asarray(boxes, np.float64).reshape(-1, 4)
    return np.asarray(np.prod(np.maximum(sides[:, 2:] - sides[:, :2], 0.0), axis=-1))


# ------------------------------------------------------------------------------------------------- average precision


def average_precision(
    truth: Sequence[Sequence[Wanted]], found: Sequence[Detections], class_names: Sequence[str]
) -> BoxScores:
    """Average precision of every class over a set of pictures, computed by pycocotools.

    Args:
        truth: the objects of every picture.
        found: what was detected there, down to scores near 0: what is left out cannot be recalled.

    Raises:
        SemslamError: pycocotools is not installed.
        ValueError: lists of different length, or a class id beyond the names.
    """
    _require_alike(truth, found)
    coco, evaluation = _coco()
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its progress
        judge = evaluation(
            _indexed(coco, truth, _true_rows(truth), class_names),
            _indexed(coco, truth, _found_rows(found), class_names),
            "bbox",
        )
        judge.params.areaRng, judge.params.areaRngLbl = [[0.0, 1e10]], ["all"]
        judge.params.maxDets = [MAX_DETECTIONS]
        judge.evaluate()
        judge.accumulate()
    precision = judge.eval["precision"][:, :, :, 0, 0]  # (overlaps, recalls, classes); -1 without objects
    counts = [sum(w.counts and w.class_id == k for objects in truth for w in objects) for k in range(len(class_names))]
    return BoxScores(
        tuple(class_names),
        tuple(float(precision[0, :, k].mean()) if n else None for k, n in enumerate(counts)),
        tuple(float(precision[:, :, k].mean()) if n else None for k, n in enumerate(counts)),
        tuple(counts),
        tuple(sum(not w.counts and w.class_id == k for o in truth for w in o) for k in range(len(class_names))),
    )


def _coco() -> tuple[Any, Any]:
    try:
        from pycocotools.coco import COCO  # type: ignore[import-not-found,import-untyped,unused-ignore]
        from pycocotools.cocoeval import COCOeval  # type: ignore[import-not-found,import-untyped,unused-ignore]
    except ImportError as error:
        raise SemslamError(
            "Average precision needs `pycocotools`, which is not installed", hint="pip install 'semslam[train]'"
        ) from error
    return COCO, COCOeval


def _require_alike(truth: Sequence[Sequence[Wanted]], found: Sequence[Detections]) -> None:
    if len(truth) != len(found):
        raise ValueError(f"truth of {len(truth)} pictures and detections of {len(found)}")


def _indexed(
    coco: Any, truth: Sequence[Sequence[Wanted]], rows: Sequence[dict[str, Any]], class_names: Sequence[str]
) -> Any:
    """Annotations as pycocotools wants them."""
    if any(not 0 <= row["category_id"] < len(class_names) for row in rows):
        raise ValueError(f"a class id beyond the {len(class_names)} class names")
    indexed = coco()
    indexed.dataset = {
        "info": {},
        "images": [{"id": number} for number in range(len(truth))],
        "categories": [{"id": number, "name": name} for number, name in enumerate(class_names)],
        # Ids start at 1: pycocotools takes a match with 0 for none.
        "annotations": [{"id": number, **row} for number, row in enumerate(rows, start=1)],
    }
    indexed.createIndex()
    return indexed


def _true_rows(truth: Sequence[Sequence[Wanted]]) -> list[dict[str, Any]]:
    return [
        {**_row(picture, item.class_id, np.asarray(item.box)), "iscrowd": int(not item.counts)}
        for picture, objects in enumerate(truth)
        for item in objects
    ]


def _found_rows(found: Sequence[Detections]) -> list[dict[str, Any]]:
    return [
        {**_row(picture, int(class_id), box), "iscrowd": 0, "score": float(score)}
        for picture, one in enumerate(found)
        for box, score, class_id in zip(one.boxes, one.scores, one.class_ids, strict=True)
    ]


def _row(picture: int, class_id: int, box: NDArray[Any]) -> dict[str, Any]:
    left, top, right, bottom = (float(side) for side in box)
    wide, high = right - left, bottom - top
    return {"image_id": picture, "category_id": class_id, "bbox": [left, top, wide, high], "area": wide * high}


# -------------------------------------------------------------------------------------- precision and recall at a score


def hits(
    truth: Sequence[Sequence[Wanted]],
    found: Sequence[Detections],
    classes: int,
    min_score: float,
    min_iou: float = MIN_IOU,
) -> tuple[Hits, ...]:
    """What became of the objects of each class and of the detections from `min_score` on.

    Best score first, a detection takes the free object of its class that it overlaps most, if by `min_iou`; otherwise
    it is false, unless so much of it lies in an ignore region of its class.
    """
    _require_alike(truth, found)
    totals = np.zeros((classes, 3), int)
    for objects, one in zip(truth, found, strict=True):
        for class_id in {*(item.class_id for item in objects), *one.class_ids.tolist()}:
            mine = (one.class_ids == class_id) & (one.scores >= min_score)
            boxes = one.boxes[mine][np.argsort(-one.scores[mine], kind="stable")]
            totals[class_id] += _hits([item for item in objects if item.class_id == class_id], boxes, min_iou)
    return tuple(Hits(*row) for row in totals.tolist())


def total_hits(by_class: Iterable[Hits]) -> Hits:
    """Of all classes together."""
    rows = [(one.wanted, one.found, one.false) for one in by_class]
    return Hits(*np.sum(rows, axis=0).tolist()) if rows else Hits(0, 0, 0)


def _hits(objects: Sequence[Wanted], boxes: Floats, min_iou: float) -> tuple[int, int, int]:
    """Wanted, found and false of one class in one picture; boxes by falling score."""
    counting = _boxes(item.box for item in objects if item.counts)
    ignored = _boxes(item.box for item in objects if not item.counts)
    overlaps, false = box_overlaps(boxes, counting), 0
    shares = _shared(boxes, ignored) / np.maximum(_areas(boxes), 1e-9)[:, None]
    within = (shares.max(1, initial=0.0) >= min_iou).tolist()
    free = np.ones(len(counting), bool)
    for row, inside in zip(overlaps, within, strict=True):
        best = int(np.argmax(np.where(free, row, -1.0))) if free.any() else -1
        if best >= 0 and row[best] >= min_iou:
            free[best] = False
        else:
            false += not inside
    return len(counting), int((~free).sum()), false


def _boxes(boxes: Iterable[tuple[float, float, float, float]]) -> Floats:
    return np.array(list(boxes), np.float32).reshape(-1, 4)


# -------------------------------------------------------------------------------------------------------------- masks


def paired(objects: Sequence[Wanted], found: Detections, min_iou: float = MIN_IOU) -> list[int | None]:
    """For every object the detection of its class that overlaps it most, by index; None if none does by `min_iou`.

    Ignore regions have none. A detection may serve two objects: what its mask is worth is for the masks to show.
    """
    overlaps = box_overlaps(_boxes(item.box for item in objects), found.boxes)
    same = np.array([item.class_id for item in objects], int)[:, None] == found.class_ids[None]
    counts = np.array([item.counts for item in objects], bool)
    overlaps = np.where(same & counts[:, None], overlaps, -1.0)
    best = overlaps.argmax(1) if overlaps.shape[1] else np.zeros(len(objects), int)
    return [int(k) if overlaps.shape[1] and row[k] >= min_iou else None for row, k in zip(overlaps, best, strict=True)]


def mask_overlap(true: NDArray[np.bool_], found: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks (H, W); 0 if both are empty.

    Raises:
        ValueError: masks of different size.
    """
    if true.shape != found.shape:
        raise ValueError(f"a mask of {found.shape} pixels against a true one of {true.shape}")
    union = int(np.count_nonzero(true | found))
    return int(np.count_nonzero(true & found)) / union if union else 0.0


def mask_scores(overlaps: Sequence[float | None], class_ids: Sequence[int], class_names: Sequence[str]) -> MaskScores:
    """Means of the overlaps of objects with these classes; None is an object without a mask."""
    numbers = range(len(class_names))
    of_class = [[value for value, own in zip(overlaps, class_ids, strict=True) if own == number] for number in numbers]
    return MaskScores(
        tuple(class_names),
        tuple(mean(values) for values in of_class),
        tuple(mean(value or 0.0 for value in values) for values in of_class),
        mean(overlaps),
        mean(value or 0.0 for value in overlaps),
        len(overlaps),
        sum(value is None for value in overlaps),
    )
