"""Maps that grow: squares of 64 x 64 cells, made where something is laid down, numbered by row and column from the
origin of the map frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from semslam.geometry.frames import SE2

TILE = 64
LARGEST_M = 1e7
"""Poses beyond this are off any map; what they saw is left out."""
LARGEST_CELL = 1 << 30
"""Nor is a cell beyond this on any map: tables hold 32 bits, and an observation reaches farther than its pose."""

TilePlace = tuple[int, int]
"""Row and column of a tile."""
Window = tuple[slice, slice]
"""Rows and columns."""


def on_map(pose: SE2, cell_m: float) -> bool:
    """Whether a pose is near enough to be one. Not so if it is no number."""
    largest_m = min(LARGEST_M, LARGEST_CELL * cell_m)
    return abs(pose.x_m) < largest_m and abs(pose.y_m) < largest_m and math.isfinite(pose.heading_rad)


def tiles_under(left: int, low: int, shape: tuple[int, int]) -> Iterator[tuple[TilePlace, Window, Window]]:
    """Tiles beneath an array of cells whose first column is `left` and whose first row is `low`: the place of each,
    with the window of the tile and the window of the array that meet."""
    rows, columns = shape
    for tile_y in range(low // TILE, (low + rows - 1) // TILE + 1):
        for tile_x in range(left // TILE, (left + columns - 1) // TILE + 1):
            window_y, part_y = _overlap(tile_y * TILE, low, rows)
            window_x, part_x = _overlap(tile_x * TILE, left, columns)
            yield (tile_y, tile_x), (window_y, window_x), (part_y, part_x)


def _overlap(tile_start: int, start: int, length: int) -> Window:
    """Where a tile and [start, start + length) meet, seen from the tile and from the other."""
    first, last = max(tile_start, start), min(tile_start + TILE, start + length)
    return slice(first - tile_start, last - tile_start), slice(first - start, last - start)
