"""Grids: how class planes over cells are laid out in memory and in tables.

An array of a grid is (classes, rows, columns) = [class_id, iy, ix]: iy rises with y (left of the robot), ix with x
(ahead of it). Row 0 is the lowest y; pictures flip it. In an observation the camera stands in the middle of the
centre cell, looking along +x.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED

Planes = NDArray[np.float32]
"""(classes, rows, columns), values 0 to 1."""


def to_sparse(planes: Planes) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """Flat indices (rising) and values of the non-zero entries; the inverse of `to_dense`."""
    flat = np.ascontiguousarray(planes).ravel()
    cells = np.flatnonzero(flat)
    return cells.astype(np.uint32), flat[cells].astype(np.float32)


def to_dense(cells: NDArray[np.uint32], weights: NDArray[np.float32], shape: tuple[int, int, int]) -> Planes:
    """Planes of `shape` from flat indices and values.

    Raises:
        IndexError: an index lies outside the shape.
    """
    planes = np.zeros(shape, np.float32)
    planes.reshape(-1)[np.asarray(cells, np.int64)] = np.asarray(weights, np.float32)
    return planes


def pool_observation(planes: Planes, factor: int, side: int) -> Planes:
    """A coarser, smaller observation about the same centre: (L, s, s) -> (L, side, side).

    `factor` fine cells make a coarse one along each axis; it must be odd, as must both sides, so that cells nest.
    Equation 1 counts pixel fractions, so object planes add up (capped at 1). A coarse cell is free floor if any of it
    is and no obstacle stands in it, obstacle if any of it is, unobserved if all of it is. Fine cells beyond the
    observation count as unobserved.

    Raises:
        ValueError: factor or a side is even, or the coarse grid reaches beyond the fine one by a whole cell.
    """
    classes, fine_side, _ = planes.shape
    if factor % 2 == 0 or side % 2 == 0 or fine_side % 2 == 0:
        raise ValueError(f"factor {factor}, side {side} and observation side {fine_side} must be odd")
    wanted = side * factor
    if wanted >= fine_side + 2 * factor:
        raise ValueError(f"{side} cells of {factor} need {wanted} fine cells, the observation has {fine_side}")
    fine = np.zeros((classes, wanted, wanted), np.float32)
    fine[UNOBSERVED] = 1.0
    margin = (wanted - fine_side) // 2
    inner = slice(max(0, margin), wanted - max(0, margin))
    outer = slice(max(0, -margin), fine_side - max(0, -margin))
    fine[:, inner, inner] = planes[:, outer, outer]
    blocks = fine.reshape(classes, side, factor, side, factor)
    coarse = np.minimum(blocks.sum((2, 4), dtype=np.float32), np.float32(1.0))
    coarse[OBSTACLE] = blocks[OBSTACLE].max((1, 3))
    coarse[FREE_FLOOR] = np.where(coarse[OBSTACLE] > 0, 0.0, blocks[FREE_FLOOR].max((1, 3)))
    coarse[UNOBSERVED] = blocks[UNOBSERVED].min((1, 3))
    return np.asarray(coarse, np.float32)


def object_planes(planes: Planes) -> Planes:
    """The planes of object classes only, without the reserved ones (a view)."""
    return planes[FIRST_OBJECT:]
