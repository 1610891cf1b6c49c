"""Refrigerators, televisions, bins and toilets.

A television's outline includes its stand; one that hangs on a wall has none, and whoever places it lifts it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import (
    BLACK_STEEL,
    CHROME,
    DARK,
    STEEL,
    WHITE,
    Palette,
    appliance,
    chance,
    pick,
    piece,
    plastic,
    tinted,
    uniform,
    wicker,
)
from semslam.sim.furniture.forms import loft, rounded_ring
from semslam.sim.furniture.solids import block, shell, skin
from semslam.sim.home import Array, Colour, Look, Mesh, Piece, Vector
from semslam.sim.shapes import about_x, about_y, bar, box, lathe, merge, moved, picture_plane, posed, rod, tube

Parts = list[tuple[Mesh, Look]]
Makers = dict[str, Callable[[Generator, Palette], Piece]]

# Refrigerators --------------------------------------------------------------------------------------------------------

_PAPERS: tuple[Colour, ...] = (
    (0.95, 0.93, 0.80),
    (0.93, 0.93, 0.92),
    (0.55, 0.70, 0.82),
    (0.86, 0.55, 0.40),
    (0.93, 0.80, 0.35),
    (0.62, 0.75, 0.50),
)
_GASKET = plastic((0.16, 0.16, 0.17), shine=0.0)


def two_door(rng: Generator, _: Palette) -> Piece:
    """A fridge-freezer: a small door over or under a large one."""
    wide, deep, height = uniform(rng, 0.55, 0.70), uniform(rng, 0.60, 0.68), uniform(rng, 1.55, 1.95)
    look, foot = appliance(rng), 0.06
    freezer_above = chance(rng, 0.5)
    split = foot + (height - foot) * (uniform(rng, 0.66, 0.72) if freezer_above else uniform(rng, 0.32, 0.40))
    parts, x = _cabinet(look, wide, deep, height, foot)
    grip, hinge = _grip_style(rng, look), pick(rng, (-1, 1))
    for bottom, top in ((foot, split), (split, height)):
        parts.append((_door(x, (-wide / 2, wide / 2), (bottom, top)), look))
        tall = (top - bottom) * (0.36 if top - bottom > 0.9 else 0.5)
        near = top < height or not freezer_above  # handles meet where the doors meet
        low = top - 0.07 - tall if (top == split) else bottom + 0.07
        low = low if near or top == split else bottom + 0.07
        parts += grip(x + _DOOR_M, -hinge * (wide / 2 - 0.055), (low, low + tall))
    big = (foot, split) if freezer_above else (split, height)
    parts += _notes(rng, x + _DOOR_M, wide, big) if chance(rng, 0.45) else []
    return piece("refrigerator", "two_door", parts)


def single_door(rng: Generator, _: Palette) -> Piece:
    """A tall refrigerator with one door."""
    wide, deep, height = uniform(rng, 0.58, 0.62), uniform(rng, 0.60, 0.68), uniform(rng, 1.45, 1.85)
    look, foot = appliance(rng), 0.06
    parts, x = _cabinet(look, wide, deep, height, foot)
    parts.append((_door(x, (-wide / 2, wide / 2), (foot, height)), look))
    middle, hinge = foot + 0.55 * (height - foot), pick(rng, (-1, 1))
    parts += _grip_style(rng, look)(x + _DOOR_M, -hinge * (wide / 2 - 0.055), (middle - 0.28, middle + 0.28))
    parts += _notes(rng, x + _DOOR_M, wide, (foot, height)) if chance(rng, 0.45) else []
    return piece("refrigerator", "single_door", parts)


def side_by_side(rng: Generator, _: Palette) -> Piece:
    """A broad one with two tall doors, long bars as handles and a water dispenser."""
    wide, deep, height = uniform(rng, 0.85, 0.92), uniform(rng, 0.66, 0.72), uniform(rng, 1.72, 1.82)
    look, foot = appliance(rng), 0.05
    parts, x = _cabinet(look, wide, deep, height, foot)
    split = -wide / 2 + wide * uniform(rng, 0.42, 0.5)
    front = x + _DOOR_M
    for low, high in ((-wide / 2, split), (split, wide / 2)):
        parts.append((_door(x, (low, high), (foot, height)), look))
    for side in (-1, 1):
        parts += _bar_grip(front, split + side * 0.05, (0.62, 1.45), STEEL)
    middle, z = (-wide / 2 + split) / 2 - 0.02, 1.0
    parts.append((block((front - 0.01, middle - 0.10, z), (front + 0.006, middle + 0.10, z + 0.36), 0.005), DARK))
    parts.append((box((front, middle - 0.07, z + 0.26), (front + 0.0075, middle + 0.07, z + 0.33)), _DISPLAY))
    parts.append((block((front, middle - 0.08, z + 0.02), (front + 0.022, middle + 0.08, z + 0.035), 0.004), STEEL))
    return piece("refrigerator", "side_by_side", parts)


def retro(rng: Generator, _: Palette) -> Piece:
    """Round edges, a colour, a chrome handle and badge."""
    wide, deep, height = uniform(rng, 0.56, 0.62), uniform(rng, 0.60, 0.68), uniform(rng, 1.45, 1.7)
    colour = pick(rng, ((0.62, 0.76, 0.72), (0.88, 0.84, 0.70), (0.68, 0.20, 0.17), (0.92, 0.91, 0.88)))
    look, foot, x = plastic(colour, shine=0.6), 0.07, deep / 2 - 0.075
    split = foot + 0.72 * (height - foot)
    parts: Parts = [
        (box((-deep / 2, -wide / 2, foot), (x, wide / 2, height), bevel_m=0.05), look),
        (box((x - 0.03, -wide / 2 + 0.03, foot + 0.03), (x + 0.01, wide / 2 - 0.03, height - 0.03)), _GASKET),
        (box((-deep / 2 + 0.03, -wide / 2 + 0.03, 0), (x - 0.03, wide / 2 - 0.03, foot + 0.03)), DARK),
    ]
    for bottom, top in ((foot, split - 0.003), (split + 0.003, height)):
        door = box((x + 0.008, -wide / 2, bottom), (x + 0.075, wide / 2, top), bevel_m=0.03)
        parts.append((door, look))
    for low, high in ((split - 0.30, split - 0.08), (split + 0.06, split + 0.22)):
        parts += _bar_grip(x + 0.073, wide / 2 - 0.07, (low, high), CHROME)
    badge = block((x + 0.07, -0.07, height - 0.16), (x + 0.079, 0.07, height - 0.13), 0.003)
    return piece("refrigerator", "retro", [*parts, (badge, CHROME)])


REFRIGERATORS: Makers = {
    "two_door": two_door,
    "single_door": single_door,
    "side_by_side": side_by_side,
    "retro": retro,
}
"""Makers by style."""

_DOOR_M = 0.06
_DISPLAY = Look("plain", ((0.25, 0.45, 0.60),), glow=0.4)


def _cabinet(look: Look, wide: float, deep: float, height: float, foot: float) -> tuple[Parts, float]:
    """The body behind the doors, the seal between, a dark base; and x of the doors' back."""
    x, y = deep / 2 - _DOOR_M, wide / 2
    sides = tinted(look, 0.93)
    return [
        (block((-deep / 2, -y, foot), (x - 0.008, y, height), 0.006), sides),
        (box((x - 0.009, -y + 0.008, foot + 0.006), (x + 0.004, y - 0.008, height - 0.008)), _GASKET),
        (box((-deep / 2 + 0.03, -y + 0.02, 0), (x - 0.02, y - 0.02, foot)), DARK),
        (block((x - 0.05, -y + 0.03, height - 0.004), (x + 0.04, -y + 0.10, height + 0.014), 0.004), tinted(look, 0.6)),
        (block((x - 0.05, y - 0.10, height - 0.004), (x + 0.04, y - 0.03, height + 0.014), 0.004), tinted(look, 0.6)),
    ], x


def _door(x: float, across: tuple[float, float], up: tuple[float, float]) -> Mesh:
    """A door with round edges and gaps of 3 mm all around."""
    low, high = (x, across[0] + 0.003, up[0] + 0.003), (x + _DOOR_M, across[1] - 0.003, up[1] - 0.003)
    return box(low, high, bevel_m=0.012)


Grip = Callable[[float, float, tuple[float, float]], Parts]


def _grip_style(rng: Generator, look: Look) -> Grip:
    """Bars on stand-offs, moulded grips, or recesses."""
    bright = look.colours[0][0] > 0.5
    kind, metal = int(rng.integers(3)), pick(rng, (STEEL, CHROME, BLACK_STEEL if bright else STEEL))

    def bars(x: float, y: float, up: tuple[float, float]) -> Parts:
        return _bar_grip(x, y, up, metal)

    def moulded(x: float, y: float, up: tuple[float, float]) -> Parts:
        return [(block((x - 0.002, y - 0.018, up[0]), (x + 0.035, y + 0.018, up[1]), 0.012), tinted(look, 0.72))]

    def recesses(x: float, y: float, up: tuple[float, float]) -> Parts:
        return [(block((x - 0.01, y - 0.016, up[0]), (x + 0.002, y + 0.016, up[1]), 0.001), _GASKET)]

    return (bars, moulded, recesses)[kind]


def _bar_grip(x: float, y: float, up: tuple[float, float], metal: Look) -> Parts:
    """An upright bar on two stand-offs."""
    low, high = up
    posts = [rod((x - 0.005, y, z), (x + 0.045, y, z), 0.008, segments=8) for z in (low + 0.04, high - 0.04)]
    return [(merge([rod((x + 0.045, y, low), (x + 0.045, y, high), 0.011, segments=10), *posts]), metal)]


def _notes(rng: Generator, x: float, wide: float, up: tuple[float, float]) -> Parts:
    """Papers and magnets on a door."""
    parts: Parts = []
    top = min(up[1] - 0.15, 1.55)
    for _ in range(int(rng.integers(2, 6))):
        across, tall = uniform(rng, 0.05, 0.13), uniform(rng, 0.06, 0.16)
        y, z = uniform(rng, -0.3, 0.22) * wide, uniform(rng, max(up[0] + 0.3, top - 0.5), top)
        lift = 0.001 + 0.0004 * len(parts)
        paper = posed(picture_plane(across, tall), about_x(uniform(rng, -0.12, 0.12)), (x + lift, y, z))
        look = plastic(pick(rng, _PAPERS), shine=0.0)
        magnet = block((x, y - 0.012, z + 0.4 * tall), (x + 0.008, y + 0.012, z + 0.4 * tall + 0.024), 0.003)
        parts += [(paper, look), (magnet, pick(rng, (DARK, plastic((0.7, 0.15, 0.12)))))]
    return parts


# Televisions ----------------------------------------------------------------------------------------------------------


def on_feet(rng: Generator, _: Palette) -> Piece:
    """A flat screen on two splayed feet near its ends."""
    wide, tall, lift = *_screen_size(rng), uniform(rng, 0.05, 0.08)
    parts = _set(rng, wide, tall, lift)
    reach = 0.10 + 0.04 * wide
    for y in (-0.36 * wide, 0.36 * wide):
        neck = (-0.005, y, lift + 0.03)
        for x in (-reach, reach):
            parts.append((bar(neck, (x, y, 0.006), 0.02, 0.012), _CASE))
            parts.append((box((x - 0.015, y - 0.01, 0.0), (x + 0.015, y + 0.01, 0.012)), _CASE))
    return piece("tv", "feet", parts)


def on_pedestal(rng: Generator, _: Palette) -> Piece:
    """A flat screen on a neck and a plate in the middle."""
    wide, tall, lift = *_screen_size(rng), uniform(rng, 0.06, 0.10)
    parts = _set(rng, wide, tall, lift)
    look, half = pick(rng, (_CASE, STEEL)), 0.2 * wide
    plate = [rounded_ring(0.22, 2 * half, 0.04, z, steps=4) for z in (0.0, 0.010)]
    parts += [(loft(plate), look), (block((-0.045, -0.06, 0.005), (-0.015, 0.06, lift + 0.12), 0.006), look)]
    return piece("tv", "pedestal", parts)


def on_wall(rng: Generator, _: Palette) -> Piece:
    """A flat screen without a stand, its back flush with the wall; z = 0 is its lower edge."""
    wide, tall = _screen_size(rng)
    return piece("tv", "wall", _set(rng, wide, tall, 0.0, bulge_m=0.03))


TVS: Makers = {"feet": on_feet, "pedestal": on_pedestal, "wall": on_wall}
"""Makers by style."""

_CASE = plastic((0.055, 0.055, 0.06), shine=0.4)


def _screen_size(rng: Generator) -> tuple[float, float]:
    """Width and height of a 16:9 screen of 32 to 60 inches."""
    diagonal = uniform(rng, 32, 60) * 0.0254
    return diagonal * 16 / math.hypot(16, 9), diagonal * 9 / math.hypot(16, 9)


def _set(rng: Generator, wide: float, tall: float, lift: float, *, bulge_m: float = 0.045) -> Parts:
    """Screen, frame, and the thicker housing of the electronics behind."""
    rim, chin = uniform(rng, 0.007, 0.012), uniform(rng, 0.012, 0.022)
    y, top = wide / 2 + rim, lift + chin + tall + rim
    frame = pick(rng, (_CASE, _CASE, _CASE, plastic((0.34, 0.34, 0.36), shine=0.5)))
    screen = Look("screen", ((0.03, 0.03, 0.04),), tile_m=1.0, shine=0.6, seed=int(rng.integers(8)))
    picture = moved(picture_plane(wide, tall), (0.0212, 0.0, lift + chin + tall / 2))
    low, high = (-bulge_m + 0.002, -0.36 * wide, lift + 0.03), (0.002, 0.36 * wide, lift + 0.62 * tall)
    badge = box((0.02, -0.02, lift + 0.3 * chin), (0.0215, 0.02, lift + 0.7 * chin))
    return [
        (block((0.0, -y, lift), (0.021, y, top), 0.004), frame),
        (picture, screen),
        (block(low, high, 0.012), _CASE),
        (badge, STEEL),
    ]


# Bins -----------------------------------------------------------------------------------------------------------------


def pedal_bin(rng: Generator, _: Palette) -> Piece:
    """A steel or enamelled cylinder with a domed lid, a black collar and a pedal."""
    radius, height = uniform(rng, 0.12, 0.17), uniform(rng, 0.40, 0.68)
    colours = ((0.92, 0.91, 0.88), (0.20, 0.20, 0.21), (0.60, 0.22, 0.18), (0.45, 0.55, 0.52))
    look = pick(rng, (STEEL, CHROME, STEEL, plastic(pick(rng, colours), shine=0.5)))
    wall = height - 0.30 * radius - 0.025
    body = lathe([(0, 0.02), (radius, 0.02), (radius, wall), (0, wall)], segments=28)
    dark = radius + 0.004
    base = lathe([(0, 0), (dark, 0), (dark, 0.035), (0, 0.035)], segments=28)
    collar = lathe([(0, wall), (dark, wall), (dark, wall + 0.025), (0, wall + 0.025)], segments=28)
    angles = np.linspace(0, math.pi / 2, 6)
    dome = np.column_stack([np.cos(angles) * radius, wall + 0.025 + np.sin(angles) * 0.30 * radius])
    lid = lathe(np.vstack([[(0, wall + 0.025)], dome]), segments=28)
    pedal = block((radius - 0.02, -0.045, 0.008), (radius + 0.055, 0.045, 0.022), 0.005)
    hinge = block((-radius - 0.02, -0.05, wall - 0.03), (-radius + 0.02, 0.05, wall + 0.035), 0.008)
    return piece(
        "bin", "pedal", [(body, look), (lid, look), (base, DARK), (collar, DARK), (pedal, DARK), (hinge, DARK)]
    )


def swing_bin(rng: Generator, _: Palette) -> Piece:
    """A tapered plastic body under a hood with a swinging flap."""
    deep, wide, height = uniform(rng, 0.22, 0.28), uniform(rng, 0.27, 0.36), uniform(rng, 0.5, 0.72)
    colour = pick(rng, ((0.90, 0.90, 0.88), (0.58, 0.60, 0.62), (0.22, 0.23, 0.25), (0.42, 0.52, 0.56)))
    hood_colour = pick(rng, ((0.20, 0.21, 0.23), (0.85, 0.85, 0.84), (0.45, 0.47, 0.50)))
    body, hood = plastic(colour), plastic(hood_colour)
    wall = 0.72 * height
    taper = ((0.82, 0.0), (0.84, 0.02), (1.0, wall))
    parts: Parts = [(loft([rounded_ring(deep * s, wide * s, 0.05, z, steps=4) for s, z in taper]), body)]
    sizes = ((1.05, wall - 0.015), (1.05, wall + 0.012), (1.0, wall + 0.03), (0.72, height - 0.015), (0.62, height))
    rings = [rounded_ring(deep * s, wide * (s if s > 0.99 else 0.5 + s / 2), 0.05, z, steps=4) for s, z in sizes]
    parts.append((loft(rings), hood))
    slope = math.atan2(0.14 * deep, height - 0.045 - wall)
    flap = block((-0.004, -0.36 * wide, 0.0), (0.006, 0.36 * wide, 0.8 * (height - wall - 0.045)), 0.004)
    start = (deep / 2 * 0.985, 0.0, wall + 0.038)
    return piece("bin", "swing", [*parts, (posed(flap, about_y(-slope), start), tinted(hood, 0.72))])


def paper_basket(rng: Generator, palette: Palette) -> Piece:
    """An open cone of plastic, felt or steel, with crumpled paper in it."""
    radius, height = uniform(rng, 0.12, 0.16), uniform(rng, 0.26, 0.36)
    looks = (BLACK_STEEL, plastic((0.80, 0.80, 0.79)), palette.fabric, plastic((0.28, 0.38, 0.48)), palette.wood)
    look = pick(rng, looks)
    parts: Parts = [(shell([(0.76 * radius, 0.0), (radius, height)], 0.005, segments=28), look)]
    parts.append((lathe([(0, 0.004), (0.75 * radius, 0.004), (0.75 * radius, 0.012), (0, 0.012)], segments=28), look))
    rim = shell([(radius + 0.004, height - 0.016), (radius + 0.004, height)], 0.010, segments=28)
    return piece("bin", "basket", [*parts, (rim, tinted(look, 0.8)), *_crumpled(rng, 0.84 * radius, 0.7 * height)])


def wire_basket(rng: Generator, _: Palette) -> Piece:
    """An open cone of wires and hoops with a liner."""
    radius, height = uniform(rng, 0.13, 0.16), uniform(rng, 0.28, 0.38)
    wire, low = pick(rng, (BLACK_STEEL, CHROME, _WHITE_WIRE)), 0.72 * radius
    parts: Parts = []
    for k in range(24):
        angle = 2 * math.pi * k / 24
        x, y = math.cos(angle), math.sin(angle)
        parts.append((rod((low * x, low * y, 0.003), (radius * x, radius * y, height), 0.0025, segments=4), wire))
    for share in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
        ring, z, thick = low + (radius - low) * share, share * (height - 0.012), 0.012 if share == 1 else 0.006
        parts.append((shell([(ring + 0.003, z), (ring + 0.003, z + thick)], 0.006, segments=24), wire))
    liner = [(0, 0.006), (low - 0.006, 0.006), (radius - 0.012, 0.82 * height), (radius - 0.02, 0.82 * height)]
    liner += [(low - 0.012, 0.03), (0, 0.03)]
    parts.append((lathe(liner, segments=20), plastic((0.87, 0.87, 0.85), shine=0.2)))
    return piece("bin", "wire", [*parts, *_crumpled(rng, 0.7 * radius, 0.55 * height)])


def wicker_basket(rng: Generator, palette: Palette) -> Piece:
    """A round basket with a braided rim, open or with a lid."""
    radius, height = uniform(rng, 0.15, 0.2), uniform(rng, 0.36, 0.58)
    look = wicker(rng)
    line = [(0.82 * radius, 0.0), (0.95 * radius, 0.3 * height), (radius, 0.7 * height), (0.97 * radius, height - 0.02)]
    parts: Parts = [(shell(line, 0.012, segments=28), look), (_torus(0.97 * radius, 0.014, height - 0.02), look)]
    parts.append((_torus(0.82 * radius, 0.012, 0.012), look))
    if chance(rng, 0.5):
        lid = [(0, height - 0.015), (0.98 * radius, height - 0.015), (0.98 * radius, height + 0.01), (0, height + 0.05)]
        grip = lathe([(0, 0), (0.012, 0), (0.022, 0.025), (0, 0.035)], segments=10)
        parts += [(lathe(lid, segments=28), look), (moved(grip, (0, 0, height + 0.046)), palette.wood)]
    else:
        floor = lathe([(0, 0.02), (0.8 * radius, 0.02), (0.8 * radius, 0.03), (0, 0.03)], segments=20)
        parts += [(floor, tinted(look, 0.5)), *_crumpled(rng, 0.8 * radius, 0.5 * height)]
    return piece("bin", "wicker", parts)


BINS: Makers = {
    "pedal": pedal_bin,
    "swing": swing_bin,
    "basket": paper_basket,
    "wire": wire_basket,
    "wicker": wicker_basket,
}
"""Makers by style."""

_WHITE_WIRE = plastic((0.90, 0.90, 0.88), shine=0.4)
_PAPER = plastic((0.93, 0.92, 0.89), shine=0.0)


def _torus(radius: float, thick: float, z: float) -> Mesh:
    """A ring about the z axis."""
    turn = np.linspace(-math.pi, math.pi, 8)
    return lathe(np.column_stack([radius + thick * np.cos(turn), z + thick * np.sin(turn)]), segments=28)


def _crumpled(rng: Generator, radius: float, level: float) -> Parts:
    """Balls of paper up to about a height."""
    parts: Parts = []
    for k in range(5):
        size, angle = uniform(rng, 0.032, 0.045), 1.3 * k + uniform(rng, 0, 0.5)
        away = max(0.0, radius - size) * (0.0 if k == 4 else 0.75)
        angles = np.linspace(-math.pi / 2, math.pi / 2, 5)
        rough = np.array([uniform(rng, 0.75, 1.0) for _ in angles])
        profile = np.column_stack([np.cos(angles) * rough, np.sin(angles)]) * size
        profile[[0, -1], 0] = 0.0
        paper = lathe(profile, segments=6)
        place = (away * math.cos(angle), away * math.sin(angle), level + (0.5 * size if k == 4 else 0.0))
        parts.append((posed(paper, about_x(uniform(rng, -1, 1)), place), _PAPER))
    return parts


# Toilets --------------------------------------------------------------------------------------------------------------


def closed(rng: Generator, _: Palette) -> Piece:
    """A bowl on a foot with a cistern on it, lid down."""
    return _close_coupled(rng, "closed", open_lid=False)


def opened(rng: Generator, _: Palette) -> Piece:
    """A bowl on a foot with a cistern on it, lid up."""
    return _close_coupled(rng, "open", open_lid=True)


def monobloc(rng: Generator, _: Palette) -> Piece:
    """A modern one: bowl and cistern flow into each other, sides go straight down to the floor."""
    bowl, rim = _Bowl(uniform(rng, 0.35, 0.39), 0.19, 0.182), uniform(rng, 0.38, 0.41)
    skirt = ((0.80, 0.66, 0.0), (0.81, 0.67, 0.04), (0.88, 0.78, 0.2), (0.99, 0.98, rim - 0.06), (0.99, 0.99, rim))
    parts: Parts = [(loft([bowl.ring(z, along, across) for along, across, z in skirt]), _CHINA)]
    parts += _lidded(bowl, rim, 0.0, _CHINA)
    top, back = uniform(rng, 0.68, 0.76), -bowl.back + 0.04
    sizes = ((0.15, 0.33, rim - 0.12), (0.17, 0.36, rim + 0.05), (0.18, 0.38, top - 0.04), (0.19, 0.39, top))
    tank = loft([rounded_ring(d, w, 0.06, z, steps=5) + (back - d / 2 - 0.01, 0, 0) for d, w, z in sizes])
    cover = [
        rounded_ring(d, 2 * d + 0.015, 0.06, z, steps=5)
        for d, z in ((0.195, top), (0.195, top + 0.016), (0.18, top + 0.024))
    ]
    parts += [(tank, _CHINA), (moved(loft(cover), (back - 0.105, 0, 0)), _CHINA)]
    parts.append((moved(_button(), (back - 0.105, 0, top + 0.022)), CHROME))
    return piece("toilet", "monobloc", parts)


def wall_hung(rng: Generator, palette: Palette) -> Piece:
    """A bowl that hangs from a boxed-in cistern with a flush plate; lid up or down."""
    bowl, rim = _Bowl(0.36, 0.20, 0.18), uniform(rng, 0.40, 0.43)
    below = (
        (0.02, 0.02, 0.128),
        (0.62, 0.60, 0.13),
        (0.80, 0.80, 0.18),
        (0.95, 0.96, 0.28),
        (1.0, 1.0, rim - 0.02),
        (0.99, 0.99, rim),
    )
    sides = [bowl.ring(z, along, across, anchored=True) for along, across, z in below]
    open_lid, depth, top, y = chance(rng, 0.4), 0.16, uniform(rng, 1.1, 1.2), uniform(rng, 0.25, 0.45)
    parts: Parts = [(skin(sides) if open_lid else loft(sides), _CHINA)]
    parts += _lidded(bowl, rim, 1.62 if open_lid else 0.0, _SEAT)
    wall = -bowl.back
    panel = pick(
        rng, (Look("tiles", ((0.86, 0.86, 0.84), (0.70, 0.70, 0.68)), tile_m=0.6, shine=0.5), _CHINA, palette.body)
    )
    parts.append((block((wall - depth, -y, 0), (wall, y, top), 0.004), panel))
    parts.append((block((wall - depth - 0.004, -y - 0.004, top), (wall + 0.012, y + 0.004, top + 0.02)), palette.wood))
    plate, z = pick(rng, (CHROME, WHITE, BLACK_STEEL)), top - 0.19
    parts.append((block((wall, -0.12, z), (wall + 0.012, 0.12, z + 0.16), 0.004), plate))
    for low, high in ((-0.095, -0.01), (0.0, 0.095)):
        parts.append((block((wall, low, z + 0.03), (wall + 0.016, high, z + 0.13), 0.003), tinted(plate, 0.9)))
    return piece("toilet", "wall_hung", parts)


TOILETS: Makers = {"closed": closed, "open": opened, "monobloc": monobloc, "wall_hung": wall_hung}
"""Makers by style."""

_CHINA = Look("plain", ((0.95, 0.95, 0.94),), shine=0.8)
_SEAT = Look("plain", ((0.92, 0.92, 0.90),), shine=0.5)
_WATER = Look("plain", ((0.62, 0.70, 0.74),), shine=0.9)


@dataclasses.dataclass(frozen=True)
class _Bowl:
    """The outline of a bowl: long and round in front, square behind; metres from its middle."""

    front: float
    back: float
    half: float

    def ring(self, z: float, along: float = 1.0, across: float = 1.0, *, anchored: bool = False) -> Array:
        """(M, 3) its outline at a height; `anchored` shrinks the front only, the back stays at the wall."""
        angles = np.arange(28) * 2 * np.pi / 28
        cos, sin = np.cos(angles), np.sin(angles)
        square = np.where(cos < 0, 0.55, 1.0)
        x = np.where(cos > 0, self.front * along, self.back * (1.0 if anchored else along))
        ring = [np.sign(cos) * np.abs(cos) ** square * x, np.sign(sin) * np.abs(sin) ** square * self.half * across]
        return np.column_stack([*ring, np.full(28, z)])


def _close_coupled(rng: Generator, style: str, *, open_lid: bool) -> Piece:
    bowl, rim = _Bowl(uniform(rng, 0.32, 0.36), 0.15, uniform(rng, 0.175, 0.19)), uniform(rng, 0.38, 0.41)
    below = [(0.55, 0.60, 0.0), (0.56, 0.62, 0.03), (0.50, 0.54, 0.12), (0.58, 0.58, 0.22)]
    below += [(0.86, 0.84, 0.31), (0.98, 0.98, rim - 0.035), (1.0, 1.0, rim - 0.015), (0.99, 0.99, rim)]
    top, wide = uniform(rng, 0.74, 0.82), uniform(rng, 0.37, 0.44)
    deep = uniform(rng, 0.17, 0.2)
    back = -bowl.back - 0.015
    sides = [bowl.ring(z, along, across) for along, across, z in below]
    parts: Parts = [(skin(sides) if open_lid else loft(sides), _CHINA)]  # an end would close the open bowl
    shelf = [rounded_ring(d, w, 0.05, z) for d, w, z in ((0.20, 0.2, 0.2), (0.26, 0.3, rim - 0.03), (0.27, 0.32, rim))]
    foot = [rounded_ring(d, w, 0.04, z) for d, w, z in ((0.30, 0.19, 0.0), (0.28, 0.17, 0.15), (0.25, 0.2, 0.3))]
    parts += [(moved(loft(shelf), (back - 0.05, 0, 0)), _CHINA), (moved(loft(foot), (back, 0, 0)), _CHINA)]
    sizes = ((0.88 * deep, 0.90 * wide, rim), (0.95 * deep, 0.96 * wide, rim + 0.08), (deep, wide, top - 0.035))
    tank = [rounded_ring(d, w, 0.045, z, steps=4) for d, w, z in sizes]
    cover = [(1.06, top - 0.035), (1.07, top - 0.012), (1.0, top - 0.002), (0.9, top)]
    lid = [rounded_ring(deep * s, wide + deep * (s - 1), 0.05, z, steps=4) for s, z in cover]
    middle = back - deep / 2
    parts += [(moved(loft(tank), (middle, 0, 0)), _CHINA), (moved(loft(lid), (middle, 0, 0)), _CHINA)]
    if chance(rng, 0.6):
        parts.append((moved(_button(), (middle, 0, top - 0.002)), CHROME))
    else:
        lever = tube([(0, 0, 0), (0.025, 0, 0), (0.03, 0.07, -0.012)], 0.007, segments=8)
        parts.append((moved(lever, (middle + deep / 2, -0.4 * wide, top - 0.09)), CHROME))
    return piece("toilet", style, [*parts, *_lidded(bowl, rim, 1.60 if open_lid else 0.0, _SEAT)])


def _lidded(bowl: _Bowl, rim: float, lid_rad: float, look: Look) -> Parts:
    """Seat and lid on a bowl; an open lid shows the inside of the bowl."""
    hinge = (-bowl.back * 0.86, 0.0, rim + 0.028)
    parts: Parts = [(rod((hinge[0], -0.09, hinge[2]), (hinge[0], 0.09, hinge[2]), 0.012, segments=10), look)]
    outer, inner = (1.02, 1.02), (0.70, 0.66)
    shape = [
        (*outer, 0.002),
        (1.03, 1.03, 0.011),
        (*outer, 0.02),
        (0.86, 0.84, 0.023),
        (*inner, 0.018),
        (*inner, 0.004),
    ]
    seat = skin([bowl.ring(rim + z, along, across) for along, across, z in shape])
    lid_rings = ((1.0, 1.0, 0.024), (1.03, 1.03, 0.028), (1.03, 1.03, 0.036), (0.98, 0.98, 0.043), (0.6, 0.6, 0.048))
    lid = loft([bowl.ring(rim + z, along, across) for along, across, z in lid_rings])
    if lid_rad:
        lid = _swung(lid, hinge, lid_rad)
        hole = ((0.72, 0.68, 0.006), (0.66, 0.62, -0.05), (0.45, 0.42, -0.15), (0.3, 0.3, -0.17))
        bowl_inside = skin([bowl.ring(rim + z, along, across) for along, across, z in hole])
        water = loft([bowl.ring(rim + z, 0.47, 0.45) for z in (-0.145, -0.14)])
        parts += [(bowl_inside, tinted(look, 0.9)), (water, _WATER)]
    shadow = skin([bowl.ring(rim + z, 0.985, 0.98) for z in (-0.002, 0.006)])
    return [*parts, (seat, look), (lid, look), (shadow, tinted(look, 0.35))]


def _swung(mesh: Mesh, hinge: Vector, angle_rad: float) -> Mesh:
    """The mesh turned up about a level axis along y."""
    turn = about_y(-angle_rad)
    return posed(mesh, turn, np.asarray(hinge) - turn @ np.asarray(hinge))


def _button() -> Mesh:
    return lathe([(0, 0), (0.026, 0), (0.026, 0.005), (0.022, 0.008), (0, 0.008)], segments=18)
