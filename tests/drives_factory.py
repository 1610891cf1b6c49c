"""Small data sets of made-up drives, whose every cell and pose is known: tables without a simulator."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2
from semslam.geometry.grid import to_sparse
from semslam.labels import UNOBSERVED, class_list
from semslam.models.training.drives import RunTables
from semslam.tables.parquet import write_table
from semslam.tables.spec import MOTION, OBSERVATIONS, SPLITS, TRUE_MAP, TRUTH

CELL_M, MAP_SIDE, SIDE = 0.3, 13, 5
NAMES = class_list(("chair", "table", "plant"))
SECOND = 1_000_000_000
START = SE2(4.0, -2.0, 0.7)
"""Of every drive, in the world that its truth counts in."""

Grid = NDArray[np.int64]


@dataclass(frozen=True)
class Story:
    """What really happened in a log."""

    labels: Grid
    poses: list[SE2]
    first_seen: Grid


def make_story(seed: int, steps: int) -> Story:
    """A room of random cells within a border of unobserved ones, and a walk through it."""
    rng = np.random.default_rng(seed)
    labels = rng.choice([1, 1, 1, 2, 3, 4, 5], (MAP_SIDE, MAP_SIDE))
    labels[[0, -1]] = labels[:, [0, -1]] = UNOBSERVED
    poses = [SE2(0.0, 0.0, 0.0)]
    while len(poses) < steps:
        motion = SE2(rng.uniform(0.1, 0.4), rng.uniform(-0.1, 0.1), rng.uniform(-0.9, 0.9))
        pose = poses[-1] @ motion
        poses.append(pose if max(abs(pose.x_m), abs(pose.y_m)) < 1.5 else poses[-1] @ SE2(0.0, 0.0, 0.8))
    first_seen = np.full(labels.shape, -1, np.int64)
    for step, pose in reversed(list(enumerate(poses))):
        y, x = (np.mgrid[:MAP_SIDE, :MAP_SIDE] - MAP_SIDE // 2) * CELL_M
        first_seen[(np.hypot(x - pose.x_m, y - pose.y_m) < 0.8) & (labels != UNOBSERVED)] = step
    return Story(labels, poses, first_seen)


def look(story: Story, step: int, wrong: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(L, h, h) the labels of the window about the robot; a share of the cells says something wrong."""
    y, x = (np.mgrid[:SIDE, :SIDE] - SIDE // 2) * CELL_M
    places = story.poses[step].apply(np.stack([x, y], -1))
    column, row = np.floor(places / CELL_M + MAP_SIDE / 2).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < MAP_SIDE) & (column >= 0) & (column < MAP_SIDE)
    seen = np.where(inside, story.labels[np.clip(row, 0, MAP_SIDE - 1), np.clip(column, 0, MAP_SIDE - 1)], UNOBSERVED)
    seen = np.where(rng.random(seen.shape) < wrong, rng.integers(0, len(NAMES), seen.shape), seen)
    return np.moveaxis(np.eye(len(NAMES), dtype=np.float32)[seen], -1, 0).copy()


def write_data_set(root: Path, logs: int = 4, steps: int = 12, wrong: float = 0.0) -> dict[str, Story]:
    """A data set of logs in one home each; the last one tests."""
    stories = {f"home_{index:02}": make_story(index, steps) for index in range(logs)}
    root.mkdir(parents=True, exist_ok=True)
    parts = ["train"] * (logs - 1) + ["test"]
    rows: dict[str, list[Any]] = {"log": list(stories), "variant": ["standard"] * logs, "scene": list(range(logs))}
    rows |= {"day": [0] * logs, "trajectory": [0] * logs, "intra": [None] * logs, "cross": parts}
    write_table(root / "splits.parquet", SPLITS, rows, {"seed": 1})
    for index, (name, story) in enumerate(stories.items()):
        folder = root / "truth" / name
        folder.mkdir(parents=True)
        _write_truth(folder, story)
        rng = np.random.default_rng([7, index])
        for quality, share in (("ideal", 0.0), ("obstructed", wrong)):
            planes = [look(story, step, share, rng) for step in range(steps)]
            write_observations(folder / f"{quality}.parquet", planes, list(range(steps)))
    return stories


def _write_truth(folder: Path, story: Story) -> None:
    world = [START @ pose for pose in story.poses]
    zeros = [0.0] * len(world)
    poses = {
        "x_m": [p.x_m for p in world],
        "y_m": [p.y_m for p in world],
        "heading_rad": [p.heading_rad for p in world],
    }
    others = dict.fromkeys(("z_m", "roll_rad", "pitch_rad"), zeros)
    write_table(folder / "truth.parquet", TRUTH, {**stamps(range(len(world))), **poses, **others})
    row, column = np.nonzero(story.labels)
    first = story.first_seen[row, column]
    origin = -0.5 * MAP_SIDE * CELL_M
    cells = {
        "cell_m": [CELL_M] * len(row),
        "row": row.tolist(),
        "column": column.tolist(),
        "x_m": (origin + (column + 0.5) * CELL_M).tolist(),
        "y_m": (origin + (row + 0.5) * CELL_M).tolist(),
        "class_id": story.labels[row, column].tolist(),
        "first_seen_frame": [None if frame < 0 else frame for frame in first.tolist()],
    }
    grid = {"cell_m": CELL_M, "rows": MAP_SIDE, "columns": MAP_SIDE, "origin_x_m": origin, "origin_y_m": origin}
    meta = {"classes": list(NAMES), "grids": [grid], "world_from_map": [START.x_m, START.y_m, START.heading_rad]}
    write_table(folder / "true_map.parquet", TRUE_MAP, cells, meta)


def write_observations(
    path: Path, planes: list[NDArray[np.float32]], frames: list[int], names: tuple[str, ...] = NAMES
) -> Path:
    """An observations table with these planes at the frames' stamps."""
    sparse = [to_sparse(one) for one in planes]
    columns = {"cells": [c for c, _ in sparse], "weights": [w for _, w in sparse], "objects": [1] * len(planes)}
    meta = {"classes": list(names), "cell_m": CELL_M, "side": SIDE}
    write_table(path, OBSERVATIONS, {**stamps(frames), **columns}, meta)
    return path


def write_run(root: Path, story: Story, frames: list[int], missing: int | None = None) -> RunTables:
    """Motion and perfect real-camera observations at some of the image pairs; one observation may be missing."""
    root.mkdir(parents=True, exist_ok=True)
    steps = [story.poses[a].between(story.poses[b]) for a, b in itertools.pairwise(frames)]
    motion: dict[str, list[Any]] = {
        "dx_m": [None, *(one.x_m for one in steps)],
        "dy_m": [None, *(one.y_m for one in steps)],
        "dheading_rad": [None, *(one.heading_rad for one in steps)],
        "source": ["start", *["odometry"] * len(steps)],
    }
    write_table(root / "motion.parquet", MOTION, {**stamps(frames), **motion})
    rng, seen = np.random.default_rng(0), [frame for frame in frames if frame != missing]
    path = write_observations(root / "observations.parquet", [look(story, f, 0.0, rng) for f in seen], seen)
    return RunTables((root / "motion.parquet",), (path,))


def stamps(frames: Any) -> dict[str, list[int]]:
    """Columns that say when; frames count the rows, stamps the image pairs."""
    times = [1_700_000_000 * SECOND + frame * SECOND for frame in frames]
    return {"frame": list(range(len(times))), "stamp_nanos": times}
