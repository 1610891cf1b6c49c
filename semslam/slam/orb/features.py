"""Keypoints of a picture: ORB corners spread over a grid, each with its descriptor and, where measured, its depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.slam.estimator import View

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

SCALE = 1.2
"""Ratio of neighbouring pyramid levels."""
LEVELS = 8
BASELINE_M = 0.08
"""A point with depth is seen by a second, imagined camera this far to the right, as in ORB-SLAM2: its error there, a
disparity, weighs depth like pixels, and far depth little."""
DESCRIPTOR_BYTES = 32

_CELL_PX = 32
_FAST_THRESHOLD = 7
"""Least contrast of a corner, grey levels: ORB-SLAM2's second, lower one, for places where the first finds none."""
_EDGE_PX = 19
"""Margin of every level without corners: a descriptor's patch must lie within, however it is turned."""
_CANDIDATES = 4
"""Corners found for each one kept, so that the grid has a choice."""


@dataclass(frozen=True)
class Features:
    """N keypoints of one picture."""

    camera: Camera
    pixels: Floats
    """(N, 2) column and row."""
    octaves: Ints
    """(N,) pyramid level, 0 the finest."""
    descriptors: Bytes
    """(N, 32)"""
    depths_m: Floats
    """(N,) along the optical axis; NaN where missing."""

    def __len__(self) -> int:
        return len(self.pixels)

    def chosen(self, which: Ints) -> Features:
        """Some of the keypoints."""
        return Features(
            self.camera, self.pixels[which], self.octaves[which], self.descriptors[which], self.depths_m[which]
        )

    @property
    def points(self) -> Floats:
        """(N, 3) in the camera frame; NaN without depth."""
        return np.asarray(self.camera.rays(self.pixels) * self.depths_m[:, None])

    @property
    def sigmas_px(self) -> Floats:
        """(N,) how exact a keypoint is: a pixel of its own level."""
        return np.asarray(SCALE**self.octaves)

    @property
    def disparities_px(self) -> Floats:
        """(N,) between the camera and the imagined one; NaN without depth."""
        return disparities(self.camera, self.depths_m)


def disparities(camera: Camera, depths_m: Floats) -> Floats:
    """Pixels by which the imagined second camera sees points of those depths farther left."""
    return np.asarray(camera.fx * BASELINE_M / depths_m)


class Extractor:
    """Finds at most `features` keypoints in a picture."""

    def __init__(self, features: int) -> None:
        self._features = features
        self._orb = cv2.ORB_create(  # type: ignore[attr-defined]
            nfeatures=_CANDIDATES * features,
            scaleFactor=SCALE,
            nlevels=LEVELS,
            edgeThreshold=_EDGE_PX,
            fastThreshold=_FAST_THRESHOLD,
        )

    def __call__(self, view: View) -> Features:
        """The keypoints of a view; none of them on a picture without corners."""
        grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
        corners, descriptors = self._corners(grey)
        octaves = np.array([corner.octave for corner in corners], np.int64)
        pixels = _pixels(corners, octaves, grey.shape[1], grey.shape[0])
        return Features(
            camera=Camera(grey.shape[1], grey.shape[0], view.fx, view.fy, view.cx, view.cy),
            pixels=pixels,
            octaves=octaves,
            descriptors=descriptors,
            depths_m=_depths_at(view.depth_m, pixels),
        )

    def _corners(self, grey: NDArray[Any]) -> tuple[list[Any], Bytes]:
        """OpenCV's keypoints with their descriptors (N, 32); it refuses pictures of a few pixels, which have none."""
        found = self._orb.detect(grey, None) if min(grey.shape) > 2 * _EDGE_PX else ()
        if not found:
            return [], np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
        corners, descriptors = self._orb.compute(grey, _spread(found, self._features))
        return list(corners), np.asarray(descriptors, np.uint8)


def _spread(corners: tuple[Any, ...], number: int) -> list[Any]:
    """The best corner of every grid cell, then the second best of every cell, and so on up to `number`."""
    strengths = np.array([corner.response for corner in corners])
    cells = np.array([corner.pt for corner in corners]) // _CELL_PX
    cell = (cells[:, 1] * 65536 + cells[:, 0]).astype(np.int64)
    by_cell = np.lexsort((-strengths, cell))
    _, starts, counts = np.unique(cell[by_cell], return_index=True, return_counts=True)
    rank = np.empty(len(corners), np.int64)
    rank[by_cell] = np.arange(len(corners)) - np.repeat(starts, counts)
    return [corners[i] for i in np.lexsort((-strengths, rank))[:number]]


def _pixels(corners: list[Any], octaves: Ints, width: int, height: int) -> Floats:
    """(N, 2) in the picture.

    OpenCV multiplies a corner's place in its level by the nominal scale. But levels have whole pixels, so their true
    scale differs, and they share the picture's edges, not the centre of its first pixel: up to 2 px at the coarsest.
    """
    scales = (SCALE**octaves)[:, None]
    in_level = np.array([corner.pt for corner in corners], np.float64).reshape(-1, 2) / scales
    size = np.array([width, height])
    return np.asarray((in_level + 0.5) * (size / np.rint(size / scales)) - 0.5)


def _depths_at(depth_m: NDArray[np.float32], pixels: Floats) -> Floats:
    """Depth of the pixel that each keypoint lies in; NaN where it is missing."""
    rows, columns = (
        np.clip(np.rint(pixels[:, axis]).astype(np.int64), 0, size - 1)
        for axis, size in zip((1, 0), depth_m.shape, strict=True)
    )
    depths = depth_m[rows, columns].astype(np.float64)
    return np.where(depths > 0.0, depths, np.nan)
