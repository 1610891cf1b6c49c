"""Where a log's map lies in a map made before, without a first guess, and whether that is sure.

The whole log is placed at once: `semantic_field` proposes poses of its map in the other, surfels draw each proposal to
where surfaces meet, and pictures of both logs, looked up in each other, decide. If a second proposal is nearly as good
as the best, as in a room that looks the same from both ends, the answer is *ambiguous*; if none is good, *lost*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, planar
from semslam.slam.surfel.alignment import Target, between, nudged
from semslam.slam.surfel.places import Keyframe, Place, moved, shared_voxels
from semslam.slam.surfel.search import unlevel
from semslam.slam.surfel.semantic_field import Candidate, ClassMap, candidates
from semslam.slam.surfel.sight import Agreement, agreement
from semslam.slam.surfel.surfels import Surfels

Floats = NDArray[np.float64]

FOUND, AMBIGUOUS, LOST = "found", "ambiguous", "lost"

_PROPOSALS = 8
_ASKED = 16
"""Keyframes of the log, evenly spread, that decide."""
_REFERENCES = 2
"""Keyframes of the map that each is compared with."""
_TARGET_SURFELS = 60_000
_REACHES_M = (0.4, 0.4, 0.3, 0.3, 0.2, 0.2, 0.15, 0.1, 0.1, 0.1, 0.06, 0.06)
_TILT_RAD, _HEIGHT_M = 0.01, 0.03
"""How far two levelled maps may be tilted and raised against each other (1 sigma)."""
_STRANGERS_RIGHT, _STRANGERS_WRONG = 0.04, 0.3
"""Share of samples that hang in space that was seen through, at the right pose (things move) and at a wrong one; those
that are hidden there do not count."""
_GOOD = 0.22
"""Log likelihood ratio of a sample from which on two maps show the same place: 4 % of the samples may be strangers, 0.3
is what the right pose gives, and rooms of one shape with other furniture 0.1 to 0.18."""
_WORTH_A_LOOK = 0.4
"""Guesses with less than this share of the best one's score are not looked at."""
_SEEN = 0.15
"""Share of samples that must be found again."""
_SHARED = 0.15
"""Share of the smaller one's voxels that two keyframes must have in common to be compared one by one."""
_ALIKE = 0.3
"""Share of those pairs whose pictures must surely show the same place: between logs of simulated homes it is 0.67 to 1
at right poses, moved furniture included; it is 0 where a log was laid behind a wall, from where most is hidden and the
rest agrees."""
_WORTH = 60.0
"""Samples that a log gives independently. Few, because what differs between the right pose and one that looks alike
are a few things in a room, not thousands of pixels of its walls."""
_MARGIN = 5.0
"""Log odds by which the best proposal must beat all others."""


@dataclass(frozen=True, eq=False)
class Submap:
    """What a log has seen, in its own map frame."""

    places: Sequence[Place]
    cells: ClassMap

    @property
    def pictured(self) -> list[Place]:
        """Places with surfels."""
        return [place for place in self.places if place.keyframe and len(place.keyframe.surfels)]


@dataclass(frozen=True)
class Proposal:
    """One way to lay a log's map on the other."""

    other_from_own: SE2
    semantic: float
    """Evidence of the cells, as `semantic_field` weighs it."""
    likeness: float
    """Log likelihood ratio of a sample that is found again: right pose against wrong one."""
    seen: float
    """Share of samples that are, and are not hidden. It is no evidence: a wrong pose may see more."""
    covariance: Floats
    """(3, 3) of its x, y and heading along the other map's axes, if it is the right way."""
    alike: float = 1.0
    """Share of the pairs of keyframes with much in common whose pictures surely show the same place; 0 without any."""
    probability: float = 0.0
    """Among all proposals."""

    @property
    def good(self) -> bool:
        """Whether the two maps show the same place there."""
        return self.likeness > _GOOD and self.seen > _SEEN


@dataclass(frozen=True)
class Placement:
    """The answer."""

    verdict: str
    """found, ambiguous or lost."""
    proposals: tuple[Proposal, ...] = field(default=())
    """Best first."""

    @property
    def other_from_own(self) -> SE2 | None:
        """The pose if it is sure."""
        return self.proposals[0].other_from_own if self.verdict == FOUND else None


def place_in(own: Submap, other: Submap) -> Placement:
    """Lay a log's map on another."""
    asked, known = _spread(own.pictured, _ASKED), other.pictured
    if not asked or not known:
        return Placement(LOST)
    whole = Surfels.joined([place.keyframe.surfels.moved(place.pose) for place in known if place.keyframe])
    target = Target(whole.every(max(1, len(whole) // _TARGET_SURFELS)), max(_REACHES_M))
    guesses = candidates(own.cells, other.cells, _PROPOSALS)
    worth = [guess for guess in guesses if guess.score >= _WORTH_A_LOOK * guesses[0].score]
    found = [_proposal(asked, known, target, guess) for guess in worth]
    return _judged(_distinct(found))


def _proposal(asked: Sequence[Place], known: Sequence[Place], target: Target, guess: Candidate) -> Proposal:
    """A guess, drawn to where surfaces meet, and what the pictures say there."""
    shift = guess.other_from_own.matrix
    about = shift[:3, 3]
    for reach_m in _REACHES_M:
        fit = target.fit(
            Surfels.joined([place.keyframe.coarse.moved(shift @ place.pose) for place in asked if place.keyframe]),
            reach_m,
        )
        about = shift[:3, 3]
        hessian, gradient = fit.equations(about)
        level, height = 1.0 / _TILT_RAD**2, 1.0 / _HEIGHT_M**2
        weight = np.diag([level, level, 1e-6, 1e-6, 1e-6, height])
        shift = nudged(shift, np.asarray(-np.linalg.solve(hessian + weight, gradient + weight @ unlevel(shift))))
    seen, samples, alike = _compared(asked, known, shift)
    information, _ = fit.information(about)
    keep = np.ix_([3, 4, 2], [3, 4, 2])
    covariance = np.asarray(np.linalg.inv(information + weight)[keep], np.float64)
    return Proposal(planar(shift), guess.score, _likeness(seen), seen.told / max(1, samples), covariance, alike)


def _likeness(seen: Agreement) -> float:
    """Log likelihood ratio of a sample; that of nothing but strangers if there is none."""
    strangers = seen.strangers / seen.told if seen.told else 1.0
    fits = math.log((1.0 - _STRANGERS_RIGHT) / (1.0 - _STRANGERS_WRONG))
    return (1.0 - strangers) * fits + strangers * math.log(_STRANGERS_RIGHT / _STRANGERS_WRONG)


def _compared(asked: Sequence[Place], known: Sequence[Place], shift: Floats) -> tuple[Agreement, int, float]:
    """Pictures of the log looked up in those of the map that see most of the same; how many samples there were; and
    which share of pairs is alike."""
    whole, samples = Agreement(0.0, 0), 0
    alike: list[bool] = []
    for place in asked:
        here = moved(place, shift @ place.pose)
        shared = shared_voxels(known, here)
        best = sorted(shared, key=lambda index: (-shared[index], index))[:_REFERENCES]
        samples += 2 * _REFERENCES * len(_of(here).sight.points)
        for index in best:
            one, other = _of(known[index]).sight, _of(here).sight
            seen = agreement(one, other, between(known[index].pose, here.pose))
            whole += seen
            if shared[index] >= _SHARED * min(len(known[index].voxels), len(here.voxels)):
                alike.append(seen.same_place(len(one.points) + len(other.points), sure=True))
    return whole, samples, sum(alike) / max(1, len(alike))


def _of(place: Place) -> Keyframe:
    assert place.keyframe is not None
    return place.keyframe


def _judged(proposals: list[Proposal]) -> Placement:
    """Order by likeness, those that see too little last; sure if the best is good, and better than all others."""
    if not proposals:
        return Placement(LOST)
    ordered = sorted(proposals, key=lambda one: (one.seen <= _SEEN, -one.likeness))
    odds = np.array([math.exp(_WORTH * (one.likeness - ordered[0].likeness)) for one in ordered if one.seen > _SEEN])
    shares = [*(odds / odds.sum()).tolist(), *[0.0] * len(ordered)]
    told = tuple(replace(one, probability=share) for one, share in zip(ordered, shares, strict=False))
    if not told[0].good:
        return Placement(LOST, told)
    rivals = [one for one in told[1:] if one.good and _WORTH * (told[0].likeness - one.likeness) < _MARGIN]
    if rivals:
        return Placement(AMBIGUOUS, told)
    return Placement(FOUND if told[0].alike >= _ALIKE else LOST, told)


def _distinct(proposals: Sequence[Proposal]) -> list[Proposal]:
    """Without those that surfaces drew to the same pose; the better one stays."""
    kept: list[Proposal] = []
    for one in sorted(proposals, key=lambda proposal: -proposal.likeness):
        apart = [one.other_from_own.between(other.other_from_own) for other in kept]
        if all(math.hypot(away.x_m, away.y_m) > 0.3 or abs(away.heading_rad) > 0.1 for away in apart):
            kept.append(one)
    return kept


def _spread(places: Sequence[Place], most: int) -> list[Place]:
    """At most so many, evenly."""
    if len(places) <= most:
        return list(places)
    return [places[int(index)] for index in np.linspace(0, len(places) - 1, most)]
