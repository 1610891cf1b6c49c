"""Colour of the points that rays hit: pattern of the surface, light by its direction, shadows.

Light comes from a window direction and from all around; soft shadows on the floor are drawn once a room.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.toy.casting import CEILING, FLOOR, WALL, corners_of
from tests.toy.furniture import Colour, Solid
from tests.toy.texture import PATTERNS
from tests.toy.toyroom import ToyRoom

_SHADOW_CELL_M = 0.02
_SUN = np.array([0.45, 0.30, 0.84]) / np.linalg.norm([0.45, 0.30, 0.84])
"""Direction towards the light, room frame."""
_AMBIENT = 0.55


class Surfaces:
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
        self._colours = np.array([_two_colours(solid) for solid in solids], np.float32)
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
        wall = np.flatnonzero(index == WALL)
        axis[wall] = (np.abs(points[:2, wall]) - self._room_half[:, None]).argmax(0)
        axis[(index == FLOOR) | (index == CEILING)] = 2
        pixels = np.arange(len(index))
        side = np.sign(scaled[axis, pixels])
        side[wall] *= -1
        side[index == FLOOR], side[index == CEILING] = 1, -1
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


def occlusion(
    index: NDArray[np.int32], points: NDArray[np.float32], floor_light: NDArray[np.float32], size_m: NDArray[np.float64]
) -> NDArray[np.float32]:
    """(N,) shadows on the floor, and the darker edges where walls, floor and ceiling meet, for points (3, N)."""
    factor = np.ones(len(index), np.float32)
    floor = index == FLOOR
    cells = [(points[axis][floor] + size_m[axis] / 2) / _SHADOW_CELL_M for axis in (0, 1)]
    columns, rows = (np.clip(c.astype(np.int32), 0, None) for c in cells)
    last_row, last_column = floor_light.shape[0] - 1, floor_light.shape[1] - 1
    factor[floor] = floor_light[np.minimum(rows, last_row), np.minimum(columns, last_column)]
    wall = index == WALL
    height = points[2][wall]
    top = np.float32(size_m[2]) - height
    factor[wall] = (1 - 0.3 * np.exp(-height / 0.25)) * (1 - 0.15 * np.exp(-top / 0.3))
    return factor


def floor_light(room: ToyRoom) -> NDArray[np.float32]:
    """(rows along y, columns along x) light on the floor: shadows cast by the window's light, and contact shadows."""
    shape = round(room.depth_m / _SHADOW_CELL_M), round(room.width_m / _SHADOW_CELL_M)
    cast, below = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for solid in room.solids:
        if solid.object_id == 0:
            continue
        corners = corners_of(solid)
        shifted = corners[:, :2] - corners[:, 2:] * (_SUN[:2] / _SUN[2])
        for picture, points in ((cast, shifted), (below, corners[:, :2])):
            cells = (points + (room.width_m / 2, room.depth_m / 2)) / _SHADOW_CELL_M
            cv2.fillConvexPoly(picture, cv2.convexHull(cells.astype(np.int32)), 255)
    soft = cv2.GaussianBlur(cast, (0, 0), 2.5).astype(np.float32) / 255
    near = cv2.GaussianBlur(below, (0, 0), 7.0).astype(np.float32) / 255
    return np.asarray((1 - 0.3 * soft) * (1 - 0.35 * near), np.float32)


def _grows_upwards(solid: Solid) -> bool:
    """Posts and legs: the grain of the wood follows them."""
    return solid.material.pattern == "wood" and solid.half_m[2] > max(solid.half_m[:2])


def _two_colours(solid: Solid) -> tuple[Colour, Colour]:
    return solid.material.colour, solid.material.second
