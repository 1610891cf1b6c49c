"""Intervals: repeatable, honest about both seeds and drives, and sharper in pairs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semslam.bench.statistics import band, interval, paired


def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    """Of 200 samples of 30 drives, nine in ten or more hold the true mean, and are as wide as Student tells."""
    random = np.random.default_rng(3)
    samples = random.normal(2.0, 0.5, (200, 30))
    found = [interval(sample, draws=1000) for sample in samples]
    assert np.mean([one.low < 2.0 < one.high for one in found]) >= 0.9
    width = np.mean([one.high - one.low for one in found])
    assert width == pytest.approx(2 * 2.045 * 0.5 / math.sqrt(30), rel=0.1)


def test_same_scores_same_interval() -> None:
    """Draws come from a seed."""
    scores = np.random.default_rng(1).gamma(2.0, 1.0, (3, 12))
    assert interval(scores) == interval(scores)
    assert interval(scores, seed=1).mean == interval(scores).mean


def test_seeds_widen_the_interval() -> None:
    """Networks that differ by seed are not the same network measured three times."""
    drives = np.linspace(1.0, 2.0, 12)
    same = interval(np.stack([drives] * 3))
    other = interval(np.stack([drives - 0.5, drives, drives + 0.5]))
    assert same.mean == pytest.approx(other.mean)
    assert other.high - other.low > 1.5 * (same.high - same.low)


def test_missing_scores_are_left_out() -> None:
    """A drive without a pose counts in the coverage, not here; one drive alone has no interval."""
    scores = [[1.0, math.nan, 3.0], [1.0, math.nan, math.nan]]
    found = interval(scores)
    assert (found.mean, found.drives) == (pytest.approx(5 / 3), 2)
    assert math.isnan(interval([4.0]).low)
    assert interval([4.0]).mean == 4.0
    assert not interval([math.nan]).known


def test_pairs_are_sharper() -> None:
    """A method that is always a tenth better is told apart although both intervals overlap."""
    drives = np.random.default_rng(5).gamma(3.0, 1.0, 12)
    other, one = drives, drives * 0.9
    compared = paired(one, other)
    assert not interval(one).apart(interval(other))
    assert compared.difference.high < 0
    assert (compared.better, compared.drives) == (12, 12)
    assert compared.ratio == pytest.approx(0.9)


def test_pairs_of_three_seeds_and_of_one() -> None:
    """A trained method against one that needs no training."""
    drives = np.arange(1.0, 7.0)
    trained = np.stack([drives - 0.5, drives - 0.4, drives - 0.6])
    compared = paired(trained, drives)
    assert compared.difference.mean == pytest.approx(-0.5)
    with pytest.raises(ValueError, match="paired"):
        paired(trained, drives[:3])


def test_a_band_has_an_interval_a_step() -> None:
    """Three curves of equal length."""
    scores = np.random.default_rng(2).normal(1.0, 0.1, (2, 8, 5)) * np.arange(1, 6)
    mean, low, high = band(scores)
    assert mean.shape == (5,)
    assert (low < mean).all()
    assert (mean < high).all()
    assert mean[-1] > mean[0]
