"""Which logs show one site, where each lies there, and all their keyframes aligned with each other.

No log says where it began. Each map is laid on those of the others by `registration`, without a first guess; what is
found there joins them, and a log that was not is asked again of sites that have grown since: if A meets B and B meets
C, all three are one site. An ambiguous answer never joins. A log that joins two or more is also laid on single ones of
them, and where that contradicts the join, the join is undone.

Then the keyframes of all logs of a site are aligned at once by `smoothing`: consecutive ones of a log are tied by the
motion of its finished track, those of different logs by the surfaces that both show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix, planar
from semslam.slam.surfel.alignment import between
from semslam.slam.surfel.places import Place, moved, placed
from semslam.slam.surfel.prior import Grid, Remembered, submap_of
from semslam.slam.surfel.registration import AMBIGUOUS, FOUND, LOST, Placement, Submap, place_in
from semslam.slam.surfel.semantic_field import candidates
from semslam.slam.surfel.smoothing import Smoothed, smooth
from semslam.slam.surfel.uncertainty import lever
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

FIRST, CONTRADICTED = "first", "contradicted"
"""Verdicts beside found, ambiguous and lost: the log whose frame is that of its site; a join that was undone."""
_WITNESSES = 2
"""Logs of a site, those that share most with one that joins, on which it is laid by itself."""
_LEAST = 5
"""Keyframes of a site in which logs of a larger one are looked for: fewer show too little to be sure."""
_APART_M, _APART_RAD = 0.25, 0.07
"""Two ways to the same pose contradict each other from here on: maps are good to centimetres, and 4 degrees are 0.3 m
at the end of a room."""
_MOTION_M, _MOTION_RAD = 0.01, 0.005
"""Random error over a second of the motion that a finished track tells, metres along each axis and radians."""
_STEADY_M, _STEADY_RAD = 1e-4, 1e-4
"""Its steady error: none to speak of, since the track is rid of it."""
_NO_MOTION_S = 1e6
"""Between logs: after so long nothing is known of where a robot is."""
_HEADINGS = 40
"""Of the field by which sites are put in order before they are asked."""


@dataclass(frozen=True, eq=False)
class Drive:
    """What a log knows, in its own map frame."""

    name: str
    known: tuple[Remembered, ...]
    """At least one keyframe, in the order of time."""


@dataclass(frozen=True)
class Answer:
    """What came of laying a log's map on others."""

    verdict: str
    """first, found, ambiguous, lost or contradicted."""
    other: str = ""
    """The log on whose site it was laid (its first one); empty if there was none."""
    likeness: float | None = None
    """Log likelihood ratio of a sample there, right pose against wrong one; None if no way to lie there was seen."""
    probability: float | None = None
    """Of the best way among all."""


@dataclass(frozen=True, eq=False)
class Site:
    """A place that robots know, and the logs recorded there, by name, in the map frame of the first of them."""

    drives: tuple[Drive, ...]
    answers: tuple[Answer, ...]
    poses: tuple[tuple[Matrix, ...], ...]
    """site_from_robot of each log's keyframes, (4, 4)."""
    covariances: tuple[tuple[Floats, ...], ...]
    """(3, 3) of each, of x, y and heading along the site's axes; none if it is a single log, or if they are not
    known."""
    ties: tuple[int, ...] = (0,)
    """Pairs that surfaces tie of each log's keyframes and others'."""

    def map_pose(self, number: int) -> SE2:
        """Where a log's own map lies: what carries its first keyframe to where it is now."""
        own = self.drives[number].known[0].place.pose
        return planar(self.poses[number][0]) @ planar(own).inverse()

    def map_error(self, number: int) -> Floats | None:
        """Covariance (3, 3) of `map_pose`, which has that of the first keyframe; None if that is not known."""
        if not self.covariances[number]:
            return None
        origin, robot = self.map_pose(number), planar(self.poses[number][0])
        arm = lever(origin.x_m - robot.x_m, origin.y_m - robot.y_m)
        return np.asarray(arm @ self.covariances[number][0] @ arm.T)


Watch = Callable[[str, int, int], None]
"""Hears what is done (a word), how much of it, and of how much."""


def merge(drives: Sequence[Drive], grid: Grid, config: SurfelConfig, watch: Watch) -> list[Site]:
    """All sites, by the names of their first logs; the same whatever the order of the logs, whose names differ."""
    ordered = sorted(drives, key=lambda drive: drive.name)
    grouping = Grouping(ordered, grid, watch)
    groups = grouping.result()
    keyframes, done = sum(len(drive.known) for drive in drives), 0
    sites: list[Site] = []
    for group in groups:
        size = sum(len(ordered[index].known) for index in group)
        told = _Told(watch, done, size / max(1, config.rounds), keyframes)
        sites += _sites(ordered, group, grouping, config, told)
        done += size
        watch("aligned", done, keyframes)
    return sorted(sites, key=lambda site: site.drives[0].name)


@dataclass(frozen=True)
class _Told:
    """Tells of the rounds over a site's keyframes as keyframes that are aligned."""

    watch: Watch
    before: int
    each: float
    whole: int

    def __call__(self, turn: int) -> None:
        """So many rounds are over."""
        self.watch("aligned", self.before + int(self.each * turn), self.whole)


# --- which belong together --------------------------------------------------------------------------------------------

_Group = dict[int, SE2]
"""Logs of a site by their number, with group_from_own."""


@dataclass(eq=False)
class Grouping:
    """Logs being sorted into sites."""

    drives: Sequence[Drive]
    grid: Grid
    watch: Watch
    answers: dict[int, Answer] = field(default_factory=dict)
    """The best one of each log."""
    _maps: dict[tuple[int, ...], Submap] = field(default_factory=dict)
    """Of sites, by their logs."""
    _asked: dict[tuple[int, tuple[int, ...]], Placement] = field(default_factory=dict)

    def result(self) -> list[_Group]:
        """All sites."""
        order = sorted(range(len(self.drives)), key=lambda one: (-len(self.drives[one].known), self.drives[one].name))
        groups: list[_Group] = []
        for number, index in enumerate(order):
            self.watch("placed", number, len(order))
            self._admit(groups, index)
        while self._meet(groups):
            self.watch("placed", len(order), len(order))
        self.watch("placed", len(order), len(order))
        return groups

    def _admit(self, groups: list[_Group], index: int) -> None:
        """Into the site where a log is found, those that look most alike first; else into one of its own."""
        own = self._map({index: SE2(0.0, 0.0, 0.0)})
        scores = [_likeness(own, self._map(group)) for group in groups]
        for number in sorted(range(len(groups)), key=lambda one: (-scores[one], one)):
            group_from_own = self._found(index, groups[number])
            if group_from_own is not None:
                groups[number][index] = group_from_own
                return
        groups.append({index: SE2(0.0, 0.0, 0.0)})

    def _meet(self, groups: list[_Group]) -> bool:
        """Join two sites, of which a log of one is found in the other; False if there are none."""
        groups.sort(key=lambda group: (-len(group), min(group)))
        for smaller in reversed(groups):
            for larger in groups[: groups.index(smaller)]:
                larger_from_smaller = self._between(larger, smaller)
                if larger_from_smaller is not None:
                    larger |= {one: larger_from_smaller @ pose for one, pose in smaller.items()}
                    groups.remove(smaller)
                    return True
        return False

    def _between(self, larger: _Group, smaller: _Group) -> SE2 | None:
        """larger_from_smaller, by the first log of one that is found in the other: where little is shared, it may
        decide which of two is asked."""
        for index in sorted(smaller):
            found = self._found(index, larger)
            if found is not None:
                return found @ smaller[index].inverse()
        enough = sum(len(self.drives[one].known) for one in smaller) >= _LEAST
        for index in sorted(larger) if enough else ():
            found = self._found(index, smaller)
            if found is not None:
                return larger[index] @ found.inverse()
        return None

    def _found(self, index: int, group: _Group) -> SE2 | None:
        """group_from_own, if that is sure and nothing speaks against it; asked once of each site as it is."""
        key = (index, tuple(sorted(group)))
        if key in self._asked:
            return None  # what was found is no question any more
        placement = self._asked[key] = self._lay(index, group)
        found = placement.other_from_own
        verdict = placement.verdict
        if found is not None and self._contradicted(index, found, group):
            found, verdict = None, CONTRADICTED
        self._note(index, group, verdict, placement)
        return found

    def _note(self, index: int, group: _Group, verdict: str, placement: Placement) -> None:
        """Keep what says most of a log; what is more than lost is news of the other logs, too."""
        best = placement.proposals[0] if placement.proposals else None
        other = min(self.drives[one].name for one in group)
        answer = Answer(verdict, other, *((best.likeness, best.probability) if best else (None, None)))
        told = {index: answer}
        if verdict != LOST:
            told |= {one: replace(answer, other=self.drives[index].name) for one in group}
        for one, news in told.items():
            if one not in self.answers or _WEIGHT[verdict] > _WEIGHT[self.answers[one].verdict]:
                self.answers[one] = news

    def _near(self, index: int, group_from_own: SE2, group: _Group) -> list[int]:
        """The logs of a site that share most with one that was found there; none if it is of one log alone, which has
        been asked."""
        if len(group) < 2:
            return []
        mine = _voxels(self.drives[index], group_from_own)
        shared = {one: len(np.intersect1d(mine, _voxels(self.drives[one], pose))) for one, pose in group.items()}
        return sorted((one for one in shared if shared[one]), key=lambda one: (-shared[one], one))[:_WITNESSES]

    def _contradicted(self, index: int, group_from_own: SE2, group: _Group) -> bool:
        """Whether one of the logs of a site by itself tells another pose; one in which the log is not found, or not
        surely, tells none."""
        for witness in self._near(index, group_from_own, group):
            told = self._lay(index, {witness: SE2(0.0, 0.0, 0.0)}).other_from_own
            if told is not None and _apart(group[witness] @ told, group_from_own):
                return True
        return False

    def _lay(self, index: int, group: _Group) -> Placement:
        return place_in(self._map({index: SE2(0.0, 0.0, 0.0)}), self._map(group))

    def _map(self, group: _Group) -> Submap:
        """What the logs of a site have seen together; the maps that it had before are forgotten."""
        key = tuple(sorted(group))
        if key not in self._maps:
            for old in [one for one in self._maps if len(one) > 1 and set(one) <= set(key)]:
                del self._maps[old]
            known = [(one, group[number].matrix) for number in key for one in self.drives[number].known]
            places = [moved(one.place, pose @ one.place.pose) for one, pose in known]
            self._maps[key] = submap_of(places, [one.seen for one, _ in known], self.grid)
        return self._maps[key]


_WEIGHT = {LOST: 0, AMBIGUOUS: 1, CONTRADICTED: 2, FOUND: 3}
"""What says more of a log than what it said before."""


def _likeness(own: Submap, other: Submap) -> float:
    """Evidence of the cells that two maps show the same."""
    best = candidates(own.cells, other.cells, 1, _HEADINGS)
    return best[0].score if best else 0.0


def _voxels(drive: Drive, group_from_own: SE2) -> NDArray[np.int64]:
    """All that have surfels of a log."""
    places = (moved(one.place, group_from_own.matrix @ one.place.pose) for one in drive.known)
    return np.unique(np.concatenate([place.voxels for place in places]))


def _apart(one: SE2, other: SE2) -> bool:
    away = one.between(other)
    return math.hypot(away.x_m, away.y_m) > _APART_M or abs(away.heading_rad) > _APART_RAD


# --- all keyframes at once --------------------------------------------------------------------------------------------


def _sites(
    drives: Sequence[Drive],
    group: _Group,
    grouping: Grouping,
    config: SurfelConfig,
    watch: Callable[[int], None],
) -> Iterator[Site]:
    """The sites that are left of one when its keyframes are aligned: logs that no surface ties to the others are none
    of it."""
    order = sorted(group, key=lambda index: drives[index].name)
    chosen = [drives[index] for index in order]
    answers = [grouping.answers.get(index, Answer(LOST)) for index in order]
    if len(order) < 2:
        yield _alone(chosen[0], answers[0])
        return
    aligned = _Aligned(chosen, _aligned(chosen, [group[index] for index in order], config, watch))
    parts = aligned.parts()
    for part in parts:
        told = [answers[number] for number in part]
        if len(part) > 1:
            yield aligned.site(part, [replace(told[0], verdict=FIRST), *told[1:]])
        else:
            yield _alone(chosen[part[0]], replace(told[0], verdict=CONTRADICTED))


def _alone(drive: Drive, answer: Answer) -> Site:
    """A site of which there is one log: its map stays as it is."""
    return Site((drive,), (answer,), (tuple(one.place.pose for one in drive.known),), ((),))


def _aligned(
    drives: Sequence[Drive], poses: Sequence[SE2], config: SurfelConfig, watch: Callable[[int], None]
) -> Smoothed:
    """All keyframes of logs whose maps lie at these poses (group_from_own) aligned; the first one stays where it is."""
    first_from_group = poses[0].inverse()
    places: list[Place] = []
    for drive, pose in zip(drives, poses, strict=True):
        places += _tied(drive, (first_from_group @ pose).matrix)
    trusted = replace(
        config,
        position_noise_m=_MOTION_M,
        heading_noise_rad=_MOTION_RAD,
        position_bias_m=_STEADY_M,
        heading_bias_rad=_STEADY_RAD,
        rounds=config.rounds or SurfelConfig().rounds,  # 0 is for tracks; logs that nothing aligns are not merged
    )
    return smooth(places, np.zeros(3), trusted, watch)


def _tied(drive: Drive, site_from_own: Matrix) -> Iterator[Place]:
    """The keyframes of a log, each with the motion since the one before that the finished track tells."""
    before: Remembered | None = None
    for one in drive.known:
        motion, seconds = None, _NO_MOTION_S
        if before is not None:
            motion = planar(between(before.place.pose, one.place.pose))
            seconds = max(0.0, (one.stamp_nanos - before.stamp_nanos) / 1e9)
        yield placed(one.place.keyframe, site_from_own @ one.place.pose, seconds, motion, linked=True)
        before = one


@dataclass(frozen=True, eq=False)
class _Aligned:
    """Logs whose keyframes were aligned with each other."""

    drives: Sequence[Drive]
    smoothed: Smoothed
    """All keyframes in a row."""

    @cached_property
    def owner(self) -> list[int]:
        """The number of each keyframe's log."""
        return [number for number, drive in enumerate(self.drives) for _ in drive.known]

    @cached_property
    def across(self) -> list[tuple[int, int]]:
        """Numbers of the logs of each pair of keyframes that surfaces tie, of different logs."""
        pairs = [(self.owner[first], self.owner[second]) for first, second in self.smoothed.ties]
        return [(one, other) for one, other in pairs if one != other]

    def parts(self) -> list[list[int]]:
        """Numbers of logs that are tied to each other, over whatever others; rising, in the order of their first."""
        root = list(range(len(self.drives)))
        for one, other in sorted(set(self.across)):
            low, high = sorted((root[one], root[other]))
            root = [low if number == high else number for number in root]
        return [[number for number in range(len(root)) if root[number] == first] for first in sorted(set(root))]

    def site(self, part: Sequence[int], answers: Sequence[Answer]) -> Site:
        """A part as a site, in the frame of its first log."""
        poses, known = self._by_drive([place.pose for place in self.smoothed.places]), self.smoothed.covariances()
        first = part[0]
        back = np.eye(4)
        if first:  # the first of all stands where it stood
            own = self.drives[first].known[0].place.pose
            back = (planar(own) @ planar(poses[first][0]).inverse()).matrix
            known = []  # they are of another frame
        errors = self._by_drive(known) if known else [()] * len(self.drives)
        return Site(
            tuple(self.drives[number] for number in part),
            tuple(answers),
            tuple(tuple(back @ pose for pose in poses[number]) for number in part),
            tuple(tuple(errors[number]) for number in part),
            tuple(sum(number in pair for pair in self.across) for number in part),
        )

    def _by_drive(self, values: Sequence[NDArray[np.float64]]) -> list[Sequence[NDArray[np.float64]]]:
        ends = np.cumsum([len(drive.known) for drive in self.drives]).tolist()
        return [values[start:end] for start, end in pairwise([0, *ends])]
