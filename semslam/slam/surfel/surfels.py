"""A depth image as small planes (surfels), each with how well its place along its normal is known.

With x and y such that a pixel looks along (x, y, 1), the points of a plane have 1/z = a x + b y + c: linear in the
pixel. And a camera that measures disparity (structured light, stereo) errs in 1/z alike at every range. So patches are
fitted to inverse depth by plain least squares, over 1 to 7 x 7 blocks, of which the largest that is still flat
counts: a single block of 8 x 8 pixels, seen at 3 m, tells its normal to some ten degrees only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix
from semslam.slam.estimator import View

COLUMNS = 80
"""Blocks along a row of the picture, about."""
_RADII = (0, 1, 2, 3)
"""Patches of 1 to 7 x 7 blocks."""
_FILLED = 0.6
"""Share of a patch's pixels that must have depth."""
_FLAT = (3.0, 1.5, 1.5, 1.5)
"""A patch is flat if its squared residual is below this times the picture's usual one; a block's own noise scatters."""
_ALIKE = 6.0
"""Neighbouring pixels of a depth image share their noise: so many count as one."""
_MOST_TILT_RAD = 0.25
"""A surfel whose direction is less sure than this (1 sigma) is left out."""
_GRAZING = 0.1
"""Cosine between ray and normal below which a surface is left out."""
_FLOOR_M = 0.002
_FLOOR_SHARE = 0.001
"""What averaging does not remove: calibration, 2 mm and a thousandth of the range."""
_DIRECTIONS = 1.5
"""Surfels are told apart by direction in bins of about 1 / 1.5, so that a floor does not outvote a table leg."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surfels:
    """N small planes in one frame."""

    points: Floats
    """(N, 3) metres."""
    normals: Floats
    """(N, 3) unit, towards the camera that saw them."""
    sigma_m: Floats
    """(N,) standard deviation of the place along the normal."""

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, target_from_source: Matrix) -> Surfels:
        """The same in another frame."""
        rotation, offset = target_from_source[:3, :3], target_from_source[:3, 3]
        return Surfels(self.points @ rotation.T + offset, self.normals @ rotation.T, self.sigma_m)

    def every(self, step: int) -> Surfels:
        """Every so many of them."""
        return Surfels(self.points[::step], self.normals[::step], self.sigma_m[::step])

    @staticmethod
    def joined(parts: Sequence[Surfels]) -> Surfels:
        """All in one; the parts are of one frame."""
        points, normals = (np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "normals"))
        return Surfels(points, normals, np.concatenate([part.sigma_m for part in parts]))


def surfels_of(view: View, most: int, max_depth_m: float) -> Surfels:
    """At most `most` surfels of a picture, in the robot frame, spread over directions; values exact in float32."""
    if min(view.depth_m.shape) < block_size(view.depth_m.shape[1]):
        return Surfels(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    planes = _fitted(view, max_depth_m)
    chosen = _spread(planes, most)
    points, normals, sigma_m = (
        np.asarray(values[chosen], np.float32).astype(np.float64)
        for values in (planes.points, planes.normals, planes.sigma_m)
    )
    return Surfels(points, normals, sigma_m)


def block_size(width: int) -> int:
    """Pixels along a side of a block, for pictures so wide."""
    return max(2, round(width / COLUMNS))


def _fitted(view: View, max_depth_m: float) -> Surfels:
    """One surfel a block that lies in a flat patch."""
    sums, x, y = _block_sums(view, max_depth_m)
    plane, sigma, found = np.zeros((*x.shape, 3)), np.zeros(x.shape), np.zeros(x.shape, bool)
    fits = [_fit(sums, x, y, radius, block_size(view.depth_m.shape[1])) for radius in _RADII]
    _, variances, _, enough = fits[1]  # of a block alone it is of too few pixels if the picture is small
    usual = float(np.median(variances[enough])) if enough.any() else 0.0
    for (fit, variance, shares, full), flat in zip(fits, _FLAT, strict=True):
        spread = np.sqrt(_ALIKE * np.maximum(variance, usual)[..., None] * shares)
        good = full & (variance <= flat * usual) & (fit[..., 2] > 1.0 / (1.2 * max_depth_m))
        good &= spread[..., :2].max(-1) < _MOST_TILT_RAD * np.linalg.norm(_normal(fit, x, y), axis=-1)
        plane[good] = fit[good]
        sigma[good] = spread[..., 2][good]
        found |= good
    return _placed(plane[found], sigma[found], np.stack([x, y], -1)[found], view.robot_from_camera)


def _block_sums(view: View, max_depth_m: float) -> tuple[Floats, Floats, Floats]:
    """(10, h, w) sums over blocks of 1, x, y, xx, xy, yy, q, xq, yq, qq, q = 1/z; (h, w) x and y of their middles."""
    size = block_size(view.depth_m.shape[1])
    rows, columns = (length // size for length in view.depth_m.shape)
    depth = view.depth_m[: rows * size, : columns * size].astype(np.float64)
    known = (depth > 0) & (depth < max_depth_m)
    q = np.divide(1.0, depth, out=np.zeros_like(depth), where=known)
    x = (np.arange(columns * size) - view.cx) / view.fx
    y = ((np.arange(rows * size) - view.cy) / view.fy)[:, None]
    ones = known.astype(np.float64)

    def down(values: Floats) -> Floats:
        return np.asarray(values.reshape(rows, size, -1).sum(1))

    def across(values: Floats) -> Floats:
        return np.asarray(values.reshape(rows, columns, size).sum(2))

    n, sy, syy, sq, syq = down(ones), down(ones * y), down(ones * y * y), down(q), down(q * y)
    parts = (n, n * x, sy, n * x * x, sy * x, syy, sq, sq * x, syq, down(q * q))
    middles = x.reshape(columns, size).mean(1), y.reshape(rows, size).mean(1)
    return np.stack([across(part) for part in parts]), *np.meshgrid(*middles)


def _fit(
    sums: Floats, x: Floats, y: Floats, radius: int, size: int
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Planes through patches about each block.

    Returns:
        (h, w, 3) a, b, c of 1/z = a (x - x0) + b (y - y0) + c with (x0, y0) the block's middle; (h, w) variance of the
        residuals; (h, w, 3) variances of a, b, c for residuals of variance 1; and whether the patch has depth enough.
    """
    side = 2 * radius + 1
    n, sx, sy, sxx, sxy, syy, sq, sxq, syq, sqq = (
        cv2.boxFilter(part, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT) for part in sums
    )
    full = n > _FILLED * (side * size) ** 2
    normal = np.empty((*x.shape, 3, 3))
    normal[..., 0, 0] = sxx - 2 * x * sx + x * x * n
    normal[..., 1, 1] = syy - 2 * y * sy + y * y * n
    normal[..., 2, 2] = n
    normal[..., 0, 1] = normal[..., 1, 0] = sxy - x * sy - y * sx + x * y * n
    normal[..., 0, 2] = normal[..., 2, 0] = sx - x * n
    normal[..., 1, 2] = normal[..., 2, 1] = sy - y * n
    normal[~full] = np.eye(3)
    right = np.where(full[..., None], np.stack([sxq - x * sq, syq - y * sq, sq], -1), 0.0)
    inverse = np.linalg.inv(normal)
    fit = np.einsum("hwij,hwj->hwi", inverse, right)
    squares = np.maximum(sqq - np.einsum("hwi,hwi->hw", fit, right), 0.0)
    return fit, squares / np.maximum(n - 3, 1), np.abs(np.einsum("hwii->hwi", inverse)), full


def _normal(fit: Floats, x: Floats, y: Floats) -> Floats:
    """(..., 3) normals, not of unit length, of planes (..., 3) fitted about (x, y): 1 = a X + b Y + c' Z."""
    a, b, c = fit[..., 0], fit[..., 1], fit[..., 2]
    return np.stack([a, b, c - a * x - b * y], -1)


def _placed(plane: Floats, sigma: Floats, middle: Floats, robot_from_camera: Matrix) -> Surfels:
    """Planes (N, 3) with standard deviations of their inverse depth (N,), at (N, 2), as surfels of the robot frame."""
    ray = np.concatenate([middle, np.ones((len(middle), 1))], 1)
    away = _normal(plane, *middle.T)
    normals = -away / np.linalg.norm(away, axis=1, keepdims=True)
    depth = 1.0 / plane[:, 2]
    slant = np.abs((ray * normals).sum(1))
    points = ray * depth[:, None]
    noise = depth**2 * sigma * slant
    range_m = np.linalg.norm(points, axis=1)
    sigma_m = np.sqrt(noise**2 + _FLOOR_M**2 + (_FLOOR_SHARE * range_m) ** 2)
    seen = slant > _GRAZING * np.linalg.norm(ray, axis=1)
    return Surfels(points[seen], normals[seen], sigma_m[seen]).moved(robot_from_camera)


def _spread(surfels: Surfels, most: int) -> NDArray[np.int64]:
    """Which to keep: fewer of those whose direction is common, evenly over the picture."""
    if len(surfels) <= most:
        return np.arange(len(surfels))
    bins = np.rint(surfels.normals * _DIRECTIONS).astype(np.int64) @ (25, 5, 1)
    _, place, count = np.unique(bins, return_inverse=True, return_counts=True)
    share = 1.0 / np.sqrt(count[place])
    order = np.argsort(place, kind="stable")
    until = np.cumsum(share[order])
    picked = np.searchsorted(until, (np.arange(most) + 0.5) * (until[-1] / most))
    return np.unique(order[picked])
