"""What an estimator is: keyframes in, poses out, one step at a time, with a state that can be put away and taken up.

Poses are map_from_robot; the map frame is the robot frame of the first keyframe (x ahead, y left).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes

START = "start"
"""The first keyframe: its pose is known, because it makes the map frame."""
VISUAL = "visual"
"""The pose comes from matching the observation with the map."""
INERTIAL = "inertial"
"""The pose comes from the previous one and the measured motion."""
NONE = "none"
"""There is no pose for this keyframe."""


@dataclass(frozen=True)
class Step:
    """What is known at one keyframe."""

    frame: int
    stamp_nanos: int
    observation: Planes | None
    """(L, side, side) as in the observations table; None if the keyframe has none."""
    motion: SE2 | None
    """previous_from_current robot frame (u_t); None if unknown, and ignored at the first keyframe."""


@dataclass(frozen=True)
class Mode:
    """A local maximum of a pose field."""

    map_from_robot: SE2
    probability: float
    """Of its bin alone."""


@dataclass(frozen=True)
class PoseEstimate:
    """What an estimator says about one keyframe."""

    map_from_robot: SE2 | None
    """None if and only if `source` is `none`."""
    source: str
    """start, visual, inertial or none."""
    peak: float | None = None
    """Probability of the best bin of the visual pose field, whichever pose was chosen; None without a field."""
    entropy_nats: float | None = None
    """Entropy of that field."""
    modes: tuple[Mode, ...] = ()
    """Its best modes, best first; empty without a field or if it is flat."""


@dataclass(frozen=True)
class Belief:
    """The map that an estimator localises in."""

    planes: Planes
    """(L, rows, columns), values 0 to 1."""
    cell_m: float
    origin_x_m: float
    """Map frame x of the lower corner of cell ix = 0."""
    origin_y_m: float


class Estimator(Protocol):
    """One pose track in the making."""

    def step(self, step: Step) -> PoseEstimate:
        """Take the next keyframe."""

    def belief(self) -> Belief | None:
        """The estimator's own map as it stands; None if it keeps none."""

    def state(self) -> bytes:
        """Everything the estimator remembers; equal memories give equal bytes."""

    def restore(self, state: bytes) -> None:
        """Go on exactly where `state` was taken, bit for bit; the configuration must be the same."""
