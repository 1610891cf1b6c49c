"""Potted plants: palms, a dragon tree, a bush, snake plants, a rubber plant; pots, soil and leaves."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from semslam.sim.furniture.common import (
    Palette,
    ceramic,
    chance,
    darker,
    foliage,
    pick,
    piece,
    terracotta,
    tinted,
    uniform,
    wicker,
)
from semslam.sim.furniture.forms import curve
from semslam.sim.home import Array, Look, Mesh, Piece
from semslam.sim.shapes import lathe, moved, rod, sheet, tube

Parts = list[tuple[Mesh, Look]]

_SOIL = Look("plaster", ((0.20, 0.14, 0.10),), tile_m=0.15)
_BARK = Look("wood", ((0.46, 0.36, 0.26), (0.30, 0.23, 0.16)), tile_m=0.15)
_OVAL = ((0.0, 0.10), (0.2, 0.72), (0.45, 1.0), (0.75, 0.72), (1.0, 0.05))
"""Width of a broad leaf along its length, as a share of the greatest."""
_BLADE = ((0.0, 0.55), (0.3, 1.0), (0.7, 0.75), (1.0, 0.04))
_ANGLE = math.pi * (3 - math.sqrt(5))
"""Each leaf grows at this angle from the one before."""


def palm(rng: Generator, palette: Palette) -> Piece:
    """Arched fronds with rows of narrow leaflets, out of one clump."""
    look, height = _leaves(rng), uniform(rng, 1.1, 1.7)
    parts, rim, radius = _pot(rng, palette, uniform(rng, 0.15, 0.19))
    fronds = int(rng.integers(8, 11))
    for k in range(fronds):
        heading, young = k * _ANGLE + uniform(rng, -0.2, 0.2), k / fronds
        length = min(1.15, height - rim) * uniform(rng, 0.85, 1.0) * (0.82 + 0.18 * young)
        start = (0.25 * radius * math.cos(heading), 0.25 * radius * math.sin(heading), rim - 0.02)
        rise = 1.42 + 0.12 * young
        parts += _frond(start, heading, length, rise, uniform(rng, 0.8, 1.0) * (1.0 - 0.65 * young), look)
    return piece("plant", "palm", parts)


def _frond(start: Sequence[float], heading: float, length: float, rise: float, droop: float, look: Look) -> Parts:
    """A bent stem whose outer part carries leaflets on both sides."""
    line, slopes = _bent(start, heading, length, rise, droop, 12)
    parts: Parts = [(tube(line[::2], np.linspace(0.007, 0.003, 6).tolist(), segments=4), tinted(look, 1.15))]
    pairs = 10
    for k in range(pairs):
        share = 0.30 + 0.68 * k / (pairs - 1)
        at = share * (len(line) - 1)
        low = min(int(at), len(line) - 2)
        place = line[low] + (at - low) * (line[low + 1] - line[low])
        size = 0.27 * length * (0.55 + 0.45 * math.sin(math.pi * (0.2 + 0.7 * k / pairs)))
        for side in (-1, 1):
            away = heading + side * (1.05 - 0.75 * k / (pairs - 1))
            leaf = _leaf(place, away, slopes[low] * 0.4 + 0.1, size, 0.042, 1.1, _BLADE, rows=4, folds=False)
            parts.append((leaf, look))
    return parts


def dragon_tree(rng: Generator, palette: Palette) -> Piece:
    """Bare canes of different height, each with a tuft of long arched blades."""
    look, height = _leaves(rng), uniform(rng, 1.1, 1.7)
    parts, rim, radius = _pot(rng, palette, uniform(rng, 0.14, 0.18))
    canes = int(rng.integers(2, 4))
    for k in range(canes):
        angle = 2 * math.pi * k / canes + uniform(rng, 0, 1)
        tuft = 0.44
        tip = rim + (height - rim - 0.5 * tuft) * (1 - 0.27 * k)
        lean = 0.4 * radius * np.array([math.cos(angle), math.sin(angle), 0.0])
        top = np.array([0.0, 0.0, tip]) + 1.6 * lean
        line = curve([lean + (0, 0, rim - 0.02), 1.2 * lean + (0, 0, (rim + tip) / 2), top], 6)
        parts.append((tube(line, 0.014, segments=8), _BARK))
        for j in range(26):
            share = j / 26
            blade = _leaf(
                top - (0, 0, 0.10 * (1 - share)),
                j * _ANGLE,
                0.35 + 1.05 * share,
                tuft * uniform(rng, 0.85, 1.05),
                0.05,
                1.7 - 0.8 * share,
                _BLADE,
                rows=6,
                folds=False,
            )
            parts.append((blade, look))
    return piece("plant", "dragon_tree", parts)


def bush(rng: Generator, palette: Palette) -> Piece:
    """Many small leaves on branching stems: a round head, sometimes on a trunk."""
    look, bright = _leaves(rng), uniform(rng, 1.15, 1.35)
    parts, rim, radius = _pot(rng, palette, uniform(rng, 0.13, 0.18))
    tree = chance(rng, 0.5)
    spread = uniform(rng, 0.28, 0.36) if tree else uniform(rng, 0.24, 0.32)
    trunk = uniform(rng, 0.4, 0.7) if tree else 0.04
    middle = np.array([0.0, 0.0, rim + trunk + spread * 0.8])
    if tree:
        stem = np.array([(0, 0, rim - 0.02), (0.015, 0.01, rim + 0.5 * trunk), tuple(middle)])
        parts.append((tube(stem, (0.02, 0.017, 0.008)), _BARK))
    twigs = 14
    for k in range(twigs):
        way = _direction(k, twigs, -0.35 if tree else -0.1)
        start = (
            middle - (0, 0, 0.3 * spread) if tree else np.array([0.0, 0.0, rim - 0.02]) + 0.3 * radius * way * (1, 1, 0)
        )
        tip = middle + spread * uniform(rng, 0.75, 1.0) * way * (1, 1, 1.1)
        parts.append((tube([start, 0.5 * (start + tip) + (0, 0, 0.05), tip], (0.006, 0.004, 0.002), segments=4), _BARK))
        for j in range(9):
            share = 0.4 + 0.6 * (j + 1) / 9
            place = start + share * (tip - start) + (0, 0, 0.2 * share * (1 - share))
            heading, size = math.atan2(way[1], way[0]) + uniform(rng, -1.7, 1.7), uniform(rng, 0.10, 0.15)
            leaf = _leaf(place, heading, uniform(rng, -0.3, 0.9), size, 0.55 * size, 0.9, _OVAL, rows=4)
            parts.append((leaf, look if (j + k) % 3 else tinted(look, bright)))
    return piece("plant", "bush", parts)


def snake_plant(rng: Generator, palette: Palette) -> Piece:
    """Stiff upright blades with light margins."""
    look, tall = _leaves(rng), uniform(rng, 0.45, 0.85)
    margin = Look("plain", (pick(rng, ((0.66, 0.68, 0.30), (0.58, 0.66, 0.36), darker(look.colours[0], 1.4))),))
    parts, rim, radius = _pot(rng, palette, uniform(rng, 0.12, 0.16))
    count = int(rng.integers(14, 20))
    for k in range(count):
        share = math.sqrt((k + 0.5) / count)
        heading = k * _ANGLE
        place = (0.72 * radius * share * math.cos(heading), 0.72 * radius * share * math.sin(heading), rim - 0.02)
        length, wide = tall * uniform(rng, 0.65, 1.0) * (1.1 - 0.35 * share), uniform(rng, 0.045, 0.065)
        parts += _sword(place, heading, 1.5 - 0.32 * share, length, wide, (look, margin))
    return piece("plant", "snake", parts)


def _sword(
    place: Sequence[float], heading: float, rise: float, length: float, wide: float, looks: tuple[Look, Look]
) -> Parts:
    """A blade with a margin: a narrow leaf in front and behind of a broader one."""
    shape = ((0.0, 0.6), (0.25, 0.9), (0.6, 1.0), (0.85, 0.7), (1.0, 0.06))
    inner, outer = (
        _leaf(place, heading, rise, length, wide * scale, -0.12, shape, rows=6, folds=False, thick=thick)
        for scale, thick in ((0.76, 0.006), (1.0, 0.002))
    )
    return [(inner, looks[0]), (outer, looks[1])]


def rubber_plant(rng: Generator, palette: Palette) -> Piece:
    """Big glossy oval leaves around one or two upright stems."""
    look, height = dataclasses.replace(_leaves(rng), shine=0.5), uniform(rng, 0.9, 1.6)
    parts, rim, radius = _pot(rng, palette, uniform(rng, 0.14, 0.19))
    stems = int(rng.integers(1, 3))
    for stem in range(stems):
        tip = rim + (height - rim) * (1 - 0.22 * stem) - 0.1
        side = (0.3 * radius * (2 * stem - 1) if stems > 1 else 0.0, 0.02 * stem)
        parts.append((rod((*side, rim - 0.02), (side[0] * 1.8, side[1], tip), 0.012, 0.006, segments=8), _BARK))
        count = int((tip - rim) / 0.036)
        for k in range(count):
            share = (k + 0.5) / count
            place = (side[0] * (1 + 0.8 * share), side[1], rim + 0.04 + (tip - rim - 0.02) * share)
            size = uniform(rng, 0.25, 0.32) * (1.05 - 0.35 * share)
            leaf = _leaf(
                place, k * _ANGLE + stem, 0.45 + 0.7 * share**2, size, 0.5 * size, 0.75, _OVAL, rows=6, stalk=0.05
            )
            parts.append((leaf, look if k % 4 else tinted(look, 1.2)))
    return piece("plant", "rubber", parts)


def split_leaf(rng: Generator, palette: Palette) -> Piece:
    """A Swiss cheese plant: broad leaves with deep notches on long stalks."""
    look = dataclasses.replace(_leaves(rng), shine=0.4)
    reach = uniform(rng, 0.5, 0.75)
    parts, rim, radius = _pot(rng, palette, uniform(rng, 0.14, 0.18))
    count = int(rng.integers(11, 15))
    for k in range(count):
        share, heading = k / count, k * _ANGLE + uniform(rng, -0.2, 0.2)
        start = (0.2 * radius * math.cos(heading), 0.2 * radius * math.sin(heading), rim - 0.02)
        stalk, _ = _bent(start, heading, reach * (0.55 + 0.45 * share), 1.1 + 0.4 * share, 0.7 - 0.3 * share, 6)
        parts.append((tube(stalk, 0.005, segments=5), tinted(look, 1.2)))
        parts.append((_notched(stalk[-1], heading, uniform(rng, 0.24, 0.32)), look if k % 3 else tinted(look, 1.2)))
    return piece("plant", "split_leaf", parts)


def _notched(place: Array, heading: float, size: float) -> Mesh:
    """A heart-shaped leaf with fingers, hanging from its stalk."""
    shape = []
    for k, width in enumerate((0.62, 0.9, 1.0, 0.98, 0.88, 0.7)):
        at = 0.02 + 0.15 * k
        shape += [(at, width), (at + 0.09, width * 0.97), (at + 0.105, width * 0.42), (at + 0.135, width * 0.42)]
    return _leaf(place, heading, -0.35, size, 0.95 * size, 0.75, (*shape[:-2], (1.0, 0.05)), rows=0)


PLANTS: dict[str, Callable[[Generator, Palette], Piece]] = {
    "palm": palm,
    "dragon_tree": dragon_tree,
    "bush": bush,
    "snake": snake_plant,
    "rubber": rubber_plant,
    "split_leaf": split_leaf,
}
"""Makers by style."""


# Leaves ---------------------------------------------------------------------------------------------------------------


def _leaf(
    place: Sequence[float] | Array,
    heading: float,
    rise: float,
    length: float,
    width: float,
    droop: float,
    shape: Sequence[tuple[float, float]],
    *,
    rows: int = 5,
    folds: bool = True,
    stalk: float = 0.0,
    thick: float = 0.0012,
) -> Mesh:
    """A leaf that starts at an angle of `rise` over the level and bends down by `droop` on its way; radians.

    Args:
        shape: (place along the leaf, width there), shares; interpolated to `rows` places, or kept where that is 0.
        folds: the two halves stand up from the middle rib.
        stalk: length of the bare part before it, of no width.
    """
    places = np.array([at for at, _ in shape]) if rows == 0 else np.linspace(0, 1, rows)
    half = np.interp(places, *np.array(shape).T) * width / 2
    line, slopes = _bent(
        place, heading, length + stalk, rise, droop, 0, places=(stalk + places * length) / (length + stalk)
    )
    across = np.array([-1.0, 0.0, 1.0]) if folds else np.array([-1.0, 1.0])
    side = np.array([-math.sin(heading), math.cos(heading), 0.0])
    up = np.column_stack([-np.sin(slopes) * math.cos(heading), -np.sin(slopes) * math.sin(heading), np.cos(slopes)])
    lift = 0.3 * np.abs(across) * folds
    points = line[:, None] + half[:, None, None] * (across[:, None] * side + lift[:, None] * up[:, None])
    mesh = sheet(points, thick_m=thick)
    return dataclasses.replace(mesh, uv=_veined(mesh, across, places * length))


def _veined(mesh: Mesh, across: Array, along: Array) -> NDArray[np.float32]:
    """(V, 2) texture places that give the leaf one middle rib: patterns have four to a tile."""
    u, v = np.meshgrid(0.06 + 0.06 * across, along, indexing="xy")
    one = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
    return np.tile(one, (len(mesh.vertices) // len(one), 1))


def _bent(
    start: Sequence[float] | Array,
    heading: float,
    length: float,
    rise: float,
    droop: float,
    count: int,
    *,
    places: Array | None = None,
) -> tuple[Array, Array]:
    """Points (N, 3) and slopes (N,) of a line that bends down evenly, at `count` places or at shares of its length."""
    fine = np.linspace(0, 1, 41)
    slope = rise - droop * fine
    steps = np.column_stack([np.cos(slope), np.sin(slope)])
    way = np.concatenate([[(0.0, 0.0)], np.cumsum((steps[1:] + steps[:-1]) / 2, axis=0)]) * length / 40
    at = np.linspace(0, 1, count) if places is None else places
    out, up = (np.interp(at, fine, way[:, k]) for k in range(2))
    line = np.column_stack([out * math.cos(heading), out * math.sin(heading), up]) + np.asarray(start)
    return line, rise - droop * at


def _leaves(rng: Generator) -> Look:
    """Leaves in full light."""
    return tinted(foliage(rng), uniform(rng, 1.15, 1.45))


def _direction(k: int, count: int, lowest: float) -> Array:
    """(3,) the k-th of evenly spread directions above a height on the unit sphere."""
    z = lowest + (1 - lowest) * (k + 0.5) / count
    flat = math.sqrt(max(0.0, 1 - z * z))
    return np.array([flat * math.cos(k * _ANGLE), flat * math.sin(k * _ANGLE), z])


# Pots -----------------------------------------------------------------------------------------------------------------


def _pot(rng: Generator, palette: Palette, radius: float) -> tuple[Parts, float, float]:
    """A pot with soil; the height of the soil and the radius there."""
    kind = int(rng.integers(5))
    if kind == 4:
        return _on_stand(rng, palette, radius)
    parts, soil, inner = _vessel(rng, palette, kind, radius)
    return parts, soil, inner


def _vessel(rng: Generator, palette: Palette, kind: int, radius: float) -> tuple[Parts, float, float]:
    """A clay pot with a collar, a straight or a bellied planter, or a basket."""
    tall = radius * uniform(rng, 1.5, 1.9)
    shapes = (
        [(0.68, 0.0), (0.93, 0.76), (0.93, 0.78), (1.0, 0.78), (1.02, 1.0)],
        [(0.92, 0.0), (0.97, 0.03), (1.0, 0.1), (1.0, 1.0)],
        [(0.6, 0.0), (0.85, 0.12), (1.06, 0.38), (1.1, 0.58), (1.02, 0.82), (0.9, 1.0)],
        [(0.82, 0.0), (0.98, 0.15), (1.05, 0.45), (1.0, 0.8), (1.04, 1.0)],
    )
    looks = (terracotta(rng), palette.ceramic, ceramic(rng), wicker(rng))
    outer = np.array(shapes[kind]) * (radius, tall)
    rim = outer[-1, 0]
    profile = np.vstack([[(0.0, 0.0)], outer, [(rim - 0.012, tall), (rim - 0.016, 0.8 * tall)]])
    soil = lathe([(rim - 0.01, 0.86 * tall), (0.5 * rim, 0.885 * tall), (0, 0.89 * tall)], segments=18)
    parts: Parts = [(lathe(profile, segments=24), looks[kind]), (soil, _SOIL)]
    if kind == 0 and chance(rng, 0.6):
        dish = [(0, 0), (0.85, 0), (0.98, 0.13), (0.93, 0.13), (0.8, 0.03), (0, 0.03)]
        parts.append((lathe(np.array(dish) * radius, segments=24), looks[0]))
    return parts, 0.87 * tall, rim - 0.02


def _on_stand(rng: Generator, palette: Palette, radius: float) -> tuple[Parts, float, float]:
    """A straight pot in a wooden stand."""
    parts, soil, inner = _vessel(rng, palette, 1, radius)
    lift, reach = uniform(rng, 0.14, 0.22), radius + 0.014
    parts = [(moved(mesh, (0, 0, lift)), look) for mesh, look in parts]
    for k in range(4):
        angle = math.pi / 4 + k * math.pi / 2
        x, y = reach * math.cos(angle), reach * math.sin(angle)
        parts.append((rod((x, y, 0), (x, y, lift + 0.12), 0.012, segments=8), palette.wood))
    arm = reach * math.sqrt(0.5)
    for a, b in (((-arm, -arm), (arm, arm)), ((-arm, arm), (arm, -arm))):
        parts.append((rod((*a, lift - 0.012), (*b, lift - 0.012), 0.01, segments=6), palette.wood))
    return parts, soil + lift, inner
