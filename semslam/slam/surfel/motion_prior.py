"""What measured motion promises: where the robot may be by the next keyframe, and what its sensors get wrong all along.

Motion errs at random, growing with the root of time, and steadily: a wheel that is worn, a gyro that drifts. The steady
part is the same all through a log, so every step whose true motion was seen by the camera tells about it (a Kalman
filter of three numbers), and motion across a blind stretch comes out better for it. So does it tell whether this robot
errs more than it is said to, and by how much.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, wrap_angle
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

UNKNOWN_SPEED_M_S, UNKNOWN_TURN_RAD_S = 0.4, 0.5
"""Standard deviations of the motion of a robot that does not tell it."""
PAUSE_S = 5.0
"""After a longer step the robot may have been parked, and its steady errors with it: no more of them is taken off."""
_LONGEST_S = 60.0
"""In a longer step a robot that does not tell its motion gets no farther."""
_GATE = 16.0
"""A step whose squared Mahalanobis distance exceeds this tells nothing of steady errors."""
_BELIEVED = 3.0
"""Steps that the configuration is worth when errors turn out larger than it says."""
_MOST_SURPRISE = 30.0
"""A squared Mahalanobis distance, over its three degrees of freedom, counts as no more than this."""


@dataclass(frozen=True, eq=False)
class Expected:
    """A step as motion tells it."""

    motion: SE2
    covariance: Floats
    """(3, 3) of x, y and heading in the robot's axes."""


@dataclass
class MotionPrior:
    """Motion without its steady error, as far as that is known."""

    config: SurfelConfig
    bias: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) m/s, m/s and rad/s by which measured motion is too large."""
    covariance: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    speed: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) m/s, m/s and rad/s of the last step that was seen; a robot that tells no motion is thought to go on so."""
    surprise: float = 0.0
    """Sum of squared Mahalanobis distances of measured motion, each over its degrees of freedom, ..."""
    steps: float = 0.0
    """... and of how many steps; one that was seen in part counts in part."""

    @property
    def scale(self) -> float:
        """How much larger the variances of this robot's motion are than the configuration says; 1 or more."""
        return max(1.0, (_BELIEVED + self.surprise) / (_BELIEVED + self.steps))

    def __post_init__(self) -> None:
        self.covariance = np.diag(np.square(bias_sigmas(self.config)))

    def expect(self, motion: SE2 | None, seconds: float) -> Expected:
        """The true motion of a step for which this was measured."""
        if motion is None:
            x, y, heading = self.speed * min(seconds, 1.0)
            away, turn = (speed * min(seconds, _LONGEST_S) for speed in (UNKNOWN_SPEED_M_S, UNKNOWN_TURN_RAD_S))
            return Expected(SE2(x, y, wrap_angle(heading)), np.diag([away**2, away**2, turn**2]))
        x, y, heading = np.array([motion.x_m, motion.y_m, motion.heading_rad]) - self.bias * min(seconds, PAUSE_S)
        random = np.diag(np.square(noise_sigmas(self.config))) * seconds
        return Expected(SE2(x, y, wrap_angle(heading)), self.scale * (random + seconds**2 * self.covariance))

    def see(self, seen: SE2, seconds: float) -> None:
        """Keep how fast the robot went."""
        self.speed = np.array([seen.x_m, seen.y_m, seen.heading_rad]) / seconds if seconds > 0 else np.zeros(3)

    def learn(self, motion: SE2, seconds: float, seen: SE2, covariance: Floats) -> None:
        """Compare measured motion with what was seen of it; `covariance` (3, 3) is that of `seen`."""
        difference = np.array(
            [motion.x_m - seen.x_m, motion.y_m - seen.y_m, wrap_angle(motion.heading_rad - seen.heading_rad)]
        )
        surprise = difference - self.bias * seconds
        noise = covariance + np.diag(np.square(noise_sigmas(self.config))) * seconds
        spread = seconds**2 * self.covariance + noise
        squared = float(surprise @ np.linalg.solve(spread, surprise))
        if seconds <= 0:
            return
        self.surprise += min(squared / 3.0, _MOST_SURPRISE)
        self.steps += float(np.mean(1.0 - np.diag(covariance) / np.diag(spread)))
        if squared > _GATE * self.scale:
            return
        gain = seconds * self.covariance @ np.linalg.inv(spread)
        self.bias = self.bias + gain @ surprise
        self.covariance = (np.eye(3) - seconds * gain) @ self.covariance


def noise_sigmas(config: SurfelConfig) -> Floats:
    """(3,) random error of motion over a second: x, y, heading."""
    return np.array([config.position_noise_m, config.position_noise_m, config.heading_noise_rad])


def bias_sigmas(config: SurfelConfig) -> Floats:
    """(3,) steady error of motion over a second."""
    return np.array([config.position_bias_m, config.position_bias_m, config.heading_bias_rad])
