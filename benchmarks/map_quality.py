"""How good maps are: classes, outlines and probabilities of their cells beside the truth.

    semslam run HOMES/logs/... --out OUT --estimator surfel --estimator paper --estimator dead_reckoning
    python benchmarks/map_quality.py OUT --dataset HOMES [--log NAME]...

HOMES is a folder of `semslam simulate`. Compared are the cells that OUT holds of each estimator; the same evidence laid
at true poses, which no estimator can better; the paper's map updates, by a leaky average and by the shipped network, at
the poses of `surfel`; and chance, classes drawn as often as they are true. A map of an estimator lies where its first
keyframe is, and so does the true map.

What counts are cells of 0.1 m that the camera observed: into which an observation fell, laid at its true pose. A map
that has no class there has missed it, unless the cell lies outside the home; probabilities are judged where it has one.
A cell of the paper's grid of 0.3 m says the same of all cells in it, and of those off its map nothing is known. The
second half compares on the paper's own grid, in cells that were observed and that a region of interest has reached;
finer cells are put together by the rule by which the true map of that grid was (data_spec.md, table 13).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine
from numpy.typing import NDArray

from semslam.bench.rows import LEAKS
from semslam.bench.tracks import published_track, true_track
from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes, to_dense
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.map_metrics import (
    Boundaries,
    Ids,
    Mask,
    Overlaps,
    Reliability,
    as_probabilities,
    class_boundaries,
    class_overlaps,
    labels_of,
    reliability,
)
from semslam.models.builtin import shipped
from semslam.models.training.drives import coarse_observation
from semslam.pipeline.run_tables import run_tables
from semslam.slam.evidence import Evidence
from semslam.slam.paper import PoseGrid, place_observation, pose_field, roi_mask, rotate_observation
from semslam.slam.paper_estimator import open_map, pooling_factor
from semslam.stages.settings import PaperConfig
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import CELLS, OBSERVATIONS
from semslam.tables.true_map import TrueMap, read_true_map

ESTIMATORS = ("surfel", "paper", "dead_reckoning")
TRUE, CHANCE, LEARNED = "evidence at true poses", "chance", "learned update"
TOLERANCES = (1, 2)
BINS = 10
MARGIN = 20
"""Cells around the true map that may count as well."""
PARTS = 2
"""Finer cells are looked at in so many parts along each axis: half of one may lie in a coarse cell."""
OBJECT_SHARE, OBSTACLE_SHARE = 0.25, 0.15
"""Of a coarse cell, as table 13 has it."""


@dataclass(frozen=True)
class Canvas:
    """A grid in the map frame that all maps of a log are drawn on."""

    cell_m: float
    left: int
    """Number of its first column, in cells from the origin of the map frame."""
    low: int
    rows: int
    columns: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def middles(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(rows, columns) x and y of the cells' middles."""
        x, y = ((start + np.arange(n) + 0.5) * self.cell_m for start, n in self._axes)
        return np.broadcast_to(x, self.shape), np.broadcast_to(y[:, None], self.shape)

    @property
    def _axes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        return (self.left, self.columns), (self.low, self.rows)


@dataclass(frozen=True, eq=False)
class Layer:
    """A map on a canvas."""

    ids: Ids
    probability: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Score:
    """How one kind of map did; add those of several logs."""

    overlaps: Overlaps
    boundaries: tuple[Boundaries, ...]
    reliability: Reliability
    right: int
    cells: int
    """That count."""
    occupied: NDArray[np.int64]
    """Cells with anything on them in both maps, in the one that is judged, in truth; true obstacles, and how many of
    those are told to be free floor."""

    def __add__(self, other: Score) -> Score:
        boundaries = tuple(map(add, self.boundaries, other.boundaries))
        overlaps, told = self.overlaps + other.overlaps, self.reliability + other.reliability
        right, cells = self.right + other.right, self.cells + other.cells
        return Score(overlaps, boundaries, told, right, cells, self.occupied + other.occupied)


@dataclass(frozen=True, eq=False)
class Log:
    """What there is of a log."""

    name: str
    classes: tuple[str, ...]
    cell_m: float
    side: int
    sights: Sequence[tuple[int, Sequence[int], Sequence[float]]]
    """Stamp, cells and weights of each observation."""
    true: Mapping[int, SE2]
    """Map_from_robot by stamp, in the frame of the first keyframe."""
    results: Path

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.classes), self.side, self.side


Scores = dict[str, Score]


def main() -> None:
    """Compare what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--log", action="append", help="default: all logs with a map of surfel")
    args = parser.parse_args()
    found = sorted(path.parents[1].name for path in (args.out / "results").glob("*/surfel/map.parquet"))
    names = [name for name in found if not args.log or name in args.log]
    print(machine(), flush=True)
    fine: Scores = {}
    coarse: Scores = {}
    classes: tuple[str, ...] = ()
    for log in logs_of(args.out, args.dataset, names):
        classes = log.classes
        for whole, part in zip((fine, coarse), scores_of(log, args.dataset), strict=True):
            for kind, score in part.items():
                whole[kind] = whole[kind] + score if kind in whole else score
    print(f"\n{len(names)} logs")
    tell("cells of 0.1 m that the camera observed", fine, classes)
    tell("cells of 0.3 m that the camera observed and a region of interest reached", coarse, classes)


def logs_of(out: Path, dataset: Path, names: Sequence[str]) -> Iterator[Log]:
    """Read logs one by one."""
    for name, tables in sorted(run_tables(out, (OBSERVATIONS,), names).items()):
        table = TableFiles(OBSERVATIONS, tables[OBSERVATIONS.name])
        rows = table.read(["stamp_nanos", "cells", "weights"])
        sights = list(zip(rows["stamp_nanos"], rows["cells"], rows["weights"], strict=True))
        true = true_track(dataset, name).by_stamp()
        start = true[min(true)]
        placed = {stamp: start.between(pose) for stamp, pose in true.items()}
        meta = table.meta
        facts = tuple(meta["classes"]), float(meta["cell_m"]), int(meta["side"])
        yield Log(name, *facts, sights, placed, out / "results" / name)


def scores_of(log: Log, dataset: Path) -> tuple[Scores, Scores]:
    """Of all maps of a log, on its own grid and on the paper's."""
    path = dataset / "truth" / log.name / "true_map.parquet"
    maps = cell_maps(log)
    true = read_true_map(path, log.cell_m)
    canvas = canvas_of(true)
    truth = padded(true.class_ids)
    layers = {kind: drawn(cells, canvas) for kind, cells in maps.items()}
    observed = layers[TRUE].ids != UNOBSERVED
    beliefs, reached = paper_maps(log)
    grid = PoseGrid(1, reached.shape[0], PaperConfig().cell_m)
    layers |= {kind: spread(layer_of(planes), grid, canvas) for kind, planes in beliefs.items()}
    layers[CHANCE] = by_chance(truth, observed)
    coarse = {kind: gathered(layer, canvas, grid, len(log.classes)) for kind, layer in layers.items() if kind in maps}
    counted = reached & (coarse[TRUE].ids != UNOBSERVED)
    coarse |= {kind: layer_of(planes) for kind, planes in beliefs.items()}
    coarse_truth = read_true_map(path, grid.cell_m).class_ids
    coarse[CHANCE] = by_chance(coarse_truth, counted)
    return scored(layers, truth, observed, len(log.classes)), scored(coarse, coarse_truth, counted, len(log.classes))


def scored(layers: Mapping[str, Layer], truth: Ids, mask: Mask, classes: int) -> Scores:
    """Compare with the truth."""
    return {
        kind: Score(
            class_overlaps(layer.ids, truth, classes, mask),
            tuple(class_boundaries(layer.ids, truth, classes, mask, cells) for cells in TOLERANCES),
            reliability(layer.ids, layer.probability, truth, mask & (layer.ids != UNOBSERVED), BINS),
            int((layer.ids == truth)[mask].sum()),
            int(mask.sum()),
            occupancy(layer.ids[mask], truth[mask]),
        )
        for kind, layer in layers.items()
    }


def occupancy(found: Ids, truth: Ids) -> NDArray[np.int64]:
    """As `Score` has it."""
    told, true, walls = found >= OBSTACLE, truth >= OBSTACLE, truth == OBSTACLE
    sets = (told & true, told, true, walls, walls & (found == FREE_FLOOR))
    return np.array([np.count_nonzero(one) for one in sets], np.int64)


# ------------------------------------------------------------------------------------------------------- cells as maps


def cell_maps(log: Log) -> dict[str, Mapping[str, Any]]:
    """Columns of the cells table, by kind of map: those of the results, and evidence at true poses."""
    evidence = Evidence(log.cell_m, log.side)
    for stamp, cells, weights in log.sights:
        planes = to_dense(np.array(cells, np.uint32), np.array(weights, np.float32), log.shape)
        planes[UNOBSERVED] = ~planes[1:].any(0)
        evidence.add(planes, log.true[stamp], stamp)
    files = {name: log.results / name / "map.parquet" for name in ESTIMATORS}
    columns = ["ix", "iy", "class_id", "probability"]
    stored = {name: TableFiles(CELLS, [path]).read(columns) for name, path in files.items() if path.is_file()}
    return {**stored, TRUE: evidence.cells()}


def canvas_of(true: TrueMap) -> Canvas:
    """The true map's grid, and some cells around it."""
    left, low = (round(origin / true.cell_m) - MARGIN for origin in (true.origin_x_m, true.origin_y_m))
    rows, columns = (side + 2 * MARGIN for side in true.class_ids.shape)
    return Canvas(true.cell_m, left, low, rows, columns)


def padded(class_ids: Ids) -> Ids:
    """The true map on its canvas."""
    return np.pad(class_ids, MARGIN, constant_values=UNOBSERVED)


def drawn(cells: Mapping[str, Any], canvas: Canvas) -> Layer:
    """Cells on a canvas, those beyond it left out."""
    column, row = (np.asarray(cells[name], np.int64) for name in ("ix", "iy"))
    column, row = column - canvas.left, row - canvas.low
    inside = (column >= 0) & (column < canvas.columns) & (row >= 0) & (row < canvas.rows)
    ids, probability = np.full(canvas.shape, UNOBSERVED, np.int64), np.ones(canvas.shape)
    ids[row[inside], column[inside]] = np.asarray(cells["class_id"], np.int64)[inside]
    probability[row[inside], column[inside]] = np.asarray(cells["probability"], np.float64)[inside]
    return Layer(ids, probability)


def by_chance(truth: Ids, counted: Mask) -> Layer:
    """Classes drawn as often as they are true, and as sure as that."""
    classes, numbers = np.unique(truth[counted], return_counts=True)
    shares = numbers / numbers.sum()
    pick = np.random.default_rng(0).choice(len(classes), truth.shape, p=shares)
    return Layer(classes[pick], shares[pick])


# --------------------------------------------------------------------------------------------------- the paper's maps


def paper_maps(log: Log) -> tuple[dict[str, Planes], Mask]:
    """The paper's maps at the poses of surfel (L, H, W), by kind, and the cells that a region of interest reached."""
    config = PaperConfig()
    poses = published_track(log.results / "surfel").by_stamp()
    worlds = {f"leaky {leak:.1f}": open_map(replace(config, leak=leak), log.classes, None) for leak in LEAKS}
    worlds[LEARNED] = open_map(config, log.classes, shipped("map_update"))
    grid = PoseGrid(config.headings, config.map_side, config.cell_m)
    reached = np.zeros((config.map_side, config.map_side), np.bool_)
    factor = pooling_factor(config, log.cell_m, log.side)
    for stamp, cells, weights in log.sights:
        if stamp not in poses:
            continue
        window = roi_mask(poses[stamp], grid, config.side)
        rotated = rotate_observation(coarse_observation(cells, weights, log.shape, factor, config), config.headings)
        placed = place_observation(rotated, pose_field(poses[stamp], grid), window)
        reached[window] = True
        for world in worlds.values():
            world.update(placed, window)
    return {kind: world.planes for kind, world in worlds.items()}, reached


def layer_of(planes: Planes) -> Layer:
    """The strongest class of each cell, and its probability."""
    return Layer(labels_of(planes), as_probabilities(planes).max(0))


def spread(layer: Layer, grid: PoseGrid, canvas: Canvas) -> Layer:
    """A map of the paper's grid on a finer one; what lies off it is unobserved."""
    column, row = (np.floor((axis - grid.origin_m) / grid.cell_m).astype(np.int64) for axis in canvas.middles())
    inside = (column >= 0) & (column < grid.side) & (row >= 0) & (row < grid.side)
    place = np.where(inside, row, 0), np.where(inside, column, 0)
    return Layer(np.where(inside, layer.ids[place], UNOBSERVED), np.where(inside, layer.probability[place], 1.0))


def gathered(layer: Layer, canvas: Canvas, grid: PoseGrid, classes: int) -> Layer:
    """A finer map on the paper's grid: the object that covers most if objects cover enough, obstacle, else floor."""
    counts, sums = np.zeros((2, classes, grid.side * grid.side))
    for cell, part in _parts(canvas, grid):
        np.add.at(counts, (layer.ids.ravel()[part], cell), 1.0)
        np.add.at(sums, (layer.ids.ravel()[part], cell), layer.probability.ravel()[part])
    share = counts / (PARTS * grid.cell_m / canvas.cell_m) ** 2
    floor = np.where(counts[FREE_FLOOR] > 0, FREE_FLOOR, np.where(counts[OBSTACLE] > 0, OBSTACLE, UNOBSERVED))
    ids = np.where(share[OBSTACLE] >= OBSTACLE_SHARE, OBSTACLE, floor)
    largest = share[FIRST_OBJECT:].argmax(0) + FIRST_OBJECT
    ids = np.where(share[FIRST_OBJECT:].sum(0) >= OBJECT_SHARE, largest, ids)
    every = np.arange(ids.size)
    probability = np.where(ids == UNOBSERVED, 1.0, sums[ids, every] / np.maximum(counts[ids, every], 1.0))
    return Layer(ids.reshape(grid.side, -1), probability.reshape(grid.side, -1))


def _parts(canvas: Canvas, grid: PoseGrid) -> Iterator[tuple[NDArray[np.int64], Mask]]:
    """The coarse cell under one part of every cell, part by part, and which cells (flat) have one there."""
    x, y = canvas.middles()
    offsets = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * canvas.cell_m
    for dy in offsets:
        for dx in offsets:
            column, row = (np.floor((v - grid.origin_m) / grid.cell_m).astype(np.int64) for v in (x + dx, y + dy))
            inside = (column >= 0) & (column < grid.side) & (row >= 0) & (row < grid.side)
            yield (row * grid.side + column)[inside], inside.ravel()


# -------------------------------------------------------------------------------------------------------------- tables


def tell(title: str, scores: Scores, classes: Sequence[str]) -> None:
    """Tables of all kinds of maps."""
    kinds = [kind for kind in (*ESTIMATORS, TRUE, *sorted(scores.keys() - set(ESTIMATORS) - {TRUE})) if kind in scores]
    print(f"\n### {title[0].upper()}{title[1:]}\n")
    print("| map | mean IoU | of objects | boundary F1, 1 cell | 2 cells | calibration error | Brier | right |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in kinds:
        print(summary(kind, scores[kind]))
    print("\n| occupied: obstacle or object | precision | recall | obstacles called free floor |\n|---|---|---|---|")
    for kind in kinds:
        both, told, true, walls, missed = scores[kind].occupied.tolist()
        print(f"| {kind} | {both / max(1, told):.3f} | {both / max(1, true):.3f} | {missed / max(1, walls):.3f} |")
    print("\n| IoU | " + " | ".join(kinds) + " |\n|---|" + "---|" * len(kinds))
    for number, name in list(enumerate(classes))[FREE_FLOOR:]:
        print(f"| {name} | " + " | ".join(f"{scores[kind].overlaps.iou[number]:.2f}" for kind in kinds) + " |")
    shown = [kind for kind in kinds if kind in (*ESTIMATORS, LEARNED)]
    print("\n| probability | " + " | ".join(f"{kind}: cells, right" for kind in shown) + " |")
    print("|---|" + "---|" * len(shown))
    for number in range(BINS):
        row = " | ".join(bin_of(scores[kind].reliability, number) for kind in shown)
        print(f"| {number / BINS:.1f} to {(number + 1) / BINS:.1f} | {row} |")


def summary(kind: str, score: Score) -> str:
    """A row: means over classes that are there."""
    iou = score.overlaps.iou[FREE_FLOOR:]
    edges = (np.nanmean(one.f1[FREE_FLOOR:]) for one in score.boundaries)
    told = score.reliability
    values = (np.nanmean(iou), score.overlaps.mean_objects, *edges, told.error, told.brier)
    return f"| {kind} | " + " | ".join(f"{v:.3f}" for v in values) + f" | {score.right / score.cells:.1%} |"


def bin_of(told: Reliability, number: int) -> str:
    """How many cells are about so sure, and which share of them is right."""
    cells, right = int(told.cells[number]), int(told.right[number])
    return f"{cells:,}, {right / cells:.2f}" if cells else "-"


if __name__ == "__main__":
    main()
