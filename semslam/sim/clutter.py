"""Loose things: what lies on tables and on the floor; fixtures, no objects of the class list.

What lies on a piece is drawn from that piece's number alone, so that it
stays with it when it is moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from semslam.sim.home import Array, Colour, Fixture, Look, Mesh, Part, Placed, Top, turn
from semslam.sim.palettes import Palette, mixed
from semslam.sim.polygons import closer, rectangle_at, touches
from semslam.sim.shapes import ball, box, cushion, lathe, merge, moved, picture_plane, rod, transformed

Parts = list[tuple[Mesh, Look]]
_STEEL = Look("metal", ((0.68, 0.69, 0.70),), 0.5, shine=0.7)
_CARTON = Look("paint", ((0.66, 0.52, 0.36),), 0.6)
_BEARERS = ("table", "dresser", "bookshelf")


def on_furniture(
    objects: Sequence[Placed], palette: Palette, seed: int, streams: Mapping[int, int] | None = None
) -> list[Fixture]:
    """Things on the tops of tables, dressers and shelves, beside what else stands there.

    Args:
        streams: instances that take the randomness of another one, and so bear the same things.
    """
    fixtures = []
    for item in objects:
        if item.class_name in _BEARERS and item.z_m == 0:
            upon = [other for other in objects if other.z_m > 0 and _carries(item, other)]
            stream = (streams or {}).get(item.instance, item.instance)
            fixtures += _on_piece(item, upon, palette, np.random.default_rng([seed, 0xC7, stream]))
    return fixtures


def _carries(item: Placed, other: Placed) -> bool:
    return math.hypot(item.x_m - other.x_m, item.y_m - other.y_m) < max(item.piece.width_m, item.piece.depth_m) / 2


def _on_piece(item: Placed, upon: Sequence[Placed], palette: Palette, rng: np.random.Generator) -> list[Fixture]:
    tops = [top for top in item.piece.tops if 0.3 < top.z_m < 1.5]
    if not tops or rng.random() < 0.15:
        return []
    top = max(tops, key=lambda top: top.z_m)
    rotation = turn(item.yaw_rad)
    local = [np.asarray((o.footprint - (item.x_m, item.y_m)) @ rotation) for o in upon]
    fixtures = []
    for _ in range(int(rng.integers(1, 5))):
        parts, reach = _SMALL[int(rng.integers(len(_SMALL)))](palette, rng)
        spot = _spot_on(top, reach, local, rng)
        if spot is None:
            continue
        local.append(rectangle_at(*spot, 2 * reach, 2 * reach))
        x, y = rotation @ spot + (item.x_m, item.y_m)
        where = (float(x), float(y), item.z_m + top.z_m)
        fixtures.append(Fixture("clutter", stood(parts, where, item.yaw_rad + float(rng.normal(0, 0.25)))))
    return fixtures


def _spot_on(top: Top, reach: float, taken: Sequence[Array], rng: np.random.Generator) -> tuple[float, float] | None:
    """A free place on a top for something that reaches so far, or None."""
    low, high = np.add(top.low, reach), np.subtract(top.high, reach)
    for _ in range(8 if np.all(low < high) else 0):
        x, y = rng.uniform(low, high)
        outline = rectangle_at(float(x), float(y), 2 * reach, 2 * reach)
        if not any(closer(outline, other, 0.01) for other in taken):
            return float(x), float(y)
    return None


def stood(parts: Parts, where: tuple[float, float, float], yaw_rad: float) -> tuple[Part, ...]:
    return tuple(Part(transformed(mesh, where, yaw_rad), look) for mesh, look in parts)


def on_floor(
    palette: Palette, rng: np.random.Generator, count: int, free: Callable[[Array], bool], room: tuple[Array, Array]
) -> list[Fixture]:
    """Shoes, boxes, baskets and the like on the floor of a room, where `free` allows their outline."""
    fixtures: list[Fixture] = []
    for _ in range(count):
        parts, reach = _LARGE[int(rng.integers(len(_LARGE)))](palette, rng)
        mine = [f.footprint for f in fixtures if f.footprint is not None]
        place = _spot_beside(reach, free, [each for outline in mine for each in (outline, -outline)], room, rng)
        if place is not None:
            x, y, yaw = place
            outline = rectangle_at(x, y, 2 * reach, 2 * reach, yaw)
            fixtures.append(Fixture("clutter", stood(parts, (x, y, 0.0), yaw), outline))
    return fixtures


def _spot_beside(
    reach: float,
    free: Callable[[Array], bool],
    taken: Sequence[Array],
    room: tuple[Array, Array],
    rng: np.random.Generator,
) -> tuple[float, float, float] | None:
    """Place and heading on the floor for something that reaches so far, or None."""
    for _ in range(25):
        x, y = (float(value) for value in rng.uniform(room[0] + 0.3, room[1] - 0.3))
        yaw = float(rng.uniform(0, 2 * math.pi))
        outline = rectangle_at(x, y, 2 * reach, 2 * reach, yaw)
        if not touches([outline], taken, 0.05) and free(outline):
            return x, y, yaw
    return None


def _tint(palette: Palette, rng: np.random.Generator) -> Colour:
    """One of the palette's bright colours, a little lighter or darker."""
    colour = palette.bright[int(rng.integers(4))]
    share = float(rng.uniform(-0.25, 0.25))
    return mixed(colour, (1, 1, 1) if share > 0 else (0, 0, 0), abs(share))


def _glaze(palette: Palette, rng: np.random.Generator) -> Look:
    return Look("paint", (_tint(palette, rng),), 0.8, shine=0.5)


def _books(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A pile, largest at the bottom."""
    parts: Parts = []
    z, size = 0.0, float(rng.uniform(0.10, 0.13))
    for _ in range(int(rng.integers(2, 5))):
        thick, turn_rad = float(rng.uniform(0.018, 0.04)), float(rng.normal(0, 0.15))
        cover = box((-size * 0.72, -size, 0), (size * 0.72, size, thick))
        parts.append((transformed(cover, (0.0, 0.0, z), turn_rad), Look("paint", (_tint(palette, rng),), 0.8)))
        z, size = z + thick, size * float(rng.uniform(0.88, 0.98))
    return parts, 0.15


def _row_of_books(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A few upright books."""
    y, parts = -0.10, list[tuple[Mesh, Look]]()
    while y < 0.09:
        thick, high = float(rng.uniform(0.02, 0.04)), float(rng.uniform(0.18, 0.26))
        parts.append((box((-0.07, y, 0), (0.07, y + thick, high)), Look("paint", (_tint(palette, rng),), 0.8)))
        y += thick + 0.002
    return parts, 0.14


def _bowl(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """With fruit."""
    radius = float(rng.uniform(0.09, 0.14))
    profile = [[0, 0], [0.45, 0], [0.8, 0.25], [1, 0.55], [0.94, 0.56], [0.72, 0.28], [0.4, 0.1], [0, 0.1]]
    parts: Parts = [(lathe(np.array(profile) * radius), _glaze(palette, rng))]
    for k in range(int(rng.integers(0, 5))):
        colour: Colour = ((0.75, 0.20, 0.15), (0.85, 0.60, 0.15), (0.50, 0.62, 0.20))[k % 3]
        angle = 2 * math.pi * k / 4
        place = (0.42 * radius * math.cos(angle), 0.42 * radius * math.sin(angle), 0.52 * radius)
        parts.append((ball(place, 0.035, segments=10), Look("paint", (colour,), 0.5, shine=0.3)))
    return parts, radius


def _vase(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """With or without a few dry stems."""
    high, radius = float(rng.uniform(0.16, 0.30)), float(rng.uniform(0.045, 0.07))
    profile = np.array([[0, 0], [0.7, 0], [1, 0.3], [0.9, 0.6], [0.4, 0.85], [0.5, 1], [0.42, 1], [0, 0.9]])
    parts: Parts = [(lathe(profile * (radius, high), segments=18), _glaze(palette, rng))]
    for _ in range(int(rng.integers(0, 6))):
        angle, lean = float(rng.uniform(0, 2 * math.pi)), float(rng.uniform(0.02, 0.07))
        tip = (lean * math.cos(angle), lean * math.sin(angle), high + float(rng.uniform(0.12, 0.24)))
        stem = rod((0.0, 0.0, high * 0.9), tip, 0.003, segments=5)
        parts += [(stem, Look("plain", ((0.36, 0.40, 0.20),)))]
        parts += [(ball(tip, (0.015, 0.015, 0.025), segments=8), Look("plain", (_tint(palette, rng),)))]
    return parts, radius + 0.06


def _mug(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    profile = np.array([[0, 0], [0.036, 0], [0.04, 0.09], [0.035, 0.09], [0.033, 0.01], [0, 0.01]])
    handle = box((0.036, -0.006, 0.02), (0.062, 0.006, 0.075), bevel_m=0.005)
    return [(merge([lathe(profile, segments=16), handle]), _glaze(palette, rng))], 0.07


def _photo(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A picture in a standing frame."""
    wide, high = float(rng.uniform(0.07, 0.11)), float(rng.uniform(0.18, 0.26))
    frame = box((-0.012, -wide, 0), (0.008, wide, high))
    print_ = moved(picture_plane(2 * wide - 0.03, high - 0.03), (0.0085, 0.0, high / 2))
    canvas = Look("painting", palette.bright, 1.0, seed=int(rng.integers(60)))
    return [(frame, Look("plain", ((0.14, 0.13, 0.12),))), (print_, canvas)], wide + 0.01


def _carton(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A small box with a lid in colour."""
    a, b, high = float(rng.uniform(0.07, 0.12)), float(rng.uniform(0.07, 0.12)), float(rng.uniform(0.07, 0.14))
    lid = box((-a - 0.004, -b - 0.004, high * 0.7), (a + 0.004, b + 0.004, high))
    return [(box((-a, -b, 0), (a, b, high * 0.7)), _CARTON), (lid, _glaze(palette, rng))], max(a, b) + 0.01


def _laptop(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """Open, its screen towards +x."""
    base = box((-0.11, -0.16, 0), (0.11, 0.16, 0.016), bevel_m=0.004)
    lid = box((-0.125, -0.16, 0.012), (-0.112, 0.16, 0.22))
    screen = moved(picture_plane(0.29, 0.18), (-0.111, 0.0, 0.12))
    look = Look("screen", palette.bright, 1.0, glow=0.2, seed=int(rng.integers(9)))
    return [(merge([base, lid]), _STEEL), (screen, look)], 0.17


def _shoes(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A pair, side by side."""
    look = Look("leather", (mixed(_tint(palette, rng), (0.1, 0.1, 0.1), 0.4),), 0.5, shine=0.2)
    pair = []
    for y in (-0.07, 0.07):
        x = float(rng.uniform(-0.03, 0.03))
        pair.append(cushion((x - 0.13, y - 0.045, 0.02), (x + 0.14, y + 0.045, 0.075), bevel_m=0.03, puff_m=0.006))
        pair.append(cushion((x - 0.13, y - 0.04, 0.05), (x - 0.01, y + 0.04, 0.12), bevel_m=0.03, puff_m=0.004))
    soles = [box((-0.14, y - 0.045, 0), (0.14, y + 0.045, 0.022), bevel_m=0.008) for y in (-0.07, 0.07)]
    return [(merge(pair), look), (merge(soles), Look("plain", ((0.85, 0.84, 0.80),)))], 0.19


def _crate(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A cardboard box with tape."""
    a, b, high = float(rng.uniform(0.15, 0.24)), float(rng.uniform(0.15, 0.24)), float(rng.uniform(0.2, 0.38))
    tape = box((-a - 0.001, -0.03, 0.0), (a + 0.001, 0.03, high + 0.001))
    carton = Look("paint", (mixed((0.66, 0.52, 0.36), palette.wood[0], 0.3),), 0.6)
    return [(box((-a, -b, 0), (a, b, high)), carton), (tape, Look("plain", ((0.78, 0.70, 0.55),)))], max(a, b) + 0.01


def _basket(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """Woven, with something soft in it."""
    radius, high = float(rng.uniform(0.16, 0.22)), float(rng.uniform(0.22, 0.34))
    profile = np.array([[0, 0], [0.82, 0], [1, 1], [0.93, 1], [0.88, 0.6], [0, 0.6]]) * (radius, high)
    weave = Look("wicker", (mixed((0.72, 0.56, 0.36), palette.wood[0], 0.3),), 0.35)
    soft = ball((0.0, 0.0, 0.72 * high), (0.8 * radius, 0.8 * radius, 0.35 * high), segments=14)
    cloth = Look("fabric", (_tint(palette, rng),), 0.3)
    return [(lathe(profile), weave), (soft, cloth)], radius + 0.01


def _toy_ball(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    radius = float(rng.uniform(0.08, 0.13))
    look = Look("stripes", (_tint(palette, rng), (0.92, 0.90, 0.86)), 0.3, shine=0.3)
    return [(ball((0.0, 0.0, radius), radius, segments=18), look)], radius + 0.01


def _hassock(palette: Palette, rng: np.random.Generator) -> tuple[Parts, float]:
    """A floor cushion."""
    half, high = float(rng.uniform(0.2, 0.27)), float(rng.uniform(0.14, 0.22))
    pattern = ("fabric", "plaid", "floral")[int(rng.integers(3))]
    look = Look(pattern, (_tint(palette, rng), palette.cloth[0], _tint(palette, rng)), 0.4, seed=int(rng.integers(9)))
    return [(cushion((-half, -half, 0.02), (half, half, high), bevel_m=0.06, puff_m=0.02), look)], half + 0.03


_SMALL = (_books, _row_of_books, _bowl, _vase, _mug, _photo, _carton, _laptop, _mug, _books)
_LARGE = (_shoes, _crate, _basket, _toy_ball, _hassock, _shoes, _books)
