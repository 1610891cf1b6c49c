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

from dataclasses import dataclass
from typing import Any

import cv2
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
EXTENT_SHARES = (0.02, 0.98)
"""An object's extent leaves out this share of its points at either end of an axis."""


@dataclass(frozen=True)
class Landing:
    """Where the pixels of a frame fall, before anyone says which object they belong to."""

    points: Points
    """(H, W, 3) in the robot frame."""
    usable: NDArray[np.bool_]
    """(H, W), with depth, and not flying."""
    cells: NDArray[np.int32]
    """(H, W) flat cell index; side * side for pixels that are not usable or beyond the grid."""
    floor: NDArray[np.bool_]
    """(H, W), within the tolerance of the floor."""
    raised: NDArray[np.bool_]
    """(H, W), above the floor and low enough to be an obstacle."""
    side: int
    """Cells along a side of the grid."""


def points_in_robot(
    depth_m: NDArray[np.float32], fx: float, fy: float, cx: float, cy: float, robot_from_camera: Matrix
) -> Points:
    """Points (H, W, 3) of a depth image (H, W) of a pinhole camera, in the robot frame; NaN where depth is missing.

    Each axis lies together in memory, since what follows works on one at a time.

    Args:
        depth_m: metres along the optical axis; 0 or less is missing.
        fx: focal length along columns, pixels; `fy` along rows; `cx`, `cy` the principal point.
        robot_from_camera: (4, 4), from the optical frame to the levelled robot frame with the floor at z = 0.
    """
    height, width = depth_m.shape
    depth = np.array(depth_m, np.float32)
    np.copyto(depth, np.float32(np.nan), where=~(depth > 0))
    columns, rows = (np.arange(width) - cx) / fx, ((np.arange(height) - cy) / fy)[:, None]
    planes = np.empty((3, height, width), np.float32)
    for plane, line in zip(planes, np.asarray(robot_from_camera, np.float64)[:3], strict=True):
        across, down = (line[0] * columns).astype(np.float32), (line[1] * rows + line[2]).astype(np.float32)
        np.add(across, down, out=plane)  # (W,) + (H, 1) -> (H, W)
        np.multiply(plane, depth, out=plane)
        np.add(plane, np.float32(line[3]), out=plane)
    return planes.transpose(1, 2, 0)


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
    """Observation (classes, side, side) of one frame: `land`, then `observe_landed`, with their arguments."""
    landing = land(
        points, valid, cell_m=cell_m, side=side, floor_tolerance_m=floor_tolerance_m, max_height_m=max_height_m
    )
    return observe_landed(masks, class_ids, landing, classes, min_pixels)


def land(
    points: Points, valid: NDArray[np.bool_], *, cell_m: float, side: int, floor_tolerance_m: float, max_height_m: float
) -> Landing:
    """The part of an observation that no mask has a say in.

    Args:
        points: (H, W, 3) in the robot frame.
        valid: (H, W), where depth can be used.
        cell_m: side of a cell, metres.
        side: cells along a side, odd.
        floor_tolerance_m: points within this height of z = 0 are floor.
        max_height_m: higher points are no obstacle.
    """
    usable = valid & ~flying(points, valid)
    height = points[..., 2]
    floor = np.abs(height) <= floor_tolerance_m
    raised = (height > floor_tolerance_m) & (height <= max_height_m)
    return Landing(points, usable, _cells(points, usable, cell_m, side), floor, raised, side)


def observe_landed(
    masks: NDArray[np.bool_],
    class_ids: NDArray[np.integer[Any]],
    landing: Landing,
    classes: int,
    min_pixels: int,
) -> Planes:
    """Observation (classes, side, side) of one frame, with the robot in the middle of the centre cell, looking along x.

    Object planes follow equation 1: each instance adds, per cell, its pixels there over |A_i|, read as its pixels with
    usable depth (so that holes in the depth do not fade an object), within and beyond the grid. Instances of one class
    add, capped at 1. No threshold is applied.

    Of the other pixels, at least `min_pixels` raised ones make an obstacle; so many on the floor make free floor, if no
    obstacle and fewer than so many object pixels are in the cell. A cell is unobserved exactly if it is none of free
    floor, obstacle and object.

    Args:
        masks: (N, H, W), one per instance; where they overlap, the pixel counts for each.
        class_ids: (N,) indices into the class list.
        landing: where the frame's pixels fall.
        classes: length of the class list, reserved classes included.
        min_pixels: evidence a cell needs for floor or obstacle.
    """
    side = landing.side
    planes = np.zeros((classes, side * side), np.float32)
    object_pixels = np.zeros(side * side, np.int64)
    background = landing.usable.copy()
    for mask, class_id in zip(masks, class_ids, strict=True):
        near = window(mask)
        inside = mask[near] & landing.usable[near]  # (h, w)
        body = _body(inside, landing.points[near])  # (n,)
        background[near][inside] &= ~body
        hits = _count(landing.cells[near][inside][body], side)
        planes[class_id] += (hits / max(1, int(np.count_nonzero(body)))).astype(np.float32)
        object_pixels += hits
    np.minimum(planes, np.float32(1.0), out=planes)
    floor = _count(landing.cells[background & landing.floor], side)
    raised = _count(landing.cells[background & landing.raised], side)
    obstacle = raised >= min_pixels
    free = (floor >= min_pixels) & ~obstacle & (object_pixels < min_pixels)
    planes[OBSTACLE], planes[FREE_FLOOR] = obstacle, free
    planes[UNOBSERVED] = ~(obstacle | free | (object_pixels > 0))
    return planes.reshape(classes, side, side)


def window(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The smallest rectangle of rows and columns that holds a mask (H, W); empty for an empty one."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def _cells(points: Points, usable: NDArray[np.bool_], cell_m: float, side: int) -> NDArray[np.int32]:
    """Flat cell index of every pixel, (H, W); side * side for pixels that are not usable or beyond the grid."""
    scale, centre = np.float32(1.0 / cell_m), np.float32(side / 2)
    column, row = points[..., 0] * scale + centre, points[..., 1] * scale + centre
    inside = usable & (np.minimum(column, row) >= 0) & (np.maximum(column, row) < side)  # false for NaN
    with np.errstate(invalid="ignore"):  # whatever becomes of pixels beyond the grid, the last line replaces
        cells = row.astype(np.int32) * np.int32(side) + column.astype(np.int32)
    np.copyto(cells, np.int32(side * side), where=~inside)
    return cells


def _count(cells: NDArray[np.int32], side: int) -> NDArray[np.int64]:
    """Pixels per cell, (side * side,), without those beyond the grid."""
    return np.bincount(cells, minlength=side * side + 1)[:-1]


def _body(inside: NDArray[np.bool_], points: Points) -> NDArray[np.bool_]:
    """Which pixels of a mask (h, w), in the order of its rows, belong to its main body."""
    return main_body(np.hypot(points[..., 0][inside], points[..., 1][inside]))


def flying(points: Points, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) that hang between two surfaces: far from both neighbours in their row, or in their column.

    Far is measured along the distance from the robot's origin. A missing neighbour counts as far, one beyond the
    picture as near.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    distance = np.sqrt(x * x + y * y + z * z)  # NaN where depth is missing
    reach = np.float32(FLYING_M) + np.float32(FLYING_SHARE) * distance
    near_across = np.abs(np.diff(distance, axis=1)) <= reach[:, 1:]  # of each pixel and the next; false for NaN
    near_down = np.abs(np.diff(distance, axis=0)) <= reach[1:]
    held = np.ones(valid.shape, bool)
    held[:, 1:-1] = near_across[:, :-1] | near_across[:, 1:]
    held[1:-1] &= near_down[:-1] | near_down[1:]
    return valid & ~held


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
    axes = points.reshape(-1, 3).T
    finite = np.isfinite(axes).all(axis=0)
    axes = np.ascontiguousarray(axes if finite.all() else axes[:, finite])  # (3, n)
    if axes.shape[1] == 0:
        return None
    low, high = (_quantile(axes, share) for share in EXTENT_SHARES)
    return low, high


def _quantile(axes: NDArray[np.float32], share: float) -> NDArray[np.float64]:
    """A quantile (a,) of each row of (a, n): what `numpy.quantile` gives in float64, to the bit, but fast.

    It was the dearest step of a frame.
    """
    place = (axes.shape[1] - 1) * share
    below = int(place)
    ordered = np.partition(axes, below, axis=1)
    low = ordered[:, below].astype(np.float64)
    high = ordered[:, below + 1 :].min(axis=1).astype(np.float64) if place > below else low
    part, step = place - below, high - low
    return np.asarray(low + step * part if part < 0.5 else high - step * (1 - part))
