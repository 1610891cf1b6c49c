"""Time a keyframe and memory of `surfel`, beside small_gicp on motion, and how both grow with the length of a log.

    semslam localize LOG --out OUT
    python benchmarks/growth.py OUT [--log NAME] [--frames 30 --frames 300 ...]

The keyframes of the log, there and back again and again, until there are so many; each length and method in a process
of its own, one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from machine import machine

from semslam.bench.peers import Keyframe, keyframes
from semslam.geometry.frames import SE2
from semslam.pipeline.run_tables import run_tables
from semslam.slam.estimator import Step, View
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.prior import Grid
from semslam.stages.settings import SurfelConfig
from semslam.tables.spec import FRAMES, MOTION

SECOND = 1_000_000_000


def main() -> None:
    """All lengths, both methods."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--log", default="", help="default: the first")
    parser.add_argument("--frames", type=int, action="append", help="default: 30, 100, 300, 1000, 3000")
    parser.add_argument("--peer-until", type=int, default=300, help="keyframes up to which small_gicp runs too")
    parser.add_argument("--one", choices=METHODS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    lengths = args.frames or [30, 100, 300, 1000, 3000]
    if args.one:
        print(json.dumps(METHODS[args.one](args.out, args.log, lengths[0])))
        return
    print(machine("small_gicp"))
    print("\n| keyframes | surfel: walk | align all | memory | small_gicp | memory | ratio of time |")
    print("|---" * 7 + "|")
    for length in lengths:
        ours = measured(args.out, args.log, length, "surfel")
        walk, align = (1000 * value / length for value in ours[:2])
        peer = "| - | - | - |"
        if length <= args.peer_until:
            theirs = measured(args.out, args.log, length, "small_gicp")
            ratio = (ours[0] + ours[1]) / theirs[0]
            peer = f"| {1000 * theirs[0] / length:.0f} ms | {theirs[2]:.0f} MB | {ratio:.2f} |"
        print(f"| {length:,} | {walk:.0f} ms | {align:.0f} ms | {ours[2]:.0f} MB {peer}", flush=True)


def measured(out: Path, log: str, length: int, method: str) -> list[float]:
    """Seconds of walking and of aligning, and megabytes above those of the imports, in a process of its own."""
    command = [sys.executable, __file__, str(out), "--log", log, "--frames", str(length), "--one", method]
    alone = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=alone)
    found: list[float] = json.loads(done.stdout)
    return found


def surfel(out: Path, log: str, length: int) -> list[float]:
    """Of the default estimator; decoding pictures is not counted."""
    estimator = SurfelEstimator(SurfelConfig(), Grid(("unobserved", "free_floor", "obstacle"), 0.1, 99))
    whole = first_keyframes(out, log)
    before, walked = peak_mb(), 0.0
    for number, frame in enumerate(there_and_back(whole, length)):
        view = View(frame.rgb, frame.depth_m, *frame.intrinsics, frame.robot_from_camera)
        started = time.perf_counter()
        estimator.step(Step(number, number * SECOND, None, frame.motion, view))
        walked += time.perf_counter() - started
    started = time.perf_counter()
    estimator.finish()
    return [walked, time.perf_counter() - started, peak_mb() - before]


def small_gicp(out: Path, log: str, length: int) -> list[float]:
    """Of the peer, as the bench runs it."""
    from semslam.bench import peers

    whole = first_keyframes(out, log)
    before, started = peak_mb(), time.perf_counter()
    for _ in peers.small_gicp(there_and_back(whole, length), out):
        pass
    return [time.perf_counter() - started, 0.0, peak_mb() - before]


METHODS = {"surfel": surfel, "small_gicp": small_gicp}


def first_keyframes(out: Path, log: str) -> list[Keyframe]:
    """At most 80 keyframes of a log, decoded."""
    found = run_tables(out, (FRAMES, MOTION), [log] if log else None)
    tables = next(iter(found.values()), {})
    if len(tables) < 2:
        raise SystemExit(f"the run has no keyframes of `{log}`" if log else "the run has no keyframes")
    return list(islice(keyframes(tables[FRAMES.name], tables[MOTION.name]), 80))


def there_and_back(whole: Sequence[Keyframe], length: int) -> Iterator[Keyframe]:
    """The keyframes of a log, forwards, backwards, forwards, ..., with the motion between them."""
    place, way = 0, 1
    for number in range(length):
        yield replace(whole[place], motion=between(whole, place, way) if number else None)
        way = -way if not 0 <= place + way < len(whole) else way
        place += way


def between(whole: Sequence[Keyframe], place: int, way: int) -> SE2 | None:
    """Measured motion to a keyframe, from the one before on the way."""
    if way > 0:
        return whole[place].motion
    motion = whole[place + 1].motion
    return motion.inverse() if motion else None


def peak_mb() -> float:
    """Most memory so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
