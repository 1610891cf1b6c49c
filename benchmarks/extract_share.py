"""How long each model takes for a frame, and how much of extract's time passes outside ONNX Runtime.

    python benchmarks/extract_share.py [LOG] [--detector FILE.onnx] [--classes FILE.txt] [--segmenter NAME]
        [--encoder FILE.onnx --decoder FILE.onnx] [--batch 1] [--rounds 5] [--quick]

Without options, the demo's log and the shipped models. Extract runs whole, from the tables it reads to those it writes,
in this process and with one thread for every library. The baseline is ONNX Runtime alone, with the same tensors, in the
same process; both take turns, and the best round of each counts. Opening the models, once a log, is left out of both.

Extract decodes the next keyframe and projects the last one in threads while the models look at this one: the share of
wall time shows it where processors are free for them, the share of CPU time never does.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from machine import machine

from semslam.models.builtin import with_shipped
from semslam.models.session import Session
from semslam.pipeline.cache import table_files
from semslam.pipeline.demo import demo_log
from semslam.pipeline.job import InputFile, Job
from semslam.pipeline.threads import ONE_THREAD
from semslam.pipeline.worker import execute
from semslam.stages.catalogue import EXTRACT
from semslam.stages.extract import Eyes
from semslam.stages.settings import ExtractConfig


@dataclass(frozen=True)
class Cost:
    """Of some work."""

    wall_s: float
    cpu_s: float

    @staticmethod
    def of(work: Callable[[], object]) -> Cost:
        """Do it and see."""
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        return Cost(time.perf_counter() - wall, time.process_time() - cpu)

    def __sub__(self, other: Cost) -> Cost:
        return Cost(self.wall_s - other.wall_s, self.cpu_s - other.cpu_s)

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


def best(costs: Sequence[Cost]) -> Cost:
    """The least of each kind of time."""
    return Cost(min(cost.wall_s for cost in costs), min(cost.cpu_s for cost in costs))


class Tensors:
    """What extract gave to each model, to be run again without extract."""

    def __init__(self) -> None:
        self.feeds: dict[str, list[tuple[Session, Mapping[str, Any]]]] = {}
        self._run = Session.run

    def recorded(self, work: Callable[[], object]) -> None:
        """Do the work and keep what it feeds to the models."""

        def run(session: Session, feeds: Mapping[str, Any]) -> Any:
            self.feeds.setdefault(session.path.name, []).append((session, dict(feeds)))
            return self._run(session, feeds)

        with mock.patch.object(Session, "run", run):
            work()

    def forget(self, others: Tensors) -> None:
        """Drop what came first: as many runs of each model as the others hold."""
        self.feeds = {model: runs[len(others.feeds.get(model, [])) :] for model, runs in self.feeds.items()}

    def run(self, model: str) -> None:
        """The model alone, on all that it was given."""
        for session, feeds in self.feeds[model]:
            session.run(feeds)


def ingested(log: Path, folder: Path) -> tuple[InputFile, ...]:
    """The keyframes of a log."""
    command = [sys.executable, "-m", "semslam.pipeline.cli", "ingest", str(log), "--out", str(folder)]
    subprocess.run([*command, "--workers", "0", "--quiet"], check=True)
    return table_files(next(folder.glob("cache/ingest/*/")))["frames"]


def extract(frames: tuple[InputFile, ...], config: ExtractConfig) -> int:
    """The whole stage, into a folder that is removed; returns the number of keyframes."""
    done = [0]

    def report(units: int, _total: int | None) -> None:
        done[0] = max(done[0], units)

    with tempfile.TemporaryDirectory() as temporary:
        inputs = {"frames": frames}
        job = Job(0, EXTRACT, "", "log", (), config, "0" * 64, {}, inputs, (), Path(temporary))
        outcome = execute(job, report)
    if outcome.failure is not None:
        sys.exit(f"extract failed: {outcome.failure.message}")
    return done[0]


def measure(frames: tuple[InputFile, ...], config: ExtractConfig, rounds: int) -> None:
    """Print the tables."""
    tensors, of_opening, count = Tensors(), Tensors(), [0]
    of_opening.recorded(lambda: Eyes.open(config, 1))
    tensors.recorded(lambda: count.append(extract(frames, config)))
    tensors.forget(of_opening)
    wholes, openings = [], []
    alone: dict[str, list[Cost]] = {model: [] for model in tensors.feeds}
    for _ in range(rounds):
        wholes.append(Cost.of(lambda: extract(frames, config)))
        openings.append(Cost.of(lambda: Eyes.open(config, 1)))
        for model, costs in alone.items():
            costs.append(Cost.of(lambda model=model: tensors.run(model)))
    models = {model: best(costs) for model, costs in alone.items()}
    say_models(tensors, models, count[-1])
    say_shares(best(wholes) - best(openings), sum(models.values(), Cost(0.0, 0.0)), count[-1])


def say_models(tensors: Tensors, models: Mapping[str, Cost], count: int) -> None:
    """Milliseconds a frame of each model alone."""
    print(f"\n{'MODEL, ONE THREAD':<32} {'RUNS':>6} {'MS A RUN':>10} {'MS A FRAME':>11}")
    for model, cost in models.items():
        runs = len(tensors.feeds[model])
        print(f"{model:<32} {runs:6} {1e3 * cost.wall_s / runs:10.2f} {1e3 * cost.wall_s / count:11.2f}")


def say_shares(whole: Cost, alone: Cost, count: int) -> None:
    """Extract beside ONNX Runtime."""
    print(f"\n{f'OF {count} KEYFRAMES':<32} {'WALL MS A FRAME':>17} {'CPU MS A FRAME':>17}")
    for name, cost in (("extract", whole), ("ONNX Runtime alone", alone), ("extract outside it", whole - alone)):
        print(f"{name:<32} {1e3 * cost.wall_s / count:17.2f} {1e3 * cost.cpu_s / count:17.2f}")
    outside = whole - alone
    print(f"{'share outside':<32} {outside.wall_s / whole.wall_s:17.1%} {outside.cpu_s / whole.cpu_s:17.1%}")


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", nargs="?", type=Path)
    for option in ("--detector", "--classes", "--encoder", "--decoder"):
        parser.add_argument(option, default="")
    parser.add_argument("--segmenter", default="auto")
    parser.add_argument("--batch", type=int, default=ExtractConfig().batch)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one round: only to see that it runs")
    args = parser.parse_args()
    if any(os.environ.get(name) != value for name, value in ONE_THREAD.items()):  # libraries read it when they load
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **ONE_THREAD})
    config = with_shipped(
        ExtractConfig(
            detector=args.detector,
            classes=args.classes,
            segmenter=args.segmenter,
            segmenter_encoder=args.encoder,
            segmenter_decoder=args.decoder,
            batch=args.batch,
        )
    )
    print(machine("onnxruntime", "opencv-contrib-python-headless", "numpy", "pyarrow"))
    with tempfile.TemporaryDirectory() as temporary:
        measure(ingested(args.log or demo_log(), Path(temporary)), config, 1 if args.quick else args.rounds)


if __name__ == "__main__":
    main()
