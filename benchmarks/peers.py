"""Other packages on the keyframes that a run gave to its estimators: every log, beside the truth.

    semslam run LOGS --out OUT
    python benchmarks/peers.py OUT [--peer small_gicp]... [--log NAME]...

small_gicp comes with semslam; `pip install kiss-icp pyorbslam3` brings the others, and pyorbslam3 wants a vocabulary:
`PYORBSLAM3_VOCAB=ORBvoc.txt`. Nothing but the first keyframe is aligned. A keyframe without a pose counts in the
coverage alone; a package that crashes on a log has none there.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from machine import machine

from semslam.bench.peers import installed, track
from semslam.bench.tracks import column_track, track_of
from semslam.metrics import Score, score
from semslam.pipeline.run_tables import run_tables
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import FRAMES, MOTION, TRUTH

PEERS = ("small_gicp", "kiss_icp", "pyorbslam3")
ERRORS = ("ape_m", "de_deg", "ape_worst_m", "de_worst_deg")


def main() -> None:
    """Run them, and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder of a run")
    parser.add_argument("--peer", action="append", choices=PEERS, help="default: all that are installed")
    parser.add_argument("--log", action="append", help="default: all")
    args = parser.parse_args()
    chosen = args.peer or [peer for peer in PEERS if installed(peer)]
    print(machine(*chosen))
    print("\n| log | package | keyframes | with a pose | APE | DE | worst APE | worst DE |\n" + "|---" * 8 + "|")
    for peer in chosen:
        found: list[Score] = []
        for log, one in peer_scores(args.out, peer, args.log):
            print(line(log, peer, [one]), flush=True)
            found.append(one)
        print(line(f"mean of {len(found)}", peer, found), flush=True)


def peer_scores(run: Path, peer: str, logs: Sequence[str] | None = None) -> Iterator[tuple[str, Score]]:
    """A package on the logs of a run, one after the other."""
    for log, tables in run_tables(run, (FRAMES, MOTION, TRUTH), logs).items():
        if TRUTH.name not in tables:
            print(f"`{log}` has no truth", file=sys.stderr)
            continue
        truth = track_of(TableFiles(TRUTH, tables[TRUTH.name]))
        frames, motion = tables[FRAMES.name], tables[MOTION.name]
        arguments = {"peer": peer, "frames": frames, "motion": motion, "steps": len(truth.frames)}
        found = tracked(arguments)
        yield (
            log,
            score(truth, column_track(found, truth))
            if found
            else Score(len(truth.frames), 0.0, None, None, None, None),
        )


def tracked(arguments: Mapping[str, Any]) -> dict[str, Any] | None:
    """The columns of a track, by a process of its own; None if that crashed."""
    spawned = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as temporary, ProcessPoolExecutor(1, mp_context=spawned) as pool:
        try:
            return pool.submit(track, arguments, Path(temporary)).result()
        except BrokenProcessPool:
            return None


def line(name: str, peer: str, scores: Sequence[Score]) -> str:
    """A row: means over logs that have poses, and the worst keyframes."""
    keyframes = sum(one.frames for one in scores)
    coverage = sum(one.coverage * one.frames for one in scores) / max(1, keyframes)
    metres, degrees, far, turned = ([getattr(one, name) for one in scores if one.ape_m is not None] for name in ERRORS)
    cells = ["-"] * 4
    if metres:
        mean_m, mean_deg = sum(metres) / len(metres), sum(degrees) / len(degrees)
        cells = [f"{mean_m:.3f} m", f"{mean_deg:.2f} deg", f"{max(far):.3f} m", f"{max(turned):.2f} deg"]
    return " | ".join([f"| {name}", f"`{peer}`", str(keyframes), f"{coverage:.1%}", *cells]) + " |"


if __name__ == "__main__":
    main()
