"""Somebody who walks to and fro through a home, where there is room for them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from semslam.sim.home import Array, Piece, Walker
from semslam.sim.polygons import closer, rectangle_at, touches

BODY_M = 0.25
"""Half the width of a person."""
KEEP_M = 0.36
"""From their side to furniture and walls."""
STRIP_M = 0.45
"""Half the width of the strip of floor that a robot must leave to them."""


def draw_walk(
    blocked: Sequence[Array],
    start: tuple[float, float],
    person: Piece,
    instance: int,
    rng: np.random.Generator,
    outline: Sequence[Array],
) -> Walker | None:
    """The longest of some free straight walks that can be seen from the middle of the home; None if there is none."""
    best, longest = None, 2.0
    low = np.min([polygon.min(0) for polygon in outline], axis=0) + 0.7
    high = np.max([polygon.max(0) for polygon in outline], axis=0) - 0.7
    for _ in range(400):
        first, heading, length = (
            rng.uniform(low, high),
            float(rng.uniform(0, 2 * math.pi)),
            float(rng.uniform(2.0, 4.2)),
        )
        last = first + length * np.array([math.cos(heading), math.sin(heading)])
        if length <= longest or np.any(last < low) or np.any(last > high):
            continue
        if _free(first, last, blocked, start) and _in_view(first, last, blocked):
            best, longest = (first, last), length
    if best is None:
        return None
    (x0, y0), (x1, y1) = best
    speed = float(rng.uniform(0.5, 1.0))
    return Walker(instance, person, (float(x0), float(y0)), (float(x1), float(y1)), speed, float(rng.uniform(0, 10)))


def strip_of(walker: Walker) -> Array:
    """(4, 2) the floor that a walker needs, with a margin."""
    return _corridor(np.asarray(walker.start), np.asarray(walker.end), STRIP_M)


def _corridor(first: Array, last: Array, margin_m: float) -> Array:
    along, middle = last - first, (first + last) / 2
    length = float(np.hypot(*along)) + 2 * margin_m
    return rectangle_at(float(middle[0]), float(middle[1]), length, 2 * margin_m, math.atan2(along[1], along[0]))


def _free(first: Array, last: Array, blocked: Sequence[Array], start: tuple[float, float]) -> bool:
    way = _corridor(first, last, BODY_M + KEEP_M)
    if closer(_corridor(first, last, STRIP_M + 0.55), np.array([start, start, start]), 0.0):
        return False
    return not touches([way], blocked)


def _in_view(first: Array, last: Array, blocked: Sequence[Array]) -> bool:
    """True if most of the walk is seen from the middle, over the floor plan."""
    places = first + np.linspace(0, 1, 7)[:, None] * (last - first)
    seen = sum(not touches([_line(place)], blocked) for place in places)
    return seen >= 3 and float(np.linalg.norm(places, axis=1).min()) < 3.5


def _line(place: Array) -> Array:
    """From the middle of the home to a place, as a thin outline."""
    aside = np.array([-place[1], place[0]]) / max(float(np.hypot(*place)), 1e-9) * 0.01
    return np.array([aside, -aside, place - aside, place + aside])
