"""The pose of a keyframe among others whose poses are known.

Alignment converges from a decimetre or two and is then content wherever a wall may slide along a wall. So several
starts are tried, over all headings that motion leaves open and, along the direction that surfaces hold worst, over
several places; what agrees best with the pictures around it (`sight`) and with the motion is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix
from semslam.slam.surfel.alignment import Fit, Target, between, change_between, nudged, weakest_direction
from semslam.slam.surfel.places import Keyframe
from semslam.slam.surfel.sight import Agreement, agreement
from semslam.slam.surfel.surfels import Surfels
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

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
_TOO_FEW = 0.04
"""Share of samples that must be found again, or the pictures have nothing in common."""
_MIN_MATCHES = 40
_CLEARLY = 0.3
"""Standard deviations by which the mean difference of one pose is smaller than that of another that is worse."""
_ASIDE_M = 0.1
"""So far to either side pictures are compared to see whether edges hold a pose."""
_CHANCE = 2.0
"""By so much pictures may agree worse there without meaning anything."""
_EDGES_M = 0.05
"""Standard deviation of a place that edges tell, at best: so far apart are the places that the search looks at."""
_WIDE_M, _WIDE_RAD = 0.2, 0.35
"""Standard deviations of motion above which pictures alone must tell where a robot is."""


@dataclass(frozen=True, eq=False)
class Found:
    """Where a keyframe was found."""

    pose: Matrix
    hessian: Floats
    """(6, 6) information of the surfaces alone, for a turn about the pose's place and a shift, along the map's axes."""
    reference: int
    """Number of the known keyframe whose picture tells most by edges, and ..."""
    edge_information: Floats
    """... (2, 2) what they tell of x and y from there, along the axes of the map: of the direction that surfaces hold
    worst. Where surfaces hold it as well, they tell far more."""
    sure: bool
    """Whether pictures alone would do to tell."""
    seen: Agreement
    """With the pictures around it."""

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
        hessian, _ = fit.information(pose[:3, 3])
        sure = seen.same_place(self._samples, sure=True)
        return Found(pose, hessian, *self._edges(pose, hessian), sure, seen)

    def _edges(self, pose: Matrix, hessian: Floats) -> tuple[int, Floats]:
        """Which reference tells most of the place along the direction that surfaces hold worst, and (2, 2) what:
        nothing, unless what two pictures have in common agrees worse on either side. How much they have in common tells
        nothing: it grows towards the other picture's own place."""
        direction = weakest_direction(hessian + self._level)
        told = [self._edge_information(number, pose, direction) for number in range(len(self._references))]
        best = max(range(len(told)), key=lambda number: (told[number], -number))
        return best, told[best] * np.outer(direction, direction)

    def _edge_information(self, number: int, pose: Matrix, direction: Floats) -> float:
        """Information (1 / m^2) along a direction of the floor from the pictures of one reference."""
        (other, place), own = self._references[number], self._keyframe.sight
        aside = [nudged(pose, np.array([0.0, 0.0, 0.0, *(way * direction), 0.0])) for way in (-_ASIDE_M, _ASIDE_M)]
        here, *there = (agreement(other.sight, own, between(place, one)) for one in (pose, *aside))
        worth = _WORTH * here.looked_up / max(1, len(other.sight.points) + len(own.points))
        rise = worth * (min(one.dissent for one in there) - here.dissent)
        return min(max(0.0, 2.0 * (rise - _CHANCE) / _ASIDE_M**2), _EDGES_M**-2)

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
            direction = weakest_direction(hessian + self._level)
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
        mean = (seen.dissent * seen.looked_up + _NEUTRAL * rest) / max(1, self._samples)
        error = change_between(self._start, pose)
        return _WORTH * mean + 0.5 * float(error @ self._motion @ error)

    def _agreement(self, pose: Matrix) -> Agreement:
        whole = Agreement(0.0, 0)
        for other, place in self._references:
            whole += agreement(other.sight, self._keyframe.sight, between(place, pose))
        return whole

    def _too_few(self, seen: Agreement) -> bool:
        return seen.looked_up < _TOO_FEW * 2 * len(self._keyframe.sight.points) + 1


def unlevel(pose: Matrix) -> Floats:
    """(6,) tilt of a pose as a turn from the upright, and its height above the floor."""
    return np.array([-pose[1, 2], pose[0, 2], 0.0, 0.0, 0.0, pose[2, 3]])
