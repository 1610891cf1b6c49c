"""What stands in shelves: books upright, leaning and lying, ornaments, boxes and baskets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import (
    DARK,
    Palette,
    ceramic,
    chance,
    fabric,
    linen,
    pick,
    plastic,
    uniform,
    wicker,
)
from semslam.sim.furniture.solids import block, brick
from semslam.sim.home import Colour, Look, Mesh
from semslam.sim.shapes import about_x, ball, lathe, moved, picture_plane, posed

Parts = list[tuple[Mesh, Look]]

BOOKS: tuple[Colour, ...] = (
    (0.55, 0.16, 0.14),
    (0.70, 0.30, 0.18),
    (0.80, 0.56, 0.22),
    (0.88, 0.83, 0.70),
    (0.93, 0.92, 0.89),
    (0.22, 0.33, 0.22),
    (0.42, 0.52, 0.38),
    (0.13, 0.20, 0.34),
    (0.24, 0.40, 0.56),
    (0.56, 0.66, 0.72),
    (0.12, 0.12, 0.13),
    (0.36, 0.25, 0.18),
    (0.46, 0.22, 0.30),
)
"""Colours of spines."""
_LETTERING = plastic((0.90, 0.86, 0.72), shine=0.1)


@dataclass(frozen=True)
class Bay:
    """A compartment of a shelf, open towards +x."""

    front: float
    """x of the front edge of its floor."""
    deep: float
    low: float
    high: float
    """y of its sides."""
    floor: float
    clear: float
    """Height of the room above its floor."""

    @property
    def width(self) -> float:
        return self.high - self.low

    def beyond(self, y: float) -> Bay:
        """What is left of it beyond a place along y."""
        return replace(self, low=y)


@dataclass(frozen=True)
class Stock:
    """What one household puts on its shelves."""

    spines: tuple[Look, ...]
    basket: Look
    pot: Look

    @staticmethod
    def draw(rng: Generator, palette: Palette) -> Stock:
        """Seven colours of books, one kind of box, one glaze."""
        chosen = rng.permutation(len(BOOKS))[:7]
        basket = pick(rng, (wicker(rng), fabric(rng), linen(rng), palette.accent))
        return Stock(tuple(plastic(BOOKS[i], shine=0.15) for i in chosen), basket, ceramic(rng))


def filled(rng: Generator, bay: Bay, stock: Stock) -> Parts:
    """Books and things in a compartment, from left to right."""
    kind = rng.random()
    if kind < 0.5:
        return _books(rng, bay, stock, uniform(rng, 0.8, 1.0))
    if kind < 0.78:
        row = _books(rng, bay, stock, uniform(rng, 0.4, 0.62))
        return row + _ornament(rng, bay.beyond(bay.low + 0.72 * bay.width), stock)
    heap = pile(rng, replace(bay, high=bay.low + 0.3), stock)
    rest = bay.beyond(bay.low + 0.34)
    return heap + (_books(rng, rest, stock, 0.9) if rest.width > 0.15 else [])


def _books(rng: Generator, bay: Bay, stock: Stock, share: float) -> Parts:
    """Upright books over a share of the width, some in series; the last one may lean."""
    parts: Parts = []
    place, end, run = bay.low, bay.low + share * bay.width, 0
    tall = wide = deep = 0.0
    look = stock.spines[0]
    while True:
        if run <= 0:
            run = int(rng.integers(3, 7)) if chance(rng, 0.3) else 1
            look = pick(rng, stock.spines)
            tall, wide = min(uniform(rng, 0.19, 0.30), 0.94 * bay.clear), uniform(rng, 0.018, 0.046)
            deep = min(uniform(rng, 0.14, 0.2), bay.deep)
        run -= 1
        if place + wide > end:
            break
        front = bay.front - uniform(rng, 0.012, 0.03)
        parts += _book(rng, (front, place, bay.floor), (deep, wide - 0.0015, tall), look)
        place += wide
    if share < 0.98 and place + 0.1 < bay.high and chance(rng, 0.6):
        parts.append((_tilted(place, bay, 0.03, min(0.22, 0.85 * bay.clear)), pick(rng, stock.spines)))
    return parts


def _book(
    rng: Generator, corner: tuple[float, float, float], size: tuple[float, float, float], look: Look
) -> list[tuple[Mesh, Look]]:
    """A book whose spine's foot is at `corner`, going back, left and up; half of them are lettered."""
    (x, y, z), (deep, wide, tall) = corner, size
    parts: Parts = [(brick((x - deep, y, z), (x, y + wide, z + tall)), look)]
    if chance(rng, 0.5):
        label = moved(picture_plane(wide * 0.72, tall * 0.12), (x + 0.0008, y + wide / 2, z + tall * 0.72))
        parts.append((label, _LETTERING))
    return parts


def _tilted(place: float, bay: Bay, wide: float, tall: float) -> Mesh:
    """A book that leans on the row to its left."""
    angle = 0.22
    book = brick((-0.16, 0.0, 0.0), (0.0, wide, tall))
    across = tall * math.sin(angle)
    return posed(book, about_x(angle), (bay.front - 0.02, place + across + 0.001, bay.floor))


def pile(rng: Generator, bay: Bay, stock: Stock) -> Parts:
    """Books lying on each other, with a bowl on top if there is room."""
    parts: Parts = []
    level, middle = bay.floor, (bay.low + bay.high) / 2
    for _ in range(int(rng.integers(3, 6))):
        thick, half = uniform(rng, 0.022, 0.045), uniform(rng, 0.1, 0.135)
        front = bay.front - uniform(rng, 0.015, 0.04)
        deep = min(0.18, bay.deep)
        book = brick((front - deep, middle - half, level), (front, middle + half, level + thick))
        parts.append((book, pick(rng, stock.spines)))
        level += thick
    if bay.clear - (level - bay.floor) > 0.12:
        bowl = lathe([(0, 0), (0.03, 0), (0.055, 0.03), (0.065, 0.055), (0.058, 0.055), (0, 0.03)], segments=14)
        parts.append((moved(bowl, (bay.front - 0.11, middle, level)), stock.pot))
    return parts


def _ornament(rng: Generator, bay: Bay, stock: Stock) -> Parts:
    """A vase, a picture frame, or a ball on a foot in the middle of a compartment."""
    x, y, kind = bay.front - min(0.11, bay.deep / 2), (bay.low + bay.high) / 2, int(rng.integers(3))
    size = min(0.075, bay.width / 2 - 0.005, bay.clear / 3)
    if kind == 0:
        profile = np.array([(0, 0), (0.55, 0), (0.95, 0.7), (0.9, 1.3), (0.4, 2.0), (0.45, 2.5), (0.35, 2.5), (0, 2.0)])
        return [(moved(lathe(profile * size, segments=16), (x, y, bay.floor)), stock.pot)]
    if kind == 1:
        high, wide = min(0.2, 0.8 * bay.clear), 2 * size
        frame = brick((x - 0.01, y - wide / 2, bay.floor), (x + 0.01, y + wide / 2, bay.floor + high))
        inner = moved(picture_plane(wide * 0.76, high * 0.8), (x + 0.0108, y, bay.floor + high / 2))
        colours = tuple(look.colours[0] for look in stock.spines[:3])
        return [(frame, DARK), (inner, Look("painting", colours, seed=int(rng.integers(4))))]
    foot = lathe([(0, 0), (0.6 * size, 0), (0.6 * size, 0.012), (0, 0.012)], segments=12)
    globe = ball((x, y, bay.floor + 0.01 + size), size, segments=12)
    return [(moved(foot, (x, y, bay.floor)), DARK), (globe, stock.pot)]


def boxed(rng: Generator, bay: Bay, stock: Stock) -> Parts:
    """A storage box or basket that fills a compartment, with a grip."""
    front, gap, tall = bay.front - 0.012, 0.006, bay.clear * uniform(rng, 0.78, 0.95)
    low, high, z = bay.low + gap, bay.high - gap, bay.floor
    grip = moved(picture_plane(0.09, 0.028), (front + 0.0008, (low + high) / 2, z + 0.78 * tall))
    return [
        (block((front - bay.deep + 0.02, low, z), (front, high, z + tall), 0.01), stock.basket),
        (grip, DARK),
    ]


def lying(rng: Generator, bay: Bay, stock: Stock) -> Parts:
    """A few flat books or boxes side by side in a low compartment."""
    parts: Parts = []
    for middle in (bay.low + 0.25 * bay.width, bay.low + 0.75 * bay.width):
        level = bay.floor
        for _ in range(int(rng.integers(1, 4))):
            thick, half = uniform(rng, 0.018, 0.03), uniform(rng, 0.07, 0.22 * bay.width)
            if level + thick > bay.floor + bay.clear - 0.01:
                break
            low, high = (bay.front - 0.17, middle - half, level), (bay.front, middle + half, level + thick)
            parts.append((brick(low, high), pick(rng, stock.spines)))
            level += thick
    return parts
