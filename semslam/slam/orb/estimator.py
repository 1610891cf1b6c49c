"""Keypoint SLAM as an estimator: find the picture in the map, say where the robot was, add the picture to the map.

It never looks at the motion: what it knows between two keyframes is what their pictures have in common. The camera is
tracked in all six degrees of freedom; the pose told is the robot's, on the ground plane.

- The first keyframe makes the map frame, so its pose is known even if its picture has no corners; but then there is
  nothing to find later ones in, and none of them has a pose.
- A picture that cannot be found near the last one is looked for in all keyframes, and so are all later ones until one
  is found. Those in between have no pose and leave no trace in the map.
"""

from __future__ import annotations

import numpy as np

from semslam.geometry.frames import SE2, Matrix, invert, planar
from semslam.slam.checkpoint import pack, unpack
from semslam.slam.estimator import NONE, START, VISUAL, Belief, PoseEstimate, Step, View
from semslam.slam.orb.features import Extractor, Features
from semslam.slam.orb.local_map import UNKNOWN, KeypointMap
from semslam.slam.orb.tracking import Tracked, Tracker
from semslam.stages.settings import OrbConfig


class OrbEstimator:
    """ORB-SLAM2's way with colour and depth, but for its loop closing and bundle adjustment."""

    def __init__(self, config: OrbConfig) -> None:
        self._config = config
        self._extract = Extractor(config.features)
        self._map = KeypointMap(config.max_keyframes)
        self._tracker = Tracker(config, self._map)
        self._started = False
        self._last: Tracked | None = None  # the last picture, if it was found
        self._motion: Matrix | None = None  # previous_from_current camera, if both pictures were found

    def step(self, step: Step) -> PoseEstimate:
        """Find the picture in the map; the first one makes it."""
        features = self._extract(step.view) if step.view else None
        if not self._started:
            return self._start(step.view, features)
        found = self._find(features) if features else None
        if features and found:
            found = self._learn(features, found)
        self._remember(found)
        if step.view is None or found is None:
            return PoseEstimate(None, NONE)
        return PoseEstimate(planar(found.map_from_camera @ invert(step.view.robot_from_camera)), VISUAL)

    def belief(self) -> Belief | None:
        """None: it knows points, not what stands where."""
        return None

    def state(self) -> bytes:
        """The map, the last picture's place and what it showed, and the motion up to it."""
        last, motion = self._last, self._motion
        return pack(
            {
                **self._map.arrays(),
                "started": np.array(self._started),
                "last_pose": np.zeros((0, 4)) if last is None else last.map_from_camera,
                "last_shown": np.zeros(0, np.int64) if last is None else last.shown,
                "motion": np.zeros((0, 4)) if motion is None else motion,
            }
        )

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        arrays = unpack(state)
        self._map.restore(arrays)
        self._started = bool(arrays["started"])
        pose, motion = arrays["last_pose"], arrays["motion"]
        self._last = Tracked(pose, arrays["last_shown"]) if len(pose) else None
        self._motion = motion if len(motion) else None

    def _start(self, view: View | None, features: Features | None) -> PoseEstimate:
        """The first keyframe: the map frame is its levelled robot frame."""
        self._started = True
        if view and features:
            nothing = np.full(len(features), UNKNOWN)
            self._remember(self._learn(features, Tracked(view.robot_from_camera, nothing)))
        return PoseEstimate(SE2(0.0, 0.0, 0.0), START)

    def _find(self, features: Features) -> Tracked | None:
        """The picture's place: near the last one, if that is known, or anywhere."""
        found = None
        if self._last:
            guess = None if self._motion is None else self._last.map_from_camera @ self._motion
            found = self._tracker.follow(features, guess, self._last)
        return found or self._tracker.relocalise(features)

    def _learn(self, features: Features, found: Tracked) -> Tracked:
        """Make a keyframe of a picture that shows too little of the map, and say what it shows of the map then."""
        if self._map.keyframes and self._tracker.share(found) >= self._config.keyframe_share:
            return found
        self._map.add(found.map_from_camera, features, found.shown, self._config.max_depth_m)
        return Tracked(found.map_from_camera, self._map.keyframes[-1].points)

    def _remember(self, found: Tracked | None) -> None:
        last, self._last = self._last, found
        self._motion = invert(last.map_from_camera) @ found.map_from_camera if last and found else None
