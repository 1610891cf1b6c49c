"""Where the groups of furniture go: places are drawn at random, the best of those that fit is taken.

Nothing overlaps; doors, doorways and the start stay clear, tall things keep away from windows, and free-standing groups
keep the robot's width from everything else.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semslam.sim import zones
from semslam.sim.groups import Extra, Group, Shop, Spot
from semslam.sim.home import Array, Placed, Room
from semslam.sim.polygons import disc, touches
from semslam.sim.shell import Shell

PASSAGE_M = 0.72
"""Kept between a free-standing group and everything else."""
NEIGHBOUR_M = 0.1
"""Kept between groups at a wall."""
START_CLEAR_M = 0.6
MOST_OBJECTS = 40
MOST_OBJECTS_ROOMS = 60


@dataclass(frozen=True, eq=False)
class Solid:
    """Something that stands on the floor, as far as placing others is concerned."""

    outline: Array
    free: bool
    """True if it stands in the middle of the room, and people walk around it."""
    height_m: float = 3.0


@dataclass(eq=False)
class Floor:
    """What stands where so far; grows while a home is being furnished."""

    shell: Shell
    windows: list[tuple[Array, float]]
    """Floor before each window, and the height from which it must stay empty."""
    twins: bool = False
    """True if everything has its twin half a turn about the origin."""
    solids: list[Solid] = field(default_factory=list)
    clear: list[Array] = field(default_factory=list)
    spots: list[Spot] = field(default_factory=list)
    extras: list[Extra] = field(default_factory=list)
    middles: list[tuple[str, float, float]] = field(default_factory=list)

    def add(self, group: Group) -> None:
        """Let a placed group, and its twin if there are twins, stand."""
        for each in [group, half_turned(group)] if self.twins else [group]:
            free = each.anchor == "free"
            self.solids += [Solid(s.footprint, free, s.piece.height_m) for s in each.spots if s.z_m == 0]
            self.solids += [Solid(e.outline, free, e.height_m) for e in each.extras if e.solid]
            self.clear += each.clear
            self.spots += each.spots
            self.extras += each.extras
            x, y = np.mean([s.footprint.mean(0) for s in each.spots], axis=0)
            self.middles.append((each.name, float(x), float(y)))

    def fits(self, group: Group, room: Room) -> bool:
        """True if a placed group touches nothing, blocks nothing and stays in its room."""
        outlines = group.solids
        margin = 0.3 if group.anchor == "free" else -1e-6
        if not all(_within(outline, room, margin) for outline in outlines):
            return False
        if self.twins and not self._apart_from_twin(group, outlines):
            return False
        solids = [solid.outline for solid in self.solids]
        keep = [PASSAGE_M if solid.free or group.anchor == "free" else NEIGHBOUR_M for solid in self.solids]
        if touches(outlines, solids, np.array(keep)) or touches(group.clear, solids) or touches(outlines, self.clear):
            return False
        return not any(before_window(spot.footprint, spot.top_m, self.windows) for spot in group.spots)

    def _apart_from_twin(self, group: Group, outlines: Sequence[Array]) -> bool:
        twin = half_turned(group)
        gap = PASSAGE_M if group.anchor == "free" else NEIGHBOUR_M
        return not touches(outlines, [*twin.solids, *twin.clear], gap)


def empty_floor(shell: Shell, *, twins: bool = False) -> Floor:
    """The bare floor: partitions stand, the swing of doors, doorways and the start are to stay clear."""
    floor = Floor(shell, window_strips(shell), twins)
    floor.solids += [Solid(shell.partition_outline(p), False, p.height_m) for p in shell.partitions]
    for side in shell.sides:
        for opening in side.openings:
            if opening.kind != "window":
                floor.clear.append(side.strip(opening.ends_m[0] - 0.12, opening.ends_m[1] + 0.12, 0.0, 1.0))
    floor.clear.append(disc(*shell.start, START_CLEAR_M))
    return floor


def half_turned(group: Group) -> Group:
    """The group half a turn about the origin, to the last bit."""
    spots = tuple(replace(s, x_m=-s.x_m, y_m=-s.y_m, yaw_rad=s.yaw_rad + math.pi) for s in group.spots)
    extras = tuple(replace(e, x_m=-e.x_m, y_m=-e.y_m, yaw_rad=e.yaw_rad + math.pi) for e in group.extras)
    return Group(group.name, group.anchor, spots, extras, tuple(-area for area in group.clear))


_ENOUGH = 10
"""Places that fit, of which the best is taken."""


def place(floor: Floor, room: int, group: Group, rng: np.random.Generator, *, tries: int = 60) -> bool:
    """Put a group where it fits best of some places drawn; False if it fits nowhere."""
    best, most, found = None, -math.inf, 0
    for _ in range(tries):
        candidate = _drawn(floor.shell, room, group, rng)
        if candidate is None or not floor.fits(candidate, floor.shell.rooms[room]):
            continue
        found += 1
        score = _worth(floor, room, candidate) + float(rng.uniform(0, 1.2))
        if score > most:
            best, most = candidate, score
        if found == _ENOUGH:
            break
    if best is not None:
        floor.add(best)
    return best is not None


def _drawn(shell: Shell, room: int, group: Group, rng: np.random.Generator) -> Group | None:
    """The group at a random place of its kind."""
    group = group.mirrored() if group.anchor != "corner" and rng.random() < 0.5 else group
    if group.anchor == "free":
        low, high = shell.rooms[room].low, shell.rooms[room].high
        x, y = rng.uniform(np.add(low, 1.2), np.subtract(high, 1.2))
        yaw = float(rng.integers(4)) * math.pi / 2 + float(rng.normal(0, 0.04))
        return group.at(float(x), float(y), yaw)
    side = shell.side(room, int(rng.integers(4)))
    if group.anchor == "corner":
        left = rng.random() < 0.5
        anchor = -side.length_m / 2 if left else side.length_m / 2
        return (group if left else group.mirrored()).at(*side.at(0.0, anchor), side.yaw_rad)
    points = np.concatenate(group.solids)
    reach = side.length_m / 2 - 0.02
    first, last = -reach - float(points[:, 1].min()), reach - float(points[:, 1].max())
    if first >= last:
        return None
    return group.at(*side.at(0.0, float(rng.uniform(first, last))), side.yaw_rad)


_FRIENDS = {("dining", "kitchen"): 3.2, ("chest", "sleeping"): 2.8, ("study", "sleeping"): 4.0}
"""Groups that want to be near each other, and at what distance, metres."""


def _worth(floor: Floor, room: int, group: Group) -> float:
    """How good a place is: away from other groups, near friends, dining in the open."""
    x, y = np.mean([s.footprint.mean(0) for s in group.spots], axis=0)
    low, high = floor.shell.rooms[room].low, floor.shell.rooms[room].high
    there = [m for m in floor.middles if low[0] <= m[1] <= high[0] and low[1] <= m[2] <= high[1]]
    distances = [math.hypot(x - mx, y - my) for _, mx, my in there]
    worth = min(min(distances, default=3.0), 3.0)
    for (name, _, _), distance in zip(there, distances, strict=True):
        wanted = _FRIENDS.get((group.name, name))
        if wanted is not None:
            worth += 2.5 - 0.9 * abs(distance - wanted)
    if group.anchor == "free":
        worth -= 0.25 * math.hypot(x - (low[0] + high[0]) / 2, y - (low[1] + high[1]) / 2)
    return worth


def _within(outline: Array, room: Room, margin_m: float) -> bool:
    low, high = np.add(room.low, margin_m), np.subtract(room.high, margin_m)
    return bool(np.all(outline >= low) and np.all(outline <= high))


def window_strips(shell: Shell) -> list[tuple[Array, float]]:
    """Of every window the floor before it, and the height of its sill."""
    windows = [(side, opening) for side in shell.sides for opening in side.openings if opening.kind == "window"]
    return [(side.strip(o.ends_m[0] - 0.05, o.ends_m[1] + 0.05, 0.0, 0.5), o.low_m - 0.05) for side, o in windows]


def before_window(outline: Array, top_m: float, windows: Sequence[tuple[Array, float]]) -> bool:
    """True if something that high stands before a window."""
    return touches([outline], [strip for strip, sill_m in windows if top_m > sill_m])


def furnish(shell: Shell, shop: Shop, seed: int, attempt: int, *, twins: bool = False) -> Floor:
    """Groups first, then single pieces until the home is full."""
    floor = empty_floor(shell, twins=twins)
    rng = np.random.default_rng([seed, 0xF1A7, attempt])
    rooms = len(shell.rooms)
    total = int(rng.integers(22, 35)) if rooms == 1 else min(MOST_OBJECTS_ROOMS, 9 * rooms + 12)
    for room in range(rooms):
        for name in _groups(shell.rooms[room].name, np.random.default_rng([seed, 0x6209, room]), twins=twins):
            _place_group(floor, room, name, shop, seed, rng)
    _fill(floor, shop, rng, seed, total)
    return floor


def _place_group(floor: Floor, room: int, name: str, shop: Shop, seed: int, rng: np.random.Generator) -> None:
    """Put a group somewhere: as drawn, else drawn anew, else a smaller one."""
    for version, compact in enumerate((False, False, True)):
        own = np.random.default_rng([seed, 0x6209, room, zlib.crc32(name.encode()), version])
        compact = compact or (floor.twins and name in ("kitchen", "bath", "dining"))
        if place(
            floor, room, zones.GROUPS[name](shop, f"{room}:", own, compact), rng, tries=120 if floor.twins else 60
        ):
            return


def _groups(purpose: str, rng: np.random.Generator, *, twins: bool) -> list[str]:
    """Names of the groups of a room, by its purpose; some rooms do without some."""
    home = purpose == "home"
    chosen = [name for name, purposes in _PURPOSES if home or any(word in purpose for word in purposes)]
    luck = dict(zip(("lounge", "reading"), rng.random(2) < (0.6, 0.7), strict=True))
    if twins:  # there is half the floor for everything
        return [name for name in chosen if name not in ("lounge", "reading", "chest")]
    return [name for name in chosen if luck.get(name, True)]


_PURPOSES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("bath", ("bath",)),
    ("kitchen", ("kitchen",)),
    ("sleeping", ("bedroom",)),
    ("living", ("living",)),
    ("study", ("study",)),
    ("dining", ("kitchen",)),
    ("chest", ("bedroom", "living")),
    ("lounge", ()),
    ("reading", ("living", "study")),
)
"""Groups, those that need a corner first, then the largest; words in the purpose of the rooms that they belong to.

A home of a single room has them all."""


_FILLERS: tuple[tuple[str, str, float], ...] = (
    ("plant", "corner", 3.0),
    ("plant", "wall", 1.5),
    ("bookshelf", "wall", 2.0),
    ("chair", "wall", 1.0),
    ("dresser", "wall", 1.0),
    ("lamp", "corner", 1.5),
    ("bin", "corner", 0.6),
    ("bin", "wall", 0.3),
    ("table", "wall", 0.4),
    ("sofa", "wall", 0.8),
)
"""Single pieces, how they stand, how likely."""

_FILLER_STYLES: dict[tuple[str, str], tuple[str, ...]] = {
    ("plant", "wall"): zones.SLIM_PLANTS,
    ("chair", "wall"): zones.CHAIRS,
    ("dresser", "wall"): ("chest", "wardrobe", "sideboard"),
    ("lamp", "corner"): zones.LAMPS,
    ("table", "wall"): ("side",),
    ("sofa", "wall"): ("armchair", "classic", "modern", "chesterfield"),
}
"""Styles that stand alone; any where none are named."""

_MOST: dict[str, int] = {"plant": 5, "bookshelf": 5, "dresser": 4, "lamp": 4, "bin": 4, "sofa": 4, "table": 5}
"""No more of a class than this in 100 m2 for a single piece to be added."""


def _fill(floor: Floor, shop: Shop, rng: np.random.Generator, seed: int, total: int) -> None:
    """Single pieces along the walls and in corners, until there are enough or nothing fits."""
    chances = np.array([chance for _, _, chance in _FILLERS])
    step = 2 if floor.twins else 1
    for k in range(3 * total):
        if len(floor.spots) + step > total:
            break
        room = int(rng.integers(len(floor.shell.rooms)))
        there = {spot.piece.class_name for spot in floor.spots}
        eager = chances * [1.0 if name in there else 6.0 for name, _, _ in _FILLERS]
        name, anchor, _ = _FILLERS[int(rng.choice(len(_FILLERS), p=eager / eager.sum()))]
        if not _enough_of(floor, room, name):
            place(floor, room, _filler(shop, name, anchor, k, seed), rng, tries=25)


def _enough_of(floor: Floor, room: int, name: str) -> bool:
    """True if a room has its share of a class."""
    low, high = floor.shell.rooms[room].low, floor.shell.rooms[room].high
    inside = [s for s in floor.spots if low[0] < s.x_m < high[0] and low[1] < s.y_m < high[1]]
    most = math.ceil(_MOST.get(name, 9) * float(np.prod(np.subtract(high, low))) / 100)
    return sum(spot.piece.class_name == name for spot in inside) >= most


def _filler(shop: Shop, name: str, anchor: str, index: int, seed: int) -> Group:
    rng = np.random.default_rng([seed, 0xF177, index])
    key = f"fill{index}"
    made = zones.in_corner if anchor == "corner" else zones.single
    return made(shop, key, name, rng, _FILLER_STYLES.get((name, anchor), ()))


def numbered(spots: Sequence[Spot], first: int = 1) -> tuple[Placed, ...]:
    """Spots as objects of the home, numbered in order."""
    return tuple(
        Placed(first + k, s.piece, s.x_m, s.y_m, math.remainder(s.yaw_rad, 2 * math.pi), s.z_m)
        for k, s in enumerate(spots)
    )
