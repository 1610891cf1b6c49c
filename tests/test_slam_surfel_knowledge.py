"""What surfaces tell of a pose and what they do not: a wall holds a robot across it, and nothing holds it along."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, planar
from semslam.slam.estimator import VISUAL
from semslam.slam.surfel.alignment import DOUBT, Fit, Target, between, shows_wall
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.places import Edges, Keyframe, placed
from semslam.slam.surfel.prior import Grid
from semslam.slam.surfel.rejoining import rejoined
from semslam.slam.surfel.search import Search
from semslam.slam.surfel.smoothing import smooth
from semslam.slam.surfel.surfels import Surfels
from semslam.slam.verdict import OK, UNCERTAIN, verdict_of
from semslam.stages.settings import SurfelConfig
from tests.depth_world import SECOND, Room, make_drive, make_room, make_views, matrix, observed
from tests.slam_world import CELL_M, CLASSES, SIDE

CONFIG = SurfelConfig(surfels=500, neighbours=4, rounds=4)
GRID = Grid(tuple(CLASSES), CELL_M, SIDE)
FLOOR_AND_WALL = Room(np.array([-50.0, -50.0, -0.05]), np.array([3.1, 50.0, 2.5]), np.zeros((0, 2, 3)))
"""One wall, three metres before the robot, as far as one sees; not on the edges of voxels, where rounding decides."""
BARE_FLOOR = Room(np.array([-50.0, -50.0, 0.0]), np.array([50.0, 50.0, 50.0]), np.zeros((0, 2, 3)))


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
    """Scattered normals seem to hold a robot to centimetres there; most of that is told to be noise. Across the wall
    nothing is lost."""
    fit = of_wall(math.radians(tilt_deg))
    seeming, known = (sigmas(told(np.zeros(3))[0]) for told in (fit.equations, fit.information))
    known /= math.sqrt(DOUBT)
    assert seeming[1] < 0.08
    assert known[1] > 3 * seeming[1]
    assert known[0] == pytest.approx(seeming[0], rel=0.02)


def test_what_surfaces_do_tell_stays() -> None:
    """In a furnished room the step that both tell is the same, and hardly any of it is called noise."""
    room = make_room()
    one, other = (Keyframe.of(room.view(matrix(SE2(x, 0.0, 0.0))), CONFIG) for x in (0.0, 0.3))
    pose = matrix(SE2(0.31, -0.01, 0.01))
    fit = Target(one.surfels).fit(other.surfels.moved(pose), 0.1)
    (seeming, pull), (known, less) = fit.equations(pose[:3, 3]), fit.information(pose[:3, 3])
    seeming = seeming / DOUBT
    np.testing.assert_allclose(np.linalg.solve(known, less), np.linalg.solve(seeming, pull / DOUBT), atol=1e-6)
    before, after = (np.linalg.inv(hessian)[[2, 3, 4], [2, 3, 4]] for hessian in (seeming, known))
    assert (after >= before * (1 - 1e-9)).all()
    assert (after < 1.5 * before).all()


@pytest.mark.parametrize("surfels", [500, 1500])
def test_a_floor_alone_is_no_wall(surfels: int) -> None:
    """However many surfels there are, and whatever their noise; a wall alone is one."""
    config = SurfelConfig(surfels=surfels)
    for room, pose, walls in ((BARE_FLOOR, SE2(0.2, 0.0, 0.0), False), (FLOOR_AND_WALL, SE2(0.0, 0.2, 0.0), True)):
        noise = np.random.default_rng(3)
        one, other = (Keyframe.of(room.view(matrix(there), noise), config) for there in (SE2(0.0, 0.0, 0.0), pose))
        fit = Target(one.surfels).fit(other.surfels.moved(matrix(pose)), 0.1)
        assert len(fit) > 200
        assert shows_wall(fit.information(matrix(pose)[:3, 3])[0]) == walls


@pytest.mark.parametrize("motion", [True, False], ids=["with motion", "without motion"])
def test_along_a_wall_a_track_is_as_sure_as_its_motion(motion: bool) -> None:
    """And says so: no longer ok once motion has added up, though every picture fits the one before; without odometry
    from the first step on."""
    drive = [SE2(0.0, 0.15 * number, 0.0) for number in range(30)]
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in observed(make_views(FLOOR_AND_WALL, drive, noise_m=0.03)):
        estimator.step(step if motion else replace(step, motion=None))
    walked = [planar(place.pose) for place in estimator._track.places]
    found = estimator.finish()
    assert [one.source for one in found[1:]] == [VISUAL] * 29
    errors = [np.sqrt(np.diag(np.array(one.covariance).reshape(3, 3))) for one in found]
    assert errors[-1][0] < 0.02
    assert errors[-1][1] > 0.08
    for one, true, error in zip(found[1:], drive[1:], errors[1:], strict=True):
        assert one.map_from_robot is not None
        away = true.between(one.map_from_robot)
        assert abs(away.x_m) < 0.03
        assert abs(away.y_m) < 3 * error[1] if motion else error[1] > 0.1
    if motion:
        assert max(abs(true.between(pose).y_m) for true, pose in zip(drive, walked, strict=True)) < 0.4
    assert verdict_of(found[1], 0.1, 0.035) == (OK if motion else UNCERTAIN)
    assert verdict_of(found[-1], 0.1, 0.035) == UNCERTAIN


def test_where_surfaces_are_blind_edges_count() -> None:
    """The walk chose by them between places where surfaces lie equally well: alignment gives that up for motion as far
    as that is surer."""
    views = [FLOOR_AND_WALL.view(matrix(pose)) for pose in (SE2(0.0, 0.0, 0.0), SE2(0.0, 0.2, 0.0))]
    first, second = (Keyframe.of(view, CONFIG) for view in views)

    def aligned(motion: SE2 | None, edges: Edges | None) -> float:
        start = matrix(SE2(0.02, 0.3, 0.0))
        places = [
            placed(first, np.eye(4), 0.0, None, linked=True),
            placed(None, start, 1.0, SE2(0.02, 0.3, 0.0), linked=True),  # saw nothing: edges are not from here
            replace(placed(second, start, 1.0, motion and SE2(0.0, 0.0, 0.0), linked=True), edges=edges),
        ]
        poses = [place.pose for place in smooth(places, np.zeros(3), CONFIG).places]
        found = planar(between(poses[0], poses[2]))
        assert abs(found.x_m) < 0.03
        return found.y_m

    there = Edges(0, SE2(0.0, 0.2, 0.0), np.diag([0.0, 0.05**-2]))
    assert aligned(None, there) == pytest.approx(0.2, abs=0.03)
    assert aligned(SE2(0.0, 0.3, 0.0), None) == pytest.approx(0.3, abs=0.01)
    assert 0.22 < aligned(SE2(0.0, 0.3, 0.0), there) < 0.29


def test_edges_tell_where_a_wall_does_not() -> None:
    """A board before the wall faces the same way as the wall, but its outline is seen; a bare wall has none."""
    board = np.array([[[2.5, -0.3, 0.0], [2.6, 0.3, 2.0]]])
    told = []
    for room in (FLOOR_AND_WALL, replace(FLOOR_AND_WALL, boxes=board)):
        one, other = (Keyframe.of(room.view(matrix(SE2(0.0, y, 0.0))), CONFIG) for y in (0.0, 0.1))
        start = matrix(SE2(0.0, 0.1, 0.0))
        search = Search(other, [(one, np.eye(4))], [start], np.diag([0.05**2, 0.05**2, 0.03**2]), CONFIG)
        found = search.result()
        assert found is not None
        told.append(float(np.trace(found.edge_information)))
    assert told[0] < 1.0
    assert told[1] > 50.0


def test_edges_are_put_away_and_taken_up() -> None:
    """With the keyframe that they were seen from."""
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in observed(make_views(make_room(), make_drive(4), noise_m=0.02)):
        estimator.step(step)
    again = SurfelEstimator(CONFIG, GRID)
    again.restore([estimator.part()])
    told = [place.edges for place in estimator._track.places[1:]]
    assert all(edges is not None and edges.information.any() for edges in told)
    for edges, place in zip(told, again._track.places[1:], strict=True):
        assert edges is not None
        assert place.edges is not None
        assert (place.edges.index, place.edges.other_from_robot) == (edges.index, edges.other_from_robot)
        np.testing.assert_array_equal(place.edges.information, edges.information)


def test_one_who_is_lost_over_bare_floor_stays_lost() -> None:
    """Floors fit each other everywhere: what motion leaves open grows, and what is seen afterwards is another group."""
    boards = np.array([[[2.5, y, 0.0], [2.6, y + 0.5, 2.0]] for y in (-3.0, -1.2, 0.4, 2.2, 4.0, 6.5)])
    room = replace(FLOOR_AND_WALL, boxes=boards)
    back = [SE2(0.0, 0.2 * number, math.pi) for number in range(25)]
    drive = [*(SE2(0.0, 0.0, 0.0) for _ in range(2)), *back, SE2(0.0, 4.8, 0.0), SE2(0.0, 5.0, 0.0)]
    steps = observed(make_views(room, drive))
    estimator = SurfelEstimator(CONFIG, GRID)
    for number, step in enumerate(steps):
        estimator.step(replace(step, motion=None) if 2 <= number < len(steps) - 1 else step)
    places = estimator._track.places
    assert not any(place.linked for place in places[3:26])
    assert not places[-1].linked or places[-1].group > 0 or abs(places[-1].pose[1, 3] - 5.0) < 0.3


def test_what_motion_leads_to_moves_with_a_part_that_was_found() -> None:
    """A robot that was carried is found again by its map, and with it keyframes that saw nothing of that: before the
    second alignment, for which they may lie too far away."""
    before = make_drive(12)
    away = [SE2(1.2, -0.8, 2.4) @ pose for pose in make_drive(12)]
    first, later = (observed(make_views(make_room(), drive)) for drive in (before, away))
    later = [replace(step, frame=12 + step.frame, stamp_nanos=step.stamp_nanos + 60 * SECOND) for step in later]
    later[0] = replace(later[0], motion=SE2(0.0, 0.0, 0.0))  # what the wheels tell of it
    later[9:] = [replace(step, view=None, observation=None) for step in later[9:]]
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in (*first, *later):
        estimator.step(step)
    track = estimator._track
    smoothed = smooth(track.places, track.prior.bias, CONFIG)
    assert max(map(len, smoothed.parts[1:])) >= 5
    places = rejoined(smoothed, estimator._seen, GRID)
    assert places is not None
    for one, true in zip(places[12:], away, strict=True):
        apart = true.between(planar(one.pose))
        assert math.hypot(apart.x_m, apart.y_m) < 0.1
        assert abs(apart.heading_rad) < 0.05
        assert one.group == places[0].group


def test_nothing_is_known_of_nothing() -> None:
    """No matches: no equations, and no crash."""
    hessian, gradient = Fit.nothing().information(np.zeros(3))
    assert np.abs(hessian).max() < 1e-12
    assert not gradient.any()
