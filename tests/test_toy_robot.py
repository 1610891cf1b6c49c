"""What the robot's sensors say against the motion they measure."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.toy.robot import (
    GRAVITY_M_S2,
    DrivePath,
    ImuNoise,
    OdometryNoise,
    measure_depth,
    measure_imu,
    measure_odometry,
    mount,
    optical,
    plan_path,
)
from tests.toy.toyroom import make_room

TIMES = np.arange(0, 20, 0.01)
SILENT = ImuNoise(0, 0, 0, 0)


@pytest.fixture(scope="module")
def path() -> DrivePath:
    """The loop through one room."""
    return plan_path(make_room(1), 1)


def rng(seed: int = 0) -> np.random.Generator:
    """Noise of a seed."""
    return np.random.default_rng(seed)


def test_gyro_adds_up_to_the_true_heading(path: DrivePath) -> None:
    """Without noise the integral of the turn rate follows the heading; with noise it strays no more than the bias."""
    true = np.unwrap(path.heading(TIMES))
    for noise, allowed in ((SILENT, 1e-4), (ImuNoise(), 20 * 4 * 0.003)):
        gyro, _ = measure_imu(path, TIMES, noise, rng(), np.eye(4))
        turned = np.concatenate([[0.0], np.cumsum((gyro[1:, 2] + gyro[:-1, 2]) / 2 * 0.01)])
        assert np.abs(turned - (true - true[0])).max() < allowed


def test_accelerometer_feels_gravity_and_the_curve(path: DrivePath) -> None:
    """A sensor off the turning point, nose down: its reading is the second derivative of its own position plus g."""
    base_from_imu = mount(0.3, -0.2, 0.5, pitch_rad=0.4)
    _, accel = measure_imu(path, TIMES, SILENT, rng(), base_from_imu)
    heading = path.heading(TIMES)
    cos, sin = np.cos(heading), np.sin(heading)
    arm = np.stack([0.3 * cos + 0.2 * sin, 0.3 * sin - 0.2 * cos], axis=1)
    moving = np.gradient(np.gradient(path.position(TIMES) + arm, 0.01, axis=0), 0.01, axis=0)
    body = np.stack(
        [cos * moving[:, 0] + sin * moving[:, 1], cos * moving[:, 1] - sin * moving[:, 0], np.full(2000, GRAVITY_M_S2)]
    )
    assert accel[5:-5] == pytest.approx((body.T @ base_from_imu[:3, :3])[5:-5], abs=0.02)
    assert np.abs(moving[5:-5]).max() > 0.1


def test_accelerometer_in_a_pitched_camera_shows_the_pitch(path: DrivePath) -> None:
    """In optical axes gravity lies between up (-y) and backwards (-z) as the camera looks down."""
    camera = mount(0.0, 0.0, 0.5, pitch_rad=math.radians(30)) @ optical()
    _, accel = measure_imu(path, TIMES, ImuNoise(), rng(), camera)
    mean = accel.mean(0)
    assert math.degrees(math.atan2(-mean[2], -mean[1])) == pytest.approx(30, abs=2)


def errors_a_second(path: DrivePath, noise: OdometryNoise) -> NDArray[np.float64]:
    """(recordings, steps, 3) error of steps of one second, in the axes of the robot: metres, metres, radians."""
    times = np.arange(0, 20.01, 0.05)
    true = np.column_stack([path.position(times), path.heading(times)])[::20]
    rows = []
    for seed in range(150):
        xy, heading = measure_odometry(path, times, noise, rng(seed))
        rows.append(steps_of(np.column_stack([xy, heading])[::20]) - steps_of(true))
    errors = np.array(rows)
    errors[..., 2] = (errors[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return errors


def steps_of(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) poses -> (N - 1, 3) motions in the axes of the earlier pose."""
    delta = np.diff(poses, axis=0)
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    x, y = delta[:, 0], delta[:, 1]
    return np.column_stack([cos * x + sin * y, cos * y - sin * x, delta[:, 2]])


def test_wheels_are_exact_without_noise(path: DrivePath) -> None:
    """Odometry starts at (0, 0, 0) and repeats the true motion in that frame."""
    errors = errors_a_second(path, OdometryNoise(0, 0, 0, 0))
    assert np.abs(errors).max() < 1e-9


def test_wheel_error_has_the_stated_spread_and_bias(path: DrivePath) -> None:
    """Per second 0.03 m and 1.5 degrees at random, and a constant part drawn from 0.02 m and 0.5 degrees."""
    errors = errors_a_second(path, OdometryNoise())
    within = errors.std(1).mean(0)
    between = errors.mean(1).std(0)
    assert within[2] == pytest.approx(math.radians(1.5), rel=0.1)
    assert within[:2] == pytest.approx(0.03, rel=0.15)
    assert between[2] == pytest.approx(math.hypot(math.radians(0.5), math.radians(1.5) / 20**0.5), rel=0.2)
    assert between[:2] == pytest.approx(math.hypot(0.02, 0.03 / 20**0.5), rel=0.25)


def test_depth_noise_grows_with_range_and_ends_at_the_reach() -> None:
    """Millimetres; four times the range has sixteen times the noise; beyond 8 m there is nothing."""
    near, far = (measure_depth(np.full((100, 100), z, np.float32), rng()) for z in (1.5, 6.0))
    assert near.dtype == np.uint16
    assert near.mean() == pytest.approx(1500, abs=0.5)
    assert far.std() / near.std() == pytest.approx(16, rel=0.1)
    assert not measure_depth(np.full((4, 4), 8.1, np.float32), rng()).any()
    assert not measure_depth(np.full((4, 4), 2.0, np.float32), rng(), max_depth_m=1.9).any()


def test_depth_that_is_no_number_is_missing() -> None:
    """Rays that hit nothing, and those that tell nothing, give 0 like what lies out of reach."""
    depth = np.array([[1.0, np.nan, np.inf, 9.0]], np.float32)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "invalid value encountered in cast")  # what it gives depends on the processor
        warnings.filterwarnings("ignore", "invalid value encountered in add")
        found = measure_depth(depth, rng())
    assert abs(int(found[0, 0]) - 1000) < 20
    assert found[0, 1:].tolist() == [0, 0, 0]
