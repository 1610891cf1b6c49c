"""Pictures of a toy room: colour, metric depth, object ids and class ids, by ray casting with a depth buffer.

Visibility comes first, for all solids (`casting`); colour is then worked out once a pixel (`shading`). The camera
frame is optical (x right, y down, z forward).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from tests.toy.casting import SHELL, cast_shell, cast_solid, corners_of, directions, ray_xy, screen_window
from tests.toy.shading import Surfaces, floor_light, occlusion
from tests.toy.toyroom import ToyRoom


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
        self._corners = np.array([corners_of(solid) for solid in room.solids]).reshape(-1, 8, 3)
        self._surfaces = Surfaces(room)
        self._floor_light = floor_light(room)
        self._object_ids = np.array([0] * SHELL + [solid.object_id for solid in room.solids], np.int32)
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

    def silhouettes(self, camera: Camera, room_from_camera: NDArray[np.float64]) -> NDArray[np.int64]:
        """(objects + 1,) pixels that each object would cover if nothing stood before it, by object id; entry 0 is 0."""
        rotation, origin = room_from_camera[:3, :3], room_from_camera[:3, 3]
        x, y = ray_xy(camera)
        in_camera = (self._corners - origin) @ rotation
        covered = np.zeros((len(self._class_ids), camera.height, camera.width), bool)
        for index, solid in enumerate(self._solids):
            window = screen_window(in_camera[index], camera)
            if window is not None and solid.object_id:
                hit = cast_solid(solid, rotation, origin, x[window[1]], y[window[0]])
                covered[solid.object_id][window] |= np.isfinite(hit)
        return np.asarray(covered.sum((1, 2)), np.int64)

    def _cast(
        self, camera: Camera, room_from_camera: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Depth and index of the nearest surface of every pixel."""
        rotation, origin = room_from_camera[:3, :3], room_from_camera[:3, 3]
        x, y = ray_xy(camera)
        depth, surface = cast_shell(self._size, rotation, origin, x, y)
        in_camera = (self._corners - origin) @ rotation  # (S, 8, 3)
        for index, solid in enumerate(self._solids):
            window = screen_window(in_camera[index], camera)
            if window is None:
                continue
            hit = cast_solid(solid, rotation, origin, x[window[1]], y[window[0]])
            nearer = hit < depth[window]
            np.copyto(depth[window], hit, where=nearer)
            np.copyto(surface[window], index + SHELL, where=nearer)
        return depth, surface

    def _shade(
        self,
        camera: Camera,
        room_from_camera: NDArray[np.float64],
        depth: NDArray[np.float32],
        surface: NDArray[np.int32],
    ) -> NDArray[np.uint8]:
        """(H, W, 3) colour of the points that were hit."""
        rotation, origin = room_from_camera[:3, :3], room_from_camera[:3, 3]
        rays = directions(rotation, *ray_xy(camera))
        points = [np.float32(o) + depth * d for o, d in zip(origin, rays, strict=True)]
        flat = np.stack([p.ravel() for p in points])  # (3, N)
        index = surface.ravel()
        colour, light = self._surfaces.look(index, flat)
        light *= occlusion(index, flat, self._floor_light, self._size)
        lit = np.clip(colour * light[:, None], 0, 1) ** np.float32(0.9)
        picture = (lit * 255).astype(np.uint8).reshape(*depth.shape, 3)
        return np.asarray(cv2.GaussianBlur(picture, (3, 3), 0.55), np.uint8)


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
