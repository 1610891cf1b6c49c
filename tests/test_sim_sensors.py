"""Sensors of simulated homes: noise as modelled, holes where they belong, pictures that stay good to look at."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.sim.home import Array
from semslam.sim.sensors import (
    FARTHEST_M,
    NEAREST_M,
    NOISE_FLOOR_M,
    NOISE_PER_M,
    STEP_PER_M,
    ColourCamera,
    draw_colour_camera,
    measure_depth,
    measure_rgb,
)
from tests.sim_box import HALF_X_M, BoxEye, BoxRobot, BoxSight, box_drive, box_home

SHAPE = (120, 160)


def flat(depth_m: float | Array, cos: float | Array = 1.0) -> BoxSight:
    """A view of surfaces with that depth and cosine to the line of sight."""
    depth, facing = (np.broadcast_to(np.asarray(value, np.float32), SHAPE) for value in (depth_m, cos))
    return BoxSight(
        np.full((*SHAPE, 3), 128, np.uint8), depth, np.zeros(SHAPE, np.uint16), np.full(SHAPE, 2, np.uint8), facing
    )


def measured(sight: BoxSight, seed: int = 0) -> NDArray[np.uint16]:
    """Depth of one frame."""
    return measure_depth(sight, np.random.default_rng(seed))  # type: ignore[arg-type]


@pytest.mark.parametrize("range_m", [0.5, 1.0, 2.0, 4.0, 6.0])
def test_noise_grows_with_the_square_of_the_range(range_m: float) -> None:
    """The spread on a wall is that of the model, rounding to steps included, and its mean is the wall."""
    found = np.concatenate([measured(flat(range_m), seed).ravel() for seed in range(8)]) / 1000.0
    found = found[found > 0]
    rounding = STEP_PER_M * range_m**2 / math.sqrt(12)
    expected = math.hypot(NOISE_PER_M * range_m**2, NOISE_FLOOR_M, rounding)
    assert found.std() == pytest.approx(expected, abs=max(0.1 * expected, 0.0003))  # close by, millimetres are coarse
    assert found.mean() == pytest.approx(range_m, abs=0.1 * expected + 0.0006)


def test_depth_comes_in_steps_that_grow_with_the_range() -> None:
    """Between two values that occur lies one step of disparity, in whole millimetres."""
    for range_m in (1.5, 3.0, 5.0):
        values = np.unique(measured(flat(np.linspace(range_m, range_m * 1.03, SHAPE[1], dtype=np.float32))))
        steps = np.diff(values[values > 0].astype(float)) / 1000.0
        assert np.median(steps) == pytest.approx(STEP_PER_M * (1.015 * range_m) ** 2, abs=0.002)


def test_what_is_too_far_or_too_near_is_missing() -> None:
    """Beyond 8 m and below 0.3 m there is nothing; inside there is, but for a few specks."""
    for outside in (0.0, 0.2, NEAREST_M - 0.02, FARTHEST_M + 0.05, 12.0):
        assert not measured(flat(outside)).any()
    for inside in (0.35, 1.0, 7.0):
        assert (measured(flat(inside)) == 0).mean() < 0.01


def test_grazing_surfaces_are_missing() -> None:
    """Nothing comes back at 3 degrees, half at 8, nearly all at 13; and what is lost lies in patches."""
    missing = {
        degrees: float((measured(flat(2.0, math.sin(math.radians(degrees)))) == 0).mean())
        for degrees in (1, 3, 8, 13, 20)
    }
    assert missing[1] > 0.98
    assert missing[3] > 0.9
    assert 0.3 < missing[8] < 0.7
    assert missing[13] < 0.05
    assert missing[20] < 0.01
    holes = measured(flat(2.0, math.sin(math.radians(8)))) == 0
    alike = (holes[:, 1:] == holes[:, :-1]).mean()
    assert alike > 0.65  # independent pixels would agree half of the time


def test_pixels_beside_an_edge_are_missing() -> None:
    """A box before a wall: a thin line on its right, a wider shadow on its left, and few pixels in between."""
    depth = np.full(SHAPE, 4.0, np.float32)
    depth[30:90, 60:100] = 1.0
    found = measured(flat(depth))
    assert (found[40:80, 57:60] == 0).all()
    assert (found[40:80, 100] == 0).all()
    assert (found[40:80, 103:110] == 0).mean() < 0.05
    box = found[40:80, 60:100]
    assert (np.abs(box[:, 1:-1].astype(int) - 1000) < 20).mean() > 0.99
    between = (box > 1050) & (box < 3900)
    assert 2 <= between.sum() <= 30
    assert not between[:, 1:-1].any()


def test_neighbours_err_alike() -> None:
    """Noise is correlated over a pixel or two, as windows of stereo matching overlap."""
    error = measured(flat(3.0)).astype(float) - 3000
    error[error < -1000] = 0
    near, far = (np.corrcoef(error[:, k:].ravel(), error[:, :-k].ravel())[0, 1] for k in (1, 8))
    assert near > 0.3
    assert abs(far) < 0.1


@pytest.mark.parametrize("real", [False, True], ids=["by hand", "MuJoCo"])
def test_depth_of_a_wall_through_the_whole_chain(real: bool) -> None:
    """Eye and sensor together give the analytic distance to the wall ahead, pixel by pixel, within the noise."""
    home, camera = box_home(()), Camera(160, 120, 80.0, 80.0, 79.5, 59.5)
    eye: Any = BoxEye(home, camera)
    if real:
        pytest.importorskip("mujoco_warp", reason="needs the renderer: pip install 'semslam[sim]'")
        from semslam.sim.eye import Eye

        eye = Eye(home, camera)
    pose = box_drive().world_from_base(0.0) @ BoxRobot().base_from_camera
    sight = eye.look(pose)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - 79.5) / 80, (v - 59.5) / 80, np.ones(u.shape)], -1) @ pose[:3, :3].T
    expected = (HALF_X_M - pose[0, 3]) / rays[..., 0]
    hit = pose[:3, 3] + rays * expected[..., None]
    wall = (rays[..., 0] > 0) & (np.abs(hit[..., 1]) < 2.4) & (hit[..., 2] > 0.1) & (hit[..., 2] < 2.5)
    assert wall.sum() > 4000
    assert sight.depth_m[wall] == pytest.approx(expected[wall], abs=2e-3)
    cos = np.abs(rays[..., 0]) / np.linalg.norm(rays, axis=-1)
    assert np.abs(sight.normals_cos[wall] - cos[wall]).mean() < 0.02
    found = measured(sight)[wall] / 1000.0
    sigma = np.sqrt((NOISE_PER_M**2 + STEP_PER_M**2 / 12) * expected[wall] ** 4 + NOISE_FLOOR_M**2)
    error = ((found - expected[wall]) / sigma)[found > 0]
    assert (found > 0).mean() > 0.97
    assert abs(error.mean()) < 0.1
    assert error.std() == pytest.approx(1.0, abs=0.15)


def picture() -> NDArray[np.uint8]:
    """Something with light, dark and colours, (480, 640, 3)."""
    rough = np.random.default_rng(5).integers(30, 226, (12, 16, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(rough, (640, 480), interpolation=cv2.INTER_CUBIC), np.uint8)


def test_colour_stays_the_picture_that_it_was() -> None:
    """Exposure, cast and noise change no more than a camera does: values follow the original closely."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found = measure_rgb(picture(), rng, draw_colour_camera(rng))
        for channel in range(3):
            assert np.corrcoef(found[..., channel].ravel(), picture()[..., channel].ravel())[0, 1] > 0.985
        assert 90 < found.mean() < 150
        assert (
            0.9
            < found[..., 0].mean() / found[..., 2].mean() / (picture()[..., 0].mean() / picture()[..., 2].mean())
            < 1.12
        )


def test_exposure_pulls_dark_and_light_rooms_to_the_middle() -> None:
    """A dark picture comes out lighter, a light one darker, by no more than a quarter, and never twice the same."""
    means = {
        value: [
            float(measure_rgb(np.full((60, 80, 3), value, np.uint8), np.random.default_rng(k)).mean()) for k in (0, 1)
        ]
        for value in (50, 120, 200)
    }
    assert 50 < means[50][0] < 70
    assert 150 < means[200][0] < 200
    assert means[120][0] == pytest.approx(120, abs=12)
    assert means[120][0] != means[120][1]


def test_light_falls_off_to_the_corners_and_noise_is_small() -> None:
    """The corners are darker than the middle; a grey wall is rough by about one value of 255."""
    found = measure_rgb(np.full((480, 640, 3), 128, np.uint8), np.random.default_rng(1), ColourCamera(vignette=0.15))
    assert 2 < found[200:280, 260:380].mean() - found[:30, :30].mean() < 15
    assert 0.4 < found[200:240, 300:340, 1].std() < 2.0


def test_the_same_randomness_gives_the_same_frames() -> None:
    """Bit for bit; other randomness, other frames."""
    sight = BoxEye(box_home(), Camera(160, 120, 80.0, 80.0, 79.5, 59.5)).look(
        box_drive().world_from_base(0.0) @ BoxRobot().base_from_camera
    )
    assert np.array_equal(measured(sight, 3), measured(sight, 3))
    assert not np.array_equal(measured(sight, 3), measured(sight, 4))
    first, again, other = (measure_rgb(sight.rgb, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
