"""Through a log keyframe by keyframe: expect where the robot is, find it among what was seen before, remember."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix, planar
from semslam.slam.health import JUMP_M, JUMP_M_PER_S
from semslam.slam.surfel.alignment import between, marginal_information, rotation_vector, shows_wall
from semslam.slam.surfel.coverage import Coverage
from semslam.slam.surfel.motion_prior import PAUSE_S, Expected, MotionPrior
from semslam.slam.surfel.places import Anchor, Edges, Keyframe, Place, placed, shared_voxels
from semslam.slam.surfel.search import Found, Search
from semslam.slam.surfel.sight import agreement
from semslam.slam.surfel.uncertainty import along, grown
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

SHORTEST_S = 1e-3
"""Between keyframes; stamps that repeat or run back count as this."""
_LONGEST_S = 60.0
"""Steps count as no longer than this where a robot's motion is bounded."""
_SOON_S, _BESIDE_M, _BESIDE_RAD = 0.45, 0.3, 0.3
"""Less than this after a keyframe that was kept, and no farther from it, the next ones are not."""
_TOGETHER = 0.3
"""Share of samples that two keyframes have in common which are surely near each other."""
_WIDER = 9.0
"""Variances are so many times larger in a second search."""
_LOST_M, _LOST_RAD = 0.5, 0.6
"""Standard deviations of motion above which a single keyframe may be found in the wrong place."""


class Track:
    """All keyframes so far, with the poses at which they were found.

    While nothing is found the poses are those of motion alone, and the search grows wider with every step.
    """

    def __init__(self, config: SurfelConfig) -> None:
        self._config = config
        self.places: list[Place] = []
        self.prior = MotionPrior(config)
        self.open = np.zeros((3, 3))
        """Covariance of what motion has told, and pictures have not, since a keyframe was linked, along the axes of the
        map; what walls left open before that is in the covariances of the alignment alone."""
        self.parked = False
        """Whether the robot may have been parked, and carried away, since then."""
        self.group = 0
        """Of the next place."""
        self._coverage: dict[int, Coverage] = {}
        """Of each group."""

    def recall(self, place: Place) -> None:
        """Take a place as it was taken before."""
        self.places.append(place)
        if place.keyframe is not None and place.linked:
            self._coverage.setdefault(place.group, Coverage()).add(place.keyframe.surfels, place.pose)

    def step(self, keyframe: Keyframe | None, motion: SE2 | None, seconds: float) -> Place:
        """Take the next keyframe; `seconds` since the one before, at which `motion` began."""
        if not self.places:
            return self._remember(keyframe, np.eye(4), 0.0, None, linked=True)
        before, seconds = self.places[-1], max(seconds, SHORTEST_S)
        if motion is not None and math.hypot(motion.x_m, motion.y_m) > max(
            JUMP_M, JUMP_M_PER_S * min(seconds, _LONGEST_S)
        ):
            motion = None  # odometry that was set anew, not a robot
        expected = self.prior.expect(motion, seconds)
        start = before.pose @ expected.motion.matrix
        if not any(len(place.voxels) for place in self.places):  # the first picture: there is nothing to find it in
            return self._remember(keyframe, start, seconds, motion, linked=keyframe is not None)
        starts = [start]
        if seconds > PAUSE_S and motion is not None:  # a parked robot's odometry rests, and its errors with it
            starts += [before.pose @ motion.matrix, before.pose]
        so_far = np.zeros((3, 3)) if before.linked else self.open  # those before are known from each other
        opened = grown(so_far, before.pose, start, expected.covariance)
        found = self._found(keyframe, starts, opened)
        wall = found is not None and shows_wall(found.hessian)
        if found is None or (_lost(opened) and not wall):  # one who is lost has floors everywhere
            return self._go_on(keyframe, start, seconds, motion, expected, opened)
        left_open = _left_open(opened, found)
        if not wall:
            self.open = left_open
            return self._remember(keyframe, found.pose, seconds, motion, linked=False)
        if keyframe and (self.parked or _lost(opened)) and not self._seen_together(keyframe, found.pose):
            self.group += 1
        self.open, self.parked = left_open, False
        pose, hessian = found.pose, found.hessian
        if before.linked:
            seen = planar(between(before.pose, pose))
            self.prior.see(seen, seconds)
            if motion is not None and seconds <= PAUSE_S:
                self.prior.learn(motion, seconds, seen, _covariance_in_robot(hessian, before.pose))
        place = placed(keyframe, pose, seconds, motion, linked=True, group=self.group)
        place = replace(place, edges=self._edges(found))
        if keyframe and found.sure and (self._shown(keyframe, pose) or self._just_kept(pose, seconds)):
            place = self._left_out(place, hessian)
        self.recall(place)
        return place

    def _edges(self, found: Found) -> Edges | None:
        """What edges tell of a pose that was found; None from a keyframe of another group, of which nobody knows where
        it lies."""
        if self.places[found.reference].group != self.group:
            return None
        other = self.places[found.reference].pose
        back = other[:2, :2].T
        return Edges(found.reference, planar(between(other, found.pose)), back @ found.edge_information @ back.T)

    def _shown(self, keyframe: Keyframe, pose: Matrix) -> bool:
        """Whether keyframes of this group show all that this one does."""
        coverage = self._coverage.get(self.group)
        return coverage is not None and coverage.holds(keyframe.surfels, pose)

    def _just_kept(self, pose: Matrix, seconds: float) -> bool:
        """Whether a keyframe near by was kept less than half a second ago: many in a row would be aligned with each
        other alone, and small errors add up."""
        for last in reversed(self.places):
            if last.anchor is None:
                break
            seconds += last.seconds
        away = between(last.pose, pose)
        turn = float(np.linalg.norm(rotation_vector(away[:3, :3])))
        near = float(np.linalg.norm(away[:3, 3])) < _BESIDE_M and turn < _BESIDE_RAD
        return seconds < _SOON_S and near and last.linked and last.keyframe is not None and last.group == self.group

    def _left_out(self, place: Place, hessian: Floats) -> Place:
        """The same without its pictures, tied to the one of its group that shows most of the same."""
        shared = shared_voxels(self.places, place)
        tied = [index for index in shared if self.places[index].linked and self.places[index].group == place.group]
        if not tied:
            return place
        nearest = max(tied, key=lambda index: (shared[index], -index))
        known = self.places[nearest].pose
        turn = np.kron(np.eye(2), known[:3, :3])
        anchor = Anchor(nearest, between(known, place.pose), turn.T @ hessian @ turn)
        alone = placed(None, place.pose, place.seconds, place.motion, linked=True, group=place.group)
        return replace(alone, anchor=anchor, edges=place.edges)

    def _go_on(
        self,
        keyframe: Keyframe | None,
        start: Matrix,
        seconds: float,
        motion: SE2 | None,
        expected: Expected,
        opened: Floats,
    ) -> Place:
        """Without a link to what is known: among keyframes that have none either, or as motion leads."""
        found = self._find(keyframe, [start], expected.covariance, linked=False)
        if found is None or not shows_wall(found.hessian):
            self.open = opened
        self.parked |= seconds > PAUSE_S
        return self._remember(keyframe, start if found is None else found.pose, seconds, motion, linked=False)

    def _remember(
        self, keyframe: Keyframe | None, pose: Matrix, seconds: float, motion: SE2 | None, *, linked: bool
    ) -> Place:
        place = placed(keyframe, pose, seconds, motion, linked=linked, group=self.group)
        self.recall(place)
        return place

    def _found(self, keyframe: Keyframe | None, starts: Sequence[Matrix], covariance: Floats) -> Found | None:
        """The pose among linked keyframes; where it is not sure, motion may err more than it is thought to."""
        found = self._find(keyframe, starts, covariance, linked=True)
        if keyframe is None or (found and found.sure):
            return found
        wider = self._find(keyframe, starts, _WIDER * covariance, linked=True)
        if wider is None or (found and not (wider.sure and wider.better_than(found))):
            return found
        return wider

    def _find(
        self, keyframe: Keyframe | None, starts: Sequence[Matrix], covariance: Floats, *, linked: bool
    ) -> Found | None:
        """The pose among what was seen before, linked or not; None if it does not fit anywhere."""
        if keyframe is None:
            return None
        near = self._near(placed(keyframe, starts[0], 0.0, None, linked=False), linked=linked)
        known = {index: place.keyframe for index in near if (place := self.places[index]).keyframe}
        if not known:
            return None
        poses = [(other, self.places[index].pose) for index, other in known.items() if other]
        found = Search(keyframe, poses, starts, covariance, self._config).result()
        return found and replace(found, reference=list(known)[found.reference])

    def _near(self, place: Place, *, linked: bool) -> list[int]:
        """The last place and those that see most of the same, best first, of those that are linked or not."""
        shared = shared_voxels(self.places, place)
        shared[self._last()] = len(place.voxels) + 1
        others = [index for index in shared if self.places[index].linked == linked]
        others.sort(key=lambda index: (-shared[index], index))
        return others[: self._config.neighbours]

    def _last(self) -> int:
        """The last place, or the one it is tied to."""
        anchor = self.places[-1].anchor
        return anchor.index if anchor else len(self.places) - 1

    def _seen_together(self, keyframe: Keyframe, pose: Matrix) -> bool:
        """Whether a keyframe shows much of what the one before it did, whose place is known: then it is near, whatever
        motion leaves open."""
        before = self.places[self._last()]
        if not before.linked or before.keyframe is None:
            return False
        seen = agreement(before.keyframe.sight, keyframe.sight, between(before.pose, pose))
        samples = len(before.keyframe.sight.points) + len(keyframe.sight.points)
        return seen.same_place(samples, sure=True) and seen.told > _TOGETHER * samples


def _lost(covariance: Floats) -> bool:
    """Whether motion leaves so much open that a single keyframe may be found in the wrong place."""
    return bool(covariance[:2, :2].max() > _LOST_M**2 or covariance[2, 2] > _LOST_RAD**2)


def _covariance_in_robot(hessian: Floats, before: Matrix) -> Floats:
    """(3, 3) of x, y and heading along the axes of the pose before."""
    upright = np.diag([1e4, 1e4, 1.0, 1e-2, 1e-2, 1e4])
    return along(np.asarray(np.linalg.inv(marginal_information(hessian + upright, (3, 4, 2)))), before.T)


def _left_open(opened: Floats, found: Found) -> Floats:
    """(3, 3) what a pose that was found leaves open of what motion did: along a corridor motion tells the way, across
    it the walls do."""
    told = marginal_information(found.hessian + np.diag([1e4, 1e4, 0.0, 0.0, 0.0, 1e4]), (3, 4, 2))
    told[:2, :2] += found.edge_information
    return np.asarray(opened @ np.linalg.inv(np.eye(3) + told @ opened))
