"""Objects of the map beside those that stand in the home: which were found, which were made up, and how far off.

    semslam run HOMES/logs --out OUT
    python benchmarks/objects.py HOMES OUT [--log NAME]... [--estimator surfel]

HOMES is a folder of `semslam simulate`. An object counts as seen if a fifth of its footprint was; it is found if one of
its class stands within half a metre, each with one only. Chance: as many objects of the same classes, put uniformly
into the rectangle that the map spans, mean of 200 draws.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from machine import machine
from numpy.typing import NDArray

from semslam.bench.tracks import true_track
from semslam.slam.objects import centroid
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import CELLS, HOME_OBJECTS, OBJECTS

NEAR_M = 0.5
SEEN = 0.2
DRAWS = 200


@dataclass(frozen=True, eq=False)
class Thing:
    """An object, found or true."""

    label: str
    middle: NDArray[np.float64]
    outline: NDArray[np.float64]
    """(V, 2)"""


@dataclass
class Tally:
    """Of one class, or of all."""

    true: int = 0
    told: int = 0
    matched: int = 0
    away_m: float = 0.0
    overlap: float = 0.0

    def line(self, name: str) -> str:
        """A row of the table."""
        precision = f"{self.matched / self.told:.2f}" if self.told else "-"
        recall = f"{self.matched / self.true:.2f}" if self.true else "-"
        away = f"{self.away_m / self.matched:.2f} m | {self.overlap / self.matched:.2f}" if self.matched else "- | -"
        return f"| {name} | {self.true} | {self.told} | {precision} | {recall} | {away} |"


def main() -> None:
    """Compare what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("homes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--log", action="append", help="default: all logs with results")
    parser.add_argument("--estimator", default="surfel")
    args = parser.parse_args()
    print(machine())
    tallies: dict[str, Tally] = defaultdict(Tally)
    random = np.random.default_rng(0)
    lucky = 0.0
    found = sorted(path.parent for path in (args.out / "results").glob(f"*/{args.estimator}/objects.parquet"))
    folders = [path for path in found if not args.log or path.parent.name in args.log]
    for folder in folders:
        told = objects_of(folder)
        cells = TableFiles(CELLS, [folder / "map.parquet"])
        places = cells.read(["x_m", "y_m", "class_id"])
        seen = np.stack([places["x_m"], places["y_m"]], 1)
        true = [one for one in truth_of(args.homes, folder.parent.name) if share_seen(one, seen) >= SEEN]
        compare(told, true, tallies)
        chance = [matches(shuffled(told, seen, random), true) for _ in range(DRAWS)]
        lucky += float(np.mean([len(one) for one in chance]))
    whole = tallies["all"]
    print(f"\n{len(folders)} logs, estimator {args.estimator}\n")
    print("| class | seen in the homes | in the tables | precision | recall | apart | footprints' IoU |")
    print("|---|---|---|---|---|---|---|")
    for name in sorted(set(tallies) - {"all"}):
        print(tallies[name].line(name))
    print(whole.line("all"))
    print(f"| chance | | | {lucky / max(1, whole.told):.2f} | {lucky / max(1, whole.true):.2f} | | |")


def objects_of(folder: Path) -> list[Thing]:
    """The objects of a result."""
    rows = TableFiles(OBJECTS, [folder / "objects.parquet"]).read(["label", "x_m", "y_m", "footprint"])
    return [
        Thing(label, np.array([x, y]), np.array(outline).reshape(-1, 2))
        for label, x, y, outline in zip(rows["label"], rows["x_m"], rows["y_m"], rows["footprint"], strict=True)
    ]


def truth_of(homes: Path, log: str) -> list[Thing]:
    """The objects of the home in the log's map frame: that of its first keyframe."""
    (first,) = true_track(homes, log, 1).by_stamp().values()
    start = first.inverse().matrix
    rows = TableFiles(HOME_OBJECTS, [homes / "truth" / log / "home_objects.parquet"]).read(["label", "footprint"])
    found = []
    for label, outline in zip(rows["label"], rows["footprint"], strict=True):
        here = np.array(outline).reshape(-1, 2) @ start[:2, :2].T + start[:2, 3]
        found.append(Thing(label, centroid(here), here))
    return found


def share_seen(one: Thing, seen: NDArray[np.float64], cell_m: float = 0.1) -> float:
    """Share of a footprint that lies in cells that were seen."""
    outline = one.outline.astype(np.float32)
    inside = sum(cv2.pointPolygonTest(outline, (float(x), float(y)), measureDist=False) >= 0 for x, y in seen)
    return float(inside * cell_m**2 / max(1e-6, cv2.contourArea(outline)))


def matches(told: Sequence[Thing], true: Sequence[Thing]) -> list[tuple[int, int]]:
    """Pairs of one class, nearest first, each with one only."""
    near = [
        (float(np.hypot(*(one.middle - other.middle))), i, j)
        for i, one in enumerate(told)
        for j, other in enumerate(true)
        if one.label == other.label
    ]
    pairs: list[tuple[int, int]] = []
    for away, i, j in sorted(near):
        if away <= NEAR_M and all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return pairs


def compare(told: Sequence[Thing], true: Sequence[Thing], tallies: dict[str, Tally]) -> None:
    """Count."""
    for things, name in ((true, "true"), (told, "told")):
        for thing in things:
            for tally in (tallies[thing.label], tallies["all"]):
                setattr(tally, name, getattr(tally, name) + 1)
    for i, j in matches(told, true):
        for tally in (tallies[told[i].label], tallies["all"]):
            tally.matched += 1
            tally.away_m += float(np.hypot(*(told[i].middle - true[j].middle)))
            tally.overlap += overlap(told[i].outline, true[j].outline)


def overlap(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Intersection over union of two outlines' hulls."""
    first, second = (cv2.convexHull(outline.astype(np.float32)) for outline in (one, other))
    common, _ = cv2.intersectConvexConvex(first, second)
    whole = cv2.contourArea(first) + cv2.contourArea(second) - common
    return float(common / whole) if whole > 0 else 0.0


def shuffled(told: Sequence[Thing], seen: NDArray[np.float64], random: np.random.Generator) -> list[Thing]:
    """The same objects anywhere."""
    low, high = seen.min(0), seen.max(0)
    return [Thing(one.label, random.uniform(low, high), one.outline) for one in told]


if __name__ == "__main__":
    main()
