"""Pictures of a toy room by ray casting: colour, metric depth, object ids and class ids.

Each solid is tested only in the rectangle its corners span on the screen (slab test for boxes, quadratic for balls); a
depth buffer keeps the nearest. Colour is worked out afterwards, once a pixel: pattern, then light from a window
direction, ambient light, and soft shadows on the floor that are drawn once a room.

The camera frame is optical (x right, y down, z forward); the ray of a pixel has z = 1, so its length is the depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.sim.furniture import Material, Solid
from semslam.sim.texture import PATTERNS, noise
from semslam.sim.toyroom import ToyRoom, turn

_NEAR_M = 0.03
_SHADOW_CELL_M = 0.02
_SUN = np.array([0.45, 0.30, 0.84]) / np.linalg.norm([0.45, 0.30, 0.84])
"""Direction towards the light, room frame."""
_AMBIENT = 0.55
_FLOOR, _WALL, _CEILING = 0, 1, 2
_SHELL = 3
"""Surfaces 0 to 2 are the room itself; solid i is surface i + 3."""


@dataclass(frozen=True)
class View:
    """What one camera sees from one place."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    depth_m: NDArray[np.float32]
    """(H, W) along the optical axis, exact."""
    object_ids: NDArray[np.int32]
    """(H, W), 0 is the room itself."""
    class_ids: NDArray[np.int32]
    """(H, W) index into CLASSES, -1 is the room itself."""


@dataclass(frozen=True)
class VisibleBox:
    """Bounding box of the visible pixels of one object; half-open, pixels."""

    object_id: int
    class_id: int
    left: int
    top: int
    right: int
    bottom: int
    pixels: int


def pinhole(width: int, height: int, horizontal_fov_rad: float) -> Camera:
    """A camera without distortion: square pixels, axis through the middle."""
    focal = width / 2 / math.tan(horizontal_fov_rad / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


class Renderer:
    """Renders one room from any number of places."""

    def __init__(self, room: ToyRoom) -> None:
        self._solids = room.solids
        self._size = np.array([room.width_m, room.depth_m, room.height_m])
        self._corners = np.array([_corners(solid) for solid in room.solids]).reshape(-1, 8, 3)
        self._surfaces = _Surfaces(room)
        self._floor_light = _floor_light(room)
        self._object_ids = np.array([0] * _SHELL + [solid.object_id for solid in room.solids], np.int32)
        self._class_ids = np.array([-1] + [item.class_id for item in room.objects], np.int32)

    def view(self, camera: Camera, room_from_camera: NDArray[np.float64]) -> View:
        """Colour, depth and ids; `room_from_camera` is 4x4."""
        depth, surface = self._cast(camera, room_from_camera)
        object_ids = self._object_ids[surface]
        rgb = self._shade(camera, room_from_camera, depth, surface)
        return View(rgb, depth, object_ids, self._class_ids[object_ids])

    def depth_m(self, camera: Camera, room_from_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """(H, W) exact depth along the optical axis, metres; much faster than a whole view."""
        return self._cast(camera, room_from_camera)[0]

    def _cast(
        self, camera: Camera, room_from_camera: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Depth and index of the nearest surface of every pixel."""
        rotation, origin = room_from_camera[:3, :3], room_from_camera[:3, 3]
        x, y = _ray_xy(camera)
        depth, surface = self._cast_shell(rotation, origin, x, y)
        in_camera = (self._corners - origin) @ rotation  # (S, 8, 3)
        for index, solid in enumerate(self._solids):
            window = _screen_window(in_camera[index], camera)
            if window is None:
                continue
            hit = _cast_solid(solid, rotation, origin, x[window[1]], y[window[0]])
            nearer = hit < depth[window]
            np.copyto(depth[window], hit, where=nearer)
            np.copyto(surface[window], index + _SHELL, where=nearer)
        return depth, surface

    def _cast_shell(
        self, rotation: NDArray[np.float64], origin: NDArray[np.float64], x: NDArray[np.float32], y: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Floor, walls and ceiling seen from inside: the first of the six planes that a ray leaves through."""
        half = self._size / 2
        local = origin - (0.0, 0.0, half[2])
        directions = _directions(rotation, x, y)
        exits = [
            (np.where(d > 0, h, -h).astype(np.float32) - np.float32(o)) / _nonzero(d)
            for d, o, h in zip(directions, local, half, strict=True)
        ]
        walls = np.minimum(exits[0], exits[1])
        depth = np.minimum(walls, exits[2])
        flat = np.where(directions[2] > 0, _CEILING, _FLOOR)
        return depth, np.where(walls < exits[2], _WALL, flat).astype(np.int32)

    def _shade(
        self,
        camera: Camera,
        room_from_camera: NDArray[np.float64],
        depth: NDArray[np.float32],
        surface: NDArray[np.int32],
    ) -> NDArray[np.uint8]:
        """(H, W, 3) colour of the points that were hit."""
        rotation, origin = room_from_camera[:3, :3], room_from_camera[:3, 3]
        rays = _directions(rotation, *_ray_xy(camera))
        points = [np.float32(o) + depth * d for o, d in zip(origin, rays, strict=True)]
        flat = np.stack([p.ravel() for p in points])  # (3, N)
        index = surface.ravel()
        colour, light = self._surfaces.look(index, flat)
        light *= self._occlusion(index, flat)
        lit = np.clip(colour * light[:, None], 0, 1) ** np.float32(0.9)
        picture = (lit * 255).astype(np.uint8).reshape(*depth.shape, 3)
        return np.asarray(cv2.GaussianBlur(picture, (3, 3), 0.55), np.uint8)

    def _occlusion(self, index: NDArray[np.int32], points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Shadows on the floor, and the darker edges where walls, floor and ceiling meet."""
        factor = np.ones(len(index), np.float32)
        floor = index == _FLOOR
        cells = [(points[axis][floor] + self._size[axis] / 2) / _SHADOW_CELL_M for axis in (0, 1)]
        columns, rows = (np.clip(c.astype(np.int32), 0, None) for c in cells)
        light = self._floor_light
        factor[floor] = light[np.minimum(rows, light.shape[0] - 1), np.minimum(columns, light.shape[1] - 1)]
        wall = index == _WALL
        height = points[2][wall]
        top = np.float32(self._size[2]) - height
        factor[wall] = (1 - 0.3 * np.exp(-height / 0.25)) * (1 - 0.15 * np.exp(-top / 0.3))
        return factor


def visible_boxes(view: View, *, min_pixels: int = 40) -> list[VisibleBox]:
    """Boxes of the objects that show at least `min_pixels`, by rising object id."""
    boxes = []
    counts = np.bincount(view.object_ids.ravel())
    for object_id in np.flatnonzero(counts[1:] >= min_pixels) + 1:
        rows, columns = np.nonzero(view.object_ids == object_id)
        class_id = int(view.class_ids[rows[0], columns[0]])
        box = int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1
        boxes.append(VisibleBox(int(object_id), class_id, *box, pixels=int(counts[object_id])))
    return boxes


class _Surfaces:
    """Place, size, pattern and colours of every surface, as arrays to look up by pixel."""

    def __init__(self, room: ToyRoom) -> None:
        shell = [Solid((0.0, 0.0, 0.0), (9.0, 9.0, 9.0), look) for look in (room.floor, room.wall, room.ceiling)]
        solids = shell + list(room.solids)
        self._patterns = sorted({solid.material.pattern for solid in solids})
        self._pattern = np.array([self._patterns.index(solid.material.pattern) for solid in solids])
        self._centre = np.array([solid.centre_m for solid in solids], np.float32)
        self._half = np.array([solid.half_m for solid in solids], np.float32)
        self._ball = np.array([solid.ball for solid in solids])
        self._grain_up = np.array([_grows_upwards(solid) for solid in solids])
        yaw = np.array([solid.yaw_rad for solid in solids])
        self._cos, self._sin = np.cos(yaw).astype(np.float32), np.sin(yaw).astype(np.float32)
        self._salt = (np.arange(len(solids)) * 0.37).astype(np.float32)
        self._colours = np.array([_two_colours(solid.material) for solid in solids], np.float32)
        self._room_half = np.array([room.width_m, room.depth_m], np.float32) / 2

    def look(
        self, index: NDArray[np.int32], points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Unlit colour (N, 3) and light (N,) of points (3, N) in the room frame on surfaces `index` (N,)."""
        local = self._local(index, points)
        axis, normal = self._faces(index, points, local)
        u = np.where(axis == 0, local[1], local[0])
        v = np.where(axis == 2, local[1], points[2])
        along_v = self._grain_up[index] & (axis != 2)
        u, v = np.where(along_v, v, u), np.where(along_v, u, v)
        pattern = self._pattern[index]
        colour = np.empty((len(index), 3), np.float32)
        for number, name in enumerate(self._patterns):
            at = np.flatnonzero(pattern == number)
            surface = index[at]
            pair = self._colours[surface]
            colour[at] = PATTERNS[name](u[at], v[at], self._salt[surface], pair[:, 0], pair[:, 1])
        return colour, self._light(normal)

    def _local(self, index: NDArray[np.int32], points: NDArray[np.float32]) -> NDArray[np.float32]:
        """(3, N) in the frame of the solid."""
        x, y, z = points - self._centre[index].T
        cos, sin = self._cos[index], self._sin[index]
        return np.stack([cos * x + sin * y, cos * y - sin * x, z])

    def _faces(
        self, index: NDArray[np.int32], points: NDArray[np.float32], local: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Axis of the face that was hit, and the unit normal (3, N) in the room frame."""
        scaled = local / self._half[index].T
        axis = np.abs(scaled).argmax(0)
        wall = np.flatnonzero(index == _WALL)
        axis[wall] = (np.abs(points[:2, wall]) - self._room_half[:, None]).argmax(0)
        axis[(index == _FLOOR) | (index == _CEILING)] = 2
        pixels = np.arange(len(index))
        side = np.sign(scaled[axis, pixels])
        side[wall] *= -1
        side[index == _FLOOR], side[index == _CEILING] = 1, -1
        flat = np.zeros_like(scaled)
        flat[axis, pixels] = side
        ball = self._ball[index]
        flat[:, ball] = scaled[:, ball]
        cos, sin = self._cos[index], self._sin[index]
        return axis, np.stack([cos * flat[0] - sin * flat[1], sin * flat[0] + cos * flat[1], flat[2]])

    @staticmethod
    def _light(normal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Ambient light, a little more from above, and the window's light."""
        sun = np.maximum(0, _SUN[0] * normal[0] + _SUN[1] * normal[1] + _SUN[2] * normal[2])
        bounce = 0.12 * normal[0] - 0.08 * normal[1] + 0.06 * normal[2]
        return np.asarray(_AMBIENT + bounce + 0.45 * sun, np.float32)


def _grows_upwards(solid: Solid) -> bool:
    """Posts and legs: the grain of the wood follows them."""
    return solid.material.pattern == "wood" and solid.half_m[2] > max(solid.half_m[:2])


def _two_colours(material: Material) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return material.colour, material.second


def _ray_xy(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x of every column (W,) and y of every row (H,) of the rays with z = 1."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    return x.astype(np.float32), y.astype(np.float32)


def _directions(
    rotation: NDArray[np.float64], x: NDArray[np.float32], y: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Ray directions in another frame, one (H, W) array an axis: rotation times (x, y, 1)."""
    matrix = rotation.astype(np.float32)
    first, second, third = (row[0] * x[None, :] + (row[1] * y + row[2])[:, None] for row in matrix)
    return first, second, third


def _nonzero(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same values with zero made tiny, to divide by."""
    return np.where(np.abs(values) < 1e-9, np.float32(1e-9), values)


def _corners(solid: Solid) -> NDArray[np.float64]:
    """(8, 3) corners in the room frame."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    points = signs * np.array(solid.half_m)
    points[:, :2] = points[:, :2] @ turn(solid.yaw_rad).T
    return np.asarray(points + solid.centre_m)


_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)])


def _screen_window(corners: NDArray[np.float64], camera: Camera) -> tuple[slice, slice] | None:
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


def _cast_solid(
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
    directions = _directions(inverse @ rotation, x, y)
    return _cast_ball(solid, local, directions) if solid.ball else _cast_box(solid, local, directions)


def _cast_box(
    solid: Solid, origin: NDArray[np.float64], directions: tuple[NDArray[np.float32], ...]
) -> NDArray[np.float32]:
    """Slab test: the ray is inside between the last entry and the first exit of three pairs of planes."""
    entry, leave = np.float32(_NEAR_M), np.float32(np.inf)
    for d, o, h in zip(directions, origin, solid.half_m, strict=True):
        inverse = np.float32(1) / _nonzero(d)
        middle, reach = inverse * np.float32(-o), np.abs(inverse) * np.float32(h)
        entry, leave = np.maximum(entry, middle - reach), np.minimum(leave, middle + reach)
    return np.where((entry < leave) & (entry > _NEAR_M), entry, np.float32(np.inf))


def _cast_ball(
    solid: Solid, origin: NDArray[np.float64], directions: tuple[NDArray[np.float32], ...]
) -> NDArray[np.float32]:
    """Ellipsoid with holes where its noise is low: foliage. The far side shows through the holes."""
    o = (origin / solid.half_m).astype(np.float32)
    d = [direction / np.float32(h) for direction, h in zip(directions, solid.half_m, strict=True)]
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    root = b * b - a * (o @ o - np.float32(1))
    hits = root > 0
    root = np.sqrt(np.where(hits, root, 0))
    depth = np.full(a.shape, np.inf, np.float32)
    for t in ((-b + root) / a, (-b - root) / a):
        u, v = origin[0] + t * directions[0] + origin[1] + t * directions[1], origin[2] + t * directions[2]
        leaf = noise((u * 3).astype(np.float32), (v * 3).astype(np.float32)) > 0.42
        np.copyto(depth, t, where=hits & leaf & (t > _NEAR_M))
    return depth


def _floor_light(room: ToyRoom) -> NDArray[np.float32]:
    """(rows along y, columns along x) light on the floor: shadows cast by the window's light, and contact shadows."""
    shape = round(room.depth_m / _SHADOW_CELL_M), round(room.width_m / _SHADOW_CELL_M)
    cast, below = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for solid in room.solids:
        if solid.object_id == 0:
            continue
        corners = _corners(solid)
        shifted = corners[:, :2] - corners[:, 2:] * (_SUN[:2] / _SUN[2])
        for picture, points in ((cast, shifted), (below, corners[:, :2])):
            cells = (points + (room.width_m / 2, room.depth_m / 2)) / _SHADOW_CELL_M
            cv2.fillConvexPoly(picture, cv2.convexHull(cells.astype(np.int32)), 255)
    soft = cv2.GaussianBlur(cast, (0, 0), 2.5).astype(np.float32) / 255
    near = cv2.GaussianBlur(below, (0, 0), 7.0).astype(np.float32) / 255
    return np.asarray((1 - 0.3 * soft) * (1 - 0.35 * near), np.float32)
