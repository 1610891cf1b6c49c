"""Accuracy on simulated rooms that nobody chose: seeds 1 to 5 of the demo's room, path and noise.

    python benchmarks/seeds.py [--seeds 5] [--quick]

Prints what `semslam evaluate` prints: every estimator beside dead reckoning (the baseline), chance and standing still.
The seed that `semslam demo` uses was chosen, for its picture and for little wheel drift; these were not.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from machine import machine

from semslam.sim.demo import demo_settings, record_demo


def main() -> None:
    """Record, run, evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one seed, four keyframes: only to see that it runs")
    args = parser.parse_args()
    seeds, keyframes = (1, 4) if args.quick else (args.seeds, 30)
    print(machine())
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        logs = [
            str(record_demo(folder / f"seed{seed}.mcap", seed=seed, keyframes=keyframes))
            for seed in range(1, seeds + 1)
        ]
        command = [sys.executable, "-m", "semslam.pipeline.cli"]
        detector = str(demo_settings()["extract.detector"])
        run = [*command, "run", *logs, "--out", str(folder / "out"), "--detector", detector, "--quiet"]
        subprocess.run(run, check=True)
        done = subprocess.run([*command, "evaluate", str(folder / "out")], check=True, capture_output=True, text=True)
        print(done.stdout)


if __name__ == "__main__":
    main()
