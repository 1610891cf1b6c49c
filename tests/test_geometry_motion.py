"""Motion from tracks of poses and from an IMU alone."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix, matrix_from_pose, rotation_from_vector, wrap_angle
from semslam.geometry.motion import ImuIntegrator, PoseTrack, motion_between

Vector = NDArray[np.float64]
SECOND = 1_000_000_000
RATE_HZ = 100
G = 9.81


def standing(x: float, y: float, heading: float) -> Matrix:
    return matrix_from_pose((x, y, 0.3), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)))


def test_a_track_is_interpolated_but_not_extrapolated() -> None:
    """Between samples, within the gap; never outside."""
    track = PoseTrack()
    assert (track.first, track.last) == (None, None)
    for second in (2, 0, 1):
        assert track.add(second * SECOND, standing(float(second), 0.0, 0.2 * second))
    assert not track.add(SECOND, standing(9.0, 9.0, 0.0))
    assert not track.add(7 * SECOND, np.full((4, 4), np.nan))
    assert (track.first, track.last) == (0, 2 * SECOND)
    assert track.at(SECOND // 2, SECOND) == pytest.approx(standing(0.5, 0.0, 0.1))
    assert track.at(SECOND // 2, SECOND - 1) is None
    assert track.at(2 * SECOND + 1, SECOND) is None
    track.forget_before(3 * SECOND // 2)
    assert track.first == SECOND


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3), st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3))
def test_relative_motion_is_seen_from_the_start(
    x: float, y: float, heading: float, dx: float, dy: float, turn: float
) -> None:
    """Wherever the track's world begins, the step is the same."""
    start, step = SE2(x, y, heading), SE2(dx, dy, turn)
    stop = start @ step
    track = PoseTrack()
    track.add(0, standing(start.x_m, start.y_m, start.heading_rad))
    track.add(SECOND, standing(stop.x_m, stop.y_m, stop.heading_rad))
    found = motion_between(track.at(0, SECOND), track.at(SECOND, SECOND))
    assert found is not None
    assert (found.x_m, found.y_m) == pytest.approx((dx, dy), abs=1e-9)
    assert wrap_angle(found.heading_rad - turn) == pytest.approx(0.0, abs=1e-9)
    assert motion_between(track.at(0, SECOND), track.at(2 * SECOND, SECOND)) is None


TILT = rotation_from_vector((0.0, 0.35, 0.0)) @ rotation_from_vector((-0.1, 0.0, 0.0))
"""level_from_body of the IMU, mounted askew."""


def filled(
    heading: Vector, acceleration: Vector, turn_rate: Vector, *, bias: float = 0.0, shake: float = 0.02
) -> ImuIntegrator:
    """An IMU on a vehicle with these headings, world accelerations (n, 2) and turn rates, 100 samples a second."""
    imu, rng = ImuIntegrator(), np.random.default_rng(0)
    for index in range(len(heading)):
        world_from_level = rotation_from_vector((0.0, 0.0, heading[index]))
        force = world_from_level.T @ np.array([*acceleration[index], G])
        gyro = TILT.T @ np.array([0.0, 0.0, turn_rate[index]]) + bias + rng.normal(0, 0.005, 3)
        stamp = round(index / RATE_HZ * SECOND)
        assert imu.add(stamp, gyro.tolist(), (TILT.T @ force + rng.normal(0, shake, 3)).tolist())
    return imu


def test_a_circle() -> None:
    """Turns are right within half a degree a step, although the IMU is tilted by 20 degrees."""
    times = np.arange(0, 10 * RATE_HZ + 1) / RATE_HZ
    rate = 0.5
    heading = rate * times
    centripetal = 0.4 * rate * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    imu = filled(heading, centripetal, np.full(len(times), rate))
    total = 0.0
    for second in range(10):
        step = imu.motion(second * SECOND, (second + 1) * SECOND, TILT[2])
        assert step is not None
        assert step.heading_rad == pytest.approx(rate, abs=math.radians(0.5))
        total += step.heading_rad
    assert total == pytest.approx(10 * rate, abs=math.radians(1.0))


def stop_and_go() -> tuple[Vector, Vector]:
    """Rest for 2 s, then 1 s of speeding up, 1 s of braking, and rest again; metres along x, and accelerations."""
    times = np.arange(0, 7 * RATE_HZ + 1) / RATE_HZ
    ahead = np.where((times >= 2) & (times < 3), 0.8, np.where((times >= 3) & (times < 4), -0.8, 0.0))
    path = np.cumsum(np.cumsum(ahead)) / RATE_HZ**2
    return path, np.stack([ahead, np.zeros(len(times))], axis=1)


def test_straight_stop_and_go() -> None:
    """From rest to rest the distance is right within a few centimetres, although up is off by half a degree.

    Uncorrected, that alone would make 38 cm.
    """
    path, acceleration = stop_and_go()
    still = np.zeros(len(path))
    imu = filled(still, acceleration, still, bias=0.004)
    up = TILT[2] @ rotation_from_vector((0.0, math.radians(0.5), 0.0))
    steps = [imu.motion(a * SECOND, b * SECOND, up) for a, b in ((1, 2), (2, 5), (5, 6))]
    x = [step.x_m for step in steps if step is not None]
    assert x == pytest.approx([0.0, 0.8, 0.0], abs=0.05)
    assert all(step is not None and abs(step.heading_rad) < math.radians(0.3) for step in steps)


def test_velocity_is_carried_from_step_to_step() -> None:
    """Cruising after speeding up still moves, although the accelerometer shows nothing."""
    path, acceleration = stop_and_go()
    acceleration[acceleration < 0] = 0.0
    still = np.zeros(len(path))
    imu = filled(still, acceleration, still, shake=0.3)  # wheels on a real floor
    first, second = (imu.motion(a * SECOND, (a + 1) * SECOND, TILT[2]) for a in (2, 3))
    assert first is not None
    assert second is not None
    assert first.x_m == pytest.approx(0.4, abs=0.1)
    assert second.x_m == pytest.approx(0.8 * math.exp(-0.5), abs=0.1)  # 0.8 if velocity did not fade


def test_nothing_is_said_without_samples() -> None:
    """No gravity, no samples, a pause, an empty step."""
    still = np.zeros(301)
    imu = filled(still, np.zeros((301, 2)), still)
    assert imu.motion(0, SECOND, None) is None
    assert imu.motion(0, 0, TILT[2]) is None
    assert imu.motion(2 * SECOND, 4 * SECOND, TILT[2]) is None
    assert ImuIntegrator().motion(0, SECOND, TILT[2]) is None
    assert not imu.add(SECOND // 2, (0.0, 0.0, math.inf), (0.0, 0.0, G))
    for index in range(50):
        imu.add(4 * SECOND + index * SECOND // RATE_HZ, (0.0, 0.0, 0.0), (0.0, 0.0, G))
    assert imu.motion(2 * SECOND, 4 * SECOND + SECOND // 4, TILT[2]) is None


def test_forgetting_changes_no_later_step() -> None:
    """A streaming reader drops what lies behind."""
    path, acceleration = stop_and_go()
    still = np.zeros(len(path))
    kept, forgetful = filled(still, acceleration, still), filled(still, acceleration, still)
    for second in range(1, 6):
        forgetful.forget_before(second * SECOND)
        step = second * SECOND, (second + 1) * SECOND
        assert kept.motion(*step, TILT[2]) == forgetful.motion(*step, TILT[2])


def test_gtsam_is_loaded_only_when_needed() -> None:
    """It costs a good part of a second, which logs with odometry need not pay."""
    code = "import sys, semslam.geometry.motion; sys.exit('gtsam' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
