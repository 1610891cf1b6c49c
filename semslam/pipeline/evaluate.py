"""Evaluate: how far every estimator's track is from the truth, beside dead reckoning, luck and standing still.

Reads   truth, motion, poses       data_spec.md, tables 4, 3 and 7
Writes  evaluation         data_spec.md, table 11, as OUT/results/evaluation.parquet
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.metrics import Score, Track, chance, errors, score, standstill, trusted
from semslam.pipeline.cache import EntryIndex
from semslam.pipeline.console import table
from semslam.pipeline.files import TEMPORARY
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.record import LogRecord, load_records
from semslam.pipeline.run_tables import log_tables
from semslam.slam.verdict import OK
from semslam.tables.parquet import TableFiles, write_table
from semslam.tables.spec import EVALUATION, MOTION, OBSERVATIONS, POSES, TRUTH, Table

DEAD_RECKONING = "dead_reckoning"
CHANCE = "chance"
STANDSTILL = "standstill"
_SEED = 0


@dataclass(frozen=True)
class Line:
    """One estimator on one log."""

    log: str
    estimator: str
    score: Score


@dataclass(frozen=True)
class Evaluation:
    """All scores, what could not be scored, and where the table lies."""

    lines: tuple[Line, ...]
    notes: tuple[str, ...]
    path: Path

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        scores = [{"log": line.log, "estimator": line.estimator, **asdict(line.score)} for line in self.lines]
        return {"format": "semslam-evaluation", "version": 1, "scores": scores, "notes": list(self.notes)}

    def text(self) -> str:
        """For a terminal; with several logs, their mean as well."""
        head = ["LOG", "ESTIMATOR", "FRAMES", "COVERAGE", "APE", "DE", "WORST APE", "WORST DE", "OK", "OK WRONG"]
        rows = [_row(line) for line in (*self.lines, *_means(self.lines))]
        return table([head, *rows], left=(0, 1))


def evaluate_run(folder: OutputFolder) -> Evaluation:
    """Score every estimator on every log that has ground truth.

    Raises:
        SemslamError: no log has any, or a stored table is damaged.
    """
    index = EntryIndex(folder.cache)
    lines: list[Line] = []
    notes: list[str] = []
    records = load_records(folder.logs)
    failed = {name: reason for name, record in records.items() if (reason := _failure(record, TRUTH.stage))}
    for name, record in records.items():
        if name in failed:
            notes.append(f"{TRUTH.stage} of `{name}` failed: {failed[name]}")
            continue
        truth = _track(folder, index, record, TRUTH, "")
        if truth is None or not len(truth.frames):
            notes.append(f"`{name}` has no ground truth")
            continue
        lines += _score_log(folder, index, record, truth, notes)
    if not lines:
        raise SemslamError(
            f"No log of `{folder.root}` has both ground truth and poses",
            details="\n".join(notes),
            hint=f"`semslam status {folder.root}` shows what failed"
            if records and len(failed) == len(records)
            else "name the topic with `semslam run LOG --topic truth=/ground_truth`",
        )
    return Evaluation(tuple(lines), tuple(notes), _write(folder, lines))


def _score_log(
    folder: OutputFolder, index: EntryIndex, record: LogRecord, truth: Track, notes: list[str]
) -> Iterator[Line]:
    found: set[str] = set()
    known = [task.partition("/")[2] for task in record.tasks if task.split("/")[0] == POSES.stage]
    order: list[str] = record.config[POSES.stage]["estimators"]
    for estimator in sorted(known, key=lambda name: order.index(name) if name in order else len(order)):
        track = _track(folder, index, record, POSES, estimator)
        if track is None:
            reason = _failure(record, f"{POSES.stage}/{estimator}")
            notes.append(f"`{record.name}` has no poses of `{estimator}`" + (f": {reason}" if reason else ""))
            continue
        found.add(estimator)
        if _outdated(index, record, estimator):
            notes.append(f"poses of `{estimator}` for `{record.name}` are older than its observations; run again")
        yield Line(record.name, estimator, _judged(folder, index, record, estimator, truth, track))
    if DEAD_RECKONING not in found:
        motion = _rows(folder, index, record, MOTION, "", ("frame", "stamp_nanos", "dx_m", "dy_m", "dheading_rad"))
        if motion is None:
            notes.append(f"`{record.name}` has no motion for `{DEAD_RECKONING}`")
        else:
            yield Line(record.name, DEAD_RECKONING, score(truth, compose(motion)))
    yield Line(record.name, CHANCE, chance(truth, _map_half_m(record), _SEED))
    yield Line(record.name, STANDSTILL, standstill(truth))


def _judged(
    folder: OutputFolder, index: EntryIndex, record: LogRecord, estimator: str, truth: Track, track: Track
) -> Score:
    """The score of a track, and what became of the poses that it calls ok."""
    rows = _rows(folder, index, record, POSES, estimator, ("frame", "verdict")) or {"frame": [], "verdict": []}
    called = [frame for frame, verdict in zip(rows["frame"], rows["verdict"], strict=True) if verdict == OK]
    bounds = record.config[POSES.stage]
    found = score(truth, track)
    return trusted(found, errors(truth, track), called, bounds["ok_m"], math.degrees(bounds["ok_rad"]))


def compose(motion: Mapping[str, Sequence[Any]]) -> Track:
    """The track that the measured motions give, one after the other, from the columns of the motion table.

    As slam/dead_reckoning.py has it: the first keyframe stands at the origin, and one whose motion is unknown has no
    pose, while the last is held.
    """
    held: SE2 | None = None
    poses: list[tuple[float, float, float]] = []
    for step in zip(motion["dx_m"], motion["dy_m"], motion["dheading_rad"], strict=True):
        known = held is None or None not in step
        held = SE2(0.0, 0.0, 0.0) if held is None else held @ SE2(*step) if known else held
        poses.append((held.x_m, held.y_m, held.heading_rad) if known else (math.nan, math.nan, math.nan))
    columns = [[pose[axis] for pose in poses] for axis in range(3)]
    return Track.of(motion["frame"], motion["stamp_nanos"], *columns)


def _failure(record: LogRecord, task: str) -> str:
    """Why a task failed in the last run; empty if it did not."""
    found = record.tasks.get(task)
    return found.failure.message if found and found.failure else ""


def _track(folder: OutputFolder, index: EntryIndex, record: LogRecord, of: Table, variant: str) -> Track | None:
    """Poses of a table as a track; None if the log has none."""
    columns = ("frame", "stamp_nanos", "x_m", "y_m", "heading_rad")
    rows = _rows(folder, index, record, of, variant, columns)
    return None if rows is None else Track.of(*(rows[column] for column in columns))


def _rows(
    folder: OutputFolder, index: EntryIndex, record: LogRecord, of: Table, variant: str, columns: Sequence[str]
) -> dict[str, list[Any]] | None:
    """Columns of a table of a log; None if the log does not have the table."""
    files = log_tables(folder, index, record, (of,), variant).get(of.name)
    return None if files is None else TableFiles(of, files).read(columns)


def _outdated(index: EntryIndex, record: LogRecord, estimator: str) -> bool:
    """Whether the poses were made from other observations than the log has now."""
    task, source = record.tasks[f"{POSES.stage}/{estimator}"], record.tasks.get(OBSERVATIONS.stage)
    entry = index.find(OBSERVATIONS.stage, source.key) if source else None
    used = task.components.get("inputs", {}).get(OBSERVATIONS.name)
    return entry is not None and used != entry.tables.get(OBSERVATIONS.name)


def _map_half_m(record: LogRecord) -> float:
    """Half the side of the map that the estimators had, metres."""
    paper: Mapping[str, Any] = record.config[POSES.stage]["paper"]
    return float(paper["cell_m"]) * int(paper["map_side"]) / 2


def _write(folder: OutputFolder, lines: Sequence[Line]) -> Path:
    """Store the scores as a table, whole or not at all."""
    path = folder.results / f"{EVALUATION.name}.parquet"
    rows = [{"log": line.log, "estimator": line.estimator, **asdict(line.score)} for line in lines]
    temporary = path.with_name(f"{TEMPORARY}{path.name}-{os.getpid()}")
    write_table(
        temporary, EVALUATION, {column.name: [row[column.name] for row in rows] for column in EVALUATION.columns}
    )
    temporary.replace(path)
    return path


def _means(lines: Sequence[Line]) -> Iterator[Line]:
    """The mean over logs of every estimator; logs without a pose lower the coverage only."""
    if len({line.log for line in lines}) < 2:
        return
    for estimator in dict.fromkeys(line.estimator for line in lines):
        scores = [line.score for line in lines if line.estimator == estimator]
        yield Line(
            f"mean of {len(scores)}",
            estimator,
            Score(
                sum(one.frames for one in scores),
                sum(one.coverage for one in scores) / len(scores),
                _mean([one.ape_m for one in scores]),
                _mean([one.de_deg for one in scores]),
                _most([one.ape_worst_m for one in scores]),
                _most([one.de_worst_deg for one in scores]),
                sum(one.ok for one in scores) / len(scores),
                _mean([one.ok_wrong for one in scores], [one.ok * one.frames for one in scores]),
            ),
        )


def _mean(values: Sequence[float | None], weights: Sequence[float] = ()) -> float | None:
    """Of those that are known, weighted alike unless told otherwise; None without any."""
    weighted = zip(values, weights or [1.0] * len(values), strict=True)
    known = [(value, weight) for value, weight in weighted if value is not None]
    return sum(value * weight for value, weight in known) / sum(weight for _, weight in known) if known else None


def _most(values: Sequence[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _row(line: Line) -> list[str]:
    one = line.score
    return [
        line.log,
        line.estimator,
        f"{one.frames:,}",
        f"{one.coverage:.1%}",
        *(_metres(one.ape_m), _degrees(one.de_deg), _metres(one.ape_worst_m), _degrees(one.de_worst_deg)),
        f"{one.ok:.1%}",
        "-" if one.ok_wrong is None else f"{one.ok_wrong:.1%}",
    ]


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} deg"
