"""The map that users get from any pose track: who was seen where, how often, and when.

Each keyframe's fine observation is laid on the map frame's grid at the estimated pose; nearest cells, looked up from
the map's side so that no holes appear. Memory grows with the mapped area, in tiles of 64 x 64 cells, not with time.

**What a keyframe says about a cell.** One of: objects (possibly several classes), else obstacle, else free floor.
Equation 1 spreads an instance's weight 1 over all its cells, so a sofa may leave 0.005 in each of its own: what counts
as seeing a class is therefore relative. Touching cells of a class form a blob. A blob with less than `MIN_BLOB_WEIGHT`
of an instance is spill of the mask onto the background; within a blob, cells below `MIN_SHARE` of its peak are ragged
edge.

**What the keyframes together say.** A sight from distance d weighs w = 1 / (1 + (d / 3 m)^2), because depth, mask and
heading errors grow with it; E sums the weights of each class in a cell. What a cell is, and how surely, follows from
these sums and from the things around it: belief.py. A tile is read again only if it or one beside it has changed.

Two maps are compared by what was seen, not by what they make of it: there a cell is of the class of the largest E,
which counts twice for objects, because a detector that overlooks a chair reports obstacle or floor in its place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.slam.belief import Belief, Ids, hulls_of
from semslam.slam.checkpoint import pack, unpack
from semslam.slam.tiles import TILE, TilePlace, Window, on_map, tiles_under

MIN_BLOB_WEIGHT = 0.1
MIN_SHARE = 0.1
HALF_WEIGHT_M = 3.0
OBJECT_SHARE = 2.0
SNAPSHOT_HALF = 1024
"""A snapshot shows at most this many cells either way of the robot."""
SNAPSHOT_INDICES = 1 << 32
"""Numbers that a snapshot's table has for a cell of a class; with very many classes a snapshot shows less."""

_Mask = NDArray[np.bool_]
_Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Snapshot:
    """A map as sparse class planes, as the snapshots table holds it."""

    rows: int
    columns: int
    cell_m: float
    origin_x_m: float
    origin_y_m: float
    cells: NDArray[np.int64]
    """(class_id * rows + iy) * columns + ix, rising."""
    weights: NDArray[np.float32]


@dataclass
class _Tile:
    """64 x 64 cells, [iy, ix]."""

    views: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((TILE, TILE), np.uint32))
    first: NDArray[np.int64] = field(default_factory=lambda: np.zeros((TILE, TILE), np.int64))
    last: NDArray[np.int64] = field(default_factory=lambda: np.zeros((TILE, TILE), np.int64))
    hits: dict[int, NDArray[np.uint32]] = field(default_factory=dict)
    """By class id, present only for classes seen in the tile."""
    weights: dict[int, NDArray[np.float32]] = field(default_factory=dict)
    """Summed sight weights, likewise."""


@dataclass(frozen=True)
class _Patch:
    """The part of the map's grid under an observation."""

    left: int
    low: int
    source: NDArray[np.int64]
    """(rows, columns): flat observation cell under each map cell; side * side if none."""


class Evidence:
    """Accumulates observations at poses; gives cells."""

    def __init__(self, cell_m: float, side: int) -> None:
        """`cell_m` and `side` of the observations; the map has the same cells."""
        self._cell_m = cell_m
        self._side = side
        self._weight = _sight_weights(side, cell_m)
        self._tiles: dict[TilePlace, _Tile] = {}
        self._labels: dict[TilePlace, Ids] = {}
        """Of each tile by itself: what has been read since it changed."""
        self._columns: dict[TilePlace, _Columns] = {}
        """The cells of each tile, likewise since it or one beside it changed."""

    def add(self, planes: Planes, map_from_robot: SE2, stamp_nanos: int) -> bool:
        """Lay one observation (L, side, side) on the map. False if the pose is too far away to be one."""
        if not on_map(map_from_robot, self._cell_m):
            return False
        seen = np.asarray(planes[1:].any(0))
        if seen.any():
            patch = self._patch(map_from_robot, seen)
            sights = {class_id: mask for class_id, mask in sightings(planes).items() if mask.any()}
            for place, window, part in tiles_under(patch.left, patch.low, patch.source.shape):
                if (patch.source[part] < self._side**2).any():
                    tile = self._changing(place)
                    _count(tile, window, patch.source[part], seen, sights, self._weight, stamp_nanos)
        return True

    def _patch(self, map_from_robot: SE2, seen: _Mask) -> _Patch:
        """Map cells that the seen part of an observation may cover, with the observation cell under their middles."""
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        ends_x, ends_y = ((np.array([a[0], a[-1] + 1]) - 0.5 * self._side) * self._cell_m for a in (columns, rows))
        corners = map_from_robot.apply([[x, y] for x in ends_x for y in ends_y]) / self._cell_m
        left, low = (int(v) for v in np.floor(corners.min(0)))
        right, high = (int(v) + 1 for v in np.floor(corners.max(0)))
        x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(low, high) + 0.5)
        x, y = x - map_from_robot.x_m / self._cell_m, y - map_from_robot.y_m / self._cell_m
        cosine, sine = math.cos(map_from_robot.heading_rad), math.sin(map_from_robot.heading_rad)
        column = np.floor(cosine * x + sine * y + 0.5 * self._side).astype(np.int64)
        row = np.floor(cosine * y - sine * x + 0.5 * self._side).astype(np.int64)
        inside = (column >= 0) & (column < self._side) & (row >= 0) & (row < self._side)
        return _Patch(left, low, np.where(inside, row * self._side + column, self._side * self._side))

    def _changing(self, place: TilePlace) -> _Tile:
        """The tile there, to be changed: what was read of it, and of those beside it, is forgotten."""
        self._labels.pop(place, None)
        for beside in _around(place):
            self._columns.pop(beside, None)
        return self._tiles.setdefault(place, _Tile())

    def cells(self) -> _Columns:
        """Columns ix, iy, class_id, probability, hits, views, first_seen_nanos, last_seen_nanos; by iy, then ix."""
        parts = [self._cells_of(place) for place in sorted(self._tiles)]
        return _joined(parts or [_tile_cells((0, 0), _Tile(), _belief(_Tile()))])

    def seen(self) -> _Columns:
        """Columns ix, iy, class_id of what was seen most, to be compared with another map; by iy, then ix."""
        parts = [_tile_seen(place, tile) for place, tile in sorted(self._tiles.items())]
        return _joined(parts or [_tile_seen((0, 0), _Tile())])

    def _cells_of(self, place: TilePlace) -> _Columns:
        """The cells of a tile, with what the things that reach into it say."""
        if place not in self._columns:
            inner = slice(TILE, 2 * TILE)
            labels = np.block([[self._labels_of(beside) for beside in row] for row in _rows_around(place)])
            belief = _belief(self._tiles[place]).enclosed(hulls_of(labels, (inner, inner), TILE))
            self._columns[place] = _tile_cells(place, self._tiles[place], belief)
        return self._columns[place]

    def _labels_of(self, place: TilePlace) -> Ids:
        """The most probable class of each cell of a tile by itself; *unobserved* where no tile is."""
        if place not in self._tiles:
            return np.full((TILE, TILE), UNOBSERVED, np.uint16)
        if place not in self._labels:
            self._labels[place] = _belief(self._tiles[place]).labels()
        return self._labels[place]

    def snapshot(self, around: SE2) -> Snapshot:
        """The map as it stands, at most `SNAPSHOT_HALF` cells either way of a pose; empty about one off the map."""
        cells = self.cells()
        ix, iy, class_id = (cells[name].astype(np.int64) for name in ("ix", "iy", "class_id"))
        near = np.zeros(ix.shape, np.bool_)
        if ix.size and on_map(around, self._cell_m):
            half = _snapshot_half(int(class_id.max()) + 1)
            middle_x, middle_y = (math.floor(v / self._cell_m) for v in (around.x_m, around.y_m))
            near = (np.abs(ix - middle_x) <= half) & (np.abs(iy - middle_y) <= half)
        if not near.any():
            nothing = np.zeros(0, np.int64)
            return Snapshot(0, 0, self._cell_m, 0.0, 0.0, nothing, nothing.astype(np.float32))
        ix, iy, class_id = ix[near], iy[near], class_id[near]
        left, low, columns, rows = ix.min(), iy.min(), int(np.ptp(ix)) + 1, int(np.ptp(iy)) + 1
        flat = (class_id * rows + iy - low) * columns + ix - left
        order = np.argsort(flat)
        origin_x, origin_y = float(left * self._cell_m), float(low * self._cell_m)
        return Snapshot(rows, columns, self._cell_m, origin_x, origin_y, flat[order], cells["probability"][near][order])

    def state(self) -> bytes:
        """All tiles."""
        arrays: _Columns = {}
        for (tile_y, tile_x), tile in sorted(self._tiles.items()):
            name = f"{tile_y},{tile_x}"
            arrays |= {f"{name},views": tile.views, f"{name},first": tile.first, f"{name},last": tile.last}
            for class_id in sorted(tile.hits):
                arrays[f"{name},hits,{class_id}"] = tile.hits[class_id]
                arrays[f"{name},weights,{class_id}"] = tile.weights[class_id]
        return pack(arrays)

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        self._tiles, self._labels, self._columns = {}, {}, {}
        for name, array in unpack(state).items():
            tile_y, tile_x, kind, *class_id = name.split(",")
            tile = self._tiles.setdefault((int(tile_y), int(tile_x)), _Tile())
            if class_id:
                getattr(tile, kind)[int(class_id[0])] = array
            else:
                setattr(tile, kind, array)


def _snapshot_half(classes: int) -> int:
    """Cells either way that a snapshot of so many classes can number."""
    return min(SNAPSHOT_HALF, (math.isqrt(SNAPSHOT_INDICES // classes) - 1) // 2)


def sightings(planes: Planes) -> dict[int, _Mask]:
    """Where a keyframe sees each class, by the rules above: objects, else obstacle, else free floor."""
    sights = {index: _object_cells(planes[index]) for index in range(FIRST_OBJECT, len(planes)) if planes[index].any()}
    objects = np.zeros(planes.shape[1:], np.bool_)
    for mask in sights.values():
        objects |= mask
    obstacle = (planes[OBSTACLE] > 0) & ~objects
    return sights | {OBSTACLE: obstacle, FREE_FLOOR: (planes[FREE_FLOOR] > 0) & ~objects & ~obstacle}


def _object_cells(plane: NDArray[np.float32]) -> _Mask:
    """Cells of an object plane that belong to real blobs and are no ragged edge."""
    count, blobs = cv2.connectedComponents((plane > 0).astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    labels = np.asarray(blobs.ravel(), np.int64)
    peak, total = np.zeros(count, np.float32), np.bincount(labels, plane.ravel(), count)
    np.maximum.at(peak, labels, plane.ravel())
    return np.asarray((plane > 0) & (total[blobs] >= MIN_BLOB_WEIGHT) & (plane >= MIN_SHARE * peak[blobs]))


def _sight_weights(side: int, cell_m: float) -> NDArray[np.float32]:
    """Weight of a sight in each observation cell, and 0 for none: (side * side + 1,)."""
    y, x = (np.mgrid[:side, :side] - side // 2) * cell_m
    weights = 1.0 / (1.0 + (x * x + y * y) / HALF_WEIGHT_M**2)
    return np.append(weights.ravel(), 0.0).astype(np.float32)


def _count(
    tile: _Tile,
    window: Window,
    source: NDArray[np.int64],
    seen: _Mask,
    sights: dict[int, _Mask],
    weight: NDArray[np.float32],
    stamp_nanos: int,
) -> None:
    """Add one keyframe to a window of a tile; `source` gives the observation cell under each cell of the window."""
    viewed = np.append(seen, False)[source]
    tile.first[window][viewed & (tile.views[window] == 0)] = stamp_nanos
    tile.last[window][viewed] = stamp_nanos
    tile.views[window] += viewed
    for class_id, mask in sights.items():
        hit = np.append(mask, False)[source]
        if hit.any():
            tile.hits.setdefault(class_id, np.zeros((TILE, TILE), np.uint32))[window] += hit
            tile.weights.setdefault(class_id, np.zeros((TILE, TILE), np.float32))[window] += hit * weight[source]


def _rows_around(place: TilePlace) -> Iterator[list[TilePlace]]:
    """Places of the tiles about one, and its own, row by row."""
    for row in range(place[0] - 1, place[0] + 2):
        yield [(row, column) for column in range(place[1] - 1, place[1] + 2)]


def _around(place: TilePlace) -> Iterator[TilePlace]:
    return chain.from_iterable(_rows_around(place))


def _joined(parts: Sequence[_Columns]) -> _Columns:
    """Cells of all tiles, by iy, then ix."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((whole["ix"], whole["iy"]))
    return {name: column[order] for name, column in whole.items()}


def _belief(tile: _Tile) -> Belief:
    """What the sights in a tile say of its cells."""
    return Belief.of(tile.weights, (TILE, TILE))


def _tile_cells(place: TilePlace, tile: _Tile, belief: Belief) -> _Columns:
    """The cells of a tile in which anything was recognised."""
    labels, probability = belief.told()
    y, x = np.nonzero(labels != UNOBSERVED)
    hits = np.zeros((TILE, TILE), np.uint32)
    for class_id, counts in tile.hits.items():
        np.copyto(hits, counts, where=labels == class_id)
    return {
        "ix": (place[1] * TILE + x).astype(np.int32),
        "iy": (place[0] * TILE + y).astype(np.int32),
        "class_id": labels[y, x],
        "probability": probability[y, x],
        "hits": hits[y, x],
        "views": tile.views[y, x],
        "first_seen_nanos": tile.first[y, x],
        "last_seen_nanos": tile.last[y, x],
    }


def _tile_seen(place: TilePlace, tile: _Tile) -> _Columns:
    """The cells of a tile in which anything was recognised. Of equal weights objects win, then obstacles."""
    ids = [class_id for class_id in sorted(tile.weights) if class_id >= FIRST_OBJECT]
    ids += [class_id for class_id in (OBSTACLE, FREE_FLOOR) if class_id in tile.weights]
    shares = [OBJECT_SHARE if class_id >= FIRST_OBJECT else 1.0 for class_id in ids]
    planes = [np.float32(share) * tile.weights[class_id] for share, class_id in zip(shares, ids, strict=True)]
    weights = np.stack(planes or [np.zeros((TILE, TILE), np.float32)])
    y, x = np.nonzero(weights.any(0))
    ix, iy = (place[1] * TILE + x).astype(np.int32), (place[0] * TILE + y).astype(np.int32)
    return {"ix": ix, "iy": iy, "class_id": np.array(ids or [0], np.uint16)[weights.argmax(0)[y, x]]}
