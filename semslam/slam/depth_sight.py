"""What one depth image says of the columns above the cells of a map: where it hit something, and where it saw through.

Columns are cut into slices of `SLICE_M` from the least to the greatest height of obstacles. A slice is *hit* if a pixel
with depth lies in it. It is *passed* if the image sees through it to something farther: its lower and its upper end,
above the middle of the cell, must both lie nearer than anything around the pixel that shows them. Both ends, because a
ray that skims over a bed leaves through the side of the same slice in which the bed's top lies. What lies behind a
surface, beyond the picture or behind missing depth is neither; where a slice is hit, rays beside it count for nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2, Matrix, invert
from semslam.geometry.projection import FLYING_M, FLYING_SHARE, points_in_robot

SLICE_M = 0.1
BIN_M = 0.02
"""Heights are counted in bins of this size."""
BINS = round(SLICE_M / BIN_M)
"""In a slice."""
LOWEST_M = -0.3
"""Points lower than about this are below any floor: noise, or stairs that lead down."""
NEAR_M = 0.3
"""Nearer points may be the robot itself."""
COLUMNS = 160
"""Pictures are thinned to about so many columns."""
WIDEST = 4.0
"""Nor is looked farther to the side than so many times ahead (76 degrees), whatever the camera claims to see."""
MARGIN = 0.005
"""A surface counts as farther than a place if it is by a cell and this, per metre, times the square of the distance:
three standard deviations of a depth camera's noise."""

_Mask = NDArray[np.bool_]
_Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Columns:
    """How a map is cut into cells, and the columns above them into slices."""

    cell_m: float
    low_m: float
    """Least height of obstacles; what is lower is floor."""
    high_m: float
    """Points higher than this are no obstacle."""
    reach_m: float
    """Farther depth is ignored, along the optical axis."""

    def __post_init__(self) -> None:
        """Raises SemslamError if no height is left for obstacles."""
        if not self.low_m < self.high_m:
            raise SemslamError(
                f"`export.min_obstacle_height_m` is {self.low_m:g} and `export.max_obstacle_height_m` is "
                f"{self.high_m:g}, which leaves nothing between them for obstacles",
                hint="set `export.min_obstacle_height_m` to 0.1 and `export.max_obstacle_height_m` to 1.5",
            )

    @cached_property
    def slices(self) -> int:
        """Of the band of obstacles."""
        return max(1, math.ceil((self.high_m - self.low_m) / SLICE_M - 1e-6))

    @cached_property
    def below(self) -> int:
        """Slices under the band, where the floor is looked for."""
        return max(1, math.ceil((self.low_m - LOWEST_M) / SLICE_M - 1e-6))

    @property
    def bins(self) -> int:
        """Of heights, below the band and in it."""
        return (self.below + self.slices) * BINS

    @property
    def base_m(self) -> float:
        """Lower end of the first bin."""
        return self.low_m - self.below * SLICE_M

    @property
    def ends_m(self) -> list[float]:
        """(slices + 1,) heights between the slices, lowest first."""
        return [min(self.low_m + number * SLICE_M, self.high_m) for number in range(self.slices + 1)]


@dataclass(frozen=True)
class DepthImage:
    """A keyframe's depth (H, W), metres along the optical axis, with its pinhole camera; 0 or NaN where missing."""

    depth_m: _Floats
    fx: float
    fy: float
    cx: float
    cy: float
    robot_from_camera: Matrix

    @property
    def stride(self) -> int:
        """Every so many pixels, along both axes, one is looked at."""
        return max(1, round(int(self.depth_m.shape[1]) / COLUMNS))


@dataclass(frozen=True)
class Sight:
    """What a depth image says of a window of the map."""

    left: int
    low: int
    """The first column and row of cells."""
    hit: _Mask
    """(slices, rows, columns)"""
    passed: _Mask
    """(slices, rows, columns); nowhere where `hit`."""
    seen: _Mask
    """(rows, columns): hit, passed, or the floor was seen there."""
    marks: NDArray[np.int64]
    """(3, n) bin of height, row and column wherever a pixel fell, each once."""
    pixels: NDArray[np.int64]
    """(n,) how many fell there."""


def look(image: DepthImage, map_from_robot: SE2, columns: Columns) -> Sight | None:
    """What an image taken at a pose says; None if nothing in it is near enough."""
    nearest = nearest_depth(image.depth_m, image.stride)
    known = nearest[nearest > 0]
    if not known.size:
        return None
    reach_m = min(columns.reach_m, float(known.max()))
    window = _window(image, map_from_robot, columns.cell_m, reach_m)
    marks, pixels = _marks(_points(image, columns.reach_m), map_from_robot, columns, window)
    hit, floor = _hits(marks, window, columns)
    screen = _Screen.of(image, nearest, columns.cell_m, reach_m)
    passed = _passed(screen, map_from_robot, columns, window)
    passed[0] |= floor
    passed &= ~hit
    return Sight(window.left, window.low, hit, passed, hit.any(0) | passed.any(0) | floor, marks, pixels)


def nearest_depth(depth_m: _Floats, stride: int) -> _Floats:
    """The nearest depth in each block of pixels (H // stride, W // stride); 0 where half of the block has none."""
    rows, columns = (length // stride for length in depth_m.shape)
    known = (depth_m > 0) & (depth_m < np.inf)  # false for NaN
    filled = np.where(known, depth_m, np.float32(np.inf))[: rows * stride, : columns * stride]
    nearest = np.full((rows, columns), np.inf, np.float32)
    pixels = np.zeros((rows, columns), np.int32)
    for row in range(stride):
        for column in range(stride):
            part = filled[row::stride, column::stride]
            np.minimum(nearest, part, out=nearest)
            pixels += part < np.inf
    return np.where(2 * pixels > stride * stride, nearest, np.float32(0.0))


def _points(image: DepthImage, reach_m: float) -> _Floats:
    """(n, 3) points of the thinned image in the robot frame, without pixels that hang between two surfaces."""
    stride = image.stride
    first = stride // 2
    rows, columns = (np.arange(first, length, stride) for length in image.depth_m.shape)
    depth = image.depth_m[np.ix_(rows, columns)]
    usable = (depth >= NEAR_M) & (depth <= reach_m) & _steady(image.depth_m, rows, columns)
    cx, cy = (image.cx - first) / stride, (image.cy - first) / stride
    points = points_in_robot(depth, image.fx / stride, image.fy / stride, cx, cy, image.robot_from_camera)
    return points[usable]


def _steady(depth_m: _Floats, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> _Mask:
    """Of the pixels in those rows and columns, those near to a neighbour in their row and to one in their column."""
    depth = depth_m[np.ix_(rows, columns)]
    reach = np.float32(FLYING_M) + np.float32(FLYING_SHARE) * depth
    last_row, last_column = (length - 1 for length in depth_m.shape)
    beside = [depth_m[np.ix_(rows, np.clip(columns + step, 0, last_column))] for step in (-1, 1)]
    above = [depth_m[np.ix_(np.clip(rows + step, 0, last_row), columns)] for step in (-1, 1)]
    with np.errstate(invalid="ignore"):  # depth that is NaN or infinite is near to nothing
        across, down = (
            (np.abs(pair[0] - depth) <= reach) | (np.abs(pair[1] - depth) <= reach) for pair in (beside, above)
        )
    return np.asarray(across & down)


@dataclass(frozen=True)
class _Window:
    """A rectangle of cells of the map."""

    left: int
    low: int
    columns: int
    rows: int


def _window(image: DepthImage, map_from_robot: SE2, cell_m: float, reach_m: float) -> _Window:
    """The cells over which the image may see so far."""
    height, width = image.depth_m.shape
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    slopes = np.clip((corners - (image.cx, image.cy)) / (image.fx, image.fy), -WIDEST, WIDEST)
    rays = np.column_stack([slopes, np.ones(4)]) * reach_m
    in_camera = np.concatenate([rays, np.zeros((1, 3))])
    in_robot = in_camera @ image.robot_from_camera[:3, :3].T + image.robot_from_camera[:3, 3]
    cells = np.floor(map_from_robot.apply(in_robot[:, :2]) / cell_m).astype(np.int64)
    (left, low), (right, high) = cells.min(0).tolist(), cells.max(0).tolist()
    return _Window(left, low, right - left + 1, high - low + 1)


def _marks(
    points: _Floats, map_from_robot: SE2, columns: Columns, window: _Window
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bins of height, rows and columns (3, n) in which points (N, 3) lie, each once, and how many lie there (n,)."""
    place = np.floor(map_from_robot.apply(points[:, :2]) / columns.cell_m).astype(np.int64) - (window.left, window.low)
    height = points[:, 2].astype(np.float64)
    level = np.floor((height - columns.base_m) / BIN_M).astype(np.int64)
    inside = (level >= 0) & (level < columns.bins) & (height < columns.high_m)
    inside &= ((place >= 0) & (place < (window.columns, window.rows))).all(1)
    shape = columns.bins, window.rows, window.columns
    flat, pixels = np.unique(
        np.ravel_multi_index((level[inside], place[inside, 1], place[inside, 0]), shape), return_counts=True
    )
    return np.stack(np.unravel_index(flat, shape)), pixels


def _hits(marks: NDArray[np.int64], window: _Window, columns: Columns) -> tuple[_Mask, _Mask]:
    """(slices, rows, columns) in which points lie, and (rows, columns) in which points of the floor do."""
    number, row, column = marks[0] // BINS - columns.below, marks[1], marks[2]
    hit = np.zeros((columns.slices, window.rows, window.columns), np.bool_)
    floor = np.zeros((window.rows, window.columns), np.bool_)
    hit[number[number >= 0], row[number >= 0], column[number >= 0]] = True
    floor[row[number < 0], column[number < 0]] = True
    return hit, floor


def _passed(screen: _Screen, map_from_robot: SE2, columns: Columns, window: _Window) -> _Mask:
    """(slices, rows, columns) that are seen through."""
    x = (np.arange(window.left, window.left + window.columns) + 0.5) * columns.cell_m - map_from_robot.x_m
    y = (np.arange(window.low, window.low + window.rows) + 0.5) * columns.cell_m - map_from_robot.y_m
    there = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    feet = screen.at(SE2(0.0, 0.0, -map_from_robot.heading_rad).apply(there).astype(np.float32))
    ends = columns.ends_m
    shown = np.flatnonzero(screen.may_show(feet, ends[0], ends[-1]))
    within = np.ascontiguousarray(feet[:, shown])
    clear = np.stack([screen.clear(within, height) for height in ends])  # (slices + 1, n)
    passed = np.zeros((columns.slices, window.rows * window.columns), np.bool_)
    passed[:, shown] = clear[:-1] & clear[1:]
    return passed.reshape(columns.slices, window.rows, window.columns)


@dataclass(frozen=True)
class _Screen:
    """A thinned depth image that places are looked up in."""

    nearest: _Floats
    camera_from_robot: _Floats
    """(3, 4)"""
    fx: float
    fy: float
    cx: float
    cy: float
    """In blocks of pixels, counted from the edge of the first."""
    cell_m: float
    reach_m: float

    @staticmethod
    def of(image: DepthImage, nearest: _Floats, cell_m: float, reach_m: float) -> _Screen:
        values = (image.fx, image.fy, image.cx + 0.5, image.cy + 0.5)
        fx, fy, cx, cy = (value / image.stride for value in values)
        inverse = invert(image.robot_from_camera)[:3].astype(np.float32)
        return _Screen(nearest, inverse, fx, fy, cx, cy, cell_m, reach_m)

    def at(self, feet: _Floats) -> _Floats:
        """Points on the floor (n, 2) of the robot frame in the camera frame, (3, n)."""
        return self.camera_from_robot[:, :2] @ feet.T + self.camera_from_robot[:, 3:]

    def _above(self, feet: _Floats, height_m: float) -> _Floats:
        """What lies so high above points (3, n) on the floor, (3, n)."""
        return feet + self.camera_from_robot[:, 2:3] * np.float32(height_m)

    def may_show(self, feet: _Floats, low_m: float, high_m: float) -> _Mask:
        """Whether the picture may show any of the column between two heights above each of the points (3, n)."""
        (first, _, front), (second, _, above) = (self._above(feet, height) for height in (low_m, high_m))
        ahead = (np.maximum(front, above) > NEAR_M) & (np.minimum(front, above) < self.reach_m)
        edge = np.float32((self.nearest.shape[1] - self.cx) / self.fx), np.float32(-self.cx / self.fx)
        right = (first > edge[0] * front) & (second > edge[0] * above)
        left = (first < edge[1] * front) & (second < edge[1] * above)
        return np.asarray(ahead & ~right & ~left)

    def clear(self, feet: _Floats, height_m: float) -> _Mask:
        """Whether the picture shows something farther in the direction of what lies so high above points (3, n)."""
        side, down, front = self._above(feet, height_m)
        known = (front > NEAR_M) & (front < self.reach_m)
        scale = np.float32(1.0) / np.maximum(front, np.float32(NEAR_M))
        column = np.float32(self.fx) * side * scale + np.float32(self.cx)
        row = np.float32(self.fy) * down * scale + np.float32(self.cy)
        rows, columns = self.nearest.shape
        known &= (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        flat = (row.astype(np.int32) * np.int32(columns) + column.astype(np.int32)) * known
        beyond = front + np.float32(self.cell_m) + np.float32(MARGIN) * front * front
        return np.asarray(known & (self.nearest.ravel()[flat] > beyond))
