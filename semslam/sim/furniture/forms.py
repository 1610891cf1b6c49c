"""Shapes that furniture needs beyond `semslam.sim.shapes`: cushions, pillows, lofts, moulded shells, legs, bends."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from semslam.sim.furniture.solids import block
from semslam.sim.home import Array, Mesh, Vector
from semslam.sim.shapes import about_y, merge, moved, posed


def grained(mesh: Mesh, along: Vector) -> Mesh:
    """The mesh with its texture's first axis, the grain of wood, along a direction in space."""
    axis = np.asarray(along, np.float64) / np.linalg.norm(along)
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    place = mesh.vertices - middle
    across = np.cross(mesh.normals, axis)
    lengths = np.linalg.norm(across, axis=1, keepdims=True)
    other = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    ends = np.linalg.norm(across, axis=1) < 0.5  # end grain: any two directions of the face do
    across = np.where(ends[:, None], other, across / np.maximum(lengths, 1e-9))
    first = np.where(ends, place @ np.cross(axis, other), place @ axis)
    uv = np.stack([first, (place * across).sum(1)], -1) + middle[:2]
    return dataclasses.replace(mesh, uv=uv.astype(np.float32))


def swapped(mesh: Mesh) -> Mesh:
    """The mesh with the axes of its texture exchanged: the grain of a turned or bent rod then runs along it."""
    return dataclasses.replace(mesh, uv=np.ascontiguousarray(mesh.uv[:, ::-1]))


def mirrored(mesh: Mesh) -> Mesh:
    """The mesh with left and right exchanged (y to -y)."""
    flip = np.array([1, -1, 1], np.float32)
    return Mesh(mesh.vertices * flip, mesh.normals * flip, mesh.uv, np.ascontiguousarray(mesh.faces[:, ::-1]))


def both_sides(mesh: Mesh) -> Mesh:
    """The mesh and its mirror image across y = 0."""
    return merge([mesh, mirrored(mesh)])


def loft(rings: ArrayLike) -> Mesh:
    """A smooth skin through closed rings (N, M, 3), closed by flat ends.

    Each ring runs counter-clockwise seen from the side of the last ring: for a bowl built upwards, seen from above.
    The first point is not repeated. Repeat a ring nowhere: where a sharp edge is wanted, merge two lofts.
    """
    points = np.asarray(rings, np.float64)
    closed = np.concatenate([points, points[:, :1]], axis=1)
    around = np.roll(points, -1, 1) - np.roll(points, 1, 1)
    onward = np.gradient(points, axis=0)
    normals = _unit_rows(np.cross(around, onward))
    normals = np.concatenate([normals, normals[:, :1]], axis=1)
    side = _woven(closed, normals)
    return merge([side, _cap(points[0][::-1]), _cap(points[-1])])


def slab(points: ArrayLike, thick_m: float) -> Mesh:
    """A bent board or a moulded shell: a grid of points (N, M, 3) given a thickness, half to each side, with rims.

    Its front looks along rows x columns.
    """
    grid = np.asarray(points, np.float64)
    normals = _unit_rows(np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)))
    half = normals * (thick_m / 2)
    front, back = grid + half, grid - half
    rim = np.array([*_border(grid.shape[:2])])
    top, bottom = front[rim[:, 0], rim[:, 1]], back[rim[:, 0], rim[:, 1]]
    out = _unit_rows(np.cross(np.roll(top, -1, 0) - np.roll(top, 1, 0), top - bottom))
    edge = np.stack([np.vstack([bottom, bottom[:1]]), np.vstack([top, top[:1]])])
    lean = np.broadcast_to(np.vstack([out, out[:1]]), edge.shape)
    return merge([_woven(front, normals), _turned_over(_woven(back, normals)), _woven(edge, lean)])


def warped(mesh: Mesh, bend: Callable[[Array], Array]) -> Mesh:
    """The mesh with its points (V, 3) put through a smooth map of space; normals follow."""
    points, step = mesh.vertices.astype(np.float64), 1e-4
    columns = [(bend(points + step * axis) - bend(points - step * axis)) / (2 * step) for axis in np.eye(3)]
    jacobian = np.stack(columns, -1)  # (V, 3, 3)
    normals = np.linalg.solve(np.swapaxes(jacobian, 1, 2), mesh.normals.astype(np.float64)[..., None])[..., 0]
    return dataclasses.replace(
        mesh, vertices=bend(points).astype(np.float32), normals=_unit_rows(normals).astype(np.float32)
    )


def leg(top: Vector, foot: Vector, top_m: float, foot_m: float, *, rounded: bool = True) -> Mesh:
    """A tapered, perhaps splayed leg with level ends, `top_m` and `foot_m` thick."""
    if rounded:
        angles = np.arange(10) * 2 * np.pi / 10
        circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(10)]) / 2
        return swapped(loft([circle * foot_m + foot, circle * top_m + top]))
    tall, half = top[2] - foot[2], top_m / 2
    upright = block((-half, -half, 0.0), (half, half, tall), min(0.005, 0.3 * foot_m))
    low, way = np.asarray(foot, np.float64), np.subtract(top, foot) / tall

    def stretch(points: Array) -> Array:
        along = points[:, 2:]
        thick = foot_m / top_m + (1 - foot_m / top_m) * along / tall
        return np.asarray(points * (1, 1, 0) * thick + low + along * way)

    return grained(warped(upright, stretch), (float(way[0]), float(way[1]), 1.0))


def curve(points: ArrayLike, count: int) -> Array:
    """(count, D) smooth curve through points (N, D): Catmull-Rom."""
    line = np.asarray(points, np.float64)
    padded = np.vstack([2 * line[0] - line[1], line, 2 * line[-1] - line[-2]])
    place = np.linspace(0, len(line) - 1, count)
    start = np.minimum(place.astype(int), len(line) - 2)
    t = (place - start)[:, None]
    a, b, c, d = (padded[start + i] for i in range(4))
    return np.asarray(b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))


def rounded_ring(depth_m: float, width_m: float, radius_m: float, z_m: float, *, steps: int = 3) -> Array:
    """(4 * steps + 4, 3) level rectangle with round corners about the z axis, always as many points."""
    radius = max(min(radius_m, depth_m / 2 - 1e-4, width_m / 2 - 1e-4), 1e-4)
    points = []
    for sx, sy, start in ((1, 1, 0.0), (-1, 1, 0.5), (-1, -1, 1.0), (1, -1, 1.5)):
        angles = np.pi * (start + np.linspace(0, 0.5, steps + 1))
        centre = (sx * (depth_m / 2 - radius), sy * (width_m / 2 - radius))
        points.append(np.column_stack([np.cos(angles), np.sin(angles)]) * radius + centre)
    outline = np.concatenate(points)
    return np.column_stack([outline, np.full(len(outline), z_m)])


def post(path: ArrayLike, thick_m: ArrayLike, *, steps: int = 1) -> Mesh:
    """An upright bar of square section with round edges, bent along a path (N, 3) that rises; its ends are level."""
    line = np.asarray(path, np.float64)
    thick = np.broadcast_to(np.asarray(thick_m, np.float64), (len(line),))
    rings = [
        rounded_ring(t, t, 0.3 * t, 0.0, steps=steps) + place for place, t in zip(line, thick.tolist(), strict=True)
    ]
    return grained(loft(rings), tuple((line[-1] - line[0]).tolist()))


def plate(outline: ArrayLike, z_low_m: float, z_high_m: float, *, edge_m: float = 0.008) -> Mesh:
    """A level board over a convex outline (N, 2) about the origin, counter-clockwise, its edges rounded."""
    points = np.asarray(outline, np.float64)
    edge = min(edge_m, 0.45 * (z_high_m - z_low_m))
    profile = [(edge, z_low_m), (0.3 * edge, z_low_m + 0.3 * edge), (0.0, z_low_m + edge)]
    profile += [(0.0, z_high_m - edge), (0.3 * edge, z_high_m - 0.3 * edge), (edge, z_high_m)]
    reach = np.abs(points).max(0)
    return loft([np.column_stack([points * (1 - inset / reach), np.full(len(points), z)]) for inset, z in profile])


def back_pad(
    place: Vector,
    tall_m: float,
    width_m: float,
    thick_m: float,
    lean_rad: float,
    *,
    crown_m: float = 0.02,
    steps: int = 3,
) -> Mesh:
    """A pad that stands on its lower edge and faces +x, leaning back; `place` is the middle of that edge's rear."""
    lying = pad(
        (-tall_m, -width_m / 2, 0.0), (0.0, width_m / 2, thick_m), edge_m=0.45 * thick_m, crown_m=crown_m, steps=steps
    )
    return posed(lying, about_y(np.pi / 2 - lean_rad), place)


def resampled(ring: ArrayLike, count: int) -> Array:
    """(count, D) points at equal distances along a closed line (N, D), from its first point on."""
    line = np.asarray(ring, np.float64)
    closed = np.vstack([line, line[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    places = np.arange(count) * way[-1] / count
    return np.column_stack([np.interp(places, way, column) for column in closed.T])


def pad(low: Vector, high: Vector, *, edge_m: float = 0.04, crown_m: float = 0.02, steps: int = 3) -> Mesh:
    """An upholstered block: round edges, a crowned top that stands above `high` by `crown_m`, a flat underside."""
    (depth, width, tall), middle = np.subtract(high, low), (np.asarray(low, np.float64) + high) / 2
    edge = min(edge_m, tall / 2, depth / 3, width / 3)
    reach = min(depth, width) / 2
    profile = [(edge * 0.6, 0.0), (0.15 * edge, 0.3 * edge), (0.0, edge), (0.0, tall - edge)]
    profile += [(0.3 * edge, tall - 0.3 * edge), (edge, tall + 0.15 * crown_m)]
    profile += [(0.4 * reach + 0.6 * edge, tall + 0.75 * crown_m), (0.85 * reach, tall + crown_m)]
    rings = [
        rounded_ring(depth - 2 * inset, width - 2 * inset, 1.4 * edge, height, steps=steps) for inset, height in profile
    ]
    return moved(draped(loft(rings), rings, profile), (middle[0], middle[1], low[2]))


def plump(outline: ArrayLike, thick_m: float, *, edge_m: float = 0.03, crown_m: float = 0.015) -> Mesh:
    """Upholstery over a convex outline (N, 2) about the origin, lying on z = 0, with round edges and a crowned top.

    An outline with many points may be bent afterwards, see `warped`.
    """
    points = np.asarray(outline, np.float64)
    edge, reach = min(edge_m, thick_m / 2), np.abs(points).max(0)
    profile = [(edge, 0.0), (0.25 * edge, 0.25 * edge), (0.0, edge), (0.0, thick_m - edge)]
    profile += [(0.25 * edge, thick_m - 0.25 * edge), (edge, thick_m), (0.5 * reach.min(), thick_m + 0.7 * crown_m)]
    profile += [(0.82 * reach.min(), thick_m + crown_m)]
    scales = [1 - inset / (reach if inset <= edge else reach.min()) for inset, _ in profile]
    rings = [
        np.column_stack([points * scale, np.full(len(points), z)])
        for scale, (_, z) in zip(scales, profile, strict=True)
    ]
    return draped(loft(rings), rings, profile)


def superellipse(depth_m: float, width_m: float, power: float, *, segments: int = 28) -> Array:
    """(N, 2) outline about the origin between an ellipse (2) and a rectangle (large), counter-clockwise."""
    angles = (np.arange(segments) + 0.5) * 2 * np.pi / segments
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return np.asarray(np.sign(circle) * np.abs(circle) ** (2 / power) * (depth_m / 2, width_m / 2))


def draped(mesh: Mesh, rings: Sequence[Array], profile: Sequence[tuple[float, float]]) -> Mesh:
    """The mesh of a loft with its texture as if a cloth lay over it: level on top, unrolled down the sides.

    The cloth's place of a ring is the ring itself pushed outwards by how much longer the way down is than across.
    """
    line = np.asarray(profile, np.float64)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    onward = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])  # way from each ring up to the last
    excess = onward - (line[-1, 0] - line[:, 0])
    places = []
    for ring, more in zip(rings, excess, strict=True):
        level = np.vstack([ring, ring[:1]])[:, :2]
        half = np.maximum(np.abs(level).max(0), 1e-6)
        places.append(level * (1 + more / half))
    bottom, top = rings[0][::-1, :2], rings[-1][:, :2]
    uv = np.concatenate([*places, bottom, bottom.mean(0)[None], top, top.mean(0)[None]])
    return dataclasses.replace(mesh, uv=uv.astype(np.float32))


def pillow(depth_m: float, width_m: float, thick_m: float, *, count: int = 9) -> Mesh:
    """A stuffed pillow lying about the origin, from z = 0: thin seams all around, corners drawn out."""
    edge = np.sin(np.linspace(-0.5, 0.5, count) * np.pi)
    u, v = np.meshgrid(edge, edge, indexing="ij")
    draw = 1 - 0.09 * (1 - u * u) * v * v - 0.09 * (1 - v * v) * u * u  # sides fall in between the corners
    bulge = np.clip((1 - u**2) * (1 - v**2), 0, 1) ** 0.45
    place = np.stack([u * depth_m / 2 * draw, v * width_m / 2 * draw], -1)
    top, bottom = (np.concatenate([place, side * (thick_m / 2 * bulge)[..., None]], -1) for side in (1.0, -1.0))
    normals = _unit_rows(np.cross(np.gradient(top, axis=0), np.gradient(top, axis=1)))
    upper = _woven(top, normals)
    lower = _woven(bottom, normals * (1, 1, -1))
    return moved(merge([upper, lower]), (0.0, 0.0, thick_m / 2))


def _border(shape: Sequence[int]) -> Iterable[tuple[int, int]]:
    """Indices around a grid, counter-clockwise seen from its front (rows x columns)."""
    rows, columns = shape
    yield from ((i, 0) for i in range(rows - 1))
    yield from ((rows - 1, j) for j in range(columns - 1))
    yield from ((i, columns - 1) for i in range(rows - 1, 0, -1))
    yield from ((0, j) for j in range(columns - 1, 0, -1))


def _woven(points: Array, normals: Array) -> Mesh:
    """A mesh over a grid of points (N, M, 3); each face is turned to the side of its normals."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    flat, lean = points.reshape(-1, 3), normals.reshape(-1, 3)
    look = np.cross(flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]])
    away = (look * lean[faces].sum(1)).sum(1) < 0
    faces[away] = faces[away][:, ::-1]
    faces = faces[np.linalg.norm(look, axis=1) > 1e-12]
    u = np.concatenate([np.zeros((rows, 1)), np.cumsum(np.linalg.norm(np.diff(points, axis=1), axis=-1), 1)], 1)
    v = np.concatenate([np.zeros((1, columns)), np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1), 0)])
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return Mesh(
        flat.astype(np.float32), lean.astype(np.float32), uv.astype(np.float32), np.ascontiguousarray(faces, np.int32)
    )


def _turned_over(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, -mesh.normals, mesh.uv, np.ascontiguousarray(mesh.faces[:, ::-1]))


def _cap(ring: Array) -> Mesh:
    """A flat end over a ring (M, 3), counter-clockwise seen from outside, a fan about its middle."""
    middle = ring.mean(0)
    normal = np.cross(ring - middle, np.roll(ring, -1, 0) - middle).sum(0)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    count = len(ring)
    vertices = np.vstack([ring, middle])
    faces = np.array([(count, i, (i + 1) % count) for i in range(count)], np.int32)
    side = np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0))
    uv = np.stack([vertices @ side, vertices @ np.cross(normal, side)], -1)
    return Mesh(
        vertices.astype(np.float32),
        np.tile(normal, (count + 1, 1)).astype(np.float32),
        uv.astype(np.float32),
        faces,
    )


def _unit_rows(vectors: ArrayLike) -> Array:
    rows = np.asarray(vectors, np.float64)
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(np.where(lengths > 1e-12, rows / np.maximum(lengths, 1e-12), (0.0, 0.0, 1.0)))
