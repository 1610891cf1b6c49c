"""Meshes to build furniture and walls from: boxes, turned and bent things, cushions, sheets.

All lengths are metres. Faces are counter-clockwise seen from outside; every vertex carries its normal and its place on
the texture in metres along the surface, so that a texture has the same scale on every shape.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from semslam.sim.home import Array, Mesh, Vector

_BEVEL_STEPS = 2
_SHARP_RAD = math.radians(40)
"""Turned profiles look sharp where they bend by more than this."""


def box(low: Vector, high: Vector, *, bevel_m: float = 0.0) -> Mesh:
    """An upright box between two corners; `bevel_m` rounds its edges."""
    return _soft_box(low, high, bevel_m, 0.0)


def cushion(low: Vector, high: Vector, *, bevel_m: float = 0.05, puff_m: float = 0.02) -> Mesh:
    """A box with round edges whose faces bulge by up to `puff_m`, within its corners' bounds grown by that much."""
    return _soft_box(low, high, bevel_m, puff_m)


def lathe(profile: ArrayLike, *, segments: int = 24) -> Mesh:
    """A solid of revolution about z: profile (N, 2) of radius and height, so ordered that outside is to its right.

    For a pot that is: from the bottom's centre outwards, up the side, and back to the axis.
    """
    line = np.asarray(profile, np.float64)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    parts = []
    for (start, end), (first, last), along in zip(
        itertools.pairwise(line),
        _profile_normals(line),
        itertools.pairwise(lengths),
        strict=True,
    ):
        if np.allclose(start, end):
            continue
        parts.append(_ring(start, end, first, last, along, segments))
    return merge(parts)


def tube(path: ArrayLike, radius_m: float | Sequence[float], *, segments: int = 10) -> Mesh:
    """A round rod along a polyline (N, 3); one radius, or one a point; closed by flat ends."""
    line = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius_m, np.float64), (len(line),))
    tangents = np.gradient(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = _perpendicular(tangents[0])
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    rings, normals, uv = [], [], []
    for point, tangent, radius, length in zip(line, tangents, radii, lengths, strict=True):
        side = side - tangent * (side @ tangent)  # carried along without twist
        side /= np.linalg.norm(side)
        out = np.outer(np.cos(angles), side) + np.outer(np.sin(angles), np.cross(tangent, side))
        rings.append(point + radius * out)
        normals.append(out)
        uv.append(np.column_stack([angles * radius, np.full(len(angles), length)]))
    grid = _grid(np.array(rings), np.array(normals), np.array(uv), flip=True)
    return merge([grid, _cap(rings[0][:-1][::-1]), _cap(rings[-1][:-1])])


def rod(start: Vector, end: Vector, radius_m: float, end_radius_m: float | None = None, *, segments: int = 10) -> Mesh:
    """A straight rod, tapered if the end has a radius of its own."""
    return tube([start, end], [radius_m, radius_m if end_radius_m is None else end_radius_m], segments=segments)


def bar(start: Vector, end: Vector, width_m: float, thick_m: float, *, bevel_m: float = 0.0) -> Mesh:
    """A straight bar of rectangular section: `width_m` across (level where it can be), `thick_m` the other way."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    across = np.cross((0.0, 0.0, 1.0), along)
    across = np.array([0.0, 1.0, 0.0]) if np.linalg.norm(across) < 1e-6 else across / np.linalg.norm(across)
    frame = np.column_stack([along, across, np.cross(along, across)])
    half = (width_m / 2, thick_m / 2)
    return posed(box((0.0, -half[0], -half[1]), (length, half[0], half[1]), bevel_m=bevel_m), frame, a)


def ball(centre: Vector, radii_m: float | Vector, *, segments: int = 16) -> Mesh:
    """A sphere or an upright ellipsoid."""
    radii = np.broadcast_to(np.asarray(radii_m, np.float64), (3,))
    polar, around = np.linspace(0, np.pi, segments // 2 + 1), np.linspace(0, 2 * np.pi, segments + 1)
    p, a = np.meshgrid(polar, around, indexing="ij")
    unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1)
    normals = unit / radii
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    uv = np.stack([a * radii[0], p * radii[2]], -1)
    return _grid(unit * radii + np.asarray(centre), normals, uv, flip=False)


def sheet(points: ArrayLike, *, thick_m: float = 0.001) -> Mesh:
    """A thin surface seen from both sides, through a grid of points (N, M, 3): a leaf, a curtain, a cloth."""
    grid = np.asarray(points, np.float64)
    rows, columns = np.gradient(grid, axis=0), np.gradient(grid, axis=1)
    normals = np.cross(rows, columns)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), (0.0, 0.0, 1.0))  # a tip has no direction
    u = np.concatenate([np.zeros((1, grid.shape[1])), np.cumsum(np.linalg.norm(np.diff(grid, axis=0), axis=-1), 0)])
    v = np.concatenate(
        [np.zeros((grid.shape[0], 1)), np.cumsum(np.linalg.norm(np.diff(grid, axis=1), axis=-1), 1)], axis=1
    )
    uv, half = np.stack([v, u], -1), normals * (thick_m / 2)
    return merge([_grid(grid + half, normals, uv, flip=False), _grid(grid - half, -normals, uv, flip=True)])


def picture_plane(width_m: float, height_m: float) -> Mesh:
    """An upright rectangle about the origin that faces +x; the texture covers it once: uv is 0..1 times one metre.

    Give its look `tile_m=1.0`.
    """
    y, z = width_m / 2, height_m / 2
    corners = np.array([[0, -y, -z], [0, y, -z], [0, y, z], [0, -y, z]])  # who looks at it has +y on the right
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return _mesh(corners, np.tile((1.0, 0.0, 0.0), (4, 1)), uv, np.array([[0, 1, 2], [0, 2, 3]]))


def rounded_rectangle(depth_m: float, width_m: float, radius_m: float, *, steps: int = 5) -> Array:
    """(N, 2) outline about the origin, `depth_m` along x, counter-clockwise."""
    radius = min(radius_m, depth_m / 2, width_m / 2)
    corners = [(1, 1, 0.0), (-1, 1, 0.5), (-1, -1, 1.0), (1, -1, 1.5)]
    points = []
    for sx, sy, start in corners:
        angles = np.pi * (start + np.linspace(0, 0.5, steps + 1))
        centre = np.array([sx * (depth_m / 2 - radius), sy * (width_m / 2 - radius)])
        points.append(centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    outline = np.concatenate(points)
    keep = np.linalg.norm(outline - np.roll(outline, 1, 0), axis=1) > 1e-6
    return np.asarray(outline[keep])


def ellipse(depth_m: float, width_m: float, *, segments: int = 28) -> Array:
    """(N, 2) outline about the origin, counter-clockwise."""
    angles = np.arange(segments) * 2 * np.pi / segments
    return np.column_stack([np.cos(angles) * depth_m / 2, np.sin(angles) * width_m / 2])


def rectangle(depth_m: float, width_m: float) -> Array:
    """(4, 2) outline about the origin, counter-clockwise."""
    return np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * (depth_m / 2, width_m / 2)


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several.

    Raises:
        ValueError: there is none.
    """
    meshes = list(meshes)
    starts = np.concatenate([[0], np.cumsum([len(mesh.vertices) for mesh in meshes])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
    )


def posed(mesh: Mesh, rotation: ArrayLike, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
    """The mesh turned by a rotation (3, 3), then moved by an offset (3,)."""
    turn = np.asarray(rotation, np.float64)
    vertices = mesh.vertices @ turn.T + np.asarray(offset, np.float64)
    return Mesh(vertices.astype(np.float32), (mesh.normals @ turn.T).astype(np.float32), mesh.uv, mesh.faces)


def moved(mesh: Mesh, offset: ArrayLike) -> Mesh:
    """The mesh moved by an offset (3,)."""
    return posed(mesh, np.eye(3), offset)


def transformed(mesh: Mesh, position: ArrayLike, yaw_rad: float) -> Mesh:
    """The mesh turned about the vertical, then moved to a position (3,)."""
    return posed(mesh, about_z(yaw_rad), position)


def about_x(angle_rad: float) -> Array:
    """(3, 3) rotation."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def about_y(angle_rad: float) -> Array:
    """(3, 3) rotation; positive turns +x down."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


def about_z(angle_rad: float) -> Array:
    """(3, 3) rotation, counter-clockwise from above."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _mesh(vertices: ArrayLike, normals: ArrayLike, uv: ArrayLike, faces: ArrayLike) -> Mesh:
    return Mesh(
        np.asarray(vertices, np.float32),
        np.asarray(normals, np.float32),
        np.asarray(uv, np.float32),
        np.asarray(faces, np.int32).reshape(-1, 3),
    )


def _grid(points: Array, normals: Array, uv: Array, *, flip: bool) -> Mesh:
    """A mesh over a grid (N, M, 3); faces look along rows x columns, or the other way."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    flat = points.reshape(-1, 3)
    area = np.linalg.norm(
        np.cross(flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]]), axis=1
    )
    faces = faces[area > 1e-12]  # at the poles of a ball, the tip of a cone
    return _mesh(flat, normals.reshape(-1, 3), uv.reshape(-1, 2), faces[:, ::-1] if flip else faces)


def _soft_box(low: Vector, high: Vector, bevel_m: float, puff_m: float) -> Mesh:
    middle = (np.asarray(low, np.float64) + high) / 2
    half = (np.asarray(high, np.float64) - low) / 2
    if np.any(half <= 0):
        raise ValueError(f"a box from {low} to {high} has no volume")
    bevel = min(bevel_m, float(half.min()))
    steps = [_soft_line(float(h), bevel, puff_m > 0) for h in half]
    faces = [_soft_face(axis, sign, half, bevel, puff_m, steps) for axis in range(3) for sign in (-1.0, 1.0)]
    return moved(merge(faces), middle)


def _soft_line(half: float, bevel: float, bulges: bool) -> Array:
    """Places of grid lines along one edge of a box, rising."""
    flat = np.linspace(-(half - bevel), half - bevel, 6 if bulges else 2)
    if bevel <= 0:
        return flat if bulges else np.array([-half, half])
    turn = bevel * np.tan(np.pi / 4 * np.arange(1, _BEVEL_STEPS + 1) / _BEVEL_STEPS)
    line = np.concatenate([-(half - bevel) - turn[::-1], flat, half - bevel + turn])
    return np.asarray(line[np.concatenate([[True], np.diff(line) > 1e-9])])


def _soft_face(axis: int, sign: float, half: Array, bevel: float, puff_m: float, steps: list[Array]) -> Mesh:
    """One side of a box: rounded over its edges, bulging in the middle."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    u, v = np.meshgrid(steps[first], steps[second], indexing="ij")
    cube = np.zeros((*u.shape, 3))
    cube[..., axis], cube[..., first], cube[..., second] = sign * half[axis], u, v
    flat = np.zeros(3)
    flat[axis] = sign
    normals = np.broadcast_to(flat, cube.shape).copy()
    points = cube
    if bevel > 0:
        inner = np.clip(cube, -(half - bevel), half - bevel)
        normals = (cube - inner) / np.linalg.norm(cube - inner, axis=-1, keepdims=True)
        points = inner + bevel * normals
    if puff_m > 0:
        a, b = u / half[first], v / half[second]
        bulge = puff_m * (1 - a * a) * (1 - b * b)
        points = points + bulge[..., None] * flat
        lean = np.zeros_like(points)
        lean[..., first] = puff_m * 2 * a / half[first] * (1 - b * b)
        lean[..., second] = puff_m * 2 * b / half[second] * (1 - a * a)
        normals = normals + lean
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # upright sides carry their texture upright: the height is the second axis of it
    uv = np.stack([v, u], -1) if second != 2 else np.stack([u, v], -1)
    return _grid(points, normals, uv, flip=sign < 0)


def _profile_normals(line: Array) -> list[tuple[Array, Array]]:
    """For every segment of a turned profile the normals (radial, up) at its two ends."""
    along = np.diff(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    pairs = []
    for i, normal in enumerate(normals):
        before = normals[i - 1] if i and normals[i - 1] @ normal > math.cos(_SHARP_RAD) else normal
        after = normals[i + 1] if i + 1 < len(normals) and normals[i + 1] @ normal > math.cos(_SHARP_RAD) else normal
        pairs.append((_unit(before + normal), _unit(after + normal)))
    return pairs


def _ring(start: Array, end: Array, first: Array, last: Array, along: tuple[float, float], segments: int) -> Mesh:
    """The band of a solid of revolution between two points of its profile."""
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    points, normals, uv = [], [], []
    for (radius, height), (out, up), length in zip((start, end), (first, last), along, strict=True):
        points.append(np.column_stack([circle * radius, np.full(len(circle), height)]))
        normals.append(np.column_stack([circle * out, np.full(len(circle), up)]))
        uv.append(np.column_stack([angles * max(start[0], end[0]), np.full(len(circle), length)]))
    return _grid(np.array(points), np.array(normals), np.array(uv), flip=True)


def _cap(ring: Array) -> Mesh:
    """A flat convex polygon (N, 3), counter-clockwise seen from outside."""
    normal = _unit(np.cross(ring[1] - ring[0], ring[2] - ring[0]))
    faces = [(0, i, i + 1) for i in range(1, len(ring) - 1)]
    across = _perpendicular(normal)
    uv = np.column_stack([ring @ across, ring @ np.cross(normal, across)])
    return _mesh(ring, np.tile(normal, (len(ring), 1)), uv, faces)


def _perpendicular(vector: Array) -> Array:
    other = np.array([0.0, 0.0, 1.0]) if abs(vector[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    return _unit(np.cross(vector, other))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
