"""The distance at which the object of a box stands: the main mode of the depths inside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BIN_M = 0.1
_MIN_PIXELS = 20


def inner(boxes: NDArray[np.float32], width: int, height: int) -> NDArray[np.int64]:
    """Boxes (N, 4) as whole pixels inside the picture, at least one pixel wide and high; right and bottom exclusive."""
    low = np.floor(boxes[:, :2]).astype(np.int64)
    high = np.ceil(boxes[:, 2:]).astype(np.int64)
    size = np.array([width, height])
    low = np.clip(low, 0, size - 1)
    return np.concatenate([low, np.clip(high, low + 1, size)], axis=1)


def depth_mode(depth_m: NDArray[np.float32]) -> float | None:
    """The main distance in a box's depths (h, w), metres; None with too little depth.

    Pixels near the middle of the box count more, and near surfaces more than far ones: what stands behind an object
    fills the corners of its box and the holes of a chair.
    """
    seen = depth_m > 0
    if np.count_nonzero(seen) < _MIN_PIXELS:
        return None
    rows, columns = np.indices(depth_m.shape, dtype=np.float32)
    height, width = depth_m.shape
    across = (columns + 0.5) / width - 0.5
    down = (rows + 0.5) / height - 0.5
    weight = np.exp(-4.0 * (across**2 + down**2)) / np.maximum(depth_m, 0.3)
    bins = (depth_m[seen] / _BIN_M).astype(np.int64)
    histogram = np.convolve(np.bincount(bins, weight[seen]), [0.5, 1.0, 0.5], mode="same")
    peak = int(histogram.argmax())
    close = np.abs(bins - peak) <= 1
    return float(np.median(depth_m[seen][close]))
