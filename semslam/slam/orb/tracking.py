"""Where a picture was taken: along the last motion, else from a keyframe like it; then against the local map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semslam.geometry.frames import Matrix, invert
from semslam.slam.orb.features import Features, Ints
from semslam.slam.orb.local_map import UNKNOWN, KeypointMap
from semslam.slam.orb.matching import Pairs, match_anywhere, match_expected
from semslam.slam.orb.pose import LOOSE, Sightings, fit_pose, guess_pose
from semslam.stages.settings import OrbConfig

_WIDE_PX, _NARROW_PX = 15.0, 5.0
"""How far from its expected place a point is looked for: after a guess of the motion, and after a first fit."""
_PASSES = 4
"""Of a place against the local map, at most."""
_CANDIDATES = 5
"""Keyframes that relocalisation tries, most similar first."""


@dataclass(frozen=True)
class Tracked:
    """A picture with its place in the map."""

    map_from_camera: Matrix
    shown: Ints
    """(N,) the point that each keypoint shows, or UNKNOWN."""

    @property
    def inliers(self) -> int:
        """Keypoints whose points agree with the pose."""
        return int((self.shown != UNKNOWN).sum())


class Tracker:
    """Finds pictures in a map that it never changes."""

    def __init__(self, config: OrbConfig, keypoint_map: KeypointMap) -> None:
        self._config = config
        self._map = keypoint_map

    def follow(self, features: Features, guess: Matrix | None, last: Tracked) -> Tracked | None:
        """From the guess of a constant motion if there is one, and from the keyframe most like the last picture.

        ORB-SLAM2 asks for the second only if the first fails. But where pictures lie a second apart, a wrong guess may
        find enough points on a floor of even planks, one plank too far: the place that more points agree with wins.
        """
        akin = self._map.akin(last.shown)
        first = [self._like(features, self._similar(features, akin[0]))]
        if guess is not None:
            first.append(self._near(features, self._around(akin), guess, _WIDE_PX))
        places = [self._confirmed(features, place, self._config.map_inliers) for place in first]
        return max((place for place in places if place), key=lambda place: place.inliers, default=None)

    def relocalise(self, features: Features) -> Tracked | None:
        """From the keyframes whose descriptors match best, wherever they are."""
        pairs = [self._similar(features, index) for index in range(len(self._map.keyframes))]
        best = sorted(range(len(pairs)), key=lambda index: (-len(pairs[index]), -index))
        for index in best[:_CANDIDATES]:
            like = self._like(features, pairs[index])
            found = self._confirmed(features, like, self._config.relocalise_inliers)
            if found:
                return found
        return None

    def share(self, tracked: Tracked) -> float:
        """How many points a picture shows for each one that the keyframe most like it shows."""
        reference = self._map.keyframes[self._map.akin(tracked.shown)[0]]
        return tracked.inliers / max(len(reference.known), 1)

    def _similar(self, features: Features, index: int) -> Pairs:
        """Keypoints that look like known ones of a keyframe."""
        keyframe = self._map.keyframes[index]
        pairs = match_anywhere(features.descriptors, keyframe.descriptors[keyframe.known], self._config.ratio)
        return Pairs(pairs.keypoints, keyframe.points[keyframe.known[pairs.points]])

    def _like(self, features: Features, pairs: Pairs) -> Tracked | None:
        """The picture placed by what it has in common with one keyframe."""
        if len(pairs) < self._config.min_matches:
            return None
        sightings = self._sightings(features, pairs)
        guess = guess_pose(sightings, self._config.inlier_px)
        return None if guess is None else self._fitted(features, pairs, guess, LOOSE * self._config.inlier_px)

    def _near(self, features: Features, numbers: Ints, guess: Matrix, radius_px: float) -> Tracked | None:
        """The picture placed by points that are found near where a guess of its pose expects them."""
        camera_from_map = invert(guess)
        visible, expected = self._map.expect(numbers, camera_from_map, features.camera)
        pairs = match_expected(features, expected, radius_px, self._config.ratio)
        if len(pairs) < self._config.min_matches:
            return None
        return self._fitted(features, Pairs(pairs.keypoints, visible[pairs.points]), camera_from_map, np.inf)

    def _confirmed(self, features: Features, place: Tracked | None, enough: int) -> Tracked | None:
        """A first placement again and again with all points around, while more agree; None if too few do at last."""
        for _ in range(_PASSES):
            if place is None:
                return None
            around = self._around(self._map.akin(place.shown))
            before, place = place, self._near(features, around, place.map_from_camera, _NARROW_PX)
            if place and place.inliers <= before.inliers:
                break
        return place if place and place.inliers >= enough else None

    def _around(self, akin: list[int]) -> Ints:
        """The local map: the points of the first of these keyframes."""
        return self._map.shown_by(akin[: self._config.local_keyframes])

    def _fitted(self, features: Features, pairs: Pairs, camera_from_map: Matrix, reach_px: float) -> Tracked | None:
        fit = fit_pose(self._sightings(features, pairs), camera_from_map, self._config.inlier_px, reach_px)
        if fit.inliers.sum() < self._config.min_inliers:
            return None
        shown = np.full(len(features), UNKNOWN)
        shown[pairs.keypoints[fit.inliers]] = pairs.points[fit.inliers]
        return Tracked(invert(fit.camera_from_map), shown)

    def _sightings(self, features: Features, pairs: Pairs) -> Sightings:
        return Sightings.of(features.chosen(pairs.keypoints), self._map.points.places_m[pairs.points])
