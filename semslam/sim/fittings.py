"""What comes with a group of furniture but is part of the building: counters, washstands, screen walls, rugs."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from semslam.sim.clutter import Parts, stood
from semslam.sim.groups import Extra
from semslam.sim.home import Array, Colour, Fixture, Look, Mesh, Part
from semslam.sim.palettes import Palette, mixed
from semslam.sim.shapes import box, lathe, merge, moved, picture_plane, rod, transformed
from semslam.sim.shell import Side

_STEEL = Look("metal", ((0.68, 0.69, 0.70),), 0.5, shine=0.7)
_WHITE = Look("paint", ((0.92, 0.92, 0.91),), 1.0, shine=0.4)


def fitted(extra: Extra, palette: Palette, seed: int, index: int, side: Side | None, wall: Look) -> list[Fixture]:
    """An extra of a group as fixtures: rug, mat, kitchen counter, washstand, screen wall.

    Args:
        side: the wall it stands at, for what hangs above it; None if it is free or there is a window.
        wall: look of the walls, for the screen.
    """
    rng = np.random.default_rng([seed, 0xF17, index])
    parts: Parts
    if extra.kind in ("rug", "mat"):
        parts = _carpet(extra, palette, rng)
    elif extra.kind == "counter":
        parts = _counter(extra, palette, rng, cabinets=side is not None)
    elif extra.kind == "washstand":
        parts = _washstand(extra, palette, mirror=side is not None)
    else:
        half = extra.depth_m / 2, extra.width_m / 2
        cap = box((-half[0], -half[1] - 0.01, extra.height_m), (half[0], half[1] + 0.01, extra.height_m + 0.02))
        parts = [(box((-half[0], -half[1], 0), (*half, extra.height_m)), wall), (cap, Look("wood", palette.wood, 0.6))]
    placed = stood(parts, (extra.x_m, extra.y_m, 0.0), extra.yaw_rad)
    kind = "rug" if not extra.solid else "wall" if extra.kind == "screen" else "counter"
    return [Fixture(kind, placed, extra.outline if extra.solid else None)]


def _carpet(extra: Extra, palette: Palette, rng: np.random.Generator) -> Parts:
    """A flat rug that its pattern covers once."""
    half = np.array([extra.depth_m, extra.width_m]) / 2
    slab = box((-half[0], -half[1], 0.0005), (half[0], half[1], extra.height_m))
    uv = (slab.vertices[:, :2] + half) / (2 * half)
    order = rng.permutation(4)
    colours = tuple(palette.bright[int(k)] for k in order)
    pattern = ("rug", "rug", "stripes", "plaid", "carpet")[int(rng.integers(5))] if extra.kind == "rug" else "carpet"
    if pattern == "carpet":
        colours = (palette.cloth[1], palette.cloth[0])
    look = Look(pattern, colours, 1.0 if pattern == "rug" else 0.5, seed=int(rng.integers(50)))
    return [(replace(slab, uv=uv.astype(np.float32)) if pattern == "rug" else slab, look)]


def _counter(extra: Extra, palette: Palette, rng: np.random.Generator, *, cabinets: bool) -> Parts:
    """Base units with a worktop and a sink, tiles behind, wall units above."""
    deep, wide, high = extra.depth_m, extra.width_m, extra.height_m
    back, front = -deep / 2, deep / 2
    units = max(2, round(wide / 0.55))
    edges = np.linspace(-wide / 2, wide / 2, units + 1)
    body = [box((back, -wide / 2, 0.1), (front - 0.045, wide / 2, high - 0.04))]
    kick = box((back, -wide / 2, 0.0), (front - 0.09, wide / 2, 0.1))
    doors = [box((front - 0.045, a + 0.004, 0.11), (front - 0.025, b - 0.004, high - 0.05)) for a, b in _runs(edges)]
    knobs = [
        box((front - 0.025, a + 0.1, high - 0.12), (front - 0.005, b - 0.1, high - 0.105)) for a, b in _runs(edges)
    ]
    if cabinets:
        shelf = back + 0.34
        body.append(box((back, -wide / 2, 1.48), (shelf - 0.02, wide / 2, 2.12)))
        doors += [box((shelf - 0.02, a + 0.004, 1.485), (shelf, b - 0.004, 2.115)) for a, b in _runs(edges)]
    fronts: Colour = ((0.90, 0.89, 0.86), palette.accent_wall, mixed(palette.wood[0], (1, 1, 1), 0.1))[
        int(rng.integers(3))
    ]
    top = Look(
        "marble", ((0.30, 0.29, 0.28), (0.42, 0.41, 0.40)) if max(fronts) > 0.6 else palette.wood, 1.0, shine=0.4
    )
    splash = Look("tiles", ((0.88, 0.89, 0.88), palette.tile[1]), 0.6, shine=0.3)
    y = float(rng.uniform(-0.2, 0.2)) * wide
    return [
        (merge(body), Look("paint", (mixed(fronts, (0, 0, 0), 0.15),), 1.0)),
        (merge(doors), Look("paint", (fronts,), 1.0, shine=0.25)),
        (merge([*knobs, _tap(back + 0.1, y, high)]), _STEEL),
        (box((back, -wide / 2, high - 0.04), (front, wide / 2, high)), top),
        (box((back, -wide / 2, high), (back + 0.012, wide / 2, high + (0.58 if cabinets else 0.10))), splash),
        (
            box((back + 0.14, y - 0.22, high), (front - 0.1, y + 0.22, high + 0.004)),
            Look("metal", ((0.45, 0.46, 0.47),), 0.5),
        ),
        (kick, Look("plain", ((0.16, 0.16, 0.16),))),
    ]


def _runs(edges: Array) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in pairwise(edges)]


def _tap(x: float, y: float, z: float) -> Mesh:
    return merge(
        [rod((x, y, z), (x, y, z + 0.2), 0.012), rod((x - 0.01, y, z + 0.195), (x + 0.16, y, z + 0.17), 0.010)]
    )


def _washstand(extra: Extra, palette: Palette, *, mirror: bool) -> Parts:
    """A basin on a cupboard, a mirror above it."""
    a, b, high = extra.depth_m / 2, extra.width_m / 2, extra.height_m
    basin = lathe(np.array([[0, 0], [0.11, 0], [0.19, 0.10], [0.20, 0.13], [0.185, 0.13], [0.10, 0.03], [0, 0.03]]))
    parts: Parts = [
        (box((-a + 0.01, -b, 0.12), (a - 0.03, b, high - 0.13)), Look("paint", (palette.accent_wall,), 1.0, shine=0.2)),
        (box((-a + 0.01, -b, high - 0.13), (a, b, high - 0.09)), Look("wood", palette.wood, 0.6)),
        (box((-a + 0.05, -b + 0.04, 0.0), (a - 0.08, b - 0.04, 0.12)), Look("plain", ((0.16, 0.16, 0.16),))),
        (moved(basin, (0.02, 0.0, high - 0.09)), _WHITE),
        (_tap(-a + 0.05, 0.0, high - 0.09), _STEEL),
    ]
    if mirror:
        glass = moved(picture_plane(0.5, 0.7), (-a + 0.021, 0.0, 1.5))
        frame = box((-a - 0.005, -0.28, 1.12), (-a + 0.02, 0.28, 1.88))
        parts += [
            (glass, Look("metal", ((0.80, 0.84, 0.86),), 1.0, shine=0.8)),
            (frame, Look("wood", palette.wood, 0.5)),
        ]
    return parts


def half_turned(fixture: Fixture) -> Fixture:
    """The fixture half a turn about the origin."""
    parts = tuple(Part(transformed(part.mesh, (0.0, 0.0, 0.0), math.pi), part.look) for part in fixture.parts)
    return replace(fixture, parts=parts, footprint=None if fixture.footprint is None else -fixture.footprint)
