"""Cameras: intrinsics and lens model, from pixels to rays and back, and the pinhole picture of a distorted one.

Pixels are (column, row) with the centre of the first pixel at (0, 0). Points and rays are in the optical frame
(x right, y down, z forward). Lens models are those of OpenCV, as ROS and Foxglove name them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError

NONE, BROWN, RATIONAL, EQUIDISTANT = "none", "plumb_bob", "rational_polynomial", "equidistant"

_MODEL_NAMES = {
    "": NONE,
    "none": NONE,
    "pinhole": NONE,
    "perspective": NONE,
    "undistorted": NONE,
    "plumb_bob": BROWN,
    "brown_conrady": BROWN,
    "radtan": BROWN,
    "radial_tangential": BROWN,
    "rational_polynomial": RATIONAL,
    "rational": RATIONAL,
    "equidistant": EQUIDISTANT,
    "kannala_brandt": EQUIDISTANT,
    "kannala_brandt4": EQUIDISTANT,
    "fisheye": EQUIDISTANT,
    "equi": EQUIDISTANT,
    "inverse_brown_conrady": BROWN,
}
_SENT_INVERTED = "inverse_brown_conrady"  # RealSense sends this name with zeros; with coefficients it is another model

_COEFFICIENTS = {NONE: (0,), BROWN: (0, 4, 5, 8, 12), RATIONAL: (0, 4, 5, 8, 12), EQUIDISTANT: (0, 4)}

MAX_SIDE_PX = 32_768
"""Images larger than this are refused before anything is allocated."""

MAX_HALF_VIEW_RAD = math.radians(60.0)
"""A rectified picture looks at most this far to each side: beyond, a pinhole stretches pixels more than fourfold."""

_NEWTON_STEPS = 20
_LARGEST_ANGLE_RAD = 1.57  # just below a right angle, where a ray would have no z
_REACH_STEPS = 257
_MIN_REACH = 0.3


@dataclass(frozen=True)
class Camera:
    """Size in pixels, focal lengths and principal point in pixels, lens model and its coefficients."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = NONE
    distortion: tuple[float, ...] = ()

    @staticmethod
    def from_info(width: int, height: int, k: Sequence[float], model: str, distortion: Sequence[float]) -> Camera:
        """The camera of a calibration message; `k` is the 3x3 intrinsic matrix, row by row.

        Raises:
            SemslamError: the model is unknown, has a wrong number of coefficients, or the intrinsics make no sense.
        """
        known = _model(model, distortion)
        coefficients = _coefficients(known, model, distortion)
        camera = Camera(int(width), int(height), *_intrinsics(k), known, coefficients)
        trouble = _absurdity(camera)
        if trouble:
            raise SemslamError(
                f"Camera calibration makes no sense: {trouble}",
                details=f"size  {width} x {height}\nK     {[float(value) for value in k]}",
                hint="Calibrate the camera, or record the calibration topic that belongs to this image topic.",
            )
        return camera

    @property
    def is_pinhole(self) -> bool:
        """Whether pixels are simply scaled rays: no lens model, or one whose coefficients are all zero."""
        return self.model == NONE or (self.model != EQUIDISTANT and not any(self.distortion))

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rectified(self) -> Camera:
        """The pinhole camera of the same place, direction and size that stands in for this one; itself if it is one.

        Its borders look where the middles of this camera's borders look, so a barrel-distorted picture keeps its width
        and height and loses only the corners, with no empty margin along the axes. A view beyond `MAX_HALF_VIEW_RAD`
        is cut there, and one beyond the point where the lens model folds back on itself is cut at the fold. Pixels keep
        their shape (fx : fy), for detectors know objects of true proportions.

        Raises:
            SemslamError: the lens model is unusable over most of the image.
        """
        return self if self.is_pinhole else _rectified(self)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of points (N, 3); NaN for points that are not in front of the camera."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        depth = np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
        plane = _distort(self, points[:, :2] / depth)
        return np.asarray(plane * (self.fx, self.fy) + (self.cx, self.cy))

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rays (N, 3) with z = 1 through pixels (N, 2); NaN where the lens model has no ray in front of the camera."""
        pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
        plane = _undistort(self, (pixels - (self.cx, self.cy)) / (self.fx, self.fy))
        return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)

    def scaled(self, width: int, height: int) -> Camera:
        """The camera of the same view with that many pixels, for images that were resized after calibration."""
        across, down = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * across - 0.5, (self.cy + 0.5) * down - 0.5  # pixel edges scale, not centres
        return replace(self, width=width, height=height, fx=self.fx * across, fy=self.fy * down, cx=cx, cy=cy)

    def rectify(self, image: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """The image (H, W) or (H, W, C) as `rectified()` sees it; itself for a pinhole. Empty places are 0.

        Depth takes `cv2.INTER_NEAREST`: a mean of two depths is a surface that does not exist. Depth along the optical
        axis stays what it is, since rectifying does not turn the camera.

        Raises:
            SemslamError: the image has another size than the camera.
        """
        if image.shape[:2] != (self.height, self.width):
            raise SemslamError(
                f"Image of {image.shape[1]} x {image.shape[0]} pixels, but its calibration is for "
                f"{self.width} x {self.height}"
            )
        if self.is_pinhole:
            return image
        columns, rows = _maps(self)
        return np.asarray(cv2.remap(image, columns, rows, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0))


def _model(name: str, distortion: Sequence[float]) -> str:
    key = name.strip().lower().replace("-", "_").replace(" ", "_")
    known = _MODEL_NAMES.get(key)
    if known is None or (key == _SENT_INVERTED and any(distortion)):
        choices = ", ".join(f"`{choice}`" for choice in (BROWN, RATIONAL, EQUIDISTANT, NONE))
        raise SemslamError(
            f"Lens model `{name}` with {len(distortion)} coefficients is not supported; known are {choices}",
            hint="Record rectified images, or calibrate with one of these models.",
        )
    return known


def _coefficients(model: str, name: str, distortion: Sequence[float]) -> tuple[float, ...]:
    """The coefficients in OpenCV's order; trailing zeros beyond what the model has are dropped."""
    values = [float(value) for value in distortion]
    allowed = _COEFFICIENTS[model]
    while len(values) not in allowed and values and values[-1] == 0.0:
        values.pop()
    if len(values) not in allowed or not all(map(math.isfinite, values)):
        raise SemslamError(
            f"Lens model `{name}` came with coefficients {[float(value) for value in distortion]}, "
            f"but takes {' or '.join(map(str, allowed))} finite numbers"
        )
    if model == EQUIDISTANT and not values:
        values = [0.0] * 4
    return tuple(values)


def _intrinsics(k: Sequence[float]) -> tuple[float, float, float, float]:
    if len(k) != 9:
        raise SemslamError(f"Camera matrix K has {len(k)} numbers, but takes 9")
    return float(k[0]), float(k[4]), float(k[2]), float(k[5])


def _absurdity(camera: Camera) -> str:
    """What is impossible about a camera; empty if nothing is."""
    width, height = camera.width, camera.height
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        return f"the image size {width} x {height} is not within 1 to {MAX_SIDE_PX} pixels"
    if not all(map(math.isfinite, (camera.fx, camera.fy, camera.cx, camera.cy))):
        return "K holds numbers that are not finite"
    if camera.fx == 0 or camera.fy == 0:
        return "the focal length is 0, as drivers send for an uncalibrated camera"
    for name, focal, side in (("fx", camera.fx, width), ("fy", camera.fy, height)):
        if not 0.05 * side <= focal <= 100.0 * side:
            return f"{name} = {focal:g} px does not fit an image of {side} px"
    for name, centre, side in (("cx", camera.cx, width), ("cy", camera.cy, height)):
        if not -0.5 * side <= centre <= 1.5 * side:
            return f"{name} = {centre:g} px lies far outside an image of {side} px"
    return ""


def _distort(camera: Camera, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the lens shows rays (N, 2), given as (x / z, y / z), in units of the focal length."""
    if camera.is_pinhole:
        return plane
    if camera.model == EQUIDISTANT:
        radius = np.hypot(plane[:, 0], plane[:, 1])
        angle = np.arctan(radius)
        return plane * (_bent(camera, angle) / np.where(radius > 0, radius, 1.0))[:, None]
    return _brown(camera.distortion, plane)


def _brown(coefficients: tuple[float, ...], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Brown's model with OpenCV's extensions, in its order: k1 k2 p1 p2 k3, denominator k4 k5 k6, prism s1 to s4."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = coefficients + (0.0,) * (12 - len(coefficients))
    x, y = plane[:, 0], plane[:, 1]
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    seen_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + square * s2)
    seen_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + square * s4)
    return np.stack([seen_x, seen_y], axis=1)


def _bent(camera: Camera, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Kannala-Brandt: the angle a lens draws for the true angle from its axis, radians."""
    k1, k2, k3, k4 = camera.distortion
    square = angle * angle
    return np.asarray(angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))))


def _undistort(camera: Camera, seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of `_distort`; NaN where it has none."""
    if camera.is_pinhole:
        return seen
    if camera.model == EQUIDISTANT:
        return _unbend(camera, seen)
    plane = seen.copy()
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(camera, plane, seen)
        plane = plane - step
        if not (np.abs(step) > 1e-12).any():
            break
    wrong = ~(np.abs(_distort(camera, plane) - seen).max(axis=1, initial=0.0) < 1e-7)
    plane[wrong] = np.nan
    return plane


def _newton_step(camera: Camera, plane: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Newton's step of the Brown model with a numeric Jacobian, at most 0.2 long so that it cannot jump a fold."""
    small = 1e-6
    miss = _distort(camera, plane) - seen
    by_x = (_distort(camera, plane + (small, 0.0)) - _distort(camera, plane - (small, 0.0))) / (2 * small)
    by_y = (_distort(camera, plane + (0.0, small)) - _distort(camera, plane - (0.0, small))) / (2 * small)
    determinant = by_x[:, 0] * by_y[:, 1] - by_y[:, 0] * by_x[:, 1]
    determinant = np.where(np.abs(determinant) < 1e-9, np.nan, determinant)
    step_x = (by_y[:, 1] * miss[:, 0] - by_y[:, 0] * miss[:, 1]) / determinant
    step_y = (by_x[:, 0] * miss[:, 1] - by_x[:, 1] * miss[:, 0]) / determinant
    step = np.stack([step_x, step_y], axis=1)
    length = np.hypot(step_x, step_y)[:, None]
    return np.asarray(step * np.minimum(1.0, 0.2 / np.maximum(length, 1e-300)))


def _unbend(camera: Camera, seen: NDArray[np.float64]) -> NDArray[np.float64]:
    bent = np.hypot(seen[:, 0], seen[:, 1])
    k1, k2, k3, k4 = camera.distortion
    angle = np.minimum(bent, math.pi / 2)
    for _ in range(_NEWTON_STEPS):
        square = angle * angle
        slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
        slope = np.where(np.abs(slope) < 1e-6, np.nan, slope)
        angle = np.clip(angle - (_bent(camera, angle) - bent) / slope, 0.0, _LARGEST_ANGLE_RAD)
    angle = np.where(np.abs(_bent(camera, angle) - bent) < 1e-9, angle, np.nan)
    return np.asarray(seen * (np.tan(angle) / np.where(bent > 0, bent, 1.0))[:, None])


@lru_cache(maxsize=16)
def _rectified(camera: Camera) -> Camera:
    column, row = np.clip((camera.cx, camera.cy), 0.0, (camera.width - 1, camera.height - 1))
    left, right = (_reach(camera, (column, row), (edge, row), 0) for edge in (0.0, camera.width - 1.0))
    top, bottom = (_reach(camera, (column, row), (column, edge), 1) for edge in (0.0, camera.height - 1.0))
    fx, fy = (camera.width - 1) / (right - left), (camera.height - 1) / (bottom - top)
    zoom = max(fx / camera.fx, fy / camera.fy)
    cx, cy = -left / (right - left) * (camera.width - 1), -top / (bottom - top) * (camera.height - 1)
    return Camera(camera.width, camera.height, zoom * camera.fx, zoom * camera.fy, cx, cy)


def _reach(camera: Camera, start: tuple[float, float], stop: tuple[float, float], axis: int) -> float:
    """The ray coordinate at the last usable pixel on the way from `start` to `stop`."""
    share = np.linspace(0.0, 1.0, _REACH_STEPS)[:, None]
    rays = camera.rays((1 - share) * start + share * np.asarray(stop))[:, axis]
    outward = np.diff(rays) * np.sign(stop[axis] - start[axis] or 1.0) > 0
    good = outward & (np.abs(rays[1:]) <= math.tan(MAX_HALF_VIEW_RAD))
    steps = _REACH_STEPS - 1 if good.all() else int(np.argmin(good))
    if steps < _MIN_REACH * (_REACH_STEPS - 1):
        raise SemslamError(
            f"Lens model `{camera.model}` with coefficients {list(camera.distortion)} cannot be undone beyond "
            f"{steps / (_REACH_STEPS - 1):.0%} of the way from the middle of the image to its border",
            hint="Calibrate the camera again, or record rectified images.",
        )
    return float(rays[steps])


@lru_cache(maxsize=8)
def _maps(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For each pixel of the rectified picture, the column and row of the distorted one, both (H, W)."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    rays = camera.rectified().rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    pixels = camera.project(rays).astype(np.float32).reshape(camera.height, camera.width, 2)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
