"""Motion between two moments: from a track of poses, or, failing that, from the IMU alone.

The IMU gives the turn well and the translation poorly. A tilt error of half a degree leaks 0.09 m/s^2 of gravity into
the plane: 4 cm in the first second, and a velocity error of 9 cm/s that the next second inherits. Stops are recognised
and reset the velocity; between stops it fades (`VELOCITY_MEMORY_S`), since a wrong velocity does more harm than none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix, interpolate, planar
from semslam.geometry.levelling import GRAVITY_M_S2, level_rotation
from semslam.geometry.timeline import Timeline

Vector = NDArray[np.float64]

VELOCITY_MEMORY_S = 2.0
"""Time in which a carried velocity fades to 1/e, seconds."""
MAX_SPEED_M_S = 3.0
"""A faster velocity is drift, and forgotten."""
MAX_IMU_GAP_S = 0.1
"""Nothing is integrated across a longer pause of the IMU."""

_STILL_WINDOW_NANOS = 500_000_000  # to either side
_STILL_TURN_RAD_S = 0.015  # mean rate: the bias of a cheap gyro, but no slow turn
_STILL_GYRO_STD_RAD_S = 0.05
_STILL_ACCEL_STD_M_S2 = 0.12  # noise of a cheap accelerometer; wheels and hands shake more


class PoseTrack:
    """Stamped poses world_from_body; duplicates are ignored, and order of arrival does not matter."""

    def __init__(self) -> None:
        self._poses: Timeline[Matrix] = Timeline()

    @property
    def first(self) -> int | None:
        """The oldest stamp kept; None when empty."""
        return self._poses.first

    @property
    def last(self) -> int | None:
        """The newest stamp; None when empty."""
        return self._poses.last

    def add(self, stamp_nanos: int, world_from_body: Matrix) -> bool:
        """Take in a pose (4, 4); False if the stamp is already there or the pose is not finite."""
        if not np.isfinite(world_from_body).all():
            return False
        return self._poses.add(stamp_nanos, world_from_body)

    def at(self, stamp_nanos: int, max_gap_nanos: int) -> Matrix | None:
        """world_from_body at a stamp, interpolated; None outside the track or inside a pause longer than the gap."""
        found = self._poses.bracket(stamp_nanos, max_gap_nanos)
        if found is None:
            return None
        before, after, fraction = found
        return before if fraction == 0.0 else interpolate(before, after, fraction)

    def forget_before(self, stamp_nanos: int) -> None:
        """Drop poses that no look-up at or after the stamp needs."""
        self._poses.forget_before(stamp_nanos)


def motion_between(before: Matrix | None, after: Matrix | None) -> SE2 | None:
    """Planar motion from one pose world_from_body to another, in the body's frame at the first; None if one is missing.

    The world must be z-up.
    """
    return None if before is None or after is None else planar(before).between(planar(after))


class ImuIntegrator:
    """Planar motion from raw gyro and accelerometer, by preintegration (gtsam), step after step.

    Steps are asked for in time order; the velocity at the end of one is where the next one starts.
    """

    def __init__(self) -> None:
        self._samples: Timeline[tuple[float, ...]] = Timeline()
        self._velocity_in_body: Vector = np.zeros(3)
        self._velocity_nanos: int | None = None
        self._gyro_bias: Vector = np.zeros(3)

    def add(self, stamp_nanos: int, gyro: Sequence[float], accel: Sequence[float]) -> bool:
        """Take in angular velocity (rad/s) and specific force (m/s^2) in body axes; False if not finite or a repeat."""
        sample = tuple(float(value) for value in (*gyro, *accel))
        if len(sample) != 6 or not all(map(math.isfinite, sample)):
            return False
        return self._samples.add(stamp_nanos, sample)

    def forget_before(self, stamp_nanos: int) -> None:
        """Drop what no step from this stamp on needs."""
        self._samples.forget_before(stamp_nanos - _STILL_WINDOW_NANOS)

    def motion(self, start_nanos: int, stop_nanos: int, up: Vector | None) -> SE2 | None:
        """Motion of the body between two stamps, in its levelled frame at the first.

        Args:
            start_nanos: begin of the step; normally the end of the step before.
            stop_nanos: end of the step.
            up: direction (3,) that points up, in body axes at the begin (`GravityFilter.up_at`).

        Returns:
            None without `up`, or if the samples do not cover the step without a pause.
        """
        steps = self._steps(start_nanos, stop_nanos)
        if up is None or steps is None:
            self._velocity_nanos = None
            return None
        starts_still, stops_still = self._watch_stops(start_nanos, stop_nanos)
        velocity = np.zeros(3) if starts_still else self._carried(start_nanos)
        level_from_body = level_rotation(up)
        pose, level_velocity = self._integrate(*steps, level_from_body, velocity)
        if stops_still:
            # The velocity left over at a stop is the sum of steady errors, so half of it was there on average.
            pose[:3, 3] -= 0.5 * level_velocity * (stop_nanos - start_nanos) / 1e9
            level_velocity = np.zeros(3)
        self._velocity_in_body = pose[:3, :3].T @ level_velocity
        self._velocity_nanos = stop_nanos
        begin = np.eye(4)
        begin[:3, :3] = level_from_body
        return planar(begin).between(planar(pose))

    def _steps(self, start_nanos: int, stop_nanos: int) -> tuple[Vector, Vector] | None:
        """Lengths (n,) in seconds and mean samples (n, 6) of the intervals of the step; None if not covered."""
        margin = int(MAX_IMU_GAP_S * 1e9)
        stamps, samples = self._samples.between(start_nanos - margin, stop_nanos + margin + 1)
        if stop_nanos <= start_nanos or len(stamps) < 2:
            return None
        seconds = (np.asarray(stamps, np.int64) - start_nanos) / 1e9
        length = (stop_nanos - start_nanos) / 1e9
        inside = seconds[(seconds > 0) & (seconds < length)]
        times = np.concatenate([[0.0], inside, [length]])
        covered = seconds[0] <= MAX_IMU_GAP_S and seconds[-1] >= length - MAX_IMU_GAP_S
        if not covered or np.diff(times).max() > MAX_IMU_GAP_S:
            return None
        values = np.asarray(samples, np.float64)
        at_times = np.stack([np.interp(times, seconds, values[:, axis]) for axis in range(6)], axis=1)
        return np.diff(times), 0.5 * (at_times[1:] + at_times[:-1])

    def _carried(self, start_nanos: int) -> Vector:
        """Velocity in body axes at the begin of a step, faded; zero if the steps before do not lead here."""
        if self._velocity_nanos != start_nanos or np.linalg.norm(self._velocity_in_body) > MAX_SPEED_M_S:
            return np.zeros(3)
        return self._velocity_in_body

    def _watch_stops(self, start_nanos: int, stop_nanos: int) -> tuple[bool, bool]:
        """Whether the body rests at either end; rest also tells the gyro's bias."""
        still = []
        for stamp in (start_nanos, stop_nanos):
            rate = self._resting_rate(stamp)
            still.append(rate is not None)
            if rate is not None:
                self._gyro_bias = rate
        return still[0], still[1]

    def _resting_rate(self, stamp_nanos: int) -> Vector | None:
        """Mean angular velocity (3,) around a stamp if the body rests there, else None."""
        window = self._samples.between(stamp_nanos - _STILL_WINDOW_NANOS, stamp_nanos + _STILL_WINDOW_NANOS + 1)
        if len(window[0]) < 10 or window[0][-1] - window[0][0] < _STILL_WINDOW_NANOS * 4 // 5:
            return None
        values = np.asarray(window[1], np.float64)
        rate, spread = values[:, :3].mean(axis=0), values.std(axis=0)
        resting = (
            np.linalg.norm(rate) < _STILL_TURN_RAD_S
            and spread[:3].max() < _STILL_GYRO_STD_RAD_S
            and spread[3:].max() < _STILL_ACCEL_STD_M_S2
        )
        return np.asarray(rate) if resting else None

    def _integrate(
        self, lengths_s: Vector, samples: Vector, level_from_body: Vector, velocity_in_body: Vector
    ) -> tuple[Matrix, Vector]:
        """Pose (4, 4) at the end in the level frame of the begin, and velocity (3,) there."""
        import gtsam  # loading it takes a good part of a second, and most logs have better sources than the IMU

        bias = gtsam.imuBias.ConstantBias(np.zeros(3), self._gyro_bias)
        measured: Any = gtsam.PreintegratedImuMeasurements(_parameters(gtsam), bias)
        for length, sample in zip(lengths_s.tolist(), samples, strict=True):
            measured.integrateMeasurement(sample[3:], sample[:3], length)
        velocity = level_from_body @ velocity_in_body
        velocity *= math.exp(-float(lengths_s.sum()) / VELOCITY_MEMORY_S)
        state = gtsam.NavState(gtsam.Rot3(level_from_body), np.zeros(3), velocity)
        end = measured.predict(state, bias)
        return np.asarray(end.pose().matrix(), np.float64), np.asarray(end.velocity(), np.float64)


def _parameters(gtsam: Any) -> Any:
    """Gravity along -z of the level frame; the noise densities do not matter, as no covariance is asked for."""
    parameters = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    parameters.setGyroscopeCovariance(1e-6 * np.eye(3))
    parameters.setAccelerometerCovariance(1e-4 * np.eye(3))
    parameters.setIntegrationCovariance(1e-8 * np.eye(3))
    return parameters
