"""A small robot in a toy room: its path, and what its IMU, wheels and depth camera make of it.

The path is a closed, twice differentiable loop in the corridor around the table, driven again and again. The robot can
drive sideways: it looks ahead and inwards, and its heading swings slowly, so it sees the table and the walls across the
room in turn. Position is that of `base_link` on the floor; heading is counter-clockwise from the room's x axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.toy.toyroom import ToyRoom, turn

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
ROBOT_RADIUS_M = 0.18
_GRID_M = 0.05
_SPEED_M_S = 0.42
_INWARDS_RAD = 0.7
_SWING_RAD = 0.5
_SWING_PERIOD_S = 11.0
_KNOTS = 20


@dataclass(frozen=True)
class ImuNoise:
    """White noise a sample, and the spread from which the constant bias of a recording is drawn, per axis."""

    gyro_rad_s: float = 0.003
    accel_m_s2: float = 0.03
    gyro_bias_rad_s: float = 0.003
    accel_bias_m_s2: float = 0.04


@dataclass(frozen=True)
class OdometryNoise:
    """Level "standard": spread of the error of a step of one second, and of its constant part in a recording."""

    position_m: float = 0.03
    heading_rad: float = float(np.deg2rad(1.5))
    position_bias_m: float = 0.02
    heading_bias_rad: float = float(np.deg2rad(0.5))


@dataclass(frozen=True)
class DrivePath:
    """A closed uniform cubic B-spline through the corridor; any time is allowed, the loop goes on for ever."""

    knots: Array
    """(K, 2) control points, evenly spaced, room frame."""
    knots_per_s: float
    start_knot: float
    gaze_rad: float
    """Mean heading relative to the direction of travel."""
    swing_phase_rad: float

    def position(self, time_s: Array) -> Array:
        """(N, 2) metres."""
        return self._spline(time_s, 0)

    def velocity(self, time_s: Array) -> Array:
        """(N, 2) metres per second, room frame."""
        return self._spline(time_s, 1) * self.knots_per_s

    def acceleration(self, time_s: Array) -> Array:
        """(N, 2) metres per second squared, room frame."""
        return self._spline(time_s, 2) * self.knots_per_s**2

    def heading(self, time_s: Array) -> Array:
        """(N,) radians, within -pi..pi: along the path, plus gaze and swing."""
        velocity = self.velocity(time_s)
        heading = np.arctan2(velocity[:, 1], velocity[:, 0]) + self.gaze_rad
        heading += _SWING_RAD * np.sin(self._swing(time_s))
        return np.asarray((heading + np.pi) % (2 * np.pi) - np.pi)

    def turn_rate(self, time_s: Array) -> Array:
        """(N,) radians per second, the derivative of `heading`."""
        v, a = self.velocity(time_s), self.acceleration(time_s)
        bend = (v[:, 0] * a[:, 1] - v[:, 1] * a[:, 0]) / (v * v).sum(1)
        return np.asarray(bend + _SWING_RAD * 2 * np.pi / _SWING_PERIOD_S * np.cos(self._swing(time_s)))

    def _swing(self, time_s: Array) -> Array:
        return np.asarray(2 * np.pi * time_s / _SWING_PERIOD_S + self.swing_phase_rad)

    def _spline(self, time_s: Array, derivative: int) -> Array:
        """Value or derivative by knot of the spline, (N, 2)."""
        place = np.asarray(time_s, np.float64) * self.knots_per_s + self.start_knot
        whole = np.floor(place).astype(np.int64)
        powers = _powers(place - whole, derivative) @ _B_SPLINE  # (N, 4)
        around = self.knots[(whole[:, None] + np.arange(-1, 3)) % len(self.knots)]  # (N, 4, 2)
        return np.asarray(np.einsum("nk,nkd->nd", powers, around))


_B_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
"""Rows: powers 0 to 3 of the place between two knots; columns: the four control points around it."""


def plan_path(room: ToyRoom, seed: int) -> DrivePath:
    """A loop around the table that keeps clear of everything.

    Raises:
        ValueError: the furniture leaves no corridor.
    """
    rng = np.random.default_rng([seed, 0x9A7])
    clearance = clearance_grid(room)
    middle = _table_middle(room)
    angles = np.arange(2 * _KNOTS) * np.pi / _KNOTS
    ring = np.array([_corridor(clearance, room, middle, angle) for angle in angles])
    for _ in range(3):
        ring = (np.roll(ring, 1, 0) + 2 * ring + np.roll(ring, -1, 0)) / 4
    knots, length = _evenly(ring)
    gaze = _INWARDS_RAD
    if rng.random() < 0.5:
        knots, gaze = knots[::-1].copy(), -gaze
    start, phase = float(rng.uniform(0, _KNOTS)), float(rng.uniform(0, 2 * np.pi))
    path = DrivePath(knots, _SPEED_M_S * _KNOTS / length, start, gaze, phase)
    times = np.arange(0, _KNOTS / path.knots_per_s, 0.1)
    if clearance_at(clearance, room, path.position(times)).min() < ROBOT_RADIUS_M:
        raise ValueError(f"the furniture leaves no corridor of {2 * ROBOT_RADIUS_M:.2f} m around the table")
    return path


def clearance_grid(room: ToyRoom) -> NDArray[np.float32]:
    """(rows along y, columns along x) distance to the nearest footprint or wall, metres, cells of 5 cm."""
    shape = round(room.depth_m / _GRID_M), round(room.width_m / _GRID_M)
    free = np.full(shape, 255, np.uint8)
    free[[0, -1], :], free[:, [0, -1]] = 0, 0
    for item in room.objects:
        cells = (item.corners() + (room.width_m / 2, room.depth_m / 2)) / _GRID_M
        cv2.fillConvexPoly(free, np.round(cells).astype(np.int32), 0)
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5) * _GRID_M, np.float32)


def clearance_at(grid: NDArray[np.float32], room: ToyRoom, xy: Array) -> NDArray[np.float32]:
    """(N,) clearance at points (N, 2) of the room."""
    cells = np.floor((xy + (room.width_m / 2, room.depth_m / 2)) / _GRID_M).astype(np.int64)
    rows, columns = (np.clip(cells[:, axis], 0, grid.shape[1 - axis] - 1) for axis in (1, 0))
    return grid[rows, columns]


def base_pose(path: DrivePath, time_s: float) -> Array:
    """room_from_base, 4x4, at one time."""
    time = np.array([time_s])
    pose = np.eye(4)
    pose[:2, :2] = turn(float(path.heading(time)[0]))
    pose[:2, 3] = path.position(time)[0]
    return pose


def mount(forward_m: float, left_m: float, up_m: float, *, pitch_rad: float = 0.0) -> Array:
    """base_from_link, 4x4: a link with x forward and z up, its nose pitched down by `pitch_rad`."""
    cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
    pose = np.eye(4)
    pose[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    pose[:3, 3] = forward_m, left_m, up_m
    return pose


def optical(forward_m: float = 0.0, left_m: float = 0.0, up_m: float = 0.0) -> Array:
    """link_from_optical, 4x4: x right, y down, z forward, at an offset in the link's axes."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = forward_m, left_m, up_m
    return pose


def measure_imu(
    path: DrivePath, time_s: Array, noise: ImuNoise, rng: np.random.Generator, base_from_imu: Array
) -> tuple[Array, Array]:
    """Gyro (N, 3) rad/s and accelerometer (N, 3) m/s^2 of a sensor mounted at `base_from_imu` (4x4), in its own axes.

    At rest the accelerometer reads gravity, upwards. Off the turning point it also feels the turn.
    """
    turn_rate = path.turn_rate(time_s)
    turn_change = np.gradient(turn_rate, time_s)
    force = np.zeros((len(time_s), 3))
    force[:, :2] = _into_body(path.acceleration(time_s), path.heading(time_s))
    x, y = base_from_imu[:2, 3]
    force[:, 0] += -turn_change * y - turn_rate**2 * x
    force[:, 1] += turn_change * x - turn_rate**2 * y
    force[:, 2] += GRAVITY_M_S2
    spin = np.zeros_like(force)
    spin[:, 2] = turn_rate
    rotation = base_from_imu[:3, :3]
    gyro = spin @ rotation + _error(noise.gyro_bias_rad_s, noise.gyro_rad_s, len(time_s), rng)
    accel = force @ rotation + _error(noise.accel_bias_m_s2, noise.accel_m_s2, len(time_s), rng)
    return gyro, accel


def _error(bias: float, spread: float, samples: int, rng: np.random.Generator) -> Array:
    """(N, 3) a constant drawn once an axis, plus white noise."""
    return np.asarray(rng.normal(0, bias, 3) + rng.normal(0, spread, (samples, 3)))


def measure_odometry(
    path: DrivePath, time_s: Array, noise: OdometryNoise, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Position (N, 2) and heading (N,) that the wheels believe, from (0, 0, 0) at the first time.

    The error of a step grows as in `OdometryNoise`: its random part with the root of time, its constant part with
    time, both in the axes of the robot.
    """
    steps = np.diff(time_s)
    xy, heading = path.position(time_s), path.heading(time_s)
    moved = _into_body(np.diff(xy, axis=0), heading[:-1])
    turned = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    spread = np.array([noise.position_m, noise.position_m, noise.heading_rad])
    bias = rng.normal(0, 1, 3) * (noise.position_bias_m, noise.position_bias_m, noise.heading_bias_rad)
    error = bias * steps[:, None] + spread * rng.normal(0, 1, (len(steps), 3)) * np.sqrt(steps)[:, None]
    believed = np.concatenate([[0.0], np.cumsum(turned + error[:, 2])])
    cos, sin = np.cos(believed[:-1]), np.sin(believed[:-1])
    x, y = (moved + error[:, :2]).T
    way = np.cumsum(np.stack([cos * x - sin * y, sin * x + cos * y], axis=1), axis=0)
    return np.concatenate([np.zeros((1, 2)), way]), believed


def measure_depth(
    depth_m: NDArray[np.float32], rng: np.random.Generator, *, max_depth_m: float = 8.0
) -> NDArray[np.uint16]:
    """Depth as a stereo camera gives it: millimetres, noise growing with the square of range, 0 beyond its reach."""
    spread = 0.0015 * depth_m * depth_m
    noisy = depth_m + spread * rng.standard_normal(depth_m.shape, np.float32)
    seen = depth_m <= max_depth_m  # false for NaN too, which has no whole number
    return np.where(seen, np.round(noisy * 1000), 0).astype(np.uint16)


def _into_body(vectors: Array, heading_rad: Array) -> Array:
    """(N, 2) vectors of the room in the axes of a robot with those headings (N,)."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    x, y = vectors.T
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)


def _powers(place: Array, derivative: int) -> Array:
    """(N, 4) powers 0 to 3 of the place, or their first or second derivative."""
    one, zero = np.ones_like(place), np.zeros_like(place)
    rows = (
        (one, place, place**2, place**3),
        (zero, one, 2 * place, 3 * place**2),
        (zero, zero, 2 * one, 6 * place),
    )
    return np.stack(rows[derivative], axis=1)


def _table_middle(room: ToyRoom) -> Array:
    tables = [(item.x_m, item.y_m) for item in room.objects if item.class_name == "table"]
    return np.array(tables[0])


def _corridor(clearance: NDArray[np.float32], room: ToyRoom, middle: Array, angle_rad: float) -> Array:
    """The roomiest point on a ray from the table; among roomy ones, near 1.6 m."""
    radii = np.arange(0.8, 2.6, _GRID_M)
    points = middle + radii[:, None] * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    worth = np.minimum(clearance_at(clearance, room, points), 0.45) - 0.1 * np.abs(radii - 1.6)
    return np.asarray(points[int(worth.argmax())])


def _evenly(ring: Array) -> tuple[Array, float]:
    """(K, 2) points evenly spaced along a closed polygon (M, 2), and its length."""
    closed = np.vstack([ring, ring[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    places = np.arange(_KNOTS) * along[-1] / _KNOTS
    return np.stack([np.interp(places, along, closed[:, axis]) for axis in (0, 1)], axis=1), float(along[-1])
