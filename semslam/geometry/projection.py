"""From masks and depth to an egocentric observation map: equation 1, with free floor, obstacles and what nobody saw.

Pixels fall on the ground straight down, in the levelled robot frame, so a pitched camera gives the same map as a level
one. Only what a pixel hit is marked: a cell behind an object received no pixel and stays unobserved.

Two kinds of pixels would smear objects over the floor, and are left out of them:

* A *flying* pixel is a mixture of the near and far side of an edge and hangs in the air between them. It is recognised
  by being far from both its neighbours in a row, or in a column, and counts for nothing at all.
* A pixel of the *background* that an imprecise mask covers lies beyond a gap in range. Of the stretches between gaps a
  mask keeps the one with most pixels; what it loses counts as floor or obstacle like any other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix
from semslam.geometry.grid import Planes
from semslam.labels import FREE_FLOOR, OBSTACLE, UNOBSERVED

Points = NDArray[np.float32]
"""(H, W, 3) or (N, 3) in the robot frame, metres."""

FLYING_M = 0.06
FLYING_SHARE = 0.03
"""A neighbour further away than FLYING_M + FLYING_SHARE * distance lies across an edge; a floor seen flat does not."""
RANGE_BIN_M = 0.1
RANGE_GAP_BINS = 3
"""A step of more bins than this from one filled bin to the next is a gap."""
RANGE_EMPTY_SHARE = 0.02
"""A bin with a smaller share of the fullest bin's pixels is empty."""


def points_in_robot(
    depth_m: NDArray[np.float32], fx: float, fy: float, cx: float, cy: float, robot_from_camera: Matrix
) -> Points:
    """Points (H, W, 3) of a depth image (H, W) of a pinhole camera, in the robot frame; NaN where depth is missing.

    Args:
        depth_m: metres along the optical axis; 0 or less is missing.
        fx: focal length along columns, pixels; `fy` along rows; `cx`, `cy` the principal point.
        robot_from_camera: (4, 4), from the optical frame to the levelled robot frame with the floor at z = 0.
    """
    height, width = depth_m.shape
    depth = np.where(depth_m > 0, depth_m, np.float32(np.nan)).astype(np.float32, copy=False)
    columns, rows = (np.arange(width) - cx) / fx, ((np.arange(height) - cy) / fy)[:, None]
    points = np.empty((height, width, 3), np.float32)
    for axis, line in enumerate(np.asarray(robot_from_camera, np.float64)[:3]):
        slope = (line[0] * columns).astype(np.float32) + (line[1] * rows + line[2]).astype(np.float32)  # (H, W)
        np.multiply(slope, depth, out=slope)
        np.add(slope, np.float32(line[3]), out=points[..., axis])
    return points


def observe(
    masks: NDArray[np.bool_],
    class_ids: NDArray[np.integer[Any]],
    points: Points,
    valid: NDArray[np.bool_],
    classes: int,
    *,
    cell_m: float,
    side: int,
    floor_tolerance_m: float,
    max_height_m: float,
    min_pixels: int,
) -> Planes:
    """Observation (classes, side, side) of one frame, with the robot in the middle of the centre cell, looking along x.

    Object planes follow equation 1: each instance adds, per cell, its pixels there over |A_i|, read as its pixels with
    usable depth (so that holes in the depth do not fade an object), within and beyond the grid. Instances of one class
    add, capped at 1. No threshold is applied.

    Of the other pixels, at least `min_pixels` above `floor_tolerance_m` and up to `max_height_m` make an obstacle; so
    many on the floor make free floor, if no obstacle and fewer than so many object pixels are in the cell. A cell is
    unobserved exactly if it is none of free floor, obstacle and object.

    Args:
        masks: (N, H, W), one per instance; where they overlap, the pixel counts for each.
        class_ids: (N,) indices into the class list.
        points: (H, W, 3) in the robot frame.
        valid: (H, W), where depth can be used.
        classes: length of the class list, reserved classes included.
        cell_m: side of a cell, metres.
        side: cells along a side, odd.
        floor_tolerance_m: points within this height of z = 0 are floor.
        max_height_m: higher points are no obstacle.
        min_pixels: evidence a cell needs for floor or obstacle.
    """
    usable = valid & ~flying(points, valid)
    cells = _cells(points, usable, cell_m, side)
    planes = np.zeros((classes, side * side), np.float32)
    object_pixels = np.zeros(side * side, np.int64)
    background = usable.copy()
    for mask, class_id in zip(masks, class_ids, strict=True):
        body = _body_pixels(mask & usable, points)
        background.ravel()[body] = False
        hits = _count(cells.ravel()[body], side)
        planes[class_id] += (hits / max(1, len(body))).astype(np.float32)
        object_pixels += hits
    np.minimum(planes, np.float32(1.0), out=planes)
    height = points[..., 2]
    floor = _count(cells[background & (np.abs(height) <= floor_tolerance_m)], side)
    raised = _count(cells[background & (height > floor_tolerance_m) & (height <= max_height_m)], side)
    obstacle = raised >= min_pixels
    free = (floor >= min_pixels) & ~obstacle & (object_pixels < min_pixels)
    planes[OBSTACLE], planes[FREE_FLOOR] = obstacle, free
    planes[UNOBSERVED] = ~(obstacle | free | (object_pixels > 0))
    return planes.reshape(classes, side, side)


def _cells(points: Points, usable: NDArray[np.bool_], cell_m: float, side: int) -> NDArray[np.int32]:
    """Flat cell index of every pixel, (H, W); side * side for pixels that are not usable or beyond the grid."""
    scale, centre = np.float32(1.0 / cell_m), np.float32(side / 2)
    column, row = points[..., 0] * scale + centre, points[..., 1] * scale + centre
    inside = usable & (column >= 0) & (column < side) & (row >= 0) & (row < side)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    cells = row.astype(np.int32) * np.int32(side) + column.astype(np.int32)
    return np.where(inside, cells, np.int32(side * side))


def _count(cells: NDArray[np.int32], side: int) -> NDArray[np.int64]:
    """Pixels per cell, (side * side,), without those beyond the grid."""
    return np.bincount(cells, minlength=side * side + 1)[:-1]


def _body_pixels(mask: NDArray[np.bool_], points: Points) -> NDArray[np.int64]:
    """Flat indices of the pixels of a mask (H, W) that belong to its main body."""
    pixels = np.flatnonzero(mask)
    ground = points.reshape(-1, 3)[pixels, :2]
    return pixels[main_body(np.hypot(ground[:, 0], ground[:, 1]))]


def flying(points: Points, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) that hang between two surfaces: far from both neighbours in their row, or in their column.

    Far is measured along the distance from the robot's origin. A missing neighbour counts as far, one beyond the
    picture as near.
    """
    distance = np.sqrt(np.einsum("hwc,hwc->hw", points, points))  # NaN where depth is missing
    reach = np.float32(FLYING_M) + np.float32(FLYING_SHARE) * distance
    far_across = ~(np.abs(np.diff(distance, axis=1)) <= reach[:, 1:])
    far_down = ~(np.abs(np.diff(distance, axis=0)) <= reach[1:])
    alone = np.zeros(valid.shape, bool)
    alone[:, 1:-1] = far_across[:, :-1] & far_across[:, 1:]
    alone[1:-1] |= far_down[:-1] & far_down[1:]
    return alone & valid


def main_body(ranges_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which pixels (n,) of a mask belong to the stretch of ranges that holds most of them; stretches end at gaps.

    The range of a pixel is the distance from the robot's origin along the ground.
    """
    if ranges_m.size == 0:
        return np.zeros(0, bool)
    bins = (ranges_m / np.float32(RANGE_BIN_M)).astype(np.int64)
    counts = np.bincount(bins)
    filled = np.flatnonzero(counts >= max(1.0, RANGE_EMPTY_SHARE * float(counts.max())))
    starts = np.concatenate([[0], np.flatnonzero(np.diff(filled) > RANGE_GAP_BINS) + 1])
    most = int(np.argmax(np.add.reduceat(counts[filled], starts)))
    low = filled[starts[most]]
    high = filled[starts[most + 1] - 1] if most + 1 < len(starts) else filled[-1]
    return np.asarray((bins >= low) & (bins <= high))


def extent(points: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """2nd and 98th percentile of points (N, 3) along each axis, (3,) each; None without a finite point."""
    finite = points[np.isfinite(points).all(axis=-1)].reshape(-1, 3)
    if len(finite) == 0:
        return None
    low, high = np.percentile(finite.astype(np.float64), (2.0, 98.0), axis=0)
    return low, high
