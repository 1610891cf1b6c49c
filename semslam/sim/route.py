"""Where a robot drives in a home: an endless seeded sequence of legs that keep objects in the picture.

Of several goals the one is taken whose way sees most, sees what was long out of sight and covers new floor. Ways are
those of the lattice, made smooth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import wrap_angle
from semslam.sim.home import Array, Home
from semslam.sim.lattice import (
    ANGLES,
    AROUND_START_M,
    HEADINGS,
    MARGIN_M,
    PITCH_M,
    RASTER_M,
    ROBOT_RADIUS_M,
    Raster,
    Reach,
    Search,
    clearance_at,
    in_view,
    make_lattice,
)

_SPIN_RAD = 1.1
"""Sharper bends are turned on the spot."""
_FORGOTTEN_S = 30.0
"""Objects and floor not seen for so long are new again."""
_ROOM_S = (12.0, 26.0)
"""A stay in one room of several lasts between these."""
_OLD = (0.25, 1.0)
"""Ages of floor, as shares of four times _FORGOTTEN_S, to which one returns now and then."""
_FRESH = 0.15
"""Floor younger than this share is not driven again at once."""
_LEG_S = 40.0
"""Dreaded seconds that a leg within a room may cost."""
_LEG_M = (1.2, 6.5)
_CANDIDATES = 48
_REVISITS = 0.2
_NEAR_M = 1.2
"""Floor within this distance of the way counts as visited."""
_OBJECTS_ENOUGH = 8
_OBJECTS_LEAST = 2
"""A way with fewer in view at any moment is worth less."""


@dataclass(frozen=True)
class Turn:
    """Turn on the spot to a heading, in the direction that keeps objects in view."""

    heading_rad: float
    amount_rad: float
    """About how far, counter-clockwise positive; says which way round."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Drive along a smooth line and stop at its end."""

    points: Array
    """(M, 2) about 2 cm apart."""
    speed_m_s: float


Move: TypeAlias = Turn | Stretch


@dataclass(frozen=True)
class Leg:
    """From one goal to the next, and how long to stand there."""

    moves: tuple[Move, ...]
    pause_s: float


@dataclass(eq=False)
class Memory:
    """When what was last seen and visited; -infinity: never."""

    object_s: Array
    place_s: Array
    room_s: Array
    entered_s: float = 0.0
    room: int = -1
    stay_s: float = field(default=_ROOM_S[0])


class Route:
    """The endless sequence of legs of one seed; `next_leg` is to be called when the one before is done."""

    def __init__(
        self, home: Home, raster: Raster, camera_height_m: float, camera_pitch_rad: float, rng: np.random.Generator
    ) -> None:
        self.lattice = make_lattice(home, raster, camera_height_m, camera_pitch_rad)
        self._search, self._rng = Search(self.lattice), rng
        self._rooms = _room_of(home, self.lattice.places)
        self._memory = Memory(_never(len(home.objects)), _never(len(self._rooms)), _never(len(home.rooms)))
        self.place, self.heading = self._begin(home)

    @property
    def pose(self) -> tuple[float, float, float]:
        """Where the last leg ends, or where to begin: x, y, heading."""
        x, y = self.lattice.places[self.place]
        return float(x), float(y), float(ANGLES[self.heading])

    def next_leg(self, time_s: float) -> Leg:
        """The leg that starts at `time_s`, at the end of the one before."""
        room = self._room_to_go(time_s)
        within = _LEG_S if room is None else math.inf
        reach = self._search.reach(self.place, self.heading, within)
        way = self._choose(reach, time_s, room)
        self._remember(way, time_s)
        self.place, self.heading = way[-1]
        return Leg(self._moves(way), float(self._rng.uniform(0.1, 0.8)))

    def _begin(self, home: Home) -> tuple[int, int]:
        """A place near the start, looking where there is much to see."""
        away = np.hypot(*(self.lattice.places - home.start).T)
        place = int(self._rng.choice(np.flatnonzero(away <= max(0.8 * AROUND_START_M, float(away.min())))))
        count = self.lattice.view[place].sum(1)
        return place, int((np.minimum(count, _OBJECTS_ENOUGH) + self._rng.gumbel(0, 0.7, HEADINGS)).argmax())

    def _room_to_go(self, time_s: float) -> int | None:
        """The room longest not visited, when the stay in this one is over; else None."""
        memory, room = self._memory, int(self._rooms[self.place])
        if room != memory.room:
            memory.room, memory.entered_s = room, time_s
            memory.stay_s = float(self._rng.uniform(*_ROOM_S))
        memory.room_s[room] = time_s
        if len(np.unique(self._rooms)) < 2 or time_s - memory.entered_s < memory.stay_s:
            return None
        known = np.where(np.isin(np.arange(len(memory.room_s)), self._rooms), memory.room_s, np.inf)
        return int(self._rng.choice(np.flatnonzero(known == known.min())))

    def _choose(self, reach: Reach, time_s: float, room: int | None) -> list[tuple[int, int]]:
        """The way to the best of some random goals."""
        cost, heading = reach.cost.min(1), reach.cost.argmin(1)
        away = np.hypot(*(self.lattice.places - self.lattice.places[self.place]).T)
        wanted = (away >= _LEG_M[0]) & (away <= _LEG_M[1]) if room is None else self._rooms == room
        goals = np.flatnonzero(wanted & np.isfinite(cost))
        if not len(goals):  # a corner from which every view is dreaded: out of it, whatever it costs
            reach = self._search.reach(self.place, self.heading, math.inf)
            cost, heading = reach.cost.min(1), reach.cost.argmin(1)
            goals = np.flatnonzero(np.isfinite(cost) & (away >= min(_LEG_M[0], float(away.max()))))
        goals = self._rng.permutation(goals)[:_CANDIDATES]
        ways = [reach.way(int(goal), int(heading[goal])) for goal in goals]
        back = self._rng.random() < _REVISITS
        worth = [self._worth(way, float(cost[way[-1][0]]), time_s, back) for way in ways]
        return ways[int((np.array(worth) + self._rng.gumbel(0, 0.25, len(ways))).argmax())]

    def _worth(self, way: list[tuple[int, int]], cost: float, time_s: float, back: bool) -> float:
        """How much a way is worth: what it sees, what of it is new, and how little it costs for its length."""
        places, headings = np.array(way).T
        view = self.lattice.view[places, headings]  # (states, objects)
        seen = np.minimum(view.sum(1), _OBJECTS_ENOUGH).mean() / _OBJECTS_ENOUGH
        poor = np.maximum(_OBJECTS_LEAST - view.sum(1), 0)
        fresh = (view.any(0) & (time_s - self._memory.object_s > _FORGOTTEN_S)).sum() / max(view.shape[1], 1)
        age = np.minimum(time_s - self._memory.place_s[places], 4 * _FORGOTTEN_S) / (4 * _FORGOTTEN_S)
        retraced = (age < _FRESH).mean()
        floor = float(_OLD[0] < age[-1] < _OLD[1]) if back else (age.mean() + age[-1]) / 2
        steps = np.hypot(*np.diff(self.lattice.places[places], axis=0).T).sum()
        good = 2.0 * seen + 4.0 * fresh + 5.0 * floor + steps / max(cost, 1e-9)
        bad = retraced + poor.max() + 3.0 * poor.mean() + 0.1 * self._search.leave_s[way[-1]]
        return float(good - bad)

    def _remember(self, way: list[tuple[int, int]], time_s: float) -> None:
        """What the way will have seen and visited when it is done; its length in time is close enough."""
        places, headings = np.array(way).T
        self._memory.object_s[self.lattice.view[places, headings].any(0)] = time_s
        for place in dict.fromkeys(places.tolist()):
            near = np.hypot(*(self.lattice.places - self.lattice.places[place]).T) <= _NEAR_M
            self._memory.place_s[near] = time_s
            self._memory.room_s[self._rooms[place]] = time_s

    def _moves(self, way: list[tuple[int, int]]) -> tuple[Move, ...]:
        """Turns on the spot and smooth stretches between them."""
        moves: list[Move] = []
        heading = float(ANGLES[way[0][1]])
        for amount, places in _pieces(way):
            stretch = Stretch(self._smooth(places), float(self._rng.uniform(0.3, 0.4)))
            start = _direction(stretch.points[: min(6, len(stretch.points))])
            turned = amount + wrap_angle(start - heading - amount)
            moves += [Turn(start, turned), stretch]
            heading = _direction(stretch.points[-6:])
        return tuple(moves)

    def _smooth(self, places: list[int]) -> Array:
        """(M, 2) a line through the places without their zigzag, as clear of things as they are."""
        line = _dense(self.lattice.places[self._shortened(places)])
        least = ROBOT_RADIUS_M + MARGIN_M / 2
        for half in (18, 9, 4):
            smooth = _averaged(_averaged(line, half), half)
            if clearance_at(self.lattice.clearance_m, self.lattice.origin, smooth).min() >= least:
                return smooth
        return line

    def _shortened(self, places: list[int]) -> list[int]:
        """The places that remain when straight cuts replace detours, where these see and clear no less."""
        kept, first = [places[0]], 0
        while first < len(places) - 1:
            last = min(first + 12, len(places) - 1)
            while last > first + 1 and not self._cut(places[first : last + 1]):
                last -= 1
            kept.append(places[last])
            first = last
        return kept

    def _cut(self, places: list[int]) -> bool:
        """Whether the straight line from first to last place is as good as the way between them."""
        start, end = self.lattice.places[[places[0], places[-1]]]
        line = start + np.linspace(0, 1, 2 + int(np.hypot(*(end - start)) / RASTER_M))[:, None] * (end - start)
        if clearance_at(self.lattice.clearance_m, self.lattice.origin, line).min() < ROBOT_RADIUS_M + MARGIN_M:
            return False
        straight = _direction(np.stack([start, end]))
        steps = np.diff(self.lattice.places[places], axis=0)
        there = in_view(self.lattice, line[:: round(PITCH_M / RASTER_M)], straight).min()
        zigzag = [
            int(in_view(self.lattice, self.lattice.places[[place]], math.atan2(step[1], step[0]))[0])
            for place, step in zip(places, steps, strict=False)
        ]
        return bool(there >= min(5, *zigzag))


def _never(things: int) -> Array:
    """(things,) times at which nothing was seen yet."""
    return np.full(things, -np.inf)


def _room_of(home: Home, places: Array) -> NDArray[np.int64]:
    """(P,) the room in which, or nearest to which, each place lies."""
    outside = [
        np.maximum(np.maximum(np.subtract(room.low, places), np.subtract(places, room.high)), 0.0).max(1)
        for room in home.rooms
    ]
    return np.stack(outside, axis=1).argmin(1) if outside else np.zeros(len(places), np.int64)


def _pieces(way: list[tuple[int, int]]) -> list[tuple[float, list[int]]]:
    """Runs of places between turns on the spot, each with the turn before it."""
    pieces: list[tuple[float, list[int]]] = []
    turned = 0.0
    for (before, old), (place, new) in pairwise(way):
        if place == before:
            turned += wrap_angle(float(ANGLES[new] - ANGLES[old]))
            continue
        if not pieces or abs(turned) > _SPIN_RAD:
            pieces.append((turned, [before]))
        pieces[-1][1].append(place)
        turned = 0.0
    return pieces


def _direction(points: Array) -> float:
    along = points[-1] - points[0]
    return math.atan2(float(along[1]), float(along[0]))


def _dense(points: Array, step_m: float = 0.02) -> Array:
    """(M, 2) points along a polyline, evenly spaced."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, along[-1], 1 + max(1, round(along[-1] / step_m)))
    return np.stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)], axis=1)


def _averaged(line: Array, half: int) -> Array:
    """Moving average over 2 half + 1 points; mirrored through its ends, which stay where they are."""
    half = min(half, len(line) - 1)
    before, after = 2 * line[0] - line[half:0:-1], 2 * line[-1] - line[-2 : -half - 2 : -1]
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), before, line, after]), axis=0)
    return np.asarray((total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1))
