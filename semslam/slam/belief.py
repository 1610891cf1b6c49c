"""What a cell of the map is, and how surely, given how much of what was seen in it.

Keyframes that see the same wrong thing see it for the same reason: the same detector, the same shadow, the same gap
under a bed. Sights of a class c in a cell, E(c) in sum of their weights, therefore tell little more than one:

    e(c) = E(c)^0.2

Twenty sights tell less than twice as much as one. What they tell of each thing that the cell may be, in nats against
free floor, adds up (naive Bayes, a log-linear model):

    log odds         before   each e of it   of other objects   of obstacle   of free floor
    an object c       -3.6        4.3             -0.6              1.4           -1.7
    obstacle          -1.5        3.3             -0.9                            -3.7
    free floor         0          0                0                 0             0

An obstacle speaks for an object because detectors overlook many, free floor against an object less than against an
obstacle, because one sees it between legs. The numbers are those of greatest likelihood on 16 simulated drives at true
poses (semslam's own detector, cells of 0.1 m), rounded; docs/accuracy.md says what they are worth on others.

**Things are convex.** From low above the floor a bed is its front, one side and floor between its legs. Where touching
cells of a class, taken one by one, make a blob (of four cells at least and no wider than a tile), obstacle and floor
within its convex hull are probably of the same thing: 6.2 for the class there, 1.1 for obstacle. Cells of other objects
stay what they are.

    probability(c) = odds(c) / sum of odds

over floor, obstacle, the classes that were seen in the cell or enclose it, and `UNSEEN_CLASSES` others that nobody saw
there, so that a detector of many classes is no less sure than one of few.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED

POWER = 0.2
UNSEEN_CLASSES = 12
"""Of the detector whose drives gave the numbers."""
LEAST_BLOB = 4

Floats = NDArray[np.float64]
Ids = NDArray[np.uint16]
"""(rows, columns) class ids."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class LogOdds:
    """What speaks for a kind of thing, in nats against free floor."""

    before: float
    own: float
    others: float
    """Of an obstacle: of all objects."""
    obstacle: float
    floor: float
    enclosed: float


OBJECT = LogOdds(-3.6, own=4.3, others=-0.6, obstacle=1.4, floor=-1.7, enclosed=6.2)
ALONE = LogOdds(-1.5, own=3.3, others=-0.9, obstacle=3.3, floor=-3.7, enclosed=1.1)
"""An obstacle."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Log odds of what the cells of a part of the map may be."""

    ids: tuple[int, ...]
    """Of the objects, rising."""
    objects: Floats
    """(N, rows, columns); minus infinity for those that were not seen in a cell."""
    obstacle: Floats
    """(rows, columns)"""
    unseen: Floats
    """(rows, columns) of any class that was not seen there."""
    known: Mask
    """(rows, columns) where anything was seen."""

    @staticmethod
    def of(weights: Mapping[int, NDArray[np.float32]], shape: tuple[int, int]) -> Belief:
        """From the summed weights of the sights of each class (rows, columns)."""
        ids = tuple(sorted(class_id for class_id in weights if class_id >= FIRST_OBJECT))
        told = {class_id: np.power(values, POWER, dtype=np.float64) for class_id, values in weights.items()}
        nothing = np.zeros(shape)
        floor, obstacle = told.get(FREE_FLOOR, nothing), told.get(OBSTACLE, nothing)
        own = np.stack([told[class_id] for class_id in ids]) if ids else np.zeros((0, *shape))
        every = own.sum(0)
        common = OBJECT.before + OBJECT.obstacle * obstacle + OBJECT.floor * floor
        objects = common + OBJECT.own * own + OBJECT.others * (every - own)
        return Belief(
            ids,
            np.where(own > 0, objects, -np.inf),
            ALONE.before + ALONE.own * obstacle + ALONE.others * every + ALONE.floor * floor,
            common + OBJECT.others * every,
            (floor + obstacle + every) > 0,
        )

    def labels(self) -> Ids:
        """The most probable class of each cell; *unobserved* where nothing was seen."""
        return self._best(self._odds())[0]

    def enclosed(self, hulls: Mapping[int, Mask]) -> Belief:
        """The same, knowing which cells the hulls of the blobs of some classes hold."""
        if not hulls:
            return self
        ids = tuple(sorted({*self.ids, *hulls}))
        rows = dict(zip(self.ids, self.objects, strict=True))
        objects = np.stack([rows.get(class_id, np.full(self.obstacle.shape, -np.inf)) for class_id in ids])
        for class_id, hull in hulls.items():
            row = objects[ids.index(class_id)]
            row[hull] = np.maximum(row, self.unseen)[hull] + OBJECT.enclosed
        obstacle = self.obstacle + ALONE.enclosed * np.any(list(hulls.values()), axis=0)
        return Belief(ids, objects, obstacle, self.unseen, self.known)

    def told(self) -> tuple[Ids, NDArray[np.float32]]:
        """The most probable class of each cell (*unobserved* where nothing was seen) and its probability."""
        odds = self._odds()
        labels, highest = self._best(odds)
        others = UNSEEN_CLASSES * np.exp(self.unseen - highest)
        return labels, np.asarray(1.0 / (np.exp(odds - highest).sum(0) + others), np.float32)

    def _odds(self) -> Floats:
        """(N + 2, rows, columns): objects, obstacle, free floor."""
        return np.concatenate([self.objects, self.obstacle[None], np.zeros((1, *self.obstacle.shape))])

    def _best(self, odds: Floats) -> tuple[Ids, Floats]:
        """The class of the highest odds, objects before obstacle before floor among equals, and these odds."""
        order = np.array([*self.ids, OBSTACLE, FREE_FLOOR], np.uint16)
        return np.where(self.known, order[odds.argmax(0)], np.uint16(UNOBSERVED)), odds.max(0)


def hulls_of(labels: Ids, inner: tuple[slice, slice], widest: int) -> dict[int, Mask]:
    """Where obstacle and floor of the inner part of a map lie in the hull of a blob of a class, by class.

    `labels` must reach `widest` cells beyond the inner part.
    """
    part = labels[inner]
    open_cells = (part == OBSTACLE) | (part == FREE_FLOOR)
    hulls = {}
    for class_id in sorted(set(np.unique(labels).tolist()) - {UNOBSERVED, OBSTACLE, FREE_FLOOR}):
        canvas = np.zeros(labels.shape, np.uint8)
        for corners in _blobs(labels == class_id, inner, widest):
            cv2.fillConvexPoly(canvas, corners, 1)
        held = canvas[inner].astype(np.bool_) & open_cells
        if held.any():
            hulls[class_id] = held
    return hulls


def _blobs(cells: Mask, inner: tuple[slice, slice], widest: int) -> Iterator[NDArray[np.int32]]:
    """Corners of the hulls of blobs that may reach into the inner part."""
    count, blobs, stats, _ = cv2.connectedComponentsWithStats(cells.astype(np.uint8), connectivity=8)
    for blob in range(1, count):
        left, low, width, height, area = (int(v) for v in stats[blob])
        meets = left < inner[1].stop and left + width > inner[1].start and low < inner[0].stop
        if area >= LEAST_BLOB and max(width, height) <= widest and meets and low + height > inner[0].start:
            y, x = np.nonzero(blobs[low : low + height, left : left + width] == blob)
            yield np.asarray(cv2.convexHull(np.stack([x + left, y + low], 1).astype(np.int32)), np.int32)
