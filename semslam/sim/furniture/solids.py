"""Shapes that furniture needs beside those of `shapes`: boards with broken edges, skins without ends, turned knobs."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semslam.sim.home import Array, Mesh, Vector
from semslam.sim.shapes import about_y, lathe, posed

_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""(8, 3) signs of the corners of a box."""


def block(low: Vector, high: Vector, bevel_m: float = 0.004, *, grain: int | None = None) -> Mesh:
    """A board: a box whose edges are broken and look round, at 44 triangles against the 300 of `shapes.box`.

    Args:
        grain: axis (0, 1, 2) along which the texture's first axis runs; None takes the longest.
    """
    half = (np.asarray(high, np.float64) - low) / 2
    bevel = min(bevel_m, 0.45 * float(half.min()))
    if bevel <= 0:
        return brick(low, high)
    middle = (np.asarray(low, np.float64) + high) / 2
    along = int(np.argmax(half)) if grain is None else grain
    points, normals = [], []
    for axis in (0, 1, 2, along):  # the ends come twice: as end grain, and as part of the edges around them
        out = np.eye(3)[axis] * _CORNERS
        points.append(middle + _CORNERS * (half - bevel) + out * bevel)
        normals.append(out)
    place = np.concatenate(points)
    return Mesh(
        place.astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        _board_uv(place, along).astype(np.float32),
        _board_faces(along),
    )


def brick(low: Vector, high: Vector) -> Mesh:
    """A box with sharp edges: as `shapes.box` without a bevel, but quickly made, for books by the hundred."""
    middle, half = (np.asarray(low, np.float64) + high) / 2, (np.asarray(high, np.float64) - low) / 2
    if np.any(half <= 0):
        raise ValueError(f"a box from {low} to {high} has no volume")
    place = np.tile(middle + _CORNERS * half, (3, 1))
    normals = np.repeat(np.eye(3), 8, axis=0) * np.tile(_CORNERS, (3, 1))
    uv = np.concatenate([place[:8, (1, 2)], place[:8, (0, 2)], place[:8, (0, 1)]])
    return Mesh(place.astype(np.float32), normals.astype(np.float32), uv.astype(np.float32), _board_faces(-1)[:12])


def _board_uv(place: Array, along: int) -> Array:
    """(32, 2) the first axis along the grain, the second unrolled around it; the last eight are the ends."""
    first, second = (along + 1) % 3, (along + 2) % 3
    uv = np.column_stack([place[:, along], place[:, first] + place[:, second]])
    uv[24:] = place[24:, [first, second]]
    return uv


@functools.cache
def _board_faces(along: int) -> NDArray[np.int32]:
    """(44, 3) six sides, twelve edges, eight corners of `block`; `along` is -1 where ends are not told apart."""
    faces = []
    for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        ring = [_corner({axis: sign, first: a, second: b}) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        start = 24 if axis == along else 8 * axis
        faces += _fan([start + corner for corner in ring], sign < 0)
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for a, b in itertools.product((-1.0, 1.0), repeat=2):
            low, high = (_corner({axis: end, first: a, second: b}) for end in (-1.0, 1.0))
            faces += _fan([8 * first + low, 8 * second + low, 8 * second + high, 8 * first + high], a * b < 0)
    for corner, signs in enumerate(_CORNERS):
        faces += _fan([corner, 8 + corner, 16 + corner], bool(signs.prod() < 0))
    return np.array(faces, np.int32)


def _corner(signs: dict[int, float]) -> int:
    """Index into _CORNERS."""
    return sum((signs[axis] > 0) << (2 - axis) for axis in range(3))


def _fan(ring: list[int], flip: bool) -> list[list[int]]:
    ring = ring[::-1] if flip else ring
    return [[ring[0], ring[i], ring[i + 1]] for i in range(1, len(ring) - 1)]


def skin(rings: ArrayLike) -> Mesh:
    """A smooth band through closed rings (N, M, 3) without ends; rings turn left seen from where the next ones are."""
    points = np.asarray(rings, np.float64)
    around = np.roll(points, -1, 1) - np.roll(points, 1, 1)
    normals = np.cross(around, np.gradient(points, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    closed, lean = (np.concatenate([grid, grid[:, :1]], axis=1) for grid in (points, normals))
    rows, columns = closed.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    u = np.concatenate([np.zeros((rows, 1)), np.cumsum(np.linalg.norm(np.diff(closed, axis=1), axis=-1), 1)], 1)
    v = np.concatenate([np.zeros((1, columns)), np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=-1), 0)])
    uv = np.stack([np.broadcast_to(u.max(0), u.shape), v], -1)
    return Mesh(
        closed.reshape(-1, 3).astype(np.float32),
        lean.reshape(-1, 3).astype(np.float32),
        uv.reshape(-1, 2).astype(np.float32),
        faces.astype(np.int32),
    )


def shell(profile: ArrayLike, thick_m: float, *, segments: int = 24) -> Mesh:
    """A turned vessel or lamp shade that is open at both ends: profile (N, 2) of radius and height, upwards."""
    outer = np.asarray(profile, np.float64)
    inner = outer[::-1] - (thick_m, 0.0)
    return lathe(np.vstack([outer, inner, outer[:1]]), segments=segments)


def knob(place: Vector, radius_m: float, *, segments: int = 12) -> Mesh:
    """A turned handle on a front that faces +x."""
    profile = np.array([(0.45, 0.0), (0.4, 0.7), (0.95, 1.0), (1.0, 1.4), (0.7, 1.75), (0.0, 1.85)]) * radius_m
    return posed(lathe(profile, segments=segments), about_y(math.pi / 2), place)
