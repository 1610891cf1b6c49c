"""From detections in single keyframes to the things of a place: each once, with where it stands and who saw it.

A detection's pixels with depth, laid on the map at the pose of its keyframe, are a patch of small cells. Patches of one
class that lie on each other are one thing; where two classes claim the same ground, the thing with more evidence
stands there. A cell belongs to a thing if enough of the keyframes that saw the thing saw it there, so that
a mask that spilled over once does not widen it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2

CELL_M = 0.05
_SAME = 0.35
"""Share of the smaller one's cells in which two patches of one class must meet to be one thing."""
_CLAIMED = 0.4
"""Intersection over union from which on two things of different classes are two names of one: what stands on a table
covers little of it."""
_SPILL = 0.25
"""Share of the keyframes of the best seen cell that must have seen a cell of a thing."""
_LEAST_PIXELS = 3
"""Pixels that make a cell of a patch: single ones are noise of depth."""
_TOP = 0.98
"""Share of its points that a thing's height leaves below."""

Cells = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Patch:
    """What one detection covers of the ground."""

    class_id: int
    score: float
    frame: int
    stamp_nanos: int
    cells: Cells
    """(n,) cells of the map, numbered by `_number`, rising."""
    top_m: float
    """Height of the detection's points above the floor."""

    @staticmethod
    def of(
        points: NDArray[np.float32], map_from_robot: SE2, class_id: int, score: float, frame: int, stamp_nanos: int
    ) -> Patch | None:
        """Of points (n, 3) in the robot frame; None if they make no cell."""
        cosine, sine = math.cos(map_from_robot.heading_rad), math.sin(map_from_robot.heading_rad)
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        across = np.floor((map_from_robot.x_m + cosine * x - sine * y) / CELL_M).astype(np.int64)
        along = np.floor((map_from_robot.y_m + sine * x + cosine * y) / CELL_M).astype(np.int64)
        cells, pixels = np.unique(_number(across, along), return_counts=True)
        kept = cells[pixels >= _LEAST_PIXELS]
        if not len(kept):
            return None
        return Patch(class_id, score, frame, stamp_nanos, kept, float(np.quantile(points[:, 2], _TOP)))


@dataclass(frozen=True, eq=False)
class Thing:
    """An object of the map."""

    class_id: int
    footprint: NDArray[np.float64]
    """(V, 2) outline in the map frame, counter-clockwise, metres: the convex hull of its cells."""
    cells: NDArray[np.float64]
    """(n, 2) middles of its cells, metres."""
    height_m: float
    score: float
    """Mean confidence of its detections."""
    frames: tuple[int, ...]
    """Keyframes in which it was detected, rising."""
    first_seen_nanos: int
    last_seen_nanos: int

    @property
    def middle(self) -> NDArray[np.float64]:
        """(2,) centroid of its footprint."""
        return centroid(self.footprint)

    @property
    def area_m2(self) -> float:
        """Of its footprint."""
        return float(cv2.contourArea(self.footprint.astype(np.float32)))


@dataclass(eq=False)
class _Track:
    """A thing in the making."""

    class_id: int
    patches: list[Patch] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    """Keyframes that saw a cell."""
    last: dict[int, int] = field(default_factory=dict)
    """The last of them."""

    @staticmethod
    def of(patches: Iterable[Patch]) -> _Track:
        """Patches of one thing, in any order."""
        rising = sorted(patches, key=lambda patch: patch.frame)
        track = _Track(rising[0].class_id)
        for patch in rising:
            track.take(patch)
        return track

    def take(self, patch: Patch) -> None:
        """More of the same thing, of the same keyframe or a later one."""
        self.patches.append(patch)
        for cell in patch.cells.tolist():
            self.counts[cell] = self.counts.get(cell, 0) + (self.last.get(cell) != patch.frame)
            self.last[cell] = patch.frame

    @property
    def evidence(self) -> float:
        """Sum of the confidences of its detections."""
        return sum(patch.score for patch in self.patches)

    @property
    def cells(self) -> set[int]:
        """Those that enough keyframes saw."""
        least = _SPILL * max(self.counts.values())
        return {cell for cell, count in self.counts.items() if count >= least}

    @property
    def frames(self) -> tuple[int, ...]:
        return tuple(sorted({patch.frame for patch in self.patches}))


class _Ground:
    """Which tracks lie on a cell."""

    def __init__(self) -> None:
        self.sizes: list[int] = []
        """Cells of each track."""
        self._on: dict[int, list[int]] = {}

    def lay(self, number: int, cells: Iterable[int]) -> None:
        """Add cells that the track did not have; a new one has the next number."""
        if number == len(self.sizes):
            self.sizes.append(0)
        for cell in cells:
            self._on.setdefault(cell, []).append(number)
            self.sizes[number] += 1

    def met(self, cells: Iterable[int]) -> Counter[int]:
        """How many of the cells each track has."""
        return Counter(number for cell in cells for number in self._on.get(cell, ()))


def things(patches: Iterable[Patch], least_frames: int) -> list[Thing]:
    """The objects that patches, by rising keyframe, show, each in so many keyframes at least; most evidence first."""
    tracks: list[_Track] = []
    grounds: dict[int, tuple[_Ground, list[_Track]]] = {}
    for patch in patches:
        ground, own = grounds.setdefault(patch.class_id, (_Ground(), []))
        cells = patch.cells.tolist()
        number = _same(ground, cells)
        if number == len(own):
            own.append(_Track(patch.class_id))
            tracks.append(own[number])
        ground.lay(number, [cell for cell in cells if cell not in own[number].counts])
        own[number].take(patch)
    seen = [track for track in _joined(tracks) if len(track.frames) >= least_frames]
    return [_thing(track) for track in _unrivalled(seen)]


def _same(ground: _Ground, cells: Sequence[int]) -> int:
    """The track that cells are of: the one that they meet most; a new one if they meet none enough."""
    shares = [(count / min(len(cells), ground.sizes[number]), -number) for number, count in ground.met(cells).items()]
    share, number = max(shares, default=(0.0, 0))
    return -number if share >= _SAME else len(ground.sizes)


def _joined(tracks: Sequence[_Track]) -> list[_Track]:
    """Tracks that turned out to be of one thing once more of it was seen."""
    grounds: dict[int, tuple[_Ground, list[list[Patch]], list[set[int]]]] = {}
    for track in sorted(tracks, key=lambda one: (-one.evidence, one.frames)):
        ground, groups, known = grounds.setdefault(track.class_id, (_Ground(), [], []))
        cells = sorted(track.cells)
        number = _same(ground, cells)
        if number == len(groups):
            groups.append([])
            known.append(set())
        groups[number] += track.patches
        ground.lay(number, [cell for cell in cells if cell not in known[number]])
        known[number].update(cells)
    return [_Track.of(group) for _, groups, _ in grounds.values() for group in groups]


def _unrivalled(tracks: Sequence[_Track]) -> list[_Track]:
    """Without things that stand where one of another class, with more evidence, stands."""
    kept: list[_Track] = []
    ground = _Ground()
    for track in sorted(tracks, key=lambda one: (-one.evidence, one.frames)):
        cells = sorted(track.cells)
        met = ground.met(cells).items()
        if all(count < _CLAIMED * (len(cells) + ground.sizes[number] - count) for number, count in met):
            ground.lay(len(kept), cells)
            kept.append(track)
    return kept


def _thing(track: _Track) -> Thing:
    middles = np.array([_place(cell) for cell in sorted(track.cells)])
    corners = (middles[:, None] + 0.5 * CELL_M * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])).reshape(-1, 2)
    hull = cv2.convexHull(corners.astype(np.float32), clockwise=False).reshape(-1, 2).astype(np.float64)
    stamps = [patch.stamp_nanos for patch in track.patches]
    return Thing(
        track.class_id,
        hull,
        middles,
        float(np.median([patch.top_m for patch in track.patches])),
        float(np.mean([patch.score for patch in track.patches])),
        track.frames,
        min(stamps),
        max(stamps),
    )


def _number(ix: Cells, iy: Cells) -> Cells:
    return np.asarray((ix << 32) + iy)


def _place(number: int) -> tuple[float, float]:
    """Middle of a cell, metres."""
    iy = ((number + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    return ((number - iy) >> 32) * CELL_M + 0.5 * CELL_M, iy * CELL_M + 0.5 * CELL_M


def centroid(outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) of the area within an outline."""
    x, y = outline.T
    after_x, after_y = np.roll(x, -1), np.roll(y, -1)
    cross = x * after_y - after_x * y
    area = cross.sum()
    if abs(area) < 1e-12:
        return np.asarray(outline.mean(0))
    return np.asarray(np.array([((x + after_x) * cross).sum(), ((y + after_y) * cross).sum()]) / (3.0 * area))
