"""Do the depth images of a log agree with each other, and with its truth?

    semslam run LOG --out OUT
    python benchmarks/closure.py OUT [--log NAME] [--focal 0.96]...

Three keyframes are aligned two by two with small_gicp, from the poses that truth gives them. Had alignment no error,
going round the three would lead back to where it began: what is left is the error of three alignments, and knows
nothing of the truth. Beside it stands how far an alignment of two neighbours is from the truth. If that is much larger,
either the truth is that wrong, or depth is in a way that all three share, such as a wrong focal length: `--focal`
multiplies it.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import small_gicp
from machine import machine
from numpy.typing import NDArray

from semslam.bench.peers import Keyframe, keyframes
from semslam.bench.tracks import track_of
from semslam.geometry.frames import SE2, invert, planar
from semslam.pipeline.run_tables import run_tables
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import FRAMES, MOTION, TRUTH

VOXEL_M, REACH_M = 0.04, 0.15

Matrix = NDArray[np.float64]


def main() -> None:
    """Compare what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--log", action="append", help="default: all logs")
    parser.add_argument("--focal", type=float, action="append", default=[1.0])
    args = parser.parse_args()
    print(machine("small_gicp"))
    print(
        "\n| log | focal length | triangles | round a triangle | neighbours, beside the truth |\n|---|---|---|---|---|"
    )
    for log, tables in run_tables(args.out, (FRAMES, MOTION, TRUTH), args.log).items():
        if TRUTH.name not in tables:
            print(f"| {log} | no truth | - | - | - |")
            continue
        truth = track_of(TableFiles(TRUTH, tables[TRUTH.name])).by_stamp()
        frames = [one for one in keyframes(tables[FRAMES.name], tables[MOTION.name]) if one.stamp_nanos in truth]
        for focal in args.focal:
            rounds, beside = compared([zoomed(one, focal) for one in frames], truth)
            print(f"| {log} | x {focal:g} | {len(rounds)} | {middle(rounds)} | {middle(beside)} |", flush=True)


def zoomed(frame: Keyframe, focal: float) -> Keyframe:
    """As if its camera had another focal length."""
    fx, fy, cx, cy = frame.intrinsics
    return replace(frame, intrinsics=(fx * focal, fy * focal, cx, cy))


def compared(frames: Sequence[Keyframe], truth: dict[int, SE2]) -> tuple[list[SE2], list[SE2]]:
    """What is left of each triangle of keyframes that follow each other, and of neighbours beside the truth."""
    poses = [truth[frame.stamp_nanos] for frame in frames]
    clouds = [small_gicp.preprocess_points(frame.cloud, VOXEL_M) for frame in frames]

    def aligned(first: int, second: int) -> Matrix:
        (target, tree), (source, _) = clouds[first], clouds[second]
        start = poses[first].between(poses[second]).matrix
        found = small_gicp.align(target, source, tree, start, max_correspondence_distance=REACH_M)
        return np.asarray(found.T_target_source)

    steps = [aligned(index, index + 1) for index in range(len(frames) - 1)]
    rounds = [planar(steps[i] @ steps[i + 1] @ invert(aligned(i, i + 2))) for i in range(len(frames) - 2)]
    beside = [poses[i].between(poses[i + 1]).between(planar(step)) for i, step in enumerate(steps)]
    return rounds, beside


def middle(away: Sequence[SE2]) -> str:
    """Medians."""
    if not away:
        return "-"
    metres, degrees = zip(*sizes(away), strict=True)
    return f"{np.median(metres):.3f} m, {np.median(degrees):.2f} deg"


def sizes(away: Sequence[SE2]) -> Iterator[tuple[float, float]]:
    """Metres and degrees."""
    for one in away:
        yield math.hypot(one.x_m, one.y_m), math.degrees(abs(one.heading_rad))


if __name__ == "__main__":
    main()
