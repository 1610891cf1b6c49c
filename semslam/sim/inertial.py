"""What IMU and wheels report of a drive, at the noise levels of the standard protocol.

Levels are defined per step of a recording at 1 Hz (STEP_S on average). Random errors grow with the root of time,
constant ones with time, so slower and denser images meet the same wheels. The heading of the odometry is the integral
of the measured gyro, as in robots whose wheel base takes its heading from a gyro: no topic tells more than another.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np

from semslam.sim.home import Array
from semslam.sim.vehicle import IMU_HZ, Drive

STEP_S = 1.125
"""Mean interval of images at 1 Hz, for which the levels are defined."""
ODOMETRY_HZ = 50
_EVERY = IMU_HZ // ODOMETRY_HZ


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviations; a bias is drawn once a recording."""

    position_m: float
    """Random error of a step, per axis of the robot."""
    heading_rad: float
    """Random error of a step."""
    position_bias_m: float
    """Constant error of a step, per axis."""
    heading_bias_rad: float
    """Constant error of a step."""
    tilt_rad_s: float
    """White noise of a sample of the gyro's level axes."""
    tilt_bias_rad_s: float
    """Constant error of the gyro's level axes, spread from log to log."""
    accel_m_s2: float
    """White noise of a sample of the accelerometer."""
    accel_bias_m_s2: float
    """Constant error of the accelerometer, likewise."""

    def scaled(self, factor: float) -> NoiseLevel:
        """Everything `factor` times as bad."""
        return NoiseLevel(*(factor * value for value in astuple(self)))

    @property
    def turn_rad_s(self) -> float:
        """White noise of a sample of the gyro's upright axis: its integral over a step errs by `heading_rad`."""
        return self.heading_rad * math.sqrt(IMU_HZ / STEP_S)

    @property
    def turn_bias_rad_s(self) -> float:
        """Constant error of the gyro's upright axis: its integral over a step errs by `heading_bias_rad`."""
        return self.heading_bias_rad / STEP_S


STANDARD = NoiseLevel(
    position_m=0.03,
    heading_rad=math.radians(1.5),
    position_bias_m=0.02,
    heading_bias_rad=math.radians(0.5),
    tilt_rad_s=0.003,
    tilt_bias_rad_s=0.003,
    accel_m_s2=0.03,
    accel_bias_m_s2=0.04,
)
"""The first four define the protocol (docs/simulator.md); tilt and accelerometer are of the order of MEMS parts in
small robots at 200 Hz, and no figure depends on them closely."""
LEVELS: dict[str, NoiseLevel] = {
    "none": STANDARD.scaled(0.0),
    "half": STANDARD.scaled(0.5),
    "standard": STANDARD,
    "triple": STANDARD.scaled(3.0),
}


def measure_imu(drive: Drive, level: NoiseLevel, rng: np.random.Generator) -> tuple[Array, Array]:
    """Gyro (N, 3) rad/s and accelerometer (N, 3) m/s^2 at IMU_HZ, in the axes of the IMU.

    The same `rng` gives the same errors for every level, up to their size, and for any length of the drive.
    """
    bias, white = rng.standard_normal(6), rng.standard_normal((len(drive.times_s), 6))
    constant = [level.tilt_bias_rad_s] * 2 + [level.turn_bias_rad_s] + [level.accel_bias_m_s2] * 3
    random = [level.tilt_rad_s] * 2 + [level.turn_rad_s] + [level.accel_m_s2] * 3
    error = bias * constant + white * random
    return drive.gyro + error[:, :3], drive.accel + error[:, 3:]


def measure_odometry(
    drive: Drive, gyro: Array, level: NoiseLevel, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Times (M,) at ODOMETRY_HZ, position (M, 2) and heading (M,) that the robot believes, from (0, 0, 0) at the first.

    Args:
        gyro: what `measure_imu` measured on this drive; its error turns the heading.
    """
    times, truth = drive.times_s[::_EVERY], drive.headings()
    believed = (truth - truth[0] + _turned_wrongly(drive, gyro))[::_EVERY]
    moved = _into_body(np.diff(drive.positions[::_EVERY, :2], axis=0), truth[::_EVERY])
    share = 1.0 / (ODOMETRY_HZ * STEP_S)  # of a step
    bias, white = rng.standard_normal(2), rng.standard_normal(moved.shape)
    moved = moved + bias * level.position_bias_m * share + white * level.position_m * math.sqrt(share)
    way = np.cumsum(_into_body(moved, -believed), axis=0)
    return times, np.concatenate([np.zeros((1, 2)), way]), believed


def _turned_wrongly(drive: Drive, gyro: Array) -> Array:
    """(N,) integral of the gyro's error: what it adds to the heading. The axes of base and IMU are parallel."""
    error = gyro[:, 2] - drive.gyro[:, 2]
    return np.concatenate([[0.0], np.cumsum((error[1:] + error[:-1]) / 2) / IMU_HZ])


def _into_body(vectors: Array, heading_rad: Array) -> Array:
    """(M, 2) vectors turned clockwise by the mean of the headings (M + 1,) before and after each.

    The mean, because a robot that drives and turns leaves along the chord.
    """
    middle = (heading_rad[1:] + heading_rad[:-1]) / 2
    cos, sin = np.cos(middle), np.sin(middle)
    x, y = vectors.T
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)
