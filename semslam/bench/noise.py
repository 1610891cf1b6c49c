"""More and less noise of IMU and wheels than the logs have, from the same logs.

The error of each measured motion against the true one is multiplied by the level: 0 gives exact motion, 1 the motion as
it was measured, 3 three times the noise and bias. Observations stay as they are. Estimators then run as in `localize`,
outside the pipeline, since no log holds such motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from semslam.bench.localising import settings_of, track_errors
from semslam.bench.maps import paper_settings
from semslam.bench.networks import Networks
from semslam.bench.results import NoiseScore, NotRun
from semslam.bench.rows import ALL, NOISE_LEVELS, NOISE_ROWS, Row
from semslam.bench.store import Part
from semslam.bench.tracks import column_track, scored, true_track
from semslam.bench.work import Work, where
from semslam.errors import SemslamError
from semslam.geometry.frames import SE2, wrap_angle
from semslam.geometry.grid import Planes, to_dense
from semslam.labels import UNOBSERVED
from semslam.models.training.drives import simulating
from semslam.slam.estimator import Step
from semslam.slam.registry import open_estimator
from semslam.stages.settings import LocalizeConfig, PaperConfig
from semslam.tables.parquet import TableFiles, made_by, rows_of
from semslam.tables.spec import MOTION, OBSERVATIONS, TRUTH

TASK = "semslam.bench.noise:track"
VERSION = 1


def noise_tracks(work: Work, networks: Networks, missing: list[NotRun]) -> Iterator[NoiseScore]:
    """Scores across scenes of the rows that use motion, at every level."""
    parts: dict[tuple[str, float, int], Part] = {}
    for row in (ALL[name] for name in NOISE_ROWS):
        for seed in work.seeds if row.network else (0,):
            try:
                settings = settings_of(work, row, "cross", seed, networks)
            except SemslamError as error:
                missing.append(NotRun(row.name, where("noise", seed), error.in_a_line))
                continue
            for level in NOISE_LEVELS:
                parts[row.name, level, seed] = _part(work, row, level, seed, settings, networks)
    outcomes = work.do(list(parts.values()))
    for (name, level, seed), part in parts.items():
        outcome = outcomes[part.key]
        if outcome.result is None:
            missing.append(NotRun(name, where(f"noise {level:g}", seed), outcome.reason))
            continue
        for log, columns in outcome.result.items():
            truth = true_track(work.dataset.root, log, work.request.steps)
            found = track_errors(truth, column_track(columns, truth))
            yield NoiseScore(level, scored(ALL[name], "cross", seed, log, truth, found))


def _part(work: Work, row: Row, level: float, seed: int, settings: Mapping[str, Any], networks: Networks) -> Part:
    logs = work.dataset.test["cross"]
    paper = paper_settings(work.pipeline.paper(settings))
    outcome = networks.get((row.network, "cross", "real", seed))
    shared = {"logs": list(logs), "estimator": row.estimator, "level": level, "steps": work.request.steps}
    facts = {
        **shared,
        "version": VERSION,
        "paper": {**paper, "model": ""},
        "network": outcome.result["digest"] if outcome and outcome.result else "",
        "inputs": work.inputs(logs, observed=True),
    }
    arguments = {**shared, "dataset": str(work.dataset.root), "run": work.run_files(logs), "paper": paper}
    title = f"{row.name} with {level:g} times the noise" + (f", seed {seed}" if seed else "")
    return Part("noise", title, facts, TASK, arguments)


def track(arguments: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Tracks of an estimator at a level: columns by log.

    Args:
        arguments: dataset, logs, run ({log: [motion files, observation files]}), estimator, paper (its settings),
            level, steps.
        folder: not used; nothing but the result is kept.
    """
    del folder
    paper = PaperConfig(**arguments["paper"])
    config = LocalizeConfig(estimators=(arguments["estimator"],), paper=paper)
    return {log: _one(arguments, log, config) for log in arguments["logs"]}


def _one(arguments: Mapping[str, Any], log: str, config: LocalizeConfig) -> dict[str, list[float]]:
    motion, seen = ([Path(file) for file in files] for files in arguments["run"][log])
    sights = TableFiles(OBSERVATIONS, seen)
    classes, side = tuple(sights.meta["classes"]), int(sights.meta["side"])
    estimator = open_estimator(config.estimators[0], config, classes, float(sights.meta["cell_m"]), side)
    columns: dict[str, list[float]] = {name: [] for name in ("stamp_nanos", "x_m", "y_m", "heading_rad")}
    observed = dict(_observed(sights, (len(classes), side, side)))
    moves = list(_motions(motion, Path(arguments["dataset"]) / "truth" / log / "truth.parquet", arguments["level"]))
    for frame, (stamp, moved) in enumerate(moves[: arguments["steps"]]):
        pose = estimator.step(Step(frame, stamp, observed.get(stamp), moved)).map_from_robot
        if pose is not None:
            for name, value in zip(columns, (stamp, pose.x_m, pose.y_m, pose.heading_rad), strict=True):
                columns[name].append(value)
    return columns


def _observed(table: TableFiles, shape: tuple[int, int, int]) -> Iterator[tuple[int, Planes]]:
    """Stamps and dense observations."""
    for row in rows_of(table.batches(["stamp_nanos", "cells", "weights"])):
        planes = to_dense(np.array(row["cells"], np.uint32), np.array(row["weights"], np.float32), shape)
        planes[UNOBSERVED] = ~planes[1:].any(0)
        yield row["stamp_nanos"], planes


def _motions(motion: list[Path], truth: Path, level: float) -> Iterator[tuple[int, SE2 | None]]:
    """Stamps of all keyframes and the motion to each, with its error multiplied."""
    with made_by(simulating(truth.parents[2])):
        rows = TableFiles(TRUTH, [truth]).read(["stamp_nanos", "x_m", "y_m", "heading_rad"])
    poses = {stamp: SE2(*pose) for stamp, *pose in zip(*rows.values(), strict=True)}
    before: SE2 | None = None
    moved = TableFiles(MOTION, motion).read(["stamp_nanos", "dx_m", "dy_m", "dheading_rad"])
    for stamp, *parts in zip(*moved.values(), strict=True):
        now, measured = poses.get(stamp), None if None in parts else SE2(*parts)
        if before is not None and now is not None and measured is not None:
            measured = scaled(before.between(now), measured, level)
        yield stamp, measured
        before = now


def scaled(true: SE2, measured: SE2, level: float) -> SE2:
    """A measured motion with its error multiplied; as it was for level 1."""
    if level == 1.0:
        return measured
    error = true.between(measured)
    return true @ SE2(level * error.x_m, level * error.y_m, wrap_angle(level * error.heading_rad))
