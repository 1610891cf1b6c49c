"""Which objects a camera near the floor would see: heights on a raster, and rays that climb over them.

A coarse forecast for choosing where to drive, not a picture: every object is a solid of its footprint up to its
height. Along a ray the steepest line of sight so far hides what lies below it, so a low table does not hide the shelf
behind it. Chairs and tables are no solids, so the forecast misses objects (a quarter of those in the pictures), but
hardly ever promises one that is not there (1 %).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.sim.home import Array, Fixture, Home
from semslam.sim.space import stops_robot

CELL_M = 0.1
"""Raster of heights; rays advance by this much too, so that none slips through a wall."""
REACH_M = 7.0
NEAREST_M = 0.45
"""What is nearer fills a corner of the picture at best."""
BEARINGS = 120
"""Directions around a place, 3 degrees apart; bearing b looks along 2 pi b / BEARINGS."""
SPREAD = 14
"""Bearings to either side of the heading that are in the picture: 42 of the 45 degrees, to be on the safe side."""
FOCAL_PX = 320.0
HALF_HEIGHT_PX = 240.0
VISIBLE_PX = 150.0
"""Pixels from which an object counts as visible; more than the 100 of the statistics, for the forecast is coarse."""

_AT_ONCE = 100
"""Places whose rays are cast together, which bounds the memory."""


@dataclass(frozen=True, eq=False)
class Relief:
    """The home from above: how high things reach, and which object it is."""

    height_m: NDArray[np.float32]
    """(rows along y, columns along x) top of what stands there; 0 on the floor."""
    instance: NDArray[np.int64]
    """Same shape: index into home.objects plus one; 0 where there is none."""
    origin: Array
    """(2,) world place of the corner of cell (0, 0)."""
    objects: int


def relief_of(home: Home) -> Relief:
    """Objects, walls and all that stands on the floor; outside the home everything is as high as the ceiling."""
    x0, y0, x1, y1 = home.bounds
    origin = np.array([x0 - CELL_M, y0 - CELL_M])
    shape = math.ceil((y1 - y0) / CELL_M) + 2, math.ceil((x1 - x0) / CELL_M) + 2
    height, instance = np.full(shape, home.height_m, np.float32), np.zeros(shape, np.int64)
    for polygon in home.outline:
        height[_inside(polygon, origin, shape)] = 0.0
    solids = [(fixture_top(home, item), 0, item.footprint) for item in home.fixtures if stops_robot(item)]
    solids += [(item.z_m + item.piece.height_m, k + 1, item.footprint) for k, item in enumerate(home.objects)]
    for top, number, footprint in sorted(solids, key=lambda solid: solid[:2]):
        cells = _inside(np.asarray(footprint), origin, shape)
        height[cells], instance[cells] = top, number
    return Relief(height, instance, origin, len(home.objects))


def fixture_top(home: Home, item: Fixture) -> float:
    """Height of a fixture; that of the room where it has no parts to measure."""
    tops = [float(part.mesh.vertices[:, 2].max()) for part in item.parts if len(part.mesh.vertices)]
    return max(tops, default=home.height_m)


def _inside(polygon: Array, origin: Array, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Cells that a polygon touches."""
    mask = np.zeros(shape, np.uint8)
    fine = np.round((polygon - origin) / CELL_M * 16 - 8).astype(np.int32)  # cv2 means centres, in 1/16 of a cell
    cv2.fillPoly(mask, [fine], 1, shift=4)
    return mask.astype(bool)


def forecast(relief: Relief, places: Array, camera_height_m: float, camera_pitch_rad: float) -> NDArray[np.bool_]:
    """Which objects a camera at each of the places (P, 2) would show for each heading.

    Returns:
        (P, BEARINGS, objects); the second axis is the heading.
    """
    parts = [
        _seen(_pixels(relief, places[first : first + _AT_ONCE], camera_height_m, camera_pitch_rad))
        for first in range(0, len(places), _AT_ONCE)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, BEARINGS, relief.objects), bool)


def _seen(pixels: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(P, BEARINGS, objects) pixels a ray -> whether the picture around each bearing shows enough of them."""
    around = np.concatenate([pixels[:, -SPREAD:], pixels, pixels[:, :SPREAD]], axis=1)
    total = np.cumsum(np.pad(around, ((0, 0), (1, 0), (0, 0))), axis=1)
    return np.asarray(total[:, 2 * SPREAD + 1 :] - total[:, : -2 * SPREAD - 1] > VISIBLE_PX)


def _pixels(relief: Relief, places: Array, camera_height_m: float, camera_pitch_rad: float) -> NDArray[np.float32]:
    """(P, BEARINGS, objects) pixels of each object on the rays from each place."""
    ranges = np.arange(CELL_M, REACH_M, CELL_M, dtype=np.float32)
    height, number = _along_rays(relief, places, ranges)  # (P, BEARINGS, ranges)
    half = math.atan(HALF_HEIGHT_PX / FOCAL_PX)
    lowest, highest = (math.tan(sign * half - camera_pitch_rad) for sign in (-1, 1))
    slope = np.clip((height - np.float32(camera_height_m)) / ranges, lowest, highest)
    before = np.full_like(slope, lowest)
    np.maximum.accumulate(slope[..., :-1], axis=-1, out=before[..., 1:])
    number[..., ranges < NEAREST_M] = 0
    width_px = FOCAL_PX * 2 * math.pi / BEARINGS
    gained = np.maximum(slope - before, 0.0) * (FOCAL_PX * width_px)
    ray = np.arange(len(places) * BEARINGS).reshape(len(places), BEARINGS, 1) * (relief.objects + 1)
    total = np.bincount((ray + number).ravel(), gained.ravel(), len(places) * BEARINGS * (relief.objects + 1))
    return total.reshape(len(places), BEARINGS, -1)[..., 1:].astype(np.float32)


def _along_rays(
    relief: Relief, places: Array, ranges: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Height and object number on the rays, each (P, BEARINGS, ranges)."""
    angle = 2 * math.pi * np.arange(BEARINGS) / BEARINGS
    start = (places - relief.origin) / CELL_M
    rows, columns = relief.height_m.shape
    away = ranges / CELL_M
    column = (start[:, 0, None, None] + np.cos(angle)[:, None] * away).astype(np.int32)
    row = (start[:, 1, None, None] + np.sin(angle)[:, None] * away).astype(np.int32)
    cell = np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1)
    return relief.height_m.ravel()[cell], relief.instance.ravel()[cell]
