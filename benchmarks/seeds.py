"""Accuracy on simulated homes that nobody chose: the first log of the first homes of `semslam simulate --seed 1`.

    python benchmarks/seeds.py [--homes 5] [--steps 30] [--quick]

Prints what `semslam evaluate` prints: every estimator beside dead reckoning (the baseline), chance and standing still.
None of them was chosen, nor was the home of `semslam demo`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from machine import machine

from semslam.sim.dataset import Recipe
from semslam.sim.simulate import simulate

ESTIMATORS = ("surfel", "paper", "paper_visual", "dead_reckoning")


def main() -> None:
    """Record, run, evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=5)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--quick", action="store_true", help="one home, four keyframes: only to see that it runs")
    args = parser.parse_args()
    recipe = Recipe(scenes=1 if args.quick else args.homes, trajectories=1, steps=4 if args.quick else args.steps)
    print(machine())
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        simulate(folder / "homes", recipe)
        command = [sys.executable, "-m", "semslam.pipeline.cli"]
        run = [*command, "run", str(folder / "homes" / "logs"), "--out", str(folder / "out"), "--quiet"]
        run += [part for name in ESTIMATORS for part in ("--estimator", name)]
        subprocess.run(run, check=True)
        done = subprocess.run([*command, "evaluate", str(folder / "out")], check=True, capture_output=True, text=True)
        print(done.stdout)


if __name__ == "__main__":
    main()
