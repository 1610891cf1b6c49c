"""Masks as networks give them, grids of logits over their whole input, brought to the pixels of the picture.

YOLACT (Bolya et al. 2019) and what follows it combine a few prototypes a picture with coefficients a box; transformers
give a grid a query, prompted segmenters one a box. Each lies over the whole input, whatever its own size.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Floats, Letterbox


def combined(coefficients: Floats, prototypes: Floats) -> Floats:
    """(n, K) and (K, h, w) -> logits (n, h, w)."""
    count, height, width = prototypes.shape
    with np.errstate(invalid="ignore", over="ignore"):
        grids = coefficients @ prototypes.reshape(count, height * width)
    return np.asarray(grids.reshape(len(coefficients), height, width), np.float32)


def masks_from_grids(
    grids: Floats | Sequence[Floats], boxes: Floats, box: Letterbox, size: tuple[int, int]
) -> NDArray[np.bool_]:
    """Masks (n, H, W) of the picture, each inside its box.

    Args:
        grids: n times (h, w) logits over the model's input; what is no number is no object.
        boxes: (n, 4) in pixels of the picture.
        box: how the picture was fitted.
        size: height and width of the model's input.
    """
    masks = np.zeros((len(boxes), box.height, box.width), bool)
    cells = np.array([grids[0].shape[1], grids[0].shape[0]]) if len(boxes) else np.ones(2)
    step = np.array([box.scale_x, box.scale_y]) * cells / size[::-1]  # cells of the grid a pixel of the picture
    start = np.array([box.left, box.top]) * cells / size[::-1] - 0.5
    for mask, grid, (left, top, right, bottom) in zip(masks, grids, _whole(boxes), strict=True):
        first = start + step * (left + 0.5, top + 0.5)
        last = start + step * (right - 0.5, bottom - 0.5)
        low = np.clip(np.floor(first), 0, cells - 1).astype(int)
        high = np.clip(np.ceil(last), low, cells - 1).astype(int) + 1
        part = _finite(grid[low[1] : high[1], low[0] : high[0]])
        mask[top:bottom, left:right] = _sampled(part, first - low, step, (right - left, bottom - top)) > 0
    return masks


def _finite(grid: Floats) -> Floats:
    """Logits with what is no number taken as background."""
    return np.asarray(np.nan_to_num(grid, nan=-1.0, posinf=1e3, neginf=-1e3), np.float32)


def _sampled(grid: Floats, first: NDArray[np.float64], step: NDArray[np.float64], size: tuple[int, int]) -> Floats:
    """The grid (h, w) read every `step` cells from `first` on, as (size[1], size[0]); beyond its edge the edge."""
    to_grid = np.array([[step[0], 0, first[0]], [0, step[1], first[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(grid, to_grid, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _whole(boxes: Floats) -> list[list[int]]:
    """Boxes inside the picture as whole pixels: right and bottom exclusive, nothing empty."""
    low, high = np.floor(boxes[:, :2]).astype(int), np.ceil(boxes[:, 2:]).astype(int)
    whole: list[list[int]] = np.concatenate([low, np.maximum(high, low + 1)], axis=1).tolist()
    return whole
