"""Class maps of semantic segmentation (DeepLab and the like): each connected piece of a class is an object.

One output (the first; auxiliary ones are ignored): class numbers (1, H, W) or (1, 1, H, W), or logits
(1, classes, h, w), of the input's size or up to 32 times smaller. The input is (1, 3, h, w), by ImageNet's
normalisation unless the metadata holds `mean` and `std`, or (1, h, w, 3) pixels 0 to 255, as DeepLab's own export has
it. The picture is stretched.

Pieces of one class that touch in the picture but are parted by a step of depth are different objects. A piece's score
is the mean probability of its class over its pixels, 1 where the model gives numbers alone. Classes that are no objects
(`BACKGROUND`) and pieces of less than a thousandth of the picture are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import MOST_OBJECTS, Detections, Floats, Letterbox, fitted, stretched
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import IMAGENET, input_size, known_sizes, one_picture, planes, stated_scaling
from semslam.models.session import Signature, Tensor

BACKGROUND = frozenset(
    ("background", "bg", "void", "unlabeled", "unlabelled", "unknown", "other", "ignore", "wall", "floor", "ceiling")
    + ("ground", "building", "road", "sidewalk", "sky", "earth", "grass")
)
"""Class names that never become objects; of names like `door;double door` the first part counts."""
_MIN_SHARE = 0.001
"""Of the map: smaller pieces are noise."""
_STEP_M, _STEP_SHARE = 0.15, 0.08
"""A step of depth: more than this, and more than this share of the distance."""
_COARSEST = 32
_FINE = 2
"""Logits coarser than half of the input are enlarged to it before classes are compared."""

Map = NDArray[np.uint16]
_NO_CLASS = 0xFFFF


@dataclass(frozen=True)
class ClassMap:
    """The adapter."""

    name: str = "class_map"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature) if not _pixels(signature) else ""
        if problem:
            return problem
        tensor = signature.outputs[0]
        if any(word in tensor.name.lower() for word in ("embed", "feature")):
            return f"its output {tensor.name} is an embedding by name"
        numbers, size = "int" in tensor.type, _map_size(tensor)
        if len(tensor.shape) not in ((3, 4) if numbers else (4,)) or size is None:
            return f"wants class numbers (1, H, W) or logits (1, classes, h, w) of known size, found {tensor}"
        if len(tensor.shape) == 4 and (tensor.shape[1] != 1 if numbers else int(tensor.shape[1]) < 2):
            return f"wants one map of class numbers or logits of two or more classes, found {tensor}"
        height, width = _picture_size(signature)
        small = any(side * _COARSEST < whole for side, whole in zip(size, (height, width), strict=True))
        return f"map of {size[1]}x{size[0]} does not fit a {width}x{height} input" if small else ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) normalised, or (1, h, w, 3) as it is."""
        height, width = _picture_size(signature)
        box = stretched((rgb.shape[0], rgb.shape[1]), width, height)
        canvas = fitted(rgb, box, width, height)
        feed = canvas[None] if _pixels(signature) else planes(canvas, stated_scaling(signature, IMAGENET))
        return {signature.inputs[0].name: feed}, box

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """Pieces by falling score."""
        answer = outputs[0][0]
        unsound = 0
        if "int" in signature.outputs[0].type:
            classes, certainty = _numbers(answer.reshape(answer.shape[-2:])), None
        else:
            classes, certainty, unsound = _most_likely(np.asarray(answer, np.float32), _picture_size(signature))
        found = list(_pieces(classes, certainty, look))
        found.sort(key=lambda piece: -piece.score)
        return _detections(found[:MOST_OBJECTS], int(unsound > 0), look.box)

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes; a map of numbers does not tell."""
        tensor = signature.outputs[0]
        return () if "int" in tensor.type else (int(tensor.shape[1]),)


@dataclass(frozen=True)
class _Piece:
    class_id: int
    score: float
    mask: NDArray[np.bool_]
    """(H, W) of the picture."""


def _pixels(signature: Signature) -> bool:
    """Whether the input takes (1, h, w, 3) pixels."""
    shape, kind = signature.inputs[0].shape, signature.inputs[0].type
    return len(signature.inputs) == 1 and len(shape) == 4 and shape[3] == 3 and kind == "tensor(uint8)"


def _picture_size(signature: Signature) -> tuple[int, int]:
    if not _pixels(signature):
        return input_size(signature)
    height, width = (size if isinstance(size, int) else 513 for size in signature.inputs[0].shape[1:3])
    return height, width


def _map_size(tensor: Tensor) -> tuple[int, int] | None:
    """Height and width of the map; None if they are open."""
    sizes = known_sizes(tensor)
    return (sizes[-2], sizes[-1]) if len(sizes) >= 2 else None


def _most_likely(logits: Floats, size: tuple[int, int]) -> tuple[Map, Floats, int]:
    """Class numbers (h, w), their probabilities, and how many pixels of (C, h, w) were no numbers (no class)."""
    sound = np.isfinite(logits).all(axis=0)
    unsound = int(np.count_nonzero(~sound))
    if unsound:
        logits = np.where(sound, logits, np.float32(0))
    if logits.shape[1] * _FINE < size[0]:
        finer = (size[1] // _FINE, size[0] // _FINE)
        logits = np.stack([_resized(np.asarray(plane, np.float32), finer, cv2.INTER_LINEAR) for plane in logits])
        sound = _resized(np.asarray(sound, np.float32), finer, cv2.INTER_NEAREST_EXACT) > 0
    classes = logits.argmax(axis=0)
    top = np.take_along_axis(logits, classes[None], axis=0)
    certainty = 1 / np.exp(logits - top).sum(axis=0)
    return _numbers(np.where(sound, classes, -1)), np.asarray(certainty, np.float32), unsound


def _numbers(classes: Array) -> Map:
    """Class numbers (h, w) as small ones: counting and comparing those is several times faster."""
    return np.where((classes >= 0) & (classes < _NO_CLASS), classes, _NO_CLASS).astype(np.uint16)


def _resized(plane: Floats, size: tuple[int, int], interpolation: int) -> Floats:
    return np.asarray(cv2.resize(plane, size, interpolation=interpolation), np.float32)


def _pieces(classes: Map, certainty: Floats | None, look: Look) -> Iterator[_Piece]:
    """Connected pieces of object classes, parted at steps of depth."""
    height, width = classes.shape
    steps = np.zeros((height, width), bool)
    if look.depth_m is not None:
        steps = depth_steps(_resized(look.depth_m, (width, height), cv2.INTER_NEAREST_EXACT))
    smallest = max(4, round(_MIN_SHARE * classes.size))
    counts = np.bincount(classes.ravel())[:_NO_CLASS]
    for class_id in np.flatnonzero(counts >= smallest).tolist():
        if _is_background(class_id, look.class_names):
            continue
        for mask in _connected(classes == class_id, steps, smallest):
            score = 1.0 if certainty is None else float(certainty[mask].mean())
            if score >= look.min_score:
                whole = cv2.resize(
                    mask.astype(np.uint8), (look.box.width, look.box.height), interpolation=cv2.INTER_NEAREST_EXACT
                )
                yield _Piece(class_id, score, whole > 0)


def depth_steps(depth_m: Floats) -> NDArray[np.bool_]:
    """Pixels (h, w) whose right or lower neighbour is much nearer or farther; without depth there is no step."""
    steps = np.zeros(depth_m.shape, bool)
    for one, other, found in (
        (depth_m[:, :-1], depth_m[:, 1:], steps[:, :-1]),
        (depth_m[:-1], depth_m[1:], steps[:-1]),
    ):
        nearer = np.minimum(one, other)
        found |= (np.abs(one - other) > np.maximum(_STEP_M, _STEP_SHARE * nearer)) & (nearer > 0)
    return steps


def _connected(inside: NDArray[np.bool_], steps: NDArray[np.bool_], smallest: int) -> list[NDArray[np.bool_]]:
    """Masks (h, w) of the connected pieces that are large enough, with the pixels on the steps themselves."""
    left, top, width, height = cv2.boundingRect(inside.astype(np.uint8))
    part = slice(top, top + height), slice(left, left + width)
    whole = (inside[part] & ~steps[part]).astype(np.uint8)
    # Four neighbours: a line of steps that runs diagonally leaves gaps for eight.
    count, found, stats, _ = cv2.connectedComponentsWithStats(whole, connectivity=4, ltype=cv2.CV_32S)
    labels = _with_steps(np.asarray(found, np.int32), inside[part] & steps[part])
    masks = []
    for label in range(1, count):
        if stats[label, cv2.CC_STAT_AREA] >= smallest:
            mask = np.zeros(inside.shape, bool)
            np.equal(labels, label, out=mask[part])
            masks.append(mask)
    return masks


def _with_steps(labels: NDArray[np.int32], on_step: NDArray[np.bool_]) -> NDArray[np.int32]:
    """A pixel before a step belongs to the piece on its left or above it: those lie on its own side."""
    if not on_step.any():
        return labels
    labels = labels.copy()
    for axis in (1, 0):
        before = np.roll(labels, 1, axis=axis)
        (before[:, 0] if axis else before[0])[...] = 0
        alone = on_step & (labels == 0)
        labels[alone] = before[alone]
    return labels


def _is_background(class_id: int, names: tuple[str, ...]) -> bool:
    if class_id >= len(names):
        return False
    words = names[class_id].lower().replace(",", ";").split(";")
    return words[0].strip().strip("_") in BACKGROUND


def _detections(pieces: list[_Piece], dropped: int, box: Letterbox) -> Detections:
    masks = np.stack([piece.mask for piece in pieces]) if pieces else np.zeros((0, box.height, box.width), bool)
    corners = [cv2.boundingRect(piece.mask.astype(np.uint8)) for piece in pieces]
    boxes = np.array([[x, y, x + w, y + h] for x, y, w, h in corners], np.float32).reshape(-1, 4)
    scores = np.array([piece.score for piece in pieces], np.float32)
    return Detections(boxes, scores, np.array([piece.class_id for piece in pieces], np.int64), dropped, masks)


ADAPTERS: tuple[Adapter, ...] = (ClassMap(),)
