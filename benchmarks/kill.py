"""Kill a run again and again, resume it, and compare every stored byte with those of an undisturbed run.

    python benchmarks/kill.py --kills 50 --seed 1 -- LOG... [options of semslam run]

For every kill: a fresh output folder, SIGKILL at a random moment of the run, then the same command to its end. The
moments are uniform over the time of the undisturbed run. Afterwards the same run with 1, 2 and 4 workers. What is
compared: every file of the cache but timing.json, and every file of the results. Baseline: the undisturbed run.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from machine import machine

from semslam.pipeline.digest import sha256_file
from semslam.pipeline.files import files_below


def command(out: Path, arguments: Sequence[str]) -> list[str]:
    """The run, into `out`."""
    return [sys.executable, "-m", "semslam.pipeline.cli", "run", *arguments, "--out", str(out), "--quiet"]


def finish(out: Path, arguments: Sequence[str]) -> float:
    """Run to the end; seconds it took."""
    start = time.perf_counter()
    done = subprocess.run(command(out, arguments), capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"the run failed:\n{done.stderr}")
    return time.perf_counter() - start


def digests(out: Path) -> dict[str, str]:
    """SHA-256 of every stored file, by path."""
    stages = sorted(path for path in (out / "cache").iterdir() if path.is_dir())
    files = [file for folder in (*stages, out / "results") for file in files_below(folder)]
    return {str(file.relative_to(out)): sha256_file(file) for file in files if file.name != "timing.json"}


def kill_at(out: Path, arguments: Sequence[str], moment_s: float) -> tuple[bool, int]:
    """Start the run and kill it after so long; whether it was still running, and the shards it left unfinished."""
    process = subprocess.Popen(command(out, arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(moment_s)
        return False, 0
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True, len(list(out.glob("cache/*/.work-*/shard-*")))


def differences(expected: dict[str, str], found: dict[str, str]) -> list[str]:
    """Paths that are missing, extra or other."""
    return sorted(path for path in {*expected, *found} if expected.get(path) != found.get(path))


def main() -> None:
    """Print the figures; exit code 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="two kills and two workers, to see that it works")
    parser.add_argument("arguments", nargs="+", metavar="LOG... [options]")
    options = parser.parse_args()
    kills, workers = (2, (2,)) if options.quick else (options.kills, (1, 2, 4))
    dice = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        undisturbed_s = finish(root / "undisturbed", options.arguments)
        expected = digests(root / "undisturbed")
        print(machine())
        print(f"undisturbed run: {undisturbed_s:.1f} s, {len(expected)} files")
        equal = killed = resumed = 0
        after_s = []
        for number in range(kills):
            out = root / f"killed-{number}"
            moment_s = dice.uniform(0.0, undisturbed_s)
            was_running, shards = kill_at(out, options.arguments, moment_s)
            after_s.append(moment_s + finish(out, options.arguments))
            different = differences(expected, digests(out))
            killed += was_running
            resumed += shards > 0
            equal += not different
            for path in different[:3]:
                print(f"killed after {moment_s:.2f} s: {path} differs", flush=True)
            shutil.rmtree(out)
        mean_s = sum(after_s) / len(after_s)
        print(f"killed and resumed: {equal} of {kills} equal; {killed} while running, {resumed} amid an entry's shards")
        print(f"time with one kill: {mean_s:.1f} s   ratio to undisturbed {mean_s / undisturbed_s:.2f}")
        for number in workers:
            out = root / f"workers-{number}"
            took_s = finish(out, [*options.arguments, "--workers", str(number)])
            same = not differences(expected, digests(out))
            equal += same
            print(f"{number} workers: {'equal' if same else 'DIFFERENT'}, {took_s:.1f} s")
    sys.exit(0 if equal == kills + len(workers) else 1)


if __name__ == "__main__":
    main()
