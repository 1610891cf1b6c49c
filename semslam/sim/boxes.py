"""True boxes of the objects in a view, and how much of each object the view shows.

For training and judging detectors: an object of which little is seen should be neither wanted nor punished.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.sim.eye import Sight
from semslam.sim.home import Array, Home, Placed, turn

_NEAR_M = 0.05
_MARGIN_PX = 256
"""Silhouettes are drawn this far beyond the picture's edges."""
_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class TrueBox:
    """The box of an object's visible pixels: edges in pixels, right and bottom exclusive."""

    instance: int
    class_id: int
    """Index into `Home.classes`."""
    left: int
    top: int
    right: int
    bottom: int
    pixels: int
    """Visible ones."""
    share: float
    """Visible pixels over those of its silhouette with nothing in the way, the part beyond the picture included (as far
    as 256 pixels); 0 to 1."""
    cut: bool
    """It touches the picture's edge."""


def true_boxes(home: Home, sight: Sight, camera: Camera, world_from_camera: Array) -> list[TrueBox]:
    """Of every object with a visible pixel, by instance."""
    seen = {int(instance) for instance in np.unique(sight.instances)}
    return [
        _true_box(item, sight.instances == item.instance, camera, world_from_camera)
        for item in home.objects
        if item.instance in seen
    ]


def silhouette_pixels(item: Placed, camera: Camera, world_from_camera: Array) -> int:
    """Pixels that an object alone would cover on a picture larger than the camera's by 256 pixels on every side."""
    canvas = np.zeros((camera.height + 2 * _MARGIN_PX, camera.width + 2 * _MARGIN_PX), np.uint8)
    for part in item.piece.parts:
        corners = _in_camera(part.mesh.vertices, item, world_from_camera)[part.mesh.faces]  # (F, 3, 3)
        corners = corners[(corners[..., 2] > _NEAR_M).all(1)]
        pixels = corners[..., :2] / corners[..., 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy) + _MARGIN_PX
        pixels = pixels[(np.abs(pixels) < 4 * max(canvas.shape)).all((1, 2))]
        for triangle in np.round(pixels * (1 << _SUBPIXEL_BITS)).astype(np.int32):
            cv2.fillConvexPoly(canvas, triangle, 1, shift=_SUBPIXEL_BITS)
    return int(canvas.sum())


def _true_box(item: Placed, mask: NDArray[np.bool_], camera: Camera, world_from_camera: Array) -> TrueBox:
    columns, rows = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
    left, right, top, bottom = int(columns[0]), int(columns[-1]) + 1, int(rows[0]), int(rows[-1]) + 1
    pixels, whole = int(mask.sum()), silhouette_pixels(item, camera, world_from_camera)
    cut = left == 0 or top == 0 or right == camera.width or bottom == camera.height
    share = min(1.0, pixels / max(whole, pixels))
    return TrueBox(item.instance, item.class_id, left, top, right, bottom, pixels, share, cut)


def _in_camera(vertices: NDArray[np.float32], item: Placed, world_from_camera: Array) -> Array:
    """(V, 3) vertices of a piece in the optical frame."""
    world = vertices.astype(np.float64)
    world[:, :2] = world[:, :2] @ turn(item.yaw_rad).T + (item.x_m, item.y_m)
    world[:, 2] += item.z_m
    return np.asarray((world - world_from_camera[:3, 3]) @ world_from_camera[:3, :3])
