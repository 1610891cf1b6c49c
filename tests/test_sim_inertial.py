"""What IMU and odometry report, against the definition of the noise levels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semslam.geometry.frames import SE2
from semslam.sim.home import Array
from semslam.sim.inertial import LEVELS, ODOMETRY_HZ, STEP_S, NoiseLevel, measure_imu, measure_odometry
from semslam.sim.vehicle import IMU_HZ, Drive

STEPS = 80
SEEDS = 200


def made_drive(seconds: float = STEPS * STEP_S) -> Drive:
    """A drive along a winding curve, exact by formula: 0.3 m/s, turning to and fro."""
    times = np.arange(round(seconds * IMU_HZ) + 1) / IMU_HZ
    heading = 0.7 + 1.2 * np.sin(0.4 * times) + 0.05 * times
    fine = np.linspace(0, times[-1], 20 * (len(times) - 1) + 1)
    way = 0.3 * np.exp(1j * (0.7 + 1.2 * np.sin(0.4 * fine) + 0.05 * fine))
    path = np.concatenate([[0], np.cumsum((way[1:] + way[:-1]) / 2) * (fine[1] - fine[0])])[::20]
    zero = np.zeros_like(times)
    gyro = np.stack([zero, zero, 0.48 * np.cos(0.4 * times) + 0.05], axis=1)
    accel = np.stack([zero, 0.3 * gyro[:, 2], zero + 9.81], axis=1)
    positions = np.stack([path.real, path.imag, zero], axis=1)
    orientations = np.stack([zero, zero, np.sin(heading / 2), np.cos(heading / 2)], axis=1)
    return Drive(times, positions, orientations, gyro, accel, np.zeros((len(times), 2)), 0, times[::225])


@pytest.fixture(scope="module")
def motion() -> Drive:
    """80 steps of the standard protocol."""
    return made_drive()


def measured(motion: Drive, level: NoiseLevel, seed: int) -> tuple[Array, Array, Array, Array]:
    """Gyro, accelerometer, position and heading, each sensor from a stream of its own."""
    gyro, accel = measure_imu(motion, level, np.random.default_rng([seed, 1]))
    _, xy, heading = measure_odometry(motion, gyro, level, np.random.default_rng([seed, 2]))
    return gyro, accel, xy, heading


def step_errors(motion: Drive, level: NoiseLevel, seed: int) -> Array:
    """(STEPS, 3) x, y and heading by which the odometry of each step is wrong, in the robot's axes."""
    _, _, xy, heading = measured(motion, level, seed)
    ends = np.round(np.arange(STEPS + 1) * STEP_S * ODOMETRY_HZ).astype(int)
    real = steps(motion.positions[::4, :2][ends], motion.headings()[::4][ends])
    return steps(xy[ends], heading[ends]) - real


def steps(xy: Array, heading: Array) -> Array:
    """(K, 3) motions between poses, each in the axes of the pose before."""
    moved = np.diff(xy[:, 0] + 1j * xy[:, 1]) * np.exp(-1j * heading[:-1])
    return np.stack([moved.real, moved.imag, np.diff(heading)], axis=1)


def test_without_noise_everything_is_exact(motion: Drive) -> None:
    """Level `none`: the IMU tells the truth, and the odometry ends where the robot does."""
    gyro, accel, xy, heading = measured(motion, LEVELS["none"], 3)
    np.testing.assert_array_equal(gyro, motion.gyro)
    np.testing.assert_array_equal(accel, motion.accel)
    start = SE2(*motion.positions[0, :2], float(motion.headings()[0])).inverse()
    np.testing.assert_allclose(xy, start.apply(motion.positions[::4, :2]), atol=1e-3)
    np.testing.assert_allclose(heading, (motion.headings() - motion.headings()[0])[::4], atol=math.radians(0.05))


def test_odometry_starts_at_nothing_and_comes_at_50_hz(motion: Drive) -> None:
    """The first pose is (0, 0, 0) at the first sample; then one every 20 ms."""
    gyro, _ = measure_imu(motion, LEVELS["triple"], np.random.default_rng(1))
    times, xy, heading = measure_odometry(motion, gyro, LEVELS["triple"], np.random.default_rng(2))
    assert times[0] == 0.0
    assert (*xy[0], heading[0]) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    assert len(times) == len(xy) == len(heading)


@pytest.mark.parametrize(("name", "factor"), [("half", 0.5), ("standard", 1.0), ("triple", 3.0)])
def test_drift_is_as_defined(motion: Drive, name: str, factor: float) -> None:
    """Per step: 0.03 m an axis and 1.5 degrees at random, 0.02 m and 0.5 degrees constant in a recording."""
    errors = np.stack([step_errors(motion, LEVELS[name], seed) for seed in range(SEEDS)])  # (seeds, steps, 3)
    random = (errors - errors.mean(1, keepdims=True)).std(axis=(0, 1))
    np.testing.assert_allclose(random[2], factor * math.radians(1.5), rtol=0.05)
    # Heading errors within a step bend its path a little, which comes on top sideways.
    np.testing.assert_allclose(random[:2], factor * 0.03, rtol=0.1)
    own = factor * np.array([0.03, 0.03, math.radians(1.5)]) / math.sqrt(STEPS)
    constant = np.sqrt(errors.mean(1).var(0) - own**2)
    np.testing.assert_allclose(constant, factor * np.array([0.02, 0.02, math.radians(0.5)]), rtol=0.2)
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.3 * factor * 0.02


def test_steps_err_independently(motion: Drive) -> None:
    """The random part of one step says nothing about the next."""
    errors = np.stack([step_errors(motion, LEVELS["standard"], seed) for seed in range(40)])
    errors -= errors.mean(1, keepdims=True)
    for axis in range(3):
        pairs = np.corrcoef(errors[:, :-1, axis].ravel(), errors[:, 1:, axis].ravel())
        assert abs(pairs[0, 1]) < 0.08


def test_slower_images_meet_the_same_wheels(motion: Drive) -> None:
    """Over five steps random heading errors grow by the root of five, constant ones five times."""
    level = NoiseLevel(0.0, math.radians(1.5), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    wrong = [
        np.diff(measured(motion, level, seed)[3] - measured(motion, LEVELS["none"], seed)[3]) for seed in range(100)
    ]
    for count in (1, 5):
        width = round(count * STEP_S * ODOMETRY_HZ)
        sums = np.stack([w[: len(w) // width * width].reshape(-1, width).sum(1) for w in wrong])
        assert sums.std() == pytest.approx(math.radians(1.5) * math.sqrt(count), rel=0.06)


def test_the_heading_of_the_odometry_is_the_integral_of_the_logged_gyro(motion: Drive) -> None:
    """No topic tells more about the heading than another: both err alike, to a thousandth of the error."""
    gyro, _, _, heading = measured(motion, LEVELS["triple"], 5)
    integral = np.concatenate([[0.0], np.cumsum(gyro[1:, 2] + gyro[:-1, 2]) / 2 / IMU_HZ])[::4]
    truth = (motion.headings() - motion.headings()[0])[::4]
    assert np.abs(heading - truth).max() > 0.1
    np.testing.assert_allclose(heading, integral, atol=2e-4)


def test_tilt_and_acceleration_are_those_of_a_usual_sensor(motion: Drive) -> None:
    """White noise per sample and a constant per recording, for the axes that say nothing of the heading."""
    pairs = [measure_imu(motion, LEVELS["standard"], np.random.default_rng([s, 1])) for s in range(100)]
    wrong = np.stack([np.hstack([gyro - motion.gyro, accel - motion.accel]) for gyro, accel in pairs])[
        ..., [0, 1, 3, 4, 5]
    ]
    np.testing.assert_allclose(wrong.std(1).mean(0), [0.003] * 2 + [0.03] * 3, rtol=0.02)
    np.testing.assert_allclose(wrong.mean(1).std(0), [0.003] * 2 + [0.04] * 3, rtol=0.2)


def test_levels_differ_only_in_size(motion: Drive) -> None:
    """The same stream gives the same errors, three times as large; and a longer drive begins with the same ones."""
    one, three = (measure_imu(motion, LEVELS[name], np.random.default_rng(9))[0] for name in ("standard", "triple"))
    np.testing.assert_allclose(three - motion.gyro, 3 * (one - motion.gyro), atol=1e-12)
    brief = made_drive(9.0)
    for whole, part in zip(measured(motion, LEVELS["half"], 4), measured(brief, LEVELS["half"], 4), strict=True):
        np.testing.assert_allclose(whole[: len(part)], part, atol=1e-6)


def test_a_seed_repeats_itself_and_no_other(motion: Drive) -> None:
    """The same stream gives the same bytes; another one other errors."""
    first, again, other = (measured(motion, LEVELS["standard"], seed) for seed in (1, 1, 2))
    assert [a.tobytes() for a in first] == [a.tobytes() for a in again]
    assert all((a != b).any() for a, b in zip(first, other, strict=True))
