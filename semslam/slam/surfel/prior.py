"""A map made before, as a file: the places table (data_spec.md, table 16) and back.

A reader needs nothing else: the semantic map is laid out again from the observations of its keyframes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import planar
from semslam.geometry.grid import Planes, to_dense, to_sparse
from semslam.labels import UNOBSERVED
from semslam.slam.evidence import Evidence
from semslam.slam.surfel.places import Keyframe, Place, placed
from semslam.slam.surfel.registration import Submap
from semslam.slam.surfel.semantic_field import ClassMap
from semslam.slam.surfel.sight import Sight
from semslam.slam.surfel.surfels import Surfels
from semslam.tables.parquet import TableFiles, made_by, rows_of
from semslam.tables.pictures import decode_depth, encode_depth
from semslam.tables.spec import PLACES

_COMMAND = "semslam run LOG --estimator surfel --out OUT"
"""What makes a map."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The observation of a keyframe, sparse."""

    cells: NDArray[np.uint32]
    weights: NDArray[np.float32]

    @staticmethod
    def of(planes: Planes | None) -> Seen:
        """Of dense planes; empty of none."""
        if planes is None:
            return Seen(np.zeros(0, np.uint32), np.zeros(0, np.float32))
        return Seen(*to_sparse(planes))


@dataclass(frozen=True)
class Grid:
    """What observations are made of."""

    classes: tuple[str, ...]
    cell_m: float
    side: int

    @staticmethod
    def of(meta: Mapping[str, Any]) -> Grid:
        """That of a table, by what it says of itself; KeyError, TypeError or ValueError if it does not."""
        return Grid(tuple(meta["classes"]), float(meta["cell_m"]), int(meta["side"]))

    @property
    def told(self) -> str:
        """For messages."""
        return f"{self.side} x {self.side} cells of {self.cell_m:g} m, {', '.join(self.classes)}"

    def dense(self, seen: Seen) -> Planes | None:
        """(L, side, side); None if nothing was observed."""
        if not len(seen.cells):
            return None
        planes = to_dense(seen.cells, seen.weights, (len(self.classes), self.side, self.side))
        planes[UNOBSERVED] = ~planes[1:].any(0)
        return planes


@dataclass(frozen=True, eq=False)
class Remembered:
    """A keyframe that a map knows: a row of the places table."""

    frame: int
    stamp_nanos: int
    place: Place
    seen: Seen


def submap_of(places: Sequence[Place], seen: Iterable[Seen], grid: Grid) -> Submap:
    """Places with what their observations saw where."""
    evidence = Evidence(grid.cell_m, grid.side)
    for place, one in zip(places, seen, strict=True):
        planes = grid.dense(one)
        if planes is not None:
            evidence.add(planes, planar(place.pose), 0)
    return Submap(places, ClassMap.of(evidence.seen(), grid.cell_m, grid.classes))


def place_row(frame: int, stamp_nanos: int, place: Place, seen: Seen) -> dict[str, list[Any]]:
    """A row of the places table; the place has a picture."""
    keyframe = place.keyframe
    if keyframe is None:
        raise ValueError("a place without a picture")
    surfels, sight = keyframe.surfels, keyframe.sight
    row = {
        "frame": frame,
        "stamp_nanos": stamp_nanos,
        "map_from_robot": place.pose.ravel(),
        "points": surfels.points.astype(np.float32).ravel(),
        "normals": surfels.normals.astype(np.float32).ravel(),
        "sigma_m": surfels.sigma_m.astype(np.float32),
        "depth": encode_depth(sight.depth_m),
        **dict(zip(("fx", "fy", "cx", "cy"), sight.intrinsics, strict=True)),
        "robot_from_camera": sight.robot_from_camera.ravel(),
        "cells": seen.cells,
        "weights": seen.weights,
    }
    return {name: [value] for name, value in row.items()}


def read_prior(path: Path, grid: Grid) -> Submap:
    """A map made before.

    Raises:
        SemslamError: it is no such file, or its observations are of other classes or cells than `grid`.
    """
    with made_by(_COMMAND):
        known = remembered(open_prior(path, grid), grid, f"map `{path}`")
    return submap_of([one.place for one in known], [one.seen for one in known], grid)


def remembered(table: TableFiles, grid: Grid, name: str) -> list[Remembered]:
    """All keyframes of a places table, whose observations are of that grid; `name` is what messages call it.

    Raises:
        SemslamError: a row is no place.
    """
    known: list[Remembered] = []
    try:
        for row in rows_of(table.batches(batch_rows=8)):
            known.append(_remembered(row, grid))
    except (ValueError, IndexError) as error:
        raise SemslamError(
            f"Row {len(known)} of {name} is no place: {error}", hint=f"make it again: `{_COMMAND}`"
        ) from error
    return known


def open_prior(path: Path, grid: Grid) -> TableFiles:
    """The table of a map made before, if it suits the log.

    Raises:
        SemslamError: it is no such file, or its observations are of other classes or cells than `grid`.
    """
    with made_by(_COMMAND):
        table = TableFiles(PLACES, [path])
    try:
        theirs = Grid.of(table.meta)
    except (KeyError, TypeError, ValueError) as error:
        raise SemslamError(
            f"Map `{path}` does not say what its observations are made of", hint="make it again with this semslam"
        ) from error
    if theirs != grid:
        raise SemslamError(
            f"Map `{path}` was made of other observations than this log",
            details=f"map: {theirs.told}\nlog: {grid.told}",
            hint="run both logs with the same detector and the same `[extract]`",
        )
    return table


def _remembered(row: dict[str, Any], grid: Grid) -> Remembered:
    seen = Seen(np.array(row["cells"], np.uint32), np.array(row["weights"], np.float32))
    if len(seen.cells) != len(seen.weights) or (seen.cells >= len(grid.classes) * grid.side**2).any():
        raise ValueError("its observation does not suit the classes and the side")
    return Remembered(row["frame"], row["stamp_nanos"], _place(row), seen)


def _place(row: dict[str, Any]) -> Place:
    points, normals = (np.array(row[name], np.float64).reshape(-1, 3) for name in ("points", "normals"))
    surfels = Surfels(points, normals, np.array(row["sigma_m"], np.float64))
    robot_from_camera = np.array(row["robot_from_camera"], np.float64).reshape(4, 4)
    intrinsics = (row["fx"], row["fy"], row["cx"], row["cy"])
    keyframe = Keyframe(surfels, Sight(decode_depth(row["depth"]), intrinsics, robot_from_camera))
    return placed(keyframe, np.array(row["map_from_robot"]).reshape(4, 4), 0.0, None, linked=True)
