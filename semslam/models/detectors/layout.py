"""What detector layouts have in common: a picture in, candidates out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Floats
from semslam.models.session import Signature

Array = NDArray[Any]

DEFAULT_SIDE = 640
"""Side of the input where a model leaves it open, pixels."""


def one_picture(signature: Signature) -> str:
    """Why the input is no float picture (1, 3, h, w); empty if it is."""
    if len(signature.inputs) != 1:
        return f"wants one input, found {len(signature.inputs)}"
    tensor = signature.inputs[0]
    if len(tensor.shape) != 4 or tensor.shape[1] != 3:
        return f"wants an input (1, 3, height, width), found {tensor}"
    if tensor.type not in ("tensor(float)", "tensor(float16)"):
        return f"wants a float input, found {tensor.type}"
    return "" if tensor.shape[0] == 1 or isinstance(tensor.shape[0], str) else f"wants batches of 1, found {tensor}"


def input_size(signature: Signature) -> tuple[int, int]:
    """Height and width of the input."""
    height, width = signature.inputs[0].shape[2:]
    return (
        height if isinstance(height, int) else DEFAULT_SIDE,
        width if isinstance(width, int) else DEFAULT_SIDE,
    )


def dense_rows(signature: Signature, values: int) -> str:
    """Why the output is not one of (1, candidates, at least `values`); empty if it is."""
    if len(signature.outputs) != 1 or len(signature.outputs[0].shape) != 3:
        return f"wants one output of three dimensions, found {len(signature.outputs)} outputs"
    _, rows, columns = signature.outputs[0].shape
    if not isinstance(columns, int) or columns < values:
        return f"last dimension of the output is {columns}, wants 5 + classes"
    if isinstance(rows, int) and rows < columns:
        return f"output has {rows} candidates of {columns} values: more candidates than values expected"
    return ""


def unit_tensor(canvas: NDArray[np.uint8]) -> Floats:
    """(h, w, 3) 0 to 255 as (1, 3, h, w) 0 to 1."""
    return np.multiply(canvas.transpose(2, 0, 1)[None], np.float32(1 / 255), dtype=np.float32, order="C")


def best_class(class_scores: Floats, objectness: Floats | None = None) -> tuple[Floats, NDArray[np.int64]]:
    """Score (N,) and index (N,) of the best class of each candidate (N, C), times its objectness (N,)."""
    class_ids = class_scores.argmax(axis=1)
    scores = class_scores[np.arange(len(class_scores)), class_ids]
    return np.asarray(scores if objectness is None else scores * objectness, np.float32), class_ids


def corners(centre_size: Floats) -> Floats:
    """(N, 4) left, top, right, bottom from centre and size."""
    half = centre_size[:, 2:4] * np.float32(0.5)
    return np.concatenate([centre_size[:, :2] - half, centre_size[:, :2] + half], axis=1)
