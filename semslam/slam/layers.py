"""Occupancy and heights of a map from the depth of its keyframes: a column of slices above each cell.

Each slice holds the log-odds of being occupied: what hits it adds `HIT`, what sees through it (depth_sight.py) adds
`PASS`, within bounds, so that somebody who stood there is forgotten once he has gone. They are whole numbers of
1 / `STEPS`, so that sums are exact. A cell is as occupied as the most occupied of its slices. It is free only if all
its slices, from the lowest to the highest about which anything is known, were seen through: rays that pass high above
a bed say nothing of the bed, nor does floor that was seen beneath it.

Heights are counted in bins, once a keyframe. The floor is the median of what is below the obstacles, the top the 90th
percentile within the highest occupied slice: neither hangs on a single pixel.

Memory grows with the mapped area, in tiles of 64 x 64 cells, not with time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2
from semslam.slam.depth_sight import BIN_M, BINS, SLICE_M, Columns, DepthImage, Sight, look
from semslam.slam.tiles import TILE, TilePlace, Window, on_map, tiles_under
from semslam.stages.settings import ExportConfig

STEPS = 16
HIT, PASS = 32, -24
"""Two natural units (probability 0.88) and one and a half (0.18)."""
LEAST, MOST = -64, 96
FREE_SHARE = 0.5
"""Share of the slices, from the lowest on, that must have been seen through in a free cell."""
TOP, FLOOR = 0.9, 0.5
"""Shares of the heights that lie below what is told."""

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LayerCells:
    """Cells about which something is known, by row, then column; NaN where a value is not."""

    ix: NDArray[np.int64]
    iy: NDArray[np.int64]
    occupancy: _Floats
    """Probability."""
    floor_m: _Floats
    top_m: _Floats
    points: NDArray[np.uint32]
    views: NDArray[np.uint32]
    columns: Columns
    keyframes: int
    """In whose depth anything was near enough."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) of which cells occupancy is known; of the others only a height is."""
        return ~np.isnan(self.occupancy)

    def rows(self) -> dict[str, list[Any]]:
        """Of the layers table."""
        return {
            "ix": self.ix.tolist(),
            "iy": self.iy.tolist(),
            "x_m": ((self.ix + 0.5) * self.columns.cell_m).tolist(),
            "y_m": ((self.iy + 0.5) * self.columns.cell_m).tolist(),
            **{name: _nullable(getattr(self, name)) for name in ("occupancy", "floor_m", "top_m")},
            "points": self.points.tolist(),
            "views": self.views.tolist(),
        }

    def about(self, estimator: str) -> dict[str, Any]:
        """The table's metadata."""
        return {
            "cell_m": self.columns.cell_m,
            "min_obstacle_height_m": self.columns.low_m,
            "max_obstacle_height_m": self.columns.high_m,
            "estimator": estimator,
        }


def _nullable(values: _Floats) -> list[float | None]:
    """Values with None for NaN."""
    return [None if value != value else value for value in values.tolist()]


class _Tile:
    """64 x 64 cells, [iy, ix]."""

    def __init__(self, columns: Columns) -> None:
        self.odds = np.zeros((columns.slices, TILE, TILE), np.int8)
        self.heights = np.zeros((columns.bins, TILE, TILE), np.uint8)
        """Keyframes that saw something so high, at most 255."""
        self.points = np.zeros((TILE, TILE), np.uint32)
        self.views = np.zeros((TILE, TILE), np.uint32)

    def take(self, window: Window, sight: Sight, part: Window) -> None:
        """Add the part of a sight that lies over a window of the tile."""
        rows, columns = part
        change = np.int8(HIT) * sight.hit[:, rows, columns] + np.int8(PASS) * sight.passed[:, rows, columns]
        odds = self.odds[:, window[0], window[1]]
        summed = np.clip(odds.astype(np.int16) + change, LEAST, MOST)
        even = (summed == 0) & ((change != 0) | (odds != 0))  # zero is what nothing is known of
        odds[...] = np.where(even, np.where(change < 0, -1, 1), summed)
        self.views[window] += sight.seen[part]
        level, row, column = sight.marks
        inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
        place = row[inside] + window[0].start - rows.start, column[inside] + window[1].start - columns.start
        np.add.at(self.points, place, sight.pixels[inside].astype(np.uint32))
        heights = self.heights[level[inside], *place]
        self.heights[level[inside], *place] = heights + (heights < 255)


class Layers:
    """Accumulates depth images at poses; gives cells."""

    def __init__(self, columns: Columns) -> None:
        self._columns = columns
        self._tiles: dict[TilePlace, _Tile] = {}
        self._keyframes = 0

    @staticmethod
    def of(config: ExportConfig) -> Layers:
        """Empty ones as configured."""
        low_m, high_m = config.min_obstacle_height_m, config.max_obstacle_height_m
        return Layers(Columns(config.layer_cell_m, low_m, high_m, config.layer_depth_m))

    def add(self, image: DepthImage, map_from_robot: SE2) -> bool:
        """Take up one keyframe. False if its pose is too far away to be one."""
        if not on_map(map_from_robot, self._columns.cell_m):
            return False
        sight = look(image, map_from_robot, self._columns)
        if sight is not None:
            for place, window, part in tiles_under(sight.left, sight.low, sight.seen.shape):
                if sight.seen[part].any():
                    if place not in self._tiles:
                        self._tiles[place] = _Tile(self._columns)
                    self._tiles[place].take(window, sight, part)
            self._keyframes += 1
        return True

    def cells(self) -> LayerCells:
        """All cells of which anything is known."""
        parts = [_known(place, tile, self._columns) for place, tile in sorted(self._tiles.items())]
        parts = parts or [_known((0, 0), _Tile(self._columns), self._columns)]
        whole = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        order = np.lexsort((whole[0], whole[1]))
        ix, iy, occupancy, floor_m, top_m, points, views = (field[order] for field in whole)
        return LayerCells(ix, iy, occupancy, floor_m, top_m, points, views, self._columns, self._keyframes)


def _known(place: tuple[int, int], tile: _Tile, columns: Columns) -> tuple[NDArray[Any], ...]:
    """The fields of `LayerCells`, in order, of the cells of a tile about which something is known."""
    row, column = np.nonzero(tile.views)
    odds, heights = tile.odds[:, row, column].T, tile.heights[:, row, column].T
    occupancy, below = _occupancy(odds), columns.below * BINS
    floor = _percentile(heights[:, :below], np.full(len(row), columns.base_m), FLOOR)
    top = _tops(odds, heights[:, below:], columns)
    kept = ~(np.isnan(occupancy) & np.isnan(floor) & np.isnan(top))
    ix, iy = place[1] * TILE + column, place[0] * TILE + row
    points, views = tile.points[row, column], tile.views[row, column]
    return tuple(field[kept] for field in (ix, iy, occupancy, floor, top, points, views))


def _occupancy(odds: NDArray[np.int8]) -> _Floats:
    """Probabilities (n,) of log-odds (n, slices); NaN where nothing was found and too little was seen through."""
    seen = np.where(odds == 0, np.int8(LEAST), odds).max(1)
    height = np.where(odds != 0, np.arange(1, odds.shape[1] + 1), 0).max(1)
    whole = ((odds != 0).sum(1) == height) & (height >= FREE_SHARE * odds.shape[1])
    return np.where(whole | (seen > 0), 1.0 / (1.0 + np.exp(-seen / STEPS)), np.nan)


def _tops(odds: NDArray[np.int8], heights: NDArray[np.uint8], columns: Columns) -> _Floats:
    """(n,) top within the highest occupied slice; NaN where none is."""
    occupied = odds > 0
    highest = occupied.shape[1] - 1 - occupied[:, ::-1].argmax(1)
    by_slice = heights.reshape(*occupied.shape, BINS)[np.arange(len(highest)), highest]
    top = _percentile(by_slice, columns.low_m + highest * SLICE_M, TOP)
    return np.where(occupied.any(1), np.minimum(top, columns.high_m), np.nan)


def _percentile(counts: NDArray[np.uint8], start_m: _Floats, share: float) -> _Floats:
    """Heights (n,) below which a share of what bins (n, bins) from `start_m` counted lies; NaN where they are empty."""
    up_to = counts.cumsum(1, dtype=np.int64)
    wanted = share * up_to[:, -1]
    number = (up_to < wanted[:, None]).sum(1)
    inside = np.take_along_axis(counts, np.minimum(number, counts.shape[1] - 1)[:, None], 1)[:, 0].astype(np.float64)
    before = np.take_along_axis(up_to, np.minimum(number, counts.shape[1] - 1)[:, None], 1)[:, 0] - inside
    part = np.divide(wanted - before, inside, out=np.full(len(counts), np.nan), where=up_to[:, -1] > 0)
    return np.asarray(start_m + (number + part) * BIN_M)
