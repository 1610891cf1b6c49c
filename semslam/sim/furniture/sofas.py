"""Sofas: with loose cushions, low on metal legs, around a corner, with rolled and buttoned leather, for one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import BLACK_STEEL, CHROME, Palette, chance, pick, piece, tinted, uniform
from semslam.sim.furniture.forms import back_pad, both_sides, leg, mirrored, pad, pillow, slab
from semslam.sim.furniture.solids import block
from semslam.sim.home import Array, Look, Mesh, Piece, Vector
from semslam.sim.shapes import about_y, about_z, ball, merge, moved, posed, rod, tube

_Part = tuple[Mesh, Look]


def _rows(wide_m: float, count: int, gap_m: float = 0.006) -> list[tuple[float, float]]:
    """Sides (low, high) of equal cushions next to each other along y."""
    edges = np.linspace(-wide_m / 2, wide_m / 2, count + 1)
    return [(float(a) + gap_m / 2, float(b) - gap_m / 2) for a, b in itertools.pairwise(edges)]


def _throw(rng: Generator, place: Vector, lean_rad: float, size_m: float) -> Mesh:
    """A pillow that leans against a back; `place` is the middle of its lower edge."""
    lying = moved(pillow(size_m, size_m, 0.15, count=7), (-size_m / 2, 0, 0))
    tilt = about_y(math.pi / 2 - lean_rad) @ about_z(uniform(rng, -0.14, 0.14))
    return posed(lying, about_z(uniform(rng, -0.2, 0.2)) @ tilt, place)


def _throws(rng: Generator, palette: Palette, half_m: float, x_m: float, seat_m: float) -> list[_Part]:
    """None to three pillows, near the arms."""
    parts: list[_Part] = []
    places = (half_m - 0.22, -half_m + 0.23, half_m - 0.68)[: int(rng.integers(0, 4 if half_m > 0.75 else 3))]
    for y in places:
        look = pick(rng, (palette.accent, palette.accent, palette.linen))
        parts.append((_throw(rng, (x_m, y, seat_m + 0.015), uniform(rng, 0.3, 0.45), uniform(rng, 0.38, 0.46)), look))
    return parts


def classic(rng: Generator, palette: Palette) -> Piece:
    """Two or three seats between padded arms, with loose seat and back cushions."""
    count = int(rng.integers(2, 4))
    inner, arm = count * uniform(rng, 0.56, 0.66), uniform(rng, 0.16, 0.22)
    return _cushioned(rng, palette, "classic", count, inner, arm)


def armchair(rng: Generator, palette: Palette) -> Piece:
    """A sofa for one."""
    return _cushioned(rng, palette, "armchair", 1, uniform(rng, 0.56, 0.64), uniform(rng, 0.14, 0.2))


def _cushioned(rng: Generator, palette: Palette, style: str, count: int, inner_m: float, arm_m: float) -> Piece:
    deep, seat, tall = uniform(rng, 0.86, 0.96), uniform(rng, 0.42, 0.47), uniform(rng, 0.80, 0.92)
    foot, cover = uniform(rng, 0.07, 0.13), pick(rng, (palette.fabric, palette.fabric, palette.leather))
    x, y = deep / 2, inner_m / 2
    body = [pad((-x + 0.02, -y - 0.02, foot), (x - 0.035, y + 0.02, seat - 0.14), edge_m=0.025, crown_m=0.0)]
    body.append(
        back_pad((-x + 0.02, 0, foot + 0.02), tall - 0.12 - foot, inner_m + 1.1 * arm_m, 0.17, 0.1, crown_m=0.0)
    )
    high = seat + uniform(rng, 0.13, 0.2)
    body.append(both_sides(pad((-x, y, foot), (x - 0.02, y + arm_m, high), edge_m=0.06, crown_m=0.012)))
    for low, top in _rows(inner_m, count):
        body.append(pad((-x + 0.2, low, seat - 0.145), (x, top, seat - 0.01), edge_m=0.045, crown_m=0.03))
        body.append(_back_cushion(rng, (-x + 0.2, (low + top) / 2, seat - 0.02), tall - seat + 0.02, top - low))
    parts: list[_Part] = [(merge(body), cover)]
    parts.append((_feet(x - 0.08, y + arm_m - 0.07, foot, 0.055, 0.035), tinted(palette.wood, 0.9)))
    if chance(rng, 0.75):
        parts += _throws(rng, palette, y, -x + 0.40, seat) if count > 1 else _one_throw(rng, palette, -x + 0.40, seat)
    return piece("sofa", style, parts)


def _one_throw(rng: Generator, palette: Palette, x_m: float, seat_m: float) -> list[_Part]:
    return [(_throw(rng, (x_m, uniform(rng, -0.06, 0.06), seat_m + 0.015), 0.4, 0.42), palette.accent)]


def _back_cushion(rng: Generator, place: Vector, tall_m: float, wide_m: float) -> Mesh:
    lean = 0.2 + uniform(rng, -0.03, 0.03)
    return back_pad(place, tall_m, wide_m, 0.15, lean, crown_m=0.035)


def _feet(x_m: float, y_m: float, tall_m: float, top_m: float, foot_m: float) -> Mesh:
    """Four tapered feet below the corners of a body."""
    feet = [leg((x, y_m, tall_m + 0.02), (x * 1.03, y_m * 1.01, 0), top_m, foot_m) for x in (x_m, -x_m)]
    return both_sides(merge(feet))


def modern(rng: Generator, palette: Palette) -> Piece:
    """Low and slender: thin arms, one long seat or two, high on thin legs."""
    wide, deep, seat = uniform(rng, 1.65, 2.15), uniform(rng, 0.82, 0.9), uniform(rng, 0.41, 0.44)
    foot, arm, tall = uniform(rng, 0.14, 0.18), uniform(rng, 0.07, 0.1), uniform(rng, 0.74, 0.82)
    x, y = deep / 2, wide / 2 - arm
    cover = palette.fabric
    body = [pad((-x + 0.02, -y - 0.02, foot), (x - 0.02, y + 0.02, seat - 0.13), edge_m=0.03, crown_m=0.0)]
    body.append(back_pad((-x + 0.015, 0, foot + 0.04), tall - foot - 0.06, wide - 0.02, 0.10, 0.08, crown_m=0.0))
    body.append(both_sides(pad((-x + 0.05, y, foot), (x, y + arm, seat + 0.13), edge_m=0.03, crown_m=0.005)))
    seats = int(rng.integers(2, 4))
    for low, high in _rows(2 * y, seats):
        body.append(pad((-x + 0.12, low, seat - 0.14), (x + 0.01, high, seat - 0.01), edge_m=0.035, crown_m=0.018))
    for low, high in _rows(2 * y, seats):
        body.append(_back_cushion(rng, (-x + 0.13, (low + high) / 2, seat - 0.015), tall - seat + 0.03, high - low))
    legs = [leg((at, y - 0.1, foot + 0.02), (at * 1.12, y - 0.05, 0.0), 0.026, 0.016) for at in (x - 0.09, -x + 0.09)]
    look = pick(rng, (BLACK_STEEL, CHROME, palette.wood))
    parts: list[_Part] = [(merge(body), cover), (both_sides(merge(legs)), look)]
    return piece("sofa", "modern", parts + _throws(rng, palette, y, -x + 0.33, seat))


def corner(rng: Generator, palette: Palette) -> Piece:
    """A long seat with a couch along one side: the footprint is an L."""
    wide, deep, seat = uniform(rng, 2.2, 2.7), uniform(rng, 0.86, 0.94), uniform(rng, 0.41, 0.45)
    long, couch, arm, tall = uniform(rng, 1.5, 1.75), uniform(rng, 0.84, 0.95), uniform(rng, 0.14, 0.2), 0.84
    foot, cover = 0.06, palette.fabric
    x, y = -deep / 2, wide / 2  # of the back, of the sides; the couch lies at +y
    front, inner = x + deep, y - couch
    floor = foot, seat - 0.14
    body = [pad((x + 0.02, -y + 0.04, floor[0]), (front - 0.02, inner + 0.04, floor[1]), edge_m=0.02, crown_m=0.0)]
    body.append(pad((x + 0.02, inner, floor[0]), (x + long - 0.02, y - 0.01, floor[1]), edge_m=0.02, crown_m=0.0))
    body.append(back_pad((x + 0.02, 0.0, foot + 0.02), tall - 0.15 - foot, wide - 0.04, 0.17, 0.1, crown_m=0.0))
    body.append(pad((x, -y, foot), (front - 0.01, -y + arm, seat + 0.17), edge_m=0.05, crown_m=0.01))
    spots = [(-y + arm + (inner + y - arm) * k / 2, -y + arm + (inner + y - arm) * (k + 1) / 2) for k in range(2)]
    for low, high in spots:
        body.append(pad((x + 0.2, low + 0.003, floor[1]), (front, high - 0.003, seat - 0.01), crown_m=0.028))
    body.append(pad((x + 0.2, inner + 0.003, floor[1]), (x + long, y, seat - 0.01), crown_m=0.022))
    for low, high in [*spots, (inner, y)]:
        wide_m = high - low - 0.008
        body.append(_back_cushion(rng, (x + 0.2, (low + high) / 2, seat - 0.02), tall - seat + 0.01, wide_m))
    feet = [rod((a, b, 0.0), (a, b, foot + 0.02), 0.03) for a, b in _corner_feet(x, y, front, inner, long)]
    parts: list[_Part] = [(merge(body), cover), (merge(feet), BLACK_STEEL)]
    parts += _throws(rng, palette, y - 0.1, x + 0.40, seat)
    outline = _ell(x, y, front, inner, x + long)
    made = piece("sofa", "corner", parts, footprint=outline)
    return _flipped(made) if chance(rng, 0.5) else made


def _corner_feet(x: float, y: float, front: float, inner: float, long: float) -> list[tuple[float, float]]:
    feet = [
        (x + 0.08, -y + 0.1),
        (front - 0.1, -y + 0.1),
        (x + 0.08, inner),
        (front - 0.1, inner),
        (x + 0.08, y - 0.08),
    ]
    return [*feet, (x + long - 0.1, y - 0.08), (x + long - 0.1, inner + 0.08)]


def _ell(x: float, y: float, front: float, inner: float, end: float) -> Array:
    """Outline of the corner sofa, counter-clockwise; the back leans out a little behind."""
    back = x - 0.055
    return np.array([(back, -y), (front + 0.005, -y), (front + 0.005, inner), (end, inner), (end, y), (back, y)])


def _flipped(made: Piece) -> Piece:
    """The piece with left and right exchanged."""
    parts = [(mirrored(part.mesh), part.look) for part in made.parts]
    return piece(made.class_name, made.style, parts, footprint=(made.footprint * (1, -1))[::-1])


def chesterfield(rng: Generator, palette: Palette) -> Piece:
    """Leather with rolled arms as high as the back, buttoned all along."""
    count = int(rng.integers(2, 4))
    inner, deep, seat = count * uniform(rng, 0.56, 0.62), uniform(rng, 0.86, 0.92), uniform(rng, 0.41, 0.44)
    roll, foot, tall = uniform(rng, 0.09, 0.105), 0.09, uniform(rng, 0.78, 0.86)
    x, y, z = deep / 2, inner / 2 + 0.02, tall - roll
    look = palette.leather if chance(rng, 0.8) else palette.fabric
    body = [pad((-x + 0.08, -y - 0.04, foot), (x - 0.03, y + 0.04, seat - 0.14), edge_m=0.02, crown_m=0.0)]
    body.append(_roll(roll, [(-x + roll, -y - roll, z), (-x + roll, y + roll, z)]))
    rest = z - 0.09  # of the arms: a little lower than the back
    arm = [_roll(roll, [(-x + roll, y + roll, rest), (x - 0.03, y + roll, rest)])]
    arm.append(block((-x + 0.1, y + 0.03, foot), (x - 0.045, y + roll * 1.7, rest), 0.02))
    body += [both_sides(merge(arm)), block((-x + 0.02, -y - roll, foot), (-x + roll * 1.5, y + roll, z), 0.02)]
    for low, high in _rows(2 * y + 0.04, count):
        body.append(pad((-x + 0.2, low, seat - 0.145), (x, high, seat - 0.005), edge_m=0.035, crown_m=0.02))
    tufts, buttons = _tufts(-x + 0.2, y, seat - 0.03, z + 0.02, 3 * count)
    parts: list[_Part] = [(merge([*body, tufts]), look), (buttons, tinted(look, 0.6))]
    parts.append((both_sides(_scroll(x - 0.03, y + roll, rest, roll)), tinted(look, 0.85)))
    parts.append((_feet(x - 0.1, y + 0.06, foot, 0.07, 0.045), tinted(palette.wood, 0.6)))
    if chance(rng, 0.6):
        parts += _throws(rng, palette, y - 0.05, -x + 0.36, seat)
    return piece("sofa", "chesterfield", parts)


def _roll(radius_m: float, path: list[Vector]) -> Mesh:
    return tube(path, radius_m, segments=18)


def _scroll(x_m: float, y_m: float, z_m: float, radius_m: float) -> Mesh:
    """The rolled front of an arm: a disc, and a ring around it."""
    angles = np.linspace(0, 2 * np.pi, 17)
    ring = np.column_stack(
        [np.full(17, x_m), y_m + 0.85 * radius_m * np.cos(angles), z_m + 0.85 * radius_m * np.sin(angles)]
    )
    return merge([tube(ring, 0.008, segments=5), ball((x_m, y_m, z_m), (0.012, 0.018, 0.018), segments=8)])


def _tufts(x_m: float, half_m: float, low_m: float, high_m: float, columns: int) -> tuple[Mesh, Mesh]:
    """A back that bulges between rows of buttons, and the buttons."""
    y, t = np.linspace(-half_m, half_m, 3 * columns + 1)[:, None], np.linspace(0, 1, 10)[None]
    dip = np.maximum(np.cos(np.pi * columns * (y + half_m) / (2 * half_m)) * np.cos(3 * np.pi * t), 0)
    x = x_m - 0.10 * t + 0.014 - 0.034 * dip
    grid = np.stack([x, np.broadcast_to(y, x.shape), np.broadcast_to(low_m + (high_m - low_m) * t, x.shape)], -1)
    places = [grid[i, j] for i, j in np.argwhere(dip[:, 1:-1] > 0.97) + (0, 1)]
    buttons = [ball((float(p[0]) + 0.012, float(p[1]), float(p[2])), 0.011, segments=6) for p in places]
    return slab(grid, 0.02), merge(buttons)


SOFAS: dict[str, Callable[[Generator, Palette], Piece]] = {
    "classic": classic,
    "modern": modern,
    "corner": corner,
    "chesterfield": chesterfield,
    "armchair": armchair,
}
"""Makers by style."""
