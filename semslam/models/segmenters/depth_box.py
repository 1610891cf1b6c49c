"""Masks without a network: GrabCut inside the box, seeded by the depth at which the object stands.

Seeds: pixels close to the box's main depth are probably object, those in the middle of it surely; pixels outside the
box and far behind it are background. Colour then decides along the outline (Rother, Kolmogorov, Blake 2004). Works on a
crop of at most 112 pixels a side, so that its cost does not depend on the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.models.segmenters.depth_mode import depth_mode, inner

_MARGIN = 0.12
"""Of the box's size: how much of its surroundings teaches the background."""
_BACK = 1.0
"""Metres behind the main depth where everything is background."""


@dataclass(frozen=True)
class DepthBoxSegmenter:
    """Box-prompted segmentation from colour and depth; deterministic."""

    reach_m: float = 0.45
    """Pixels within this distance of the main depth may be object."""
    core_m: float = 0.12
    """Pixels this close to it, in the middle of the box, surely are."""
    side: int = 112
    """Longest side of the crop that GrabCut works on, pixels."""
    rounds: int = 1

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], boxes: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Masks (N, H, W)."""
        height, width = rgb.shape[:2]
        masks = np.zeros((len(boxes), height, width), bool)
        for mask, (left, top, right, bottom) in zip(masks, inner(boxes, width, height).tolist(), strict=True):
            across, down = round(_MARGIN * (right - left)) + 2, round(_MARGIN * (bottom - top)) + 2
            rows = slice(max(0, top - down), min(height, bottom + down))
            columns = slice(max(0, left - across), min(width, right + across))
            inside = np.zeros((rows.stop - rows.start, columns.stop - columns.start), bool)
            inside[top - rows.start : bottom - rows.start, left - columns.start : right - columns.start] = True
            mask[rows, columns] = self._segment(rgb[rows, columns], depth_m[rows, columns], inside)
        return masks

    def _segment(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], inside: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Object pixels of a crop (h, w); `inside` is its box."""
        rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
        box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        mode = depth_mode(depth_m[box])
        if mode is None:
            return inside
        by_depth = inside & (np.abs(depth_m - mode) <= self.reach_m) & (depth_m > 0)
        seeds = self._seeds(depth_m, inside, by_depth, mode)
        found = self._grab_cut(rgb, seeds) & inside
        return found if self._plausible(found, by_depth) else by_depth

    def _seeds(
        self, depth_m: NDArray[np.float32], inside: NDArray[np.bool_], by_depth: NDArray[np.bool_], mode: float
    ) -> NDArray[np.uint8]:
        """GrabCut's four words for each pixel of the crop."""
        seeds = np.full(depth_m.shape, cv2.GC_BGD, np.uint8)
        seeds[inside] = cv2.GC_PR_BGD
        seeds[by_depth] = cv2.GC_PR_FGD
        seeds[inside & (depth_m > mode + _BACK)] = cv2.GC_BGD
        core = by_depth & (np.abs(depth_m - mode) <= self.core_m)
        height, width = depth_m.shape
        middle = np.zeros_like(core)
        middle[height // 4 : height - height // 4, width // 4 : width - width // 4] = True
        seeds[core & middle] = cv2.GC_FGD
        return seeds

    def _grab_cut(self, rgb: NDArray[np.uint8], seeds: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """GrabCut on a reduced crop, enlarged again."""
        height, width = seeds.shape
        scale = min(1.0, self.side / max(height, width))
        size = (max(8, round(width * scale)), max(8, round(height * scale)))
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        labels = cv2.resize(seeds, size, interpolation=cv2.INTER_NEAREST)
        is_object = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
        if not is_object.any() or is_object.all():
            return np.zeros(seeds.shape, bool)
        cv2.setRNGSeed(0)  # its colour clusters start at random
        background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(small, labels, (0, 0, 0, 0), background, foreground, self.rounds, cv2.GC_INIT_WITH_MASK)
        cut = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
        return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_NEAREST) > 0)

    def _plausible(self, found: NDArray[np.bool_], by_depth: NDArray[np.bool_]) -> bool:
        """GrabCut may collapse or spill; its mask must share most with what depth says."""
        common = np.count_nonzero(found & by_depth)
        return bool(common >= 0.3 * np.count_nonzero(by_depth) and common >= 0.6 * np.count_nonzero(found))
