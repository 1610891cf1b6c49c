"""The camera's pose from points whose places are known: a first guess among wrong matches, then the best fit."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import Matrix, rotation_from_vector
from semslam.slam.orb.features import Features, Floats, disparities

_TRIALS = 300
_CONFIDENCE = 0.999
_SAMPLE = 4
LOOSE = 2.0
"""The guess from four points is coarse: its inliers may lie this many times farther off."""
_ROUNDS, _STEPS = 4, 10
"""As in ORB-SLAM2: after each round the inliers are chosen anew."""
_DIVERGED = 1e6
"""Radians and metres of a step after which nothing is an inlier any more."""
_TINY = 1e-9
_NEAREST_M = 0.05


@dataclass(frozen=True)
class Sightings:
    """N points of the map as keypoints of one picture show them."""

    camera: Camera
    points: Floats
    """(N, 3) in the map frame."""
    measured: Floats
    """(N, 3) column, row and disparity; disparity NaN without depth."""
    sigmas_px: Floats
    """(N,)"""

    @staticmethod
    def of(features: Features, points: Floats) -> Sightings:
        """Keypoints with the points they show, one each."""
        measured = np.column_stack([features.pixels, features.disparities_px])
        return Sightings(features.camera, points, measured, features.sigmas_px)


@dataclass(frozen=True)
class Fit:
    """A pose, and which sightings agree with it."""

    camera_from_map: Matrix
    inliers: NDArray[np.bool_]
    """(N,)"""


def guess_pose(sightings: Sightings, inlier_px: float) -> Matrix | None:
    """camera_from_map by four points at a time and what most others agree with (PnP, RANSAC); None if nothing does.

    OpenCV starts its random samples from the same seed in every call.
    """
    if len(sightings.points) < _SAMPLE:
        return None
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            sightings.points,
            sightings.measured[:, :2],
            sightings.camera.matrix,
            np.zeros(0),
            iterationsCount=_TRIALS,
            reprojectionError=LOOSE * inlier_px,
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
    except cv2.error:  # no sample of points gives a pose
        return None
    pose = _rigid(np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel())
    return pose if found and np.isfinite(pose).all() else None


def fit_pose(sightings: Sightings, camera_from_map: Matrix, inlier_px: float, reach_px: float) -> Fit:
    """The pose near a guess with the least error in pixels and disparity, and its inliers.

    Errors count in sigmas of their keypoints. Sightings beyond `reach_px` of the guess have no say in the first round,
    those beyond `inlier_px` of a round's pose none in the next. In the first half of the rounds larger errors pull less
    than their square (Huber).
    """
    inliers = _sizes(_errors(sightings, camera_from_map)) <= reach_px
    for round_ in range(_ROUNDS):
        robust = 2 * round_ < _ROUNDS
        for _ in range(_STEPS):
            step = _step(sightings, camera_from_map, inliers, inlier_px if robust else np.inf)
            if not np.abs(step).max() < _DIVERGED:
                break
            camera_from_map = _rigid(step[:3], step[3:]) @ camera_from_map
            if np.abs(step).max() < _TINY:
                break
        inliers = _sizes(_errors(sightings, camera_from_map)) <= inlier_px
    return Fit(camera_from_map, inliers)


def _in_camera(sightings: Sightings, camera_from_map: Matrix) -> Floats:
    return np.asarray(sightings.points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3])


def _errors(sightings: Sightings, camera_from_map: Matrix) -> Floats:
    """(N, 3) measured minus expected column, row and disparity in sigmas; 0 without depth, huge behind the camera."""
    camera, points = sightings.camera, _in_camera(sightings, camera_from_map)
    depths = points[:, 2]
    safe = np.maximum(depths, _NEAREST_M)
    columns, rows = (camera.fx * points[:, 0] / safe + camera.cx), (camera.fy * points[:, 1] / safe + camera.cy)
    expected = np.column_stack([columns, rows, disparities(camera, safe)])
    errors = np.nan_to_num((sightings.measured - expected) / sightings.sigmas_px[:, None])
    errors[depths < _NEAREST_M] = 1e6
    return np.asarray(errors)


def _sizes(errors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(errors, axis=1))


def _step(sightings: Sightings, camera_from_map: Matrix, inliers: NDArray[np.bool_], huber_px: float) -> Floats:
    """(6,) Gauss-Newton step of the pose: turn, then shift, in the camera frame. Points behind the camera are out."""
    points = _in_camera(sightings, camera_from_map)
    errors = _errors(sightings, camera_from_map)
    huber = np.minimum(huber_px / np.maximum(_sizes(errors), _TINY), 1.0)
    weights = np.where(inliers & (points[:, 2] >= _NEAREST_M), huber, 0.0)
    slopes = _slopes(sightings, points)  # (N, 3, 6)
    weighted = slopes * weights[:, None, None]
    normal = np.einsum("nki,nkj->ij", weighted, slopes)
    normal += _TINY * (1.0 + np.trace(normal)) * np.eye(6)  # points on a line leave a turn open: it stays as it is
    return np.asarray(np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, errors)))


def _slopes(sightings: Sightings, points: Floats) -> Floats:
    """(N, 3, 6) how expected column, row and disparity, in sigmas, change as the pose turns and shifts."""
    camera, (x, y, z) = sightings.camera, points.T
    z = np.maximum(z, _NEAREST_M)
    by_point = np.zeros((len(points), 3, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    by_point[:, 2, 2] = -disparities(camera, z) / z
    by_point[np.isnan(sightings.measured[:, 2]), 2] = 0.0
    by_point /= sightings.sigmas_px[:, None, None]
    upper = np.zeros((len(points), 3, 3))
    upper[:, 0, 1], upper[:, 0, 2], upper[:, 1, 2] = z, -y, x
    by_turn = upper - upper.transpose(0, 2, 1)  # of turn x point
    return np.concatenate([by_point @ by_turn, by_point], axis=2)


def _rigid(turn: Floats, shift: Floats) -> Matrix:
    """A transform by a rotation vector and a shift."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation_from_vector(turn), shift
    return transform
