"""Occupancy and heights of the layers beside the homes as they are, and beside the occupancy of the semantic map.

    semslam run HOMES/logs --out OUT
    python benchmarks/layers.py OUT --dataset HOMES [--log NAME]... [--estimator NAME]...

HOMES is a folder of `semslam simulate`. Everything is compared on the grid of the layers with the true map of 0.1 m
(data_spec.md, table 13): its obstacles and objects are occupied. An occupied cell is right if a true one lies within
a cell of that map; a true one that was visible is found if an occupied cell lies so near. *Floor blocked* is the share
of the true, visible floor that is called occupied, *blocked far* the share that is and is farther than a cell from
anything true, *floor free* the share that is called free. *Free in things* is the share of what is truly occupied, and
visible, that is called free, *inside* the same of what is farther than a cell from the edge of things.

The semantic map's cells count as occupied if they are obstacles or objects, and as free if free floor: what map.pgm
held before there were layers. `nothing but floor` calls every cell free that anybody could have seen.

Heights are those of tables, dressers, shelves and bins, whose tops are flat, up to the greatest height of obstacles:
the median of the cells of the outline that are a true cell away from anything else, against the true top. `always`
tells the median true height of the same things.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from machine import machine
from numpy.typing import NDArray

from semslam.bench.tracks import true_track
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import CELLS, HOME_OBJECTS, LAYERS
from semslam.tables.true_map import NEVER, read_true_map

TRUE_CELL_M = 0.1
FREE, OCCUPIED = 0.196, 0.65
FLAT = ("table", "dresser", "bookshelf", "bin")
LEAST_CELLS = 4
"""With a height, for a height of the whole."""

HEAD = (
    *("map", "poses", "logs", "precision", "recall", "F1"),
    *("floor blocked", "blocked far", "floor free", "free in things", "inside"),
)

_Mask = NDArray[np.bool_]
_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Truth:
    """A home on the grid of the layers, [row, column]."""

    left: int
    low: int
    class_id: NDArray[np.int64]
    visible: _Mask
    cell_m: float
    homes: Path
    log: str
    classes: tuple[str, ...]

    @property
    def reach(self) -> int:
        """Cells of the layers in one of the true map."""
        return round(TRUE_CELL_M / self.cell_m)


@dataclass(frozen=True, eq=False)
class Map:
    """A map on the same grid; what lies beyond it is counted alone."""

    occupied: _Mask
    free: _Mask
    astray: int
    """Occupied cells beyond the grid."""


def main() -> None:
    """Compare what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--dataset", type=Path, required=True, metavar="HOMES")
    parser.add_argument("--log", action="append", help="default: all logs with results")
    parser.add_argument("--estimator", action="append", help="default: surfel and dead_reckoning")
    args = parser.parse_args()
    print(machine())
    print(f"\n| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    for estimator in args.estimator or ["surfel", "dead_reckoning"]:
        folders = folders_of(args.out, estimator, args.log)
        truths = {folder: truth_of(args.dataset, folder) for folder in folders}
        print(row("layers", estimator, [scores(layers_of(f, t), t) for f, t in truths.items()]))
        print(row("semantic", estimator, [scores(semantic_of(f, t), t) for f, t in truths.items()]))
    print(row("nothing but floor", "-", [scores(floor_of(t), t) for t in truths.values()]))
    print("\n| heights | poses | things | median error | 90 % | worst | bias |\n|---|---|---|---|---|---|---|")
    for estimator in args.estimator or ["surfel", "dead_reckoning"]:
        pairs = [pair for folder in folders_of(args.out, estimator, args.log) for pair in tops(args.dataset, folder)]
        print(height_row("layers", estimator, [told - true for told, true in pairs]))
        middle = float(np.median([true for _, true in pairs])) if pairs else 0.0
        print(height_row(f"always {middle:.2f} m", "-", [middle - true for _, true in pairs]))


def folders_of(out: Path, estimator: str, logs: list[str] | None) -> list[Path]:
    """Results with layers."""
    found = sorted(path.parent for path in (out / "results").glob(f"*/{estimator}/layers.parquet"))
    return [path for path in found if not logs or path.parent.name in logs]


def truth_of(homes: Path, folder: Path) -> Truth:
    """The home of a log on the grid of its layers."""
    cell_m = float(TableFiles(LAYERS, [folder / "layers.parquet"]).meta["cell_m"])
    true = read_true_map(homes / "truth" / folder.parent.name / "true_map.parquet", TRUE_CELL_M)
    times = round(TRUE_CELL_M / cell_m)
    left, low = (round(start / cell_m) for start in (true.origin_x_m, true.origin_y_m))
    class_id, visible = (one.repeat(times, 0).repeat(times, 1) for one in (true.class_ids, true.first_seen != NEVER))
    return Truth(left, low, class_id, visible, cell_m, homes, folder.parent.name, true.classes)


def on_grid(ix: NDArray[np.int64], iy: NDArray[np.int64], chosen: _Mask, truth: Truth) -> tuple[_Mask, int]:
    """Cells as a mask on the grid, and how many lie beyond it."""
    column, row = ix[chosen] - truth.left, iy[chosen] - truth.low
    rows, columns = truth.class_id.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    mask = np.zeros((rows, columns), np.bool_)
    mask[row[inside], column[inside]] = True
    return mask, int(np.count_nonzero(~inside))


def layers_of(folder: Path, truth: Truth) -> Map:
    """What map.pgm is made of."""
    rows = TableFiles(LAYERS, [folder / "layers.parquet"]).read(["ix", "iy", "occupancy"])
    ix, iy = (np.array(rows[name], np.int64) for name in ("ix", "iy"))
    occupancy = np.array(rows["occupancy"], np.float64)
    occupied, astray = on_grid(ix, iy, occupancy > OCCUPIED, truth)
    return Map(occupied, on_grid(ix, iy, occupancy < FREE, truth)[0], astray)


def semantic_of(folder: Path, truth: Truth) -> Map:
    """The cells of the semantic map, each as several of the layers."""
    table = TableFiles(CELLS, [folder / "map.parquet"])
    times = round(float(table.meta["cell_m"]) / truth.cell_m)
    rows = {name: np.array(values, np.int64) for name, values in table.read(["ix", "iy", "class_id"]).items()}
    parts = np.stack(np.meshgrid(np.arange(times), np.arange(times)), -1).reshape(-1, 2)
    ix, iy = ((rows[name][:, None] * times + parts[:, i]).ravel() for i, name in enumerate(("ix", "iy")))
    class_id = rows["class_id"].repeat(len(parts))
    occupied, astray = on_grid(ix, iy, (class_id == OBSTACLE) | (class_id >= FIRST_OBJECT), truth)
    return Map(occupied, on_grid(ix, iy, class_id == FREE_FLOOR, truth)[0], astray)


def floor_of(truth: Truth) -> Map:
    """Everything that was visible is free."""
    return Map(np.zeros_like(truth.visible), truth.visible, 0)


def grown(mask: _Mask, cells: int) -> _Mask:
    """A mask and everything within so many cells, diagonals included."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)) > 0


def scores(told: Map, truth: Truth) -> list[float]:
    """The figures of a row, from precision on."""
    real = truth.class_id >= OBSTACLE
    seen, floor = real & truth.visible, (truth.class_id == FREE_FLOOR) & truth.visible
    near, core = grown(real, truth.reach), seen & ~grown(~real, truth.reach)
    precision = share(told.occupied & near, told.occupied, told.astray)
    recall = share(seen & grown(told.occupied, truth.reach), seen)
    total = precision + recall
    return [
        precision,
        recall,
        2 * precision * recall / total if total > 0 else 0.0,
        share(told.occupied & floor, floor),
        share(told.occupied & floor & ~near, floor),
        share(told.free & floor, floor),
        share(told.free & seen, seen),
        share(told.free & core, core),
    ]


def share(part: _Mask, whole: _Mask, more: int = 0) -> float:
    """Of the whole, and so many more, that is in the part."""
    return int(np.count_nonzero(part)) / max(1, int(np.count_nonzero(whole)) + more)


def row(name: str, estimator: str, found: list[list[float]]) -> str:
    """A line with means over logs."""
    means = np.mean(np.array(found), 0) if found else np.full(8, np.nan)
    figures = [f"{value:.3f}" for value in means[:3]] + [f"{value:.1%}" for value in means[3:]]
    return " | ".join([f"| {name}", estimator, str(len(found)), *figures]) + " |"


def tops(homes: Path, folder: Path) -> Iterable[tuple[float, float]]:
    """(told, true) height of each flat thing of which enough cells have one."""
    truth = truth_of(homes, folder)
    table = TableFiles(LAYERS, [folder / "layers.parquet"])
    highest_m = float(table.meta["max_obstacle_height_m"])
    rows = {name: np.array(values, np.float64) for name, values in table.read(["ix", "iy", "top_m"]).items()}
    column, line = (rows[name].astype(np.int64) - start for name, start in (("ix", truth.left), ("iy", truth.low)))
    top = np.full(truth.class_id.shape, np.nan)
    lines, columns = truth.class_id.shape
    inside = (column >= 0) & (column < columns) & (line >= 0) & (line < lines)
    top[line[inside], column[inside]] = rows["top_m"][inside]
    for outline, class_id, height_m in flat_things(truth):
        values = top[covered(outline, class_id, truth)]
        values = values[~np.isnan(values)]
        if len(values) >= LEAST_CELLS and height_m < highest_m:
            yield float(np.median(values)), height_m


def flat_things(truth: Truth) -> Iterable[tuple[_Floats, int, float]]:
    """Outline in the map frame, class and top of each."""
    (first,) = true_track(truth.homes, truth.log, 1).by_stamp().values()
    map_from_home = first.inverse()
    rows = TableFiles(HOME_OBJECTS, [truth.homes / "truth" / truth.log / "home_objects.parquet"]).read()
    for label, z_m, height_m, outline in zip(
        *(rows[name] for name in ("label", "z_m", "height_m", "footprint")), strict=True
    ):
        if label in FLAT:
            yield map_from_home.apply(np.array(outline).reshape(-1, 2)), truth.classes.index(label), z_m + height_m


def covered(outline: _Floats, class_id: int, truth: Truth) -> _Mask:
    """Cells of an outline, its edge included: its front is what one sees. Those beside anything else are left out."""
    corners = np.floor(outline / truth.cell_m - (truth.left, truth.low)).astype(np.int32)
    filled = np.zeros(truth.class_id.shape, np.uint8)
    cv2.fillPoly(filled, [corners], 1)
    others = (truth.class_id >= OBSTACLE) & (truth.class_id != class_id)
    return (filled > 0) & ~grown(others, truth.reach)


def height_row(name: str, estimator: str, errors: list[float]) -> str:
    """A line of the second table."""
    away = np.abs(errors)
    if not away.size:
        return f"| {name} | {estimator} | 0 | - | - | - | - |"
    figures = [float(np.median(away)), float(np.quantile(away, 0.9)), float(away.max()), float(np.median(errors))]
    return " | ".join([f"| {name}", estimator, str(len(away)), *(f"{value:.3f} m" for value in figures)]) + " |"


if __name__ == "__main__":
    main()
