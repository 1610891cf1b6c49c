"""Homes and cameras in settings that training never uses, to see what of a model's skill was the setting.

The geometry stays: every object keeps its place, shape and instance. Surfaces change colour (hue turned, saturation and
brightness changed) and material (wood is painted and paint becomes wood; walls and floors swap patterns), the lights
become one of four that `lighting.py` never draws, and the camera rides higher, looks further down and sees less.
"""

from __future__ import annotations

import colorsys
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semslam.geometry.camera import Camera
from semslam.sim.home import LIGHTS, Colour, Fixture, Home, Light, Look, Part, Piece, Vector
from semslam.sim.vehicle import RobotSpec

HEIGHT_M, PITCH_DEG, FIELD_DEG = (0.9, 1.3), (20.0, 30.0), (40.0, 47.0)
"""Camera height, how far its nose is down, field of view across. Training has 0.3 to 0.75 m, 0 to 20 degrees, and 70 to
95 degrees, by zooming in from 48 on."""

_WALLS = ("paint", "plaster", "stripes", "damask", "floral", "lattice", "dots", "brick", "planks", "tiles", "fabric")
_FLOORS = ("planks", "parquet", "tiles", "checker", "carpet", "brick", "marble", "wicker")
_CLOTHS = ("fabric", "leather", "plaid", "dots", "stripes", "floral")
_OTHER_MATERIAL = {
    "wood": ("paint", "paint", "marble"),
    "paint": ("wood", "wood", "metal"),
    "metal": ("paint",),
    "plaster": ("wicker", "marble"),
    "wicker": ("wood", "fabric"),
    "marble": ("wood", "paint"),
    "quilt": ("plaid", "floral"),
    "carpet": ("plaid", "rug"),
    "rug": ("stripes", "carpet"),
    **dict.fromkeys(_CLOTHS, _CLOTHS),
}
"""What a surface that is neither wall nor floor may become; other patterns stay what they are."""
_SMOOTH = {"paint": ("metal", "plain"), "metal": ("paint",)}
"""The same for things that a person knows by being smooth: a refrigerator of wood is a wardrobe."""
_SMOOTH_CLASSES = ("refrigerator", "toilet", "tv")
_GREY = 0.12
"""Colours less saturated than this are grey: turning their hue changes nothing, so they are tinted."""
_BULB_GLOW = 0.8
"""What glows more is a bulb and keeps its colour."""


@dataclass(frozen=True)
class _Taste:
    """How a home's colours change; every look varies it a little."""

    seed: int
    furniture_turn: float
    """Of the hue, in turns: 0.25 to 0.75."""
    building_turn: float

    def rng(self, look: Look) -> np.random.Generator:
        """Randomness of one look: the same look changes alike wherever it occurs."""
        return np.random.default_rng([self.seed, 0xE57, zlib.crc32(repr(look).encode())])


def estranged(home: Home, seed: int) -> Home:
    """The same home with other lights, colours and materials; the same seed gives the same ones.

    Args:
        seed: of colours and materials; its remainder by four chooses the lights.
    """
    rng = np.random.default_rng([seed, 0xE57])
    taste = _Taste(seed, float(rng.uniform(0.25, 0.75)), float(rng.uniform(0.25, 0.75)))
    objects = tuple(replace(item, piece=_other_piece(item.piece, taste)) for item in home.objects)
    fixtures = tuple(_other_fixture(item, taste) for item in home.fixtures)
    walker = home.walker and replace(home.walker, piece=_other_piece(home.walker.piece, taste))
    return replace(home, objects=objects, fixtures=fixtures, walker=walker, lights=_other_lights(home, seed, rng))


def unfamiliar_camera(rng: np.random.Generator, width: int = 640, height: int = 480) -> tuple[RobotSpec, Camera]:
    """Where a camera sits that training never had, and its lens."""
    rise, pitch, field = (float(rng.uniform(*limits)) for limits in (HEIGHT_M, PITCH_DEG, FIELD_DEG))
    focal_px = width / 2 / math.tan(math.radians(field) / 2)
    lens = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    return RobotSpec(rise, math.radians(pitch), float(rng.uniform(0.0, 0.06))), lens


# --------------------------------------------------------------------------------------------- colours and materials


def _other_piece(piece: Piece, taste: _Taste) -> Piece:
    materials = _SMOOTH if piece.class_name in _SMOOTH_CLASSES else _OTHER_MATERIAL

    def change(look: Look) -> Look:
        rng = taste.rng(look)
        return _recoloured(_remade(look, materials.get(look.pattern, ()), rng), taste.furniture_turn, rng)

    return replace(piece, parts=tuple(Part(part.mesh, change(part.look)) for part in piece.parts))


def _other_fixture(fixture: Fixture, taste: _Taste) -> Fixture:
    def change(look: Look) -> Look:
        rng = taste.rng(look)
        return _recoloured(_remade(look, _patterns_for(fixture.kind, look), rng), taste.building_turn, rng)

    return replace(fixture, parts=tuple(Part(part.mesh, change(part.look)) for part in fixture.parts))


def _patterns_for(kind: str, look: Look) -> tuple[str, ...]:
    if kind in ("wall", "panelling"):
        return _WALLS
    if kind == "floor":
        return _FLOORS
    return () if kind == "ceiling" else _OTHER_MATERIAL.get(look.pattern, ())


def _remade(look: Look, patterns: tuple[str, ...], rng: np.random.Generator) -> Look:
    """The look with another of the patterns, or as it is if there is no other."""
    others = [name for name in patterns if name != look.pattern]
    if not others:
        return replace(look, seed=look.seed + 100)
    shine = look.shine if look.shine else float(rng.choice([0.0, 0.2]))
    return replace(look, pattern=others[int(rng.integers(len(others)))], shine=shine, seed=look.seed + 100)


def _recoloured(look: Look, turn: float, rng: np.random.Generator) -> Look:
    """Another hue, saturation and brightness, the same for all colours of a look so that its contrast stays."""
    if look.glow > _BULB_GLOW:
        return look
    reach = 0.18 if look.pattern == "foliage" else 1.0  # leaves may be red or bluish, but not sky blue
    turned = (turn - 0.5) * reach if reach < 1 else turn + float(rng.uniform(-0.15, 0.15))
    tint, richer = float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.6, 1.6))
    gamma = math.exp(float(rng.uniform(-0.7, 0.6)))
    colours = tuple(_other_colour(colour, turned, tint, richer, gamma) for colour in look.colours)
    return replace(look, colours=colours)


def _other_colour(colour: Colour, turn: float, tint: float, richer: float, gamma: float) -> Colour:
    hue, saturation, value = colorsys.rgb_to_hsv(*(min(1.0, channel) for channel in colour))
    saturation = tint if saturation < _GREY else min(0.9, saturation * richer)
    return colorsys.hsv_to_rgb((hue + turn) % 1.0, saturation, value**gamma)


# --------------------------------------------------------------------------------------------------------- the lights


def _other_lights(home: Home, seed: int, rng: np.random.Generator) -> tuple[Light, ...]:
    setting = _SETTINGS[seed % len(_SETTINGS)]
    lights = setting(home, rng)
    return tuple([*lights, *[_sun((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))] * LIGHTS][:LIGHTS])


def _evening(home: Home, rng: np.random.Generator) -> list[Light]:
    """One warm lamp on a low table; dim ones in other rooms."""
    x, y = np.add(home.start, rng.uniform(-0.15, 0.15, 2)).tolist()
    warm = (0.80, 0.52, 0.24)
    return [_lamp((x, y, float(rng.uniform(1.0, 1.3))), warm, shadow=True), *_in_other_rooms(home, (0.30, 0.20, 0.10))]


def _dull(home: Home, rng: np.random.Generator) -> list[Light]:
    """Nothing but cold, nearly level light from one side."""
    yaw = _daylight_yaw(home, rng) + float(rng.choice([-1.0, 1.0])) * math.pi / 2
    return [_sun(_direction(yaw, 0.15), (0.34, 0.46, 0.62))]


def _noon(home: Home, rng: np.random.Generator) -> list[Light]:
    """Strong sun through the other side, blue light from above, no lamp."""
    yaw = _daylight_yaw(home, rng) + math.pi
    return [_sun(_direction(yaw, 0.55), (0.85, 0.78, 0.62)), _sun((0.0, 0.0, -1.0), (0.04, 0.06, 0.12))]


def _coloured(home: Home, rng: np.random.Generator) -> list[Light]:
    """Lamps of strong colours on opposite sides, below eye level."""
    x0, y0, x1, y1 = home.bounds
    away = np.array([x1 - x0, y1 - y0]) * 0.2
    sides = [np.add(home.start, away), np.subtract(home.start, away)]
    colours: tuple[Colour, ...] = ((0.70, 0.25, 0.50), (0.20, 0.50, 0.60))
    order = int(rng.integers(2))
    return [_lamp((float(x), float(y), 1.5), colours[(k + order) % 2], shadow=k == 0) for k, (x, y) in enumerate(sides)]


_SETTINGS: tuple[Callable[[Home, np.random.Generator], list[Light]], ...] = (_evening, _dull, _noon, _coloured)


def _in_other_rooms(home: Home, colour: Colour) -> list[Light]:
    middles = [np.add(room.low, room.high) / 2 for room in home.rooms if not _within(home.start, room.low, room.high)]
    return [_lamp((float(x), float(y), 1.4), colour) for x, y in middles]


def _within(place: tuple[float, float], low: tuple[float, float], high: tuple[float, float]) -> bool:
    return all(a <= value <= b for value, a, b in zip(place, low, high, strict=True))


def _daylight_yaw(home: Home, rng: np.random.Generator) -> float:
    """Where the home's own daylight shines to, radians; anywhere if it has none."""
    for light in home.lights:
        if light.kind == "sun" and max(light.colour) > 0 and math.hypot(*light.direction[:2]) > 0.1:
            return math.atan2(light.direction[1], light.direction[0])
    return float(rng.uniform(-math.pi, math.pi))


def _direction(yaw_rad: float, down: float) -> Vector:
    level = math.sqrt(1 - down**2)
    return math.cos(yaw_rad) * level, math.sin(yaw_rad) * level, -down


def _sun(direction: Vector, colour: Colour) -> Light:
    return Light("sun", (0.0, 0.0, 2.5), direction, colour)


def _lamp(position: Vector, colour: Colour, *, shadow: bool = False) -> Light:
    return Light("point", position, (0.0, 0.0, -1.0), colour, shadow, (1.0, 0.0, 0.03))
