"""How long a run takes to find that nothing is to do, over many logs, beside the least any program would need.

    python benchmarks/plan.py [--logs 300] [--quick]

Every log gets entries for all stages and three estimators, made under the keys of the real stages by a stand-in that
writes empty tables. Then the real `semslam run` is timed over the folder. Baselines of the same run: starting Python
with nothing to do, and starting Python to stat every file that the decision depends on.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from machine import machine

from semslam.pipeline.config import load_config
from semslam.pipeline.console import Console, RunView
from semslam.pipeline.discover import discover
from semslam.pipeline.executors import SerialExecutor
from semslam.pipeline.folder import OutputFolder, create_folder
from semslam.pipeline.runner import Runner
from semslam.stages.catalogue import STAGES
from semslam.stages.contract import StageContext

_STAT_ALL = "import os, sys; [os.stat(line.rstrip()) for line in open(sys.argv[1])]"


def stand_in(ctx: StageContext) -> None:
    """Every table of the stage without rows, and what an export leaves."""
    stage = next(stage for stage in STAGES if type(ctx.config) is stage.config)
    with ctx.shard(0) as shard:
        for table in stage.writes:
            shard.table(table, {"log": ctx.log})  # so that no two logs share an entry
        if stage is STAGES[-1]:
            for name in ("map.png", "map.pgm", "map.yaml", "map.parquet", "trajectory.tum"):
                shard.path(name).write_text(name)


def make_logs(folder: Path, number: int) -> None:
    """Small files with different contents, old enough that their stamps are trusted."""
    folder.mkdir()
    for index in range(number):
        path = folder / f"log_{index:04d}x.mcap"
        path.write_text(f"log {index}\n")
        os.utime(path, (1_700_000_000, 1_700_000_000))


def fill(out: Path, logs: Path) -> OutputFolder:
    """Make all entries, in this process."""
    folder = create_folder(out)
    stages = [replace(stage, entry="__main__:stand_in") for stage in STAGES]
    found = discover([str(logs)])
    view = RunView(Console(quiet=True))
    with folder.locked():
        Runner(folder, stages, load_config(stages), found.logs, SerialExecutor(), view, stages[-1].name).run()
    return folder


def seconds(command: Sequence[str], times: int) -> float:
    """Median wall time of a command."""
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=300)
    parser.add_argument("--times", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="a few logs, to see that it works")
    options = parser.parse_args()
    number, times = (6, 2) if options.quick else (options.logs, options.times)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        make_logs(root / "logs", number)
        folder = fill(root / "out", root / "logs")
        manifests = sorted(folder.cache.glob("*/*/manifest.json"))
        watched = [*sorted((root / "logs").iterdir()), *manifests, *sorted(folder.results.glob("*/*/*"))]
        (root / "watched.txt").write_text("\n".join(map(str, watched)))
        command = [sys.executable, "-m", "semslam.pipeline.cli", "run", str(root / "logs"), "--out", str(root / "out")]
        subprocess.run(command, check=True, capture_output=True)  # the records now say `cached`, as they will again
        decided = seconds(command, times)
        start = seconds([sys.executable, "-c", "pass"], times)
        stats = seconds([sys.executable, "-c", _STAT_ALL, str(root / "watched.txt")], times)
    print(machine())
    print(f"median of {times}")
    print(f"{number} logs, {len(manifests)} entries, {len(watched)} files that matter")
    print(f"nothing to do         {decided:6.3f} s")
    print(f"python -c pass        {start:6.3f} s   ratio {decided / start:5.1f}")
    print(f"stat of every file    {stats:6.3f} s   ratio {decided / stats:5.1f}")


if __name__ == "__main__":
    main()
