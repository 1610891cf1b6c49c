"""Depth registered to colour, against scenes whose depth is known exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import Matrix, rotation_from_vector
from semslam.geometry.registration import register_depth

DEPTH_CAMERA = Camera(320, 240, 290.0, 291.0, 158.0, 121.0)
COLOUR_CAMERAS = {
    "same_size": Camera(320, 240, 262.0, 262.0, 160.0, 120.0),
    "half": Camera(160, 120, 131.0, 131.0, 80.0, 60.0),
    "double": Camera(640, 480, 525.0, 525.0, 320.0, 240.0),
    "triple": Camera(960, 720, 787.0, 787.0, 480.0, 360.0),
}


def offset(turn: float = 0.0) -> Matrix:
    """colour_from_depth: 2.5 cm to the side, and a small turn."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_vector((0.5 * turn, -turn, 0.3 * turn))
    matrix[:3, 3] = (-0.025, 0.004, 0.002)
    return matrix


def rays(camera: Camera) -> NDArray[np.float64]:
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    flat = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    return flat.reshape(camera.height, camera.width, 3)


def plane_depth(
    camera: Camera, normal: NDArray[np.float64], distance_m: float, camera_from_depth: Matrix
) -> NDArray[np.float64]:
    """Depth of the plane normal . X = distance, given in the depth camera's frame."""
    turned = camera_from_depth[:3, :3] @ normal
    return np.asarray((distance_m + turned @ camera_from_depth[:3, 3]) / (rays(camera) @ turned))


def inner(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Away from the border, where both cameras look."""
    margin_y, margin_x = image.shape[0] // 7, image.shape[1] // 7
    return image[margin_y:-margin_y, margin_x:-margin_x]


@pytest.mark.parametrize("colour", sorted(COLOUR_CAMERAS))
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.3, -0.7, 0.65)])
def test_a_slanted_plane_keeps_its_shape(colour: str, normal: tuple[float, float, float]) -> None:
    """Error below a tenth of a millimetre and no hole, whatever the resolution of the colour camera."""
    camera, unit, move = COLOUR_CAMERAS[colour], np.array(normal) / np.linalg.norm(normal), offset(0.03)
    measured = plane_depth(DEPTH_CAMERA, unit, 2.0, np.eye(4)).astype(np.float32)
    seen = inner(register_depth(measured, DEPTH_CAMERA, camera, move))
    wanted = inner(plane_depth(camera, unit, 2.0, move).astype(np.float32))
    assert (seen > 0).all()
    assert np.abs(seen - wanted).max() < 1e-4


def box_before_wall(camera: Camera, camera_from_depth: Matrix) -> NDArray[np.float32]:
    """Exact depth of a wall at 3 m and a square plate of 0.6 m at 1.2 m, both facing the depth camera."""
    wall = plane_depth(camera, np.array([0.0, 0.0, 1.0]), 3.0, camera_from_depth)
    plate = plane_depth(camera, np.array([0.0, 0.0, 1.0]), 1.2, camera_from_depth)
    points = rays(camera) * plate[..., None] - camera_from_depth[:3, 3]
    on_plate = np.abs(points @ camera_from_depth[:3, :3])[..., :2].max(axis=-1) < 0.3
    return np.where(on_plate, plate, wall).astype(np.float32)


@pytest.mark.parametrize("colour", sorted(COLOUR_CAMERAS))
def test_a_box_hides_the_wall_behind_it(colour: str) -> None:
    """The nearer surface wins, holes are only where no depth could be, and edges are right within a pixel or two."""
    camera, move = COLOUR_CAMERAS[colour], offset()
    seen = inner(register_depth(box_before_wall(DEPTH_CAMERA, np.eye(4)), DEPTH_CAMERA, camera, move))
    wanted = inner(box_before_wall(camera, move))
    wrong = np.abs(seen - wanted) > 1e-3
    zoom = camera.fx / DEPTH_CAMERA.fx
    edge = 4 * 0.6 / 1.2 * camera.fx  # length of the outline, pixels
    shadow = 0.025 * (1 / 1.2 - 1 / 3) * camera.fx * 0.6 / 1.2 * camera.fx  # wall that the depth camera cannot see
    assert wrong.sum() <= edge * 1.5 * max(1.0, zoom) + 1.2 * shadow
    for axis in (0, 1):
        found, expected = (np.flatnonzero(((image > 0) & (image < 2.0)).any(axis=axis)) for image in (seen, wanted))
        assert np.abs(found[[0, -1]] - expected[[0, -1]]).max() <= math.ceil(zoom)
    middle = seen[seen.shape[0] // 2, seen.shape[1] // 2]
    assert middle == pytest.approx(1.202, abs=1e-4)
    present = seen[seen > 0]
    assert np.minimum(np.abs(present - 1.202), np.abs(present - 3.002)).max() < 1e-3  # nothing hangs in between


@pytest.mark.parametrize("colour", ["same_size", "double", "triple"])
def test_the_wall_does_not_shine_through(colour: str) -> None:
    """No pixel well inside the box shows the wall, and none is empty."""
    camera = COLOUR_CAMERAS[colour]
    seen = register_depth(box_before_wall(DEPTH_CAMERA, np.eye(4)), DEPTH_CAMERA, camera, offset())
    half = int(0.2 / 1.2 * camera.fx)
    box = seen[
        camera.height // 2 - half : camera.height // 2 + half, camera.width // 2 - half : camera.width // 2 + half
    ]
    assert box == pytest.approx(1.202, abs=1e-3)


def test_the_same_camera_changes_nothing() -> None:
    """Same intrinsics, no offset: the input, bit for bit."""
    depth = np.random.default_rng(0).uniform(0.0, 5.0, (240, 320)).astype(np.float32)
    depth[::3] = 0.0
    assert np.array_equal(register_depth(depth, DEPTH_CAMERA, DEPTH_CAMERA, np.eye(4)), depth)


def test_missing_depth_stays_missing() -> None:
    """Zeros, negatives, NaN and absurd numbers give no surface, and a far hole is not filled."""
    depth = np.full((240, 320), 2.0, np.float32)
    depth[100:140, 100:140] = 0.0
    depth[:10, :10], depth[10:20, :10] = np.nan, -1.0
    depth[20:30, :10], depth[30:40, :10] = np.inf, 1e30
    seen = register_depth(depth, DEPTH_CAMERA, COLOUR_CAMERAS["same_size"], offset())
    assert np.abs(seen[seen != 0] - 2.002).max() < 1e-4
    assert 0.6 * 40 * 40 < (inner(seen) == 0).sum() < 40 * 40
    assert not register_depth(np.zeros((240, 320), np.float32), DEPTH_CAMERA, DEPTH_CAMERA, offset()).any()


def test_a_slanted_plane_keeps_its_shape_up_to_its_rim() -> None:
    """Next to missing depth the slope comes from the side that is there."""
    normal, move = np.array([0.6, 0.0, 0.8]), offset()
    measured = plane_depth(DEPTH_CAMERA, normal, 2.0, np.eye(4)).astype(np.float32)
    measured[:, 150:170] = measured[100:110] = 0.0
    seen = inner(register_depth(measured, DEPTH_CAMERA, COLOUR_CAMERAS["same_size"], move))
    wanted = inner(plane_depth(COLOUR_CAMERAS["same_size"], normal, 2.0, move).astype(np.float32))
    assert 0.8 < (seen > 0).mean() < 0.95
    assert np.abs(seen - wanted)[seen > 0].max() < 1e-4


def test_a_distorted_depth_camera_is_rectified_first() -> None:
    """A wall seen through a barrel lens is flat in the colour camera."""
    lens = Camera(320, 240, 200.0, 200.0, 160.0, 120.0, "plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0))
    wall = np.full((240, 320), 2.0, np.float32)
    seen = inner(register_depth(wall, lens, COLOUR_CAMERAS["half"], offset()))
    assert seen == pytest.approx(2.002, abs=1e-4)
