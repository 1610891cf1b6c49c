"""What a perfect mapper would know: the class map of a home, what of it has been visible so far, perfect observations.

Writes  true_map, home_objects, truth      data_spec.md, tables 13, 14 and 4
        obstructed, ideal                  table 6: the paper's two better qualities of observations

*Obstructed* observations are made by `observe`, as those of extract are, from true masks and depth without noise; what
hides behind something stays hidden. *Ideal* ones are the true labels of the window around the robot; nothing hides.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import SE2, Matrix, invert, planar
from semslam.geometry.grid import to_sparse
from semslam.geometry.levelling import roll_pitch
from semslam.geometry.projection import observe, points_in_robot
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED, class_list
from semslam.sim.home import Array, Home
from semslam.sim.polygons import area_m2, fill
from semslam.sim.space import stops_robot
from semslam.tables.parquet import write_table
from semslam.tables.spec import HOME_OBJECTS, OBSERVATIONS, TRUE_MAP, TRUTH, Table
from semslam.tables.true_map import NEVER

if TYPE_CHECKING:
    from semslam.sim.eye import Sight
    from semslam.sim.vehicle import Drive, RobotSpec

PAPER_CELL_M, PAPER_SIDE = 0.3, 33
FINE_CELL_M = 0.1
OBJECT_SHARE = 0.25
"""Objects that cover this much of a cell make it theirs."""
OBSTACLE_SHARE = 0.15
"""So do walls and loose things; a wall 10 cm thick astride two cells of 30 cm covers a sixth of each."""
FLOOR_SHARE = 0.5
"""A cell is free floor if this much of it is floor."""

OBSERVATION_CELL_M, OBSERVATION_SIDE = 0.1, 99
DEPTH_M = (0.3, 6.0)
FLOOR_TOLERANCE_M, MAX_HEIGHT_M, MIN_PIXELS = 0.08, 2.0, 3
"""As extract's defaults; a test compares them."""
MIN_MASK_PIXELS = 25
"""Smaller instances are left to the background: no segmenter finds them."""
BEHIND_CELLS = 0.25
"""A pixel of a surface speaks for what lies this far behind it as well, in cells: one sees fronts, and a wall whose
front coincides with the border of cells fills the cells behind it."""

_RASTER_M = 0.01
_SAMPLE_M = 0.02


# ---------------------------------------------------------------------------------------------------- from above


@dataclass(frozen=True, eq=False)
class Ground:
    """The home from above, at every centimetre: outside, floor, obstacle, or the object that stands there.

    Where outlines overlap, the smaller object counts: the chair under the table, the tv on its bench.
    """

    codes: NDArray[np.uint8]
    """(rows along y, columns along x) index into `class_of`."""
    origin: tuple[float, float]
    class_of: NDArray[np.uint8]
    """Class id by code."""

    @staticmethod
    def of(home: Home) -> Ground:
        """Draw a home. Raises ValueError for more than 250 objects."""
        if len(home.objects) > 250:
            raise ValueError(f"{len(home.objects)} objects are more than a raster of bytes can tell apart")
        solids = [fixture for fixture in home.fixtures if stops_robot(fixture)]
        outlines = [(FREE_FLOOR, polygon) for polygon in home.outline]
        outlines += [(OBSTACLE, np.asarray(fixture.footprint)) for fixture in solids]
        numbered = [(FIRST_OBJECT + index, item.footprint) for index, item in enumerate(home.objects)]
        outlines += sorted(numbered, key=lambda entry: -area_m2(entry[1]))
        points = np.concatenate([polygon for _, polygon in outlines])
        low = np.floor(points.min(0)) - 0.1
        columns, rows = (math.ceil(side) for side in (points.max(0) + 0.1 - low) / _RASTER_M)
        codes = np.zeros((rows, columns), np.uint8)
        origin = float(low[0]), float(low[1])
        for code, polygon in outlines:
            fill(codes, polygon, origin, _RASTER_M, code)
        classes = [*range(FIRST_OBJECT), *(FIRST_OBJECT + item.class_id for item in home.objects)]
        return Ground(codes, origin, np.array(classes, np.uint8))

    def codes_at(self, x_m: Array, y_m: Array) -> NDArray[np.uint8]:
        """Codes at places of the world; 0 beyond the raster."""
        column = np.floor((x_m - self.origin[0]) / _RASTER_M).astype(np.int64)
        row = np.floor((y_m - self.origin[1]) / _RASTER_M).astype(np.int64)
        rows, columns = self.codes.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.where(inside, self.codes[np.where(inside, row, 0), np.where(inside, column, 0)], 0).astype(np.uint8)


@dataclass(frozen=True)
class Grid:
    """Cells in some frame, row 0 at the lowest y."""

    cell_m: float
    rows: int
    columns: int
    origin_x_m: float
    origin_y_m: float

    @staticmethod
    def centred(side: int, cell_m: float) -> Grid:
        """A square about the origin, which lies in the middle of the centre cell."""
        return Grid(cell_m, side, side, round(-side * cell_m / 2, 9), round(-side * cell_m / 2, 9))

    @staticmethod
    def covering(points: Array, cell_m: float) -> Grid:
        """Whole cells, counted from the origin, that hold all points (N, 2)."""
        low = np.floor(points.min(0) / cell_m).astype(int)
        high = np.floor(points.max(0) / cell_m).astype(int) + 1
        x, y = (round(float(index * cell_m), 9) for index in low)
        return Grid(cell_m, int(high[1] - low[1]), int(high[0] - low[0]), x, y)

    def flat_index(self, places: NDArray[np.float32]) -> NDArray[np.int64]:
        """Cell of every place (..., 2), row by row; -1 beyond the grid and for NaN."""
        column = np.floor((places[..., 0] - np.float32(self.origin_x_m)) * np.float32(1.0 / self.cell_m))
        row = np.floor((places[..., 1] - np.float32(self.origin_y_m)) * np.float32(1.0 / self.cell_m))
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return np.where(inside, row * self.columns + column, -1).astype(np.int64)


def cell_classes(ground: Ground, world_from_grid: SE2, grid: Grid) -> NDArray[np.uint8]:
    """(rows, columns) class of each cell of a grid laid on the ground.

    The object class that covers most of it, if objects cover `OBJECT_SHARE`; else obstacle from `OBSTACLE_SHARE` on;
    else free floor from `FLOOR_SHARE` on; else unobserved.
    """
    shares = _shares(ground, _samples(ground, world_from_grid, grid), grid)
    objects, floor = shares[FIRST_OBJECT:], shares[FREE_FLOOR] + shares[FIRST_OBJECT:].sum(0)
    classes = np.where(floor >= FLOOR_SHARE, FREE_FLOOR, UNOBSERVED)
    classes[shares[OBSTACLE] >= OBSTACLE_SHARE] = OBSTACLE
    covered = objects.sum(0) >= OBJECT_SHARE
    return np.where(covered, FIRST_OBJECT + objects.argmax(0), classes).astype(np.uint8)


def _samples(ground: Ground, world_from_grid: SE2, grid: Grid) -> NDArray[np.uint8]:
    """Codes at points evenly spread in every cell, (rows * n, columns * n)."""
    step = grid.cell_m / _per_cell(grid)
    x = grid.origin_x_m + step * (np.arange(grid.columns * _per_cell(grid)) + 0.5)
    y = (grid.origin_y_m + step * (np.arange(grid.rows * _per_cell(grid)) + 0.5))[:, None]
    cosine, sine = math.cos(world_from_grid.heading_rad), math.sin(world_from_grid.heading_rad)
    return ground.codes_at(world_from_grid.x_m + cosine * x - sine * y, world_from_grid.y_m + sine * x + cosine * y)


def _shares(ground: Ground, samples: NDArray[np.uint8], grid: Grid) -> NDArray[np.float32]:
    """Share of each class in each cell, (classes, rows, columns); of object classes as many as occur."""
    n = _per_cell(grid)
    found = ground.class_of[samples].reshape(grid.rows, n, grid.columns, n)
    shares = np.zeros((max(FIRST_OBJECT + 1, int(ground.class_of.max()) + 1), grid.rows, grid.columns), np.float32)
    for class_id in np.unique(found):
        shares[class_id] = (found == class_id).mean((1, 3), dtype=np.float32)
    return shares


def _per_cell(grid: Grid) -> int:
    return max(1, round(grid.cell_m / _SAMPLE_M))


# ------------------------------------------------------------------------------------------------------- collecting


@dataclass(frozen=True, eq=False)
class Observed:
    """An observation as table 6 has it."""

    cells: NDArray[np.uint32]
    weights: NDArray[np.float32]
    objects: int


class TruthCollector:
    """Takes in what there was to see at every keyframe; `see` is an observer of `record_log`."""

    def __init__(self, home: Home, drive: Drive, camera: Camera) -> None:
        self.home, self.camera = home, camera
        self.ground = Ground.of(home)
        self.world_from_map = planar(drive.world_from_base(float(drive.keyframes_s[0])))
        corners = self.world_from_map.inverse().apply(_corners(self.ground))
        grids = (Grid.centred(PAPER_SIDE, PAPER_CELL_M), Grid.covering(corners, FINE_CELL_M))
        self.maps = [_SeenMap(grid, cell_classes(self.ground, self.world_from_map, grid)) for grid in grids]
        self.stamps: list[int] = []
        self.poses: list[Matrix] = []
        """world_from_base of every keyframe."""
        self.obstructed: list[Observed] = []
        self._drive = drive

    def see(self, index: int, stamp_nanos: int, sight: Sight, world_from_camera: Matrix) -> None:
        """Take in keyframe `index`; they come in order."""
        world_from_base = self._drive.world_from_base(float(self._drive.keyframes_s[index]))
        self.stamps.append(stamp_nanos)
        self.poses.append(world_from_base)
        depth_m = np.where((sight.depth_m >= DEPTH_M[0]) & (sight.depth_m <= DEPTH_M[1]), sight.depth_m, 0.0)
        depth_m = depth_m.astype(np.float32)
        map_from_camera = invert(_upright(self.world_from_map)) @ world_from_camera
        points = self._points(depth_m, map_from_camera)
        kinds = self._lasting(sight)
        for seen in self.maps:
            seen.see(index, points, kinds, (float(map_from_camera[0, 3]), float(map_from_camera[1, 3])))
        robot_from_camera = invert(_upright(planar(world_from_base))) @ world_from_camera
        self.obstructed.append(
            _obstructed_observation(sight, depth_m, self._points(depth_m, robot_from_camera), self.home)
        )

    def _points(self, depth_m: NDArray[np.float32], frame_from_camera: Matrix) -> NDArray[np.float32]:
        camera = self.camera
        return points_in_robot(depth_m, camera.fx, camera.fy, camera.cx, camera.cy, frame_from_camera)

    def _lasting(self, sight: Sight) -> NDArray[np.uint8]:
        """Class of every pixel (H, W), without who walks about."""
        if self.home.walker is None:
            return sight.classes
        return np.where(sight.instances == self.home.walker.instance, UNOBSERVED, sight.classes).astype(np.uint8)


class _SeenMap:
    """One grid's classes, and when each cell was seen first."""

    def __init__(self, grid: Grid, class_ids: NDArray[np.uint8]) -> None:
        self.grid, self.class_ids = grid, class_ids
        self.first_seen = np.full(class_ids.shape, NEVER, np.int64)

    def see(
        self, frame: int, points: NDArray[np.float32], kinds: NDArray[np.uint8], camera_at: tuple[float, float]
    ) -> None:
        """A cell has been seen once `MIN_PIXELS` pixels of its own class have fallen into it."""
        places = points[..., :2]
        cells = self.grid.flat_index(places)
        hits = self._hits(cells, kinds)
        solid = kinds >= OBSTACLE
        places, cells, kinds = places[solid], cells[solid], kinds[solid]
        away = places - np.asarray(camera_at, np.float32)  # (N, 2)
        ranges = np.maximum(np.hypot(away[:, :1], away[:, 1:]), np.float32(1e-3))
        behind = away / ranges * np.float32(BEHIND_CELLS * self.grid.cell_m)
        deeper = self.grid.flat_index(np.asarray(places + behind, np.float32))
        hits += self._hits(np.where(deeper == cells, -1, deeper), kinds)
        new = (hits >= MIN_PIXELS).reshape(self.first_seen.shape) & (self.first_seen == NEVER)
        self.first_seen[new] = frame

    def _hits(self, cells: NDArray[np.int64], kinds: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Pixels of a cell's own class, per cell."""
        classes = self.class_ids.ravel()
        right = (cells >= 0) & (kinds != UNOBSERVED) & (classes[np.maximum(cells, 0)] == kinds)
        return np.bincount(cells[right], minlength=classes.size)


def _obstructed_observation(
    sight: Sight, depth_m: NDArray[np.float32], points: NDArray[np.float32], home: Home
) -> Observed:
    """What extract would observe with a perfect detector, segmenter and depth camera."""
    pixels = np.bincount(sight.instances.ravel(), minlength=1)
    seen = [item for item in home.objects if item.instance < len(pixels) and pixels[item.instance] >= MIN_MASK_PIXELS]
    masks = np.stack([sight.instances == item.instance for item in seen] or [np.zeros(depth_m.shape, bool)])
    class_ids = np.array([FIRST_OBJECT + item.class_id for item in seen], np.int64)
    planes = observe(
        masks[: len(seen)],
        class_ids,
        points,
        depth_m > 0,
        FIRST_OBJECT + len(home.classes),
        cell_m=OBSERVATION_CELL_M,
        side=OBSERVATION_SIDE,
        floor_tolerance_m=FLOOR_TOLERANCE_M,
        max_height_m=MAX_HEIGHT_M,
        min_pixels=MIN_PIXELS,
    )
    return Observed(*to_sparse(planes), sum(bool((mask & (depth_m > 0)).any()) for mask in masks[: len(seen)]))


def ideal_observation(ground: Ground, world_from_robot: SE2, classes: int) -> Observed:
    """True labels of the window around a robot, weights 1; walls hide nothing."""
    grid = Grid.centred(OBSERVATION_SIDE, OBSERVATION_CELL_M)
    labels = cell_classes(ground, world_from_robot, grid)
    planes = (labels == np.arange(classes, dtype=np.uint8)[:, None, None]).astype(np.float32)
    codes = np.unique(_samples(ground, world_from_robot, grid))
    return Observed(*to_sparse(planes), int((codes >= FIRST_OBJECT).sum()))


# ---------------------------------------------------------------------------------------------------------- writing


def write_truth(folder: Path, home: Home, robot: RobotSpec, drive: Drive, collected: TruthCollector) -> None:
    """Write the tables of one log into a folder, each whole or not at all.

    Raises:
        ValueError: not every keyframe of the drive was collected.
        OSError: the disk is full, or the folder cannot be written.
    """
    if len(collected.stamps) != len(drive.keyframes_s):
        raise ValueError(f"{len(collected.stamps)} of {len(drive.keyframes_s)} keyframes were collected")
    folder.mkdir(parents=True, exist_ok=True)
    classes = class_list(home.classes)
    window = {"classes": classes, "cell_m": OBSERVATION_CELL_M, "side": OBSERVATION_SIDE}
    ideal = [ideal_observation(collected.ground, planar(pose), len(classes)) for pose in collected.poses]
    _write(folder, "true_map", TRUE_MAP, _map_rows(collected), _map_meta(collected, classes))
    _write(folder, "home_objects", HOME_OBJECTS, _object_rows(home), _home_meta(home, robot))
    _write(folder, "truth", TRUTH, _pose_rows(collected))
    _write(folder, "obstructed", OBSERVATIONS, _observation_rows(collected, collected.obstructed), window)
    _write(folder, "ideal", OBSERVATIONS, _observation_rows(collected, ideal), window)


def _write(
    folder: Path, name: str, table: Table, rows: Mapping[str, Sequence[Any]], meta: Mapping[str, Any] | None = None
) -> None:
    temporary = folder / f".{name}.partial-{os.getpid()}"
    try:
        write_table(temporary, table, rows, meta)
        temporary.replace(folder / f"{name}.parquet")
    finally:
        temporary.unlink(missing_ok=True)


def _map_rows(collected: TruthCollector) -> dict[str, list[Any]]:
    """Cells of both grids that are anything, row by row."""
    columns: dict[str, list[Any]] = {column.name: [] for column in TRUE_MAP.columns}
    for seen in collected.maps:
        grid = seen.grid
        row, column = np.nonzero(seen.class_ids)
        first = seen.first_seen[row, column].tolist()
        columns["cell_m"] += [grid.cell_m] * len(row)
        columns["row"] += row.tolist()
        columns["column"] += column.tolist()
        columns["x_m"] += np.round(grid.origin_x_m + (column + 0.5) * grid.cell_m, 9).tolist()
        columns["y_m"] += np.round(grid.origin_y_m + (row + 0.5) * grid.cell_m, 9).tolist()
        columns["class_id"] += seen.class_ids[row, column].tolist()
        columns["first_seen_frame"] += [None if frame == NEVER else frame for frame in first]
    return columns


def _map_meta(collected: TruthCollector, classes: tuple[str, ...]) -> dict[str, Any]:
    pose = collected.world_from_map
    return {
        "classes": classes,
        "grids": [vars(seen.grid) for seen in collected.maps],
        "world_from_map": [pose.x_m, pose.y_m, pose.heading_rad],
    }


def _object_rows(home: Home) -> dict[str, list[Any]]:
    objects = home.objects
    return {
        "instance": [item.instance for item in objects],
        "class_id": [FIRST_OBJECT + item.class_id for item in objects],
        "label": [item.class_name for item in objects],
        "style": [item.piece.style for item in objects],
        "x_m": [item.x_m for item in objects],
        "y_m": [item.y_m for item in objects],
        "z_m": [item.z_m for item in objects],
        "yaw_rad": [item.yaw_rad for item in objects],
        "height_m": [item.piece.height_m for item in objects],
        "footprint": [[float(value) for value in item.footprint.ravel()] for item in objects],
    }


def _home_meta(home: Home, robot: RobotSpec) -> dict[str, Any]:
    return {
        "classes": class_list(home.classes),
        "seed": home.seed,
        "variant": home.variant,
        "day": home.day,
        "outline": [[float(value) for value in polygon.ravel()] for polygon in home.outline],
        "base_from_camera": [float(value) for value in robot.base_from_camera.ravel()],
    }


def _pose_rows(collected: TruthCollector) -> dict[str, list[Any]]:
    poses = [planar(pose) for pose in collected.poses]
    tilts = [roll_pitch(pose[2, :3]) for pose in collected.poses]
    return {
        "frame": list(range(len(poses))),
        "stamp_nanos": collected.stamps,
        "x_m": [pose.x_m for pose in poses],
        "y_m": [pose.y_m for pose in poses],
        "z_m": [float(pose[2, 3]) for pose in collected.poses],
        "heading_rad": [pose.heading_rad for pose in poses],
        "roll_rad": [roll for roll, _ in tilts],
        "pitch_rad": [pitch for _, pitch in tilts],
    }


def _observation_rows(collected: TruthCollector, observed: Sequence[Observed]) -> dict[str, list[Any]]:
    return {
        "frame": list(range(len(observed))),
        "stamp_nanos": collected.stamps,
        "cells": [one.cells for one in observed],
        "weights": [one.weights for one in observed],
        "objects": [one.objects for one in observed],
    }


def _upright(pose: SE2) -> Matrix:
    """The pose of a levelled robot on the floor as a matrix."""
    matrix = np.eye(4)
    cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    matrix[:2, :2] = [[cosine, -sine], [sine, cosine]]
    matrix[:2, 3] = pose.x_m, pose.y_m
    return matrix


def _corners(ground: Ground) -> Array:
    """(4, 2) corners of what is drawn on the ground."""
    row, column = np.nonzero(ground.codes)
    (x0, x1), (y0, y1) = ((ids.min() * _RASTER_M, (ids.max() + 1) * _RASTER_M) for ids in (column, row))
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) + ground.origin
