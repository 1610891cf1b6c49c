"""What a user should know about a pose track: poses lost, motion missing, motion that no robot makes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from semslam.slam.checkpoint import pack, unpack
from semslam.slam.estimator import PoseEstimate, Step

JUMP_M = 5.0
JUMP_M_PER_S = 5.0
"""A step both longer and faster than this is a jump."""
MANY = 0.1
"""Motion is missing often if it is for more than this share of the steps."""


@dataclass
class TrackHealth:
    """Counts over the keyframes of a track, in the order of time."""

    uses_motion: bool
    """Whether the estimator looks at the motion at all."""
    keyframes: int = 0
    lost: int = 0
    """Keyframes without a pose."""
    still: int = 0
    """Steps without motion."""
    jumps: int = 0
    jump_m: float = 0.0
    """The longest jump, and the frames it lies between."""
    jump_from: int = 0
    jump_to: int = 0
    torn: int = 0
    """Jumps that the poses follow, or across which there is no pose."""
    frame: int = 0
    stamp_nanos: int = 0
    """Of the latest keyframe."""
    x_m: float = math.nan
    y_m: float = math.nan
    """Likewise; NaN without a pose."""

    def see(self, step: Step, estimate: PoseEstimate) -> None:
        """Take the next keyframe. The motion of the first one leads nowhere and does not count."""
        self.lost += estimate.map_from_robot is None
        pose = estimate.map_from_robot
        x_m, y_m = (pose.x_m, pose.y_m) if pose else (math.nan, math.nan)
        if self.keyframes and self.uses_motion:
            self._see_motion(step, math.hypot(x_m - self.x_m, y_m - self.y_m))
        self.keyframes += 1
        self.frame, self.stamp_nanos, self.x_m, self.y_m = step.frame, step.stamp_nanos, x_m, y_m

    def _see_motion(self, step: Step, estimated_m: float) -> None:
        if step.motion is None:
            self.still += 1
            return
        length_m = math.hypot(step.motion.x_m, step.motion.y_m)
        limit_m = max(JUMP_M, JUMP_M_PER_S * (step.stamp_nanos - self.stamp_nanos) / 1e9)
        if length_m <= limit_m:
            return
        self.jumps += 1
        self.torn += not estimated_m <= limit_m
        if length_m > self.jump_m:
            self.jump_m, self.jump_from, self.jump_to = length_m, self.frame, step.frame

    def warnings(self) -> Iterator[str]:
        """A sentence for each kind of trouble."""
        steps = max(0, self.keyframes - 1)
        if self.still > MANY * steps:
            yield f"no motion for {self.still:,} of {steps:,} steps; look at the odometry, tf or IMU of the log"
        if self.lost:
            yield f"no pose for {self.lost:,} of {self.keyframes:,} keyframes; they are missing from map and trajectory"
        if self.jumps:
            others = f", and in {self.jumps - 1:,} other steps" if self.jumps > 1 else ""
            torn = "the map may be torn there" if self.torn else "the poses do not follow it"
            where = f"between keyframes {self.jump_from} and {self.jump_to}{others}"
            yield f"odometry jumps {self.jump_m:,.0f} m {where}; {torn}"

    def state(self) -> bytes:
        """All counts."""
        names = (field.name for field in fields(self) if field.name != "uses_motion")
        return pack({name: np.array(getattr(self, name)) for name in names})

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        for name, value in unpack(state).items():
            setattr(self, name, value.item())
