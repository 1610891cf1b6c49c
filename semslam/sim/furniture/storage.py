"""Bookshelves with what stands on them, and dressers: chests of drawers, sideboards, benches for a tv, cabinets."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import (
    BLACK_STEEL,
    DARK,
    Palette,
    chance,
    pick,
    piece,
    tinted,
    uniform,
)
from semslam.sim.furniture.forms import leg
from semslam.sim.furniture.solids import block, brick, knob
from semslam.sim.furniture.stock import Bay, Parts, Stock, boxed, filled, lying, pile
from semslam.sim.home import Look, Mesh, Piece, Top
from semslam.sim.shapes import box, moved, rod, tube

BOARD_M = 0.022


# Bookshelves ----------------------------------------------------------------------------------------------------------


def bookcase(rng: Generator, palette: Palette) -> Piece:
    """A tall case with a back, on a plinth."""
    return _case(rng, palette, "bookcase", 1, uniform(rng, 0.7, 1.0), uniform(rng, 1.6, 2.1))


def low_bookcase(rng: Generator, palette: Palette) -> Piece:
    """A broad case of two bays, hip high."""
    return _case(rng, palette, "low", 2, uniform(rng, 1.1, 1.6), uniform(rng, 0.8, 1.1))


def _case(rng: Generator, palette: Palette, style: str, bays: int, width: float, height: float) -> Piece:
    deep, plinth, t = uniform(rng, 0.26, 0.32), uniform(rng, 0.05, 0.08), BOARD_M
    x, y = deep / 2, width / 2
    parts: Parts = [
        (block((-x, -y, 0), (x, -y + t, height)), palette.body),
        (block((-x, y - t, 0), (x, y, height)), palette.body),
        (block((-x, -y - 0.008, height), (x + 0.012, y + 0.008, height + t), 0.005), palette.body),
        (block((-x, -y + t, 0), (x - 0.03, y - t, plinth)), palette.body),
        (brick((-x, -y + t, plinth), (-x + 0.008, y - t, height)), tinted(palette.body, 0.82)),
    ]
    stock = Stock.draw(rng, palette)
    edges = np.linspace(-y + t, y - t, bays + 1)
    levels = np.linspace(plinth, height, round((height - plinth) / uniform(rng, 0.3, 0.37)) + 1)
    for column in range(bays):
        low, high = edges[column] + (t / 2 if column else 0), edges[column + 1] - (t / 2 if column + 1 < bays else 0)
        if column:
            parts.append((block((-x, low - t, plinth), (x - 0.002, low, height)), palette.body))
        for floor, above in itertools.pairwise(levels):
            parts.append((block((-x, low, floor), (x - 0.004, high, floor + t)), palette.body))
            bay = Bay(x - 0.004, deep - 0.02, low + 0.004, high - 0.004, floor + t, above - floor - t)
            parts += filled(rng, bay, stock)
    top = Top(height + t, (-x + 0.02, -y + 0.02), (x - 0.02, y - 0.02))
    return piece("bookshelf", style, parts, tops=[top])


def cubes(rng: Generator, palette: Palette) -> Piece:
    """A grid of square compartments, thick-walled, open at the back, with books, boxes and baskets."""
    columns, rows = pick(rng, ((2, 4), (3, 3), (4, 2), (2, 3), (3, 4), (4, 4)))
    cell, wall, t, deep = uniform(rng, 0.33, 0.36), 0.04, 0.018, uniform(rng, 0.34, 0.39)
    width, height, x = columns * (cell + t) - t + 2 * wall, rows * (cell + t) - t + 2 * wall, deep / 2
    y, look = width / 2, palette.body
    parts: Parts = [
        (block((-x, -y, 0), (x, -y + wall, height)), look),
        (block((-x, y - wall, 0), (x, y, height)), look),
        (block((-x, -y + wall, 0), (x, y - wall, wall)), look),
        (block((-x, -y + wall, height - wall), (x, y - wall, height)), look),
    ]
    stock = Stock.draw(rng, palette)
    for row in range(rows):
        floor = wall + row * (cell + t)
        if row:
            parts.append((block((-x, -y + wall, floor - t), (x - 0.003, y - wall, floor)), look))
        for column in range(columns):
            left = -y + wall + column * (cell + t)
            if column:
                parts.append((block((-x, left - t, floor), (x - 0.003, left, floor + cell)), look))
            bay = Bay(x - 0.003, deep - 0.02, left + 0.005, left + cell - 0.005, floor, cell)
            parts += boxed(rng, bay, stock) if chance(rng, 0.35) else filled(rng, bay, stock)
    return piece("bookshelf", "cubes", parts, tops=[Top(height, (-x + 0.02, -y + 0.02), (x - 0.02, y - 0.02))])


def ladder(rng: Generator, palette: Palette) -> Piece:
    """Shelves between two rails that lean back, deeper towards the floor."""
    width, height, foot = uniform(rng, 0.6, 0.85), uniform(rng, 1.65, 1.95), uniform(rng, 0.38, 0.46)
    y, frame = width / 2, pick(rng, (palette.wood, palette.wood, BLACK_STEEL))
    parts: Parts = []
    for side in (-y + 0.015, y - 0.015):
        parts.append((_leaning(foot, side, height), frame))
        parts.append((block((0, side - 0.014, 0), (0.03, side + 0.014, height * 0.93)), frame))
    stock, count = Stock.draw(rng, palette), int(rng.integers(4, 6))
    levels = np.linspace(0.12, height * 0.9, count)
    for index, level in enumerate(levels):
        front = foot * (1 - level / height) + 0.06
        parts.append((block((0.0, -y, level), (front, y, level + 0.024)), palette.wood))
        parts.append((block((0.0, -y + 0.03, level + 0.024), (0.012, y - 0.03, level + 0.05)), palette.wood))
        clear = (levels[index + 1] - level - 0.03) if index + 1 < count else 0.32
        bay = Bay(front - 0.01, front - 0.02, -y + 0.035, y - 0.035, level + 0.024, min(clear, 0.34))
        parts += filled(rng, bay, stock)
    return piece("bookshelf", "ladder", parts)


def _leaning(foot: float, side: float, height: float) -> Mesh:
    """A rail from the floor in front to the top at the back; its ends are cut level."""
    flat = block((0, -0.014, -0.025), (1, 0.014, 0.025))
    way = np.array([-(foot - 0.02), 0.0, height])
    frame = np.column_stack([way, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
    vertices = flat.vertices @ frame.T + (foot, side, 0.0)
    normals = flat.normals @ np.linalg.inv(frame)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mirrored = np.ascontiguousarray(flat.faces[:, ::-1]) if np.linalg.det(frame) < 0 else flat.faces
    uv = flat.uv * np.where(np.arange(2) == 0, height, 1.0)
    return Mesh(vertices.astype(np.float32), normals.astype(np.float32), uv.astype(np.float32), mirrored)


def industrial(rng: Generator, palette: Palette) -> Piece:
    """Thick boards in a frame of black steel, open all around, crossed at the back."""
    width, height, deep = uniform(rng, 0.8, 1.2), uniform(rng, 1.4, 1.9), uniform(rng, 0.3, 0.36)
    x, y, r = deep / 2, width / 2, 0.0125
    parts: Parts = [
        (block((sx - r, sy - r, 0), (sx + r, sy + r, height), 0.003), BLACK_STEEL)
        for sx in (-x + r, x - r)
        for sy in (-y + r, y - r)
    ]
    levels = np.linspace(0.12, height - 0.03, int(rng.integers(4, 6)))
    stock = Stock.draw(rng, palette)
    for index, level in enumerate(levels):
        parts.append((block((-x + 0.004, -y + 2 * r, level), (x - 0.004, y - 2 * r, level + 0.03)), palette.wood))
        for sy in (-y + r, y - r):
            parts.append((brick((-x + r, sy - 0.008, level + 0.004), (x - r, sy + 0.008, level + 0.024)), BLACK_STEEL))
        if index + 1 < len(levels):
            clear = levels[index + 1] - level - 0.03
            bay = Bay(x - 0.01, deep - 0.05, -y + 0.035, y - 0.035, level + 0.03, clear)
            parts += filled(rng, bay, stock)
    for z, other in ((levels[0], levels[1]), (levels[1], levels[0])):
        parts.append((rod((-x + r, -y + r, z), (-x + r, y - r, other), 0.004, segments=6), BLACK_STEEL))
    top = levels[-1] + 0.03
    return piece("bookshelf", "industrial", parts, tops=[Top(float(top), (-x + 0.03, -y + 0.05), (x - 0.03, y - 0.05))])


BOOKSHELVES: dict[str, Callable[[Generator, Palette], Piece]] = {
    "bookcase": bookcase,
    "low": low_bookcase,
    "cubes": cubes,
    "ladder": ladder,
    "industrial": industrial,
}
"""Makers by style."""


# Dressers -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Front:
    """A drawer's or door's face: its place on the front of a carcass."""

    low: float
    high: float
    bottom: float
    top: float

    @property
    def middle(self) -> tuple[float, float]:
        return (self.low + self.high) / 2, (self.bottom + self.top) / 2

    @property
    def width(self) -> float:
        return self.high - self.low


_GAP_M = 0.004
_FRONT_M = 0.02


def chest(rng: Generator, palette: Palette) -> Piece:
    """A chest of drawers, the upper row often halved."""
    width, deep, height = uniform(rng, 0.75, 1.2), uniform(rng, 0.42, 0.5), uniform(rng, 0.75, 1.15)
    foot, x, y = uniform(rng, 0.06, 0.16), deep / 2, width / 2
    parts = _carcass(palette.body, x, y, foot, height) + _footing(rng, palette, x, y, foot)
    rows = round((height - foot) / uniform(rng, 0.19, 0.25))
    columns = 2 if width > 1.0 else 1
    handle = _handle_style(rng, palette)
    fronts = pick(rng, (palette.body, palette.body, palette.wood))
    edges = np.linspace(foot + 0.015, height - 0.03, rows + 1)
    for row, (bottom, top) in enumerate(itertools.pairwise(edges)):
        split = columns + 1 if row + 1 == rows and columns == 1 else columns
        for face in _split(y - 0.012, bottom, top, split):
            parts += [(_panel(x, face), fronts), *handle(x + _FRONT_M, face)]
    return piece("dresser", "chest", parts, tops=[_top(x, y, height)])


def nightstand(rng: Generator, palette: Palette) -> Piece:
    """A small chest for beside a bed: one or two drawers, perhaps over an open compartment."""
    width, deep, height = uniform(rng, 0.42, 0.55), uniform(rng, 0.36, 0.42), uniform(rng, 0.48, 0.62)
    foot, x, y, t = uniform(rng, 0.1, 0.18), deep / 2, width / 2, 0.02
    parts = _footing(rng, palette, x, y, foot)
    handle, split = _handle_style(rng, palette), foot + 0.55 * (height - foot)
    if chance(rng, 0.5):
        parts += _carcass(palette.body, x, y, foot, height)
        faces = [
            _Front(-y + 0.012, y - 0.012, foot + 0.015, split),
            _Front(-y + 0.012, y - 0.012, split, height - 0.03),
        ]
    else:
        parts += _carcass(palette.body, x, y, split - 0.02, height)
        parts += _open_box(palette.body, x, y, foot, split - 0.02, t)
        parts += pile(rng, Bay(x, deep - 0.05, -0.14, 0.14, foot + t, split - foot), Stock.draw(rng, palette))
        faces = [_Front(-y + 0.012, y - 0.012, split, height - 0.03)]
    for face in faces:
        parts += [(_panel(x, face), palette.body), *handle(x + _FRONT_M, face)]
    return piece("dresser", "nightstand", parts, tops=[_top(x, y, height)])


def sideboard(rng: Generator, palette: Palette) -> Piece:
    """A broad, low cabinet on legs, with doors and a column of drawers."""
    width, deep, height = uniform(rng, 1.2, 1.8), uniform(rng, 0.4, 0.48), uniform(rng, 0.7, 0.88)
    foot, x, y = uniform(rng, 0.12, 0.2), deep / 2, width / 2
    parts = _carcass(palette.body, x, y, foot, height) + _legs(rng, palette, x, y, foot)
    edges = np.linspace(-y + 0.012, y - 0.012, 4)
    bottom, top, handle = foot + 0.015, height - 0.03, _handle_style(rng, palette)
    fluted, drawers = chance(rng, 0.35), int(rng.integers(3))
    fronts = pick(rng, (palette.body, palette.wood))
    for column, (low, high) in enumerate(itertools.pairwise(edges)):
        if column == drawers:
            steps = np.linspace(bottom, top, 4)
            faces = [_Front(low, high, a, b) for a, b in itertools.pairwise(steps)]
            for face in faces:
                parts += [(_panel(x, face), fronts), *handle(x + _FRONT_M, face)]
            continue
        face = _Front(low, high, bottom, top)
        parts += _fluted(x, face, palette.wood) if fluted else [(_panel(x, face), fronts)]
        parts += _door_pull(palette, x + _FRONT_M, face, 1 if column == 0 else -1)
    return piece("dresser", "sideboard", parts, tops=[_top(x, y, height)])


def bench(rng: Generator, palette: Palette) -> Piece:
    """A long low bench for a tv: drawers or doors at the sides, an open compartment between."""
    width, deep, height = uniform(rng, 1.2, 1.8), uniform(rng, 0.38, 0.45), uniform(rng, 0.42, 0.54)
    foot, x, y, t = uniform(rng, 0.08, 0.16), deep / 2, width / 2, 0.022
    parts = _open_box(palette.body, x, y, foot, height, t) + _legs(rng, palette, x, y, foot)
    third, handle = width / 6, _handle_style(rng, palette)
    fronts, bottom, top = pick(rng, (palette.body, palette.wood)), foot + t, height - t
    for low, high in ((-y + t, -third), (third, y - t)):
        parts.append((brick((-x + 0.02, low, bottom), (x - 0.004, high, top)), tinted(palette.body, 0.4)))
        face = _Front(low, high, bottom, top)
        parts += [(_panel(x - _FRONT_M, face), fronts), *handle(x, face)]
    middle = (bottom + top) / 2
    parts.append((block((-x + 0.02, -third, middle), (x - 0.03, third, middle + 0.016)), palette.body))
    parts.append((brick((-0.1, -0.17, middle + 0.016), (0.1, 0.15, middle + 0.06)), DARK))
    low_bay = Bay(x - 0.06, deep - 0.1, -third + 0.02, third - 0.02, bottom, middle - bottom)
    parts += lying(rng, low_bay, Stock.draw(rng, palette))
    return piece("dresser", "bench", parts, tops=[_top(x, y, height)])


def wardrobe(rng: Generator, palette: Palette) -> Piece:
    """A tall cabinet with two or three doors, perhaps with drawers below."""
    doors = int(rng.integers(2, 4))
    width, deep, height = doors * uniform(rng, 0.42, 0.52), uniform(rng, 0.54, 0.6), uniform(rng, 1.8, 2.05)
    foot, x, y = uniform(rng, 0.06, 0.1), deep / 2, width / 2
    parts = _carcass(palette.body, x, y, foot, height)
    parts.append((block((-x + 0.02, -y + 0.02, 0), (x - 0.03, y - 0.02, foot)), tinted(palette.body, 0.6)))
    bottom, top = foot + 0.012, height - 0.03
    framed, handle = chance(rng, 0.6), _handle_style(rng, palette)
    if chance(rng, 0.5):
        for face in _split(y - 0.01, bottom, bottom + 0.26, doors):
            parts += [(_panel(x, face), palette.body), *handle(x + _FRONT_M, face)]
        bottom += 0.26
    for index, face in enumerate(_split(y - 0.01, bottom, top, doors)):
        parts.append((_panel(x, face), palette.body))
        parts += _frame(x + _FRONT_M, face, palette.body) if framed else []
        parts += _door_pull(palette, x + _FRONT_M + 0.01 * framed, face, -1 if index % 2 else 1, long=True)
    return piece("dresser", "wardrobe", parts)


DRESSERS: dict[str, Callable[[Generator, Palette], Piece]] = {
    "chest": chest,
    "nightstand": nightstand,
    "sideboard": sideboard,
    "bench": bench,
    "wardrobe": wardrobe,
}
"""Makers by style."""


def _carcass(look: Look, x: float, y: float, bottom: float, top: float) -> Parts:
    """A closed body with a top board that overhangs, dark where gaps between fronts let one see in."""
    return [
        (block((-x, -y, bottom), (x, y, top - 0.025)), look),
        (brick((x - 0.01, -y + 0.01, bottom + 0.01), (x + 0.002, y - 0.01, top - 0.026)), tinted(look, 0.25)),
        (block((-x, -y - 0.012, top - 0.025), (x + 0.03, y + 0.012, top), 0.006), look),
    ]


def _open_box(look: Look, x: float, y: float, bottom: float, top: float, t: float) -> Parts:
    """Boards around a compartment that is open to the front."""
    return [
        (block((-x, -y, bottom), (x, y, bottom + t)), look),
        (block((-x, -y, top - t), (x, y, top)), look),
        (block((-x, -y, bottom + t), (x, -y + t, top - t)), look),
        (block((-x, y - t, bottom + t), (x, y, top - t)), look),
        (brick((-x, -y + t, bottom + t), (-x + 0.01, y - t, top - t)), tinted(look, 0.7)),
    ]


def _split(half: float, bottom: float, top: float, count: int) -> list[_Front]:
    edges = np.linspace(-half, half, count + 1)
    return [_Front(float(a), float(b), bottom, top) for a, b in itertools.pairwise(edges)]


def _panel(x: float, face: _Front) -> Mesh:
    """The board in front of a drawer or compartment, with gaps around."""
    gap = _GAP_M / 2
    low = (x, face.low + gap, face.bottom + gap)
    return block(low, (x + _FRONT_M, face.high - gap, face.top - gap), 0.003, grain=1 if face.width > 0.3 else 2)


def _frame(x: float, face: _Front, look: Look) -> Parts:
    """Rails and stiles on a door."""
    wide, thick, low, high = 0.06, 0.01, face.low + 0.004, face.high - 0.004
    bottom, top = face.bottom + 0.004, face.top - 0.004
    spans = [
        ((low, bottom), (low + wide, top)),
        ((high - wide, bottom), (high, top)),
        ((low + wide, bottom), (high - wide, bottom + wide)),
        ((low + wide, top - wide), (high - wide, top)),
    ]
    return [(block((x, a[0], a[1]), (x + thick, b[0], b[1]), 0.003), look) for a, b in spans]


def _fluted(x: float, face: _Front, look: Look) -> Parts:
    """A door of upright ribs."""
    count = int(face.width / 0.035)
    edges = np.linspace(face.low + 0.003, face.high - 0.003, count + 1)
    ribs = [
        (block((x + 0.004, a + 0.002, face.bottom + 0.003), (x + _FRONT_M, b - 0.002, face.top - 0.003), 0.006), look)
        for a, b in itertools.pairwise(edges)
    ]
    back = box((x, face.low + 0.003, face.bottom + 0.003), (x + 0.008, face.high - 0.003, face.top - 0.003))
    return [*ribs, (back, tinted(look, 0.5))]


Handle = Callable[[float, _Front], Parts]


def _handle_style(rng: Generator, palette: Palette) -> Handle:
    """One kind of handle for all drawers of a piece."""
    metal, kind = palette.metal, int(rng.integers(4))
    radius = uniform(rng, 0.013, 0.018)

    def knobs(x: float, face: _Front) -> Parts:
        y, z = face.middle
        places = (y - face.width / 4, y + face.width / 4) if face.width > 0.5 else (y,)
        return [(knob((x, place, z), radius), metal) for place in places]

    def bars(x: float, face: _Front) -> Parts:
        y, z = face.middle
        half = min(0.08, face.width / 4)
        path = [(x, y - half, z), (x + 0.026, y - half, z), (x + 0.026, y + half, z), (x, y + half, z)]
        return [(tube(path, 0.005, segments=6), metal)]

    def cups(x: float, face: _Front) -> Parts:
        y, z = face.middle
        half = min(0.045, face.width / 4)
        return [(block((x, y - half, z), (x + 0.022, y + half, z + 0.024), 0.009), metal)]

    def grips(x: float, face: _Front) -> Parts:
        y, half = face.middle[0], min(0.09, face.width / 3)
        low, high = (x - 0.004, y - half, face.top - 0.028), (x + 0.0012, y + half, face.top - 0.004)
        return [(brick(low, high), DARK)]

    return (knobs, bars, cups, grips)[kind]


def _door_pull(palette: Palette, x: float, face: _Front, side: int, *, long: bool = False) -> Parts:
    """An upright handle near the edge at which a door opens: `side` is 1 for the greater y."""
    y = (face.high if side > 0 else face.low) - side * 0.035
    middle, half = face.middle[1], 0.16 if long else 0.06
    z = middle if long else face.top - 0.14
    path = [(x, y, z - half), (x + 0.026, y, z - half), (x + 0.026, y, z + half), (x, y, z + half)]
    return [(tube(path, 0.005, segments=6), palette.metal)]


def _footing(rng: Generator, palette: Palette, x: float, y: float, foot: float) -> Parts:
    """Legs, or a recessed plinth."""
    if foot > 0.1 or chance(rng, 0.4):
        return _legs(rng, palette, x, y, foot)
    return [(brick((-x + 0.02, -y + 0.02, 0), (x - 0.03, y - 0.02, foot)), tinted(palette.body, 0.6))]


def _legs(rng: Generator, palette: Palette, x: float, y: float, foot: float) -> Parts:
    """Four legs: turned and splayed, square, or a skid of steel at either end."""
    kind, inset = int(rng.integers(3)), 0.06
    corners = [(sx, sy) for sx in (-1, 1) for sy in (-1, 1)]
    if kind == 0:
        splay = 0.1 * foot
        return [
            (
                leg(
                    (sx * (x - inset), sy * (y - inset), foot),
                    (sx * (x - inset + splay), sy * (y - inset + splay), 0.0),
                    0.042,
                    0.022,
                ),
                palette.wood,
            )
            for sx, sy in corners
        ]
    if kind == 1:
        return [
            (moved(block((-0.02, -0.02, 0), (0.02, 0.02, foot)), (sx * (x - 0.05), sy * (y - 0.05), 0)), palette.wood)
            for sx, sy in corners
        ]
    parts: Parts = []
    for sy in (-1, 1):
        side = sy * (y - 0.08)
        parts.append((brick((-x + 0.03, side - 0.012, 0), (x - 0.03, side + 0.012, 0.015)), BLACK_STEEL))
        for sx in (-1, 1):
            at = sx * (x - 0.045)
            parts.append((brick((at - 0.012, side - 0.012, 0.0), (at + 0.012, side + 0.012, foot)), BLACK_STEEL))
    return parts


def _top(x: float, y: float, height: float) -> Top:
    return Top(height, (-x + 0.01, -y + 0.01), (x - 0.01, y - 0.01))
