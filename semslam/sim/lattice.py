"""The free floor as a lattice of places and headings, what the camera would see in each, and cheapest ways through it.

Driving on and turning by one heading are the edges. Their cost is the time they take, times a dread of pictures with
few objects, so that the cheapest way looks at things, also while it turns.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.sim.home import Array, Home, Walker
from semslam.sim.outlook import BEARINGS, forecast, relief_of

Raster: TypeAlias = tuple[NDArray[np.bool_], Array | tuple[float, float]]
"""Free cells (rows along y, columns along x) of RASTER_M, and the world place of the corner of cell (0, 0)."""

RASTER_M = 0.05
ROBOT_RADIUS_M = 0.18
MARGIN_M = 0.05
"""Kept free around the robot when a way is planned; the pilot needs less than half of it."""
WALKER_M = 0.45
"""Half width of the strip that is left to whoever walks about."""
PITCH_M = 0.2
"""Distance between places of the lattice."""
AROUND_START_M = 1.0

_OFFSETS = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)])
OFFSETS = np.concatenate([_OFFSETS, -_OFFSETS])
HEADINGS = len(OFFSETS)
ANGLES = np.arctan2(OFFSETS[:, 1], OFFSETS[:, 0])
"""(HEADINGS,) headings of the lattice, counter-clockwise: those that lead from place to place."""
_BEARING = np.round(ANGLES / (2 * math.pi) * BEARINGS).astype(np.int64) % BEARINGS

_SPEED_M_S = 0.33
_TURN_RAD_S = 0.8
_DREAD = np.array([40.0, 15.0, 1.5, 0.5, 0.2, 0.1])
"""By how much a second with 0, 1, 2, ... objects in view is dreaded; none beyond the list."""
_SWERVE = 1
"""Bearings by which the robot's heading may differ from that of the lattice."""
_CROWDED_M = 0.4


@dataclass(frozen=True, eq=False)
class Lattice:
    """Places and headings in which the robot can be, and what its camera would see there."""

    places: Array
    """(P, 2) world."""
    ahead: NDArray[np.int64]
    """(P, HEADINGS) place that is reached by driving on; -1 where something stands in the way."""
    view: NDArray[np.bool_]
    """(P, HEADINGS, objects) objects in view."""
    clearance_m: NDArray[np.float32]
    """Raster of distances from the robot's middle to what it must not touch."""
    origin: Array
    sites: NDArray[np.int64]
    """(rows, columns) place at or next to each site of the lattice, -1 where there is none."""
    all_bearings: NDArray[np.bool_]
    """(P, BEARINGS, objects) objects in view for any heading."""


def make_lattice(home: Home, raster: Raster, camera_height_m: float, camera_pitch_rad: float) -> Lattice:
    """The part of the floor that hangs together with the start of the home."""
    clearance, origin = clearance_raster(raster, home.walker), np.asarray(raster[1], float)
    step = round(PITCH_M / RASTER_M)
    roomy = clearance[step // 2 :: step, step // 2 :: step] >= ROBOT_RADIUS_M + MARGIN_M
    sites = np.where(roomy, np.cumsum(roomy).reshape(roomy.shape) - 1, -1)
    places = (np.argwhere(roomy)[:, ::-1] * step + step // 2 + 0.5) * RASTER_M + origin
    ahead = _edges(sites, places, clearance, origin)
    kept = _connected(ahead, _entrance(home, places))
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    places, ahead = places[kept], np.where(ahead[kept] < 0, -1, number[ahead[kept]])
    around = forecast(relief_of(home), places, camera_height_m, camera_pitch_rad)
    sites = _widened(np.where(sites < 0, -1, number[sites]))
    return Lattice(places, ahead, around[:, _BEARING], clearance, origin, sites, around)


def clearance_raster(raster: Raster, walker: Walker | None) -> NDArray[np.float32]:
    """Distance of each cell's middle from the nearest wall, thing or walker's strip, metres; 0 on them."""
    free = np.pad(np.asarray(raster[0], np.uint8), 1)
    if walker is not None:
        ends = (np.array([walker.start, walker.end]) - raster[1]) / RASTER_M + 0.5
        (ax, ay), (bx, by) = np.round(ends).astype(int).tolist()
        cv2.line(free, (ax, ay), (bx, by), 0, math.ceil(2 * WALKER_M / RASTER_M))
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.asarray(np.maximum(distance - 0.5, 0.0) * RASTER_M, np.float32)


def _widened(sites: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sites without a place get that of a neighbour."""
    next_to = cv2.dilate(sites.astype(np.float64), np.ones((3, 3)), borderType=cv2.BORDER_REPLICATE)
    return np.where(sites < 0, next_to.astype(np.int64), sites)


def _edges(sites: NDArray[np.int64], places: Array, clearance: NDArray[np.float32], origin: Array) -> NDArray[np.int64]:
    """(P, HEADINGS) neighbours that a straight line on roomy floor reaches, else -1."""
    row, column = np.nonzero(sites >= 0)
    padded = np.pad(sites, 2, constant_values=-1)
    ahead = np.stack([padded[row + 2 + dy, column + 2 + dx] for dx, dy in OFFSETS], axis=1)
    for heading, offset in enumerate(OFFSETS * PITCH_M):
        inner = np.linspace(0, 1, 8)[1:-1, None]
        along = places[:, None] + inner * offset  # (P, 6, 2)
        roomy = clearance_at(clearance, origin, along).min(1) >= ROBOT_RADIUS_M + MARGIN_M - RASTER_M / 2
        ahead[~roomy, heading] = -1
    return ahead


def clearance_at(clearance: NDArray[np.float32], origin: Array, xy: Array) -> NDArray[np.float32]:
    """Clearance at world points (..., 2)."""
    cell = np.floor((xy - origin) / RASTER_M).astype(np.int64)
    rows, columns = clearance.shape
    return np.asarray(clearance[np.clip(cell[..., 1], 0, rows - 1), np.clip(cell[..., 0], 0, columns - 1)])


def _entrance(home: Home, places: Array) -> int:
    """The place nearest to the start of the home.

    Raises:
        SemslamError: no floor near it is free.
    """
    away = np.hypot(*(places - home.start).T) if len(places) else np.array([np.inf])
    if float(away.min()) > AROUND_START_M:
        raise SemslamError(
            f"Home of seed `{home.seed}` ({home.variant}) has no free floor within {AROUND_START_M:g} m of its start",
            hint="use another `--seed`",
        )
    return int(away.argmin())


def _connected(ahead: NDArray[np.int64], first: int) -> NDArray[np.bool_]:
    """(P,) places that can be reached from the first."""
    reached, edge = np.zeros(len(ahead), bool), np.array([first])
    while len(edge):
        reached[edge] = True
        edge = np.unique(ahead[edge])
        edge = edge[(edge >= 0) & ~reached[edge]]
    return reached


def _costs(lattice: Lattice) -> tuple[Array, Array]:
    """Dreaded seconds of driving on from each state, and of turning by one heading, (P, HEADINGS) each."""
    count = lattice.all_bearings.sum(2)
    dread = 1.0 + np.append(_DREAD, 0.0)[np.minimum(count, len(_DREAD))]  # (P, BEARINGS)
    here = _worst(dread, _BEARING - _SWERVE, _BEARING + _SWERVE)
    there = np.take_along_axis(here, np.maximum(lattice.ahead, 0), axis=0)
    room = clearance_at(lattice.clearance_m, lattice.origin, lattice.places)
    crowd = 1.0 + 2.0 * np.maximum(1.0 - room / _CROWDED_M, 0.0)
    drive = np.hypot(*OFFSETS.T) * PITCH_M / _SPEED_M_S * (here + there) / 2 * crowd[:, None]
    following = np.append(_BEARING[1:], BEARINGS)
    return drive, (following - _BEARING) * 2 * math.pi / BEARINGS / _TURN_RAD_S * _worst(dread, _BEARING, following)


def _leaving(turn: Array) -> Array:
    """(P, HEADINGS) cost of a quarter turn to the left or to the right, whichever is less."""
    quarter = np.stack([np.roll(turn, -step, axis=1) for step in range(HEADINGS // 4)]).sum(0)
    return np.asarray(np.minimum(quarter, np.roll(quarter, HEADINGS // 4, axis=1)))


def _worst(dread: Array, first: NDArray[np.int64], last: NDArray[np.int64]) -> Array:
    """(P, HEADINGS) most dreaded bearing of each range, both ends included."""
    ranges = [np.arange(low, high + 1) % BEARINGS for low, high in zip(first, last, strict=True)]
    return np.stack([dread[:, bearings].max(1) for bearings in ranges], axis=1)


@dataclass(frozen=True, eq=False)
class Reach:
    """Cheapest ways from one state to others."""

    cost: Array
    """(P, HEADINGS) dreaded seconds; infinite where the search did not come."""
    parent: NDArray[np.int64]
    """(P, HEADINGS) state before, as place * HEADINGS + heading; -1 at the start."""

    def way(self, place: int, heading: int) -> list[tuple[int, int]]:
        """States from the start to this one."""
        states, state = [], place * HEADINGS + heading
        parent = self.parent.ravel()
        while state >= 0:
            states.append(divmod(state, HEADINGS))
            state = int(parent[state])
        return states[::-1]


class Search:
    """Dijkstra over the states of a lattice; costs lie in plain lists, which Python reads faster than arrays.

    `leave_s` (P, HEADINGS) is the cost of turning away by about a right angle, to the better side.
    """

    def __init__(self, lattice: Lattice) -> None:
        drive, turn = _costs(lattice)
        self.shape, self.leave_s = drive.shape, _leaving(turn)
        heading = np.arange(HEADINGS)
        self._next = np.where(lattice.ahead < 0, -1, lattice.ahead * HEADINGS + heading).ravel().tolist()
        self._drive, self._left = drive.ravel().tolist(), turn.ravel().tolist()

    def reach(self, place: int, heading: int, limit: float) -> Reach:
        """Cheapest ways to all states within `limit` dreaded seconds."""
        states = len(self._next)
        cost, parent = [math.inf] * states, [-1] * states
        first = place * HEADINGS + heading
        cost[first] = 0.0
        queue = [(0.0, first)]
        while queue:
            so_far, state = heapq.heappop(queue)
            if so_far > cost[state] or so_far > limit:
                continue
            for follower, extra in self._steps(state):
                if so_far + extra < cost[follower]:
                    cost[follower], parent[follower] = so_far + extra, state
                    heapq.heappush(queue, (so_far + extra, follower))
        return Reach(np.array(cost).reshape(self.shape), np.array(parent).reshape(self.shape))

    def _steps(self, state: int) -> list[tuple[int, float]]:
        base = state - state % HEADINGS
        left = base + (state + 1 - base) % HEADINGS
        right = base + (state - 1 - base) % HEADINGS
        steps = [(left, self._left[state]), (right, self._left[right])]
        if self._next[state] >= 0:
            steps.append((self._next[state], self._drive[state]))
        return steps


def in_view(lattice: Lattice, xy: Array, heading_rad: float | Array) -> NDArray[np.int64]:
    """(N,) number of objects in view from points (N, 2), as forecast for the nearest place of the lattice.

    0 where the lattice has no place.
    """
    site = np.floor((xy - lattice.origin) / PITCH_M).astype(np.int64)
    rows, columns = lattice.sites.shape
    place = lattice.sites[np.clip(site[:, 1], 0, rows - 1), np.clip(site[:, 0], 0, columns - 1)]
    bearing = np.round(np.asarray(heading_rad) / (2 * math.pi) * BEARINGS).astype(np.int64) % BEARINGS
    return np.where(place < 0, 0, lattice.all_bearings[place, bearing].sum(1))
