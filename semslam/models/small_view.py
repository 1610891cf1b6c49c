"""A keyframe made small, as the image networks of the baselines see it: a thumbnail, and where its parts lie.

Training and run time both call `small_view`, so that a network is asked what it was taught.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix

WIDTH, HEIGHT = 128, 96
"""Of the thumbnail, pixels; pictures of another shape are squeezed, and their points stay metric."""
PART = 4
"""A part is a square of so many pixels of the thumbnail, the stride of the feature extractor."""
PARTS = (WIDTH // PART) * (HEIGHT // PART)
"""Of a thumbnail, numbered row by row."""
MIN_DEPTH_M, MAX_DEPTH_M, MAX_HEIGHT_M = 0.3, 6.0, 2.0
"""What lies nearer, farther or higher (ceilings) has no place on the ground; the defaults of `extract`."""


@dataclass(frozen=True, eq=False)
class SmallView:
    """What is left of a keyframe."""

    picture: NDArray[np.uint8]
    """(HEIGHT, WIDTH, 3) RGB."""
    ground_m: NDArray[np.float32]
    """(PARTS, 2) x and y of each part in the robot frame; NaN where it has no place."""


def small_view(
    rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    robot_from_camera: Matrix,
) -> SmallView:
    """Shrink a picture (H, W, 3), and place its parts by the depth (H, W) in the middle of each.

    Args:
        rgb: the picture.
        depth_m: along the optical axis, 0 where missing.
        fx: focal length along columns, pixels of the full picture; `fy` along rows; `cx`, `cy` the principal point.
        robot_from_camera: (4, 4), levelled robot frame from optical frame.
    """
    shrinks = rgb.shape[0] >= HEIGHT and rgb.shape[1] >= WIDTH
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    picture = cv2.resize(rgb, (WIDTH, HEIGHT), interpolation=interpolation)
    rows, columns = (_middles(pixels, parts) for pixels, parts in zip(depth_m.shape, _PART_GRID, strict=True))
    depth = depth_m[np.ix_(rows, columns)].astype(np.float64)  # (24, 32)
    rays = np.broadcast_arrays((columns - cx) / fx, ((rows - cy) / fy)[:, None], 1.0)
    points = np.stack(rays, -1) * depth[..., None]  # (24, 32, 3) in the camera
    x, y, z = np.moveaxis(points @ robot_from_camera[:3, :3].T + robot_from_camera[:3, 3], -1, 0)
    usable = (depth >= MIN_DEPTH_M) & (depth <= MAX_DEPTH_M) & (z <= MAX_HEIGHT_M)
    ground = np.where(usable[..., None], np.stack([x, y], -1), np.nan)
    return SmallView(np.asarray(picture, np.uint8), ground.reshape(PARTS, 2).astype(np.float32))


_PART_GRID = (HEIGHT // PART, WIDTH // PART)


def _middles(pixels: int, parts: int) -> NDArray[np.int64]:
    """The pixel in the middle of each of equal parts of a row."""
    return ((np.arange(parts) + 0.5) * pixels / parts).astype(np.int64)


def cells_of(ground_m: NDArray[np.float32], cell_m: float, side: int) -> NDArray[np.int64]:
    """Flat cells iy * side + ix of ground points (..., 2) on a square about the robot; side * side for none."""
    with np.errstate(invalid="ignore"):
        index = np.floor(ground_m.astype(np.float64) / cell_m + side / 2)  # NaN stays NaN
        inside = np.asarray(((index >= 0) & (index < side)).all(-1))
    column, row = np.where(inside[..., None], index, 0.0).astype(np.int64).transpose(-1, *range(index.ndim - 1))
    return np.where(inside, row * side + column, side * side)


def network_input(pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Thumbnails (..., H, W, 3) as (..., 3, H, W), 0 to 1."""
    return np.ascontiguousarray(np.moveaxis(pictures, -1, -3), np.float32) * np.float32(1 / 255)
