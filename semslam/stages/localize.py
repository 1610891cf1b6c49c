"""Localize: from observations and motion to a pose track and maps, with the estimator that the variant names.

Reads   frames         data_spec.md, table 2, if the estimator looks at pictures
        motion         data_spec.md, table 3
        observations   data_spec.md, table 6
Writes  poses          data_spec.md, table 7
        snapshots      data_spec.md, table 8: the estimator's own map, or the map of cells so far if it keeps none
        cells          data_spec.md, table 9: the map of the whole log, in the last shard
        places         data_spec.md, table 16: what `surfel` knows of each keyframe, likewise; of others none
Paper   equations 2 to 8 and 10

A step needs all steps before it. Each shard therefore keeps the state after its last keyframe (`state.npz`), and a run
that goes on takes up the state of the last finished shard: the bytes are those of an undisturbed run.

An estimator of whole logs tells no pose before it has seen the last keyframe. Its shards keep what it took in, and the
last one holds all rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes, to_dense, to_sparse
from semslam.labels import UNOBSERVED
from semslam.models.memory import keep_freed_memory
from semslam.slam.checkpoint import as_array, pack, unpack
from semslam.slam.estimator import Belief, PoseEstimate, Step
from semslam.slam.evidence import Evidence, Snapshot
from semslam.slam.health import TrackHealth
from semslam.slam.registry import NEEDS_VIEWS, WHOLE_LOGS, WITHOUT_MOTION, open_estimator, open_whole
from semslam.slam.verdict import verdict_of
from semslam.slam.views import view_of
from semslam.stages.contract import FinishedShard, ShardWriter, StageContext, TableSink, TableSource, row_shards
from semslam.stages.settings import LocalizeConfig
from semslam.tables.parquet import rows_of
from semslam.tables.spec import CELLS, FRAMES, MOTION, OBSERVATIONS, PLACES, POSES, SNAPSHOTS

_STATE = "state.npz"
_VIEW = ["frame", "colour", "depth", "fx", "fy", "cx", "cy", "robot_from_camera"]
"""Columns of the frames table that make a view."""
_ROWS_READ = 8
"""Rows read at once of tables whose rows are large."""


def run(ctx: StageContext) -> None:
    """Estimate the track, and build the map along it."""
    if ctx.variant in WHOLE_LOGS:
        _run_whole(ctx)
    else:
        _run_stepwise(ctx)


def _run_stepwise(ctx: StageContext) -> None:
    """Step through all keyframes, shard by shard."""
    motion, observations = ctx.read(MOTION), ctx.read(OBSERVATIONS)
    rows = _rows_of(motion, ctx.config)
    frames = ctx.read(FRAMES) if ctx.variant in NEEDS_VIEWS else None
    track = _SteppedTrack(ctx, observations.meta)
    keep_freed_memory()
    if ctx.finished:
        track.restore(ctx.finished[-1])
    for index, start, stop in row_shards(rows, ctx.config.shard_frames):
        if index < len(ctx.finished):
            continue
        with ctx.shard(index) as shard:
            tables = {table.name: shard.table(table, track.meta) for table in (POSES, SNAPSHOTS, CELLS)}
            steps = read_steps(motion, observations, frames, track.shape, start, stop)
            for done, step in enumerate(steps, start + 1):
                track.add(step, track.estimate(step), shard, tables, last=done == rows)
                ctx.progress(done, rows)
            if stop == rows:
                track.close(shard, tables)
            shard.path(_STATE).write_bytes(track.state())


def _run_whole(ctx: StageContext) -> None:
    """Take in all keyframes, shard by shard, then tell all poses at once."""
    motion, observations, frames = ctx.read(MOTION), ctx.read(OBSERVATIONS), ctx.read(FRAMES)
    config: LocalizeConfig = ctx.config
    rows = _rows_of(motion, config)
    track = _Track(ctx, observations.meta)
    estimator = open_whole(ctx.variant, config, *track.grid)
    keep_freed_memory()
    estimator.restore([(shard.folder / _STATE).read_bytes() for shard in ctx.finished])
    total = rows + config.surfel.rounds
    for index, start, stop in row_shards(rows, config.shard_frames):
        if index < len(ctx.finished):
            continue
        with ctx.shard(index) as shard:
            tables = {table.name: shard.table(table, track.meta) for table in (POSES, SNAPSHOTS, CELLS)}
            places = shard.table(PLACES, {**track.meta, "side": track.grid[2]})
            for done, step in enumerate(read_steps(motion, observations, frames, track.shape, start, stop), start + 1):
                estimator.step(step)
                ctx.progress(done, total)
            shard.path(_STATE).write_bytes(estimator.part())
            if stop < rows:
                continue
            poses = estimator.finish(lambda rounds: ctx.progress(rows + rounds, total))
            steps = read_steps(motion, observations, None, track.shape, 0, rows)
            for done, (step, pose) in enumerate(zip(steps, poses, strict=True), 1):
                track.add(step, pose, shard, tables, last=done == rows)
            track.close(shard, tables)
            for row in estimator.rows():
                places.append(row)
            for warning in estimator.warnings():
                shard.warn(warning)
            ctx.progress(total, total)


def _rows_of(motion: TableSource, config: LocalizeConfig) -> int:
    """How many keyframes to localise."""
    return min(motion.rows, config.max_keyframes or motion.rows)


class _Track:
    """A pose track and the map that grows along it."""

    def __init__(self, ctx: StageContext, meta: Mapping[str, Any]) -> None:
        self._config: LocalizeConfig = ctx.config
        self._every = self._config.snapshot_every
        self._classes = tuple(meta["classes"])
        self._cell_m, self._side = float(meta["cell_m"]), int(meta["side"])
        self._evidence = Evidence(self._cell_m, self._side)
        self._last = SE2(0.0, 0.0, 0.0)
        self._half_m = math.inf
        self._steps = 0
        self._health = TrackHealth(ctx.variant not in WITHOUT_MOTION)
        self._outside = self._unmapped = 0
        self.meta = {"classes": list(self._classes), "cell_m": self._cell_m, "estimator": ctx.variant}

    @property
    def grid(self) -> tuple[tuple[str, ...], float, int]:
        """Classes, cell and side of an observation."""
        return self._classes, self._cell_m, self._side

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of an observation."""
        return len(self._classes), self._side, self._side

    def add(
        self, step: Step, estimate: PoseEstimate, shard: ShardWriter, tables: Mapping[str, TableSink], *, last: bool
    ) -> None:
        """Take the next pose: lay the observation on the map there, and write what is due."""
        self._health.see(step, estimate)
        shard.count(f"poses_{estimate.source}")
        if estimate.map_from_robot is not None:
            self._lay(step, estimate.map_from_robot, shard)
        self._steps += 1
        verdict = verdict_of(estimate, self._config.ok_m, self._config.ok_rad)
        tables["poses"].append(_pose_row(step, estimate, verdict))
        if self._steps % self._every == 0 or last:
            tables["snapshots"].append(_snapshot_row(step, self.snapshot()))

    def _lay(self, step: Step, pose: SE2, shard: ShardWriter) -> None:
        self._last = pose
        self._outside += max(abs(pose.x_m), abs(pose.y_m)) > self._half_m
        if step.observation is not None and not self._evidence.add(step.observation, pose, step.stamp_nanos):
            shard.count("observations_off_the_map")
            self._unmapped += 1

    def snapshot(self) -> Snapshot:
        """The cells about the last pose."""
        return self._evidence.snapshot(self._last)

    def close(self, shard: ShardWriter, tables: Mapping[str, TableSink]) -> None:
        """Write the whole map, and what there is to warn of."""
        tables["cells"].append(self.cells())
        self.warn(shard)

    def cells(self) -> dict[str, Any]:
        """Columns of the cells table."""
        cells = self._evidence.cells()
        centres = {f"{axis}_m": (cells[f"i{axis}"] + 0.5) * self._cell_m for axis in "xy"}
        labels = [self._classes[class_id] for class_id in cells["class_id"]]
        return {**cells, **centres, "label": labels}

    def warn(self, shard: ShardWriter) -> None:
        """Say what was wrong with the track, and how many keyframes lay off the maps."""
        for warning in self._health.warnings():
            shard.warn(warning)
        if self._unmapped:
            shard.warn(f"{self._unmapped} observations lie too far from the start for any map and were left out of it")
        if self._outside:
            shard.warn(
                f"{self._outside} keyframes lie outside the map of `{self.meta['estimator']}`, "
                f"{2 * self._half_m:.1f} m wide about the start; raise `localize.paper.map_side`"
            )


class _SteppedTrack(_Track):
    """With the estimator that makes it step by step."""

    def __init__(self, ctx: StageContext, meta: Mapping[str, Any]) -> None:
        super().__init__(ctx, meta)
        self._estimator = open_estimator(ctx.variant, ctx.config, self._classes, self._cell_m, self._side)
        self._half_m = _half_side_m(self._estimator.belief())

    def estimate(self, step: Step) -> PoseEstimate:
        """The pose of the next keyframe."""
        return self._estimator.step(step)

    def snapshot(self) -> Snapshot:
        """The estimator's own map, or the cells about the last pose."""
        belief = self._estimator.belief()
        return _sparse(belief) if belief else super().snapshot()

    def state(self) -> bytes:
        """Estimator, map, last pose, and what there is to warn of."""
        parts = {
            "estimator": self._estimator.state(),
            "evidence": self._evidence.state(),
            "health": self._health.state(),
        }
        last = np.array([self._last.x_m, self._last.y_m, self._last.heading_rad])
        counts = np.array([self._outside, self._unmapped, self._steps])
        return pack({**{name: as_array(part) for name, part in parts.items()}, "last": last, "counts": counts})

    def restore(self, shard: FinishedShard) -> None:
        """Go on after a finished shard."""
        arrays = unpack((shard.folder / _STATE).read_bytes())
        self._estimator.restore(arrays["estimator"].tobytes())
        self._evidence.restore(arrays["evidence"].tobytes())
        self._health.restore(arrays["health"].tobytes())
        self._last = SE2(*arrays["last"].tolist())
        self._outside, self._unmapped, self._steps = arrays["counts"].tolist()


def read_steps(
    motion: TableSource,
    observations: TableSource,
    frames: TableSource | None,
    shape: tuple[int, int, int],
    start: int,
    stop: int,
) -> Iterator[Step]:
    """Motion rows [start, stop), each with the observation, and if wanted the view, of its frame if there is one."""
    sights = _Beside(observations)
    pictures = _Beside(frames, _VIEW) if frames else None
    for row in rows_of(motion.batches(None, start, stop, _ROWS_READ)):
        sight = sights.at(row["frame"])
        picture = pictures.at(row["frame"]) if pictures else None
        observation = None if sight is None else _planes(sight, shape)
        view = None if picture is None else view_of(picture)
        yield Step(row["frame"], row["stamp_nanos"], observation, _motion(row), view)


class _Beside:
    """The rows of a table by frame number, asked for in rising order."""

    def __init__(self, table: TableSource, columns: list[str] | None = None) -> None:
        self._table = table
        self._columns = columns
        self._frames = np.array(table.read(["frame"])["frame"], np.int64)
        self._rows: Iterator[dict[str, Any]] | None = None
        self._row: dict[str, Any] | None = None

    def at(self, frame: int) -> dict[str, Any] | None:
        """The row of the frame; None if there is none."""
        if self._rows is None:
            first = int(np.searchsorted(self._frames, frame))
            self._rows = rows_of(self._table.batches(self._columns, first, None, _ROWS_READ))
            self._row = next(self._rows, None)
        if self._row is None or self._row["frame"] != frame:
            return None
        found, self._row = self._row, next(self._rows, None)
        return found


def _motion(row: Mapping[str, Any]) -> SE2 | None:
    """u_t, or None if any part of it is unknown or no number."""
    parts = (row["dx_m"], row["dy_m"], row["dheading_rad"])
    return SE2(*parts) if all(part is not None and np.isfinite(part) for part in parts) else None


def _planes(row: Mapping[str, Any], shape: tuple[int, int, int]) -> Planes:
    """The observation as planes; *unobserved* is 1 exactly where nothing else is, whether the table says so or not.

    Raises:
        SemslamError: an entry lies outside the observation.
    """
    try:
        planes = to_dense(np.array(row["cells"], np.uint32), np.array(row["weights"], np.float32), shape)
    except IndexError as error:
        raise SemslamError(
            f"Observation of frame {row['frame']} has a cell outside its {shape[0]} x {shape[1]} x {shape[2]} grid",
            hint="`semslam verify OUT` lists damaged files; run extract again",
        ) from error
    planes[UNOBSERVED] = ~planes[1:].any(0)
    return planes


def _half_side_m(belief: Belief | None) -> float:
    """From the middle of the estimator's map, where it starts, to its border; infinite without one."""
    return -belief.origin_x_m if belief else math.inf


def _sparse(belief: Belief) -> Snapshot:
    cells, weights = to_sparse(belief.planes)
    _, rows, columns = belief.planes.shape
    origin = belief.origin_x_m, belief.origin_y_m
    return Snapshot(rows, columns, belief.cell_m, *origin, cells.astype(np.int64), weights)


def _pose_row(step: Step, estimate: PoseEstimate, verdict: str) -> dict[str, list[Any]]:
    pose, modes = estimate.map_from_robot, estimate.modes
    row = {
        "frame": step.frame,
        "stamp_nanos": step.stamp_nanos,
        "x_m": pose.x_m if pose else None,
        "y_m": pose.y_m if pose else None,
        "heading_rad": pose.heading_rad if pose else None,
        "source": estimate.source,
        "verdict": verdict,
        "covariance": list(estimate.covariance or ()),
        "peak": estimate.peak,
        "entropy_nats": estimate.entropy_nats,
        "mode_x_m": [mode.map_from_robot.x_m for mode in modes],
        "mode_y_m": [mode.map_from_robot.y_m for mode in modes],
        "mode_heading_rad": [mode.map_from_robot.heading_rad for mode in modes],
        "mode_probability": [mode.probability for mode in modes],
    }
    return {name: [value] for name, value in row.items()}


def _snapshot_row(step: Step, snapshot: Snapshot) -> dict[str, list[Any]]:
    row = {
        "frame": step.frame,
        "stamp_nanos": step.stamp_nanos,
        "rows": snapshot.rows,
        "columns": snapshot.columns,
        "cell_m": snapshot.cell_m,
        "origin_x_m": snapshot.origin_x_m,
        "origin_y_m": snapshot.origin_y_m,
        "cells": snapshot.cells,
        "weights": snapshot.weights,
    }
    return {name: [value] for name, value in row.items()}
