"""How far a semantic map is from the truth: the paper's MSE, and what the paper leaves out.

A belief is planes (L, rows, columns) of class weights; the truth is a class id a cell, (rows, columns), as
`semslam.tables.true_map` gives it: the class of every cell that has been visible so far, *unobserved* elsewhere. Every
function takes a `mask` (rows, columns) of the cells that count; None counts all. Empty sets have no score: NaN.

    map_mse            the paper's Table 4 (times 100 there)
    brier_score        Brier, Verification of forecasts expressed in terms of probability, 1950 (several classes)
    calibration_error  Naeini et al., AAAI 2015; Guo et al., On calibration of modern neural networks, ICML 2017
    class_overlaps     intersection and union of each class (Jaccard; Everingham et al., PASCAL VOC)
    boundary_f1        Csurka et al., What is a good evaluation measure for semantic segmentation?, BMVC 2013

Where a map tells no planes but one class a cell and how sure it is of it, `reliability` judges that. Its counts, those
of `class_overlaps` and those of `class_boundaries` add over maps before anything is divided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.labels import FIRST_OBJECT, UNOBSERVED

Ids = NDArray[np.int64]
"""(rows, columns) class ids."""
Mask = NDArray[np.bool_]
"""(rows, columns)."""
_BINS = 15
"""Of confidence, as Guo et al. have it."""


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Cells of each class in both maps, and in either; add those of several maps before dividing."""

    intersection: NDArray[np.int64]
    """(L,)"""
    union: NDArray[np.int64]

    def __add__(self, other: Overlaps) -> Overlaps:
        return Overlaps(self.intersection + other.intersection, self.union + other.union)

    @property
    def iou(self) -> NDArray[np.float64]:
        """(L,) intersection over union; NaN for classes in neither map."""
        present = self.union > 0
        return np.where(present, self.intersection / np.maximum(self.union, 1), np.nan)

    @property
    def mean_objects(self) -> float:
        """Mean IoU of the object classes that are in either map."""
        return _mean(self.iou[FIRST_OBJECT:])


@dataclass(frozen=True, eq=False)
class Boundaries:
    """Boundary cells of each class in both maps, and how many of them the other map has nearby; (L,) each."""

    found: NDArray[np.int64]
    found_near: NDArray[np.int64]
    """Of those found, with a true one nearby."""
    true: NDArray[np.int64]
    true_near: NDArray[np.int64]
    """Of the true ones, with one found nearby."""

    def __add__(self, other: Boundaries) -> Boundaries:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Boundaries(*(one + another for one, another in pairs))

    @property
    def f1(self) -> NDArray[np.float64]:
        """(L,) harmonic mean of precision and recall; 0 for classes in one map only, NaN for those in neither."""
        precision, recall = self.found_near / np.maximum(self.found, 1), self.true_near / np.maximum(self.true, 1)
        both = precision + recall
        f1 = 2 * precision * recall / np.where(both > 0, both, 1.0)
        return np.where((self.found > 0) | (self.true > 0), f1, np.nan)


@dataclass(frozen=True, eq=False)
class Reliability:
    """How often cells are right, by how sure the map is of their class: equal bins (low, high] of 0 to 1."""

    cells: NDArray[np.int64]
    """(bins,)"""
    confidence: NDArray[np.float64]
    """(bins,) sum of their probabilities."""
    right: NDArray[np.int64]
    """(bins,) how many have their true class."""
    squares: float
    """Sum of (probability - right or not)^2."""

    def __add__(self, other: Reliability) -> Reliability:
        cells, confidence = self.cells + other.cells, self.confidence + other.confidence
        return Reliability(cells, confidence, self.right + other.right, self.squares + other.squares)

    @property
    def error(self) -> float:
        """Expected calibration error: |accuracy - confidence| of the bins, weighted by their cells."""
        total = int(self.cells.sum())
        return float(np.abs(self.right - self.confidence).sum() / total) if total else math.nan

    @property
    def brier(self) -> float:
        """Mean squared error of the probability that the cell's class is right, 0 to 1."""
        total = int(self.cells.sum())
        return self.squares / total if total else math.nan


@dataclass(frozen=True)
class MapScore:
    """All scores of one map."""

    mse: float
    """Mean squared error over cells and classes; the paper prints 100 times it."""
    brier: float
    ece: float
    """Expected calibration error, 0 to 1."""
    object_iou: float
    """Mean over object classes present."""
    boundary_f1: float
    """Mean over object classes present."""


def score_map(belief: NDArray[Any], truth: Ids, mask: Mask | None = None) -> MapScore:
    """All scores of a belief at once."""
    found = labels_of(belief)
    return MapScore(
        map_mse(belief, truth, mask),
        brier_score(belief, truth, mask),
        calibration_error(belief, truth, mask),
        class_overlaps(found, truth, len(belief), mask).mean_objects,
        boundary_f1(found, truth, len(belief), mask),
    )


def map_mse(belief: NDArray[Any], truth: Ids, mask: Mask | None = None) -> float:
    """Mean over cells and classes of (belief - truth)^2, the truth one-hot; the belief as it is, normalised or not."""
    return _mean(_squares(belief, truth, mask))


def brier_score(belief: NDArray[Any], truth: Ids, mask: Mask | None = None) -> float:
    """Mean over cells of the squared errors summed over classes, 0 (sure and right) to 2 (sure and wrong)."""
    squares = _squares(as_probabilities(belief), truth, mask)
    return _mean(squares.sum(0))


def calibration_error(belief: NDArray[Any], truth: Ids, mask: Mask | None = None, bins: int = _BINS) -> float:
    """Expected calibration error: |accuracy - confidence| in equal bins of confidence, weighted by their cells."""
    probabilities = as_probabilities(belief)
    return reliability(labels_of(belief), probabilities.max(0), truth, mask, bins).error


def reliability(
    found: Ids, probability: NDArray[Any], truth: Ids, mask: Mask | None = None, bins: int = _BINS
) -> Reliability:
    """Of a label map and the probability of each cell's class, both (rows, columns)."""
    kept = _kept(mask, truth)
    confidence, right = probability[kept].astype(np.float64), (found == truth)[kept]
    place = np.clip(np.ceil(confidence * bins).astype(np.int64) - 1, 0, bins - 1)  # bins are (low, high]
    return Reliability(
        np.bincount(place, minlength=bins),
        np.asarray(np.bincount(place, confidence, bins), np.float64),
        np.bincount(place[right], minlength=bins),
        float(((confidence - right) ** 2).sum()),
    )


def class_overlaps(found: Ids, truth: Ids, classes: int, mask: Mask | None = None) -> Overlaps:
    """Intersection and union, cell by cell, of each class in two label maps."""
    kept = _kept(mask, truth)
    one, other = found[kept], truth[kept]
    both = np.bincount(one[one == other], minlength=classes)
    union = np.bincount(one, minlength=classes) + np.bincount(other, minlength=classes) - both
    return Overlaps(both.astype(np.int64), union.astype(np.int64))


def boundary_f1(found: Ids, truth: Ids, classes: int, mask: Mask | None = None, tolerance_cells: int = 1) -> float:
    """Mean over the object classes in either map of the F1 of their boundaries.

    A boundary cell belongs to the class and has a neighbour (of four) that does not; beyond the map nothing does. It is
    found if the other map has a boundary cell of the class at most `tolerance_cells` away, diagonals counting one.
    """
    return _mean(class_boundaries(found, truth, classes, mask, tolerance_cells).f1[FIRST_OBJECT:])


def class_boundaries(
    found: Ids, truth: Ids, classes: int, mask: Mask | None = None, tolerance_cells: int = 1
) -> Boundaries:
    """What `boundary_f1` divides, of every class."""
    kept = _kept(mask, truth)
    counts = [_boundary_counts(found == c, truth == c, kept, tolerance_cells) for c in range(classes)]
    return Boundaries(*np.array(counts, np.int64).reshape(classes, 4).T)


def labels_of(belief: NDArray[Any]) -> Ids:
    """The class of the highest weight of each cell (the first of equals); *unobserved* where all weights are zero."""
    return np.where(belief.any(0), belief.argmax(0), UNOBSERVED).astype(np.int64)


def as_probabilities(belief: NDArray[Any]) -> NDArray[np.float64]:
    """Weights of a cell divided by their sum; a cell without any is certainly *unobserved*.

    The leaky average of equation 10 keeps pixel shares, which add up to anything; a learned map's sum to 1 already.
    """
    total = belief.sum(0, dtype=np.float64)
    empty = total <= 0
    probabilities = belief / np.where(empty, 1.0, total)
    probabilities[UNOBSERVED, empty] = 1.0
    return np.asarray(probabilities, np.float64)


def _squares(belief: NDArray[Any], truth: Ids, mask: Mask | None) -> NDArray[np.float64]:
    """(L, cells kept) squared differences from the one-hot truth."""
    expected = np.arange(len(belief))[:, None, None] == truth
    difference = belief.astype(np.float64) - expected
    return np.asarray(difference[:, _kept(mask, truth)] ** 2)


def _boundary_counts(one: Mask, other: Mask, kept: Mask, tolerance: int) -> tuple[int, int, int, int]:
    """Boundary cells of a region that count and how many of them are near the other's, and the same of the other."""
    edge, other_edge = _boundary(one), _boundary(other)
    near, other_near = _grown(edge, tolerance), _grown(other_edge, tolerance)
    edge, other_edge = edge & kept, other_edge & kept
    return int(edge.sum()), int((edge & other_near).sum()), int(other_edge.sum()), int((other_edge & near).sum())


def _boundary(region: Mask) -> Mask:
    padded = np.pad(region, 1)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.asarray(region & ~inner)


def _grown(region: Mask, cells: int) -> Mask:
    """The region and all cells at most so far from it, diagonals counting one."""
    rows, columns = region.shape
    padded = np.pad(region, cells)
    shifts = [padded[i : i + rows, j : j + columns] for i in range(2 * cells + 1) for j in range(2 * cells + 1)]
    return np.asarray(np.any(shifts, axis=0))


def _kept(mask: Mask | None, truth: Ids) -> Mask:
    return np.ones(truth.shape, np.bool_) if mask is None else mask


def _mean(values: NDArray[np.float64]) -> float:
    """Of the values that are numbers; NaN without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan
