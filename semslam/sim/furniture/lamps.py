"""Floor lamps: a shade on a pole, an arc, a tripod, a globe, a reading lamp. Shades give off a little light."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import Palette, chance, pick, piece, uniform
from semslam.sim.furniture.forms import curve
from semslam.sim.furniture.solids import shell
from semslam.sim.home import Colour, Look, Mesh, Piece
from semslam.sim.shapes import about_y, about_z, ball, lathe, moved, posed, rod, tube

Parts = list[tuple[Mesh, Look]]

_BULB = Look("plain", ((1.0, 0.96, 0.86),), glow=0.9)
_SHADES: tuple[Colour, ...] = (
    (0.93, 0.90, 0.83),
    (0.95, 0.94, 0.91),
    (0.86, 0.78, 0.64),
    (0.62, 0.60, 0.57),
    (0.72, 0.48, 0.30),
    (0.34, 0.42, 0.46),
)


def drum(rng: Generator, palette: Palette) -> Piece:
    """A drum or cone of cloth on a straight pole."""
    height, tall = uniform(rng, 1.4, 1.7), uniform(rng, 0.24, 0.34)
    wide = uniform(rng, 0.17, 0.24)
    parts = _base(rng, palette) + [(rod((0, 0, 0.02), (0, 0, height - 0.3 * tall), 0.011), palette.metal)]
    parts += _shade(rng, (0.0, 0.0, height - tall), wide, wide * uniform(rng, 0.45, 1.0), tall)
    return piece("lamp", "drum", parts)


def turned(rng: Generator, palette: Palette) -> Piece:
    """A turned wooden or ceramic column under a wide cone."""
    height, tall, wide = uniform(rng, 1.35, 1.6), uniform(rng, 0.26, 0.32), uniform(rng, 0.22, 0.27)
    stem = height - tall
    profile = [(0.0, 0.0), (0.15, 0.0), (0.15, 0.02), (0.05, 0.05), (0.025, 0.1), (0.03, 0.3 * stem)]
    profile += [(0.05, 0.36 * stem), (0.032, 0.42 * stem), (0.024, 0.6 * stem), (0.034, 0.82 * stem)]
    profile += [(0.045, 0.86 * stem), (0.02, 0.92 * stem), (0.012, height - 0.4 * tall), (0.0, height - 0.4 * tall)]
    parts: Parts = [(lathe(profile, segments=20), pick(rng, (palette.wood, palette.ceramic, palette.wood)))]
    parts += _shade(rng, (0.0, 0.0, height - tall), wide, wide * 0.55, tall)
    return piece("lamp", "turned", parts)


def tripod(rng: Generator, palette: Palette) -> Piece:
    """Three wooden legs under a drum."""
    height, tall, wide = uniform(rng, 1.35, 1.6), uniform(rng, 0.26, 0.34), uniform(rng, 0.2, 0.25)
    spread, hub, turn = uniform(rng, 0.24, 0.3), height - tall - 0.06, uniform(rng, 0.0, 2.0)
    parts: Parts = []
    for k in range(3):
        angle = turn + 2 * math.pi * k / 3
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        foot, neck = way * spread + (0, 0, 0.008), way * 0.02 + (0, 0, hub)
        parts.append((tube([foot * (1, 1, 0), foot, neck], (0.009, 0.0105, 0.017), segments=10), palette.wood))
    parts.append((lathe([(0, 0), (0.045, 0), (0.045, 0.04), (0.012, 0.06), (0.012, 0.2), (0, 0.2)]), palette.metal))
    parts[-1] = (moved(parts[-1][0], (0, 0, hub - 0.02)), palette.metal)
    parts += _shade(rng, (0.0, 0.0, height - tall), wide, wide * uniform(rng, 0.8, 1.0), tall)
    return piece("lamp", "tripod", parts)


def arc(rng: Generator, palette: Palette) -> Piece:
    """A heavy foot, a long arched pole, a bowl that hangs from its end."""
    height, reach = uniform(rng, 1.6, 1.8), uniform(rng, 0.7, 0.95)
    hang, dome = height - 0.32, uniform(rng, 0.15, 0.19)
    points = [(0, 0, 0.04), (0, 0, 0.7), (0.02, 0, 1.15), (0.28 * reach, 0, height - 0.05)]
    points += [(0.68 * reach, 0, height - 0.03), (reach, 0, hang)]
    line = curve(points, 22)
    line[:, 2] = np.minimum(line[:, 2], height - 0.012)
    parts: Parts = [(tube(line, 0.011, segments=8), palette.metal)]
    foot = [(0.0, 0.0), (0.155, 0.0), (0.16, 0.005), (0.16, 0.045), (0.155, 0.05), (0.0, 0.05)]
    parts.append((lathe(foot, segments=28), pick(rng, (palette.metal, _MARBLE, palette.metal))))
    angles = np.linspace(0.12, 1.5, 7)
    bowl = np.column_stack([np.sin(angles), np.cos(angles) * 0.8])[::-1] * dome
    parts.append((moved(shell(bowl, 0.004, segments=22), (reach, 0, hang - 0.8 * dome)), palette.metal))
    parts.append((ball((reach, 0, hang - 0.75 * dome), 0.055, segments=12), _BULB))
    return piece("lamp", "arc", parts)


def globe(rng: Generator, palette: Palette) -> Piece:
    """One to three balls of opal glass on a pole."""
    height, radius = uniform(rng, 1.4, 1.7), uniform(rng, 0.11, 0.16)
    glass = Look("plain", ((0.97, 0.95, 0.90),), shine=0.4, glow=uniform(rng, 0.35, 0.55))
    parts = _base(rng, palette)
    if chance(rng, 0.5):
        parts.append((rod((0, 0, 0.02), (0, 0, height - 2 * radius), 0.011), palette.metal))
        parts.append((ball((0, 0, height - radius), radius, segments=20), glass))
        return piece("lamp", "globe", parts)
    small = 0.65 * radius
    parts.append((rod((0, 0, 0.02), (0, 0, height - 2 * small), 0.011), palette.metal))
    parts.append((ball((0, 0, height - small), small), glass))
    for k, z in enumerate((height - 0.3, height - 0.52)):
        end = posed(ball((small + 0.09, 0, 0), small), about_z(0.6 + math.pi * k), (0, 0, z))
        arm = posed(rod((0, 0, 0), (0.12, 0, 0), 0.008, segments=8), about_z(0.6 + math.pi * k), (0, 0, z))
        parts += [(end, glass), (arm, palette.metal)]
    return piece("lamp", "globe", parts)


def reading(rng: Generator, palette: Palette) -> Piece:
    """A pole with a jointed arm and a metal cone that looks down."""
    height, reach = uniform(rng, 1.35, 1.6), uniform(rng, 0.3, 0.42)
    elbow, end = (0.0, 0.0, height - 0.05), (reach, 0.0, height - 0.1)
    parts = _base(rng, palette) + [(rod((0, 0, 0.02), elbow, 0.011), palette.metal)]
    parts.append((rod((-0.12, 0, height - 0.03), end, 0.009, segments=8), palette.metal))
    parts.append((ball(elbow, 0.022, segments=10), palette.metal))
    size = uniform(rng, 0.10, 0.13)
    profile = np.array([(1.0, -1.35), (0.95, -1.1), (0.45, -0.25), (0.3, 0.0), (0.28, 0.35)]) * size
    tilt = about_y(-0.35)
    place = np.add(end, (0.0, 0.0, -0.2 * size))
    parts.append((posed(shell(profile, 0.004, segments=20), tilt, place), _enamel(rng, palette)))
    parts.append((posed(ball((0, 0, 0.35 * size), 0.28 * size, segments=10), tilt, place), palette.metal))
    parts.append((posed(ball((0, 0, -0.75 * size), 0.45 * size, segments=10), tilt, place), _BULB))
    return piece("lamp", "reading", parts)


LAMPS: dict[str, Callable[[Generator, Palette], Piece]] = {
    "drum": drum,
    "turned": turned,
    "tripod": tripod,
    "arc": arc,
    "globe": globe,
    "reading": reading,
}
"""Makers by style."""

_MARBLE = Look("marble", ((0.90, 0.89, 0.87), (0.62, 0.61, 0.60)), tile_m=0.5, shine=0.5)


def _base(rng: Generator, palette: Palette) -> Parts:
    """A round foot: a disc or a dome."""
    radius, rise = uniform(rng, 0.12, 0.16), uniform(rng, 0.02, 0.05)
    profile = [(0.0, 0.0), (radius, 0.0), (radius, 0.012), (0.85 * radius, 0.016), (0.3 * radius, rise), (0, rise)]
    return [(lathe(profile, segments=28), palette.metal)]


def _shade(rng: Generator, place: tuple[float, float, float], low: float, high: float, tall: float) -> Parts:
    """A shade of cloth, open above and below, with rims and a bulb in it: radii below and above."""
    colour = pick(rng, _SHADES)
    look = Look("fabric", (colour, _warm(colour)), tile_m=0.3, glow=uniform(rng, 0.25, 0.4))
    rim = dataclasses.replace(look, pattern="plain", colours=(_warm(colour),), glow=0.15)
    cloth = shell([(low, 0.0), ((low + high) / 2, tall / 2), (high, tall)], 0.004, segments=30)
    rims = [_hoop(low, 0.0), _hoop(high, tall - 0.008)]
    bulb = ball((0, 0, 0.45 * tall), 0.04, segments=12)
    return [(moved(cloth, place), look), *((moved(hoop, place), rim) for hoop in rims), (moved(bulb, place), _BULB)]


def _hoop(radius: float, z: float) -> Mesh:
    return shell([(radius + 0.0015, z), (radius + 0.0015, z + 0.008)], 0.007, segments=30)


def _warm(colour: Colour) -> Colour:
    red, green, blue = colour
    return 0.9 * red, 0.86 * green, 0.8 * blue


def _enamel(rng: Generator, palette: Palette) -> Look:
    colour = pick(rng, ((0.14, 0.14, 0.15), (0.92, 0.91, 0.88), (0.30, 0.38, 0.34), (0.72, 0.36, 0.22)))
    return pick(rng, (palette.metal, Look("plain", (colour,), shine=0.5)))
