"""Where rays meet solids and the room around them.

A solid is tested only for the pixels of the rectangle that its corners span on the screen. Rays are in the camera's
optical frame with z = 1, so the length of a ray is depth along the optical axis; directions in the frame of a solid
are linear in the pixel, one (H, W) array an axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from tests.toy.furniture import Solid
from tests.toy.texture import noise
from tests.toy.toyroom import turn

FLOOR, WALL, CEILING = 0, 1, 2
"""Surfaces of the room itself."""
SHELL = 3
"""Solid i of a room is surface i + SHELL."""
_NEAR_M = 0.03
_LEAF_THRESHOLD = 0.42  # noise below it is a gap between leaves


def ray_xy(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x of every column (W,) and y of every row (H,) of the rays with z = 1."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    return x.astype(np.float32), y.astype(np.float32)


def directions(
    rotation: NDArray[np.float64], x: NDArray[np.float32], y: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Ray directions in another frame, one (H, W) array an axis: rotation times (x, y, 1)."""
    matrix = rotation.astype(np.float32)
    first, second, third = (row[0] * x[None, :] + (row[1] * y + row[2])[:, None] for row in matrix)
    return first, second, third


def corners_of(solid: Solid) -> NDArray[np.float64]:
    """(8, 3) corners in the room frame."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    points = signs * np.array(solid.half_m)
    points[:, :2] = points[:, :2] @ turn(solid.yaw_rad).T
    return np.asarray(points + solid.centre_m)


_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)])


def screen_window(corners: NDArray[np.float64], camera: Camera) -> tuple[slice, slice] | None:
    """Rows and columns that a box (8, 3) in the camera frame can cover; None if it is out of sight."""
    front = corners[:, 2] > _NEAR_M
    if not front.any():
        return None
    points = corners[front]
    if not front.all():
        a, b = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]]
        crossing = front[_EDGES[:, 0]] != front[_EDGES[:, 1]]
        a, b = a[crossing], b[crossing]
        share = (_NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2])
        points = np.concatenate([points, a + share[:, None] * (b - a)])
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    left, right = max(0, int(np.floor(u.min()))), min(camera.width, int(np.ceil(u.max())) + 1)
    top, bottom = max(0, int(np.floor(v.min()))), min(camera.height, int(np.ceil(v.max())) + 1)
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def cast_shell(
    size_m: NDArray[np.float64],
    rotation: NDArray[np.float64],
    origin: NDArray[np.float64],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth and surface of a room of that size (3,) seen from inside: the first plane that a ray leaves through."""
    half = size_m / 2
    local = origin - (0.0, 0.0, half[2])
    rays = directions(rotation, x, y)
    exits = [
        (np.where(d > 0, h, -h).astype(np.float32) - np.float32(o)) / _nonzero(d)
        for d, o, h in zip(rays, local, half, strict=True)
    ]
    walls = np.minimum(exits[0], exits[1])
    depth = np.minimum(walls, exits[2])
    flat = np.where(rays[2] > 0, CEILING, FLOOR)
    return depth, np.where(walls < exits[2], WALL, flat).astype(np.int32)


def cast_solid(
    solid: Solid,
    rotation: NDArray[np.float64],
    origin: NDArray[np.float64],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
) -> NDArray[np.float32]:
    """(h, w) depth at which each ray meets the solid; inf where it does not."""
    inverse = np.eye(3)
    inverse[:2, :2] = turn(-solid.yaw_rad)
    local = inverse @ (origin - solid.centre_m)
    rays = directions(inverse @ rotation, x, y)
    return _cast_ball(solid, local, rays) if solid.ball else _cast_box(solid, local, rays)


def _cast_box(solid: Solid, origin: NDArray[np.float64], rays: tuple[NDArray[np.float32], ...]) -> NDArray[np.float32]:
    """Slab test: the ray is inside between the last entry and the first exit of three pairs of planes."""
    entry, leave = np.float32(_NEAR_M), np.float32(np.inf)
    for d, o, h in zip(rays, origin, solid.half_m, strict=True):
        inverse = np.float32(1) / _nonzero(d)
        middle, reach = inverse * np.float32(-o), np.abs(inverse) * np.float32(h)
        entry, leave = np.maximum(entry, middle - reach), np.minimum(leave, middle + reach)
    return np.where((entry < leave) & (entry > _NEAR_M), entry, np.float32(np.inf))


def _cast_ball(solid: Solid, origin: NDArray[np.float64], rays: tuple[NDArray[np.float32], ...]) -> NDArray[np.float32]:
    """Ellipsoid with holes where its noise is low: foliage. The far side shows through the holes."""
    o = (origin / solid.half_m).astype(np.float32)
    d = [ray / np.float32(h) for ray, h in zip(rays, solid.half_m, strict=True)]
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    root = b * b - a * (o @ o - np.float32(1))
    hits = root > 0
    root = np.sqrt(np.where(hits, root, 0))
    depth = np.full(a.shape, np.inf, np.float32)
    for t in ((-b + root) / a, (-b - root) / a):
        u, v = origin[0] + t * rays[0] + origin[1] + t * rays[1], origin[2] + t * rays[2]
        leaf = noise((u * 3).astype(np.float32), (v * 3).astype(np.float32)) > _LEAF_THRESHOLD
        np.copyto(depth, t, where=hits & leaf & (t > _NEAR_M))
    return depth


def _nonzero(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same values with zero made tiny, to divide by."""
    return np.where(np.abs(values) < 1e-9, np.float32(1e-9), values)
