"""What has been seen often enough, so that a log that goes on and on in one place keeps no more of it.

A keyframe that shows nothing but surfaces which several others show already makes the map no better. Its pictures are
not kept then, only its pose among those of the others: what is kept grows with what there is to see, not with time.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix
from semslam.slam.surfel.surfels import Surfels

_VOXEL_M = 0.25
_FACES = 6
"""A surface counts by voxel and by the side that it turns to: the other side of a table is something else."""
_OFTEN = 3
"""Keyframes that must show a surface ..."""
_SHARE = 0.8
"""... and share of a keyframe's surfaces that must be shown so often for it to be left out."""


class Coverage:
    """How many keyframes show which surface."""

    def __init__(self) -> None:
        self._shown: Counter[int] = Counter()

    def add(self, surfels: Surfels, map_from_robot: Matrix) -> None:
        """A keyframe that is kept."""
        self._shown.update(_surfaces(surfels, map_from_robot).tolist())

    def holds(self, surfels: Surfels, map_from_robot: Matrix) -> bool:
        """Whether a keyframe would show hardly anything that is not shown often enough."""
        surfaces = _surfaces(surfels, map_from_robot).tolist()
        often = sum(self._shown[one] >= _OFTEN for one in surfaces)
        return often >= _SHARE * len(surfaces) > 0


def _surfaces(surfels: Surfels, map_from_robot: Matrix) -> NDArray[np.int64]:
    """Numbers of the surfaces on which surfels lie."""
    moved = surfels.moved(map_from_robot)
    axis = np.abs(moved.normals).argmax(1)
    face = 2 * axis + (np.take_along_axis(moved.normals, axis[:, None], 1)[:, 0] > 0)
    return np.unique(voxel_numbers(moved.points, _VOXEL_M) * _FACES + face)


def voxel_numbers(points: NDArray[np.float64], side_m: float) -> NDArray[np.int64]:
    """(N,) numbers of the voxels in which points (N, 3) lie, up to half a million voxels from the origin."""
    cells = np.floor(points / side_m).astype(np.int64) + (1 << 19)
    return np.asarray((cells[:, 0] << 40) | (cells[:, 1] << 20) | cells[:, 2])
