"""Logs found in the maps of others, without a first guess: a robot that was put down anywhere in a home it knows.

    python benchmarks/prior_maps.py HOMES --out OUT [--log NAME]... [--keyframes 30]

HOMES is a folder of `semslam simulate`; without `--log` the drives of its cross-scene test homes are taken. Each log is
looked for in the map of the next log of its home (of another day, where there are two), where it should be found, and
in the map of a log of the next home, where it should not. Poses are compared with the truth in the frame of that map,
from the sixth keyframe on; the same command goes on after a kill.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import machine

from semslam.bench.tracks import true_track
from semslam.geometry.frames import SE2
from semslam.pipeline.run_tables import run_tables
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import POSES, SPLITS

NEAR_M, NEAR_DEG = 0.10, 2.0
FIRST = 5
"""Keyframes before this one do not count."""
SEMSLAM = [sys.executable, "-m", "semslam.pipeline.cli"]


@dataclass(frozen=True)
class Log:
    """A log and the home it was recorded in."""

    name: str
    home: tuple[str, int]
    day: int


@dataclass(frozen=True)
class Found:
    """What became of a log in a map."""

    log: str
    map: str
    answer: str
    """found, ambiguous or lost."""
    near: int
    wrong: int
    """Keyframes that are called ok and are not near."""
    frames: int
    worst_m: float
    worst_deg: float


def main() -> None:
    """Look for all logs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("homes", type=Path)
    parser.add_argument(
        "--out", type=Path, required=True, help="output folder, made by this script or by `semslam run`"
    )
    parser.add_argument("--log", action="append", help="a log; may be given more than once")
    parser.add_argument("--keyframes", type=int, default=30, help="of each log; 0 for all")
    args = parser.parse_args()
    logs = chosen(args.homes, args.log)
    print(machine(), flush=True)
    limit = ["--set", f"localize.max_keyframes={args.keyframes}"]
    paths = [str(args.homes / "logs" / f"{log.name}.mcap") for log in logs]
    common = ["--out", str(args.out), "--estimator", "surfel", "--quiet", *limit]
    subprocess.run([*SEMSLAM, "run", *paths, *common], check=True)
    for title, pairs in (("in the map of its own home", own(logs)), ("in the map of another home", others(logs))):
        found = [look(args.homes, args.out, log, other, common) for log, other in pairs]
        if found:
            tell(title, found)


def chosen(homes: Path, names: Sequence[str] | None) -> list[Log]:
    """The logs that were named, or those of the cross-scene test homes."""
    rows = TableFiles(SPLITS, [homes / "splits.parquet"]).read()
    columns = zip(rows["log"], rows["variant"], rows["scene"], rows["day"], rows["cross"], strict=True)
    return [
        Log(log, (variant, scene), day)
        for log, variant, scene, day, cross in columns
        if (log in names if names else cross == "test")
    ]


def own(logs: Sequence[Log]) -> Iterator[tuple[Log, Log]]:
    """Each log with the next one of its home, of another day if there is one."""
    for log in logs:
        same = [one for one in logs if one.home == log.home and one != log]
        other_days = [one for one in same if one.day != log.day]
        later = [one for one in (other_days or same) if logs.index(one) > logs.index(log)]
        if same:
            yield log, (later or other_days or same)[0]


def others(logs: Sequence[Log]) -> Iterator[tuple[Log, Log]]:
    """Each log with the first one of the next home."""
    homes = list(dict.fromkeys(log.home for log in logs))
    if len(homes) > 1:
        for log in logs:
            home = homes[(homes.index(log.home) + 1) % len(homes)]
            yield log, next(one for one in logs if one.home == home)


def look(homes: Path, out: Path, log: Log, other: Log, common: Sequence[str]) -> Found:
    """Find a log in the map of another."""
    prior = out / "results" / other.name / "surfel"
    path = homes / "logs" / f"{log.name}.mcap"
    subprocess.run([*SEMSLAM, "localize", str(path), "--prior", str(prior), *common], check=True, capture_output=True)
    rows = TableFiles(POSES, run_tables(out, (POSES,), [log.name], "surfel")[log.name][POSES.name]).read()
    return judged(log, other, rows, *(true_track(homes, one.name).by_stamp() for one in (log, other)))


def judged(log: Log, other: Log, rows: dict[str, list[Any]], own: dict[int, SE2], theirs: dict[int, SE2]) -> Found:
    """Compare with the truth in the frame of the map, which is that of its first keyframe."""
    start = theirs[min(theirs)]
    near = wrong = 0
    worst_m = worst_deg = 0.0
    posed = 0
    columns = ("stamp_nanos", "x_m", "y_m", "heading_rad", "verdict")
    for stamp, x, y, heading, verdict in list(zip(*(rows[name] for name in columns), strict=True))[FIRST:]:
        if x is None:
            continue
        away = start.between(own[stamp]).between(SE2(x, y, heading))
        metres, degrees = math.hypot(away.x_m, away.y_m), abs(math.degrees(away.heading_rad))
        good = metres <= NEAR_M and degrees <= NEAR_DEG
        near, wrong, posed = near + good, wrong + (verdict == "ok" and not good), posed + 1
        worst_m, worst_deg = max(worst_m, metres), max(worst_deg, degrees)
    answer = "found" if posed else "ambiguous" if any(rows["mode_x_m"]) else "lost"
    return Found(log.name, other.name, answer, near, wrong, len(rows["x_m"]) - FIRST, worst_m, worst_deg)


def tell(title: str, found: Sequence[Found]) -> None:
    """A table, and its sum."""
    print(f"\n### A log {title}\n")
    print("| log | map | answer | within 0.10 m and 2 deg | called ok but not within | worst |")
    print("|---|---|---|---|---|---|")
    for one in found:
        worst = f"{one.worst_m:.3f} m, {one.worst_deg:.2f} deg" if one.answer == "found" else "-"
        print(f"| {one.log} | {one.map} | {one.answer} | {one.near} of {one.frames} | {one.wrong} | {worst} |")
    answers = ", ".join(f"{sum(one.answer == word for one in found)} {word}" for word in ("found", "ambiguous", "lost"))
    near, frames, wrong = (sum(getattr(one, name) for one in found) for name in ("near", "frames", "wrong"))
    print(f"| {len(found)} logs | | {answers} | {near} of {frames} ({near / frames:.1%}) | {wrong} | |", flush=True)


if __name__ == "__main__":
    main()
