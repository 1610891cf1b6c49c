"""A verdict is what the covariance says, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semslam.geometry.frames import SE2
from semslam.slam.estimator import INERTIAL, NONE, PoseEstimate
from semslam.slam.verdict import LOST, OK, UNCERTAIN, verdict_of

HERE = SE2(1.0, 2.0, 0.3)


def estimate(across_m: float, along_m: float, heading_rad: float, turned_rad: float = 0.0) -> PoseEstimate:
    turn = SE2(0.0, 0.0, turned_rad).matrix[:2, :2]
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([across_m**2, along_m**2]) @ turn.T
    covariance[2, 2] = heading_rad**2
    return PoseEstimate(HERE, INERTIAL, covariance=tuple(covariance.ravel().tolist()))


def test_without_a_pose_it_is_lost_and_without_a_covariance_uncertain() -> None:
    """Nobody vouches for either."""
    assert verdict_of(PoseEstimate(None, NONE), 100.0, 3.0) == LOST
    assert verdict_of(PoseEstimate(HERE, INERTIAL), 100.0, 3.0) == UNCERTAIN
    assert verdict_of(PoseEstimate(HERE, INERTIAL, covariance=(math.nan,) * 9), 100.0, 3.0) == UNCERTAIN


@pytest.mark.parametrize("turned_rad", [0.0, 0.7, 2.0])
def test_the_worst_direction_counts(turned_rad: float) -> None:
    """Four centimetres along a corridor are within 0.1 m with 95 %, 4.2 are not, whichever way it leads."""
    assert verdict_of(estimate(0.001, 0.040, 0.001, turned_rad), 0.1, 0.035) == OK
    assert verdict_of(estimate(0.001, 0.042, 0.001, turned_rad), 0.1, 0.035) == UNCERTAIN


def test_so_does_the_heading() -> None:
    """One degree is within two with 95 %, 1.1 is not."""
    assert verdict_of(estimate(0.001, 0.001, math.radians(1.0)), 0.1, 0.035) == OK
    assert verdict_of(estimate(0.001, 0.001, math.radians(1.1)), 0.1, 0.035) == UNCERTAIN


def test_circular_doubt_is_within_the_circle_of_95_percent() -> None:
    """Of many draws 95 % fall where the verdict says."""
    sigma = 0.1 / math.sqrt(-2 * math.log(0.05))
    draws = np.random.default_rng(0).normal(0.0, sigma, (100_000, 2))
    assert np.mean(np.hypot(*draws.T) <= 0.1) == pytest.approx(0.95, abs=0.003)
    assert verdict_of(estimate(0.999 * sigma, 0.999 * sigma, 0.0), 0.1, 0.035) == OK
    assert verdict_of(estimate(1.001 * sigma, 1.001 * sigma, 0.0), 0.1, 0.035) == UNCERTAIN
