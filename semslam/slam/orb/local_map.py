"""The map: points with a place and a descriptor, and the keyframes that saw them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import Matrix
from semslam.slam.orb.features import DESCRIPTOR_BYTES, LEVELS, SCALE, Bytes, Features, Floats, Ints, disparities
from semslam.slam.orb.matching import Expected

UNKNOWN = -1
"""In place of a point: the keypoint shows none of the map."""

_MARGIN_PX = 8.0


@dataclass(frozen=True)
class Keyframe:
    """What a picture of the map showed."""

    map_from_camera: Matrix
    descriptors: Bytes
    """(N, 32)"""
    points: Ints
    """(N,) point of each keypoint, or UNKNOWN."""

    @property
    def known(self) -> Ints:
        """Keypoints that show a point."""
        return np.flatnonzero(self.points != UNKNOWN)


@dataclass(frozen=True)
class Points:
    """P points; a point's number is its row. All but reaches change in place as points are seen again."""

    places_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(P, 3) in the map frame."""
    descriptors: Bytes = field(default_factory=lambda: np.zeros((0, DESCRIPTOR_BYTES), np.uint8))
    """(P, 32) as last seen by a keyframe."""
    reaches_m: Floats = field(default_factory=lambda: np.zeros(0))
    """(P,) distance at which the point's corner is found at the finest level; at half of it, four levels coarser."""
    weights: Floats = field(default_factory=lambda: np.zeros(0))
    """(P,) of its place: the sum, over the keyframes that measured it, of 1 / (depth * depth * sigma) squared."""

    def joined(self, other: Points) -> Points:
        """These points and others after them."""
        return Points(*(np.concatenate(pair) for pair in zip(_columns(self), _columns(other), strict=True)))

    def chosen(self, which: NDArray[Any]) -> Points:
        """Some of the points, by number or by mask."""
        return Points(*(column[which] for column in _columns(self)))


class KeypointMap:
    """Keyframes, oldest first, and all points that any of them shows."""

    def __init__(self, max_keyframes: int) -> None:
        self._max_keyframes = max_keyframes
        self.keyframes: list[Keyframe] = []
        self.points = Points()

    def add(self, map_from_camera: Matrix, features: Features, shown: Ints, max_depth_m: float) -> None:
        """Keep a picture as keyframe; keypoints that show no point yet (UNKNOWN) become points if their depth allows.

        Points that it shows take the descriptor they have here, and the mean of all measured places.
        """
        seen = np.flatnonzero(shown != UNKNOWN)
        self._correct(map_from_camera, features, seen, shown[seen])
        self.points.descriptors[shown[seen]] = features.descriptors[seen]
        fresh = np.flatnonzero((shown == UNKNOWN) & (features.depths_m <= max_depth_m))
        shown = shown.copy()
        shown[fresh] = len(self.points.places_m) + np.arange(len(fresh))
        self.points = self.points.joined(_placed(map_from_camera, features, fresh))
        self.keyframes.append(Keyframe(map_from_camera, features.descriptors, shown))
        if len(self.keyframes) > self._max_keyframes:
            self._forget_oldest()

    def akin(self, shown: Ints) -> list[int]:
        """All keyframes, those first that share most points with a picture; of equals the latest."""
        wanted = np.zeros(len(self.points.places_m), np.bool_)
        wanted[shown[shown != UNKNOWN]] = True
        shared = [int(wanted[keyframe.points[keyframe.known]].sum()) for keyframe in self.keyframes]
        return sorted(range(len(self.keyframes)), key=lambda index: (-shared[index], -index))

    def shown_by(self, keyframes: list[int]) -> Ints:
        """The points of several keyframes, in order of their numbers."""
        shown = [keyframe.points[keyframe.known] for keyframe in (self.keyframes[index] for index in keyframes)]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *shown]))

    def expect(self, numbers: Ints, camera_from_map: Matrix, camera: Camera) -> tuple[Ints, Expected]:
        """Those of the points that a camera should see from there, and where in its picture."""
        some = self.points.chosen(numbers)
        points = some.places_m @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
        pixels = camera.project(points)  # NaN behind the camera
        size = np.array([camera.width, camera.height])
        inside = ((pixels > -_MARGIN_PX) & (pixels < size + _MARGIN_PX)).all(axis=1)
        depths = points[inside, 2]
        octaves = np.rint(np.log(some.reaches_m[inside] / depths) / np.log(SCALE)).astype(np.int64)
        seen = Expected(
            pixels[inside],
            disparities(camera, depths),
            np.clip(octaves, 0, LEVELS - 1),
            some.descriptors[inside],
        )
        return numbers[inside], seen

    def _correct(self, map_from_camera: Matrix, features: Features, keypoints: Ints, numbers: Ints) -> None:
        """Move points to the mean of where all keyframes measured them: in place of a bundle adjustment."""
        measured = np.isfinite(features.depths_m[keypoints])
        numbers = numbers[measured]
        again = _placed(map_from_camera, features, keypoints[measured])
        total = self.points.weights[numbers] + again.weights
        share = (again.weights / total)[:, None]
        self.points.places_m[numbers] += share * (again.places_m - self.points.places_m[numbers])
        self.points.weights[numbers] = total

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything, to be put away."""
        names = ("places_m", "descriptors", "reaches_m", "weights")
        frames = self.keyframes
        return {
            **dict(zip(names, _columns(self.points), strict=True)),
            "keyframe_poses": np.array([frame.map_from_camera for frame in frames]).reshape(-1, 4, 4),
            "keyframe_sizes": np.array([len(frame.points) for frame in frames], np.int64),
            "keyframe_points": np.concatenate([np.zeros(0, np.int64), *(frame.points for frame in frames)]),
            "keyframe_descriptors": np.concatenate(
                [np.zeros((0, DESCRIPTOR_BYTES), np.uint8), *(frame.descriptors for frame in frames)]
            ),
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """The inverse of `arrays`."""
        self.points = Points(arrays["places_m"], arrays["descriptors"], arrays["reaches_m"], arrays["weights"])
        ends = np.cumsum(arrays["keyframe_sizes"])[:-1]
        descriptors, points = (np.split(arrays[f"keyframe_{name}"], ends) for name in ("descriptors", "points"))
        frames = zip(arrays["keyframe_poses"], descriptors, points, strict=False)  # nothing splits into one empty part
        self.keyframes = [Keyframe(*frame) for frame in frames]

    def _forget_oldest(self) -> None:
        """Drop the first keyframe, and the points that no other one shows."""
        self.keyframes = self.keyframes[1:]
        kept = self.shown_by(list(range(len(self.keyframes))))
        number = np.full(len(self.points.places_m) + 1, UNKNOWN)  # the last row stands for UNKNOWN itself
        number[kept] = np.arange(len(kept))
        self.points = self.points.chosen(kept)
        self.keyframes = [
            Keyframe(frame.map_from_camera, frame.descriptors, number[frame.points]) for frame in self.keyframes
        ]


def _placed(map_from_camera: Matrix, features: Features, which: Ints) -> Points:
    """Keypoints with depth as points of the map."""
    places = features.points[which] @ map_from_camera[:3, :3].T + map_from_camera[:3, 3]
    depths, sigmas = features.depths_m[which], features.sigmas_px[which]
    return Points(places, features.descriptors[which], depths * sigmas, (depths**2 * sigmas) ** -2.0)


def _columns(points: Points) -> tuple[NDArray[Any], ...]:
    return points.places_m, points.descriptors, points.reaches_m, points.weights
