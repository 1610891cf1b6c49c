"""The next day of a home: about a third of the movable furniture was moved, turned, taken away or is new."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semslam.sim.furnish import before_window
from semslam.sim.groups import Shop
from semslam.sim.home import Array, Placed, Room
from semslam.sim.polygons import disc, touches
from semslam.sim.shell import Shell
from semslam.sim.zones import CHAIRS, LAMPS, SLIM_PLANTS

MOVABLE = ("chair", "bin", "plant", "lamp", "table", "dresser")
SHARE = 1 / 3
"""Of the movable objects, how many are not where they were."""
_GAP_M = 0.06
_LOW_M = 0.6
"""Tables lower than this are moved, larger ones stay."""

Accepts = Callable[[Sequence[Placed]], bool]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a moved piece must keep clear of."""

    shell: Shell
    fixed: tuple[Array, ...]
    """Outlines of fixtures."""
    clear: tuple[Array, ...]
    """Floor before doors."""
    windows: tuple[tuple[Array, float], ...]
    """Floor before windows, and from which height it stays empty."""


def next_day(
    objects: Sequence[Placed],
    around: Surroundings,
    shop: Shop,
    rng: np.random.Generator,
    accepts: Accepts,
    first_new: int,
) -> tuple[Placed, ...]:
    """The objects a day later; those that stayed are the same objects, new ones get new numbers.

    Args:
        accepts: whether a robot could still reach the floor with the objects like this.
        first_new: the instance of the first piece that is new.
    """
    now = list(objects)
    names = [item.instance for item in objects if is_movable(item, objects)]
    wanted = max(2, round(SHARE * len(names)))
    order = [names[int(k)] for k in rng.permutation(len(names))]
    changed, removed = 0, 0
    for instance in order:
        if changed == wanted:
            break
        item = next(o for o in now if o.instance == instance)
        take_away = removed < wanted // 4 and item.class_name != "table" and rng.random() < 0.35
        trial = _without(now, item) if take_away else _moved(now, item, around, rng)
        if trial is not None and accepts(trial):
            now, changed, removed = trial, changed + 1, removed + take_away
    return tuple(_with_new(now, around, shop, rng, accepts, first_new))


def is_movable(item: Placed, objects: Sequence[Placed]) -> bool:
    """True for what people shift about: light things on the floor that carry nothing of the class list."""
    if item.class_name not in MOVABLE or item.z_m > 0:
        return False
    if item.class_name == "table" and item.piece.height_m > _LOW_M:
        return False
    return not any(other.z_m > 0 and _beside(item, other) < 0.5 for other in objects)


def _beside(first: Placed, second: Placed) -> float:
    return math.hypot(first.x_m - second.x_m, first.y_m - second.y_m)


def _without(now: Sequence[Placed], item: Placed) -> list[Placed]:
    return [other for other in now if other.instance != item.instance]


def _moved(now: Sequence[Placed], item: Placed, around: Surroundings, rng: np.random.Generator) -> list[Placed] | None:
    """The objects with one of them elsewhere: a chair nearby and turned, a chest along a wall, the rest anywhere."""
    others = _without(now, item)
    for _ in range(80):
        place = _elsewhere(item, around.shell, rng)
        if _beside(place, item) < 0.25 and abs(place.yaw_rad - item.yaw_rad) < 0.4:
            continue
        if _stands_free(place, others, around):
            return [place if other.instance == item.instance else other for other in now]
    return None


def _elsewhere(item: Placed, shell: Shell, rng: np.random.Generator) -> Placed:
    if item.class_name in ("chair", "table"):
        dx, dy = rng.normal(0, 0.7, 2)
        yaw = item.yaw_rad + float(rng.normal(0, 0.8))
        return replace(item, x_m=item.x_m + float(dx), y_m=item.y_m + float(dy), yaw_rad=yaw)
    side = shell.sides[int(rng.integers(len(shell.sides)))]
    reach = side.length_m / 2 - item.piece.width_m / 2 - 0.05
    along = float(rng.uniform(-reach, reach))
    x, y = side.at(item.piece.depth_m / 2 + float(rng.uniform(0.02, 0.05)), along)
    return replace(item, x_m=x, y_m=y, yaw_rad=math.remainder(side.yaw_rad, 2 * math.pi))


def _stands_free(place: Placed, others: Sequence[Placed], around: Surroundings) -> bool:
    """True if a piece is in a room and away from everything, the start and the doors included."""
    outline = place.footprint
    if not any(_inside(outline, room) for room in around.shell.rooms):
        return False
    if touches([outline], [other.footprint for other in others if other.z_m == 0], _GAP_M):
        return False
    if touches([outline], [*around.fixed, *around.clear, disc(*around.shell.start, 0.55)], 0.005):
        return False
    return not before_window(outline, place.piece.height_m, around.windows)


def _inside(outline: Array, room: Room) -> bool:
    return bool(np.all(outline > np.add(room.low, 0.014)) and np.all(outline < np.subtract(room.high, 0.014)))


_NEWCOMERS = (("plant", SLIM_PLANTS), ("bin", ()), ("lamp", LAMPS), ("chair", CHAIRS))


def _with_new(
    now: Sequence[Placed],
    around: Surroundings,
    shop: Shop,
    rng: np.random.Generator,
    accepts: Accepts,
    instance: int,
) -> list[Placed]:
    """One or two pieces that were not there before."""
    objects = list(now)
    for k in range(int(rng.integers(1, 3))):
        name, styles = _NEWCOMERS[int(rng.integers(len(_NEWCOMERS)))]
        piece = shop.get(f"new{k}{name}", name, styles)
        for _ in range(60):
            side = around.shell.sides[int(rng.integers(len(around.shell.sides)))]
            out = piece.depth_m / 2 + float(rng.uniform(0.02, 0.05))
            reach = side.length_m / 2 - piece.width_m / 2 - 0.05
            x, y = side.at(out, float(rng.uniform(-reach, reach)))
            place = Placed(instance, piece, x, y, math.remainder(side.yaw_rad, 2 * math.pi))
            if _stands_free(place, objects, around) and accepts([*objects, place]):
                objects.append(place)
                instance += 1
                break
    return objects
