"""NanoDet: for each stride class scores (1, n, classes) and distributions over distances (1, n, 4 * bins).

The distances from a cell's centre to the four sides of its box are expectations over the bins, in units of the stride
(generalised focal loss, Li et al. 2020). Source of the layout: the ONNX export of the NanoDet project; pictures are
BGR, normalised by ImageNet's mean and deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, select
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import Scaling, best_class, input_size, likely, one_picture, planes, single
from semslam.models.session import Signature, Tensor

_SCALING = Scaling(
    (1 / 58.395, 1 / 57.12, 1 / 57.375), (-123.675 / 58.395, -116.28 / 57.12, -103.53 / 57.375), bgr=True
)
"""ImageNet's mean and deviation."""


@dataclass(frozen=True)
class _Level:
    stride: int
    scores: int
    """Index of the output with class scores."""
    distances: int


@dataclass(frozen=True)
class Nanodet:
    """The adapter."""

    name: str = "nanodet"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature)
        if problem:
            return problem
        if len(signature.outputs) < 2 or len(signature.outputs) % 2:
            return f"wants class scores and distances for each stride, found {len(signature.outputs)} outputs"
        if any(len(t.shape) != 3 or not all(isinstance(d, int) for d in t.shape[1:]) for t in signature.outputs):
            return "wants outputs (1, cells, values) of known size"
        return "" if _levels(signature) else "outputs do not pair up as class scores and distances a stride"

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) BGR, normalised."""
        height, width = input_size(signature)
        canvas, box = fit(rgb, width, height, fill=0)
        return {signature.inputs[0].name: planes(canvas, _SCALING)}, box

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """Only cells above the score are decoded; the others cannot survive."""
        height, width = input_size(signature)
        boxes, scores, class_ids = [], [], []
        for level in _levels(signature):
            best, ids = best_class(single(outputs[level.scores]))
            chosen = likely(best, look.min_score)
            bins = single(outputs[level.distances])[chosen]
            boxes.append(_boxes(_centres(height, width, level.stride)[chosen], bins, level.stride))
            scores.append(best[chosen])
            class_ids.append(ids[chosen])
        return select(
            np.concatenate(boxes),
            np.concatenate(scores),
            np.concatenate(class_ids),
            look.box,
            min_score=look.min_score,
            max_overlap=look.max_overlap,
        )

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (int(signature.outputs[_levels(signature)[0].scores].shape[2]),)


def _levels(signature: Signature) -> tuple[_Level, ...]:
    """Pairs of outputs by stride; empty if they do not pair up."""
    height, width = input_size(signature)
    by_cells: dict[int, list[int]] = {}
    for index, tensor in enumerate(signature.outputs):
        by_cells.setdefault(int(tensor.shape[1]), []).append(index)
    levels = []
    for stride in (4, 8, 16, 32, 64):
        cells = -(-height // stride) * -(-width // stride)
        pair = by_cells.pop(cells, [])
        if len(pair) == 2:
            scores, distances = sorted(pair, key=lambda i: _is_distance(signature.outputs[i]))
            levels.append(_Level(stride, scores, distances))
        elif pair:
            return ()
    return () if by_cells or len(levels) < 2 else tuple(levels)


def _is_distance(tensor: Tensor) -> tuple[bool, bool]:
    """Distances are named dis or reg, or else have 32 values (eight bins for four sides)."""
    return any(word in tensor.name for word in ("dis", "reg", "bbox")), tensor.shape[2] == 32


@cache
def _centres(height: int, width: int, stride: int) -> Floats:
    """Where each cell's distances start (n, 2), pixels of the input: the middle of the cell, less half a pixel."""
    rows, columns = np.mgrid[: -(-height // stride), : -(-width // stride)]
    places = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
    return np.asarray(places * stride + (stride - 1) * 0.5, np.float32)


def _boxes(centres: Floats, bins: Floats, stride: int) -> Floats:
    """(n, 4) from distributions (n, 4 * bins) over distances to left, top, right, bottom."""
    spread = bins.reshape(len(bins), 4, bins.shape[1] // 4)
    spread = np.exp(spread - spread.max(axis=2, keepdims=True))
    spread /= spread.sum(axis=2, keepdims=True)
    distances = (spread @ np.arange(spread.shape[2], dtype=np.float32)) * stride  # (n, 4)
    return np.concatenate([centres - distances[:, :2], centres + distances[:, 2:]], axis=1)


ADAPTERS: tuple[Adapter, ...] = (Nanodet(),)
