"""Records the bundled log of `semslam demo` and writes it with its card into `semslam/data/`.

    pip install -e ".[sim]"
    python tools/make_demo.py

It is the first log of `semslam simulate --seed 3000 --scenes 1 --trajectories 1 --steps 30`; the detector was trained
on other homes. The same versions of the packages give the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from dataclasses import replace
from pathlib import Path

from semslam.sim.dataset import Recipe, Recording, versions
from semslam.sim.recorder import record_home

DATA = Path(__file__).resolve().parent.parent / "semslam" / "data"
RECIPE = Recipe(scenes=1, trajectories=1, steps=30, seed=3000)


def main() -> None:
    """Record, then write the card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DATA / "demo_home.mcap")
    args = parser.parse_args()
    (first,) = RECIPE.recordings()
    recording = replace(first, name=args.out.stem)
    with tempfile.TemporaryDirectory() as folder:
        seen = record_home(recording, args.out, Path(folder) / "truth", lambda _: None)
    args.out.with_suffix(".md").write_text(card(args.out, recording, seen), encoding="utf-8")
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB, {min(seen)} objects in view or more")


def card(log: Path, recording: Recording, seen: tuple[int, ...]) -> str:
    """What the file is, from the run itself."""
    digest = hashlib.sha256(log.read_bytes()).hexdigest()
    used = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"""# {log.name}

The log of `semslam demo`: {recording.steps} keyframes of a small robot in a simulated home, as ROS 2 records them. The
topics under `/ground_truth` hold the truth; the pipeline uses none of them but to evaluate.

| | |
|---|---|
| file | {log.stat().st_size / 1e6:.2f} MB, SHA-256 `{digest}` |
| home | seed {recording.home_seed}: the first of `semslam simulate --seed {RECIPE.seed}`, not chosen |
| noise | `{recording.noise}` (wheels and IMU); camera and depth as sensors have them |
| objects in view | {min(seen)} to {max(seen)} a frame |
| command | `python tools/make_demo.py` |
| versions | {used} |
| licence | Apache-2.0 |
"""


if __name__ == "__main__":
    main()
