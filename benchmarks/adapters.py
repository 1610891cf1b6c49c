"""The adapter matrix: networks of the real architectures, random weights, exported here, read by semslam and their own.

    python benchmarks/adapters.py [--only WORD ...] [--models FOLDER] [--keep FOLDER]

Needs torch, transformers, ultralytics, rfdetr, segment-anything, samexporter, torchvision (its Python files alone are
enough), timm; a row whose package is missing says so. Each network is read twice from the same input tensor: by semslam
from the ONNX file, and by its own project from torch, before suppression of overlaps, which is switched off here
(`max_overlap` 1). A box agrees if the project has one of the same class with all corners within half a pixel and a
score within 0.002. Segmentations agree by the share of pixels of their objects that have the project's class, masks by
intersection over union.

Prints a table in Markdown. `--models` adds the ONNX files of a folder (with `coco_classes.txt` if they name no
classes).
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from machine import machine
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import Detections
from semslam.models.detectors import Detector, Look
from semslam.models.segmenters.sam import SamSegmenter

SIZE = (480, 640)
_CORNER_PX, _SCORE = 0.5, 0.002


@dataclass(frozen=True)
class Row:
    """A line of the matrix."""

    architecture: str
    exported: str
    parameters: int
    bytes: int
    adapter: str
    result: str

    def markdown(self) -> str:
        """As the table has it."""
        millions = f"{self.parameters / 1e6:.1f} M" if self.parameters else "-"
        size = f"{self.bytes / 1e6:.1f} MB"
        return f"| {' | '.join((self.architecture, self.exported, millions, size, self.adapter, self.result))} |"


def main() -> int:
    """Make, read, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="rows whose name has one of these words")
    parser.add_argument("--models", type=Path, help="folder with ONNX files to open as well")
    parser.add_argument("--keep", type=Path, help="folder for the networks; a temporary one without")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    print(machine(), end="\n\n", flush=True)
    print("| Architecture | Export | Parameters | File | Adapter | Read as by its own project |")
    print("|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        failed = sum(_print(name, row) for name, row in rows(folder, args.models) if _wanted(name, args.only))
    return 1 if failed else 0


def _wanted(name: str, words: Sequence[str]) -> bool:
    return not words or any(word.lower() in name.lower() for word in words)


def _print(name: str, row: Callable[[], Row]) -> bool:
    """Print a row, or why there is none; whether that was so."""
    try:
        print(row().markdown(), flush=True)
    except Exception as error:  # a package of another version may fail in any way; the other rows go on
        reason = error.text() if isinstance(error, SemslamError) else f"{type(error).__name__}: {error}"
        print(f"| {name} | - | - | - | - | fails: {reason.splitlines()[0][:160]} |", flush=True)
        traceback.print_exc(file=sys.stderr)
        return True
    return False


def rows(folder: Path, models: Path | None) -> Iterator[tuple[str, Callable[[], Row]]]:
    """All rows, not yet made."""
    from_torch = _torch_rows() if _has_torch() else {}
    for name, make in from_torch.items():
        yield name, partial(_detector_row, name, make, folder)
    for name, make in (_pair_rows() if from_torch else {}).items():
        yield name, partial(_pair_row, name, make, folder)
    for path in sorted(models.glob("*.onnx")) if models else []:
        yield path.name, partial(_file_row, path)


def _has_torch() -> bool:
    try:
        import torch
    except ImportError:
        return False
    torch.manual_seed(0)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "2")))
    try:
        import torchvision  # noqa: F401
    except (ImportError, RuntimeError):
        _declare_missing_operators()
    return True


def _declare_missing_operators() -> None:
    """Let torchvision's Python files load without its compiled ones: no row runs the operators these declare."""
    import torch

    for name in [name for name in sys.modules if name.startswith("torchvision")]:
        del sys.modules[name]
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    globals()["_library"] = library  # its declarations last as long as it does


def _torch_rows() -> dict[str, Callable[[Path], object]]:
    """Makers of detectors by name."""
    from architectures import darknet, transformers_nets, ultralytics_nets

    found: dict[str, Callable[[Path], object]] = {
        "YOLOv3, Darknet-53 (written here)": darknet.yolov3,
        "YOLOv3-tiny (written here)": darknet.yolov3_tiny,
    }
    for kind in ("yolov8n", "yolo11n", "yolo12n", "yolov10n", "yolo26n", "yolov8n-seg", "yolo11n-seg", "yolo26n-seg"):
        found[f"{kind} (ultralytics)"] = partial(ultralytics_nets.ultralytics, f"{kind}.yaml")
    found["rtdetr-l (ultralytics)"] = partial(ultralytics_nets.ultralytics, "rtdetr-l.yaml")
    found["RT-DETR (transformers)"] = transformers_nets.rtdetr
    found["RT-DETR, authors' signature (transformers)"] = transformers_nets.rtdetr_sized
    found["RF-DETR nano (rfdetr)"] = transformers_nets.rfdetr
    found["RF-DETR-seg nano (rfdetr)"] = partial(transformers_nets.rfdetr, kind="RFDETRSegNano")
    found["DETR (transformers)"] = transformers_nets.detr
    found["YOLOS (transformers)"] = transformers_nets.yolos
    for kind in ("Segformer", "MobileViT", "MobileNetV2", "deeplabv3_mobilenet_v3"):
        source = "torchvision" if kind.startswith("deeplab") else "transformers"
        found[f"{kind} segmentation ({source})"] = partial(transformers_nets.segmentation, kind)
    found["MobileNetV2 segmentation, argmax (transformers)"] = partial(
        transformers_nets.segmentation, "MobileNetV2", numbers=True
    )
    return found


def _pair_rows() -> dict[str, Callable[[Path], object]]:
    from architectures import sam_nets

    return {
        "Segment Anything (segment-anything)": sam_nets.sam,
        "MobileSAM (samexporter)": partial(sam_nets.mobile_sam, pixels=False, many=False),
        "MobileSAM, pixels in, open prompts (samexporter)": partial(sam_nets.mobile_sam, pixels=True, many=True),
    }


# -------------------------------------------------------------------------------------------------------------- reading


def picture() -> NDArray[np.uint8]:
    """Coloured blobs: something with edges at all scales, the same every time."""
    rng = np.random.default_rng([0, 5])
    rgb = np.full((*SIZE, 3), 120, np.uint8)
    for _ in range(60):
        centre = tuple(int(v) for v in rng.integers(0, [SIZE[1], SIZE[0]]))
        cv2.circle(rgb, centre, int(rng.integers(5, 90)), rng.integers(0, 256, 3).tolist(), -1)
    return rgb


def _detector_row(name: str, make: Callable[[Path], object], folder: Path) -> Row:
    from architectures.made import Made

    made = make(folder)
    if not isinstance(made, Made):
        raise TypeError(f"{name} was not made")
    names = folder / f"{made.path.stem}.txt"
    names.write_text("\n".join(made.names))
    detector = Detector.open(made.path, classes_path=names, threads=int(os.environ.get("OMP_NUM_THREADS", "2")))
    rgb = picture()
    feeds, box = detector.adapter.preprocess(rgb, None, detector.signature)
    wanted = made.read(feeds, SIZE)
    outputs = detector.session.run(feeds)
    if wanted.class_map is not None:
        look = Look(box, 0.0, 1.0, detector.class_names)
        result = _same_pixels(detector.adapter.postprocess(outputs, look, detector.signature), wanted.class_map)
    else:
        least = _threshold(wanted.scores)
        look = Look(box, least, 1.0, detector.class_names)
        result = _same_boxes(detector.adapter.postprocess(outputs, look, detector.signature), wanted, least)
    return Row(name, made.exported, made.parameters, made.path.stat().st_size, detector.name, result)


def _threshold(scores: NDArray[np.float32]) -> float:
    """A score with a gap around it, so that rounding decides nothing, that some dozens pass."""
    falling = np.sort(scores[np.isfinite(scores)])[::-1].astype(np.float64)[:200]
    first = min(15, len(falling) // 2)
    gap = first + int(np.argmax(falling[first:-1] - falling[first + 1 :]))
    return float((falling[gap] + falling[gap + 1]) / 2)


def _same_boxes(found: Detections, wanted: object, least: float) -> str:
    """How many agree, both ways, and by how much they differ."""
    from architectures.made import Answer

    if not isinstance(wanted, Answer):
        raise TypeError("no answer")
    limits = [SIZE[1], SIZE[0]] * 2
    boxes = np.clip(wanted.boxes, 0, limits)
    usable = (wanted.scores >= least) & (boxes[:, 2:] - boxes[:, :2] > 1).all(axis=1)
    theirs = np.flatnonzero(usable)
    worst_px, worst_score, pairs = 0.0, 0.0, []
    for i in range(len(found)):
        corner = np.abs(boxes[theirs] - found.boxes[i]).max(axis=1, initial=0.0)
        score = np.abs(wanted.scores[theirs] - found.scores[i])
        same = (wanted.class_ids[theirs] == found.class_ids[i]) & (corner < _CORNER_PX) & (score < _SCORE)
        if same.any():
            best = int(np.flatnonzero(same)[corner[same].argmin()])
            pairs.append((i, int(theirs[best])))
            worst_px, worst_score = max(worst_px, float(corner[best])), max(worst_score, float(score[best]))
    ours = found.boxes[[i for i, _ in pairs]], found.class_ids[[i for i, _ in pairs]]
    missed = sum(not _covered(boxes[j], int(wanted.class_ids[j]), *ours) for j in theirs)
    text = f"{len(pairs)} of {len(found)} boxes agree, {missed} missed, corners within {worst_px:.2f} px"
    if found.masks is None or wanted.masks is None or not pairs:
        return text
    other = wanted.masks(np.array([j for _, j in pairs]))
    return f"{text}; masks {_overlap(found.masks[[i for i, _ in pairs]], other)}"


def _covered(box: NDArray[np.float32], class_id: int, ours: NDArray[np.float32], class_ids: NDArray[np.int64]) -> bool:
    """Whether one of ours is this box, or the same once more: of doubles, semslam keeps the best."""
    low, high = np.maximum(box[:2], ours[:, :2]), np.minimum(box[2:], ours[:, 2:])
    common = np.clip(high - low, 0, None).prod(axis=1)
    either = (box[2:] - box[:2]).prod() + (ours[:, 2:] - ours[:, :2]).prod(axis=1) - common
    return bool(((common / either > 0.999) & (class_ids == class_id)).any())


def _overlap(ours: NDArray[np.bool_], theirs: NDArray[np.bool_]) -> str:
    common, either = (ours & theirs).sum(axis=(1, 2)), (ours | theirs).sum(axis=(1, 2))
    shares = common[either > 50] / either[either > 50]
    return f"IoU {shares.mean():.3f} on average, {shares.min():.3f} at least" if len(shares) else "all next to empty"


def _same_pixels(found: Detections, theirs: NDArray[np.int64]) -> str:
    if found.masks is None or not len(found):
        return "no pieces"
    classes = np.full(SIZE, -1)
    for mask, class_id in zip(found.masks, found.class_ids, strict=True):
        classes[mask] = class_id
    covered = classes >= 0
    same = (classes == theirs)[covered].mean()
    return f"{len(found)} pieces on {covered.mean():.0%} of the picture, {same:.1%} of their pixels of the same class"


def _pair_row(name: str, make: Callable[[Path], object], folder: Path) -> Row:
    from architectures.sam_nets import Pair

    pair = make(folder)
    if not isinstance(pair, Pair):
        raise TypeError(f"{name} was not made")
    segmenter = SamSegmenter.open(pair.encoder, pair.decoder, threads=int(os.environ.get("OMP_NUM_THREADS", "2")))
    boxes = np.array([[60, 50, 300, 260], [320.5, 100.2, 600, 400], [10, 300, 200, 470]], np.float32)
    rgb = picture()
    ours = segmenter(rgb, np.zeros(SIZE, np.float32), boxes)
    theirs = pair.masks(rgb, boxes)
    within = segmenter.within(boxes, SIZE)
    size = pair.encoder.stat().st_size + pair.decoder.stat().st_size
    return Row(name, pair.exported, pair.parameters, size, "sam", f"masks {_overlap(ours, theirs & within)}")


def _file_row(path: Path) -> Row:
    """A real file: which adapter, how many classes."""
    classes = path.with_name("coco_classes.txt")
    try:
        detector = Detector.open(path)
    except SemslamError:
        detector = Detector.open(path, classes_path=classes)
    found = detector(picture(), 0.05, 0.5)
    result = f"opens, {len(detector.class_names)} classes, {len(found)} boxes above 0.05 on blobs"
    return Row(path.name, "as published", 0, path.stat().st_size, detector.name, result)


if __name__ == "__main__":
    sys.exit(main())
