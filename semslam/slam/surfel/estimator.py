"""The estimator of whole logs: walk through all keyframes, then align all of them with each other.

Nothing is told of a keyframe before the last one was taken, since the last one may move the first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, planar
from semslam.slam.checkpoint import as_array, pack, unpack
from semslam.slam.estimator import INERTIAL, NONE, START, VISUAL, PoseEstimate, Step
from semslam.slam.surfel.sight import Sight
from semslam.slam.surfel.smoothing import smooth
from semslam.slam.surfel.surfels import Surfels
from semslam.slam.surfel.tracking import Keyframe, Place, Track, placed
from semslam.stages.settings import SurfelConfig

_Arrays = dict[str, NDArray[Any]]


class SurfelEstimator:
    """A pose track from depth, with motion where depth says nothing."""

    def __init__(self, config: SurfelConfig) -> None:
        self._config = config
        self._track = Track(config)
        self._stamps: list[int] = []
        self._kept = 0  # keyframes that earlier parts hold

    def step(self, step: Step) -> None:
        """Take the next keyframe."""
        seconds = (step.stamp_nanos - self._stamps[-1]) / 1e9 if self._stamps else 0.0
        keyframe = Keyframe.of(step.view, self._config) if step.view else None
        self._track.step(keyframe, step.motion, max(0.0, seconds))
        self._stamps.append(step.stamp_nanos)

    def finish(self, watch: Callable[[int], None] | None = None) -> list[PoseEstimate]:
        """The poses of all keyframes; `watch` hears of each round over them."""
        if not self._track.places:
            return []
        smoothed = smooth(self._track.places, self._track.prior.bias, self._config, watch)
        first = planar(smoothed.places[0].pose)  # of its tilt nothing: what is upright all keyframes tell together
        rest = zip(smoothed.places[1:], smoothed.tied[1:], strict=True)
        poses = [_estimate(place, first.between(planar(place.pose)), tied=tied) for place, tied in rest]
        return [PoseEstimate(SE2(0.0, 0.0, 0.0), START), *poses]

    def part(self) -> bytes:
        """What came since the last part, and how far the track has got."""
        new = range(self._kept, len(self._stamps))
        self._kept = len(self._stamps)
        prior = self._track.prior
        arrays: _Arrays = {"bias": prior.bias, "covariance": prior.covariance, "speed": prior.speed}
        arrays["open"] = self._track.open
        arrays["stamps"] = np.array([self._stamps[index] for index in new], np.int64)
        return pack(arrays | {str(index): as_array(_packed(self._track.places[index])) for index in new})

    def restore(self, parts: Sequence[bytes]) -> None:
        """Go on where the last of these parts was taken; they are all that were."""
        self._track, self._stamps = Track(self._config), []
        for part in parts:
            arrays = unpack(part)
            prior = self._track.prior
            prior.bias, prior.covariance, prior.speed = arrays["bias"], arrays["covariance"], arrays["speed"]
            self._track.open = arrays["open"]
            for stamp in arrays["stamps"].tolist():
                self._track.places.append(_unpacked(arrays[str(len(self._stamps))].tobytes()))
                self._stamps.append(stamp)
        self._kept = len(self._stamps)


def _estimate(place: Place, map_from_robot: SE2, *, tied: bool) -> PoseEstimate:
    if tied:
        return PoseEstimate(map_from_robot, VISUAL)
    if place.motion is None:
        return PoseEstimate(None, NONE)
    return PoseEstimate(map_from_robot, INERTIAL)


def _packed(place: Place) -> bytes:
    motion = place.motion
    arrays: _Arrays = {
        "pose": place.pose,
        "seconds": np.array(place.seconds),
        "motion": np.array([] if motion is None else [motion.x_m, motion.y_m, motion.heading_rad]),
        "linked": np.array(place.linked),
    }
    if place.keyframe:
        surfels = place.keyframe.surfels
        arrays |= {name: getattr(surfels, name).astype(np.float32) for name in ("points", "normals", "sigma_m")}
        arrays |= place.keyframe.sight.arrays()
    return pack(arrays)


def _unpacked(packed: bytes) -> Place:
    arrays = unpack(packed)
    keyframe = None
    if "points" in arrays:
        surfels = Surfels(*(arrays[name].astype(np.float64) for name in ("points", "normals", "sigma_m")))
        keyframe = Keyframe(surfels, Sight.from_arrays(arrays))
    motion = SE2(*arrays["motion"].tolist()) if arrays["motion"].size else None
    return placed(keyframe, arrays["pose"], arrays["seconds"].item(), motion, linked=arrays["linked"].item())
