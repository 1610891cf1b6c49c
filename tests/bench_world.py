"""A data set of toy rooms, as `semslam simulate` would lay it out, without the simulator; and made-up results."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.bench.results import Conditions, MapResult, NotRun, Results, Trained
from semslam.bench.rows import ALL, CONVLSTM, MAP_METHODS, SETTINGS, VISUAL_SETTINGS, protocols_of
from semslam.bench.tracks import TrackScore
from semslam.geometry.frames import SE2
from semslam.geometry.grid import to_sparse
from semslam.labels import FREE_FLOOR, OBSTACLE, UNOBSERVED, class_list
from semslam.stages.settings import PaperConfig
from semslam.tables.parquet import write_table
from semslam.tables.spec import OBSERVATIONS, SPLITS, TRUE_MAP, TRUTH
from tests.make_log import ToyTruth, make_log

CLASSES = class_list(
    ("chair", "table", "sofa", "bed", "bookshelf", "dresser", "plant", "lamp", "tv", "bin", "refrigerator", "toilet")
)
"""Those of the shipped detector."""
_SAME = {"shelf": "bookshelf"}
_FINE_M, _FINE_SIDE, _CELL_M, _SIDE = 0.1, 99, 0.3, 33
_SEEN_M, _HALF_VIEW_RAD = 4.0, math.radians(35)


def make_dataset(root: Path, scenes: int = 2, trajectories: int = 2, frames: int = 4) -> Path:
    """Toy rooms driven through: the last scene tests across scenes, the last drive of each within it."""
    (root / "logs").mkdir(parents=True)
    rows = []
    for scene in range(scenes):
        for drive in range(trajectories):
            name = f"toy_{scene:02}_t{drive}"
            truth = make_log(root / "logs" / f"{name}.mcap", frames=frames, seed=10 * scene + drive)
            _write_truth(root / "truth" / name, truth)
            sides = ("train", "test")[drive == trajectories - 1], ("train", "test")[scene == scenes - 1]
            rows.append((name, "standard", scene, 0, drive, *sides))
    columns = dict(zip((c.name for c in SPLITS.columns), map(list, zip(*rows, strict=True)), strict=True))
    write_table(root / "splits.parquet", SPLITS, columns, {"seed": 0})
    return root


@dataclass(frozen=True)
class _Home:
    """Labels of a toy room in the world frame."""

    truth: ToyTruth

    def labels(self, places: NDArray[np.float64]) -> NDArray[np.int64]:
        """(..., 2) -> (...,) class ids."""
        room = self.truth.room
        x, y = np.moveaxis(places, -1, 0)
        inside = (np.abs(x) < room.width_m / 2) & (np.abs(y) < room.depth_m / 2)
        wall = ~inside & (np.abs(x) < room.width_m / 2 + 0.2) & (np.abs(y) < room.depth_m / 2 + 0.2)
        ids = np.where(inside, FREE_FLOOR, np.where(wall, OBSTACLE, UNOBSERVED))
        for thing in room.objects:
            name = _SAME.get(thing.class_name, thing.class_name)
            corners = thing.corners()
            edges = np.roll(corners, -1, 0) - corners
            offsets = places[..., None, :] - corners
            within = (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0).all(-1)
            ids[within] = CLASSES.index(name) if name in CLASSES else OBSTACLE
        return ids


def _write_truth(folder: Path, truth: ToyTruth) -> None:
    """The four tables of a log that the bench reads."""
    folder.mkdir(parents=True)
    poses = [SE2(*pose) for pose in truth.poses.tolist()]
    frames = list(range(len(poses)))
    stamps = list(truth.stamps_nanos)
    zero = [0.0] * len(poses)
    columns = {"frame": frames, "stamp_nanos": stamps, "x_m": [p.x_m for p in poses], "y_m": [p.y_m for p in poses]}
    columns |= {"z_m": zero, "heading_rad": [p.heading_rad for p in poses], "roll_rad": zero, "pitch_rad": zero}
    write_table(folder / "truth.parquet", TRUTH, columns)
    home = _Home(truth)
    for quality in ("ideal", "obstructed"):
        _write_observations(folder / f"{quality}.parquet", home, poses, stamps, everywhere=quality == "ideal")
    _write_true_map(folder / "true_map.parquet", home, poses)


def _cells(side: int, cell_m: float) -> NDArray[np.float64]:
    """(side, side, 2) x and y of cell centres about the middle."""
    y, x = (np.mgrid[:side, :side] - side // 2) * cell_m
    return np.stack([x, y], -1)


def _in_view(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the camera at the origin, looking along x, would see places with nothing in between."""
    x, y = np.moveaxis(places, -1, 0)
    return (np.hypot(x, y) < _SEEN_M) & (np.abs(np.arctan2(y, x)) < _HALF_VIEW_RAD)


def _write_observations(path: Path, home: _Home, poses: list[SE2], stamps: list[int], *, everywhere: bool) -> None:
    around = _cells(_FINE_SIDE, _FINE_M)
    cells, weights = [], []
    for pose in poses:
        ids = home.labels(pose.apply(around))
        ids = ids if everywhere else np.where(_in_view(around), ids, UNOBSERVED)
        planes = (np.arange(len(CLASSES))[:, None, None] == ids).astype(np.float32)
        kept, values = to_sparse(planes)
        cells.append(kept)
        weights.append(values)
    columns = {"frame": list(range(len(poses))), "stamp_nanos": stamps, "cells": cells, "weights": weights}
    meta = {"classes": list(CLASSES), "cell_m": _FINE_M, "side": _FINE_SIDE}
    write_table(path, OBSERVATIONS, {**columns, "objects": [0] * len(poses)}, meta)


def _write_true_map(path: Path, home: _Home, poses: list[SE2]) -> None:
    places = _cells(_SIDE, _CELL_M)  # in the map frame, which is the first pose's
    ids = home.labels(poses[0].apply(places))
    first = np.full(ids.shape, -1)
    for step, pose in reversed(list(enumerate(poses))):
        first[_in_view(pose.between(poses[0]).apply(places))] = step
    row, column = np.nonzero(ids != UNOBSERVED)
    seen = [None if step < 0 else int(step) for step in first[row, column]]
    columns: dict[str, Any] = {"cell_m": [_CELL_M] * len(row), "row": row.tolist(), "column": column.tolist()}
    columns |= {"x_m": places[row, column, 0].tolist(), "y_m": places[row, column, 1].tolist()}
    columns |= {"class_id": ids[row, column].tolist(), "first_seen_frame": seen}
    origin = -_SIDE * _CELL_M / 2
    grid = {"cell_m": _CELL_M, "rows": _SIDE, "columns": _SIDE, "origin_x_m": origin, "origin_y_m": origin}
    start = poses[0]
    meta = {
        "classes": list(CLASSES),
        "grids": [grid],
        "world_from_map": [start.x_m, start.y_m, start.heading_rad],
    }
    write_table(path, TRUE_MAP, columns, meta)


_LEVELS = {
    "chance": (3.8, 90.0, 0),
    "standstill": (2.1, 70.0, 0),
    "dead_reckoning": (0.35, 9.0, 0),
    "deepvo": (2.1, 60.0, 2),
    "mapnet": (2.6, 70.0, 2),
    "semantic_cell": (2.5, 60.0, 2),
    "visual": (2.3, 52.0, 2),
    "visual_inertial": (0.3, 8.0, 2),
    "visual_inertial_leaky": (0.4, 9.0, 0),
    "small_gicp": (0.04, 0.5, 0),
    "visual_leaky": (2.4, 60.0, 0),
    **{row.name: (0.5, 9.5, 0) for row in SETTINGS},
    **{row.name: (3.4, 62.0, 0) for row in VISUAL_SETTINGS},
}
"""Made-up errors in metres and degrees, and seeds."""


def made_up_results(steps: int = 6, drives: int = 5) -> Results:
    """Results of every kind, the ConvLSTM better than any heuristic, kiss-icp not installed."""
    rng = np.random.default_rng(7)
    difficulty = rng.gamma(20.0, 1 / 20, drives)
    tracks = [
        _track(name, protocol, seed, drive, difficulty[drive] * rng.gamma(200.0, 1 / 200), steps)
        for name, (_, _, seeds) in _LEVELS.items()
        for protocol in protocols_of(ALL[name])
        for seed in (range(1, seeds + 1) if seeds else (0,))
        for drive in range(drives)
    ]
    maps = [
        _maps(method, quality, seed, rng, drives, steps)
        for method in MAP_METHODS
        for quality in ("real", "obstructed", "ideal")
        for seed in ((1, 2) if method == CONVLSTM else (0,))
    ]
    tests = {"intra": drives, "cross": drives}
    paper, versions = vars(PaperConfig()), {"semslam": "0"}
    conditions = Conditions("toy", 2, 9, "standard", steps, 2, tests, paper, "d.onnx", versions)
    missing = (NotRun("kiss_icp", "intra", "not installed"), NotRun("kiss_icp", "cross", "not installed"))
    return Results(
        conditions, tuple(tracks), tuple(maps), missing, (Trained("mapper", "cross", "real", 1, 60.0, 9000),)
    )


def _track(name: str, protocol: str, seed: int, drive: int, factor: float, steps: int) -> TrackScore:
    ape, de, _ = _LEVELS[name]
    growth = 2 * np.arange(steps) / (steps - 1)
    distance, turn = ape * factor * growth, de * factor * growth
    return TrackScore(
        name, protocol, seed, f"log_{drive}", 1.0, ape * factor, de * factor, tuple(distance), tuple(turn)
    )


def _maps(method: str, quality: str, seed: int, rng: np.random.Generator, drives: int, steps: int) -> MapResult:
    level = 0.02 if method == CONVLSTM else 0.03 + 0.01 * float(method.partition("_")[2])
    sets = ("reached", "visible", "all")
    last = {"mse": level, "brier": 15 * level, "ece": 0.1, "object_iou": 0.3, "boundary_f1": 0.4}
    logs = {
        f"log_{drive}": {
            "mse": {name: (level * rng.gamma(400.0, 1 / 400, steps)).tolist() for name in sets},
            "last": dict.fromkeys(sets, last),
            "found": [None, *([level * step, 10.0] for step in range(2, steps))],
            "overlaps": {"intersection": [5, 40, 3, 2 + drive, *[0] * 11], "union": [9, 50, 6, 10, *[0] * 11]},
        }
        for drive in range(drives)
    }
    ids = np.zeros((33, 33), np.int64)
    ids[4:20, 6:25], ids[9:12, 10:14] = FREE_FLOOR, 3
    panel = {name: ids.tolist() for name in ("previous", "observation", "updated", "truth")}
    where = {"log": "log_0", "step": 3, "pose": [0.2, 0.1, 0.5], "window": [[10, 21], [11, 22]]}
    panels = [{**where, **panel}]
    return MapResult(method, quality, seed, {"classes": list(CLASSES), "cell_m": 0.3, "logs": logs, "panels": panels})
