"""Rigid transforms: SE(2) for the robot on its floor, 4x4 matrices for sensors, quaternions as they come from logs.

A matrix named `parent_from_child` maps points of the child frame into the parent frame. Quaternions are (x, y, z, w).
Body frames are x forward, y left, z up; optical frames x right, y down, z forward.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semslam.errors import SemslamError

Matrix = NDArray[np.float64]
"""(4, 4) rigid transform, parent_from_child."""

QUATERNION_TOLERANCE = 0.1
"""Norms this far from 1 are rounding of the sender and are normalised; others are refused."""

STEEP = 0.995
"""Above this vertical share the body's x axis gives no heading, and its y axis is asked instead (84 degrees)."""

FLU_FROM_OPTICAL: Matrix = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Forward-left-up axes from optical axes at the same place."""
FLU_FROM_OPTICAL.setflags(write=False)


def wrap_angle(angle_rad: float) -> float:
    """The same direction in (-pi, pi]. An infinite angle raises ValueError."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped <= -math.pi else wrapped


def wrap_angles(angles_rad: ArrayLike) -> NDArray[np.float64]:
    """`wrap_angle` of every element."""
    angles = np.asarray(angles_rad, np.float64)
    wrapped = angles - math.tau * np.round(angles / math.tau)
    return np.where(wrapped <= -math.pi, math.pi, np.minimum(wrapped, math.pi))


@dataclass(frozen=True)
class SE2:
    """A planar pose or motion: where a child frame stands in its parent, metres and radians."""

    x_m: float
    y_m: float
    heading_rad: float

    def __matmul__(self, other: SE2) -> SE2:
        """a_from_c = a_from_b @ b_from_c; the heading comes out wrapped."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return SE2(
            self.x_m + cosine * other.x_m - sine * other.y_m,
            self.y_m + sine * other.x_m + cosine * other.y_m,
            wrap_angle(self.heading_rad + other.heading_rad),
        )

    def inverse(self) -> SE2:
        """child_from_parent."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        x, y = -cosine * self.x_m - sine * self.y_m, sine * self.x_m - cosine * self.y_m
        return SE2(x, y, wrap_angle(-self.heading_rad))

    def between(self, other: SE2) -> SE2:
        """The motion that leads from this pose to `other`, seen from this pose."""
        return self.inverse() @ other

    @property
    def matrix(self) -> Matrix:
        """The same as a 4x4 matrix of a z-up frame, on the floor."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        matrix = np.eye(4)
        matrix[:2] = [[cosine, -sine, 0.0, self.x_m], [sine, cosine, 0.0, self.y_m]]
        return matrix

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 2) of the child frame in the parent frame."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        rotation = np.array([[cosine, -sine], [sine, cosine]])
        return np.asarray(np.asarray(points, np.float64) @ rotation.T + (self.x_m, self.y_m))


def unit_quaternion(quaternion_xyzw: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """The quaternion scaled to norm 1.

    Raises:
        SemslamError: it is not four finite numbers, or its norm is off by more than `QUATERNION_TOLERANCE`.
    """
    quaternion = np.asarray(quaternion_xyzw, np.float64)
    if quaternion.shape != (4,) or not np.isfinite(quaternion).all():
        raise SemslamError(
            f"Orientation `{_shown(quaternion)}` is not a quaternion of four finite numbers (x, y, z, w)"
        )
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise SemslamError(
            f"Orientation `{_shown(quaternion)}` has norm {norm:.4g}; a rotation has norm 1",
            hint="A norm of 0 usually means that the sender never filled in the orientation.",
        )
    return quaternion / norm


def _shown(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.6g}" for value in values.ravel()[:8])


def matrix_from_pose(
    position: Sequence[float] | NDArray[np.float64], quaternion_xyzw: Sequence[float] | NDArray[np.float64]
) -> Matrix:
    """parent_from_child of a child at `position` (metres) with that orientation in its parent.

    Raises:
        SemslamError: the position is not three finite numbers, or the quaternion is no rotation.
    """
    place = np.asarray(position, np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise SemslamError(f"Position `{_shown(place)}` is not three finite numbers (x, y, z)")
    matrix = np.eye(4)
    matrix[:3, :3] = _rotation_from_quaternion(unit_quaternion(quaternion_xyzw))
    matrix[:3, 3] = place
    return matrix


def _rotation_from_quaternion(unit_xyzw: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z, w = (float(value) for value in unit_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(matrix: Matrix) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) with w >= 0 of the rotation in a (3, 3) or (4, 4) matrix.

    Solves for the largest of the four components first, so that it is exact for every angle.
    """
    r = np.asarray(matrix, np.float64)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    squares = np.array([r[0, 0], r[1, 1], r[2, 2], trace]) * 2.0 - trace + 1.0
    squares[3] = 1.0 + trace
    products = np.array(
        [
            [squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]],
        ]
    )
    row = products[int(np.argmax(squares))]
    quaternion = row / np.linalg.norm(row)
    return np.asarray(-quaternion if quaternion[3] < 0 else quaternion)


def invert(matrix: Matrix) -> Matrix:
    """child_from_parent of a rigid parent_from_child."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def interpolate(matrix_a: Matrix, matrix_b: Matrix, fraction: float) -> Matrix:
    """The pose `fraction` of the way from a to b: straight in position, shortest arc in rotation (slerp)."""
    a, b = quaternion_from_matrix(matrix_a), quaternion_from_matrix(matrix_b)
    matrix = np.eye(4)
    matrix[:3, :3] = _rotation_from_quaternion(_slerp(a, b, fraction))
    matrix[:3, 3] = (1.0 - fraction) * matrix_a[:3, 3] + fraction * matrix_b[:3, 3]
    return matrix


def _slerp(a: NDArray[np.float64], b: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    if float(a @ b) < 0.0:
        b = -b
    angle = 2.0 * math.atan2(float(np.linalg.norm(a - b)), float(np.linalg.norm(a + b)))
    if angle < 1e-9:
        return a
    mixed = (math.sin((1.0 - fraction) * angle) * a + math.sin(fraction * angle) * b) / math.sin(angle)
    return np.asarray(mixed / np.linalg.norm(mixed))


def rotation_from_vector(rotation_vector: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians about their own direction (Rodrigues)."""
    vector = np.asarray(rotation_vector, np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    first = np.sinc(angle / math.pi)  # sin(a) / a
    second = 0.5 * np.sinc(angle / math.tau) ** 2  # (1 - cos(a)) / a^2
    cross = cross_matrix(vector)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3, 3) matrices whose product with w is vector x w."""
    cross = np.zeros((*vector.shape[:-1], 3, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    return cross


def planar(matrix: Matrix) -> SE2:
    """The pose on the ground plane of a 3D pose in a z-up frame.

    The heading is the direction of the body's x axis projected on the ground; where that axis is nearly vertical
    (`STEEP`), a right angle less than the direction of its y axis, which is then nearly level.
    """
    if abs(matrix[2, 0]) < STEEP:
        heading = math.atan2(matrix[1, 0], matrix[0, 0])
    else:
        heading = math.atan2(matrix[1, 1], matrix[0, 1]) - math.pi / 2
    return SE2(float(matrix[0, 3]), float(matrix[1, 3]), wrap_angle(heading))
