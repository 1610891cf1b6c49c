"""Textures out of noise and arithmetic: one square tile, whose edges meet, for every look.

A pattern is a function of a look and a random generator; its tile is (SIZE, SIZE, 3) of 0 to 1 and covers `tile_m` of
the surface each way: columns run along the first texture axis, rows along the second, the first row at its low end.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.sim.home import Array, Colour, Look

SIZE = 256
"""Edge of a tile, pixels."""

Pattern = Callable[[Look, np.random.Generator], Array]


def tile(look: Look) -> NDArray[np.uint8]:
    """(SIZE, SIZE, 3) RGB, row 0 at the low end of the second texture axis. The same look gives the same tile.

    Raises:
        KeyError: no such pattern.
    """
    pattern = PATTERNS[look.pattern]
    rng = np.random.default_rng([look.seed, list(PATTERNS).index(look.pattern), 0x7E7])
    picture = pattern(look, rng)
    return np.asarray(np.round(np.clip(picture, 0, 1) * 255), np.uint8)


def noise(rng: np.random.Generator, scale: float, *, stretch: float = 1.0) -> Array:
    """(SIZE, SIZE) smooth noise that tiles, mean 0, about -1 to 1.

    Args:
        scale: size of its blobs as a share of the tile.
        stretch: blobs are longer along rows of pixels (the first texture axis) by this factor.
    """
    knots = rng.standard_normal((_knots(scale), _knots(scale * stretch)), np.float32)
    around = np.pad(knots, _RIM, mode="wrap")
    grown = cv2.resize(
        around,
        (SIZE * around.shape[1] // knots.shape[1], SIZE * around.shape[0] // knots.shape[0]),
        interpolation=cv2.INTER_CUBIC,
    )
    top, left = (_RIM * SIZE // count for count in knots.shape)
    field = grown[top : top + SIZE, left : left + SIZE].astype(np.float64)
    field -= field.mean()
    return np.asarray(field / (2.5 * max(float(field.std()), 1e-9)))


_RIM = 2
"""Knots repeated at each edge before smoothing, so that the tile's edges meet."""


def _knots(scale: float) -> int:
    """Knots along one edge of the tile: a power of two, so that they fall on whole pixels."""
    wanted = min(max(0.6 / scale, 1.0), float(SIZE))
    return 1 << round(math.log2(wanted))


def _cloud(rng: np.random.Generator, scale: float = 0.2) -> Array:
    """Noise of several sizes."""
    return 0.6 * noise(rng, scale) + 0.3 * noise(rng, scale / 3) + 0.15 * noise(rng, scale / 9)


def _axes() -> tuple[Array, Array]:
    """Place on the tile, 0 to 1: along the first axis (columns) and along the second (rows)."""
    place = (np.arange(SIZE) + 0.5) / SIZE
    first, second = np.meshgrid(place, place)
    return first, second


def _flat(colour: Colour) -> Array:
    return np.broadcast_to(np.asarray(colour, np.float64), (SIZE, SIZE, 3)).copy()


def _mix(first: Colour, second: Colour, share: Array) -> Array:
    """(SIZE, SIZE, 3) from the first colour (share 0) to the second (share 1)."""
    weight = np.clip(share, 0, 1)[..., None]
    return np.asarray(np.asarray(first) * (1 - weight) + np.asarray(second) * weight)


def _second(look: Look, darker: float = 0.75) -> Colour:
    """The look's second colour, or a darker shade of its only one."""
    if len(look.colours) > 1:
        return look.colours[1]
    red, green, blue = look.colours[0]
    return red * darker, green * darker, blue * darker


def plain(look: Look, rng: np.random.Generator) -> Array:
    """One colour, nothing else."""
    return _flat(look.colours[0])


def paint(look: Look, rng: np.random.Generator) -> Array:
    """Painted wall: faint roller marks and stains."""
    return _flat(look.colours[0]) * (1 + 0.025 * _cloud(rng, 0.25) + 0.012 * noise(rng, 0.008))[..., None]


def plaster(look: Look, rng: np.random.Generator) -> Array:
    """Rough plaster: blotches and grain."""
    return _flat(look.colours[0]) * (1 + 0.08 * _cloud(rng, 0.12) + 0.06 * noise(rng, 0.012))[..., None]


def wood(look: Look, rng: np.random.Generator) -> Array:
    """Grain along the first axis, with long waves and pores."""
    _, across = _axes()
    wave = noise(rng, 0.12, stretch=5)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (9 * across + 1.3 * wave))
    fine = noise(rng, 0.006, stretch=30)
    return _mix(look.colours[0], _second(look, 0.72), 0.15 + 0.45 * rings + 0.3 * fine + 0.25 * wave)


def planks(look: Look, rng: np.random.Generator) -> Array:
    """Floor boards along the first axis: eight to a tile, with staggered ends, dark joints and different shades."""
    along, across = _axes()
    boards = 8
    board = np.minimum((across * boards).astype(int), boards - 1)
    shift = rng.random(boards)[board]
    piece = (((along + shift) % 1.0) * 2).astype(int)
    shade = rng.uniform(-0.5, 0.5, (boards, 2))[board, piece]
    grain = noise(rng, 0.008, stretch=25) + 0.5 * noise(rng, 0.05, stretch=6)
    picture = _mix(look.colours[0], _second(look, 0.7), 0.35 + 0.45 * shade + 0.25 * grain)
    edge = np.minimum((across * boards) % 1, 1 - (across * boards) % 1) / boards
    end = ((along + shift) * 2) % 1
    joint = (edge < 0.004) | (np.minimum(end, 1 - end) / 2 < 0.003)
    return np.asarray(np.where(joint[..., None], picture * 0.55, picture))


def parquet(look: Look, rng: np.random.Generator) -> Array:
    """Blocks of four staves, turned in turn."""
    along, across = _axes()
    blocks, staves = 4, 4
    i, j = (along * blocks).astype(int), (across * blocks).astype(int)
    turned = (i + j) % 2 == 1
    u, v = (along * blocks) % 1, (across * blocks) % 1
    place = np.where(turned, u, v)
    stave = np.minimum((place * staves).astype(int), staves - 1)
    shade = rng.uniform(-0.5, 0.5, (blocks, blocks, staves))[i, j, stave]
    grain = np.where(turned, noise(rng, 0.008, stretch=20).T, noise(rng, 0.008, stretch=20))
    picture = _mix(look.colours[0], _second(look, 0.7), 0.4 + 0.4 * shade + 0.2 * grain)
    gap = np.minimum.reduce([u, 1 - u, v, 1 - v]) < 0.015
    gap |= np.minimum((place * staves) % 1, 1 - (place * staves) % 1) < 0.04
    return np.asarray(np.where(gap[..., None], picture * 0.65, picture))


def tiles(look: Look, rng: np.random.Generator) -> Array:
    """Square ceramic tiles, four by four, with light or dark joints (second colour)."""
    return _laid(look, rng, 4, 4, 0.0, 0.012)


def checker(look: Look, rng: np.random.Generator) -> Array:
    """Square tiles in two colours by turns."""
    along, across = _axes()
    odd = ((along * 4).astype(int) + (across * 4).astype(int)) % 2
    picture = _mix(look.colours[0], _second(look), odd.astype(np.float64)) * (1 + 0.05 * _cloud(rng))[..., None]
    edge = np.minimum((along * 4) % 1, (across * 4) % 1)
    return np.asarray(np.where((edge < 0.03)[..., None], picture * 0.8, picture))


def brick(look: Look, rng: np.random.Generator) -> Array:
    """Bricks, staggered, with mortar in the second colour."""
    return _laid(look, rng, 4, 10, 0.5, 0.01)


def _laid(look: Look, rng: np.random.Generator, columns: int, rows: int, stagger: float, joint: float) -> Array:
    along, across = _axes()
    j = np.minimum((across * rows).astype(int), rows - 1)
    place = (along * columns + stagger * (j % 2)) % columns
    i = np.minimum(place.astype(int), columns - 1)
    shade = rng.uniform(-1, 1, (columns, rows))[i, j]
    picture = _flat(look.colours[0]) * (1 + 0.10 * shade + 0.05 * _cloud(rng, 0.06))[..., None]
    u, v = place % 1, (across * rows) % 1
    gap = (np.minimum(u, 1 - u) / columns < joint / 2) | (np.minimum(v, 1 - v) / rows < joint / 2)
    return np.asarray(np.where(gap[..., None], np.asarray(_second(look, 0.8)), picture))


def carpet(look: Look, rng: np.random.Generator) -> Array:
    """Short pile: grain of two shades."""
    return _mix(look.colours[0], _second(look, 0.8), 0.4 + 0.5 * noise(rng, 0.008) + 0.25 * _cloud(rng, 0.15))


def rug(look: Look, rng: np.random.Generator) -> Array:
    """A woven rug that the tile covers once: borders, a medallion and a lattice, in up to four colours."""
    along, across = _axes()
    colours = [np.asarray(colour) for colour in (look.colours * 4)[:4]]
    edge = np.minimum.reduce([along, 1 - along, across, 1 - across])
    picture = np.broadcast_to(colours[0], (SIZE, SIZE, 3)).copy()
    lattice = (np.sin(along * 12 * np.pi) * np.sin(across * 12 * np.pi)) > 0.55
    picture[lattice] = colours[2]
    spread = np.abs(along - 0.5) / 0.30 + np.abs(across - 0.5) / 0.24
    picture[spread < 1] = colours[1]
    picture[spread < 0.62] = colours[3]
    picture[spread < 0.3] = colours[1]
    for low, high, index in ((0.0, 0.03, 1), (0.03, 0.05, 3), (0.05, 0.11, 2), (0.11, 0.125, 1)):
        picture[(edge >= low) & (edge < high)] = colours[index]
    return picture * (1 + 0.10 * noise(rng, 0.006) + 0.04 * _cloud(rng))[..., None]


def fabric(look: Look, rng: np.random.Generator) -> Array:
    """Woven cloth: fine threads, faint folds."""
    along, across = _axes()
    weave = 0.5 + 0.25 * np.sin(2 * np.pi * 40 * along) + 0.25 * np.sin(2 * np.pi * 40 * across)
    return _mix(look.colours[0], _second(look, 0.75), 0.35 * weave + 0.25 * noise(rng, 0.012) + 0.2 * _cloud(rng))


def stripes(look: Look, rng: np.random.Generator) -> Array:
    """Stripes along the second axis (upright on walls), in up to three colours, with thin seams."""
    along, _ = _axes()
    colours = np.asarray(
        (look.colours * 3)[:3] if len(look.colours) > 1 else [look.colours[0], _second(look, 0.85)] * 2
    )
    order = [0, 1, 0, 2 % len(look.colours) if len(look.colours) > 1 else 1]
    band = np.minimum((along * 8).astype(int), 7)
    return np.asarray(colours[np.array(order)[band % 4]] * (1 + 0.05 * noise(rng, 0.01))[..., None])


def plaid(look: Look, rng: np.random.Generator) -> Array:
    """A checked blanket."""
    along, across = _axes()
    colours = (look.colours * 3)[:3]
    warp = ((along * 4) % 1 < 0.45).astype(np.float64)
    weft = ((across * 4) % 1 < 0.45).astype(np.float64)
    picture = _mix(colours[0], colours[1] if len(look.colours) > 1 else _second(look), 0.5 * (warp + weft))
    line = (np.abs((along * 4) % 1 - 0.72) < 0.03) | (np.abs((across * 4) % 1 - 0.72) < 0.03)
    picture[line] = 0.5 * picture[line] + 0.5 * np.asarray(colours[2])
    return np.asarray(picture * (1 + 0.08 * noise(rng, 0.008))[..., None])


def dots(look: Look, rng: np.random.Generator) -> Array:
    """Dots in staggered rows."""
    along, across = _axes()
    row = (across * 8).astype(int)
    u, v = (along * 8 + 0.5 * (row % 2)) % 1 - 0.5, (across * 8) % 1 - 0.5
    return _mix(look.colours[0], _second(look), (np.hypot(u, v) < 0.25).astype(np.float64))


def floral(look: Look, rng: np.random.Generator) -> Array:
    """Wallpaper or cloth with flowers: rosettes of five petals at staggered places, leaves between."""
    along, across = _axes()
    colours = (look.colours * 3)[:3] if len(look.colours) > 1 else (look.colours[0], _second(look), _second(look, 0.6))
    picture = _flat(colours[0]) * (1 + 0.03 * _cloud(rng))[..., None]
    for cx, cy, kind in ((0.25, 0.25, 1), (0.75, 0.75, 1), (0.75, 0.25, 2), (0.25, 0.75, 2)):
        dx, dy = along - cx, across - cy
        radius, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
        petals = 0.085 + 0.055 * np.cos((5 if kind == 1 else 3) * angle + kind)
        picture[radius < petals] = colours[1 if kind == 1 else 2]
        picture[radius < 0.035] = colours[2 if kind == 1 else 0]
    return picture


def damask(look: Look, rng: np.random.Generator) -> Array:
    """Wallpaper: pointed ovals in staggered columns, tone on tone."""
    along, across = _axes()
    second = _second(look, 0.88)
    share = np.zeros((SIZE, SIZE))
    for cx, cy in ((0.25, 0.0), (0.25, 1.0), (0.75, 0.5)):
        dx, dy = np.abs(along - cx) / 0.2, np.abs(across - cy) / 0.42
        oval = dx**1.5 + dy**1.5
        share[(oval < 1) & (oval > 0.72)] = 1.0
        share[oval < 0.4] = 1.0
        share[(oval < 0.22)] = 0.0
    return _mix(look.colours[0], second, share) * (1 + 0.02 * noise(rng, 0.02))[..., None]


def lattice(look: Look, rng: np.random.Generator) -> Array:
    """Wallpaper: crossing diagonal lines with a dot in every field."""
    along, across = _axes()
    a, b = ((along + across) * 4) % 1, ((along - across) * 4) % 1
    line = (np.minimum(a, 1 - a) < 0.07) | (np.minimum(b, 1 - b) < 0.07)
    dot = np.hypot(a - 0.5, b - 0.5) < 0.12
    return _mix(look.colours[0], _second(look), (line | dot).astype(np.float64))


def leather(look: Look, rng: np.random.Generator) -> Array:
    """Smooth hide with fine creases."""
    creases = np.abs(noise(rng, 0.014)) < 0.05
    picture = _flat(look.colours[0]) * (1 + 0.07 * _cloud(rng, 0.2))[..., None]
    return np.asarray(np.where(creases[..., None], picture * 0.88, picture))


def metal(look: Look, rng: np.random.Generator) -> Array:
    """Brushed along the first axis."""
    return _flat(look.colours[0]) * (1 + 0.05 * noise(rng, 0.005, stretch=40))[..., None]


def marble(look: Look, rng: np.random.Generator) -> Array:
    """Veins in the second colour."""
    vein = 1 - np.clip(np.abs(noise(rng, 0.18) + 0.4 * noise(rng, 0.05)) / 0.12, 0, 1)
    return _mix(look.colours[0], _second(look, 0.7), 0.6 * vein + 0.1 * _cloud(rng))


def foliage(look: Look, rng: np.random.Generator) -> Array:
    """Leaves: veins off a middle rib, blotches of a second green."""
    along, across = _axes()
    rib = np.abs(((along * 4) % 1) - 0.5)
    vein = (np.abs(((across * 12 + rib * 3) % 1) - 0.5) < 0.06) | (rib < 0.03)
    picture = _mix(look.colours[0], _second(look, 0.7), 0.4 + 0.6 * _cloud(rng, 0.08))
    return np.asarray(np.where(vein[..., None], picture * 1.18, picture))


def wicker(look: Look, rng: np.random.Generator) -> Array:
    """Basket weave."""
    along, across = _axes()
    u, v = along * 12, across * 12
    over = ((u.astype(int) + v.astype(int)) % 2).astype(bool)
    bump = np.where(over, np.sin(np.pi * (u % 1)), np.sin(np.pi * (v % 1)))
    return _mix(_second(look, 0.55), look.colours[0], 0.25 + 0.75 * bump + 0.1 * noise(rng, 0.01))


def painting(look: Look, rng: np.random.Generator) -> Array:
    """A picture that the tile covers once: landscape, abstract fields, or a still life, drawn by the seed."""
    kind = int(rng.integers(3))
    return (_landscape, _abstract, _still_life)[kind](look, rng)


def _landscape(look: Look, rng: np.random.Generator) -> Array:
    _, up = _axes()
    sky = _mix((0.93, 0.85, 0.72), (0.45, 0.62, 0.82), np.clip((up - 0.45) * 2, 0, 1))
    picture = sky * (1 + 0.10 * _cloud(rng, 0.2))[..., None]
    for level in range(3):
        ridge = 0.55 - 0.16 * level + 0.10 * noise(rng, 0.15)[0]
        shade = np.asarray((look.colours * 3)[level]) * (0.95 - 0.2 * level)
        below = up < ridge[None, :]
        picture[below] = shade
    return picture * (1 + 0.08 * _cloud(rng, 0.05))[..., None]


def _abstract(look: Look, rng: np.random.Generator) -> Array:
    along, up = _axes()
    picture = _flat(look.colours[0])
    for _ in range(9):
        x, y = rng.uniform(0, 1, 2)
        w, h = rng.uniform(0.08, 0.35, 2)
        colour = np.asarray(look.colours[int(rng.integers(len(look.colours)))]) * rng.uniform(0.5, 1.25)
        shape = (
            (np.hypot((along - x) / w, (up - y) / h) < 1)
            if rng.random() < 0.5
            else ((np.abs(along - x) < w) & (np.abs(up - y) < h))
        )
        picture[shape] = colour
    return picture * (1 + 0.06 * _cloud(rng, 0.04))[..., None]


def _still_life(look: Look, rng: np.random.Generator) -> Array:
    along, up = _axes()
    picture = _mix((0.35, 0.28, 0.22), (0.62, 0.52, 0.42), up + 0.2 * _cloud(rng))
    picture[up < 0.35] = (0.46, 0.30, 0.18)
    for index in range(5):
        x, radius = 0.2 + 0.15 * index + rng.uniform(-0.04, 0.04), rng.uniform(0.07, 0.13)
        colour = np.asarray(look.colours[index % len(look.colours)])
        distance = np.hypot(along - x, up - 0.33 - radius * 0.8) / radius
        light = 1.25 - 0.5 * np.hypot(along - x + radius / 3, up - 0.33 - radius * 1.2) / radius
        inside = distance < 1
        picture[inside] = (colour * np.clip(light, 0.5, 1.4)[..., None])[inside]
    return picture * (1 + 0.05 * noise(rng, 0.01))[..., None]


def outdoors(look: Look, rng: np.random.Generator) -> Array:
    """The view from a window, which the tile covers once: sky, clouds, trees, a lawn."""
    _, up = _axes()
    sky = _mix((0.86, 0.92, 0.97), (0.52, 0.72, 0.95), (up - 0.35) * 1.5)
    clouds = np.clip(_cloud(rng, 0.18) * 1.6, 0, 1)[..., None]
    picture = sky * (1 - clouds) + clouds
    crown = 0.33 + 0.10 * noise(rng, 0.08)[0] + 0.03 * noise(rng, 0.015)[0]
    trees = up < crown[None, :]
    picture[trees] = (np.array([0.24, 0.42, 0.20]) * (1 + 0.5 * noise(rng, 0.02))[..., None])[trees]
    lawn = up < 0.16
    picture[lawn] = (np.array([0.45, 0.62, 0.30]) * (1 + 0.15 * noise(rng, 0.01))[..., None])[lawn]
    return picture


def screen(look: Look, rng: np.random.Generator) -> Array:
    """A television's screen: off, with a reflection of the room, or on; the tile covers it once."""
    along, up = _axes()
    if rng.random() < 0.6:
        glare = np.clip(1 - np.abs(along - up * 0.6 - 0.15) / 0.12, 0, 1)
        return _flat((0.03, 0.035, 0.045)) + (0.06 * glare + 0.03 * up)[..., None]
    return 0.85 * outdoors(look, rng)


def books(look: Look, rng: np.random.Generator) -> Array:
    """A row of book spines which the tile covers once, upright: colours of the look, lettering as bright bars."""
    along, up = _axes()
    picture = _flat((0.08, 0.07, 0.06))
    place = 0.0
    while place < 0.985:
        width, height = rng.uniform(0.03, 0.075), rng.uniform(0.74, 0.98)
        colour = np.asarray(look.colours[int(rng.integers(len(look.colours)))]) * rng.uniform(0.7, 1.2)
        spine = (along >= place + 0.003) & (along < min(1.0, place + width)) & (up < height)
        picture[spine] = colour
        label = spine & (np.abs(up - rng.uniform(0.45, 0.7)) < rng.uniform(0.02, 0.09))
        picture[label] = np.clip(colour * 1.9 + 0.15, 0, 1)
        place += width
    return picture


def quilt(look: Look, rng: np.random.Generator) -> Array:
    """A stitched bed cover: soft squares with darker seams."""
    along, across = _axes()
    u, v = (along * 4) % 1 - 0.5, (across * 4) % 1 - 0.5
    puff = (1 - 4 * u * u) * (1 - 4 * v * v)
    return _mix(_second(look, 0.78), look.colours[0], 0.35 + 0.65 * puff**0.5 + 0.1 * noise(rng, 0.015))


PATTERNS: dict[str, Pattern] = {
    function.__name__: function
    for function in (
        plain,
        paint,
        plaster,
        wood,
        planks,
        parquet,
        tiles,
        checker,
        brick,
        carpet,
        rug,
        fabric,
        stripes,
        plaid,
        dots,
        floral,
        damask,
        lattice,
        leather,
        metal,
        marble,
        foliage,
        wicker,
        painting,
        outdoors,
        screen,
        books,
        quilt,
    )
}
"""Patterns by name."""
