"""Dead reckoning: the measured motions, one after the other (equation 3 alone). Keeps no map.

A keyframe whose motion is unknown gets no pose. The last pose is held meanwhile, so that the track goes on from there
when motion is known again: what the robot did in between is missing from every later pose.
"""

from __future__ import annotations

import numpy as np

from semslam.geometry.frames import SE2
from semslam.slam.checkpoint import pack, unpack
from semslam.slam.estimator import INERTIAL, NONE, START, Belief, PoseEstimate, Step


class DeadReckoning:
    """The track that motion alone gives; every other estimator is measured against it."""

    def __init__(self) -> None:
        self._held: SE2 | None = None

    def step(self, step: Step) -> PoseEstimate:
        """Compose the motion, or hold."""
        if self._held is None:
            self._held = SE2(0.0, 0.0, 0.0)
            return PoseEstimate(self._held, START)
        if step.motion is None:
            return PoseEstimate(None, NONE)
        self._held = self._held @ step.motion
        return PoseEstimate(self._held, INERTIAL)

    def belief(self) -> Belief | None:
        """None: there is no map to localise in."""
        return None

    def state(self) -> bytes:
        """The held pose."""
        held = self._held
        return pack({"held": np.array([] if held is None else [held.x_m, held.y_m, held.heading_rad])})

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        held = unpack(state)["held"].tolist()
        self._held = SE2(*held) if held else None
