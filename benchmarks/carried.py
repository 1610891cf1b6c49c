"""Robots that are picked up within a log and set down elsewhere: is what comes after found, and what is said of it?

    semslam run homes/logs/home_01_t0.mcap ... --out OUT
    python benchmarks/carried.py homes --out OUT [--log NAME]... [--after 30] [--gap 20]

Of each log `--gap` keyframes are taken out after the first `--after`, once with odometry that tells nothing of it, and
once with wheels that claim to have stood still. A keyframe counts as right within 0.1 m and 2 degrees of the truth, in
the frame of the first one.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from machine import machine

from semslam.bench.tracks import true_track
from semslam.geometry.frames import SE2
from semslam.metrics import Track
from semslam.pipeline.run_tables import LogTables, run_tables
from semslam.slam.estimator import PoseEstimate, Step
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.prior import Grid
from semslam.slam.verdict import OK, verdict_of
from semslam.stages.localize import read_steps
from semslam.stages.settings import LocalizeConfig
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import FRAMES, MOTION, OBSERVATIONS

NEAR_M, NEAR_DEG = 0.1, 2.0
MOTIONS = {"odometry that tells nothing": None, "wheels at rest": SE2(0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Outcome:
    """Of the keyframes after the gap."""

    frames: int
    posed: int
    right: int
    called_ok: int
    wrong: int
    """Called ok and not right, before the gap or after it."""
    median_m: float
    worst_wrong_m: float


def main() -> None:
    """All logs, both ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("homes", type=Path, help="folder of `semslam simulate`")
    parser.add_argument("--out", type=Path, required=True, help="output folder of a run over its logs")
    parser.add_argument("--log", action="append", help="default: all of the run")
    parser.add_argument("--after", type=int, default=30)
    parser.add_argument("--gap", type=int, default=20)
    args = parser.parse_args()
    print(machine() + "\n")
    print("| log | | after the gap | with a pose | right | called ok | called ok, wrongly | median error |")
    print("|---" * 8 + "|")
    for log, tables in run_tables(args.out, (MOTION, OBSERVATIONS, FRAMES), args.log).items():
        steps, grid = read(tables)
        truth = true_track(args.homes, log)
        for name, motion in MOTIONS.items():
            rest = steps[args.after + args.gap :]
            carried = [*steps[: args.after], replace(rest[0], motion=motion), *rest[1:]]
            tell(log, name, outcome(carried, grid, truth, args.after))


def read(tables: LogTables) -> tuple[list[Step], Grid]:
    """All keyframes of a log as an estimator gets them, and what their observations are made of."""
    motion, observations, frames = (TableFiles(table, tables[table.name]) for table in (MOTION, OBSERVATIONS, FRAMES))
    grid = Grid.of(observations.meta)
    shape = len(grid.classes), grid.side, grid.side
    return list(read_steps(motion, observations, frames, shape, 0, motion.rows)), grid


def outcome(steps: Sequence[Step], grid: Grid, truth: Track, after: int) -> Outcome:
    """Localise, and compare with the truth."""
    config = LocalizeConfig()
    estimator = SurfelEstimator(config.surfel, grid)
    for step in steps:
        estimator.step(step)
    found = estimator.finish()
    away = [error(step.frame, pose, truth) for step, pose in zip(steps, found, strict=True)]
    near = [one is not None and one[0] <= NEAR_M and one[1] <= NEAR_DEG for one in away]
    ok = [verdict_of(pose, config.ok_m, config.ok_rad) == OK for pose in found]
    wrong = [one[0] for one, sure, right in zip(away, ok, near, strict=True) if one and sure and not right]
    known = [one[0] for one in away[after:] if one]
    return Outcome(
        frames=len(steps) - after,
        posed=len(known),
        right=sum(near[after:]),
        called_ok=sum(ok[after:]),
        wrong=len(wrong),
        median_m=float(np.median(known)) if known else math.nan,
        worst_wrong_m=max(wrong, default=0.0),
    )


def error(frame: int, estimate: PoseEstimate, truth: Track) -> tuple[float, float] | None:
    """Metres and degrees from the true pose in the first keyframe's frame; None without a pose."""
    if estimate.map_from_robot is None:
        return None
    at = int(np.searchsorted(truth.frames, frame))
    first, true = (SE2(truth.x_m[i], truth.y_m[i], truth.heading_rad[i]) for i in (0, at))
    apart = first.between(true).between(estimate.map_from_robot)
    return math.hypot(apart.x_m, apart.y_m), math.degrees(abs(apart.heading_rad))


def tell(log: str, name: str, found: Outcome) -> None:
    """A row."""
    wrong = f"{found.wrong}" + (f" (up to {found.worst_wrong_m:.2f} m)" if found.wrong else "")
    median = "-" if math.isnan(found.median_m) else f"{found.median_m:.3f} m"
    print(
        f"| {log} | {name} | {found.frames} | {found.posed} | {found.right} | {found.called_ok} | {wrong} | {median} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
