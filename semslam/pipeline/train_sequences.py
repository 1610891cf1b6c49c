"""`semslam train mapnet` and `semslam train deepvo`: from a data set and a run over its logs to a trained network.

Reads   splits, truth    data_spec.md, tables 12 and 4, of a data set
        frames, motion   tables 2 and 3, of a run of `semslam ingest` over its logs

What comes out is judged as it will be used: its estimator, opened from the exported file, walks the drives that test,
beside dead reckoning, standing still and chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from semslam.errors import SemslamError
from semslam.metrics import Score, Track, chance, score, standstill
from semslam.models.training.drives import PARTS, logs_of
from semslam.models.training.runs import SEQUENCES, Run, require_place, train_on_pictures
from semslam.models.training.scores import mean
from semslam.models.training.sequences import DriveFiles, drive_files
from semslam.pipeline.console import Console
from semslam.pipeline.evaluate import compose
from semslam.pipeline.run_tables import run_tables
from semslam.pipeline.train_request import DrivesRequest
from semslam.pipeline.train_view import LogsView, TrainingView
from semslam.slam.deepvo_estimator import DeepVoEstimator
from semslam.slam.estimator import Estimator, Step
from semslam.slam.mapnet_estimator import MapNetEstimator
from semslam.slam.views import view_of
from semslam.tables.parquet import TableFiles, rows_of
from semslam.tables.spec import FRAMES, MOTION, TRUTH

SCORED = 30
"""Keyframes of a drive that are scored, from its start: those of the paper's test sequences."""
_VIEW = ("frame", "stamp_nanos", "colour", "depth", "fx", "fy", "cx", "cy", "robot_from_camera")
ESTIMATORS: dict[str, Callable[[Path], Estimator]] = {
    "mapnet": lambda model: MapNetEstimator(model, modes=1),
    "deepvo": DeepVoEstimator,
}
"""What runs an exported file."""


@dataclass(frozen=True)
class UnseenDrive:
    """A drive to judge on; tracks of its scored keyframes."""

    frames: tuple[Path, ...]
    """Shards of its frames table."""
    truth: Track
    reckoned: Track
    """By the measured motion."""


def train_sequences(console: Console, task: str, request: DrivesRequest) -> list[Path]:
    """Read the drives, train `mapnet` or `deepvo`, and judge on the logs that test; the files written.

    Raises:
        SemslamError: data set and run do not fit together, or the folder holds another training.
    """
    require_place(request.out, request.device)
    files, unseen = drives_of(request)
    schedule = request.schedule_from(SEQUENCES[task].defaults)
    command = request.typed(task, schedule, f"--protocol {request.protocol}")
    reading, training, walking = LogsView(console), TrainingView(console), LogsView(console)
    with closing(reading), closing(training), closing(walking):

        def opened(done: int, logs: int) -> None:
            reading.progressed(done, logs)
            if done == logs:  # its bar makes room for that of the training
                reading.close()

        def judge(model: Path) -> list[str]:
            training.close()
            return judged(task, model, unseen, lambda done, logs: walking.show(done, logs, "judged"))

        asked = (request.dataset, request.out, schedule, request.threads, request.device, training.progressed)
        return train_on_pictures(task, Run(*asked, command=command), files, judge, opened)


def drives_of(request: DrivesRequest) -> tuple[list[DriveFiles], list[UnseenDrive]]:
    """Where the drives to learn from lie, and those to judge on; all is found before the work of hours begins.

    Raises:
        SemslamError: no data set, no run, or logs that it lacks.
    """
    if request.run_folder is None:
        raise SemslamError(
            "Pictures come from a run over the logs of the data set",
            hint=f"`semslam ingest {request.dataset / 'logs'} --out RUN`, then `--run RUN`",
        )
    train, test = (logs_of(request.dataset, request.protocol, part) for part in PARTS)
    tables = run_tables(request.run_folder, (FRAMES, MOTION), (*train, *test))
    frames = {log: files.get(FRAMES.name, ()) for log, files in tables.items()}
    files, unseen = (drive_files(request.dataset, logs, frames) for logs in (train, test))
    return files, [_unseen(one, tables[one.name].get(MOTION.name, ())) for one in unseen]


def _unseen(files: DriveFiles, motion: Sequence[Path]) -> UnseenDrive:
    rows = TableFiles(MOTION, motion).read(["frame", "stamp_nanos", "dx_m", "dy_m", "dheading_rad"])
    rows = {name: column[:SCORED] for name, column in rows.items()}
    return UnseenDrive(files.frames, _truth(files, rows["frame"], rows["stamp_nanos"]), compose(rows))


def _truth(files: DriveFiles, frames: Sequence[int], stamps: Sequence[int]) -> Track:
    """The true track of keyframes; those of which there is no truth are left out.

    Raises:
        SemslamError: there is none of any.
    """
    true = TableFiles(TRUTH, files.truth).read(["stamp_nanos", "x_m", "y_m", "heading_rad"])
    row_at = {stamp: row for row, stamp in enumerate(true["stamp_nanos"])}
    known = [(frame, stamp) for frame, stamp in zip(frames, stamps, strict=True) if stamp in row_at]
    if not known:
        raise SemslamError(
            f"The data set has no true pose for any keyframe of `{files.name}`",
            hint="name the run over this very data set: `semslam ingest DATASET/logs --out RUN`",
        )
    poses = ([true[name][row_at[stamp]] for _, stamp in known] for name in ("x_m", "y_m", "heading_rad"))
    return Track.of(*zip(*known, strict=True), *poses)


def judged(
    task: str, model: Path, drives: Sequence[UnseenDrive], watch: Callable[[int, int], None] | None = None
) -> list[str]:
    """What an exported network is worth on drives that test, as paragraphs of Markdown."""
    scores: dict[str, list[Score]] = {name: [] for name in (task, "dead reckoning", "standing still", "chance")}
    for done, drive in enumerate(drives, 1):
        walked = walk(ESTIMATORS[task](model), drive.frames, SCORED)
        truth = drive.truth
        found = score(truth, walked), score(truth, drive.reckoned), standstill(truth), chance(truth)
        for name, one in zip(scores, found, strict=True):
            scores[name].append(one)
        if watch:
            watch(done, len(drives))
    text = (
        f"The first {SCORED} keyframes of {len(drives)} drives that test, from the true start and without alignment; "
        "means over drives. Dead reckoning composes the motion that the robot measured, which the network is not given:"
    )
    return [text, _table(scores)]


def _table(scores: Mapping[str, Sequence[Score]]) -> str:
    """Markdown, a track a line."""
    rows = ["| track | position error (APE), m | heading error (DE), degrees | with a pose |", "|---|---|---|---|"]
    for name, found in scores.items():
        distance, turn = mean(one.ape_m for one in found), mean(one.de_deg for one in found)
        coverage = mean(one.coverage for one in found) or 0.0
        rows.append(f"| {name} | {_shown(distance, 2)} | {_shown(turn, 1)} | {coverage:.0%} |")
    return "\n".join(rows)


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def walk(estimator: Estimator, frames: Sequence[Path], steps: int) -> Track:
    """The track that an estimator gives from the pictures of the first keyframes of a log."""
    rows: list[tuple[int, int, float, float, float]] = []
    for step in _steps(frames, steps):
        pose = estimator.step(step).map_from_robot
        place = (pose.x_m, pose.y_m, pose.heading_rad) if pose else (math.nan,) * 3
        rows.append((step.frame, step.stamp_nanos, *place))
    return Track.of(*zip(*rows, strict=True)) if rows else Track.of([], [], [], [], [])


def _steps(frames: Sequence[Path], steps: int) -> Iterator[Step]:
    """The first keyframes of a frames table, with nothing but their views."""
    rows = rows_of(TableFiles(FRAMES, frames).batches(_VIEW, batch_rows=8))
    for row in islice(rows, steps):
        yield Step(row["frame"], row["stamp_nanos"], None, None, view_of(row))
