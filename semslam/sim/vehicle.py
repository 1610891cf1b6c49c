"""The robot: where its sensors sit, how it follows a route, and what physics makes of that.

A differential-drive base of TurtleBot3 size drives in MuJoCo, its wheels held at commanded speeds; they slip. A pilot
with perfect knowledge of the pose steers. Frame `base_link`: on the floor between the wheels, x forward, z up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from semslam.errors import SemslamError
from semslam.geometry.frames import FLU_FROM_OPTICAL, Matrix, interpolate, matrix_from_pose, wrap_angle
from semslam.sim.chassis import FLOOR_GEOM, STEP_S, TRACK_M, WHEEL_RADIUS_M, model_xml
from semslam.sim.engine import require_engine
from semslam.sim.home import Array, Home
from semslam.sim.lattice import Raster
from semslam.sim.route import Leg, Route, Stretch, Turn

IMU_HZ = 200
FIRST_IMAGE_S = 0.4
AFTER_LAST_S = 0.3
_STAND_S = 0.6
"""The robot stands still for so long at first, so that gravity can be seen."""
_SETTLE_S = 0.5
"""Simulated before the first sample, for the wheels to sink onto the floor."""
_PILOT_S = 1 / IMU_HZ
_ACCELERATION_M_S2 = 0.35
_JERK_M_S3 = 1.5
_TURN_RAD_S = 1.1
_TURN_RAD_S2 = 1.6
_TURN_RAD_S3 = 10.0
_AHEAD_M = 0.22
"""The pilot steers for a point of the line so far ahead."""


@dataclass(frozen=True)
class RobotSpec:
    """Where camera and IMU sit; base_link's axes."""

    camera_height_m: float
    camera_pitch_rad: float
    """How far the nose of the camera is down."""
    camera_forward_m: float
    imu_m: tuple[float, float, float] = (-0.032, 0.0, 0.068)

    @property
    def base_from_camera(self) -> Matrix:
        """4x4 of the optical frame: x right, y down, z forward."""
        cos, sin = math.cos(self.camera_pitch_rad), math.sin(self.camera_pitch_rad)
        base_from_mount = np.eye(4)
        base_from_mount[:3, :3] = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        base_from_mount[:3, 3] = self.camera_forward_m, 0.0, self.camera_height_m
        return base_from_mount @ FLU_FROM_OPTICAL

    @property
    def base_from_imu(self) -> Matrix:
        """4x4 of the IMU, whose axes are those of the base."""
        matrix = np.eye(4)
        matrix[:3, 3] = self.imu_m
        return matrix


def draw_robot(seed: int) -> RobotSpec:
    """A robot with its camera 0.35 to 0.6 m high and its nose 2 to 9 degrees down."""
    rng = np.random.default_rng([seed, 0xB07])
    height, pitch = rng.uniform(0.35, 0.6), math.radians(rng.uniform(2.0, 9.0))
    forward, imu = rng.uniform(0.0, 0.06), rng.uniform((-0.05, -0.02, 0.05), (-0.01, 0.02, 0.08))
    return RobotSpec(float(height), pitch, float(forward), (float(imu[0]), float(imu[1]), float(imu[2])))


@dataclass(frozen=True, eq=False)
class Drive:
    """One recorded motion, free of noise, sampled at IMU_HZ from time 0."""

    times_s: Array
    """(N,)"""
    positions: Array
    """(N, 3) base_link in the world, metres."""
    orientations: Array
    """(N, 4) quaternions x, y, z, w of base_link in the world, roll and pitch of the physics included."""
    gyro: Array
    """(N, 3) rad/s, axes of the IMU."""
    accel: Array
    """(N, 3) specific force at the IMU, m/s^2: at rest gravity, upwards."""
    wheel_rad: Array
    """(N, 2) angles of the left and the right wheel."""
    contacts: int
    """Samples in which the robot touched anything but the floor."""
    keyframes_s: Array
    """(K,) times of the image pairs."""

    def world_from_base(self, time_s: float) -> Matrix:
        """4x4 at one time, exact at the samples and interpolated between them; held at the ends."""
        place = min(max(time_s * IMU_HZ, 0.0), len(self.times_s) - 1.0)
        first = min(int(place), len(self.times_s) - 2)
        if abs(place - round(place)) < 1e-6:
            return self._sample(round(place))
        return interpolate(self._sample(first), self._sample(first + 1), place - first)

    def headings(self) -> Array:
        """(N,) headings in the world, radians, without jumps."""
        x, y, z, w = self.orientations.T
        return np.unwrap(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)))

    def _sample(self, index: int) -> Matrix:
        return matrix_from_pose(self.positions[index], self.orientations[index])


def drive(home: Home, raster: Raster, robot: RobotSpec, seed: int, *, steps: int = 80, rate_hz: float = 1.0) -> Drive:
    """Drive about in a home for as long as `steps` images take.

    The motion depends on home, robot and seed alone: more steps or another rate see more or less of the same drive.

    Raises:
        SemslamError: no steps, an impossible rate, no free floor at the start of the home, or MuJoCo is not installed.
    """
    keyframes = keyframe_times(seed, steps, rate_hz)
    rng = np.random.default_rng([seed, 0x207E])
    route = Route(home, raster, robot.camera_height_m, robot.camera_pitch_rad, rng)
    samples = math.ceil((keyframes[-1] + AFTER_LAST_S) * IMU_HZ) + 1
    world = Physics(home, robot, route.pose)
    pilot = Pilot(route)
    log, contacts = np.empty((samples, _COLUMNS)), 0
    for index in range(samples):
        world.command(*pilot.steer(index / IMU_HZ, *world.pose()))
        contacts += world.touching()
        log[index] = world.advance()
    position, wxyz, wheels, gyro, accel = np.split(log, (3, 7, 9, 12), axis=1)
    times = np.arange(samples) / IMU_HZ
    return Drive(times, position, np.roll(wxyz, -1, axis=1), gyro, accel, wheels, contacts, keyframes)


_COLUMNS = 15
"""Position, quaternion (w first), wheel angles, gyro and accelerometer of a sample."""


def keyframe_times(seed: int, steps: int, rate_hz: float) -> Array:
    """(steps,) times of the images: 1 to 1.25 intervals apart, the first one while the robot stands still.

    Raises:
        SemslamError: no steps, or a rate that is not above 0.
    """
    if steps < 1:
        raise SemslamError(f"A drive of `{steps}` images shows nothing", hint="Ask for at least one, `--steps 80`.")
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise SemslamError(f"Rate `{rate_hz}` is not a number of images a second", hint="Use `--rate 1`.")
    gaps = np.random.default_rng([seed, 0x71E5]).uniform(1.0, 1.25, steps - 1) / rate_hz
    return np.asarray(FIRST_IMAGE_S + np.concatenate([[0.0], np.cumsum(gaps)]))


class Physics:
    """The simulated world; one instance per drive, for it carries the state."""

    def __init__(self, home: Home, robot: RobotSpec, pose: tuple[float, float, float]) -> None:
        require_engine()
        import mujoco

        self._model = mujoco.MjModel.from_xml_string(model_xml(home, robot.imu_m, robot.camera_height_m))
        self._data: Any = mujoco.MjData(self._model)
        self._step = mujoco.mj_step
        x, y, heading = pose
        self._data.qpos[:7] = x, y, 0.0, math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)
        self._step(self._model, self._data, round(_SETTLE_S / STEP_S))
        self._force: Array = self._data.sensordata[3:].copy()

    def pose(self) -> tuple[float, float, float]:
        """x, y and heading of the base."""
        x, y, _, qw, qx, qy, qz = self._data.qpos[:7].tolist()
        return x, y, math.atan2(2 * (qx * qy + qz * qw), 1 - 2 * (qy * qy + qz * qz))

    def command(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Set the speeds of the wheels."""
        side = turn_rad_s * TRACK_M / 2
        self._data.ctrl[:] = (speed_m_s - side) / WHEEL_RADIUS_M, (speed_m_s + side) / WHEEL_RADIUS_M

    def touching(self) -> bool:
        """Whether the robot touches anything but the floor."""
        geoms = self._data.contact.geom
        return bool(len(geoms) and (geoms.min(axis=1) != FLOOR_GEOM).any())

    def advance(self) -> Array:
        """The sample of this moment, (_COLUMNS,), after which time goes on to the next.

        MuJoCo steps velocities before positions, so the rate that belongs to a position is the mean of those before and
        after the step. Acceleration is averaged over the steps around it, as the low pass of a real sensor does: alone
        the first step after a command would feel more than its share.
        """
        state, before = self._data.qpos[:9].copy(), self._force
        self._step(self._model, self._data)
        first = self._data.sensordata.copy()
        self._step(self._model, self._data)
        second = self._data.sensordata.copy()
        self._force = second[3:]
        rate, force = (first[:3] + second[:3]) / 2, (before + 2 * first[3:] + second[3:]) / 4
        return np.concatenate([state, rate, force])


@dataclass(eq=False)
class Pilot:
    """Follows the legs of a route: speeds to command, from the true pose, every _PILOT_S."""

    route: Route
    _speed: _Smooth = field(default_factory=lambda: _Smooth(_ACCELERATION_M_S2, _JERK_M_S3))
    _turn: _Smooth = field(default_factory=lambda: _Smooth(_TURN_RAD_S2, _TURN_RAD_S3))
    _plan: Iterator[tuple[float, float]] | None = None
    _pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _time_s: float = 0.0

    def steer(self, time_s: float, x_m: float, y_m: float, heading_rad: float) -> tuple[float, float]:
        """Speed and turn rate to command now."""
        self._time_s, self._pose = time_s, (x_m, y_m, heading_rad)
        if self._plan is None:
            self._plan = self._script()
        speed, turn = next(self._plan)
        return self._speed.towards(speed), self._turn.towards(turn)

    def _script(self) -> Iterator[tuple[float, float]]:
        """Wanted speed and turn rate, call by call, for ever."""
        yield from self._stand(_STAND_S)
        while True:
            leg: Leg = self.route.next_leg(self._time_s)
            for move in leg.moves:
                yield from self._spin(move) if isinstance(move, Turn) else self._follow(move)
            yield from self._stand(leg.pause_s)

    def _stand(self, seconds: float) -> Iterator[tuple[float, float]]:
        until = self._time_s + seconds
        while self._time_s < until:
            yield 0.0, 0.0

    def _spin(self, turn: Turn) -> Iterator[tuple[float, float]]:
        """Turn on the spot, the way round that the route chose."""
        last = self._pose[2]
        left = turn.amount_rad + wrap_angle(turn.heading_rad - last - turn.amount_rad)
        while abs(left) > 0.02 or abs(self._turn.value) > 0.1:
            yield 0.0, _braked(left, _TURN_RAD_S, _TURN_RAD_S2)
            left -= wrap_angle(self._pose[2] - last)
            last = self._pose[2]

    def _follow(self, stretch: Stretch) -> Iterator[tuple[float, float]]:
        """Steer for a point ahead on the line; slower in bends, and to a stand at its end."""
        line = _prolonged(stretch.points)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        end, place = float(along[-2]), 0
        while True:
            x, y, heading = self._pose
            near = line[place : place + 12] - (x, y)
            place = min(place + int((near**2).sum(1).argmin()), len(line) - 2)
            left = end - float(along[place]) - _past(line, place, x, y)
            if left < 0.01 or (left < 0.04 and self._speed.value < 0.02):
                return
            bend = _curvature(line, along, place, (x, y, heading))
            speed = min(_braked(left, stretch.speed_m_s, _ACCELERATION_M_S2), 0.8 / max(abs(bend), 1e-6))
            yield max(speed, 0.03), min(max(bend * self._speed.value, -_TURN_RAD_S), _TURN_RAD_S)


@dataclass(eq=False)
class _Smooth:
    """A command whose rate of change is limited, and the rate of that too."""

    most: float
    """Greatest rate of change, a second."""
    jerk: float
    value: float = 0.0
    _rate: float = 0.0

    def towards(self, wanted: float) -> float:
        """The next value on the way to the wanted one."""
        gap = wanted - self.value
        rate = math.copysign(min(self.most, abs(gap) / 0.08, math.sqrt(2 * self.jerk * abs(gap))), gap)
        self._rate += min(max(rate - self._rate, -self.jerk * _PILOT_S), self.jerk * _PILOT_S)
        self.value += self._rate * _PILOT_S
        return self.value


def _braked(left: float, most: float, deceleration: float) -> float:
    """Speed from which one still stops in time, with some reserve for the jerk limit."""
    return math.copysign(min(most, math.sqrt(1.2 * deceleration * abs(left)), 4.0 * abs(left)), left)


def _prolonged(points: Array) -> Array:
    """The line with a point beyond its end, to steer for when the end is near."""
    along = points[-1] - points[-min(6, len(points))]
    return np.vstack([points, points[-1] + along / max(float(np.hypot(*along)), 1e-9) * 2 * _AHEAD_M])


def _past(line: Array, place: int, x_m: float, y_m: float) -> float:
    """How far the robot is beyond the point `place`, along the line."""
    along = line[place + 1] - line[place]
    return float(((x_m, y_m) - line[place]) @ along / max(float(np.hypot(*along)), 1e-9))


def _curvature(line: Array, along: Array, place: int, pose: tuple[float, float, float]) -> float:
    """Curvature of the arc that leads to the point ahead (pure pursuit), 1/m, left positive."""
    target = along[place] + _AHEAD_M
    x, y = (float(np.interp(target, along, line[:, axis])) for axis in (0, 1))
    away_x, away_y = x - pose[0], y - pose[1]
    sideways = math.cos(pose[2]) * away_y - math.sin(pose[2]) * away_x
    return 2.0 * sideways / max(away_x**2 + away_y**2, 1e-4)
