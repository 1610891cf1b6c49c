"""How error, time and memory of `surfel` grow with the length of a building: halls of 10 to 100 m, there and back.

    python benchmarks/extent.py [--metres 10 --metres 100 ...]

A hall of boxes is drawn by rays, 320 x 240 pixels with the noise of structured light, no depth beyond 6 m; the robot
drives to its end, turns and comes back, one keyframe half a metre, odometry with random and steady errors. On the way
back the camera looks the other way: only where the robot turned do pictures tie both ways. small_gicp on motion has the
same keyframes. Each length and method in a process of its own, one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from growth import SECOND, peak_mb
from machine import machine
from numpy.typing import NDArray

from semslam.bench import peers
from semslam.geometry.frames import FLU_FROM_OPTICAL, SE2, planar
from semslam.slam.estimator import Step, View
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.prior import Grid
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

LENGTHS_M = (10, 20, 50, 100)
HALF_WIDTH_M, HEIGHT_M, REACH_M = 2.5, 2.6, 6.0
BOX_EVERY_M = 0.8
STRIDE_M, TURNS = 0.5, 8
COLUMNS, ROWS, FOCAL_PX = 320, 240, 277.0
DISPARITY_NOISE = 0.002
BIAS = SE2(0.01, 0.0, 0.005)
NOISE = (0.02, 0.01, 0.015)
SEED = 0


@dataclass(frozen=True)
class Hall:
    """Boxes (N, 2, 3) along the walls of a hall from x = -1 to its length."""

    length_m: float
    boxes: Floats

    @staticmethod
    def of(length_m: float, seed: int) -> Hall:
        """Boxes of random size on either side."""
        random = np.random.default_rng(seed)
        placed = []
        for number in range(int((length_m + 1) / BOX_EVERY_M)):
            size = random.uniform((0.2, 0.2, 0.3), (0.9, 0.8, 2.0))
            middle = np.array([(number + random.uniform(0, 1)) * BOX_EVERY_M - 1.0, 0.0, 0.0])
            middle[1] = (HALF_WIDTH_M - size[1] / 2) * (1 if random.uniform() < 0.5 else -1)
            placed.append((middle - size * (0.5, 0.5, 0.0), middle + size * (0.5, 0.5, 1.0)))
        return Hall(length_m, np.array(placed))

    def depth(self, world_from_robot: Floats, random: np.random.Generator) -> NDArray[np.float32]:
        """(ROWS, COLUMNS) metres, 0 beyond the camera's reach."""
        column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
        x, y = (column - COLUMNS / 2) / FOCAL_PX, (row - ROWS / 2) / FOCAL_PX
        world_from_camera = world_from_robot @ robot_from_camera()
        origin, rays = world_from_camera[:3, 3], np.stack([x, y, np.ones_like(x)], -1) @ world_from_camera[:3, :3].T
        depth = self._hit(origin, rays)
        noisy = 1.0 / (1.0 / depth + DISPARITY_NOISE * random.standard_normal(depth.shape))
        return np.where(depth < REACH_M, noisy, 0.0).astype(np.float32)

    def _hit(self, origin: Floats, rays: Floats) -> Floats:
        low, high = np.array([-1.0, -HALF_WIDTH_M, 0.0]), np.array([self.length_m, HALF_WIDTH_M, HEIGHT_M])
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.maximum((low - origin) / rays, (high - origin) / rays).min(-1)
            for low, high in self.boxes[np.abs(self.boxes.mean(1)[:, 0] - origin[0]) < REACH_M + 1.0]:
                first, second = (low - origin) / rays, (high - origin) / rays
                enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
                depth = np.where((enter < leave) & (enter > 0.05), np.minimum(depth, enter), depth)
        return np.asarray(depth)


def robot_from_camera() -> Floats:
    """The camera looks ahead, half a metre above the floor."""
    pose = FLU_FROM_OPTICAL.copy()
    pose[:3, 3] = 0.05, 0.0, 0.5
    return pose


def drive(length_m: float) -> list[SE2]:
    """To the end of the hall but two metres, about, and back."""
    strides = int((length_m - 2.0) / STRIDE_M)
    ways = [SE2(STRIDE_M, 0.0, 0.0)] * strides
    poses = [SE2(0.0, 0.0, 0.0)]
    for step in (*ways, *[SE2(0.0, 0.0, math.pi / TURNS)] * TURNS, *ways):
        poses.append(poses[-1] @ step)
    return poses


def keyframes(length_m: float) -> Iterator[peers.Keyframe]:
    """What the robot sees and measures on the way."""
    random, hall, poses = np.random.default_rng(SEED), Hall.of(length_m, SEED), drive(length_m)
    motions: list[SE2 | None] = [None]
    for before, now in pairwise(poses):
        x, y, turn = random.standard_normal(3) * NOISE
        true = before.between(now)
        motions.append(
            SE2(true.x_m + BIAS.x_m + float(x), true.y_m + float(y), true.heading_rad + BIAS.heading_rad + float(turn))
        )
    intrinsics = FOCAL_PX, FOCAL_PX, COLUMNS / 2, ROWS / 2
    black = np.zeros((ROWS, COLUMNS, 3), np.uint8)
    for number, (pose, motion) in enumerate(zip(poses, motions, strict=True)):
        depth = hall.depth(pose.matrix, random)
        yield peers.Keyframe(number * SECOND, black, depth, intrinsics, robot_from_camera(), motion)


def surfel(length_m: float) -> tuple[float, list[SE2 | None]]:
    """Seconds, without drawing, and poses."""
    estimator, spent = SurfelEstimator(SurfelConfig(), Grid(("unobserved", "free_floor", "obstacle"), 0.1, 99)), 0.0
    for number, frame in enumerate(keyframes(length_m)):
        view = View(frame.rgb, frame.depth_m, *frame.intrinsics, frame.robot_from_camera)
        started = time.perf_counter()
        estimator.step(Step(number, frame.stamp_nanos, None, frame.motion, view))
        spent += time.perf_counter() - started
    started = time.perf_counter()
    found = estimator.finish()
    return spent + time.perf_counter() - started, [one.map_from_robot for one in found]


def small_gicp(length_m: float) -> tuple[float, list[SE2 | None]]:
    """The same of the peer, as the bench runs it."""
    frames = list(keyframes(length_m))
    started = time.perf_counter()
    found: list[SE2 | None] = [planar(pose) for pose in peers.small_gicp(iter(frames), Path())]
    return time.perf_counter() - started, found


def dead_reckoning(length_m: float) -> tuple[float, list[SE2 | None]]:
    """Motion alone."""
    poses: list[SE2 | None] = []
    pose = SE2(0.0, 0.0, 0.0)
    for frame in keyframes(length_m):
        pose = pose @ (frame.motion or SE2(0.0, 0.0, 0.0))
        poses.append(pose)
    return 0.0, poses


METHODS = {"surfel": surfel, "small_gicp": small_gicp, "dead_reckoning": dead_reckoning}


def one(length_m: float, method: str) -> dict[str, float]:
    """Errors, milliseconds a keyframe and memory of a method."""
    before = peak_mb()
    seconds, found = METHODS[method](length_m)
    true = drive(length_m)
    away = [t.between(pose) for t, pose in zip(true, found, strict=True) if pose is not None]
    metres = [math.hypot(error.x_m, error.y_m) for error in away]
    degrees = [math.degrees(abs(error.heading_rad)) for error in away]
    return {
        "keyframes": len(true),
        "coverage": len(away) / len(true),
        "mean_m": float(np.mean(metres)),
        "worst_m": max(metres),
        "mean_deg": float(np.mean(degrees)),
        "milliseconds": 1000 * seconds / len(true),
        "megabytes": peak_mb() - before,
    }


def measured(length_m: float, method: str) -> dict[str, float]:
    """The same in a process of its own, with one thread."""
    command = [sys.executable, __file__, "--metres", str(length_m), "--one", method]
    alone = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    found: dict[str, float] = json.loads(subprocess.run(command, check=True, capture_output=True, env=alone).stdout)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """All lengths, all methods."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metres", type=float, action="append", help="default: 10, 20, 50, 100")
    parser.add_argument("--peer-until", type=float, default=50, help="metres up to which small_gicp runs too")
    parser.add_argument("--one", choices=METHODS, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    lengths = args.metres or LENGTHS_M
    if args.one:
        print(json.dumps(one(lengths[0], args.one)))
        return
    print(machine("small_gicp") + f", seed {SEED}\n")
    print("| hall | keyframes | method | APE | worst | DE | with a pose | a keyframe | memory |")
    print("|---" * 9 + "|")
    for length_m in lengths:
        methods = [one for one in METHODS if one != "small_gicp" or length_m <= args.peer_until]
        told = {method: measured(length_m, method) for method in methods}
        peer = told["small_gicp"]["milliseconds"] if "small_gicp" in told else 0.0
        for method, row in told.items():
            ratio = f"{row['milliseconds'] / peer:.2f} x" if peer and row["milliseconds"] else "-"
            print(
                f"| {length_m:.0f} m | {row['keyframes']:.0f} | `{method}` | {row['mean_m']:.3f} m "
                f"| {row['worst_m']:.3f} m | {row['mean_deg']:.2f} deg | {row['coverage']:.0%} | {ratio} "
                f"| {row['megabytes']:.0f} MB |",
                flush=True,
            )


if __name__ == "__main__":
    main()
