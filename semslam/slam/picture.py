"""What a map picture shows: cells and a path, as plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.labels import FIRST_OBJECT


@dataclass(frozen=True)
class MapCells:
    """The cells of a map and what they were made with."""

    ix: NDArray[np.int64]
    iy: NDArray[np.int64]
    class_id: NDArray[np.int64]
    classes: tuple[str, ...]
    cell_m: float

    @staticmethod
    def of(rows: Mapping[str, Sequence[Any]], meta: Mapping[str, Any]) -> MapCells:
        """Of the columns of a cells table and what it says of itself."""
        ix, iy, class_id = (np.array(rows[name], np.int64) for name in ("ix", "iy", "class_id"))
        return MapCells(ix, iy, class_id, tuple(meta["classes"]), float(meta["cell_m"]))

    def objects(self) -> list[int]:
        """Object classes on the map, most cells first, then by class id."""
        present, counts = np.unique(self.class_id[self.class_id >= FIRST_OBJECT], return_counts=True)
        return [int(class_id) for class_id in present[np.lexsort((present, -counts))]]

    def count(self, class_id: int) -> int:
        """Cells of a class."""
        return int(np.count_nonzero(self.class_id == class_id))


@dataclass(frozen=True)
class Path:
    """Positions by keyframe, map frame; NaN where a keyframe has no pose."""

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    starts: tuple[int, ...] = ()
    """Keyframes at which the path of another log begins."""

    @property
    def parts(self) -> list[Path]:
        """The path of each log by itself."""
        pieces = zip(np.split(self.x_m, self.starts), np.split(self.y_m, self.starts), strict=True)
        return [Path(x, y) for x, y in pieces]

    @property
    def posed(self) -> NDArray[np.float64]:
        """(N, 2): the positions that are known."""
        return np.stack([self.x_m, self.y_m], 1)[~np.isnan(self.x_m)]

    @property
    def length_m(self) -> float:
        """From known position to known position of one log."""
        return float(sum(np.hypot(*np.diff(part.posed, axis=0).T).sum() for part in self.parts))


def map_subtitle(cells: MapCells, path: Path, estimator: str) -> str:
    """What a map was made of, in a line."""
    keyframes = f"{len(path.x_m):,} keyframes"
    posed = len(path.posed)
    if posed < len(path.x_m):
        keyframes += f", {posed:,} with a pose"
    return "  ·  ".join([f"estimator {estimator}", keyframes, f"cell {cells.cell_m:.2f} m", f"{len(cells.ix):,} cells"])
