"""Tables: for dining, round on one foot, on trestles, low before the sofa, small beside it, and desks."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import (
    BLACK_STEEL,
    STEEL,
    Palette,
    chance,
    lacquer,
    pick,
    piece,
    tinted,
    uniform,
    wood,
)
from semslam.sim.furniture.forms import both_sides, grained, leg, plate, superellipse, swapped
from semslam.sim.furniture.solids import block
from semslam.sim.home import Array, Look, Mesh, Piece, Top
from semslam.sim.shapes import about_z, bar, ellipse, lathe, merge, posed, rectangle, rod, rounded_rectangle, tube

_Part = tuple[Mesh, Look]


def _top(outline: Array, height_m: float, thick_m: float, edge_m: float = 0.008) -> Mesh:
    """The board, its grain along the longer way."""
    along = (1, 0, 0) if np.ptp(outline[:, 0]) > np.ptp(outline[:, 1]) else (0, 1, 0)
    return grained(plate(outline, height_m - thick_m, height_m, edge_m=edge_m), along)


def _surface(outline: Array, height_m: float, share: float) -> tuple[Top, ...]:
    """A rectangle in the middle of a top: this share of its length and width."""
    x, y = (np.abs(outline).max(0) * share).tolist()
    return (Top(height_m, (-x, -y), (x, y)),)


def dining(rng: Generator, palette: Palette) -> Piece:
    """A board on four tapered legs with an apron."""
    deep, wide, z = uniform(rng, 0.78, 0.95), uniform(rng, 1.2, 1.9), uniform(rng, 0.73, 0.76)
    thick, inset = uniform(rng, 0.028, 0.045), uniform(rng, 0.03, 0.09)
    outline = rounded_rectangle(deep, wide, pick(rng, (0.015, 0.04, 0.12)), steps=4)
    x, y = deep / 2 - inset - 0.04, wide / 2 - inset - 0.04
    splay, stout = pick(rng, (0.0, 0.03)), uniform(rng, 0.06, 0.085)
    legs = [
        leg((at, y, z - thick), (at + math.copysign(splay, at), y + splay, 0), stout, 0.55 * stout, rounded=splay > 0)
        for at in (x, -x)
    ]
    low, high = z - thick - uniform(rng, 0.07, 0.1), z - thick + 0.004
    apron = [both_sides(block((-x, y - 0.012, low), (x, y + 0.012, high)))]
    apron += [block((at - 0.012, -y, low), (at + 0.012, y, high)) for at in (-x, x)]
    frame = pick(rng, (palette.wood, palette.wood, lacquer(rng)))
    parts: list[_Part] = [(both_sides(merge(legs)), frame), (merge(apron), frame)]
    parts.append((_top(outline, z, thick), palette.wood))
    return piece("table", "dining", parts, tops=_surface(outline, z, 0.9))


def pedestal(rng: Generator, palette: Palette) -> Piece:
    """A round top on a turned column with four feet, or on a disc."""
    across, z, thick = uniform(rng, 0.85, 1.25), uniform(rng, 0.72, 0.76), uniform(rng, 0.025, 0.035)
    outline = ellipse(across, across, segments=36)
    if chance(rng, 0.55):
        look = palette.wood if chance(rng, 0.6) else lacquer(rng)
        parts: list[_Part] = [(_turned_column(z - thick), look), (_claws(across), look)]
    else:
        look = pick(rng, (lacquer(rng), BLACK_STEEL, STEEL))
        parts = [(_tulip(z - thick, 0.29 * across), look)]
    parts.append((_top(outline, z, thick), palette.wood if chance(rng, 0.7) else look))
    return piece("table", "pedestal", parts, tops=_surface(outline, z, 0.66))


def _turned_column(high_m: float) -> Mesh:
    radii = [
        (0.0, 0.10),
        (0.055, 0.10),
        (0.06, 0.16),
        (0.06, 0.26),
        (0.04, 0.28),
        (0.07, 0.36),
        (0.062, 0.44),
        (0.036, 0.5),
    ]
    radii += [
        (0.036, 0.54),
        (0.05, 0.57),
        (0.04, 0.6),
        (0.045, high_m - 0.06),
        (0.13, high_m - 0.03),
        (0.13, high_m),
        (0, high_m),
    ]
    return swapped(lathe(radii, segments=16))


def _claws(across_m: float) -> Mesh:
    """Four curved feet that spread from the column."""
    out = 0.33 * across_m
    path = [(0.03, 0, 0.22), (0.4 * out, 0, 0.2), (0.75 * out, 0, 0.1), (0.93 * out, 0, 0.035), (out, 0, 0.0285)]
    foot = swapped(tube(path, [0.034, 0.034, 0.03, 0.026, 0.026], segments=8))
    return merge([posed(foot, about_z(math.pi / 4 + k * math.pi / 2)) for k in range(4)])


def _tulip(high_m: float, radius_m: float) -> Mesh:
    """A trumpet foot out of one piece."""
    t = np.linspace(0, 1, 12)
    waist = 0.035
    radius = waist + (radius_m - waist) * (1 - t) ** 5 + 0.09 * t**7
    profile = np.column_stack([radius, 0.012 + t * (high_m - 0.012)])
    return lathe(np.vstack([[(0, 0), (radius_m, 0)], profile, [(0, high_m)]]), segments=24)


def trestle(rng: Generator, palette: Palette) -> Piece:
    """A thick board on two trestles, of wood in A shape or of steel in X shape."""
    deep, wide, z = uniform(rng, 0.78, 0.92), uniform(rng, 1.4, 2.0), uniform(rng, 0.73, 0.76)
    thick = uniform(rng, 0.035, 0.055)
    outline, y, high = rectangle(deep, wide), wide / 2 - uniform(rng, 0.22, 0.32), z - thick
    if chance(rng, 0.6):
        side, look = _a_frame(deep, y, high), palette.wood
        beam = block((-0.02, -y, 0.3), (0.02, y, 0.37))
    else:
        side, look = _x_frame(deep, y, high), BLACK_STEEL
        beam = block((-0.015, -y, high / 2 - 0.015), (0.015, y, high / 2 + 0.015))
    parts: list[_Part] = [(merge([both_sides(side), beam]), look)]
    parts.append((_top(outline, z, thick, 0.006), palette.wood))
    return piece("table", "trestle", parts, tops=_surface(outline, z, 0.92))


def _a_frame(deep_m: float, y_m: float, high_m: float) -> Mesh:
    """Two legs that lean together below a cap, a foot-rest between them."""
    foot, cap = deep_m / 2 - 0.06, 0.12
    legs = [leg((s * cap, y_m, high_m - 0.04), (s * foot, y_m, 0.0), 0.06, 0.05, rounded=False) for s in (-1, 1)]
    beam = block((-deep_m / 2 + 0.08, y_m - 0.03, high_m - 0.055), (deep_m / 2 - 0.08, y_m + 0.03, high_m))
    share = 0.335 / (high_m - 0.04)
    reach = foot + (cap - foot) * share
    return merge([*legs, beam, block((-reach, y_m - 0.018, 0.305), (reach, y_m + 0.018, 0.365))])


def _x_frame(deep_m: float, y_m: float, high_m: float) -> Mesh:
    reach = deep_m / 2 - 0.1
    legs = [
        leg((-s * reach, y_m + 0.002 * s, high_m), (s * reach, y_m + 0.002 * s, 0), 0.06, 0.06, rounded=False)
        for s in (-1, 1)
    ]
    return merge([*legs, block((-reach - 0.02, y_m - 0.03, high_m - 0.02), (reach + 0.02, y_m + 0.03, high_m))])


def coffee(rng: Generator, palette: Palette) -> Piece:
    """Low, with a shelf or on slanted legs; rectangular, oval or round."""
    z, thick = uniform(rng, 0.40, 0.46), uniform(rng, 0.025, 0.04)
    kind = pick(rng, ("shelf", "oval", "round"))
    wide = uniform(rng, 0.9, 1.2) if kind != "round" else uniform(rng, 0.7, 0.9)
    deep = uniform(rng, 0.5, 0.62) if kind != "round" else wide
    outline = (
        rounded_rectangle(deep, wide, 0.02, steps=3) if kind == "shelf" else superellipse(deep, wide, 2.5, segments=36)
    )
    parts: list[_Part] = [(_top(outline, z, thick), palette.wood)]
    look = palette.wood if chance(rng, 0.6) else BLACK_STEEL
    if kind == "shelf":
        parts.append((_shelf_frame(deep, wide, z - thick), look))
    else:
        x, y, stout = 0.28 * deep, 0.3 * wide, 0.045 if look is palette.wood else 0.024
        legs = [leg((s * x, y, z - thick), (s * 1.25 * x, 1.2 * y, 0), stout, 0.6 * stout) for s in (-1, 1)]
        rails = [bar((-x, y, z - thick - 0.02), (x, y, z - thick - 0.02), 0.02, 0.04)]
        cross = bar((0, -y, z - thick - 0.02), (0, y, z - thick - 0.02), 0.02, 0.038)
        parts.append((merge([both_sides(merge([*legs, *rails])), cross]), look))
    return piece("table", "coffee", parts, tops=_surface(outline, z, 0.92 if kind == "shelf" else 0.7))


def _shelf_frame(deep_m: float, wide_m: float, high_m: float) -> Mesh:
    x, y, low = deep_m / 2 - 0.035, wide_m / 2 - 0.035, 0.14
    legs = [leg((at, y, high_m), (at, y, 0), 0.05, 0.045, rounded=False) for at in (x, -x)]
    apron = block((-x, y - 0.01, high_m - 0.06), (x, y + 0.01, high_m))
    ends = [block((at - 0.01, -y, high_m - 0.06), (at + 0.01, y, high_m)) for at in (x, -x)]
    shelf = block((-x - 0.01, -y - 0.01, low), (x + 0.01, y + 0.01, low + 0.018))
    return merge([both_sides(merge([*legs, apron])), *ends, shelf])


def side(rng: Generator, palette: Palette) -> Piece:
    """A small table beside a sofa: a tray on a column, on three legs, or a square one with a shelf."""
    z, across = uniform(rng, 0.46, 0.58), uniform(rng, 0.40, 0.50)
    kind = pick(rng, ("column", "tripod", "square"))
    if kind == "square":
        outline = rounded_rectangle(across, across, 0.015, steps=3)
        frame, top = _shelf_frame(across, across, z - 0.022), _top(outline, z, 0.022)
        return piece("table", "side", [(frame, palette.body), (top, palette.wood)], tops=_surface(outline, z, 0.9))
    outline = ellipse(across, across, segments=30)
    look = pick(rng, (palette.metal, BLACK_STEEL, palette.wood))
    if kind == "column":
        base = lathe([(0, 0), (0.33 * across, 0), (0.33 * across, 0.01), (0.02, 0.022), (0.0, 0.022)], segments=24)
        foot = merge([base, rod((0, 0, 0.015), (0, 0, z - 0.02), 0.016)])
    else:
        angles = [k * 2 * math.pi / 3 for k in range(3)]
        tops = [(0.2 * across * math.cos(a), 0.2 * across * math.sin(a), z - 0.02) for a in angles]
        feet = [(0.42 * across * math.cos(a), 0.42 * across * math.sin(a), 0.0) for a in angles]
        foot = merge([leg(high, low, 0.034, 0.02) for high, low in zip(tops, feet, strict=True)])
    parts: list[_Part] = [(foot, look), (_top(outline, z, 0.022), palette.wood if kind == "tripod" else palette.body)]
    return piece("table", "side", parts, tops=_surface(outline, z, 0.66))


def desk(rng: Generator, palette: Palette) -> Piece:
    """A writing desk; whoever sits at it sits at its front, between drawers and a side or legs."""
    deep, wide, z = uniform(rng, 0.6, 0.72), uniform(rng, 1.15, 1.5), uniform(rng, 0.73, 0.76)
    outline = rectangle(deep, wide)
    sign = pick(rng, (-1.0, 1.0))
    timber = pick(rng, (palette.wood, wood(rng)))
    parts = _drawers(rng, palette, deep, wide, z, sign)
    x, y = deep / 2 - 0.04, wide / 2 - 0.04
    if chance(rng, 0.5):
        look, legs = (
            BLACK_STEEL,
            [leg((at, -sign * y, z - 0.03), (at, -sign * y, 0), 0.04, 0.04, rounded=False) for at in (x, -x)],
        )
        legs.append(block((-x, -sign * y - 0.02, 0.0), (x, -sign * y + 0.02, 0.03)))
    else:
        look, legs = palette.body, [block((-x - 0.02, -sign * y - 0.015, 0.0), (x + 0.02, -sign * y + 0.015, z - 0.03))]
    panel = block((-x, -y, z - 0.40), (-x + 0.016, y, z - 0.03))
    parts += [(merge(legs), look), (panel, palette.body), (_top(outline, z, 0.03, 0.006), timber)]
    return piece("table", "desk", parts, tops=_surface(outline, z, 0.92))


def _drawers(rng: Generator, palette: Palette, deep: float, wide: float, z: float, sign: float) -> list[_Part]:
    """A stack of three drawers under one end, down to the floor or to a plinth."""
    x, outer, across, floor = deep / 2 - 0.03, sign * (wide / 2 - 0.02), uniform(rng, 0.34, 0.42), 0.05
    low, high = sorted((outer, outer - sign * across))
    shell = block((-x, low, floor), (x - 0.022, high, z - 0.025))
    plinth = block((-x + 0.03, low + 0.03, 0.0), (x - 0.06, high - 0.03, floor + 0.01))
    edges = floor + (z - 0.035 - floor) * np.array([0.0, 0.46, 0.73, 1.0])
    front, look = tinted(palette.body, 1.06), palette.metal
    parts: list[_Part] = [(merge([shell, plinth]), tinted(palette.body, 0.9))]
    for bottom, top in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        parts.append((block((x - 0.018, low + 0.004, bottom + 0.004), (x, high - 0.004, top - 0.004)), front))
        middle, level = (low + high) / 2, top - 0.055
        parts.append(
            (rod((x + 0.022, middle - 0.06, level), (x + 0.022, middle + 0.06, level), 0.006, segments=6), look)
        )
        parts += [
            (rod((x - 0.002, at, level), (x + 0.022, at, level), 0.005, segments=5), look)
            for at in (middle - 0.05, middle + 0.05)
        ]
    return parts


TABLES: dict[str, Callable[[Generator, Palette], Piece]] = {
    "dining": dining,
    "pedestal": pedestal,
    "trestle": trestle,
    "coffee": coffee,
    "side": side,
    "desk": desk,
}
"""Makers by style."""
