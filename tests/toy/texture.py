"""Procedural surfaces: the colour of a point from its place on a face.

A pattern maps (u, v), metres on the face (v is the height above the floor on upright faces), and two colours to
(N, 3) float32 RGB, 0 to 1, before lighting. `salt` shifts the pattern, so that two pieces do not look alike.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Pattern = Callable[[Array, Array, Array, Array, Array], Array]
"""u (N,), v (N,), salt (N,), colour (N, 3), second colour (N, 3) -> (N, 3)."""

_TILE = 512
_TEXELS_PER_M = 128.0


def noise(u: Array, v: Array) -> Array:
    """Smooth noise of mean 0.5 with detail from 1 cm to 1 m; repeats every 4 m."""
    column = np.floor(u * _TEXELS_PER_M).astype(np.int32) & (_TILE - 1)
    row = np.floor(v * _TEXELS_PER_M).astype(np.int32) & (_TILE - 1)
    return np.asarray(_noise_tile()[row, column], np.float32)


def _plain(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    return _mix(colour, second, 0.3 * noise(u + salt, v))


def _wood(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    return _mix(colour, second, np.clip(2.4 * noise(u * 0.25 + salt, v * 3.0) - 0.7, 0, 1))


def _fabric(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    weave = 0.5 + 0.25 * (np.sin(u * 420.0) + np.sin(v * 420.0))
    return _mix(colour, second, 0.35 * weave + 0.65 * noise(u * 2 + salt, v * 2))


def _plaster(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    painted = _mix(colour, second, 0.6 * noise(u + salt, v))
    painted[v < 0.08] = (0.93, 0.92, 0.89)
    return painted


def _planks(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    """Floor boards of 14 cm x 1.2 m, each of its own shade, with dark seams."""
    row = np.floor(v / 0.14)
    along = u + 0.73 * row
    board = _scatter(row * 7.0 + np.floor(along / 1.2) * 3.0)
    grain = noise(u * 0.3 + 5 * board + salt, v * 3.0)
    painted = _mix(colour, second, np.clip(0.45 * board + 0.9 * grain - 0.25, 0, 1))
    seam = (np.mod(v, 0.14) < 0.008) | (np.mod(along, 1.2) < 0.008)
    painted[seam] *= 0.6
    return painted


def _books(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    """Spines 3.5 cm wide, each with its own colour and a pale title band."""
    spine = np.floor((u + salt) / 0.035)
    kind, tone = _scatter(spine), _scatter(spine + 0.5)
    hue = np.stack([_scatter(spine + shift) for shift in (0.1, 0.2, 0.3)], axis=1)
    painted = _mix(colour, second, kind) * 0.5 + hue * 0.45
    painted *= (0.6 + 0.5 * tone)[:, None]
    painted[np.mod((u + salt) / 0.035, 1.0) < 0.12] *= 0.35
    band = np.abs(np.mod(v, 0.34) - 0.20) < 0.012 + 0.015 * kind
    painted[band & (tone > 0.4)] = (0.85, 0.80, 0.62)
    return np.asarray(painted, np.float32)


def _leaves(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    return _mix(colour, second, np.clip(4.0 * noise(u * 3 + salt, v * 3) - 1.5, 0, 1))


def _screen(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    return _mix(colour, second, np.clip(0.5 + 0.6 * u + 1.5 * (noise(u * 0.7 + salt, v * 0.7) - 0.5), 0, 1))


def _picture(u: Array, v: Array, salt: Array, colour: Array, second: Array) -> Array:
    blobs = np.clip(6.0 * noise(u * 0.6 + salt, v * 0.6) - 2.5, 0, 1)
    return _mix(colour, second, blobs)


PATTERNS: dict[str, Pattern] = {
    "plain": _plain,
    "wood": _wood,
    "fabric": _fabric,
    "plaster": _plaster,
    "planks": _planks,
    "books": _books,
    "leaves": _leaves,
    "screen": _screen,
    "picture": _picture,
}


@cache
def _noise_tile() -> Array:
    """Four octaves of blurred white noise, wrapped at the borders, stretched to 0..1."""
    rng = np.random.default_rng(0x7E)
    total = np.zeros((_TILE, _TILE), np.float32)
    for sigma, weight in ((1, 0.5), (4, 0.8), (12, 1.0), (32, 1.0)):
        white = np.pad(rng.standard_normal((_TILE, _TILE)).astype(np.float32), 4 * sigma, mode="wrap")
        layer = cv2.GaussianBlur(white, (0, 0), sigma)[4 * sigma : -4 * sigma, 4 * sigma : -4 * sigma]
        total += weight * layer / layer.std()
    return np.asarray(np.clip(0.5 + 0.18 * total, 0, 1), np.float32)


def _mix(colour: Array, second: Array, weight: Array) -> Array:
    return np.asarray(colour + weight[:, None] * (second - colour), np.float32)


def _scatter(index: Array) -> Array:
    """A number in 0..1 that looks random, from any number."""
    value = np.sin(index * 12.9898 + 4.1) * 43758.5453
    return np.asarray(value - np.floor(value), np.float32)
