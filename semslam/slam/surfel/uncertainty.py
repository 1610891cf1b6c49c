"""Covariances (3, 3) of x, y and heading, carried from one pose to another and from one frame to another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix

Floats = NDArray[np.float64]


def lever(x_m: float, y_m: float) -> Floats:
    """(3, 3) what an error of a pose does to one that is rigidly tied to it, (x_m, y_m) away along the same axes."""
    return np.array([[1.0, 0.0, -y_m], [0.0, 1.0, x_m], [0.0, 0.0, 1.0]])


def turn_of(parent_from_child: Matrix) -> Floats:
    """(3, 3) that takes errors along the child's axes to the parent's."""
    turn = np.eye(3)
    turn[:2, :2] = parent_from_child[:2, :2]
    return turn


def along(covariance: Floats, parent_from_child: Matrix) -> Floats:
    """A covariance along the child's axes, along the parent's."""
    turn = turn_of(parent_from_child)
    return np.asarray(turn @ covariance @ turn.T)


def grown(before: Floats, map_from_before: Matrix, map_from_after: Matrix, step: Floats) -> Floats:
    """Covariance of the pose after a step, along the map's axes like that `before`; `step` is that of the step, along
    the axes of the pose before."""
    x, y = (map_from_after - map_from_before)[:2, 3]
    arm = lever(float(x), float(y))
    return np.asarray(arm @ before @ arm.T) + along(step, map_from_before)
