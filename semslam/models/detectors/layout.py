"""What detector layouts have in common: a picture in, candidates out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.class_names import names_from_metadata
from semslam.models.detections import Floats, Indices, Letterbox, fit
from semslam.models.detectors.adapter import Array
from semslam.models.session import Signature, Tensor

MOST_ROWS = 1000
"""Of a model that suppresses overlaps itself; others give thousands."""
MOST_CLASSES = 1_000_000
DEFAULT_SIDE = 640
"""Side of the input where a model leaves it open, pixels."""
_FLOATS = ("tensor(float)", "tensor(float16)")


@dataclass(frozen=True)
class Scaling:
    """From pixels 0 to 255 to what a network was trained on: scale * pixel + offset, channel by channel (RGB)."""

    scale: tuple[float, float, float]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bgr: bool = False
    """The network wants blue first."""


UNIT = Scaling((1 / 255, 1 / 255, 1 / 255))
PIXELS_BGR = Scaling((1.0, 1.0, 1.0), bgr=True)


def standardised(mean: tuple[float, ...], deviation: tuple[float, ...], *, bgr: bool = False) -> Scaling:
    """(pixel / 255 - mean) / deviation, each of them RGB and 0 to 1."""
    pairs = [(1 / (255 * d), -m / d) for m, d in zip(mean, deviation, strict=True)]
    (a, x), (b, y), (c, z) = pairs
    return Scaling((a, b, c), (x, y, z), bgr)


IMAGENET = standardised((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))


def stated_scaling(signature: Signature, usual: Scaling) -> Scaling:
    """What the metadata's `mean` and `std` (JSON lists, RGB, 0 to 1) say, else what is usual for the layout."""
    try:
        mean, deviation = (json.loads(signature.metadata[key]) for key in ("mean", "std"))
        return standardised(tuple(map(float, mean)), tuple(map(float, deviation)), bgr=usual.bgr)
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return usual


def planes(canvas: NDArray[np.uint8], scaling: Scaling) -> Floats:
    """(h, w, 3) 0 to 255 as (1, 3, h, w), scaled.

    Plane by plane into place: on 640 x 640 half the time of one strided multiplication, a tenth of OpenCV's blob.
    """
    tensor = np.empty((1, 3, *canvas.shape[:2]), np.float32)
    for channel, pixels in enumerate(cv2.split(canvas)):
        plane = tensor[0, 2 - channel if scaling.bgr else channel]
        np.multiply(pixels, np.float32(scaling.scale[channel]), out=plane, dtype=np.float32)
        if scaling.offset[channel]:
            plane += np.float32(scaling.offset[channel])
    return tensor


def picture_input(signature: Signature) -> Tensor | None:
    """The input that takes float pictures (N, 3, h, w), if there is just one."""
    found = [t for t in signature.inputs if len(t.shape) == 4 and t.shape[1] == 3 and t.type in _FLOATS]
    return found[0] if len(found) == 1 else None


def one_picture(signature: Signature) -> str:
    """Why the input is no float picture (1, 3, h, w); empty if it is."""
    if len(signature.inputs) != 1:
        return f"wants one input, found {len(signature.inputs)}"
    tensor = signature.inputs[0]
    if len(tensor.shape) != 4 or tensor.shape[1] != 3:
        return f"wants an input (1, 3, height, width), found {tensor}"
    if tensor.type not in _FLOATS:
        return f"wants a float input, found {tensor.type}"
    return "" if tensor.shape[0] == 1 or isinstance(tensor.shape[0], str) else f"wants batches of 1, found {tensor}"


def input_size(signature: Signature) -> tuple[int, int]:
    """Height and width of the picture."""
    tensor = picture_input(signature) or signature.inputs[0]
    height, width = tensor.shape[2:]
    return (
        height if isinstance(height, int) else DEFAULT_SIDE,
        width if isinstance(width, int) else DEFAULT_SIDE,
    )


def _listed(tensors: tuple[Tensor, ...]) -> str:
    return ", ".join(map(str, tensors)) if len(tensors) <= 3 else f"{len(tensors)} of them"


def one_table(signature: Signature) -> str:
    """Why there is not just one output, of three dimensions and floats; empty if there is."""
    if len(signature.outputs) != 1 or len(signature.outputs[0].shape) != 3:
        return f"wants one output of three dimensions, found {_listed(signature.outputs)}"
    tensor = signature.outputs[0]
    return "" if tensor.type in _FLOATS else f"wants a float output, found {tensor}"


def dense_rows(signature: Signature, values: int) -> str:
    """Why the output is not one of (1, candidates, at least `values`); empty if it is."""
    problem = one_table(signature)
    if problem:
        return problem
    _, rows, columns = signature.outputs[0].shape
    if not isinstance(columns, int) or columns < values:
        return f"last dimension of the output is {columns}, wants 5 + classes"
    if isinstance(rows, int) and rows < columns:
        return f"output has {rows} candidates of {columns} values: more candidates than values expected"
    return ""


def query_rows(signature: Signature) -> str:
    """Why the output is not one of (1, a few hundred rows, values); empty if it is."""
    problem = one_table(signature)
    if problem:
        return problem
    _, rows, values = signature.outputs[0].shape
    if not isinstance(rows, int) or not isinstance(values, int):
        return f"wants an output of known size, found {signature.outputs[0]}"
    return "" if rows <= MOST_ROWS else f"output has {rows} rows, wants at most {MOST_ROWS}"


def names_stated(signature: Signature) -> int | None:
    """How many classes the metadata names; None if it names none that make sense."""
    try:
        names = names_from_metadata(signature.metadata)
    except SemslamError:
        return None
    return len(names) if names else None


def head_is_rtdetr(signature: Signature) -> bool:
    """Whether Ultralytics' metadata call it an RT-DETR: its rows hold shares where those of YOLO hold pixels."""
    return signature.metadata.get("head") == "RTDETRDecoder"


def class_numbers(values: Floats) -> Indices:
    """Class numbers that came as floats; -1, which is no class, for what is no number."""
    return np.where(np.abs(values) < MOST_CLASSES, values, -1).astype(np.int64)


def known_sizes(tensor: Tensor) -> tuple[int, ...]:
    """Sizes after the first dimension; empty if one of them is open."""
    sizes = tuple(size for size in tensor.shape[1:] if isinstance(size, int))
    return sizes if len(sizes) == len(tensor.shape) - 1 else ()


def blank_feeds(signature: Signature) -> dict[str, Array] | None:
    """Empty inputs for a trial run; None if there is an input of which nobody knows what it wants."""
    if picture_input(signature) is None:
        return None
    height, width = input_size(signature)
    feeds: dict[str, Array] = {}
    for tensor in signature.inputs:
        channels = tensor.shape[1] if len(tensor.shape) == 4 else 0
        shape = {2: (1, 2), 3: (1, height, width), 4: (1, channels, height, width)}.get(len(tensor.shape))
        if shape is None or isinstance(channels, str) or tensor.type not in NUMPY_TYPES:
            return None
        feeds[tensor.name] = np.ones([int(size) for size in shape], NUMPY_TYPES[tensor.type])
    return feeds


NUMPY_TYPES: dict[str, Any] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float32,  # the session casts
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
    "tensor(bool)": np.bool_,
}


def single(output: Array) -> Floats:
    """The first and only picture's part of an output."""
    return np.asarray(output[0], np.float32)


def likely(scores: Floats, min_score: float) -> Indices:
    """Candidates worth decoding: high scores, and what is no number, so that it is counted."""
    return np.flatnonzero(~(scores < min_score))


def best_class(class_scores: Floats, objectness: Floats | None = None) -> tuple[Floats, Indices]:
    """Score (N,) and index (N,) of the best class of each candidate (N, C), times its objectness (N,)."""
    class_ids = class_scores.argmax(axis=1)
    scores = class_scores[np.arange(len(class_scores)), class_ids]
    return np.asarray(scores if objectness is None else scores * objectness, np.float32), class_ids


def sigmoid(values: Floats) -> Floats:
    """1 / (1 + exp(-x)), quiet at the ends."""
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + np.exp(-values)), np.float32)


def corners(centre_size: Floats) -> Floats:
    """(N, 4) left, top, right, bottom from centre and size."""
    half = centre_size[:, 2:4] * np.float32(0.5)
    with np.errstate(invalid="ignore"):
        return np.concatenate([centre_size[:, :2] - half, centre_size[:, :2] + half], axis=1)


def centred_picture(rgb: NDArray[np.uint8], signature: Signature) -> tuple[dict[str, Array], Letterbox]:
    """The YOLO families' one input: (1, 3, h, w) RGB, 0 to 1, the picture in the middle of grey."""
    height, width = input_size(signature)
    canvas, box = fit(rgb, width, height)
    return {signature.inputs[0].name: planes(canvas, UNIT)}, box
