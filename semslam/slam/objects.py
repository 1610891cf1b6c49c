"""From detections in single keyframes to the things of a place: each once, with where it stands and who saw it.

A detection's pixels with depth, laid on the map at the pose of its keyframe, are a patch of small cells. Patches of one
class that lie on each other are one thing; where two classes claim the same ground, the thing with more evidence
stands there. A cell belongs to a thing if enough of the keyframes that saw the thing saw it there, so that
a mask that spilled over once does not widen it.
"""

from __future__ import annotations

import math
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
        return _centroid(self.footprint)

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

    def take(self, patches: Sequence[Patch]) -> None:
        """More of the same thing."""
        for patch in patches:
            self.patches.append(patch)
            for cell in patch.cells.tolist():
                self.counts[cell] = self.counts.get(cell, 0) + 1

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


def things(patches: Iterable[Patch], least_frames: int) -> list[Thing]:
    """The objects that patches, by rising keyframe, show, each in so many keyframes at least; most evidence first."""
    tracks: list[_Track] = []
    for patch in patches:
        cells = set(patch.cells.tolist())
        shares = [(_met(cells, set(track.counts)), number) for number, track in enumerate(tracks)]
        same = [(share, -number) for share, number in shares if tracks[number].class_id == patch.class_id]
        share, number = max(same, default=(0.0, 0))
        if share < _SAME:
            tracks.append(_Track(patch.class_id))
        (tracks[-number] if share >= _SAME else tracks[-1]).take([patch])
    tracks = _joined(tracks)
    seen = [track for track in tracks if len(track.frames) >= least_frames]
    return [_thing(track) for track in _unrivalled(seen)]


def _joined(tracks: Sequence[_Track]) -> list[_Track]:
    """Tracks that turned out to be of one thing once more of it was seen."""
    kept: list[_Track] = []
    for track in sorted(tracks, key=lambda one: -one.evidence):
        cells = track.cells
        same = [one for one in kept if one.class_id == track.class_id and _met(cells, one.cells) >= _SAME]
        if same:
            same[0].take(track.patches)
        else:
            kept.append(track)
    return kept


def _unrivalled(tracks: Sequence[_Track]) -> list[_Track]:
    """Without things that stand where one of another class, with more evidence, stands."""
    kept: list[_Track] = []
    for track in sorted(tracks, key=lambda one: (-one.evidence, one.frames)):
        cells = track.cells
        if all(_alike(cells, other.cells) < _CLAIMED for other in kept):
            kept.append(track)
    return kept


def _met(one: set[int], other: set[int]) -> float:
    """Share of the smaller set's cells that lie in the other."""
    return len(one & other) / max(1, min(len(one), len(other)))


def _alike(one: set[int], other: set[int]) -> float:
    """Intersection over union."""
    return len(one & other) / max(1, len(one | other))


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


def _centroid(outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) of the area within an outline."""
    x, y = outline.T
    after_x, after_y = np.roll(x, -1), np.roll(y, -1)
    cross = x * after_y - after_x * y
    area = cross.sum()
    if abs(area) < 1e-12:
        return np.asarray(outline.mean(0))
    return np.asarray(np.array([((x + after_x) * cross).sum(), ((y + after_y) * cross).sum()]) / (3.0 * area))
