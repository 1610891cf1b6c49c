"""Whole homes from one seed: building, furniture, loose things, lights, and what changes from one day to the next.

A layout is drawn, checked, and drawn again until it is rich enough and a small robot can reach most of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.sim import clutter
from semslam.sim.building import build
from semslam.sim.changes import Surroundings, next_day
from semslam.sim.fittings import fitted, half_turned
from semslam.sim.furnish import MOST_OBJECTS, MOST_OBJECTS_ROOMS, PASSAGE_M, Floor, furnish, numbered, window_strips
from semslam.sim.furniture import Palette as Materials
from semslam.sim.furniture import draw_palette as draw_materials
from semslam.sim.furniture import make_person, make_piece
from semslam.sim.groups import Extra, MakePiece, Shop
from semslam.sim.hangings import Style
from semslam.sim.home import Array, Fixture, Home, Light, Piece, Placed
from semslam.sim.lighting import lights_of
from semslam.sim.palettes import draw_palette, draw_room
from semslam.sim.polygons import area_m2, closer, touches
from semslam.sim.shell import Shell, Side, draw_shell, without_windows
from semslam.sim.space import (
    REACH_M,
    blocked_polygons,
    cell_of,
    clearance_m,
    free_raster,
    reachable,
    stops_robot,
)
from semslam.sim.walk import draw_walk, strip_of

VARIANTS: tuple[str, ...] = ("standard", "plain", "repeating", "symmetric", "rooms", "person")
"""Kinds of homes. Unless a layout is drawn again, `plain`, `repeating` and `person` are the standard home of that seed
with other walls, or with somebody in it."""

DAYS = (0, 1)
LEAST_OBJECTS, LEAST_CLASSES = 18, 10
LEAST_FREE_M2, LEAST_FREE_SHARE = 20.0, 0.25
START_CLEARANCE_M = 0.45
_ALWAYS = {"sofa", "tv", "bed", "table", "chair"}
_ATTEMPTS = 40


@dataclass(frozen=True, eq=False)
class _Draft:
    """A furnished home that has no surfaces yet."""

    shell: Shell
    objects: tuple[Placed, ...]
    extras: tuple[Extra, ...]
    clear: tuple[Array, ...]
    lights: tuple[Light, ...]


def make_home(seed: int, variant: str = "standard", day: int = 0, *, make: MakePiece | None = None) -> Home:
    """The home of a seed.

    Args:
        variant: one of VARIANTS.
        day: 0, or 1 for the same home after some of its furniture was moved.
        make: where pieces come from, given class, randomness and style; None takes `furniture.make_piece` with two sets
            of materials for the whole home.

    Raises:
        SemslamError: unknown variant or day, a negative seed, or no layout was found.
    """
    _require(seed, variant, day)
    shop = Shop(seed, make or _matching(seed))
    for attempt in range(_ATTEMPTS):
        draft = _drafted(seed, variant, attempt, shop)
        home = None if draft is None else _finished(draft, seed, variant, attempt)
        if draft is not None and home is not None:
            return home if day == 0 else _later(home, shop, draft)
    raise SemslamError(f"No layout found for the `{variant}` home of seed {seed}", hint="Take another seed")


def _require(seed: int, variant: str, day: int) -> None:
    if variant not in VARIANTS:
        raise SemslamError(f"No kind of home called `{variant}`", hint=f"Take one of {', '.join(VARIANTS)}")
    if day not in DAYS:
        raise SemslamError(f"A home has the days 0 and 1, not `{day}`", hint="Take day 0 or 1")
    if seed < 0:
        raise SemslamError(f"The seed `{seed}` is negative", hint="Take a whole number from 0")


def _matching(seed: int) -> MakePiece:
    """Pieces of two sets of materials, so that furniture of a home goes together."""
    rng = np.random.default_rng([seed, 0x3A7])
    sets: tuple[Materials, ...] = (draw_materials(rng), draw_materials(rng))

    def make(class_name: str, rng: np.random.Generator, style: str | None = None) -> Piece:
        return make_piece(class_name, rng, style, palette=sets[int(rng.random() < 0.35)])

    return make


def _drafted(seed: int, variant: str, attempt: int, shop: Shop) -> _Draft | None:
    """Building and furniture, or None if too little found its place."""
    shell = draw_shell(seed, variant, attempt)
    floor = furnish(shell, shop, seed, attempt, twins=variant == "symmetric")
    if not _rich_enough(floor):
        return None
    lights, extras = lights_of(shell, seed, twins=variant == "symmetric"), floor.extras
    if variant == "plain":
        shell, extras = without_windows(shell), [extra for extra in extras if extra.solid]
    return _Draft(shell, numbered(floor.spots), tuple(extras), tuple(floor.clear), lights)


def _finished(draft: _Draft, seed: int, variant: str, attempt: int) -> Home | None:
    """The home, or None if there is no way through it."""
    home: Home | None = _dressed(draft, seed, variant, attempt)
    if home is not None and variant == "person":
        home = _inhabited(home, attempt)
    return home if home is not None and roomy(home) else None


def _rich_enough(floor: Floor) -> bool:
    most = MOST_OBJECTS if len(floor.shell.rooms) == 1 else MOST_OBJECTS_ROOMS
    classes = {spot.piece.class_name for spot in floor.spots}
    return LEAST_OBJECTS <= len(floor.spots) <= most and len(classes) >= LEAST_CLASSES and classes >= _ALWAYS


def _dressed(draft: _Draft, seed: int, variant: str, attempt: int) -> Home:
    """The draft with surfaces, loose things and lights."""
    shell, palette = draft.shell, draw_palette(seed)
    looks = tuple(draw_room(palette, seed, variant, k, room.name) for k, room in enumerate(shell.rooms))
    style = Style(palette, looks, seed, variant)
    solid = [extra.outline for extra in draft.extras if extra.solid]
    fixtures = build(shell, style, draft.objects, solid) + _fitted(draft, style)
    home = Home(
        seed,
        variant,
        0,
        shell.rooms,
        shell.outline,
        shell.height_m,
        draft.objects,
        tuple(fixtures),
        draft.lights,
        shell.start,
    )
    loose = _on_floor(home, draft, style, attempt)
    return replace(home, fixtures=(*home.fixtures, *loose, *_on_furniture(home, draft.objects)))


def _on_furniture(home: Home, before: Sequence[Placed]) -> list[Fixture]:
    """What lies on furniture; in a symmetric home the same on both pieces of a pair of `before`."""
    streams = _first_of_pair(before) if home.variant == "symmetric" else {}
    return clutter.on_furniture(home.objects, draw_palette(home.seed), home.seed, streams)


def _first_of_pair(objects: Sequence[Placed]) -> dict[int, int]:
    """Of every object the lower instance of itself and its twin."""
    pairs: dict[int, int] = {}
    for item in objects:
        twin = min(
            objects, key=lambda other: math.hypot(item.x_m + other.x_m, item.y_m + other.y_m) + (other.z_m != item.z_m)
        )
        pairs[item.instance] = min(item.instance, twin.instance)
    return pairs


def _fitted(draft: _Draft, style: Style) -> list[Fixture]:
    """Rugs, counters and the like; in a symmetric home the second of a pair is the first after half a turn."""
    fixtures: list[Fixture] = []
    twins = style.variant == "symmetric"
    done: list[Extra] = []
    for index, extra in enumerate(draft.extras):
        if twins and any(math.hypot(extra.x_m + o.x_m, extra.y_m + o.y_m) < 1e-6 for o in done):
            continue
        done.append(extra)
        room = next(
            k
            for k, r in enumerate(draft.shell.rooms)
            if r.low[0] < extra.x_m < r.high[0] and r.low[1] < extra.y_m < r.high[1]
        )
        wall = style.rooms[room].walls[0]
        made = fitted(extra, style.palette, style.seed, index, _bare_side(draft.shell, room, extra), wall)
        fixtures += made + ([half_turned(fixture) for fixture in made] if twins else [])
    return fixtures


def _bare_side(shell: Shell, room: int, extra: Extra) -> Side | None:
    """The wall behind an extra if there is no window or door in it there."""
    for side in (shell.side(room, k) for k in range(4)):
        local = side.local(extra.outline)
        if local[:, 0].min() > 0.1 or abs(math.remainder(side.yaw_rad - extra.yaw_rad, 2 * math.pi)) > 0.1:
            continue
        low, high = float(local[:, 1].min()), float(local[:, 1].max())
        if all(high < o.ends_m[0] - 0.1 or low > o.ends_m[1] + 0.1 for o in side.openings):
            return side
    return None


def _on_floor(home: Home, draft: _Draft, style: Style, attempt: int) -> list[Fixture]:
    """Loose things on the floor, near furniture and walls rather than in the way."""
    rng = np.random.default_rng([home.seed, 0xF100, attempt])
    twins, taken = style.variant == "symmetric", blocked_polygons(home)

    def free(outline: Array) -> bool:
        if twins and closer(outline, -outline, PASSAGE_M):
            return False
        return _aside(outline, taken) and not touches([outline], draft.clear, 0.05)

    fixtures: list[Fixture] = []
    for room in home.rooms:
        count = int(rng.integers(1, 3 if twins else 5))
        made = clutter.on_floor(style.palette, rng, count, free, (np.array(room.low), np.array(room.high)))
        fixtures += made + ([half_turned(fixture) for fixture in made] if twins else [])
    return fixtures


def _aside(outline: Array, taken: Sequence[Array]) -> bool:
    """True if an outline touches nothing, is close to something, and leaves a passage to everything else."""
    if touches([outline], taken, 0.04) or not touches([outline], taken, 0.3):
        return False
    return sum(closer(outline, other, PASSAGE_M) for other in taken) <= 3


def _inhabited(home: Home, attempt: int) -> Home | None:
    """The home with somebody who walks through it, None if there is no room."""
    rng = np.random.default_rng([home.seed, 0x3A1C, attempt])
    person = make_person(np.random.default_rng([home.seed, 0x3A1D]))
    instance = len(home.objects) + 1
    walker = draw_walk(blocked_polygons(home), home.start, person, instance, rng, home.outline)
    return None if walker is None else replace(home, walker=walker)


def roomy(home: Home) -> bool:
    """True if a robot has room to start, and a corridor leads from there over enough floor and into every room."""
    cell_m = 0.05
    free, origin = free_raster(home, cell_m)
    if clearance_m(free, cell_m)[cell_of(home.start, origin, cell_m)] < START_CLEARANCE_M:
        return False
    reached = reachable(home, cell_m)
    area = float(reached.sum()) * cell_m**2
    floor = sum(area_m2(polygon) for polygon in home.outline)
    if area < max(LEAST_FREE_M2, LEAST_FREE_SHARE * floor):
        return False
    return all(_share_reached(reached, room.low, room.high, origin, cell_m) > 0.15 for room in home.rooms)


def _share_reached(
    reached: NDArray[np.bool_],
    low: tuple[float, float],
    high: tuple[float, float],
    origin: tuple[float, float],
    cell_m: float,
) -> float:
    first, last = cell_of(low, origin, cell_m), cell_of(high, origin, cell_m)
    return float(reached[first[0] : last[0], first[1] : last[1]].mean())


def _later(home: Home, shop: Shop, draft: _Draft) -> Home:
    """The same home on day 1."""
    still = [fixture for fixture in home.fixtures if not _lies_on_furniture(fixture)]
    fixed = [f.footprint for f in still if f.footprint is not None and stops_robot(f)]
    if home.walker is not None:
        fixed.append(strip_of(home.walker))
    around = Surroundings(draft.shell, tuple(fixed), draft.clear, tuple(window_strips(draft.shell)))
    first_new = max(item.instance for item in home.objects) + (1 if home.walker is None else 2)

    def accepts(objects: Sequence[Placed]) -> bool:
        return roomy(replace(home, objects=tuple(objects)))

    rng = np.random.default_rng([home.seed, 0xDA71])
    objects = next_day(home.objects, around, shop, rng, accepts, first_new)
    later = replace(home, day=1, objects=objects)
    return replace(later, fixtures=(*still, *_on_furniture(later, home.objects)))


def _lies_on_furniture(fixture: Fixture) -> bool:
    return fixture.kind == "clutter" and fixture.footprint is None


__all__ = ["REACH_M", "VARIANTS", "blocked_polygons", "free_raster", "make_home", "reachable", "roomy"]
