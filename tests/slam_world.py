"""A small world of point objects whose truth is known, and a stage context in memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes, to_sparse
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, UNOBSERVED, class_list
from semslam.slam.estimator import Step
from semslam.stages.contract import FinishedShard
from semslam.tables.parquet import TableFiles, TableFileWriter, write_table
from semslam.tables.spec import MOTION, OBSERVATIONS, Table

CELL_M, SIDE = 0.1, 99
CLASSES = class_list(("chair", "table", "plant", "couch", "tv", "sink", "bed", "lamp"))
SECOND = 1_000_000_000
NO_BIAS = SE2(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class World:
    """Objects of half a metre: middles (N, 2) in the map frame, metres, and class ids (N,)."""

    middles: NDArray[np.float64]
    class_id: NDArray[np.int64]

    def observe(self, map_from_robot: SE2, range_m: float = 4.5, half_angle_rad: float = 1.0) -> Planes:
        """The perfect observation: floor in the field of view, and the visible part of every object by equation 1."""
        planes = np.zeros((len(CLASSES), SIDE, SIDE), np.float32)
        y, x = (np.mgrid[:SIDE, :SIDE] - SIDE // 2) * CELL_M
        view = (np.hypot(x, y) < range_m) & (np.abs(np.arctan2(y, x)) < half_angle_rad)
        spots = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 5)] * 2), -1).reshape(-1, 2)
        for middle, class_id in zip(self.middles, self.class_id, strict=True):
            seen = map_from_robot.inverse().apply(middle + spots)
            column, row = np.floor(seen / CELL_M + SIDE / 2).astype(int).T
            inside = (row >= 0) & (row < SIDE) & (column >= 0) & (column < SIDE)
            np.add.at(planes[class_id], (row[inside], column[inside]), np.float32(1 / len(spots)))
        planes *= view
        planes[FREE_FLOOR] = view & ~planes[FIRST_OBJECT:].any(0)
        planes[UNOBSERVED] = ~view
        return np.minimum(planes, np.float32(1.0))


def make_world(objects: int = 40, half_m: float = 4.0, seed: int = 0) -> World:
    """Objects of all classes at random places."""
    random = np.random.default_rng(seed)
    class_id = FIRST_OBJECT + np.arange(objects) % (len(CLASSES) - FIRST_OBJECT)
    return World(random.uniform(-half_m, half_m, (objects, 2)), class_id)


def make_walk(frames: int = 30) -> list[SE2]:
    """A loop that starts at the origin with heading 0 and comes back."""
    walk = [SE2(0.0, 0.0, 0.0)]
    for _ in range(frames - 1):
        walk.append(walk[-1] @ SE2(0.25, 0.0, math.tau / 24))
    return walk


def make_steps(
    world: World, walk: Sequence[SE2], bias: SE2 = NO_BIAS, noise_m: float = 0.0, seed: int = 0
) -> list[Step]:
    """What a robot on that walk reports: clean observations, motions with a constant bias and noise."""
    random = np.random.default_rng(seed)
    steps = [Step(0, 0, world.observe(walk[0]), None)]
    for frame, (before, now) in enumerate(pairwise(walk), 1):
        true = before.between(now)
        dx, dy, turn = random.normal(0.0, noise_m, 3) if noise_m else (0.0, 0.0, 0.0)
        motion = SE2(true.x_m + bias.x_m + dx, true.y_m + bias.y_m + dy, true.heading_rad + bias.heading_rad + turn)
        steps.append(Step(frame, frame * SECOND, world.observe(now), motion))
    return steps


def write_inputs(folder: Path, steps: Sequence[Step]) -> dict[str, TableFiles]:
    """Motion and observations as ingest and extract write them."""
    meta = {"classes": list(CLASSES), "cell_m": CELL_M, "side": SIDE}
    motion = [(s.motion.x_m, s.motion.y_m, s.motion.heading_rad) if s.motion else (None, None, None) for s in steps]
    columns = {name: [row[i] for row in motion] for i, name in enumerate(("dx_m", "dy_m", "dheading_rad"))}
    common = {"frame": [s.frame for s in steps], "stamp_nanos": [s.stamp_nanos for s in steps]}
    source = ["odometry" if s.motion else "none" for s in steps]
    write_table(folder / "motion.parquet", MOTION, {**common, **columns, "source": source}, meta)
    seen = [(s, to_sparse(s.observation)) for s in steps if s.observation is not None]
    rows = {
        "frame": [s.frame for s, _ in seen],
        "stamp_nanos": [s.stamp_nanos for s, _ in seen],
        "cells": [cells.tolist() for _, (cells, _) in seen],
        "weights": [weights.tolist() for _, (_, weights) in seen],
        "objects": [0] * len(seen),
    }
    write_table(folder / "observations.parquet", OBSERVATIONS, rows, meta)
    return {table.name: TableFiles(table, [folder / f"{table.name}.parquet"]) for table in (MOTION, OBSERVATIONS)}


@dataclass
class MemoryShard:
    """A shard in a folder, with what was said about it."""

    folder: Path
    sinks: dict[str, TableFileWriter] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)

    def table(self, table: Table, meta: Mapping[str, Any] | None = None) -> TableFileWriter:
        if table.name not in self.sinks:
            self.sinks[table.name] = TableFileWriter(self.folder / f"{table.name}.parquet", table, meta)
        return self.sinks[table.name]

    def path(self, name: str) -> Path:
        return self.folder / name

    def note(self, key: str, value: Any) -> None:
        self.notes[key] = value

    def remark(self, message: str) -> None:
        pass

    def warn(self, message: str) -> None:
        self.warnings.append(message)

    def count(self, name: str, number: int = 1) -> None:
        self.counters[name] = self.counters.get(name, 0) + number


@dataclass
class MemoryContext:
    """A stage context without cache and processes; shards lie in `folder`."""

    folder: Path
    tables: Mapping[str, TableFiles]
    config: Any
    variant: str = ""
    log: str = "kitchen_02"
    sources: tuple[Path, ...] = ()
    threads: int = 1
    shards: list[MemoryShard] = field(default_factory=list)
    finished: tuple[FinishedShard, ...] = ()
    done: list[tuple[int, int | None]] = field(default_factory=list)

    def read(self, table: Table) -> TableFiles:
        return self.tables[table.name]

    @contextmanager
    def shard(self, index: int) -> Iterator[MemoryShard]:
        folder = self.folder / f"shard-{index}"
        folder.mkdir(parents=True)
        shard = MemoryShard(folder)
        yield shard
        for sink in shard.sinks.values():
            sink.close()
        self.shards.append(shard)

    def progress(self, done: int, total: int | None = None) -> None:
        self.done.append((done, total))

    def results(self, *tables: Table) -> dict[str, TableFiles]:
        """The tables written so far, whole."""
        folders = sorted(self.folder.iterdir())
        return {t.name: TableFiles(t, [folder / f"{t.name}.parquet" for folder in folders]) for t in tables}
