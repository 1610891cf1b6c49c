"""Logs that go on and on in one place, and comparisons that need not be made again."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from semslam.geometry.frames import SE2
from semslam.slam.estimator import VISUAL, Step
from semslam.slam.surfel import comparisons
from semslam.slam.surfel.alignment import nudged
from semslam.slam.surfel.comparisons import Comparisons
from semslam.slam.surfel.coverage import Coverage
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.places import Keyframe, placed
from semslam.slam.surfel.prior import Grid
from semslam.slam.surfel.search import Found
from semslam.slam.surfel.sight import Agreement
from semslam.slam.surfel.surfels import Surfels, surfels_of
from semslam.slam.surfel.uncertainty import along, grown
from semslam.stages.settings import SurfelConfig
from tests.depth_world import SECOND, make_drive, make_room, make_views, matrix, observed
from tests.slam_world import CELL_M, CLASSES, SIDE

CONFIG = SurfelConfig(surfels=500, neighbours=4, rounds=3)
GRID = Grid(tuple(CLASSES), CELL_M, SIDE)
LAP = 8


@lru_cache(maxsize=1)
def laps() -> tuple[list[Step], list[SE2]]:
    """Six times round the same way, there and back."""
    way = make_drive(LAP)
    drive = [pose for _ in range(3) for pose in (*way, *reversed(way))]
    return observed(make_views(make_room(), drive, noise_m=0.01, noise_rad=0.01)), drive


@lru_cache(maxsize=1)
def long_track() -> SurfelEstimator:
    """All of it, walked."""
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in laps()[0]:
        estimator.step(step)
    return estimator


def test_going_round_again_keeps_no_more_pictures() -> None:
    """What is kept grows with what there is to see, and every keyframe has its pose to the centimetre all the same."""
    estimator, (steps, drive) = long_track(), laps()
    found = estimator.finish()
    frames = [row["frame"][0] for row in estimator.rows()]
    assert len([frame for frame in frames if frame >= 4 * LAP]) < LAP
    assert len(frames) < 0.7 * len(steps)
    for pose, true in zip(found, drive, strict=True):
        assert pose.map_from_robot is not None
        away = true.between(pose.map_from_robot)
        assert abs(away.x_m) + abs(away.y_m) < 0.04
    assert {pose.source for pose in found[1:]} == {VISUAL}
    assert all(pose.covariance is not None for pose in found)


def test_a_log_that_was_cut_keeps_the_same_pictures() -> None:
    """Taken up again, the same keyframes are left out, and tied to the same others."""
    steps, estimator = laps()[0], long_track()
    again, parts = SurfelEstimator(CONFIG, GRID), list[bytes]()
    for start, stop in pairwise((0, 3 * LAP, 5 * LAP, len(steps))):
        for step in steps[start:stop]:
            again.step(step)
        parts.append(again.part())
        again = SurfelEstimator(CONFIG, GRID)
        again.restore(parts)
    assert again.finish() == estimator.finish()
    assert [row["frame"] for row in again.rows()] == [row["frame"] for row in estimator.rows()]


def test_of_ten_keyframes_a_second_a_few_are_kept() -> None:
    """Many in a row would be aligned with each other alone; all have poses, and those kept are half a second apart."""
    step = SE2(0.03, 0.0, 0.04)
    drive = [SE2(0.0, 0.0, 0.0)]
    for _ in range(19):
        drive.append(drive[-1] @ step)
    steps = [
        replace(one, stamp_nanos=one.stamp_nanos // 10)
        for one in observed(make_views(make_room(), drive, noise_m=0.003, noise_rad=0.003))
    ]
    estimator = SurfelEstimator(CONFIG, GRID)
    for one in steps:
        estimator.step(one)
    found = estimator.finish()
    assert len(list(estimator.rows())) <= 6
    for pose, true in zip(found, drive, strict=True):
        assert pose.map_from_robot is not None
        away = true.between(pose.map_from_robot)
        assert abs(away.x_m) + abs(away.y_m) < 0.03


def test_what_is_left_out_is_tied_to_one_that_shows_the_same() -> None:
    """Not to whatever was kept last: that may be in another room by now."""
    places = long_track()._track.places
    steps = laps()[0]
    left_out = [(number, place) for number, place in enumerate(places) if place.anchor]
    assert left_out
    for number, place in left_out:
        assert place.anchor is not None
        known = places[place.anchor.index]
        assert known.group == place.group
        view = steps[number].view
        assert view is not None
        there = placed(Keyframe.of(view, CONFIG), place.pose, 1.0, None, linked=True)
        assert len(np.intersect1d(there.voxels, known.voxels)) > len(there.voxels) / 3


def test_a_robot_that_is_parked_where_all_is_known_was_not_carried() -> None:
    """It sees what it saw before, if not from the very keyframe before."""
    steps = list(laps()[0][: 5 * LAP])
    last = steps[-1]
    still = SE2(0.0, 0.0, 0.0)
    parked = replace(last, frame=last.frame + 1, stamp_nanos=last.stamp_nanos + 600 * SECOND, motion=still)
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in (*steps, parked):
        estimator.step(step)
    assert estimator._track.places[-2].anchor is not None
    assert estimator._track.places[-1].group == estimator._track.places[0].group


def test_settled_pairs_are_not_compared_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a small move the equations are those of a new comparison, nearly; after a larger one it is made anew."""
    (first, second), room = make_drive(2), make_room()
    views = [room.view(matrix(pose)) for pose in (first, second)]
    places = [
        placed(Keyframe.of(view, CONFIG), matrix(pose), 1.0, None, linked=True)
        for view, pose in zip(views, (first, second), strict=True)
    ]
    known = Comparisons()
    before = known.of(places, 0, 1, 0.1)
    assert before.ties
    made: list[float] = []
    laid = comparisons._laid
    monkeypatch.setattr(comparisons, "_laid", lambda *args: made.append(args[-1]) or laid(*args))
    moved = [places[0], placed(places[1].keyframe, nudged(places[1].pose, np.full(6, 4e-4)), 1.0, None, linked=True)]
    settled, anew = known.of(moved, 0, 1, 0.1), Comparisons().of(moved, 0, 1, 0.1)
    assert len(made) == 2  # both of `anew`
    assert settled.back is not None
    assert anew.back is not None
    assert before.back is not None
    change, wanted = (one.gradient - before.back.gradient for one in (settled.back, anew.back))
    assert np.linalg.norm(change - wanted) < 0.35 * np.linalg.norm(wanted)
    far = [places[0], placed(places[1].keyframe, nudged(places[1].pose, np.full(6, 2e-3)), 1.0, None, linked=True)]
    known.of(far, 0, 1, 0.1)
    assert len(made) == 4


def test_a_wall_that_slides_is_no_better_for_showing_more() -> None:
    """Of two poses where nothing disagrees the likelier one by motion stands; one that is contradicted does not."""
    little, much = Agreement(50.0, 100), Agreement(250.0, 500)
    contradicted, worse = Agreement(100.0, 100, strangers=10), Agreement(120.0, 100)

    def found(seen: Agreement) -> Found:
        return Found(np.eye(4), np.eye(6), 0, np.zeros((2, 2)), sure=True, seen=seen)

    assert not found(much).better_than(found(little))
    assert found(much).better_than(found(contradicted))
    assert found(much).better_than(found(worse))


def test_a_wrong_heading_leads_astray() -> None:
    """Uncertainty of the heading becomes one of the place across the way, whichever way the robot faces."""
    before = np.diag([0.0, 0.0, 0.01])
    east, north = SE2(0.0, 0.0, 0.0), SE2(0.0, 0.0, np.pi / 2)
    for start, across in ((east, 1), (north, 0)):
        after = start @ SE2(3.0, 0.0, 0.0)
        step = np.diag([0.04, 0.0, 0.0])  # along the way
        found = grown(before, start.matrix, after.matrix, step)
        assert found[across, across] == pytest.approx(9 * 0.01)
        assert found[1 - across, 1 - across] == pytest.approx(0.04)
    turned = along(np.diag([1.0, 4.0, 9.0]), north.matrix)
    np.testing.assert_allclose(np.diag(turned), [4.0, 1.0, 9.0], atol=1e-12)


def test_a_picture_without_surfaces_is_shown_by_nothing() -> None:
    """Nor is it one that shows nothing new: it has nothing to show. Others are left out when shown three times."""
    view = make_room().view(matrix(SE2(0.0, 0.0, 0.0)))
    surfels, coverage = surfels_of(view, 500, 6.0), Coverage()
    nothing = Surfels(surfels.points[:0], surfels.normals[:0], surfels.sigma_m[:0])
    assert not coverage.holds(nothing, np.eye(4))
    for _ in range(3):
        assert not coverage.holds(surfels, np.eye(4))
        coverage.add(surfels, np.eye(4))
    assert coverage.holds(surfels, np.eye(4))
    assert not coverage.holds(surfels, matrix(SE2(5.0, 0.0, 0.0)))
    assert not coverage.holds(nothing, np.eye(4))
