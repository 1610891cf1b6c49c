"""The plainest segmenter: everything in the box that stands about as far away as most of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.segmenters.depth_mode import depth_mode, inner


@dataclass(frozen=True)
class BoxSegmenter:
    """Pixels of the box within `reach_m` of its main depth; the whole box without depth."""

    reach_m: float = 0.5

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], boxes: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Masks (N, H, W)."""
        height, width = rgb.shape[:2]
        masks = np.zeros((len(boxes), height, width), bool)
        for mask, (left, top, right, bottom) in zip(masks, inner(boxes, width, height).tolist(), strict=True):
            depth = depth_m[top:bottom, left:right]
            mode = depth_mode(depth)
            mask[top:bottom, left:right] = (
                True if mode is None else (np.abs(depth - mode) <= self.reach_m) & (depth > 0)
            )
        return masks
