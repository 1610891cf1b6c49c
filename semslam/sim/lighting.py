"""The four lights of a home: lamps under the ceiling and daylight from the side of the windows.

Together with the renderer's ambient third they bring a wall to about its own colour.
"""

from __future__ import annotations

import math

import numpy as np

from semslam.sim.home import LIGHTS, Colour, Light
from semslam.sim.shell import Shell

_BELOW_CEILING_M = 0.35
_FADE = (1.0, 0.0, 0.022)
"""Half as bright at 6.7 m."""


def lights_of(shell: Shell, seed: int, *, twins: bool = False) -> tuple[Light, ...]:
    """One lamp in every room, more in a single room, and daylight if one of the four lights is left; one lamp casts
    shadows.
    """
    rng = np.random.default_rng([seed, 0x11A7])
    if twins:
        return _twin_lights(shell, rng)
    if len(shell.rooms) == 1:
        return _one_room(shell, rng)
    middles = [np.add(room.low, room.high) / 2 + rng.uniform(-0.4, 0.4, 2) for room in shell.rooms]
    strength = {2: 0.40, 3: 0.36, 4: 0.36}[len(middles)]
    lamps = [_lamp(shell, m, _tint(rng), strength, shadow=k == 0) for k, m in enumerate(middles)]
    daylight = _daylight(shell, rng, 0.16)
    return tuple([*lamps, daylight, _off()][:LIGHTS]) if len(lamps) < LIGHTS else tuple(lamps)


def _one_room(shell: Shell, rng: np.random.Generator) -> tuple[Light, ...]:
    (low, high), warm = (shell.rooms[0].low, shell.rooms[0].high), _tint(rng)
    angle = float(rng.uniform(0, 2 * math.pi))
    way = np.array([math.cos(angle), math.sin(angle)])
    reach = np.subtract(high, low).min() / 2
    main = way * reach * float(rng.uniform(0.1, 0.35))
    second = -way * reach * float(rng.uniform(0.4, 0.6))
    third = np.array([-way[1], way[0]]) * reach * float(rng.uniform(0.4, 0.6))
    return (
        _lamp(shell, main, warm, 0.34, shadow=True),
        _lamp(shell, second, _tint(rng), 0.19),
        _lamp(shell, third, warm, 0.15),
        _daylight(shell, rng, 0.16),
    )


def _twin_lights(shell: Shell, rng: np.random.Generator) -> tuple[Light, ...]:
    """The same after half a turn: a lamp in the middle, two opposite ones, light from straight above."""
    tint, angle = _tint(rng), float(rng.uniform(0, 2 * math.pi))
    out = np.array([math.cos(angle), math.sin(angle)]) * float(rng.uniform(2.0, 3.0))
    above = Light("sun", (0.0, 0.0, shell.height_m), (0.0, 0.0, -1.0), (0.10, 0.10, 0.10))
    return (
        _lamp(shell, np.zeros(2), tint, 0.34, shadow=True),
        _lamp(shell, out, tint, 0.17),
        _lamp(shell, -out, tint, 0.17),
        above,
    )


def _lamp(shell: Shell, place: np.ndarray, tint: Colour, strength: float, *, shadow: bool = False) -> Light:
    x, y = float(place[0]), float(place[1])
    red, green, blue = (strength * 1.3 * value for value in tint)
    where = (x, y, shell.height_m - _BELOW_CEILING_M)
    return Light("point", where, (0.0, 0.0, -1.0), (red, green, blue), shadow, _FADE)


def _daylight(shell: Shell, rng: np.random.Generator, strength: float) -> Light:
    """From the side of the first window, tilted; it casts no shadow, for the walls would keep all of it out."""
    bright = [side for side in shell.sides if any(o.kind == "window" for o in side.openings)]
    yaw = (bright[0].yaw_rad if bright else 0.0) + float(rng.uniform(-0.5, 0.5))
    down = float(rng.uniform(0.5, 0.8))
    direction = (math.cos(yaw) * math.sqrt(1 - down**2), math.sin(yaw) * math.sqrt(1 - down**2), -down)
    colour = (strength * 0.95, strength, strength * 1.08)
    return Light("sun", (0.0, 0.0, shell.height_m), direction, colour)


def _off() -> Light:
    return Light("sun", (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0))


def _tint(rng: np.random.Generator) -> Colour:
    """Warm to neutral white."""
    warmth = float(rng.uniform(0, 1))
    return 1.0 + 0.03 * warmth, 1.0 - 0.02 * warmth, 1.0 - 0.14 * warmth
