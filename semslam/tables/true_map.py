"""Reading the `true_map` table back: the class map of a home, whole or as far as it had been visible at a keyframe."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.labels import UNOBSERVED
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import TRUE_MAP

NEVER = -1
"""`first_seen` of cells that no keyframe saw."""


@dataclass(frozen=True, eq=False)
class TrueMap:
    """One grid of the table, in the map frame."""

    cell_m: float
    origin_x_m: float
    """Lower corner of column 0."""
    origin_y_m: float
    """Lower corner of row 0."""
    classes: tuple[str, ...]
    class_ids: NDArray[np.int64]
    """(rows, columns) true class of every cell."""
    first_seen: NDArray[np.int64]
    """(rows, columns) keyframe that saw the cell first; `NEVER` if none did."""

    def at(self, step: int) -> NDArray[np.int64]:
        """(rows, columns) class ids of what keyframes 0 to `step` have seen; the other cells are unobserved."""
        seen = (self.first_seen != NEVER) & (self.first_seen <= step)
        return np.where(seen, self.class_ids, UNOBSERVED)


def read_true_map(path: Path, cell_m: float = 0.3) -> TrueMap:
    """The grid of a `true_map` file with cells of that size.

    Raises:
        SemslamError: the file is damaged, or has no such grid.
    """
    table = TableFiles(TRUE_MAP, [path])
    grid = _grid(table.meta, cell_m, path)
    rows = table.read()
    chosen = np.asarray(rows["cell_m"]) == grid["cell_m"]
    place = np.asarray(rows["row"], np.int64)[chosen], np.asarray(rows["column"], np.int64)[chosen]
    first = np.array([NEVER if frame is None else frame for frame in rows["first_seen_frame"]], np.int64)
    shape = grid["rows"], grid["columns"]
    class_ids, first_seen = np.full(shape, UNOBSERVED, np.int64), np.full(shape, NEVER, np.int64)
    class_ids[place], first_seen[place] = np.asarray(rows["class_id"], np.int64)[chosen], first[chosen]
    origin = grid["origin_x_m"], grid["origin_y_m"]
    return TrueMap(grid["cell_m"], *origin, tuple(table.meta["classes"]), class_ids, first_seen)


def map_at(path: Path, step: int, cell_m: float = 0.3) -> NDArray[np.int64]:
    """(rows, columns) class ids of what had been visible at a keyframe; `read_true_map` serves many steps sooner."""
    return read_true_map(path, cell_m).at(step)


def _grid(meta: Any, cell_m: float, path: Path) -> dict[str, Any]:
    for grid in meta["grids"]:
        if abs(grid["cell_m"] - cell_m) < 1e-9:
            found: dict[str, Any] = grid
            return found
    sizes = ", ".join(f"{grid['cell_m']:g}" for grid in meta["grids"])
    raise SemslamError(f"`{path}` has no grid of {cell_m:g} m cells", hint=f"it has cells of {sizes} m")
