"""Is the truth as far from the poses as their covariances say, and are those right that are called ok?

    semslam run HOMES/logs/... --out OUT
    python benchmarks/calibration.py OUT HOMES [OUT HOMES]...

HOMES is a folder of `semslam simulate`. For each pose the squared Mahalanobis distance of the truth, of x, y and
heading, over 3: 1 on average if covariances are right, 0.79 at the median, and 2.6 or less in 95 of 100 (chi square
with three degrees of freedom). Below, poses sorted by how wide the region is that holds the truth with 95 %
probability, in bounds of 0.1 m and 2 degrees: up to 1 they are called ok; and how many of them are within these bounds.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from machine import machine

from semslam.bench.tracks import true_track
from semslam.geometry.frames import SE2
from semslam.pipeline.run_tables import run_tables
from semslam.slam.estimator import VISUAL, PoseEstimate
from semslam.slam.verdict import OK, verdict_of
from semslam.stages.settings import LocalizeConfig
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import POSES

EDGES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, math.inf)
COLUMNS = ("stamp_nanos", "x_m", "y_m", "heading_rad", "covariance")


@dataclass(frozen=True)
class Told:
    """A pose beside the truth."""

    surprise: float
    """Squared Mahalanobis distance over its degrees of freedom."""
    width: float
    """Of the region that holds the truth with 95 % probability, in bounds."""
    within: bool


def main() -> None:
    """Compare what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT HOMES")
    args = parser.parse_args()
    if len(args.folders) % 2:
        parser.error("name an output folder and its data set, in pairs")
    print(machine())
    print("\n| logs | poses | mean | median | 95 % | most |\n" + "|---" * 6 + "|")
    found: list[Told] = []
    for out, homes in zip(args.folders[::2], args.folders[1::2], strict=True):
        files = {log: tables.get(POSES.name) for log, tables in run_tables(out, (POSES,), variant="surfel").items()}
        known = {log: list(poses(paths, homes, log)) for log, paths in files.items() if paths}
        whole = [one for told in known.values() for one in told]
        print(line(f"{len(known)} of {len(files)} of {homes.name}", whole), flush=True)
        found += whole
    print(line("all", found))
    print("\n| 95 % region, in bounds | poses | within bounds |\n|---|---|---|")
    for low, high in pairwise(EDGES):
        chosen = [one.within for one in found if low < one.width <= high]
        print(f"| {low:g} to {high:g} | {len(chosen)} | {f'{np.mean(chosen):.1%}' if chosen else '-'} |")


def poses(files: Sequence[Path], homes: Path, log: str) -> Iterator[Told]:
    """Those of a log but for the first, which is the map's frame."""
    config = LocalizeConfig()
    true = true_track(homes, log).by_stamp()
    start = true[min(true)]
    rows = TableFiles(POSES, files).read(COLUMNS)
    for stamp, x, y, heading, error in list(zip(*rows.values(), strict=True))[1:]:
        if x is None or not error:
            continue
        pose, truth = SE2(x, y, heading), start.between(true[stamp])
        apart = truth.between(pose)
        off = np.array([pose.x_m - truth.x_m, pose.y_m - truth.y_m, apart.heading_rad])
        near = math.hypot(apart.x_m, apart.y_m) <= config.ok_m and abs(apart.heading_rad) <= config.ok_rad
        surprise = float(off @ np.linalg.solve(np.array(error).reshape(3, 3), off)) / 3
        yield Told(surprise, width(PoseEstimate(pose, VISUAL, covariance=tuple(error)), config), near)


def width(estimate: PoseEstimate, config: LocalizeConfig) -> float:
    """The factor by which both bounds must be multiplied for the pose to be just called ok."""
    low, high = 0.0, 1e3
    for _ in range(40):
        middle = (low + high) / 2
        ok = verdict_of(estimate, middle * config.ok_m, middle * config.ok_rad) == OK
        low, high = (low, middle) if ok else (middle, high)
    return high


def line(name: str, told: Sequence[Told]) -> str:
    """A row."""
    values = [one.surprise for one in told]
    cells = [np.mean(values), np.median(values), np.percentile(values, 95), max(values)] if values else []
    return " | ".join([f"| {name}", str(len(told)), *([f"{cell:.2f}" for cell in cells] or ["-"] * 4)]) + " |"


if __name__ == "__main__":
    main()
