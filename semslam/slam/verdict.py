"""Whether a pose may be relied on, by what its estimator tells of its own error."""

from __future__ import annotations

import math

import numpy as np

from semslam.slam.estimator import PoseEstimate

OK, UNCERTAIN, LOST = "ok", "uncertain", "lost"

_PLACE_SIGMAS = math.sqrt(-2.0 * math.log(0.05))
"""Radius of the circle that holds 95 % of a normal distribution on the plane."""
_HEADING_SIGMAS = 1.96
"""Half the width of the interval that holds 95 % of one on a line."""


def verdict_of(estimate: PoseEstimate, ok_m: float, ok_rad: float) -> str:
    """`ok` if the true pose is nearer than both bounds with 95 % probability, each; `uncertain` if it is not, or if
    nothing is told of the error; `lost` without a pose."""
    if estimate.map_from_robot is None:
        return LOST
    if estimate.covariance is None:
        return UNCERTAIN
    covariance = np.array(estimate.covariance).reshape(3, 3)
    if not np.isfinite(covariance).all():
        return UNCERTAIN
    place = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
    heading = math.sqrt(max(0.0, float(covariance[2, 2])))
    return OK if _PLACE_SIGMAS * place <= ok_m and _HEADING_SIGMAS * heading <= ok_rad else UNCERTAIN
