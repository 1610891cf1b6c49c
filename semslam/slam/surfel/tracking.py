"""Through a log keyframe by keyframe: expect where the robot is, find it among what was seen before, remember.

Alignment converges from a decimetre or two and is then content wherever a wall may slide along a wall. So several
starts are tried, over all headings that motion leaves open and, along the direction that surfaces hold worst, over
several places; what agrees best with the pictures around it (`sight`) and with the motion is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix, planar
from semslam.slam.estimator import View
from semslam.slam.health import JUMP_M, JUMP_M_PER_S
from semslam.slam.surfel.alignment import Fit, Target, between, change_between, nudged
from semslam.slam.surfel.coverage import Coverage, voxel_numbers
from semslam.slam.surfel.motion_prior import PAUSE_S, Expected, MotionPrior
from semslam.slam.surfel.sight import Agreement, Sight, agreement
from semslam.slam.surfel.surfels import Surfels, surfels_of
from semslam.slam.surfel.uncertainty import along, grown
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

SHORTEST_S = 1e-3
"""Between keyframes; stamps that repeat or run back count as this."""
HELD_M = 0.1
"""Standard deviation along the floor up to which surfaces hold one keyframe to another: a floor alone tells heights."""
_LONGEST_S = 60.0
"""Steps count as no longer than this where a robot's motion is bounded."""
VOXEL_M = 0.25
"""Keyframes that have surfels in the same voxels see the same."""
_COMPARED = 60
"""Keyframes whose voxels are compared: those whose surfels lie nearest."""
_COARSE = 3
"""Every third surfel will do for a first look."""
_FIRST_REACH_M, _REACH_M, _SHRINK = 0.3, 0.1, 0.7
_ROUNDS, _COARSE_ROUNDS = 12, 5
_STILL = 1e-4
"""Metres and radians of a change that need no other."""
_HEADING_STEP_RAD = math.radians(1.0)
_MOST_STARTS = 25
_EVENLY = 8
"""Of more headings than this, about so many are looked at closely in any case."""
_OPEN_SIGMAS = 2.5
_STARTS_KEPT = 2
"""Of the headings tried so many, or a quarter, are looked at closely."""
_BESIDE_M = (-0.1, -0.05, 0.05, 0.1)
_TIMES_BESIDE = 3
_BRIDGED_M, _GRID_M, _FARTHEST_M = 0.25, 0.1, 0.6
"""What alignment bridges from a wrong start; else places so far apart are looked at, up to so far away."""
_REFERENCES = 3
"""Keyframes with whose pictures a pose must agree."""
_WORTH = 300.0
"""Independent samples of a picture: what a difference of one standard deviation everywhere weighs against motion."""
_NEUTRAL = 0.9
"""What a sample counts that is not found again, in standard deviations: worse than one that is there, better than one
that is not. So a pose from which little is seen of what is known must be all the more likely by motion."""
_STRANGE = 6.0
"""What a sample counts, beyond its difference, that hangs in space that was seen through: what is merely hidden may be
so from elsewhere."""
_TOO_FEW = 0.04
"""Share of samples that must be found again, or the pictures have nothing in common."""
_MIN_MATCHES = 40
_TINY = 1e-12
"""Share of a Hessian that keeps parts of it solvable of which it says nothing."""
_TOGETHER = 0.3
"""Share of samples that two keyframes have in common which are surely near each other."""
_WIDER = 9.0
"""Variances are so many times larger in a second search."""
_CLEARLY = 0.3
"""Standard deviations by which the mean difference of one pose is smaller than that of another that is worse."""
_WIDE_M, _WIDE_RAD = 0.2, 0.35
"""Standard deviations of motion above which pictures alone must tell where a robot is ..."""
_LOST_M, _LOST_RAD = 0.5, 0.6
"""... and above which one of them may err."""


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
    """(6, 6) of surfaces, for a turn and a shift along the axes of the anchor."""


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
    return replace(there, anchor=place.anchor)


class Track:
    """All keyframes so far, with the poses at which they were found.

    While nothing is found the poses are those of motion alone, and the search grows wider with every step.
    """

    def __init__(self, config: SurfelConfig) -> None:
        self._config = config
        self.places: list[Place] = []
        self.prior = MotionPrior(config)
        self.open = np.zeros((3, 3))
        """Covariance of what motion alone has told since a pose was seen, along the axes of the map."""
        self.parked = False
        """Whether the robot may have been parked, and carried away, since then."""
        self.group = 0
        """Of the next place."""
        self._coverage: dict[int, Coverage] = {}
        """Of each group."""

    def recall(self, place: Place) -> None:
        """Take a place as it was taken before."""
        self.places.append(place)
        if place.keyframe is not None:
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
        opened = grown(self.open, before.pose, start, expected.covariance)
        found = self._found(keyframe, starts, opened)
        if found is None:
            return self._go_on(keyframe, start, seconds, motion, expected, opened)
        if held(found.hessian) < HELD_M**-2:  # along a corridor motion tells the way; across it the walls do
            self.open = opened
            return self._remember(keyframe, found.pose, seconds, motion, linked=False)
        if keyframe and (self.parked or _lost(opened)) and not self._seen_together(keyframe, found.pose):
            self.group += 1
        self.open, self.parked = np.zeros((3, 3)), False
        pose, hessian = found.pose, found.hessian
        if before.linked:
            seen = planar(between(before.pose, pose))
            self.prior.see(seen, seconds)
            if motion is not None and seconds <= PAUSE_S:
                self.prior.learn(motion, seconds, seen, _covariance_in_robot(hessian, before.pose))
        if keyframe and found.sure and self._shown(keyframe, pose):
            anchor = Anchor(found.nearest, between(self.places[found.nearest].pose, pose), hessian)
            return self._leave_out(pose, seconds, motion, anchor)
        return self._remember(keyframe, pose, seconds, motion, linked=True)

    def _shown(self, keyframe: Keyframe, pose: Matrix) -> bool:
        """Whether keyframes of this group show all that this one does."""
        coverage = self._coverage.get(self.group)
        return coverage is not None and coverage.holds(keyframe.surfels, pose)

    def _leave_out(self, pose: Matrix, seconds: float, motion: SE2 | None, anchor: Anchor) -> Place:
        """Keep the pose alone."""
        turn = np.kron(np.eye(2), self.places[anchor.index].pose[:3, :3])
        tied = replace(anchor, hessian=turn.T @ anchor.hessian @ turn)
        place = replace(placed(None, pose, seconds, motion, linked=True, group=self.group), anchor=tied)
        self.recall(place)
        return place

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
        if found is None:
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
        known = {index: (place.keyframe, place.pose) for index, place in near.items() if place.keyframe}
        if not known:
            return None
        found = Search(keyframe, list(known.values()), starts, covariance, self._config).result()
        return replace(found, nearest=next(iter(known))) if found else None

    def _near(self, place: Place, *, linked: bool) -> dict[int, Place]:
        """The last place and those that see most of the same, best first, of those that are linked or not."""
        shared = shared_voxels(self.places, place)
        shared[self._last()] = len(place.voxels) + 1
        others = [index for index in shared if self.places[index].linked == linked]
        others.sort(key=lambda index: (-shared[index], index))
        return {index: self.places[index] for index in others[: self._config.neighbours]}

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


def shared_voxels(places: Sequence[Place], place: Place) -> dict[int, int]:
    """How many voxels a place shares with others, by their number; only with those whose middles are nearest."""
    if not len(place.voxels):
        return {}
    away = np.linalg.norm(np.array([one.middle for one in places]) - place.middle, axis=1)
    near = np.argsort(away, kind="stable")[:_COMPARED]  # NaN comes last
    counts = {int(i): len(np.intersect1d(place.voxels, places[i].voxels, assume_unique=True)) for i in near}
    return {index: count for index, count in counts.items() if count}


@dataclass(frozen=True, eq=False)
class Found:
    """Where a keyframe was found."""

    pose: Matrix
    hessian: Floats
    """(6, 6) of the surfaces alone."""
    sure: bool
    """Whether pictures alone would do to tell."""
    seen: Agreement
    """With the pictures around it."""
    nearest: int = 0
    """The place that shows most of the same."""

    def better_than(self, other: Found) -> bool:
        """Whether what pictures tell, not how much, speaks for this pose: a wall that slides agrees with more of
        itself."""
        return not other.seen.alike or self.seen.mean < other.seen.mean - _CLEARLY


class Search:
    """The pose of a keyframe among others whose poses are known."""

    def __init__(
        self,
        keyframe: Keyframe,
        known: Sequence[tuple[Keyframe, Matrix]],
        starts: Sequence[Matrix],
        covariance: Floats,
        config: SurfelConfig,
    ) -> None:
        """`known`: keyframes with their poses, best first; `covariance` (3, 3) of x, y and heading of the first start,
        which motion tells; the others are tried as they are."""
        self._keyframe = keyframe
        self._references = known[:_REFERENCES]
        views = [keyframe, *(other for other, _ in self._references)]
        counts = [len(view.sight.points) for view in views]
        self._samples = counts[0] * (len(counts) - 1) + sum(counts[1:])
        self._start, self._others = starts[0], starts[1:]
        self._wide = len(starts) > 1 or bool(covariance[:2, :2].max() > _WIDE_M**2 or covariance[2, 2] > _WIDE_RAD**2)
        self._target = Target(Surfels.joined([other.surfels.moved(pose) for other, pose in known]))
        self._sigma_m = math.sqrt(max(covariance[0, 0], covariance[1, 1]))
        self._sigma_rad = math.sqrt(covariance[2, 2])
        level, height = 1.0 / config.tilt_noise_rad**2, 1.0 / config.height_noise_m**2
        self._level = np.diag([level, level, 0.0, 0.0, 0.0, height])
        shift = 1.0 / self._sigma_m**2
        self._motion = np.diag([0.0, 0.0, 1.0 / self._sigma_rad**2, shift, shift, 0.0])

    def result(self) -> Found | None:
        """The best pose; None if none will do."""
        poses = [self._refined(start, _COARSE_ROUNDS, coarse=True)[0] for start in self._starts()]
        pose = min(poses, key=self._cost)
        pose = self._beside(self._around(pose))
        pose, fit = self._refined(pose, _ROUNDS, coarse=False)
        seen = self._agreement(pose)
        if len(fit) < _MIN_MATCHES or self._too_few(seen) or not seen.same_place(self._samples, sure=self._wide):
            return None
        return Found(pose, fit.equations(pose[:3, 3])[0], seen.same_place(self._samples, sure=True), seen)

    def _starts(self) -> list[Matrix]:
        """Headings that agree best, none beside another; and, since only what is nearly right already agrees well, some
        in any case: the one that motion tells, and where many are open, evenly spread ones."""
        open_rad = min(math.pi, max(_HEADING_STEP_RAD, _OPEN_SIGMAS * self._sigma_rad))
        step = max(_HEADING_STEP_RAD, 2 * open_rad / (_MOST_STARTS - 1))
        half = math.ceil(open_rad / step)
        turns = range(-half, half + 1)
        costs = {turn: self._cost(self._start @ SE2(0.0, 0.0, turn * step).matrix) for turn in turns}
        kept = {0, *list(turns)[:: max(1, len(turns) // _EVENLY)]} if len(turns) > _EVENLY else {0}
        best: list[int] = []
        for turn in sorted(turns, key=lambda one: (costs[one], abs(one))):
            if len(best) < max(_STARTS_KEPT, len(turns) // 4) and all(abs(turn - other) > 1 for other in best):
                best.append(turn)
        turned = [self._start @ SE2(0.0, 0.0, turn * step).matrix for turn in sorted(kept | set(best))]
        return [*turned, *self._others]

    def _around(self, pose: Matrix) -> Matrix:
        """Where motion leaves more open than alignment bridges: look all around, begin again from the best place."""
        reach = min(_OPEN_SIGMAS * self._sigma_m, _FARTHEST_M)
        if reach <= _BRIDGED_M:
            return pose
        line = np.linspace(-reach, reach, 2 * math.ceil(reach / _GRID_M) + 1)
        places = [nudged(pose, np.array([0.0, 0.0, 0.0, x, y, 0.0])) for x in line.tolist() for y in line.tolist()]
        best = min(places, key=self._cost)
        return min((pose, self._refined(best, _COARSE_ROUNDS, coarse=True)[0]), key=self._cost)

    def _beside(self, pose: Matrix) -> Matrix:
        """Look left and right along the direction that the surfaces hold worst, as long as that gets better."""
        cost = self._cost(pose)
        for _ in range(_TIMES_BESIDE):
            hessian, _ = self._fit(pose, _REACH_M, coarse=True).equations(pose[:3, 3])
            direction = _weakest(hessian + self._level)
            places = [nudged(pose, np.array([0.0, 0.0, 0.0, *(away * direction), 0.0])) for away in _BESIDE_M]
            best = min(places, key=self._cost)
            if self._cost(best) >= cost:
                break
            tried = self._refined(best, _COARSE_ROUNDS, coarse=True, reach_m=_REACH_M)[0]
            pose = min((best, tried), key=self._cost)
            cost = self._cost(pose)
        return pose

    def _refined(
        self, pose: Matrix, rounds: int, *, coarse: bool, reach_m: float = _FIRST_REACH_M
    ) -> tuple[Matrix, Fit]:
        """Gauss-Newton on surfaces, level and motion together."""
        if not coarse:
            reach_m = min(reach_m, 1.5 * _REACH_M)
        for _ in range(rounds):
            fit = self._fit(pose, reach_m, coarse=coarse)
            hessian, gradient = fit.equations(pose[:3, 3])
            for weight, error in ((self._level, unlevel(pose)), (self._motion, change_between(self._start, pose))):
                hessian, gradient = hessian + weight, gradient + weight @ error
            change = np.asarray(-np.linalg.solve(hessian, gradient), np.float64)
            pose = nudged(pose, change)
            if np.abs(change).max() < _STILL and reach_m <= _REACH_M:
                break
            reach_m = max(_REACH_M, reach_m * _SHRINK)
        return pose, fit

    def _fit(self, pose: Matrix, reach_m: float, *, coarse: bool) -> Fit:
        surfels = self._keyframe.coarse if coarse else self._keyframe.surfels
        return self._target.fit(surfels.moved(pose), reach_m)

    def _cost(self, pose: Matrix) -> float:
        """Of pictures that disagree and of motion that is unlikely."""
        seen = self._agreement(pose)
        rest = max(0, self._samples - seen.looked_up)
        mean = (seen.difference + _STRANGE * seen.strangers + _NEUTRAL * rest) / max(1, self._samples)
        error = change_between(self._start, pose)
        return _WORTH * mean + 0.5 * float(error @ self._motion @ error)

    def _agreement(self, pose: Matrix) -> Agreement:
        whole = Agreement(0.0, 0)
        for other, place in self._references:
            whole += agreement(other.sight, self._keyframe.sight, between(place, pose))
        return whole

    def _too_few(self, seen: Agreement) -> bool:
        return seen.looked_up < _TOO_FEW * 2 * len(self._keyframe.sight.points) + 1


def _voxels(points: Floats) -> NDArray[np.int64]:
    """Voxels in which points (N, 3) lie, numbered, rising."""
    return np.unique(voxel_numbers(points, VOXEL_M))


def unlevel(pose: Matrix) -> Floats:
    """(6,) tilt of a pose as a turn from the upright, and its height above the floor."""
    return np.array([-pose[1, 2], pose[0, 2], 0.0, 0.0, 0.0, pose[2, 3]])


def held(hessian: Floats) -> float:
    """Information (1 / m^2) about the place on the floor along which it is known worst, whatever tilt and turn."""
    return float(_on_floor(hessian)[0][0])


def _weakest(hessian: Floats) -> Floats:
    """(2,) unit vector on the floor along which a pose is held worst, whatever its turn."""
    return _on_floor(hessian)[1][:, 0]


def _on_floor(hessian: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (2,), rising, and eigenvectors (2, 2) of what a Hessian (6, 6) tells of x and y alone."""
    keep, rest = [3, 4], [0, 1, 2, 5]
    others = hessian[np.ix_(rest, rest)] + np.diag(np.full(4, _TINY * (1.0 + np.trace(hessian))))
    tied = hessian[np.ix_(keep, rest)] @ np.linalg.solve(others, hessian[np.ix_(rest, keep)])
    values, vectors = np.linalg.eigh(hessian[np.ix_(keep, keep)] - tied)
    return np.asarray(values), np.asarray(vectors)


def _covariance_in_robot(hessian: Floats, before: Matrix) -> Floats:
    """(3, 3) of x, y and heading along the axes of the pose before."""
    whole = np.linalg.inv(hessian + np.diag([1e4, 1e4, 1e2, 1e1, 1e1, 1e4]))[np.ix_([3, 4, 2], [3, 4, 2])]
    return along(np.asarray(whole), before.T)
