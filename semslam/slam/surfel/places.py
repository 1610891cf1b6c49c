"""What a keyframe saw, and where it was taken.

Keyframes see the same where their surfels lie in the same voxels of space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix
from semslam.slam.estimator import View
from semslam.slam.surfel.alignment import Target
from semslam.slam.surfel.coverage import voxel_numbers
from semslam.slam.surfel.sight import Sight
from semslam.slam.surfel.surfels import Surfels, surfels_of
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

VOXEL_M = 0.25
"""Keyframes that have surfels in the same voxels see the same."""
_COMPARED = 60
"""Keyframes whose voxels are compared: those whose surfels lie nearest."""
_COARSE = 3
"""Every third surfel will do for a first look."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """What a keyframe saw, in its robot frame."""

    surfels: Surfels
    sight: Sight

    @staticmethod
    def of(view: View, config: SurfelConfig) -> Keyframe:
        """Of its pictures."""
        return Keyframe(surfels_of(view, config.surfels, config.max_depth_m), Sight.of(view, config.max_depth_m))

    @cached_property
    def target(self) -> Target:
        """Its surfels, for others to be aligned with."""
        return Target(self.surfels)

    @cached_property
    def coarse(self) -> Surfels:
        """Some of its surfels."""
        return self.surfels.every(_COARSE)


@dataclass(frozen=True, eq=False)
class Anchor:
    """To what a keyframe is tied whose pictures were not kept."""

    index: int
    """Of a keyframe whose pictures were."""
    anchor_from_robot: Matrix
    """As it was found."""
    hessian: Floats
    """(6, 6) of the surfaces that tell the pose, the anchor's and those of others beside it, for a turn and a shift
    along the axes of the anchor."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Where the search of the walk found a keyframe from another, and how surely by edges in both pictures along the
    direction that surfaces hold worst."""

    index: int
    """Of the other."""
    other_from_robot: SE2
    information: Floats
    """(2, 2) about x and y, along the axes of the other."""


@dataclass(eq=False)
class Place:
    """A keyframe and where it was taken; without pictures there is only the place."""

    keyframe: Keyframe | None
    pose: Matrix
    """map_from_robot, (4, 4)."""
    seconds: float
    """Since the keyframe before."""
    motion: SE2 | None
    """Measured since then."""
    linked: bool
    """Whether the pose was seen, not only expected."""
    voxels: NDArray[np.int64]
    """Those with surfels, rising."""
    middle: Floats
    """(3,) of its surfels, in the map frame; NaN without any."""
    group: int = 0
    """Keyframes of different groups may lie where they do by mistake: a robot that did not know where it was found
    itself by few pictures."""
    anchor: Anchor | None = None
    """Of one whose pictures were left out since they showed nothing new."""
    edges: Edges | None = None
    """What edges tell; None of a keyframe that is not linked, whose reference is of another group, and in a log that is
    merged, whose track has it in it."""

    @property
    def pictured(self) -> bool:
        """Whether pictures tell where it is."""
        return bool(len(self.voxels)) or self.anchor is not None


def placed(
    keyframe: Keyframe | None, pose: Matrix, seconds: float, motion: SE2 | None, *, linked: bool, group: int = 0
) -> Place:
    """A keyframe put somewhere."""
    if keyframe is None or not len(keyframe.surfels):
        return Place(keyframe, pose, seconds, motion, linked, np.zeros(0, np.int64), np.full(3, np.nan), group)
    points = keyframe.surfels.moved(pose).points
    return Place(keyframe, pose, seconds, motion, linked, _voxels(points), points.mean(0), group)


def moved(place: Place, pose: Matrix) -> Place:
    """The same keyframe somewhere else."""
    there = placed(place.keyframe, pose, place.seconds, place.motion, linked=place.linked, group=place.group)
    return replace(there, anchor=place.anchor, edges=place.edges)


@dataclass(frozen=True, eq=False)
class Kept:
    """Where the places are that have pictures."""

    numbers: NDArray[np.int64]
    middles: Floats
    """(N, 3)"""

    @staticmethod
    def of(places: Sequence[Place]) -> Kept:
        """Among all."""
        numbers = [number for number, place in enumerate(places) if len(place.voxels)]
        return Kept(np.array(numbers, np.int64), np.array([places[number].middle for number in numbers]).reshape(-1, 3))


def shared_voxels(places: Sequence[Place], place: Place, kept: Kept | None = None) -> dict[int, int]:
    """How many voxels a place shares with others, by their number; only with those whose middles are nearest. `kept`
    of these places, for who asks more than once."""
    if not len(place.voxels):
        return {}
    kept = kept or Kept.of(places)
    away = np.linalg.norm(kept.middles - place.middle, axis=1)
    near = kept.numbers[np.argsort(away, kind="stable")[:_COMPARED]].tolist()
    counts = {i: len(np.intersect1d(place.voxels, places[i].voxels, assume_unique=True)) for i in near}
    return {index: count for index, count in counts.items() if count}


def _voxels(points: Floats) -> NDArray[np.int64]:
    """Voxels in which points (N, 3) lie, numbered, rising."""
    return np.unique(voxel_numbers(points, VOXEL_M))
