"""Drives to learn from: what each keyframe saw, how the robot moved, and what there was to know.

Reads   splits, true_map, truth     data_spec.md, tables 12, 13 and 4, of a data set
        obstructed, ideal           table 6, of a data set: the paper's two better qualities of observations
        observations, motion        tables 6 and 3, of a run over the data set's logs: real camera, and u_t

Rows are joined by `stamp_nanos`. Observations are pooled to the paper's cells as the estimator does and kept sparse:
some hundred numbers a keyframe, dense only where a batch needs them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes, object_planes, pool_observation, to_dense, to_sparse
from semslam.labels import UNOBSERVED
from semslam.stages.settings import PaperConfig
from semslam.tables.parquet import TableFiles, made_by, rows_of
from semslam.tables.spec import MOTION, OBSERVATIONS, SPLITS, TRUTH
from semslam.tables.true_map import TrueMap, read_true_map

REAL, OBSTRUCTED, IDEAL = "real", "obstructed", "ideal"
QUALITIES = (REAL, OBSTRUCTED, IDEAL)
"""Real camera: what extract makes of the log. Obstructed: true masks and depth. Ideal: true labels of the window."""
PROTOCOLS = ("cross", "intra")
PARTS = ("train", "test")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RunTables:
    """Files of a log's tables in the output folder of a run."""

    motion: tuple[Path, ...]
    observations: tuple[Path, ...] = ()
    """Needed for real camera only."""


@dataclass(frozen=True, eq=False)
class Sights:
    """Observations of T keyframes, sparse."""

    shape: tuple[int, int, int]
    """(L, h, h) of one."""
    seen: NDArray[np.bool_]
    """(T,) False where a keyframe has no observation."""
    starts: NDArray[np.int64]
    """(T + 1,) where the entries of each keyframe begin."""
    cells: NDArray[np.uint32]
    weights: NDArray[np.float32]

    @staticmethod
    def of(planes: Iterable[Planes | None], shape: tuple[int, int, int]) -> Sights:
        """Keep what is not zero."""
        nothing = np.zeros(0, np.uint32), np.zeros(0, np.float32)
        kept = [(one is not None, *(nothing if one is None else to_sparse(one))) for one in planes]
        starts = np.cumsum([0, *(len(cells) for _, cells, _ in kept)])
        cells = np.concatenate([nothing[0], *(cells for _, cells, _ in kept)])
        weights = np.concatenate([nothing[1], *(weights for _, _, weights in kept)])
        return Sights(shape, np.array([seen for seen, _, _ in kept], bool), starts, cells, weights)

    def dense(self) -> NDArray[np.float32]:
        """(T, L, h, h), all zero where there is no observation."""
        step = np.repeat(np.arange(len(self.seen)), np.diff(self.starts))
        result = np.zeros((len(self.seen), *self.shape), np.float32)
        result.reshape(len(self.seen), -1)[step, self.cells] = self.weights
        return result

    def first(self, keyframes: int) -> Sights:
        """Those of the first keyframes alone."""
        end = self.starts[: keyframes + 1][-1]
        starts = self.starts[: keyframes + 1]
        return Sights(self.shape, self.seen[:keyframes], starts, self.cells[:end], self.weights[:end])

    def mirrored(self) -> Sights:
        """Left is right."""
        side = np.uint32(self.shape[2])
        row, column = np.divmod(self.cells, side)  # (class_id * side + iy), ix
        cells = (row + side - 1 - 2 * (row % side)) * side + column
        return replace(self, cells=cells)


@dataclass(frozen=True, eq=False)
class Drive:
    """T keyframes of one log and its true map."""

    name: str
    sights: Sights
    motion: Floats
    """(T, 3) dx, dy in metres and turn in radians since the previous keyframe, in its robot frame; NaN if unknown."""
    poses: Floats
    """(T, 3) true x, y and heading in the map frame of the log."""
    labels: NDArray[np.int64]
    """(H, W) true class of every cell."""
    first_seen: NDArray[np.int64]
    """(H, W) step to which a cell was visible first; T or more if to none."""

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def observations(self) -> NDArray[np.float32]:
        """(T, L, h, h)"""
        return self.sights.dense()

    def visible(self, step: int) -> NDArray[np.int64]:
        """(H, W) the class map visible so far: true classes of what steps 0 to `step` saw, else unobserved."""
        return np.where(self.first_seen <= step, self.labels, UNOBSERVED)


@dataclass(frozen=True, eq=False)
class DriveSet:
    """Drives of one quality, with the same classes and cells."""

    drives: tuple[Drive, ...]
    classes: tuple[str, ...]
    """The reserved ones first."""
    quality: str
    paper: PaperConfig
    """Its cells, side, noise floor and binary option are those of the observations."""
    origin: str = ""
    """The data set, as a card names it."""

    @staticmethod
    def open(
        dataset: Path,
        logs: Sequence[str],
        quality: str = REAL,
        *,
        run: Mapping[str, RunTables] | None = None,
        paper: PaperConfig | None = None,
        watch: Callable[[int, int], None] | None = None,
    ) -> DriveSet:
        """Read drives of a data set.

        Args:
            dataset: folder that `semslam simulate` made.
            logs: names of logs.
            quality: one of `QUALITIES`.
            run: tables of a run over these logs, by log; without one there is no motion and no real camera.
            paper: cells and thresholds of the observations; None takes the defaults.
            watch: hears how many logs of how many are read.

        Raises:
            SemslamError: a log or table is missing or damaged, or the pieces do not fit together.
        """
        if not logs:
            raise SemslamError(f"No logs of `{dataset}` to read", hint="make more scenes: `semslam simulate`")
        if quality == REAL and run is None:
            raise SemslamError(
                "Real-camera observations come from a run",
                hint=f"`semslam run {dataset}/logs --out RUN`, then `--run RUN`; or `--quality obstructed`",
            )
        config, read = paper or PaperConfig(), []
        for done, log in enumerate(logs, 1):
            read.append(_drive(dataset, log, quality, _tables(run, log, quality), config))
            if watch:
                watch(done, len(logs))
        _require_equal(read)
        return DriveSet(tuple(drive for drive, _ in read), read[0][1], quality, config, dataset.resolve().name)

    def __len__(self) -> int:
        return len(self.drives)

    @property
    def map_side(self) -> int:
        """Cells along a side of the maps."""
        return int(self.drives[0].labels.shape[0])

    @property
    def longest(self) -> int:
        """Keyframes of the longest drive."""
        return max(len(drive) for drive in self.drives)

    @property
    def has_motion(self) -> bool:
        """Whether any keyframe knows how the robot moved."""
        return any(np.isfinite(drive.motion[1:]).all(1).any() for drive in self.drives)

    @cached_property
    def digest(self) -> str:
        """Of everything that is learned from."""
        told = hashlib.sha256(repr((self.classes, self.quality)).encode())
        for drive in self.drives:
            sights = drive.sights
            told.update(repr((drive.name, sights.shape)).encode())
            for part in (sights.seen, sights.starts, sights.cells, sights.weights, drive.motion, drive.poses):
                told.update(np.ascontiguousarray(part).tobytes())
            told.update(drive.labels.tobytes() + drive.first_seen.tobytes())
        return told.hexdigest()[:16]


def logs_of(dataset: Path, protocol: str, part: str) -> tuple[str, ...]:
    """Names of the logs that train or test under a protocol.

    Raises:
        SemslamError: no data set there, or too small a one for the protocol.
    """
    path = dataset / "splits.parquet"
    if not path.is_file():
        raise SemslamError(
            f"`{dataset}` is no data set: it has no `splits.parquet`", hint=f"make one: `semslam simulate {dataset}`"
        )
    with made_by(simulating(dataset)):
        rows = TableFiles(SPLITS, [path]).read(["log", protocol])
    names = tuple(log for log, side in zip(rows["log"], rows[protocol], strict=True) if side == part)
    if not names:
        more = "--scenes" if protocol == "cross" else "--trajectories"
        raise SemslamError(
            f"No log of `{dataset}` is there to {part} under `{protocol}`",
            hint=f"make a larger data set: `semslam simulate {dataset} {more} 3`",
        )
    return names


def simulating(dataset: Path) -> str:
    """What makes damaged files of a data set again."""
    return f"semslam simulate {dataset} --verify"


def _tables(run: Mapping[str, RunTables] | None, log: str, quality: str) -> RunTables | None:
    if run is None:
        return None
    if log not in run or (quality == REAL and not run[log].observations):
        raise SemslamError(
            f"The run has no finished `{'extract' if log in run else 'ingest'}` of `{log}`",
            hint="run the whole data set: `semslam run DATASET/logs --out RUN`",
        )
    return run[log]


def _drive(
    dataset: Path, log: str, quality: str, tables: RunTables | None, config: PaperConfig
) -> tuple[Drive, tuple[str, ...]]:
    """A drive and its classes."""
    folder = dataset / "truth" / log
    if not folder.is_dir():
        raise SemslamError(f"`{dataset}` has no log `{log}`", hint=f"`ls {dataset}/truth` lists them")
    with made_by(simulating(dataset)):
        stamps, poses = _true_poses(TableFiles(TRUTH, [folder / "truth.parquet"]))
    keyframes, motion = (stamps, np.full((len(stamps), 3), np.nan)) if tables is None else _motion(tables.motion)
    pairs = _pairs(keyframes, stamps, log)
    paths = tables.observations if tables and quality == REAL else (folder / f"{quality}.parquet",)
    with nullcontext() if quality == REAL else made_by(simulating(dataset)):
        sights, classes = _sights(TableFiles(OBSERVATIONS, paths), keyframes, config)
    with made_by(simulating(dataset)):
        truth = read_true_map(folder / "true_map.parquet", config.cell_m)
    labels, first_seen = _wanted(truth, classes, pairs, log)
    return Drive(log, sights, motion, poses[pairs], labels, first_seen), classes


def _true_poses(table: TableFiles) -> tuple[NDArray[np.int64], Floats]:
    """(P,) stamps of a log's image pairs and (P, 3) where the robot was, in the frame of the first."""
    rows = table.read(["stamp_nanos", "x_m", "y_m", "heading_rad"])
    world = [SE2(*row) for row in zip(rows["x_m"], rows["y_m"], rows["heading_rad"], strict=True)]
    poses = [world[0].between(one) for one in world]
    return np.array(rows["stamp_nanos"], np.int64), np.array([(p.x_m, p.y_m, p.heading_rad) for p in poses])


def _motion(paths: tuple[Path, ...]) -> tuple[NDArray[np.int64], Floats]:
    """(T,) stamps of the keyframes and (T, 3) motion."""
    rows = TableFiles(MOTION, paths).read(["stamp_nanos", "dx_m", "dy_m", "dheading_rad"])
    parts = [np.array(rows[name], np.float64) for name in ("dx_m", "dy_m", "dheading_rad")]  # null becomes NaN
    return np.array(rows["stamp_nanos"], np.int64), np.stack(parts, 1)


def _pairs(keyframes: NDArray[np.int64], stamps: NDArray[np.int64], log: str) -> NDArray[np.int64]:
    """(T,) the image pair of each keyframe.

    Raises:
        SemslamError: there is no keyframe, or one that is no image pair.
    """
    if not len(keyframes):
        raise SemslamError(f"`{log}` has no keyframes", hint="make the data set again with more `--steps`")
    found = np.minimum(np.searchsorted(stamps, keyframes), len(stamps) - 1)
    strangers = int((stamps[found] != keyframes).sum())
    if strangers:
        raise SemslamError(
            f"{strangers} of {len(keyframes)} keyframes of `{log}` are not in the data set's truth",
            hint="name the run over this very data set: `semslam run DATASET/logs --out RUN`",
        )
    return found


def _sights(table: TableFiles, keyframes: NDArray[np.int64], config: PaperConfig) -> tuple[Sights, tuple[str, ...]]:
    """Observations of the keyframes in the paper's cells, and their classes."""
    classes, side = tuple(table.meta["classes"]), int(table.meta["side"])
    factor = _pooling_factor(config, float(table.meta["cell_m"]), side)
    found = dict(_pooled(table, set(keyframes.tolist()), (len(classes), side, side), factor, config))
    shape = len(classes), config.side, config.side
    return Sights.of((found.get(stamp) for stamp in keyframes.tolist()), shape), classes


def _pooled(
    table: TableFiles, wanted: set[int], shape: tuple[int, int, int], factor: int, config: PaperConfig
) -> Iterator[tuple[int, Planes]]:
    """Stamp and coarse planes of each row that is wanted."""
    for row in rows_of(table.batches(["stamp_nanos", "cells", "weights"])):
        if row["stamp_nanos"] in wanted:
            yield row["stamp_nanos"], coarse_observation(row["cells"], row["weights"], shape, factor, config)


def coarse_observation(
    cells: Sequence[int], weights: Sequence[float], shape: tuple[int, int, int], factor: int, config: PaperConfig
) -> Planes:
    """An observation as the paper's estimator looks at it: pooled, without noise below beta, binary if asked."""
    fine = to_dense(np.array(cells, np.uint32), np.array(weights, np.float32), shape)
    fine[UNOBSERVED] = ~fine[1:].any(0)
    planes = pool_observation(fine, factor, config.side)
    objects = object_planes(planes)
    objects[objects < config.noise_floor] = 0.0
    if config.binary:
        objects[objects > 0.0] = 1.0
    return planes


def _pooling_factor(config: PaperConfig, cell_m: float, side: int) -> int:
    """Fine cells along a side of a coarse one.

    Raises:
        SemslamError: coarse cells are no odd number of fine ones, or reach beyond them.
    """
    factor = round(config.cell_m / cell_m)
    fits = factor % 2 == 1 and abs(factor * cell_m - config.cell_m) < 1e-6 * config.cell_m
    if not fits or config.side % 2 == 0 or config.side * factor >= side + 2 * factor:
        raise SemslamError(
            f"Observations of {side} cells of {cell_m:g} m do not give {config.side} cells of {config.cell_m:g} m",
            hint=f"take an odd `--side` of {side // max(1, factor)} or less",
        )
    return factor


def _wanted(
    truth: TrueMap, classes: tuple[str, ...], pairs: NDArray[np.int64], log: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(H, W) true classes, as the observations number them, and the step that saw each cell first (T for none).

    Raises:
        SemslamError: the true map has a class that the observations lack.
    """
    missing = sorted(set(truth.classes) - set(classes))
    if missing:
        raise SemslamError(
            f"The true map of `{log}` has classes that its observations lack: {', '.join(missing)}",
            details=f"observations: {', '.join(classes)}",
            hint="run with a detector of all classes of the data set",
        )
    number = np.array([classes.index(name) for name in truth.classes], np.int64)
    never = truth.first_seen < 0
    return number[truth.class_ids], np.where(never, len(pairs), np.searchsorted(pairs, truth.first_seen))


def _require_equal(read: Sequence[tuple[Drive, tuple[str, ...]]]) -> None:
    first, classes = read[0]
    for drive, others in read:
        if others != classes or drive.labels.shape != first.labels.shape:
            raise SemslamError(
                f"`{drive.name}` has other classes or another map than `{first.name}`",
                details=f"{first.name}: {', '.join(classes)}\n{drive.name}: {', '.join(others)}",
                hint="run all logs with one configuration",
            )


def shortened(drive: Drive, keyframes: int) -> Drive:
    """The beginning of the drive; cells that are visible later only are then visible to no step."""
    return replace(
        drive,
        sights=drive.sights.first(keyframes),
        motion=drive.motion[:keyframes],
        poses=drive.poses[:keyframes],
    )


def mirrored(drive: Drive) -> Drive:
    """The drive as a mirror at its start's x axis shows it: left is right."""
    flip = np.array([1.0, -1.0, -1.0])
    labels, first_seen = drive.labels[::-1].copy(), drive.first_seen[::-1].copy()
    return Drive(drive.name, drive.sights.mirrored(), drive.motion * flip, drive.poses * flip, labels, first_seen)


def turned(drive: Drive, quarters: int) -> Drive:
    """The drive in a map frame turned so that everything in it is turned left by quarters about the middle.

    What the robot sees and how it moves stays the same.
    """
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    x, y, heading = drive.poses.T
    poses = np.stack([cosine * x - sine * y, sine * x + cosine * y, heading + quarters * np.pi / 2], 1)
    labels, first_seen = (np.rot90(grid, -quarters).copy() for grid in (drive.labels, drive.first_seen))
    return Drive(drive.name, drive.sights, drive.motion, poses, labels, first_seen)
