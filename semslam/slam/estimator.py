"""What an estimator is: keyframes in, poses out, with a state that can be put away and taken up.

Most tell each pose at once (`Estimator`); those of whole logs tell all at the end (`WholeLogEstimator`).

Poses are map_from_robot; the map frame is the robot frame of the first keyframe (x ahead, y left).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix
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
class View:
    """The pictures of a keyframe and where the camera was, as in the frames table."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    depth_m: NDArray[np.float32]
    """(H, W) along the optical axis, 0 where missing."""
    fx: float
    """Focal lengths and principal point, pixels; the centre of the first pixel is 0."""
    fy: float
    cx: float
    cy: float
    robot_from_camera: Matrix
    """(4, 4), levelled robot frame from optical camera frame."""


@dataclass(frozen=True)
class Step:
    """What is known at one keyframe."""

    frame: int
    stamp_nanos: int
    observation: Planes | None
    """(L, side, side) as in the observations table; None if the keyframe has none."""
    motion: SE2 | None
    """previous_from_current robot frame (u_t); None if unknown, and ignored at the first keyframe."""
    view: View | None = None
    """None for estimators that do not ask for views (registry.NEEDS_VIEWS), and where the keyframe has none."""


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
    covariance: tuple[float, ...] | None = None
    """3 x 3 of x, y and heading along the map's axes, m and rad, row by row; None if the estimator tells none."""


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


class WholeLogEstimator(Protocol):
    """A pose track that is told when all keyframes were taken, since later ones correct earlier ones."""

    def step(self, step: Step) -> None:
        """Take the next keyframe."""

    def finish(self, watch: Callable[[int], None] | None = None) -> list[PoseEstimate]:
        """The poses of all keyframes; `watch` hears how many rounds over them are done."""

    def warnings(self) -> Iterator[str]:
        """What a user should know of the finished track."""

    def rows(self) -> Iterator[dict[str, list[Any]]]:
        """Rows of the places table (data_spec.md, table 16) of the finished track."""

    def part(self) -> bytes:
        """What was taken in since the last part; equal keyframes give equal bytes."""

    def restore(self, parts: Sequence[bytes]) -> None:
        """Go on exactly where the last of these was taken, bit for bit; they are all that were taken so far."""
