"""Where one semantic map lies on another, without a first guess: a field over all headings and cells.

Equation 2 of the paper correlates one observation with a map. Here a whole map is correlated, and what a cell says is
weighed as evidence: `weights_of` gives, for each pair of classes (own, other), a number in the part of a log likelihood
ratio, chosen by hand. So free floor where a sofa should be counts against a pose as a sofa on a sofa counts for it, and
what either map has not seen says nothing. The scores order proposals; what they are worth, pictures decide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, wrap_angle
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE

Floats = NDArray[np.float64]

SAME_OBJECT, OTHER_OBJECT = 2.0, -0.5
OBJECT_AND_OBSTACLE, OBJECT_AND_FLOOR = 0.2, -1.2
OBSTACLE_AND_OBSTACLE, OBSTACLE_AND_FLOOR, FLOOR_AND_FLOOR = 1.2, -1.5, 0.25
"""Evidence of two cells, by what their maps say there; chosen by hand."""
COARSE_M = 0.2
"""Cell of the field, metres."""
HEADINGS = 120
_WIDEST_M = 500.0
_APART_M, _APART_RAD = 0.5, math.radians(10)
"""Modes nearer to a better one than this, in place and heading, are that one."""


@dataclass(frozen=True, eq=False)
class ClassMap:
    """The cells of a semantic map: where, and what is there."""

    points: Floats
    """(N, 2) middles, metres."""
    class_id: NDArray[np.int64]
    """(N,)"""
    cell_m: float
    classes: tuple[str, ...]

    @staticmethod
    def of(cells: Mapping[str, NDArray[Any]], cell_m: float, classes: Sequence[str]) -> ClassMap:
        """From columns ix, iy and class_id as evidence gives them."""
        points = (np.stack([cells["ix"], cells["iy"]], 1) + 0.5) * cell_m
        return ClassMap(np.asarray(points, np.float64), np.asarray(cells["class_id"], np.int64), cell_m, tuple(classes))


@dataclass(frozen=True)
class Candidate:
    """A pose of one map in another, and what speaks for it."""

    other_from_own: SE2
    score: float
    """Sum of evidence over coarse cells."""


def candidates(own: ClassMap, other: ClassMap, most: int, headings: int = HEADINGS) -> list[Candidate]:
    """The best modes of the field, best first.

    None of maps wider than 500 m, which a field does not fit.

    Raises:
        ValueError: the maps know different classes.
    """
    if own.classes != other.classes:
        raise ValueError("maps of different classes")
    if not len(own.points) or not len(other.points) or _too_wide(own) or _too_wide(other):
        return []
    field = _Field(own, other)
    peaks = [peak for number in range(headings) for peak in field.peaks(math.tau * number / headings, most)]
    return _distinct(sorted(peaks, key=lambda one: -one.score), most)


def _too_wide(one: ClassMap) -> bool:
    """Whether a few cells lie so far off that the field would not fit into memory: poses that are none."""
    return bool(np.ptp(one.points, axis=0).max() > _WIDEST_M)


class _Field:
    """The other map as images of evidence, one a class of our own."""

    def __init__(self, own: ClassMap, other: ClassMap) -> None:
        self._middle = 0.5 * (own.points.min(0) + own.points.max(0))  # about which it turns
        self._points = own.points - self._middle
        self._share = (own.cell_m / COARSE_M) ** 2
        self._class_id = own.class_id
        radius = float(np.linalg.norm(self._points, axis=1).max())
        self._half = math.ceil(radius / COARSE_M) + 1
        self._present = sorted(set(own.class_id.tolist()))
        corner = np.floor(other.points.min(0) / COARSE_M).astype(np.int64) - self._half
        cells = np.floor(other.points / COARSE_M).astype(np.int64) - corner
        self._corner = corner
        columns, rows = cells.max(0) + 1 + self._half
        there = _raster(cells, other.class_id, len(other.classes), int(rows), int(columns))
        there *= np.float32((other.cell_m / COARSE_M) ** 2)
        weights = weights_of(len(other.classes)).astype(np.float32)
        self._evidence = {one: np.tensordot(weights[one], there, 1) for one in self._present}  # (rows, columns) each

    def peaks(self, heading_rad: float, most: int) -> list[Candidate]:
        """The best places of our map, turned by a heading."""
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        turned = self._points @ np.array([[cosine, sine], [-sine, cosine]])
        cells = np.floor(turned / COARSE_M + 0.5).astype(np.int64) + self._half
        side = 2 * self._half + 1
        score: NDArray[np.float32] | None = None
        for one in self._present:
            mine = cells[self._class_id == one]
            template = np.zeros((side, side), np.float32)
            np.add.at(template, (mine[:, 1], mine[:, 0]), np.float32(self._share))
            image = self._evidence[one]
            padded = cv2.copyMakeBorder(image, self._half, self._half, self._half, self._half, cv2.BORDER_CONSTANT)
            part = np.asarray(cv2.matchTemplate(padded, template, cv2.TM_CCORR), np.float32)
            score = part if score is None else score + part
        return [] if score is None else self._best(score, heading_rad, most)

    def _best(self, score: NDArray[np.float32], heading_rad: float, most: int) -> list[Candidate]:
        """Local maxima of the score; element (row, column) has the middle of our map on the cell of that number."""
        highest = cv2.dilate(score, np.ones((3, 3), np.uint8))
        rows, columns = np.nonzero((score >= highest) & (score > 0))
        order = np.argsort(-score[rows, columns], kind="stable")[:most]
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        found = []
        for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
            x, y = (np.array([column, row]) + self._corner + 0.5) * COARSE_M
            back_x = cosine * self._middle[0] - sine * self._middle[1]
            back_y = sine * self._middle[0] + cosine * self._middle[1]
            pose = SE2(float(x - back_x), float(y - back_y), wrap_angle(heading_rad))
            found.append(Candidate(pose, float(score[row, column])))
        return found


def weights_of(classes: int) -> Floats:
    """(L, L) evidence of (own, other)."""
    weights = np.zeros((classes, classes))
    objects = slice(FIRST_OBJECT, classes)
    weights[objects, objects] = OTHER_OBJECT
    weights[np.arange(FIRST_OBJECT, classes), np.arange(FIRST_OBJECT, classes)] = SAME_OBJECT
    weights[objects, OBSTACLE] = weights[OBSTACLE, objects] = OBJECT_AND_OBSTACLE
    weights[objects, FREE_FLOOR] = weights[FREE_FLOOR, objects] = OBJECT_AND_FLOOR
    weights[OBSTACLE, FREE_FLOOR] = weights[FREE_FLOOR, OBSTACLE] = OBSTACLE_AND_FLOOR
    weights[OBSTACLE, OBSTACLE], weights[FREE_FLOOR, FREE_FLOOR] = OBSTACLE_AND_OBSTACLE, FLOOR_AND_FLOOR
    return weights


def _raster(
    cells: NDArray[np.int64], class_id: NDArray[np.int64], classes: int, rows: int, columns: int
) -> NDArray[np.float32]:
    """(L, rows, columns) how many cells of each class fall on each."""
    image = np.zeros((classes, rows, columns), np.float32)
    np.add.at(image, (class_id, cells[:, 1], cells[:, 0]), np.float32(1.0))
    return image


def _distinct(found: Sequence[Candidate], most: int) -> list[Candidate]:
    """The first of each group of like poses."""
    kept: list[Candidate] = []
    for one in found:
        if len(kept) == most:
            break
        if all(_apart(one.other_from_own, other.other_from_own) for other in kept):
            kept.append(one)
    return kept


def _apart(one: SE2, other: SE2) -> bool:
    far = math.hypot(one.x_m - other.x_m, one.y_m - other.y_m) > _APART_M
    return far or abs(wrap_angle(one.heading_rad - other.heading_rad)) > _APART_RAD
