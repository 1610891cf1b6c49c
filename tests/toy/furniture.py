"""Furniture made of a few boxes and balls.

A piece stands in its own frame: centre of the footprint at the origin, floor at z = 0, front towards +x, and y to the
left; metres. Sizes and colours vary with the random generator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Colour = tuple[float, float, float]
"""Red, green, blue; 0 to 1."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """What a surface looks like: a pattern of `texture.PATTERNS` between two colours."""

    pattern: str
    colour: Colour
    second: Colour


@dataclass(frozen=True)
class Solid:
    """A box, or the ball inscribed in it; `half_m` along its own axes, turned by `yaw_rad` about the vertical."""

    centre_m: Vector
    half_m: Vector
    material: Material
    yaw_rad: float = 0.0
    ball: bool = False
    object_id: int = 0
    """Object it belongs to; 0 is the room itself (pictures on walls)."""


@dataclass(frozen=True)
class Piece:
    """One piece of furniture in its own frame; `depth_m` along x, `width_m` along y."""

    class_name: str
    depth_m: float
    width_m: float
    solids: tuple[Solid, ...]


_WOODS: tuple[Colour, ...] = ((0.55, 0.36, 0.20), (0.72, 0.54, 0.34), (0.36, 0.22, 0.13), (0.80, 0.70, 0.55))
_FABRICS: tuple[Colour, ...] = ((0.25, 0.36, 0.55), (0.55, 0.22, 0.20), (0.45, 0.48, 0.45), (0.70, 0.58, 0.25))
_POTS: tuple[Colour, ...] = ((0.72, 0.38, 0.24), (0.85, 0.84, 0.80), (0.28, 0.34, 0.42))
_LEAVES: tuple[Colour, ...] = ((0.16, 0.42, 0.14), (0.30, 0.50, 0.18), (0.12, 0.34, 0.20))


def shade(colour: Colour, factor: float) -> Colour:
    """The colour made darker (below 1) or lighter (above 1)."""
    red, green, blue = (min(1.0, channel * factor) for channel in colour)
    return red, green, blue


def pick(rng: np.random.Generator, colours: tuple[Colour, ...]) -> Colour:
    """One of the colours, a little lighter or darker."""
    return shade(colours[int(rng.integers(len(colours)))], float(rng.uniform(0.85, 1.15)))


def wood(rng: np.random.Generator) -> Material:
    """A wood: grain between a colour and its darker shade."""
    colour = pick(rng, _WOODS)
    return Material("wood", colour, shade(colour, 0.65))


def fabric(rng: np.random.Generator) -> Material:
    """A woven cloth."""
    colour = pick(rng, _FABRICS)
    return Material("fabric", colour, shade(colour, 0.7))


def chair(rng: np.random.Generator) -> Piece:
    """Seat, back rest and four legs."""
    depth, width = rng.uniform(0.42, 0.48, 2)
    seat, top, post = 0.45, float(rng.uniform(0.86, 0.98)), 0.02
    frame = wood(rng)
    cover = fabric(rng) if rng.random() < 0.5 else frame
    back_x = -depth / 2 + post
    solids = [_box((0, 0, seat - 0.03), (depth, width, 0.06), cover)]
    solids += _legs(depth, width, seat - 0.06, 2 * post, frame)
    solids += [_box((back_x, y, (seat + top) / 2), (0.04, 0.04, top - seat), frame) for y in _ends(width, 0.04)]
    solids += [_box((back_x, 0, top - 0.14), (0.03, width - 0.06, 0.26), cover)]
    return Piece("chair", depth, width, tuple(solids))


def table(rng: np.random.Generator) -> Piece:
    """A top with an apron on two solid ends, and a bowl on it."""
    depth, width, height = float(rng.uniform(0.75, 0.85)), float(rng.uniform(1.15, 1.35)), 0.74
    material = wood(rng)
    apron = Material("wood", shade(material.colour, 0.85), material.second)
    solids = [_box((0, 0, height - 0.025), (depth, width, 0.05), material)]
    solids += [
        _box((0, y, (height - 0.05) / 2), (depth - 0.1, 0.06, height - 0.05), material) for y in _ends(width, 0.2)
    ]
    solids += [_box((x, 0, height - 0.13), (0.03, width - 0.2, 0.16), apron) for x in _ends(depth, 0.12)]
    bowl = Material("plain", pick(rng, _POTS), (0.2, 0.2, 0.2))
    return Piece(
        "table", depth, width, (*solids, _box((0, float(rng.uniform(-0.3, 0.3)), height + 0.05), (0.2, 0.2, 0.1), bowl))
    )


def sofa(rng: np.random.Generator) -> Piece:
    """Base, back, arms, two cushions and a pillow."""
    depth, width = float(rng.uniform(0.78, 0.88)), float(rng.uniform(1.5, 1.9))
    cover = fabric(rng)
    cushion = Material("fabric", shade(cover.colour, 1.2), cover.colour)
    inner = width - 0.36
    solids = [_box((0, 0, 0.16), (depth, width, 0.24), cover)]
    solids += [_box((-depth / 2 + 0.1, 0, 0.55), (0.2, inner, 0.54), cover)]
    solids += [_box((0, y, 0.4), (depth, 0.18, 0.28), cover) for y in _ends(width, 0.18)]
    solids += [_box((0.08, y, 0.35), (depth - 0.2, inner / 2 - 0.02, 0.14), cushion) for y in _ends(inner, inner / 2)]
    pillow = fabric(rng)
    solids += [_box((-depth / 2 + 0.27, inner / 2 - 0.22, 0.57), (0.12, 0.36, 0.3), pillow)]
    return Piece("sofa", depth, width, tuple(solids))


def shelf(rng: np.random.Generator) -> Piece:
    """An open bookcase: sides, back, boards, and rows of books of different length."""
    depth, width, levels = 0.32, float(rng.uniform(0.8, 1.1)), int(rng.integers(4, 6))
    material, height = wood(rng), 0.34 * levels + 0.03
    panel = Material("wood", shade(material.colour, 0.6), shade(material.colour, 0.45))
    solids = [_box((-depth / 2 + 0.01, 0, height / 2), (0.02, width, height), panel)]
    solids += [_box((0, y, height / 2), (depth, 0.03, height), material) for y in _ends(width, 0.03)]
    solids += [_box((0, 0, 0.015 + 0.34 * level), (depth, width - 0.06, 0.03), material) for level in range(levels + 1)]
    books = Material("books", (0.8, 0.3, 0.2), (0.2, 0.3, 0.7))
    for level in range(levels):
        row, tall = (width - 0.08) * float(rng.uniform(0.45, 1.0)), float(rng.uniform(0.20, 0.27))
        left = float(rng.choice([-1.0, 1.0])) * (width - 0.08 - row) / 2
        solids.append(_box((-0.02, left, 0.03 + 0.34 * level + tall / 2), (0.22, row, tall), books))
    return Piece("shelf", depth, width, tuple(solids))


def plant(rng: np.random.Generator) -> Piece:
    """A pot, a stem and a crown of leafy balls."""
    pot, tall, crown = float(rng.uniform(0.28, 0.34)), float(rng.uniform(0.75, 1.05)), float(rng.uniform(0.26, 0.32))
    clay = pick(rng, _POTS)
    green = pick(rng, _LEAVES)
    leaves = Material("leaves", green, shade(green, 1.9))
    solids = [_box((0, 0, 0.15), (pot, pot, 0.30), Material("plain", clay, shade(clay, 0.8)))]
    solids += [_box((0, 0, tall / 2), (0.04, 0.04, tall), Material("wood", (0.35, 0.25, 0.15), (0.25, 0.18, 0.1)))]
    for turn in np.arange(4) * (np.pi / 2) + rng.uniform(0, np.pi / 2):
        x, y = 0.12 * np.cos(turn), 0.12 * np.sin(turn)
        z, half = tall + float(rng.uniform(-0.2, 0.15)), crown * float(rng.uniform(0.55, 0.75))
        solids.append(Solid((float(x), float(y), z), (half, half, half * 1.2), leaves, ball=True))
    side = 2 * (0.12 + 0.75 * crown)
    return Piece("plant", side, side, tuple(solids))


def tv(rng: np.random.Generator) -> Piece:
    """A flat screen on a low cabinet with two doors."""
    depth, width, height = 0.40, float(rng.uniform(1.1, 1.4)), float(rng.uniform(0.40, 0.50))
    body = wood(rng)
    door = Material("plain", shade(body.colour, 1.25), body.colour)
    screen = float(rng.uniform(0.9, 1.1))
    dark, picture = (0.04, 0.04, 0.05), pick(rng, ((0.12, 0.22, 0.42), (0.05, 0.07, 0.10), (0.15, 0.35, 0.30)))
    black = Material("plain", dark, dark)
    glass = Material("screen", picture, shade(picture, 2.2))
    tall, middle = 0.58 * screen, height + 0.07 + 0.29 * screen
    solids = [_box((0, 0, height / 2), (depth, width, height), body)]
    for y in _ends(width, width / 2):
        solids += [_box((depth / 2, y, height / 2), (0.02, width / 2 - 0.06, height - 0.1), door)]
    solids += [_box((0, 0, height + 0.03), (0.2, 0.4, 0.06), black)]
    solids += [_box((0, 0, middle), (0.05, screen, tall), black)]
    solids += [_box((0.025, 0, middle), (0.02, screen - 0.06, tall - 0.06), glass)]
    return Piece("tv", depth, width, tuple(solids))


PIECES: dict[str, Callable[[np.random.Generator], Piece]] = {
    "chair": chair,
    "table": table,
    "sofa": sofa,
    "shelf": shelf,
    "plant": plant,
    "tv": tv,
}
"""Builders by class name; the order is the order of class ids."""


def _box(centre: Vector, size: Vector, material: Material) -> Solid:
    return Solid(_floats(centre), _floats((size[0] / 2, size[1] / 2, size[2] / 2)), material)


def _floats(values: Vector) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def _ends(length: float, part: float) -> tuple[float, float]:
    """Centres of two parts of length `part` that touch the two ends of `length`."""
    return -(length - part) / 2, (length - part) / 2


def _legs(depth: float, width: float, height: float, thick: float, material: Material) -> list[Solid]:
    corners = [(x, y) for x in _ends(depth, thick) for y in _ends(width, thick)]
    return [_box((x, y, height / 2), (thick, thick, height), material) for x, y in corners]
