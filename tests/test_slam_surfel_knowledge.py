"""What surfaces tell of a pose and what they do not: a wall holds a robot across it, and nothing holds it along."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, planar
from semslam.slam.estimator import INERTIAL, VISUAL
from semslam.slam.surfel.alignment import Fit, Target, between
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.places import Keyframe, placed
from semslam.slam.surfel.prior import Grid
from semslam.slam.surfel.smoothing import smooth
from semslam.slam.surfel.surfels import Surfels
from semslam.slam.verdict import OK, UNCERTAIN, verdict_of
from semslam.stages.settings import SurfelConfig
from tests.depth_world import SECOND, Room, make_drive, make_room, make_views, matrix, observed
from tests.slam_world import CELL_M, CLASSES, SIDE

CONFIG = SurfelConfig(surfels=500, neighbours=4, rounds=4)
GRID = Grid(tuple(CLASSES), CELL_M, SIDE)
FLOOR_AND_WALL = Room(np.array([-50.0, -50.0, 0.0]), np.array([3.0, 50.0, 2.5]), np.zeros((0, 2, 3)))
"""One wall, three metres before the robot, as far as one sees."""


def wall(seed: int, tilt_rad: float) -> Surfels:
    """Two metres before the origin, four wide, its normals scattered."""
    random = np.random.default_rng(seed)
    points = np.stack([np.full(400, 2.0), *random.uniform(((-2.0,), (0.0,)), ((2.0,), (2.0,)), (2, 400))], 1)
    normals = np.array([-1.0, 0.0, 0.0]) + np.concatenate([np.zeros((400, 1)), random.normal(0, tilt_rad, (400, 2))], 1)
    points[:, 0] += random.normal(0, 0.005, 400)
    return Surfels(points, normals / np.linalg.norm(normals, axis=1)[:, None], np.full(400, 0.005))


def sigmas(hessian: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations of a shift along x and y, if nothing turns."""
    return np.asarray(1.0 / np.sqrt(np.maximum(np.diag(hessian)[3:5], 1e-12)))


def of_wall(tilt_rad: float) -> Fit:
    """One wall laid on itself as it was seen another time."""
    return Target(wall(1, tilt_rad)).fit(wall(2, tilt_rad), 0.2)


@pytest.mark.parametrize("tilt_deg", [1.0, 3.0])
def test_a_wall_tells_nothing_of_the_way_along_it(tilt_deg: float) -> None:
    """Scattered normals seem to hold a robot to centimetres there; five sixths of that, or more, are told to be noise.
    Across the wall nothing is lost."""
    fit = of_wall(math.radians(tilt_deg))
    seeming, known = (sigmas(told(np.zeros(3))[0]) for told in (fit.equations, fit.information))
    assert seeming[1] < 0.08
    assert known[1] > 2.4 * seeming[1]
    assert known[0] == pytest.approx(seeming[0], rel=0.02)


def test_what_surfaces_do_tell_stays() -> None:
    """In a furnished room the step that both tell is the same, and hardly any of it is called noise."""
    room = make_room()
    one, other = (Keyframe.of(room.view(matrix(SE2(x, 0.0, 0.0))), CONFIG) for x in (0.0, 0.3))
    pose = matrix(SE2(0.31, -0.01, 0.01))
    fit = Target(one.surfels).fit(other.surfels.moved(pose), 0.1)
    (seeming, pull), (known, less) = fit.equations(pose[:3, 3]), fit.information(pose[:3, 3])
    np.testing.assert_allclose(np.linalg.solve(known, less), np.linalg.solve(seeming, pull), atol=1e-6)
    before, after = (np.linalg.inv(hessian)[[2, 3, 4], [2, 3, 4]] for hessian in (seeming, known))
    assert (after >= before * (1 - 1e-9)).all()
    assert (after < 1.5 * before).all()


def test_along_a_wall_a_track_is_as_sure_as_its_motion() -> None:
    """And says so: no longer ok once motion has added up, though every picture fits the one before."""
    drive = [SE2(0.0, 0.15 * number, 0.0) for number in range(16)]
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in observed(make_views(FLOOR_AND_WALL, drive, noise_m=0.03)):
        estimator.step(step)
    found = estimator.finish()
    assert [one.source for one in found[1:]] == [VISUAL] * 15
    across, along = (
        np.array([math.sqrt(np.array(one.covariance).reshape(3, 3)[i, i]) for one in found]) for i in (0, 1)
    )
    assert across[-1] < 0.02
    assert along[-1] > 0.04
    for one, true in zip(found, drive, strict=True):
        assert one.map_from_robot is not None
        away = true.between(one.map_from_robot)
        assert abs(away.x_m) < 0.02
        assert abs(away.y_m) < 0.2
    assert (verdict_of(found[1], 0.1, 0.035), verdict_of(found[-1], 0.1, 0.035)) == (OK, UNCERTAIN)


def test_where_surfaces_are_blind_a_step_of_the_walk_counts() -> None:
    """The search chose it by what surfaces do not show: alignment does not give it up for nothing, but for motion that
    is surer."""
    views = [FLOOR_AND_WALL.view(matrix(pose)) for pose in (SE2(0.0, 0.0, 0.0), SE2(0.0, 0.2, 0.0))]
    first, second = (Keyframe.of(view, CONFIG) for view in views)

    def aligned(motion: SE2 | None, step: SE2 | None) -> float:
        start = matrix(SE2(0.02, 0.3, 0.0))
        places = [
            placed(first, np.eye(4), 0.0, None, linked=True),
            replace(placed(second, start, 1.0, motion, linked=True), step=step),
        ]
        poses = [place.pose for place in smooth(places, np.zeros(3), CONFIG).places]
        step_found = planar(between(*poses))
        assert abs(step_found.x_m) < 0.01
        return step_found.y_m

    there = SE2(0.0, 0.2, 0.0)
    assert aligned(None, there) == pytest.approx(0.2, abs=0.01)
    assert aligned(SE2(0.0, 0.3, 0.0), None) == pytest.approx(0.3, abs=0.01)
    assert 0.22 < aligned(SE2(0.0, 0.3, 0.0), there) < 0.29


def test_what_motion_leads_to_moves_with_a_part_that_was_found() -> None:
    """A robot that was carried is found again by its map, and with it keyframes that saw nothing."""
    before = make_drive(12)
    away = [SE2(1.2, -0.8, 2.4) @ pose for pose in make_drive(10)]
    first, later = (observed(make_views(make_room(), drive)) for drive in (before, away))
    later = [replace(step, frame=12 + step.frame, stamp_nanos=step.stamp_nanos + 60 * SECOND) for step in later]
    later[0] = replace(later[0], motion=SE2(0.0, 0.0, 0.0))  # what the wheels tell of it
    later[8] = replace(later[8], view=None, observation=None)
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in (*first, *later):
        estimator.step(step)
    found = estimator.finish()
    blind, true = found[20], away[8]
    assert blind.source == INERTIAL
    assert blind.map_from_robot is not None
    apart = true.between(blind.map_from_robot)
    assert math.hypot(apart.x_m, apart.y_m) < 0.1
    assert abs(apart.heading_rad) < 0.05


def test_nothing_is_known_of_nothing() -> None:
    """No matches: no equations, and no crash."""
    hessian, gradient = Fit.nothing().knowledge(np.zeros(3))
    assert np.abs(hessian).max() < 1e-12
    assert not gradient.any()
