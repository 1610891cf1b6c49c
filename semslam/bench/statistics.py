"""Means, 95 % intervals and paired differences of scores by training seed and drive.

Scores are an array (seeds, drives). Both are samples: another seed and another drive would give other figures. The
interval is the percentile bootstrap that draws seeds and drives independently, with replacement, and averages what they
share (Owen, The pigeonhole bootstrap, 2007). It needs no assumption about the shape of errors, which are skewed, and
for one seed is the ordinary bootstrap over drives. With few drives it is somewhat too narrow (about 92 % for 12), and
drives through one home share its furniture. Draws come from an explicit seed: the same scores give the same interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FLOATS = NDArray[np.float64]
_DRAWS = 10_000
_LOW, _HIGH = 2.5, 97.5


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % interval."""

    mean: float
    """NaN without any score."""
    low: float
    """NaN, like `high`, with fewer than two drives: one drive says nothing about others."""
    high: float
    seeds: int
    drives: int

    @property
    def known(self) -> bool:
        """Whether there is a mean."""
        return not math.isnan(self.mean)

    def apart(self, other: Interval) -> bool:
        """Whether the two intervals do not meet."""
        return self.high < other.low or other.high < self.low


@dataclass(frozen=True)
class Paired:
    """How one method differs from another on the same drives."""

    difference: Interval
    """Of the scores, one minus other; below zero the first is better."""
    ratio: float
    """Mean of the first over mean of the other."""
    better: int
    """Drives on which the first has the lower score, seeds averaged."""
    drives: int


def interval(scores: ArrayLike, *, draws: int = _DRAWS, seed: int = 0) -> Interval:
    """Mean and interval of scores (seeds, drives) or (drives,); NaN marks scores that do not exist."""
    values = np.atleast_2d(np.asarray(scores, np.float64))
    values = values[:, ~np.isnan(values).all(0)]
    seeds, drives = values.shape
    if drives == 0:
        return Interval(math.nan, math.nan, math.nan, 0, 0)
    mean = float(np.nanmean(values))
    if drives == 1:
        return Interval(mean, math.nan, math.nan, seeds, drives)
    low, high = np.percentile(_resampled(values, draws, seed), (_LOW, _HIGH))
    return Interval(mean, float(low), float(high), seeds, drives)


def paired(one: ArrayLike, other: ArrayLike, *, draws: int = _DRAWS, seed: int = 0) -> Paired:
    """Compare scores (seeds, drives) of two methods on the same drives; seeds are averaged where their numbers differ.

    Raises:
        ValueError: they are not of the same drives.
    """
    first, second = (np.atleast_2d(np.asarray(scores, np.float64)) for scores in (one, other))
    if first.shape[1] != second.shape[1]:
        raise ValueError(f"scores of {first.shape[1]} and of {second.shape[1]} drives are not paired")
    means = _over_seeds(first), _over_seeds(second)
    both = ~np.isnan(means[0]) & ~np.isnan(means[1])
    difference = first - second if first.shape == second.shape else first - means[1]
    ratio = float(means[0][both].mean() / means[1][both].mean()) if both.any() else math.nan
    better = int((means[0][both] < means[1][both]).sum())
    return Paired(interval(difference, draws=draws, seed=seed), ratio, better, int(both.sum()))


def band(scores: ArrayLike, *, draws: int = 1000, seed: int = 0) -> tuple[_FLOATS, _FLOATS, _FLOATS]:
    """Mean, low and high of each step for scores (seeds, drives, steps): the band of a curve over time."""
    values = np.asarray(scores, np.float64)
    found = [interval(values[:, :, step], draws=draws, seed=seed) for step in range(values.shape[2])]
    mean, low, high = (np.array([getattr(one, name) for one in found]) for name in ("mean", "low", "high"))
    return mean, low, high


def _resampled(values: _FLOATS, draws: int, seed: int) -> _FLOATS:
    """(draws,) means of what drawn seeds and drawn drives share; draws that share nothing are left out."""
    seeds, drives = (_times_drawn(number, draws, seed, axis) for axis, number in enumerate(values.shape))
    known = ~np.isnan(values)
    total = ((seeds @ np.where(known, values, 0.0)) * drives).sum(1)
    share = ((seeds @ known.astype(np.float64)) * drives).sum(1)
    return np.asarray(total[share > 0] / share[share > 0])


@lru_cache(maxsize=64)
def _times_drawn(number: int, draws: int, seed: int, axis: int) -> _FLOATS:
    """(draws, number) how often each of `number` things comes up when as many are drawn with replacement."""
    random = np.random.default_rng([seed, axis])
    return random.multinomial(number, np.full(number, 1 / number), draws).astype(np.float64)


def _over_seeds(values: _FLOATS) -> _FLOATS:
    """(drives,) means over the seeds that have a score; NaN where none has."""
    known = ~np.isnan(values)
    count = known.sum(0)
    total = np.where(known, values, 0.0).sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
