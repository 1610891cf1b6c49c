"""The bare building: rooms, the sides of their walls, where doors and windows are, and short partition walls.

A side is one inner wall of a room with a frame of its own: origin at the foot of its middle, x into the room, y along
the wall to the left of who looks in. Sides are numbered west, south, east, north: side k faces k times 90 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from semslam.sim.home import Array, Room, turn
from semslam.sim.polygons import inside, rectangle_at, span

OUTER_WALL_M = 0.16
SHARED_WALL_M = 0.14
"""Between two rooms; each of them owns half of it."""
DOORWAY_HIGH_M = 2.1


@dataclass(frozen=True)
class Opening:
    """A closed door, an open doorway to the next room, or a window, `along_m` from the middle of its side."""

    kind: str
    along_m: float
    width_m: float
    low_m: float
    high_m: float

    @property
    def ends_m(self) -> tuple[float, float]:
        return self.along_m - self.width_m / 2, self.along_m + self.width_m / 2


@dataclass(frozen=True)
class Side:
    """One wall of a room, seen from inside."""

    room: int
    index: int
    x_m: float
    y_m: float
    length_m: float
    thick_m: float
    openings: tuple[Opening, ...] = ()

    @property
    def yaw_rad(self) -> float:
        """Of its normal, into the room."""
        return self.index * math.pi / 2

    def at(self, out_m: float, along_m: float) -> tuple[float, float]:
        """World place of a point given in the side's frame."""
        x, y = turn(self.yaw_rad) @ (out_m, along_m)
        return self.x_m + float(x), self.y_m + float(y)

    def local(self, points: Array) -> Array:
        """(N, 2) world points in the side's frame."""
        return np.asarray((points - (self.x_m, self.y_m)) @ turn(self.yaw_rad))

    def strip(self, along_low_m: float, along_high_m: float, out_low_m: float, out_high_m: float) -> Array:
        """(4, 2) world rectangle along the wall; negative `out` is inside the wall."""
        x, y = self.at((out_low_m + out_high_m) / 2, (along_low_m + along_high_m) / 2)
        return rectangle_at(x, y, out_high_m - out_low_m, along_high_m - along_low_m, self.yaw_rad)


@dataclass(frozen=True)
class Partition:
    """A short wall, as high as the room or lower, that stands out from a side by `reach_m`."""

    room: int
    side: int
    along_m: float
    reach_m: float
    thick_m: float
    height_m: float


@dataclass(frozen=True)
class Shell:
    """The building before anyone furnished it."""

    rooms: tuple[Room, ...]
    sides: tuple[Side, ...]
    """Four a room, in order."""
    partitions: tuple[Partition, ...]
    gaps: tuple[tuple[tuple[float, float], tuple[float, float]], ...]
    """Floor under open doorways: least and greatest corner."""
    height_m: float
    start: tuple[float, float]

    def side(self, room: int, index: int) -> Side:
        return self.sides[4 * room + index % 4]

    @property
    def outline(self) -> tuple[Array, ...]:
        return tuple(span(room.low, room.high) for room in self.rooms) + tuple(span(*gap) for gap in self.gaps)

    def partition_outline(self, partition: Partition) -> Array:
        side, half = self.side(partition.room, partition.side), partition.thick_m / 2
        return side.strip(partition.along_m - half, partition.along_m + half, 0.0, partition.reach_m)


def draw_shell(seed: int, variant: str, attempt: int) -> Shell:
    """The building of a seed; later attempts draw another one."""
    rng = np.random.default_rng([seed, 0x5E11, attempt])
    if variant == "rooms":
        return _several_rooms(rng)
    return _one_room(rng, twins=variant == "symmetric")


def _one_room(rng: np.random.Generator, *, twins: bool) -> Shell:
    half = rng.uniform(4.6, 5.2, 2)
    room = Room("home", (float(-half[0]), float(-half[1])), (float(half[0]), float(half[1])))
    sides = [_side(0, k, room, OUTER_WALL_M) for k in range(4)]
    doors, windows = int(rng.integers(1, 4)), int(rng.integers(2, 5))
    sides = _open_twins(rng, sides) if twins else _open(rng, sides, doors, windows)
    angle, radius = rng.uniform(0, 2 * math.pi), float(rng.uniform(0, 0.9))
    start = (0.0, 0.0) if twins else (radius * math.cos(angle), radius * math.sin(angle))
    height = float(rng.uniform(2.5, 2.8))
    shell = Shell((room,), tuple(sides), (), (), height, start)
    count = 0 if twins else int(rng.choice([0, 0, 1, 1, 2]))
    return _with_partitions(rng, shell, count)


def _side(room: int, index: int, floor: Room, thick_m: float) -> Side:
    middle = (np.array(floor.low) + floor.high) / 2
    size = np.subtract(floor.high, floor.low)
    across, along = (size[0], size[1]) if index % 2 == 0 else (size[1], size[0])
    x, y = middle - turn(index * math.pi / 2) @ (across / 2, 0.0)
    return Side(room, index, float(x), float(y), float(along), thick_m)


def _with(side: Side, opening: Opening) -> Side:
    return replace(side, openings=(*side.openings, opening))


def _draw_opening(rng: np.random.Generator, side: Side, kind: str) -> Opening | None:
    """A door or window where the wall still has room for it, or None."""
    if kind == "door":
        width, low, high = float(rng.choice([0.8, 0.9, 1.0])), 0.0, float(rng.uniform(2.0, 2.1))
    else:
        width, low, high = float(rng.uniform(1.0, 2.0)), float(rng.uniform(0.85, 1.05)), float(rng.uniform(2.05, 2.25))
    reach = side.length_m / 2 - width / 2 - 0.6
    for _ in range(20 if reach > 0 else 0):
        opening = Opening(kind, float(rng.uniform(-reach, reach)), width, low, high)
        if all(_apart(opening, other, 0.35) for other in side.openings):
            return opening
    return None


def _apart(first: Opening, second: Opening, gap_m: float) -> bool:
    return abs(first.along_m - second.along_m) > (first.width_m + second.width_m) / 2 + gap_m


def _open(rng: np.random.Generator, sides: list[Side], doors: int, windows: int) -> list[Side]:
    """Doors and windows in outer walls drawn at random; windows on at most two sides, as in a flat."""
    sides = list(sides)
    outer = [k for k, side in enumerate(sides) if side.thick_m == OUTER_WALL_M]
    order = [outer[int(k)] for k in rng.permutation(len(outer))]
    bright = order[:2]
    for kind, count, walls in (("door", doors, order[::-1]), ("window", windows, bright)):
        for index in range(count if walls else 0):
            k = walls[index % len(walls)]
            opening = _draw_opening(rng, sides[k], kind)
            if opening is not None:
                sides[k] = _with(sides[k], opening)
    return sides


def _open_twins(rng: np.random.Generator, sides: list[Side]) -> list[Side]:
    """The same doors and windows in opposite walls."""
    first = int(rng.integers(2))
    for k, kind, count in ((first, "door", 1), (1 - first, "window", 2)):
        for _ in range(count):
            opening = _draw_opening(rng, sides[k], kind)
            if opening is not None:
                sides[k], sides[k + 2] = _with(sides[k], opening), _with(sides[k + 2], opening)
    return sides


def _with_partitions(rng: np.random.Generator, shell: Shell, count: int) -> Shell:
    """Full-height wall stubs away from corners, doors, windows, each other and the start."""
    partitions: list[Partition] = []
    for _ in range(count):
        for _ in range(20):
            stub = _draw_stub(rng, shell)
            outline = shell.partition_outline(stub)
            clear = np.linalg.norm(outline - shell.start, axis=1).min() > 1.2
            if clear and _stub_fits(shell, stub) and all(other.side != stub.side for other in partitions):
                partitions.append(stub)
                break
    return replace(shell, partitions=tuple(partitions))


def _draw_stub(rng: np.random.Generator, shell: Shell) -> Partition:
    side = int(rng.integers(4))
    reach = shell.side(0, side).length_m / 2 - 2.2
    return Partition(0, side, float(rng.uniform(-reach, reach)), float(rng.uniform(1.2, 2.5)), 0.12, shell.height_m)


def _stub_fits(shell: Shell, stub: Partition) -> bool:
    openings = shell.side(stub.room, stub.side).openings
    return all(abs(stub.along_m - o.along_m) > o.width_m / 2 + (0.9 if o.low_m == 0 else 0.4) for o in openings)


def _several_rooms(rng: np.random.Generator) -> Shell:
    """Two to four rooms: in a row, or in an L or a block of two by two."""
    count = int(rng.integers(2, 5))
    block = count >= 3 and rng.random() < 0.5
    rooms = _block(rng, count) if block else _row(rng, count)
    sides = [_side(k, s, room, _thickness_m(s, room, rooms)) for k, room in enumerate(rooms) for s in range(4)]
    pairs = [(k, k + 1) for k in range(count - 1)] + ([(3, 0)] if block and count == 4 else [])
    sides, gaps = _join(rng, rooms, sides, pairs)
    for k in range(count):
        sides[4 * k : 4 * k + 4] = _open(
            rng, sides[4 * k : 4 * k + 4], 1 if k == 0 or rng.random() < 0.4 else 0, int(rng.integers(1, 4))
        )
    return Shell(tuple(rooms), tuple(sides), (), tuple(gaps), float(rng.uniform(2.5, 2.8)), _start_in(rooms))


def _thickness_m(index: int, room: Room, rooms: list[Room]) -> float:
    """Of a wall: half of a shared one where another room begins just behind it."""
    side = _side(0, index, room, OUTER_WALL_M)
    behind = np.array([side.at(-2 * SHARED_WALL_M, along) for along in np.linspace(-0.45, 0.45, 19) * side.length_m])
    shared = any(inside(behind, span(other.low, other.high)).any() for other in rooms if other is not room)
    return SHARED_WALL_M / 2 if shared else OUTER_WALL_M


_PURPOSES = {
    2: ("living, kitchen", "bedroom, study, bath"),
    3: ("living", "kitchen", "bedroom, study, bath"),
    4: ("living", "kitchen", "bedroom", "study, bath"),
}


def _row(rng: np.random.Generator, count: int) -> list[Room]:
    longest = {2: 10.0, 3: 9.2, 4: 7.2}[count]
    widths, depths = rng.uniform(5.6, longest, count), rng.uniform(5.4, 8.5, count)
    total = float(widths.sum()) + SHARED_WALL_M * (count - 1)
    rooms, x = [], -total / 2
    for k, name in enumerate(_PURPOSES[count]):
        shift = float(rng.uniform(-0.8, 0.8))
        low = (x, shift - float(depths[k]) / 2)
        rooms.append(Room(name, low, (x + float(widths[k]), low[1] + float(depths[k]))))
        x += float(widths[k]) + SHARED_WALL_M
    return _centred(rooms)


def _block(rng: np.random.Generator, count: int) -> list[Room]:
    """Rooms on a grid of two by two, one place empty if there are three."""
    widths, depths = rng.uniform(5.4, 8.0, 2), rng.uniform(5.2, 7.5, 2)
    half = SHARED_WALL_M / 2
    places = [(0, 0), (1, 0), (1, 1), (0, 1)][:count]
    rooms = []
    for (i, j), name in zip(places, _PURPOSES[count], strict=True):
        x = (-half - float(widths[0]), -half) if i == 0 else (half, half + float(widths[1]))
        y = (-half - float(depths[0]), -half) if j == 0 else (half, half + float(depths[1]))
        rooms.append(Room(name, (x[0], y[0]), (x[1], y[1])))
    return _centred(rooms)


def _centred(rooms: list[Room]) -> list[Room]:
    """The rooms moved so that the middle of all is the origin."""
    low = np.min([room.low for room in rooms], axis=0)
    high = np.max([room.high for room in rooms], axis=0)
    x, y = (low + high) / 2
    return [
        Room(
            room.name,
            (float(room.low[0] - x), float(room.low[1] - y)),
            (float(room.high[0] - x), float(room.high[1] - y)),
        )
        for room in rooms
    ]


def _join(
    rng: np.random.Generator, rooms: list[Room], sides: list[Side], pairs: list[tuple[int, int]]
) -> tuple[list[Side], list[tuple[tuple[float, float], tuple[float, float]]]]:
    """An open doorway through the shared wall of each pair of rooms."""
    gaps = []
    for first, second in pairs:
        width = float(rng.uniform(0.95, 1.3))
        low, top = _shared_wall(rooms[first], rooms[second])
        axis = int(top[0] - low[0] < top[1] - low[1])  # the wall runs along this axis
        spare = (top[axis] - low[axis] - width) / 2 - 0.5
        middle = (low[axis] + top[axis]) / 2 + float(rng.uniform(-spare, spare))
        gap_low, gap_top = list(low), list(top)
        gap_low[axis], gap_top[axis] = middle - width / 2, middle + width / 2
        gaps.append(((gap_low[0], gap_low[1]), (gap_top[0], gap_top[1])))
        place = (np.array(gap_low) + gap_top) / 2
        for room in (first, second):
            _cut_doorway(sides, room, place, width)
    return sides, gaps


def _cut_doorway(sides: list[Side], room: int, place: Array, width_m: float) -> None:
    """Open that wall of a room which is nearest to a place."""
    k = min(range(4 * room, 4 * room + 4), key=lambda k: abs(float(sides[k].local(place[None])[0, 0])))
    along = float(sides[k].local(place[None])[0, 1])
    sides[k] = _with(sides[k], Opening("doorway", along, width_m, 0.0, DOORWAY_HIGH_M))


def _shared_wall(first: Room, second: Room) -> tuple[tuple[float, float], tuple[float, float]]:
    """The rectangle between two neighbouring rooms where they face each other."""
    corners = []
    for axis in range(2):
        low = max(first.low[axis], second.low[axis])
        high = min(first.high[axis], second.high[axis])
        corners.append((min(low, high), max(low, high)))
    return (corners[0][0], corners[1][0]), (corners[0][1], corners[1][1])


def _start_in(rooms: list[Room]) -> tuple[float, float]:
    """The place nearest to the middle of the home that is 0.8 m from every wall."""
    places = [np.clip((0.0, 0.0), np.add(room.low, 0.8), np.subtract(room.high, 0.8)) for room in rooms]
    x, y = min(places, key=lambda place: float(np.hypot(*place)))
    return float(x), float(y)


def without_windows(shell: Shell) -> Shell:
    """The same building with its windows walled up."""
    sides = [replace(s, openings=tuple(o for o in s.openings if o.kind != "window")) for s in shell.sides]
    return replace(shell, sides=tuple(sides))


def wall_pieces(side: Side, height_m: float) -> list[tuple[float, float, float, float]]:
    """What is left of a wall around doorways and windows: (along low, along high, z low, z high), by rising `along`."""
    holes = sorted((opening for opening in side.openings if opening.kind != "door"), key=lambda hole: hole.along_m)
    reach = side.length_m / 2 + SHARED_WALL_M / 2  # into the corner, but never into the next room
    edges = [-reach, *(end for hole in holes for end in hole.ends_m), reach]
    pieces = [(low, high, 0.0, height_m) for low, high in zip(edges[::2], edges[1::2], strict=True)]
    for hole in holes:
        pieces += [(*hole.ends_m, 0.0, hole.low_m)] if hole.low_m > 0 else []
        pieces += [(*hole.ends_m, hole.high_m, height_m)]
    return sorted(pieces)
