"""How surfels of one frame lie on those of another, as normal equations of the pose between them.

A surfel is compared with the nearest one of the other frame that faces the same way: its distance along the mean of
both normals (symmetric point to plane: S. Rusinkiewicz, A Symmetric Objective Function for ICP, 2019), over the
standard deviation that the two together have. Distances far beyond it lose their weight (Geman and McClure).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix, cross_matrix, invert, rotation_from_vector
from semslam.slam.surfel.surfels import Surfels

Floats = NDArray[np.float64]

_SAME_WAY = 0.85
"""Least cosine between two normals of one surface: 32 degrees."""
_OUTLIER = 2.5
"""Standard deviations at which a distance has a quarter of its weight."""
DOUBT = 3.0
"""By how much less surfaces tell than their equations say, since neighbouring surfels err alike, and the same ones in
many pairs: the squared Mahalanobis distance of the truth is then what it should be (benchmarks/calibration.py)."""
_WARY = 1.5
"""So many times what the noise of normals is expected to tell is left out, since by chance it may have told more."""
_HELD_M = 0.03
"""Standard deviation along one direction of the floor that surfaces must leave at most to be a wall: right poses leave
0.002 to 0.015, and a wrong one at which little came to lie on anything left 0.08."""
_TINY, _LEAST = 1e-12, 1e-12
"""Share of a Hessian that keeps parts of it solvable of which it says nothing; the least that it is taken to be."""
_SHARED = 0.2
"""What a distance counts: those of neighbours err alike, since they come from the same pixels and surfaces."""


_STEPS = np.stack(np.meshgrid(*3 * [[-1, 0, 1]], indexing="ij"), -1).reshape(-1, 3)
"""(27, 3) steps from a voxel to itself and to those around it."""


class Target:
    """Surfels that others can be aligned with."""

    def __init__(self, surfels: Surfels, farthest_m: float = 0.0) -> None:
        """`farthest_m`: no fit will reach farther, and what is farther from all surfels is sorted out before the tree
        is asked, which takes long for it: worth while for large maps and wrong guesses. 0 sorts nothing out; the fits
        are the same either way."""
        self.surfels = surfels
        self._farthest_m = farthest_m

    @cached_property
    def tree(self) -> Any:
        """To find the nearest."""
        import small_gicp

        return small_gicp.KdTree(self.surfels.points)

    @cached_property
    def _around(self) -> NDArray[np.int64]:
        """Voxels within one of a surfel's, rising."""
        own = np.unique(_cells(self.surfels.points, self._farthest_m), axis=0)
        return np.unique(_numbers((own[:, None] + _STEPS).reshape(-1, 3)))

    def fit(self, moved: Surfels, reach_m: float) -> Fit:
        """Compare surfels, already moved into this frame, with the nearest ones up to `reach_m` away."""
        if not len(moved) or not len(self.surfels):
            return Fit.nothing()
        if self._farthest_m:
            inside = np.isin(_numbers(_cells(moved.points, self._farthest_m)), self._around)
            moved = Surfels(moved.points[inside], moved.normals[inside], moved.sigma_m[inside])
        if not len(moved):
            return Fit.nothing()
        found, squared = self.tree.batch_nearest_neighbor_search(moved.points)
        near = np.asarray(found, np.int64).ravel()
        cosine = np.einsum("ij,ij->i", moved.normals, self.surfels.normals[near])
        source = np.flatnonzero((np.asarray(squared).ravel() < reach_m**2) & (cosine > _SAME_WAY))
        near = near[source]
        normals = moved.normals[source] + self.surfels.normals[near]
        squared_sum = np.einsum("ij,ij->i", normals, normals)
        normals /= np.sqrt(squared_sum)[:, None]
        points = moved.points[source]
        distance = np.einsum("ij,ij->i", normals, points - self.surfels.points[near])
        sigma = np.hypot(moved.sigma_m[source], self.surfels.sigma_m[near])
        return Fit(points, normals, distance, sigma, np.maximum(0.0, 4.0 - squared_sum) / 8.0)


def _cells(points: Floats, side_m: float) -> NDArray[np.int64]:
    """(N, 3) voxels in which points lie."""
    return np.floor(points / side_m).astype(np.int64)


def _numbers(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) a number for each voxel; only beyond a million of them along an axis do some share one."""
    shifted = cells + (1 << 20)
    return np.asarray((shifted[:, 0] << 42) ^ (shifted[:, 1] << 21) ^ shifted[:, 2])


@dataclass(frozen=True, eq=False)
class Fit:
    """K surfels beside their nearest ones, in the target's frame."""

    points: Floats
    """(K, 3) of the source."""
    normals: Floats
    """(K, 3) along which they are compared."""
    distance_m: Floats
    """(K,) signed."""
    sigma_m: Floats
    """(K,) its standard deviation."""
    normal_variance: Floats
    """(K,) variance of the normal's direction (rad^2) about each of two axes across it, as two normals that should be
    one tell it: a quarter of their squared angle for each of them, half of that for their mean."""

    @staticmethod
    def nothing() -> Fit:
        """No surfels."""
        return Fit(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0))

    def __len__(self) -> int:
        return len(self.distance_m)

    @property
    def weights(self) -> Floats:
        """(K,) inverse variances, less for outliers."""
        share = 1.0 / (1.0 + (self.distance_m / (_OUTLIER * self.sigma_m)) ** 2)
        return _SHARED * (share / self.sigma_m) ** 2

    def equations(self, about: Floats) -> tuple[Floats, Floats]:
        """Hessian (6, 6) and gradient (6,) for a turn (3) of the source about a point (3,) and a shift (3).

        The noise of normals alone seems to hold a pose to some centimetres where it is: good for going a step from a
        pose that was chosen by other means, but no knowledge.
        """
        jacobian = self._jacobian(about)
        weighted = jacobian * self.weights
        return weighted @ jacobian.T, weighted @ self.distance_m

    def information(self, about: Floats) -> tuple[Floats, Floats]:
        """`equations` without what the noise of normals alone tells (`_without_spurious`), over `DOUBT`."""
        jacobian, noisy = self._jacobian(about), self.weights * self.normal_variance
        spurious = _point_hessian(self.points - about, noisy) - (jacobian * noisy) @ jacobian.T
        hessian, gradient = _without_spurious(spurious, *self.equations(about))
        return hessian / DOUBT, gradient / DOUBT

    def _jacobian(self, about: Floats) -> Floats:
        """(6, K)"""
        x, y, z = (self.points - about).T
        a, b, c = self.normals.T
        return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c])


def _point_hessian(points: Floats, weights: Floats) -> Floats:
    """Hessian (6, 6) that points (K, 3) would have if each of them were held along all three axes."""
    squares = (points * weights[:, None]).T @ points
    cross = cross_matrix(weights @ points)
    turns = np.trace(squares) * np.eye(3) - squares
    return np.block([[turns, cross], [cross.T, float(weights.sum()) * np.eye(3)]])


def _without_spurious(spurious: Floats, hessian: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """Normal equations without what is expected of them where nothing is known.

    Normals scatter about that of a wall, and so each of them says a little of where one is along the wall. Their errors
    are squared in the Hessian, so that hundreds of them say a lot: a wall alone would hold a robot to centimetres along
    it. Directions are taken in which Hessian and spurious part have no mixed terms; in each the Hessian and the
    gradient are lowered alike, so that what it tells stays what it was, but it weighs less, or nothing.
    """
    scale = np.sqrt(np.maximum(np.diag(hessian), _LEAST))
    lower = np.linalg.cholesky(hessian / np.outer(scale, scale) + _TINY * np.eye(6)) * scale[:, None]
    inverse = np.linalg.inv(lower)
    shares, ways = np.linalg.eigh(inverse @ spurious @ inverse.T)
    kept = np.maximum(0.0, 1.0 - _WARY * shares)
    forth = lower @ ways
    return (forth * kept) @ forth.T, (forth * kept) @ (ways.T @ (inverse @ gradient))


def shows_wall(information: Floats) -> bool:
    """Whether surfaces hold a pose along one direction of the floor at least: a floor alone tells heights."""
    return float(_on_floor(information)[0][1]) > _HELD_M**-2


def weakest_direction(hessian: Floats) -> Floats:
    """(2,) unit vector on the floor along which a pose is held worst, whatever its turn."""
    return _on_floor(hessian)[1][:, 0]


def _on_floor(hessian: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (2,), rising, and eigenvectors (2, 2) of what a Hessian (6, 6) tells of x and y alone."""
    values, vectors = np.linalg.eigh(marginal_information(hessian, (3, 4)))
    return np.asarray(values), np.asarray(vectors)


def marginal_information(hessian: Floats, keep: Sequence[int]) -> Floats:
    """Information about some of the six unknowns, whatever the others are (Schur complement)."""
    kept, rest = list(keep), [index for index in range(6) if index not in keep]
    others = hessian[np.ix_(rest, rest)] + np.diag(np.full(len(rest), _TINY * (1.0 + np.trace(hessian))))
    tied = hessian[np.ix_(kept, rest)] @ np.linalg.solve(others, hessian[np.ix_(rest, kept)])
    return np.asarray(hessian[np.ix_(kept, kept)] - tied)


def pair_equations(
    hessian: Floats, gradient: Floats, target_from_source: Matrix, parent_from_target: Matrix
) -> tuple[Floats, Floats]:
    """Hessian (12, 12) and gradient (12,) for changes of the source's pose, then of the target's, along their parent's
    axes; from those (6, 6) and (6,) of the source's alone, about its origin, along the target's axes.

    A turn of the target about its own origin moves the source's along with it: J_target = -J_source A.
    """
    whole = np.zeros((6, 12))
    whole[:, :6] = np.eye(6)
    whole[:, 6:] = -np.eye(6)
    whole[3:, 6:9] = cross_matrix(target_from_source[:3, 3])
    whole = whole @ np.kron(np.eye(4), parent_from_target[:3, :3].T)
    return whole.T @ hessian @ whole, whole.T @ gradient


def nudged(pose: Matrix, change: Floats) -> Matrix:
    """A pose turned by change[:3] radians about its own place, then shifted by change[3:], both along the axes of its
    parent."""
    moved = pose.copy()
    moved[:3, :3] = rotation_from_vector(change[:3]) @ pose[:3, :3]
    moved[:3, 3] += change[3:]
    return moved


def change_between(before: Matrix, after: Matrix) -> Floats:
    """(6,) the change that nudges one pose to another."""
    turn = after[:3, :3] @ before[:3, :3].T
    return np.concatenate([rotation_vector(turn), after[:3, 3] - before[:3, 3]])


def rotation_vector(rotation: Floats) -> Floats:
    """(3,) radians about its own direction; the inverse of `rotation_from_vector`, for turns below half a circle."""
    axis = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0)))
    return axis if sine < 1e-9 else axis * (angle / sine)


def between(first: Matrix, second: Matrix) -> Matrix:
    """first_from_second, of two poses in one frame."""
    return invert(first) @ second
