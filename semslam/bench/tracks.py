"""Pose tracks of every row on the logs that test, made by the pipeline and scored against exact truth.

Stages run as ever, in an output folder of the bench, so that tracks are cached under what they depend on. The first
`steps` keyframes of a log are localised and scored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semslam.bench.rows import CHANCE, STANDSTILL, Row
from semslam.errors import SemslamError
from semslam.metrics import Errors, Track, chance_errors, errors
from semslam.models.training.drives import simulating
from semslam.pipeline.cache import Entry, table_files
from semslam.pipeline.config import Config, load_config
from semslam.pipeline.console import Console
from semslam.pipeline.discover import Log
from semslam.pipeline.folder import OutputFolder, create_folder, open_folder
from semslam.pipeline.run import run_logs
from semslam.stages.contract import Stage
from semslam.stages.settings import PaperConfig
from semslam.tables.parquet import TableFiles, made_by
from semslam.tables.spec import POSES, TRAJECTORY, TRUTH, Table

_TRACK = ("frame", "stamp_nanos", "x_m", "y_m", "heading_rad")


@dataclass(frozen=True)
class Pipeline:
    """The stages over the logs of a data set, with the base configuration of the bench."""

    folder: OutputFolder
    stages: tuple[Stage, ...]
    logs: Mapping[str, Log]
    config_file: Path | None = None
    assignments: tuple[str, ...] = ()
    options: Mapping[str, Any] | None = None
    workers: int | None = None

    @staticmethod
    @contextmanager
    def opened(
        root: Path, stages: Sequence[Stage], dataset: Path, *, make: bool = True, **base: Any
    ) -> Iterator[Pipeline]:
        """The pipeline in the output folder `root`, which it holds until the block ends.

        Raises:
            UsageError: `root` is no output folder, and may not be made one.
        """
        folder = create_folder(root) if make else open_folder(root)
        paths = sorted((dataset / "logs").resolve().glob("*.mcap"))
        with folder.locked():
            yield Pipeline(folder, tuple(stages), {path.stem: Log(path.stem, (path,)) for path in paths}, **base)

    def config(self, settings: Mapping[str, Any] | None = None) -> Config:
        """The base configuration with some settings changed.

        Raises:
            UsageError: a setting does not exist or may not have that value.
        """
        options = {**(self.options or {}), **(settings or {})}
        return load_config(self.stages, self.config_file, self.assignments, options)

    def paper(self, settings: Mapping[str, Any] | None = None) -> PaperConfig:
        """Its section `[localize.paper]`."""
        paper: PaperConfig = self.config(settings).sections["localize"].paper
        return paper

    def run(self, until: str, names: Sequence[str], settings: Mapping[str, Any] | None = None) -> Runs:
        """Run the stages up to `until` over some logs; what failed is in the result.

        Raises:
            SemslamError: a log is missing, or the configuration is refused.
        """
        missing = [name for name in names if name not in self.logs]
        if missing:
            raise SemslamError(f"The data set has no log `{missing[0]}`", hint="`semslam simulate` makes missing ones")
        config = self.config(settings)
        logs = [self.logs[name] for name in names]
        report = run_logs(self.folder, self.stages, until, config, logs, self.workers, Console(quiet=True))
        entries: dict[tuple[str, str], Entry] = {}
        failures: dict[str, str] = {}
        for result in report.results:
            if result.entry is not None:
                entries[result.task.log.name, result.task.stage.name] = result.entry
            elif result.failure is not None:
                failures.setdefault(result.task.log.name, result.failure.message)
        return Runs(self.folder, entries, failures)


@dataclass(frozen=True)
class Runs:
    """What a run left, by log and stage (one variant at most), and why logs failed."""

    folder: OutputFolder
    entries: Mapping[tuple[str, str], Entry]
    failures: Mapping[str, str]

    def files(self, log: str, table: Table) -> tuple[Path, ...]:
        """Files of a table of a log; none if it has none."""
        entry = self.entries.get((log, table.stage))
        if entry is None or table.name not in entry.tables:
            return ()
        stored = table_files(self.folder.stage(table.stage) / entry.key)[table.name]
        return tuple(Path(file.path) for file in stored)

    def keys(self, logs: Sequence[str], stage: str) -> list[str]:
        """Keys of the stage's entries, for digests; empty where it failed."""
        return [entry.key if (entry := self.entries.get((log, stage))) else "" for log in logs]


@dataclass(frozen=True)
class TrackScore:
    """One row on one log with one seed."""

    row: str
    protocol: str
    seed: int
    """Of the training; 0 for rows without."""
    log: str
    coverage: float
    ape_m: float
    """NaN, like `de_deg`, without any pose."""
    de_deg: float
    distance_m: tuple[float, ...]
    """Position error of each step; NaN where there is no pose."""
    turn_deg: tuple[float, ...]


def true_track(dataset: Path, log: str, steps: int | None = None) -> Track:
    """The exact track of the first `steps` keyframes of a log, world_from_robot; None means all."""
    with made_by(simulating(dataset)):
        track = track_of(TableFiles(TRUTH, [dataset / "truth" / log / "truth.parquet"]), steps)
    if not len(track.frames):
        raise SemslamError(f"The truth of `{log}` is empty", hint=f"simulate it again: `semslam simulate {dataset}`")
    return track


def track_of(table: TableFiles, steps: int | None = None) -> Track:
    """The first `steps` rows of a table with the columns of a track, such as truth or trajectory; None means all."""
    rows = table.read(_TRACK)
    return Track.of(*(rows[name][:steps] for name in _TRACK))


def published_track(folder: Path) -> Track:
    """The trajectory in a folder of results: `results/LOG/ESTIMATOR`, or `sites/SITE/LOG`."""
    return track_of(TableFiles(TRAJECTORY, [folder / "trajectory.parquet"]))


def stored_track(files: Sequence[Path], truth: Track) -> Track:
    """A track of the poses table, its keyframes numbered as those of the truth with the same stamp."""
    rows = TableFiles(POSES, files).read(["stamp_nanos", "x_m", "y_m", "heading_rad"])
    stamps = np.asarray(rows["stamp_nanos"], np.int64)
    return _numbered(truth, stamps, [rows[name] for name in ("x_m", "y_m", "heading_rad")])


def scored(row: Row, protocol: str, seed: int, log: str, truth: Track, found: Errors) -> TrackScore:
    """The score of a track from its errors."""
    distance, turn = (np.full(len(truth.frames), np.nan) for _ in range(2))
    place = np.searchsorted(truth.frames, found.frames)
    distance[place], turn[place] = found.distance_m, found.turn_deg
    some = len(found.frames) > 0
    return TrackScore(
        row.name,
        protocol,
        seed,
        log,
        len(found.frames) / max(1, len(truth.frames)),
        float(found.distance_m.mean()) if some else math.nan,
        float(found.turn_deg.mean()) if some else math.nan,
        tuple(distance.tolist()),
        tuple(turn.tolist()),
    )


def reference_errors(row: Row, truth: Track, map_half_m: float) -> Errors:
    """Errors of chance, or of standing still."""
    if row == CHANCE:
        return chance_errors(truth, map_half_m)
    if row == STANDSTILL:
        zero = np.zeros(len(truth.frames))
        return errors(truth, Track(truth.frames, truth.stamp_nanos, zero, zero, zero))
    raise ValueError(row.name)


def column_track(columns: Mapping[str, Sequence[Any]], truth: Track) -> Track:
    """A track of plain columns (stamp_nanos, x_m, y_m, heading_rad), likewise numbered."""
    stamps = np.asarray(columns["stamp_nanos"], np.int64)
    return _numbered(truth, stamps, [columns[name] for name in ("x_m", "y_m", "heading_rad")])


def _numbered(truth: Track, stamps: Any, poses: Sequence[Sequence[float | None]]) -> Track:
    """Poses with the keyframe numbers that the truth has for their stamps; what it does not know is left out."""
    place = np.minimum(np.searchsorted(truth.stamp_nanos, stamps), max(0, len(truth.frames) - 1))
    known = truth.stamp_nanos[place] == stamps
    columns = [np.asarray(column, np.float64)[known] for column in poses]
    return Track.of(truth.frames[place][known], stamps[known], *columns)
