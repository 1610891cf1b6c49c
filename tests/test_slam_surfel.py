"""Depth aligned with depth: surfels lie on surfaces, pictures agree from true poses only, and tracks are right."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import FLU_FROM_OPTICAL, SE2
from semslam.slam.checkpoint import unpack
from semslam.slam.estimator import PoseEstimate, Step, View
from semslam.slam.surfel.alignment import Target, change_between, nudged
from semslam.slam.surfel.estimator import SurfelEstimator
from semslam.slam.surfel.motion_prior import MotionPrior
from semslam.slam.surfel.places import Keyframe
from semslam.slam.surfel.prior import Grid, read_prior
from semslam.slam.surfel.registration import FOUND, LOST, place_in
from semslam.slam.surfel.semantic_field import ClassMap, candidates
from semslam.slam.surfel.sight import Sight, agreement
from semslam.slam.surfel.surfels import surfels_of
from semslam.slam.verdict import OK, UNCERTAIN, verdict_of
from semslam.stages import localize
from semslam.stages.contract import FinishedShard
from semslam.stages.settings import LocalizeConfig, SurfelConfig
from semslam.tables.parquet import TableFiles, TableFileWriter, write_table
from semslam.tables.pictures import encode_colour, encode_depth
from semslam.tables.spec import CELLS, FRAMES, PLACES, POSES, SNAPSHOTS
from tests.depth_world import (
    ROBOT_FROM_CAMERA,
    SECOND,
    Room,
    make_drive,
    make_room,
    make_views,
    matrix,
    observed,
    symmetric,
)
from tests.slam_world import CELL_M, CLASSES, SIDE, MemoryContext, make_walk, make_world, write_inputs

CONFIG = SurfelConfig(surfels=600)
GRID = Grid(CLASSES, CELL_M, SIDE)
BIAS = SE2(0.02, -0.02, 0.01)


def walked(steps: Iterable[Step], config: SurfelConfig = CONFIG) -> SurfelEstimator:
    estimator = SurfelEstimator(config, GRID)
    for step in steps:
        estimator.step(step)
    return estimator


def track(steps: Iterable[Step]) -> list[PoseEstimate]:
    return walked(steps).finish()


def errors(found: list[PoseEstimate], drive: list[SE2]) -> tuple[float, float]:
    """The worst position error in metres and heading error in degrees, in the frame of the first pose."""
    apart = []
    for estimate, true in zip(found, drive, strict=True):
        assert estimate.map_from_robot is not None
        apart.append(drive[0].between(true).between(estimate.map_from_robot))
    return max(math.hypot(one.x_m, one.y_m) for one in apart), max(math.degrees(abs(one.heading_rad)) for one in apart)


def reckoned(steps: list[Step]) -> list[PoseEstimate]:
    poses = [SE2(0.0, 0.0, 0.0)]
    for step in steps[1:]:
        assert step.motion is not None
        poses.append(poses[-1] @ step.motion)
    return [PoseEstimate(pose, "inertial") for pose in poses]


# --- surfels ----------------------------------------------------------------------------------------------------------


def plane_view(normal: tuple[float, float, float], distance_m: float, noise: float) -> View:
    """A plane n . X = d of the camera frame, seen with noise of inverse depth."""
    column, row = np.meshgrid(np.arange(160), np.arange(120))
    rays = np.stack([(column - 79.5) / 80.0, (row - 59.5) / 80.0, np.ones_like(column)], -1)
    inverse = rays @ np.array(normal) / distance_m
    inverse = inverse + noise * np.random.default_rng(0).standard_normal(inverse.shape)
    depth = np.where(inverse > 0.05, 1 / np.maximum(inverse, 0.05), 0.0).astype(np.float32)
    return View(np.zeros((120, 160, 3), np.uint8), depth, 80.0, 80.0, 79.5, 59.5, FLU_FROM_OPTICAL)


@pytest.mark.parametrize("turn_deg", [0, 30, 60])
def test_surfels_lie_on_the_plane(turn_deg: float) -> None:
    """At their distance within what they promise, facing the camera, all with the plane's direction."""
    angle = math.radians(turn_deg)
    normal = (math.sin(angle), 0.0, math.cos(angle))
    found = surfels_of(plane_view(normal, 2.0, 0.002), 1000, 6.0)
    assert len(found) > 900
    toward = FLU_FROM_OPTICAL[:3, :3] @ np.array(normal)
    off = np.abs(found.points @ toward - 2.0)
    assert (off < 4 * found.sigma_m).all()
    assert off.mean() < 0.01
    assert (found.normals @ -toward > math.cos(math.radians(20))).all()


def test_edges_and_holes_make_no_surfels() -> None:
    """A step between two planes is no slanted wall, and missing depth is nothing."""
    view = plane_view((0.0, 0.0, 1.0), 2.0, 0.0)
    view.depth_m[:, 80:] = 4.0
    view.depth_m[:40] = 0.0
    found = surfels_of(view, 2000, 6.0)
    depth = found.points[:, 0]  # forward
    assert (np.minimum(np.abs(depth - 2.0), np.abs(depth - 4.0)) < 0.01).all()
    assert len(surfels_of(replace(view, depth_m=np.zeros_like(view.depth_m)), 100, 6.0)) == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 2), (5, 7)])
def test_a_tiny_picture_is_no_trouble(shape: tuple[int, int]) -> None:
    """It shows next to nothing."""
    view = replace(plane_view((0.0, 0.0, 1.0), 2.0, 0.0), depth_m=np.full(shape, 2.0, np.float32))
    assert len(Keyframe.of(view, CONFIG).surfels) <= shape[0] * shape[1]
    assert agreement(Sight.of(view, 6.0), Sight.of(view, 6.0), np.eye(4)).mean in (0.0, 3.0)


def test_rare_directions_are_kept() -> None:
    """Of a floor and a few small faces the faces lose least."""
    view = make_room().view(np.eye(4))
    few, many = surfels_of(view, 200, 8.0), surfels_of(view, 5000, 8.0)
    assert len(few) <= 200 < len(many)

    def share_of_floor(normals: NDArray[np.float64]) -> float:
        return float((normals[:, 2] > 0.9).mean())

    assert share_of_floor(few.normals) < share_of_floor(many.normals)


# --- agreement and alignment ------------------------------------------------------------------------------------------


def test_pictures_agree_from_the_true_pose() -> None:
    """Better than from any pose a little off, although walls and floor slide along themselves."""
    room = make_room()
    first, second = matrix(SE2(0.0, 0.0, 0.0)), matrix(SE2(0.4, 0.1, 0.3))
    one, other = (Sight.of(room.view(pose), 8.0) for pose in (first, second))
    best = agreement(one, other, second)
    assert best.mean < 0.5
    assert best.looked_up > 500
    for off in (SE2(0.1, 0.0, 0.0), SE2(0.0, 0.1, 0.0), SE2(0.0, -0.1, 0.0), SE2(0.0, 0.0, 0.05)):
        assert agreement(one, other, second @ matrix(off)).mean > best.mean + 0.1
    nowhere = agreement(one, other, matrix(SE2(-50.0, 0.0, math.pi / 2)))
    assert (nowhere.looked_up, nowhere.mean) == (0, 3.0)


def test_alignment_finds_a_small_change_back() -> None:
    """Gauss-Newton on the equations of a fit."""
    room = make_room()
    one, other = (Keyframe.of(room.view(matrix(SE2(x, 0.0, 0.0))), CONFIG) for x in (0.0, 0.3))
    true, pose = matrix(SE2(0.3, 0.0, 0.0)), matrix(SE2(0.34, -0.03, 0.03))
    target = Target(one.surfels)
    for reach in (0.3, 0.2, 0.15, 0.1, 0.1, 0.1):
        hessian, gradient = target.fit(other.surfels.moved(pose), reach).equations(pose[:3, 3])
        pose = nudged(pose, -np.linalg.solve(hessian, gradient))
    change = change_between(true, pose)
    assert np.abs(change[:3]).max() < 0.004
    assert np.abs(change[3:]).max() < 0.012


def test_a_change_and_back() -> None:
    """`change_between` undoes `nudged`."""
    pose = matrix(SE2(1.0, 2.0, 0.5))
    change = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    np.testing.assert_allclose(change_between(pose, nudged(pose, change)), change, atol=1e-12)


def test_nothing_fits_nothing() -> None:
    """No surfels on either side: no matches, and no crash."""
    some = Keyframe.of(make_room().view(np.eye(4)), CONFIG).surfels
    none = some.every(1).moved(np.eye(4))
    empty = type(some)(none.points[:0], none.normals[:0], none.sigma_m[:0])
    assert len(Target(empty).fit(some, 0.1)) == len(Target(some).fit(empty, 0.1)) == 0


# --- motion -----------------------------------------------------------------------------------------------------------


def test_steady_errors_of_motion_are_learned() -> None:
    """From steps whose true motion was seen; the next step is then expected right, and more surely."""
    prior = MotionPrior(CONFIG)
    before = prior.expect(SE2(0.2, 0.0, 0.1), 1.0)
    for _ in range(30):
        prior.learn(SE2(0.22, -0.02, 0.11), 1.0, SE2(0.2, 0.0, 0.1), np.diag([1e-5] * 3))
    after = prior.expect(SE2(0.22, -0.02, 0.11), 1.0)
    assert (after.motion.x_m, after.motion.y_m, after.motion.heading_rad) == pytest.approx((0.2, 0.0, 0.1), abs=2e-3)
    assert np.trace(after.covariance) < np.trace(before.covariance)
    assert np.trace(prior.expect(None, 1.0).covariance) > 10 * np.trace(before.covariance)


# --- tracks -----------------------------------------------------------------------------------------------------------


def test_a_drive_is_found_to_the_centimetre() -> None:
    """Where motion alone errs by decimetres and many degrees; its steady error is no obstacle."""
    drive = make_drive()
    steps = make_views(make_room(), drive, bias=BIAS, noise_m=0.03, noise_rad=0.05)
    assert errors(reckoned(steps), drive)[0] > 0.15
    assert errors(reckoned(steps), drive)[1] > 5.0
    found = track(steps)
    worst_m, worst_deg = errors(found, drive)
    assert worst_m < 0.02
    assert worst_deg < 0.5
    assert [one.source for one in found] == ["start", *["visual"] * (len(drive) - 1)]
    assert found[0].map_from_robot == SE2(0.0, 0.0, 0.0)


def test_smoothing_makes_it_better() -> None:
    """All keyframes together know more than each did when it came."""
    drive = make_drive(18)
    estimator = walked(make_views(make_room(3), drive, bias=BIAS, noise_m=0.03, noise_rad=0.03))
    plain = SurfelEstimator(replace(CONFIG, rounds=0), GRID)
    plain.restore([estimator.part()])
    before, smoothed = (errors(one.finish(), drive)[0] for one in (plain, estimator))
    assert smoothed < before


@pytest.mark.parametrize("seed", [0, 1])
def test_without_motion_depth_will_do(seed: int) -> None:
    """A robot that does not tell its motion is found all the same, if it moves little between keyframes."""
    drive = [SE2(0.0, 0.0, 0.0)]
    for _ in range(5):
        drive.append(drive[-1] @ SE2(0.15, 0.0, 0.25))
    steps = [replace(step, motion=None) for step in make_views(make_room(seed), drive)]
    worst_m, worst_deg = errors(track(steps), drive)
    assert worst_m < 0.03
    assert worst_deg < 1.0


@pytest.mark.parametrize("at", [3, 8])
@pytest.mark.parametrize("seconds", [60, 600])
def test_a_parked_robot_is_found_where_it_was(seconds: int, at: int) -> None:
    """Through a pause the odometry of a robot with a steady error rests; much or little may come after it."""
    drive = make_drive(12)
    steps = observed(make_views(make_room(), drive, bias=BIAS, noise_m=0.01))
    for index in range(at, len(steps)):
        steps[index] = replace(steps[index], stamp_nanos=steps[index].stamp_nanos + seconds * SECOND)
    parked = replace(steps[at], view=steps[at - 1].view, motion=SE2(0.001, 0.0, 0.0))
    after = replace(steps[at + 1], motion=drive[at - 1].between(drive[at + 1]))
    found = track([*steps[:at], parked, after, *steps[at + 2 :]])
    assert errors(found, [*drive[:at], drive[at - 1], *drive[at + 1 :]])[0] < 0.04
    assert {one.source for one in found[1:]} == {"visual"}


def test_a_gap_of_a_robot_without_odometry_is_no_end() -> None:
    """What is seen on both sides of it ties them."""
    drive = make_drive(12)[:5]
    drive += [drive[-1] @ pose.inverse() @ drive[0] for pose in drive[1:]]
    steps = [replace(step, motion=None) for step in make_views(make_room(), drive)]
    for index in range(4, len(steps)):
        steps[index] = replace(steps[index], stamp_nanos=steps[index].stamp_nanos + SECOND)
    found = track(steps)
    assert {one.source for one in found[1:]} == {"visual"}
    assert errors(found, drive)[0] < 0.03


def test_stamps_that_repeat_or_run_back_are_no_crash() -> None:
    """Nor is a gap of years."""
    drive = make_drive(6)
    steps = make_views(make_room(), drive)
    for shift in (-SECOND, -2 * SECOND, 10**18):
        moved = [*steps[:3], *(replace(one, stamp_nanos=one.stamp_nanos + shift) for one in steps[3:])]
        assert len(track(moved)) == 6
    assert errors(track([*steps[:3], replace(steps[3], stamp_nanos=2 * SECOND), *steps[4:]]), drive)[0] < 0.03


def test_the_first_picture_may_come_late() -> None:
    """The track starts without it, and what comes later is tied to it."""
    drive = make_drive(8)
    steps = make_views(make_room(), drive)
    found = track([replace(steps[0], view=None), *steps[1:]])
    assert [one.source for one in found] == ["start", *["visual"] * 7]
    assert errors(found, drive)[0] < 0.03


def test_a_blind_keyframe_is_expected_where_motion_leads() -> None:
    """No picture, or one without depth: the pose is told and called inertial, and the next ones are found again."""
    drive = make_drive(14)
    steps = make_views(make_room(), drive, noise_m=0.01)
    view = steps[5].view
    assert view is not None
    steps[5] = replace(steps[5], view=None)
    steps[6] = replace(steps[6], view=replace(view, depth_m=np.zeros_like(view.depth_m)))
    found = track(steps)
    assert [found[i].source for i in (4, 5, 6, 7)] == ["visual", "inertial", "inertial", "visual"]
    assert errors(found, drive)[0] < 0.06


def test_odometry_that_is_set_anew_is_not_believed() -> None:
    """A step of a kilometre in a second is no motion; nor is the turn that came with it."""
    drive = make_drive(8)
    steps = make_views(make_room(), drive)
    steps[4] = replace(steps[4], motion=SE2(1000.0, 0.0, 2.0))
    assert errors(track(steps), drive)[0] < 0.03


def test_a_place_without_overlap_begins_anew() -> None:
    """Keyframes of a hall are tied to nothing known: their poses are those of motion, and the room is known again."""
    here = make_room()
    hall = Room(np.array([-30.0, -30.0, 0.0]), np.array([30.0, 30.0, 9.0]), here.boxes + [14.0, 0.0, 0.0])
    drive = make_drive(8)
    steps = make_views(here, drive, noise_m=0.01)
    for index in (2, 3):
        steps[index] = replace(steps[index], view=hall.view(matrix(drive[index])))
    estimator = walked(steps)
    found = estimator.finish()
    assert [one.source for one in found[1:]] == ["visual", *["inertial"] * 2, *["visual"] * 4]
    assert errors(found[:2] + found[4:], drive[:2] + drive[4:])[0] < 0.03
    assert [row["frame"][0] for row in estimator.rows()] == [0, 1, 4, 5, 6, 7]
    assert next(estimator.warnings()).startswith("2 keyframes show nothing that the others do")


def test_neither_motion_nor_picture_is_no_pose() -> None:
    """And what comes after is no crash."""
    drive = make_drive(8)
    steps = make_views(make_room(), drive)
    steps[3] = replace(steps[3], view=None, motion=None)
    found = track(steps)
    assert found[3] == PoseEstimate(None, "none")
    assert found[4].map_from_robot is not None
    assert track([]) == []
    blind = [replace(step, view=None) for step in steps[:3]]
    assert [one.source for one in track(blind)] == ["start", "inertial", "inertial"]


def squared_surprise(found: list[PoseEstimate], drive: list[SE2]) -> list[float]:
    """Of each pose but the first, the squared Mahalanobis distance of the truth, over its three degrees of freedom."""
    surprises = []
    for estimate, true in list(zip(found, drive, strict=True))[1:]:
        assert estimate.map_from_robot is not None
        assert estimate.covariance is not None
        wanted, pose = drive[0].between(true), estimate.map_from_robot
        turn = math.remainder(pose.heading_rad - wanted.heading_rad, math.tau)
        error = np.array([pose.x_m - wanted.x_m, pose.y_m - wanted.y_m, turn])
        surprises.append(float(error @ np.linalg.solve(np.array(estimate.covariance).reshape(3, 3), error)) / 3)
    return surprises


def test_covariances_are_of_the_size_of_the_errors() -> None:
    """Neither boasting nor hiding: 1 would be perfect. The first pose is exact, since it makes the map frame."""
    surprises = []
    for seed in (0, 1, 2):
        drive = make_drive(16)
        found = track(make_views(make_room(seed), drive, bias=BIAS, noise_m=0.03, noise_rad=0.02))
        assert found[0].covariance is not None
        assert max(found[0].covariance) < 1e-7
        assert {verdict_of(one, 0.1, 0.035) for one in found} == {OK}
        surprises += squared_surprise(found, drive)
    assert 0.1 < float(np.mean(surprises)) < 2.5


def test_doubt_grows_where_motion_alone_leads() -> None:
    """Keyframes without a picture are told with a covariance that grows, until the walls are seen again."""
    drive = make_drive(14)
    steps = make_views(make_room(), drive, bias=BIAS, noise_m=0.03, noise_rad=0.02)
    for index in (7, 8):
        steps[index] = replace(steps[index], view=None)
    found = track(steps)
    spread = [math.sqrt(one.covariance[0] + one.covariance[4]) if one.covariance else math.nan for one in found]
    assert 2 * spread[6] < spread[7] < spread[8]
    assert spread[9] < 0.5 * spread[8]
    assert max(squared_surprise(found, drive)[6:8]) < 6
    assert [verdict_of(found[index], 0.1, 0.035) for index in (6, 7, 8, 9)] == [OK, UNCERTAIN, UNCERTAIN, OK]


RESTING = SE2(0.0, 0.0, 0.0)
"""What wheels tell of a robot that was carried."""
BEFORE, AFTER = 12, 8
"""Keyframes before a robot was carried, and after. After fewer before it, most of these robots are laid somewhere at
once, and what one that is lost keeps in mind (where it may have been parked, its group) is not tried."""


@lru_cache
def carried(room: int, motion: SE2 | None) -> tuple[tuple[Step, ...], list[SE2]]:
    """A robot that drives, is carried off into the room of that seed, 0 for the same one, and drives on; its odometry
    tells something of that, or nothing."""
    drive = make_drive(BEFORE)
    away = [SE2(1.2, -0.8, 2.4) @ pose for pose in make_drive(AFTER)]
    first, second = observed(make_views(make_room(), drive)), observed(make_views(make_room(room), away))
    later = [replace(step, frame=BEFORE + step.frame, stamp_nanos=step.stamp_nanos + 60 * SECOND) for step in second]
    return (*first, replace(later[0], motion=motion), *later[1:]), [*drive, *away]


@lru_cache
def carried_track(room: int, motion: SE2 | None) -> tuple[list[PoseEstimate], SurfelEstimator]:
    """The finished track of that robot, for several tests."""
    estimator = walked(carried(room, motion)[0])
    return estimator.finish(), estimator


@pytest.mark.parametrize("motion", [None, RESTING], ids=["without motion", "wheels at rest"])
def test_a_robot_that_was_carried_is_found_by_its_map(motion: SE2 | None) -> None:
    """Whatever the odometry says of it."""
    (found, _), (_, drive) = carried_track(0, motion), carried(0, motion)
    right = [one for one, true in zip(found, drive, strict=True) if one.map_from_robot and _near(one, true)]
    assert len(right) >= BEFORE + AFTER - 2
    for one, true in zip(found, drive, strict=True):
        assert verdict_of(one, 0.1, 0.035) != OK or _near(one, true)


def _near(estimate: PoseEstimate, true: SE2) -> bool:
    assert estimate.map_from_robot is not None
    apart = true.between(estimate.map_from_robot)
    return math.hypot(apart.x_m, apart.y_m) < 0.05 and abs(apart.heading_rad) < 0.02


@pytest.mark.parametrize("motion", [None, RESTING], ids=["without motion", "wheels at rest"])
def test_a_robot_that_was_carried_to_another_room_is_not_found_in_the_first(motion: SE2 | None) -> None:
    """Its poses are called uncertain, or there are none."""
    (found, _), (_, drive) = carried_track(5, motion), carried(5, motion)
    assert all(_near(one, true) for one, true in zip(found[:BEFORE], drive[:BEFORE], strict=True))
    assert {verdict_of(one, 0.1, 0.035) for one in found[BEFORE:]}.isdisjoint({OK})


@pytest.mark.parametrize("kind", ["blind", "carried"])
def test_parts_hold_everything(kind: str) -> None:
    """A track put away and taken up several times ends with the very numbers of one that was not."""
    if kind == "blind":
        steps, cuts = (
            observed(make_views(make_room(), make_drive(9), bias=BIAS, noise_m=0.02, noise_rad=0.02)),
            (0, 4, 7, 9),
        )
        steps[3], steps[7] = replace(steps[3], view=None), replace(steps[7], motion=None)
        estimator = walked(steps)
        whole = estimator.finish()
    else:
        steps, cuts = list(carried(5, RESTING)[0]), (0, BEFORE, BEFORE + 1, BEFORE + 3, BEFORE + AFTER)
        whole, estimator = carried_track(5, RESTING)
    again, parts = SurfelEstimator(CONFIG, GRID), list[bytes]()
    for start, stop in pairwise(cuts):
        for step in steps[start:stop]:
            again.step(step)
        parts.append(again.part())
        again = SurfelEstimator(CONFIG, GRID)
        again.restore(parts)
        put_away, taken_up = unpack(parts[-1]), unpack(again.part())
        for name in ("bias", "covariance", "speed", "surprise", "open", "group"):
            np.testing.assert_array_equal(taken_up[name], put_away[name], name)
    assert again.finish() == whole
    for row, wanted in zip(again.rows(), estimator.rows(), strict=True):
        np.testing.assert_equal(row, wanted)


def test_a_robot_that_errs_more_than_it_is_said_to_is_found_out() -> None:
    """Motion that errs three times as much as the configuration says, in every step: the track is as good as ever, or a
    pose that is not is not called ok."""
    drive = make_drive(14)
    steps = make_views(make_room(), drive, bias=SE2(0.05, -0.04, 0.05), noise_m=0.09, noise_rad=0.08)
    assert errors(reckoned(steps), drive)[0] > 0.4
    found = track(steps)
    assert errors(found[:13], drive[:13])[0] < 0.03
    assert all(verdict_of(one, 0.1, 0.035) != OK or _near(one, true) for one, true in zip(found, drive, strict=True))
    prior = MotionPrior(CONFIG)
    for measured in (SE2(0.2, 0.0, 0.1), SE2(0.5, 0.1, -0.2), SE2(0.0, -0.2, 0.4)):
        prior.learn(measured, 1.0, SE2(0.2, 0.0, 0.1), np.diag([1e-5] * 3))
    assert prior.scale > 3.0


# --- a map made before ------------------------------------------------------------------------------------------------

ELSEWHERE = SE2(0.9, -0.6, 2.2)
"""Where the second robot starts, in the map frame of the first."""


def make_map(folder: Path, room: Room, drive: list[SE2]) -> Path:
    """The places table of a drive."""
    estimator = SurfelEstimator(CONFIG, GRID)
    for step in observed(make_views(room, drive, noise_m=0.01)):
        estimator.step(step)
    estimator.finish()
    path = folder / "places.parquet"
    file = TableFileWriter(path, PLACES, {"classes": list(CLASSES), "cell_m": CELL_M, "side": SIDE})
    for row in estimator.rows():
        file.append(row)
    file.close()
    return path


def find(path: Path, room: Room, drive: list[SE2]) -> tuple[list[PoseEstimate], list[str]]:
    """Poses and warnings of another drive in that map."""
    estimator = SurfelEstimator(replace(CONFIG, prior=str(path)), GRID)
    for step in observed(make_views(room, drive, noise_m=0.01)):
        estimator.step(step)
    return estimator.finish(), list(estimator.warnings())


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of twelve keyframes in room 5."""
    return make_map(tmp_path_factory.mktemp("known"), make_room(5), make_drive(12))


def test_a_log_is_found_in_a_map_made_before(known: Path) -> None:
    """Without a first guess, to the centimetre, and its poses are told in that map's frame."""
    room = make_room(5)
    second = [ELSEWHERE @ pose for pose in make_drive(9)]
    found, warnings = find(known, room, second)
    assert warnings == []
    assert {one.source for one in found} == {"visual"}
    for estimate, true in zip(found, second, strict=True):
        assert estimate.map_from_robot is not None
        apart = true.between(estimate.map_from_robot)
        assert math.hypot(apart.x_m, apart.y_m) < 0.03
        assert abs(apart.heading_rad) < 0.01
        assert estimate.modes[0].probability > 0.9
        assert estimate.peak == estimate.modes[0].probability
        assert estimate.entropy_nats is not None
        assert estimate.entropy_nats < 0.4
        assert verdict_of(estimate, 0.1, 0.035) == OK
        mode = estimate.map_from_robot.between(estimate.modes[0].map_from_robot)
        assert max(abs(mode.x_m), abs(mode.y_m), abs(mode.heading_rad)) < 1e-9


def test_a_room_that_looks_the_same_from_both_ends_is_ambiguous(tmp_path: Path) -> None:
    """No pose is told, but both ways the log may lie are."""
    room = symmetric(make_room(5, boxes=7))
    path = make_map(tmp_path, room, make_drive(12))
    second = [ELSEWHERE @ pose for pose in make_drive(9)]
    found, warnings = find(path, room, second)
    assert all(one.map_from_robot is None and one.source == "none" for one in found)
    assert len(warnings) == 1
    assert "ambiguous" in warnings[0]
    half_turn = SE2(0.0, 0.0, math.pi)
    ways = [mode.map_from_robot for mode in found[0].modes[:2]]
    for true in (second[0], half_turn @ second[0]):
        apart = [true.between(way) for way in ways]
        assert min(math.hypot(one.x_m, one.y_m) for one in apart) < 0.05
    assert found[0].entropy_nats == pytest.approx(math.log(2), abs=0.1)


def test_another_room_is_not_found(known: Path) -> None:
    """Lost is an answer."""
    found, warnings = find(known, make_room(11), make_drive(9))
    assert all(one.map_from_robot is None for one in found)
    assert "lost" in warnings[0]
    assert all(one.modes == () for one in found)


def test_a_map_of_other_classes_is_refused(tmp_path: Path) -> None:
    """With both class lists."""
    path = make_map(tmp_path, make_room(5), make_drive(2))
    with pytest.raises(SemslamError, match="other observations") as caught:
        read_prior(path, replace(GRID, classes=CLASSES[:-1]))
    assert "same detector" in caught.value.hint
    with pytest.raises(SemslamError, match="other observations") as caught:
        read_prior(path, replace(GRID, side=SIDE + 2))
    assert f"{SIDE + 2} x {SIDE + 2} cells" in caught.value.details
    with pytest.raises(SemslamError, match="missing") as caught:
        read_prior(tmp_path / "none.parquet", GRID)
    assert "semslam run LOG --estimator surfel" in caught.value.hint
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for damaged in (b"", whole[:1000], bytes(flipped)):
        path.write_bytes(damaged)
        with pytest.raises(SemslamError, match="damaged") as caught:
            read_prior(path, GRID)
        assert "semslam run LOG --estimator surfel" in caught.value.hint


def test_rows_that_are_no_places_are_refused(tmp_path: Path) -> None:
    """Of a hand-made file, with the number of the row."""
    path = make_map(tmp_path, make_room(5), make_drive(2))
    rows = TableFiles(PLACES, [path]).read()
    for name, values in (("points", [1.0, 2.0]), ("map_from_robot", [1.0]), ("cells", [4_000_000_000])):
        spoiled = {**rows, name: [rows[name][0], values]}
        spoiled |= {"weights": [rows["weights"][0], [1.0]]} if name == "cells" else {}
        write_table(path, PLACES, spoiled, {"classes": list(CLASSES), "cell_m": CELL_M, "side": SIDE})
        with pytest.raises(SemslamError, match="is no place"):
            read_prior(path, GRID)


def test_a_single_keyframe_is_found(known: Path) -> None:
    """With its pose."""
    room, drive = make_room(5), make_drive(12)
    found, _ = find(known, room, drive[3:4])
    assert [one.source for one in found] == ["visual"]
    assert found[0].map_from_robot is not None
    apart = drive[3].between(found[0].map_from_robot)
    assert math.hypot(apart.x_m, apart.y_m) < 0.03


def test_a_map_comes_back_from_its_file(known: Path) -> None:
    """The same places and the same cells; a log is found in its own map where it is."""
    prior = read_prior(known, GRID)
    assert len(prior.places) == 12
    assert len(prior.cells.points) > 500
    placement = place_in(prior, prior)
    assert placement.verdict == FOUND
    pose = placement.other_from_own
    assert pose is not None
    assert math.hypot(pose.x_m, pose.y_m) < 0.005
    assert place_in(replace(prior, places=[]), prior).verdict == LOST


def test_the_field_of_maps_without_cells_is_empty() -> None:
    """And maps of other classes are never compared."""
    none = ClassMap(np.zeros((0, 2)), np.zeros(0, np.int64), CELL_M, CLASSES)
    some = ClassMap(np.ones((1, 2)), np.ones(1, np.int64), CELL_M, CLASSES)
    assert candidates(none, some, 3) == candidates(some, none, 3) == []
    far = ClassMap(np.array([[0.0, 0.0], [2000.0, 1500.0]]), np.ones(2, np.int64), CELL_M, CLASSES)
    assert candidates(some, far, 3) == candidates(far, some, 3) == []
    with pytest.raises(ValueError, match="classes"):
        candidates(some, replace(some, classes=CLASSES[:-1]), 3)


# --- the stage --------------------------------------------------------------------------------------------------------


def make_context(folder: Path, shard_frames: int) -> MemoryContext:
    """Seven keyframes of the room, with observations of another world; it does not matter which."""
    steps = make_views(make_room(), make_drive(7), noise_m=0.01)
    observed = [
        replace(step, observation=make_world().observe(pose)) for step, pose in zip(steps, make_walk(7), strict=True)
    ]
    folder.mkdir()
    inputs = write_inputs(folder, observed)
    write_table(folder / "frames.parquet", FRAMES, frame_rows(steps))
    inputs[FRAMES.name] = TableFiles(FRAMES, [folder / "frames.parquet"])
    config = LocalizeConfig(estimators=("surfel",), surfel=CONFIG, shard_frames=shard_frames, snapshot_every=3)
    return MemoryContext(folder / "out", inputs, config, "surfel")


def frame_rows(steps: list[Step]) -> dict[str, list[object]]:
    views = [step.view for step in steps if step.view]
    common = {"width": 160, "height": 120, "log_time_nanos": 0, "depth_offset_nanos": 0, "camera_height_m": 0.5}
    common |= {"fx": 80.0, "fy": 80.0, "cx": 79.5, "cy": 59.5, "roll_rad": 0.0, "pitch_rad": 0.0}
    rows: dict[str, list[object]] = {name: [value] * len(steps) for name, value in common.items()}
    rows |= {"level_source": ["tf"] * len(steps), "height_source": ["tf"] * len(steps)}
    rows |= {"robot_from_camera": [ROBOT_FROM_CAMERA.ravel().tolist()] * len(steps)}
    rows |= {"frame": [step.frame for step in steps], "stamp_nanos": [step.stamp_nanos for step in steps]}
    pictures = {"colour": [encode_colour(view.rgb) for view in views]}
    return {**rows, **pictures, "depth": [encode_depth(view.depth_m) for view in views]}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> MemoryContext:
    """A run of the stage in three shards."""
    context = make_context(tmp_path_factory.mktemp("stage") / "whole", shard_frames=3)
    localize.run(context)
    return context


def test_the_stage_tells_all_at_the_end(finished: MemoryContext) -> None:
    """All rows lie in the last shard, in the order of the keyframes, with the map along them."""
    context, out = finished, finished.folder
    tables = context.results(POSES, SNAPSHOTS, CELLS)
    poses = tables["poses"].read()
    assert poses["frame"] == list(range(7))
    assert poses["source"] == ["start", *["visual"] * 6]
    assert tables["snapshots"].read()["frame"] == [2, 5, 6]
    assert tables["cells"].rows > 100
    places = TableFiles(PLACES, [out / f"shard-{index}" / "places.parquet" for index in range(3)])
    assert places.read(["frame"])["frame"] == list(range(7))
    assert places.meta["side"] == SIDE
    assert tables["poses"].meta["estimator"] == "surfel"
    rows = [TableFiles(POSES, [out / f"shard-{index}" / "poses.parquet"]).rows for index in range(3)]
    assert rows == [0, 0, 7]
    assert context.done[-1][0] == context.done[-1][1]
    assert context.shards[-1].counters == {"poses_start": 1, "poses_visual": 6}


@pytest.mark.parametrize("shards", [1, 2])
def test_a_run_that_was_cut_goes_on_with_the_same_bytes(finished: MemoryContext, tmp_path: Path, shards: int) -> None:
    """From any finished shard."""
    cut = make_context(tmp_path / "cut", shard_frames=3)
    folders = [finished.folder / f"shard-{index}" for index in range(shards)]
    cut.finished = tuple(FinishedShard(index, {}, {}, folder) for index, folder in enumerate(folders))
    localize.run(cut)
    for index in range(shards, 3):
        ours, theirs = (folder / f"shard-{index}" for folder in (cut.folder, finished.folder))
        assert {p.name: p.read_bytes() for p in ours.iterdir()} == {p.name: p.read_bytes() for p in theirs.iterdir()}
