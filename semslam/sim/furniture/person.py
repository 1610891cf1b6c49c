"""People: adults who stand or walk, in the proportions of a grown-up, dressed for the house."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import ACCENTS, FABRICS, chance, darker, pick, piece, uniform
from semslam.sim.furniture.forms import curve, loft, plump, superellipse, warped
from semslam.sim.home import Array, Colour, Look, Mesh, Piece
from semslam.sim.shapes import ball, merge, moved, posed, tube

_SKINS: tuple[Colour, ...] = ((0.90, 0.74, 0.63), (0.82, 0.63, 0.50), (0.66, 0.47, 0.35), (0.46, 0.31, 0.22))
_HAIRS: tuple[Colour, ...] = (
    (0.12, 0.09, 0.07),
    (0.26, 0.17, 0.10),
    (0.42, 0.29, 0.16),
    (0.66, 0.52, 0.32),
    (0.55, 0.54, 0.53),
)
_TROUSERS: tuple[Colour, ...] = (
    (0.17, 0.22, 0.33),
    (0.24, 0.30, 0.42),
    (0.14, 0.14, 0.15),
    (0.36, 0.33, 0.29),
    (0.55, 0.48, 0.38),
)
_SHOES: tuple[Colour, ...] = ((0.10, 0.09, 0.09), (0.30, 0.19, 0.12), (0.86, 0.85, 0.83))

_Part = tuple[Mesh, Look]


@dataclass(frozen=True)
class _Body:
    """Sizes in metres, and how far the legs and arms swing."""

    tall: float
    stout: float
    """1 is usual."""
    stride: float
    """From the middle to the forward foot."""
    swing: float
    """From the shoulder forwards to the hand."""

    def __call__(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """A place given as shares of the height."""
        return x * self.tall, y * self.tall, z * self.tall


def make_person(rng: Generator) -> Piece:
    """Draw a standing or walking adult, facing +x."""
    walks = chance(rng, 0.7)
    body = _Body(
        tall=uniform(rng, 1.60, 1.86),
        stout=uniform(rng, 0.94, 1.14),
        stride=uniform(rng, 0.13, 0.2) if walks else 0.02,
        swing=uniform(rng, 0.07, 0.13) if walks else 0.015,
    )
    skin, hair = Look("plain", (pick(rng, _SKINS),), shine=0.1), _cloth(pick(rng, _HAIRS))
    shirt, trousers = _cloth(pick(rng, (*ACCENTS, *FABRICS))), _cloth(pick(rng, _TROUSERS))
    shoes = Look("plain", (pick(rng, _SHOES),), shine=0.2)
    parts: list[_Part] = [(_torso(body), shirt), (_hips(body), trousers), *_head(rng, body, skin, hair)]
    for side in (1.0, -1.0):
        parts += _leg(body, side, trousers, shoes)
        parts += _arm(body, side, shirt, skin)
    return piece("person", "walking" if walks else "standing", parts)


def _cloth(colour: Colour) -> Look:
    return Look("fabric", (colour, darker(colour, 0.82)), tile_m=0.3)


def _stack(body: _Body, rings: list[tuple[float, float, float, float]]) -> Mesh:
    """A trunk of rounded sections: height, depth, width and place along x, as shares of the body's height."""
    sections = curve(np.array(rings), 3 * len(rings) - 2)
    outlines = []
    for z, deep, wide, x in sections.tolist():
        flat = superellipse(deep * body.tall * body.stout, wide * body.tall * body.stout, 2.5, segments=20)
        outlines.append(np.column_stack([flat[:, 0] + x * body.tall, flat[:, 1], np.full(len(flat), z * body.tall)]))
    return loft(outlines)


def _torso(body: _Body) -> Mesh:
    """From the hem of the shirt to the neck."""
    rings = [
        (0.505, 0.118, 0.185, 0.0),
        (0.60, 0.112, 0.165, 0.004),
        (0.70, 0.125, 0.195, 0.004),
        (0.775, 0.112, 0.215, 0.0),
    ]
    return _stack(
        body, [*rings, (0.812, 0.098, 0.205, -0.004), (0.838, 0.07, 0.11, -0.006), (0.855, 0.062, 0.066, -0.006)]
    )


def _hips(body: _Body) -> Mesh:
    return _stack(
        body, [(0.45, 0.10, 0.15, 0.0), (0.48, 0.116, 0.18, 0.0), (0.53, 0.098, 0.16, 0.0), (0.56, 0.08, 0.14, 0.0)]
    )


def _head(rng: Generator, body: _Body, skin: Look, hair: Look) -> list[_Part]:
    """Head, neck, ears, nose and hair, short or down to the shoulders."""
    skull = ball(body(0.006, 0, 0.932), body(0.055, 0.044, 0.066), segments=16)
    neck = tube([body(-0.008, 0, 0.83), body(0.0, 0, 0.90)], 0.032 * body.tall, segments=12)
    nose = ball(body(0.061, 0, 0.924), body(0.010, 0.008, 0.014), segments=8)
    ears = [ball(body(0.0, side * 0.045, 0.928), body(0.010, 0.006, 0.017), segments=8) for side in (1, -1)]
    eyes = [ball(body(0.054, side * 0.018, 0.94), body(0.006, 0.008, 0.005), segments=6) for side in (1, -1)]
    cap = ball(body(-0.006, 0, 0.943), body(0.057, 0.049, 0.060), segments=16)
    locks = [warped(cap, lambda points: _off_the_face(points, body.tall))]
    if chance(rng, 0.45):
        rings = [
            (0.83, 0.035, 0.085, -0.045),
            (0.87, 0.06, 0.105, -0.034),
            (0.92, 0.075, 0.102, -0.024),
            (0.95, 0.07, 0.09, -0.02),
        ]
        locks.append(_stack(body, rings))
    dark = Look("plain", ((0.10, 0.08, 0.07),))
    return [(merge([skull, neck, nose, *ears]), skin), (merge(eyes), dark), (merge(locks), hair)]


def _off_the_face(points: Array, tall_m: float) -> Array:
    """Pushes the front of the hair up to the forehead."""
    x, z = points[:, 0] / tall_m, points[:, 2] / tall_m
    low = np.clip((0.972 - z) / 0.03, 0, 1) * np.clip((x + 0.005) / 0.02, 0, 1)
    return np.column_stack([points[:, 0] - 0.035 * tall_m * low, points[:, 1] * (1 - 0.12 * low), points[:, 2]])


def _leg(body: _Body, side: float, trousers: Look, shoes: Look) -> list[_Part]:
    """The left leg (1) goes forwards, the right one (-1) back with a bent knee."""
    foot, bend = side * body.stride, 0.02 if side > 0 else 0.05
    knee = body(0.5 * foot / body.tall + bend * min(1.0, 4 * body.stride), side * 0.05, 0.275)
    path = curve([body(0, side * 0.047, 0.49), knee, (foot, side * 0.048 * body.tall, 0.055 * body.tall)], 7)
    radii = np.interp(np.linspace(0, 1, 7), (0, 0.5, 1), (0.052, 0.038, 0.03)) * body.tall * body.stout
    sole = plump(superellipse(0.155 * body.tall, 0.056 * body.tall, 2.6, segments=20), 0.05, edge_m=0.018, crown_m=0.02)
    shoe = moved(warped(sole, _toe), (foot + 0.028 * body.tall, side * 0.052 * body.tall, 0.0))
    return [(tube(path, radii.tolist(), segments=12), trousers), (shoe, shoes)]


def _toe(points: Array) -> Array:
    """Flattens a shoe towards its tip."""
    flat = 1 - 0.4 * np.clip(points[:, 0] / 0.12, 0, 1)
    return np.column_stack([points[:, 0], points[:, 1], points[:, 2] * flat])


def _arm(body: _Body, side: float, sleeve: Look, skin: Look) -> list[_Part]:
    """Swings against the leg on its side; the elbow bends forwards."""
    reach = -side * body.swing
    out = 0.112 * body.stout
    shoulder, elbow = body(-0.004, side * (out - 0.014), 0.79), body(0.45 * reach - 0.012, side * (out + 0.022), 0.635)
    wrist = body(reach + 0.02, side * (out + 0.02), 0.50)
    path = curve([shoulder, elbow, wrist], 7)
    radii = np.interp(np.linspace(0, 1, 7), (0, 0.5, 1), (0.034, 0.028, 0.021)) * body.tall * body.stout
    cap = ball(shoulder, 0.034 * body.tall * body.stout, segments=10)
    hand = posed(
        ball((0, 0, 0), body(0.022, 0.013, 0.04), segments=10),
        np.eye(3),
        body(reach + 0.028, side * (out + 0.018), 0.465),
    )
    return [(merge([tube(path, radii.tolist(), segments=10), cap]), sleeve), (hand, skin)]
