"""Logs of many places merged at once: are those of one place joined, and how far is each keyframe from the truth?

    semslam run HOMES/logs --out OUT
    python benchmarks/merge.py HOMES --run OUT [--log NAME]...

HOMES is a folder of `semslam simulate`; the truth of all drives of one home is in one frame. All logs are merged by
`semslam merge`, which is told nothing of homes; poses of a site are compared with the truth in the frame of the first
keyframe of its first log, and nothing else is aligned. Beside them stand, for the same keyframes: each log by itself in
the map of the site's first one, as `--prior` lays it there; dead reckoning that is told where each log truly began; and
poses drawn uniformly from the rectangle that the robots drove in.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from machine import machine

from semslam.bench.tracks import published_track, true_track
from semslam.geometry.frames import SE2
from semslam.pipeline.evaluate import compose
from semslam.pipeline.run_tables import run_tables
from semslam.slam.surfel.prior import Grid, read_prior
from semslam.slam.surfel.registration import place_in
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import MOTION, PLACES, SPLITS, TRAJECTORY

OK_M, OK_DEG = 0.1, 2.0
DRAWS = 200
MERGE = "`merge`"
Poses = dict[int, SE2]
"""By stamp."""


@dataclass(frozen=True)
class Errors:
    """Of many keyframes."""

    metres: list[float]
    degrees: list[float]
    keyframes: int
    """That were asked for."""
    ok: int = 0
    wrong: int = 0
    """Called ok, and not within bounds."""

    @staticmethod
    def joined(parts: Sequence[Errors]) -> Errors:
        """All together."""
        metres, degrees = ([value for part in parts for value in getattr(part, name)] for name in ("metres", "degrees"))
        counts = (sum(getattr(part, name) for part in parts) for name in ("keyframes", "ok", "wrong"))
        return Errors(metres, degrees, *counts)

    def line(self, *words: str) -> str:
        """A row of the table."""
        cells = ["-"] * 3
        if self.metres:
            worst = f"{max(self.metres):.3f} m, {max(self.degrees):.2f} deg"
            cells = [f"{np.mean(self.metres):.3f} m", f"{np.mean(self.degrees):.2f} deg", worst]
        posed = f"{len(self.metres)} of {self.keyframes}"
        called = f"{self.ok}, {self.wrong}" if self.ok else "-"
        return "| " + " | ".join([*words, posed, *cells, called]) + " |"


def main() -> None:
    """Merge, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("homes", type=Path)
    parser.add_argument("--run", type=Path, required=True, help="output folder of a run over the logs of HOMES")
    parser.add_argument("--log", action="append", default=[], help="a log; may be given more than once")
    args = parser.parse_args()
    print(machine(), flush=True)
    sites, seconds = merged(args.run, args.log)
    homes = homes_of(args.homes)
    tell_joins(sites, homes, seconds)
    known = {log: true_track(args.homes, log).by_stamp() for logs in sites.values() for log in logs}
    rows: dict[str, list[Errors]] = {}
    for site, logs in sites.items():
        if len(logs) > 1:
            print(f"\n### Site {site}\n\n{HEAD}")
            for log in logs:
                for name, errors in compared(args.run, site, log, known):
                    print(errors.line(log, name), flush=True)
                    rows.setdefault(name, []).append(errors)
                    if log != site and name == MERGE:
                        rows.setdefault(f"{MERGE}, without first logs", []).append(errors)
    if rows:
        print(f"\n### All\n\n{HEAD}")
        for name, parts in rows.items():
            print(Errors.joined(parts).line(f"{len(parts)} logs", name))


HEAD = """| log | | keyframes with a pose | mean error | | worst | called ok, wrongly |
|---|---|---|---|---|---|---|"""


def merged(run: Path, names: Sequence[str]) -> tuple[dict[str, list[str]], float | None]:
    """Logs by site, and the seconds it took; None if it was done before."""
    start = time.monotonic()
    chosen = [word for name in names for word in ("--log", name)]
    command = [sys.executable, "-m", "semslam.pipeline.cli", "merge", str(run), "--json", *chosen]
    told = json.loads(subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout)
    sites = {one["site"]: [row["log"] for row in one["logs"]] for one in told["sites"]}
    for row in (row for one in told["sites"] for row in one["logs"]):
        print(f"{row['log']}: {row['verdict']}, site {row['site']}")
    return sites, None if told["cached"] else time.monotonic() - start


def homes_of(folder: Path) -> dict[str, tuple[str, int]]:
    """The home of each log."""
    rows = TableFiles(SPLITS, [folder / "splits.parquet"]).read(["log", "variant", "scene"])
    return dict(zip(rows["log"], zip(rows["variant"], rows["scene"], strict=True), strict=True))


def tell_joins(sites: Mapping[str, Sequence[str]], homes: Mapping[str, tuple[str, int]], seconds: float | None) -> None:
    """Pairs of logs that are joined and should not be, and the other way round."""
    place = {log: site for site, logs in sites.items() for log in logs}
    pairs = list(combinations(place, 2))
    same = [homes[one] == homes[other] for one, other in pairs]
    joined = [place[one] == place[other] for one, other in pairs]
    wrong = sum(together and not alike for together, alike in zip(joined, same, strict=True))
    missed = sum(alike and not together for together, alike in zip(joined, same, strict=True))
    took = "" if seconds is None else f" in {seconds:.0f} s"
    print(
        f"{len(place)} logs of {len({homes[log] for log in place})} homes, {len(sites)} sites{took}: "
        f"{wrong} of {len(pairs) - sum(same)} pairs joined wrongly, {missed} of {sum(same)} missed",
        flush=True,
    )


def compared(run: Path, site: str, log: str, known: Mapping[str, Poses]) -> Iterator[tuple[str, Errors]]:
    """Every way to tell the poses of a log in the frame of the site."""
    start = known[site][min(known[site])]
    true = {stamp: start.between(pose) for stamp, pose in known[log].items()}
    poses, called = track(run / "sites" / site / log)
    yield MERGE, judged(true, poses, called)
    if log != site:
        own, _ = track(run / "results" / log / "surfel")
        shift = laid(run, log, site)
        yield "`--prior`", judged(true, {stamp: shift @ pose for stamp, pose in own.items()} if shift else {})
    yield "`dead_reckoning`", judged(true, reckoned(run, log, true))
    yield "chance", drawn(true)


def track(folder: Path) -> tuple[Poses, set[int]]:
    """Poses, and the stamps of those that are called ok."""
    rows = TableFiles(TRAJECTORY, [folder / "trajectory.parquet"]).read(["stamp_nanos", "verdict"])
    called = {stamp for stamp, word in zip(rows["stamp_nanos"], rows["verdict"], strict=True) if word == "ok"}
    return published_track(folder).by_stamp(), called


def laid(run: Path, log: str, first: str) -> SE2 | None:
    """Where the map of a log lies in that of another; None if that is not sure."""
    paths = [run / "results" / name / "surfel" / "places.parquet" for name in (log, first)]
    grid = Grid.of(TableFiles(PLACES, paths[:1]).meta)
    own, other = (read_prior(path, grid) for path in paths)
    return place_in(own, other).other_from_own


def reckoned(run: Path, log: str, true: Poses) -> Poses:
    """What motion alone tells from the true start on."""
    files = run_tables(run, [MOTION], [log])[log][MOTION.name]
    start = true[min(true)]
    return {stamp: start @ pose for stamp, pose in compose(TableFiles(MOTION, files).read()).by_stamp().items()}


def judged(true: Poses, poses: Poses, called: set[int] | None = None) -> Errors:
    """How far poses are from the truth."""
    apart = {stamp: true[stamp].between(pose) for stamp, pose in poses.items() if stamp in true}
    metres = {stamp: math.hypot(one.x_m, one.y_m) for stamp, one in apart.items()}
    degrees = {stamp: abs(math.degrees(one.heading_rad)) for stamp, one in apart.items()}
    told = [stamp for stamp in apart if stamp in (called or ())]
    wrong = sum(metres[stamp] > OK_M or degrees[stamp] > OK_DEG for stamp in told)
    return Errors(list(metres.values()), list(degrees.values()), len(true), len(told), wrong)


def drawn(true: Poses) -> Errors:
    """Poses by luck."""
    random = np.random.default_rng(0)
    places = np.array([[pose.x_m, pose.y_m] for pose in true.values()])
    low, high = places.min(0), places.max(0)
    found = random.uniform(low, high, (DRAWS, len(places), 2))
    metres = np.linalg.norm(found - places, axis=2).mean(0)
    degrees = np.degrees(np.abs(random.uniform(-math.pi, math.pi, (DRAWS, len(places))))).mean(0)
    return Errors(metres.tolist(), degrees.tolist(), len(places))


if __name__ == "__main__":
    main()
