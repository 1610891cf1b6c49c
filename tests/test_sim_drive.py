"""A robot that drives about in a home: the physics, the route it takes and what it gets to see."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from semslam.errors import SemslamError
from semslam.geometry.frames import matrix_from_pose
from semslam.sim.chassis import GRAVITY_M_S2, TRACK_M, WHEEL_RADIUS_M
from semslam.sim.home import Array, Home, Piece, Placed, Walker
from semslam.sim.lattice import ROBOT_RADIUS_M, WALKER_M, clearance_at, clearance_raster
from semslam.sim.outlook import BEARINGS, forecast, relief_of
from semslam.sim.vehicle import IMU_HZ, Drive, RobotSpec, draw_robot, drive, keyframe_times
from tests.furnished import furnished, raster, rectangle

pytest.importorskip("mujoco", reason="needs the physics: pip install 'semslam[sim]'")

ROBOT = RobotSpec(0.45, math.radians(5), 0.03)
SEEDS = (1, 2)


@pytest.fixture(scope="module")
def home() -> Home:
    """One furnished room."""
    return furnished()


@pytest.fixture(scope="module")
def drives(home: Home) -> list[Drive]:
    """A full drive for each seed."""
    return [drive(home, raster(home), ROBOT, seed) for seed in SEEDS]


def in_view(home: Home, motion: Drive, every: int = 20) -> np.ndarray:
    """(N, objects) which objects the forecast shows at every so many samples."""
    headings = motion.headings()[::every]
    around = forecast(relief_of(home), motion.positions[::every, :2], ROBOT.camera_height_m, ROBOT.camera_pitch_rad)
    bearing = np.round(headings / (2 * np.pi) * BEARINGS).astype(int) % BEARINGS
    return np.asarray(around[np.arange(len(headings)), bearing])


def length_m(motion: Drive) -> float:
    return float(np.hypot(*np.diff(motion.positions[::10, :2], axis=0).T).sum())


def turned_by_wheels(motion: Drive) -> Array:
    """(N,) heading that the wheels suggest."""
    left, right = (motion.wheel_rad - motion.wheel_rad[0]).T
    return (right - left) * WHEEL_RADIUS_M / TRACK_M


def test_the_gyro_integrates_to_the_true_heading(drives: list[Drive]) -> None:
    """Over a whole drive the noise-free gyro and the orientation of the body tell the same story."""
    for motion in drives:
        rate = motion.gyro[:, 2]
        integral = np.concatenate([[0.0], np.cumsum(rate[1:] + rate[:-1]) / 2 / IMU_HZ])
        truth = motion.headings() - motion.headings()[0]
        assert np.abs(truth).max() > 1.0
        np.testing.assert_allclose(integral, truth, atol=2e-4)


def test_the_accelerometer_feels_gravity_at_rest_and_the_motion_else(drives: list[Drive]) -> None:
    """It reads g upwards while the robot stands; integrated over the drive it gives the speed the robot has."""
    for motion in drives:
        resting = motion.accel[: round(0.5 * IMU_HZ)]
        np.testing.assert_allclose(np.linalg.norm(resting, axis=1), GRAVITY_M_S2, atol=1e-3)
        np.testing.assert_allclose(resting[:, 2], GRAVITY_M_S2, atol=1e-3)
        rotation = np.array([matrix_from_pose((0, 0, 0), q)[:3, :3] for q in motion.orientations[:4000]])
        at_imu = motion.positions[:4000] + rotation @ ROBOT.imu_m
        force = np.einsum("nij,nj->ni", rotation, motion.accel[:4000]) - (0, 0, GRAVITY_M_S2)
        speed = np.cumsum(force, axis=0) / IMU_HZ
        np.testing.assert_allclose(speed[1:-1, :2], (at_imu[2:] - at_imu[:-2])[:, :2] * IMU_HZ / 2, atol=4e-3)


def test_the_robot_stays_level_on_the_floor(drives: list[Drive]) -> None:
    """It pitches by less than a degree, but it does pitch: the tilt comes from physics."""
    for motion in drives:
        tilt = 2 * np.hypot(motion.orientations[:, 0], motion.orientations[:, 1])
        assert math.radians(0.02) < np.ptp(tilt)
        assert tilt.max() < math.radians(1)
        assert np.abs(motion.positions[:, 2]).max() < 2e-3


def test_the_wheels_slip(drives: list[Drive]) -> None:
    """The wheels suggest more turning than there is, by some per cent, and nearly the right way."""
    for motion in drives:
        believed, true = (
            np.abs(np.diff(angle[::100])).sum() for angle in (turned_by_wheels(motion), motion.headings())
        )
        assert 1.01 * true < believed < 1.10 * true
        rolled = np.abs(np.diff(motion.wheel_rad[::10].mean(1))).sum() * WHEEL_RADIUS_M
        assert rolled == pytest.approx(length_m(motion), rel=0.03)


def test_it_travels_gently(drives: list[Drive]) -> None:
    """A drive of 90 s leads through 15 to 30 m, within the speeds of such a robot, and begins standing still."""
    for motion in drives:
        assert 15 < length_m(motion) * 90 / motion.times_s[-1] < 30
        speed = np.hypot(*np.gradient(motion.positions[:, :2], 1 / IMU_HZ, axis=0).T)
        assert speed.max() < 0.45
        assert np.abs(motion.gyro[:, 2]).max() < 1.3
        assert speed[: round(0.55 * IMU_HZ)].max() < 1e-3
        assert np.abs(motion.accel[:, :2]).max() < 1.5


def test_it_touches_nothing(home: Home, drives: list[Drive]) -> None:
    """No contact, and never nearer to things than the radius that routes are planned for, within the pilot's skill."""
    free = raster(home)
    clearance = clearance_raster(free, None)
    for motion in drives:
        assert motion.contacts == 0
        nearest = clearance_at(clearance, np.asarray(free[1]), motion.positions[::20, :2]).min()
        assert nearest > ROBOT_RADIUS_M - 0.05


def test_furniture_is_solid(home: Home) -> None:
    """A fence that the raster hides stops a robot that drives against it, and the touches are counted."""
    sides = ((1.3, 0.0, 0.0), (-1.3, 0.0, 0.0), (0.0, 1.3, np.pi / 2), (0.0, -1.3, np.pi / 2))
    board = Piece("bin", "box", (), rectangle(-0.05, -1.35, 0.05, 1.35), 0.15)
    fence = tuple(Placed(90 + k, board, *side) for k, side in enumerate(sides))
    motion = drive(replace(home, objects=(*home.objects, *fence)), raster(home), ROBOT, 1, steps=20)
    assert motion.contacts > IMU_HZ
    assert np.abs(motion.positions[:, :2]).max() < 1.25


def test_there_is_always_something_to_see(home: Home, drives: list[Drive]) -> None:
    """Half the moments show some five objects, every one shows at least one, and a drive sees nearly everything.

    The forecast counts less than the pictures show.
    """
    for motion in drives:
        view = in_view(home, motion)
        count = view.sum(1)
        assert np.median(count) >= 4
        assert count.min() >= 1
        assert np.mean(count < 2) < 0.02
        assert view.any(0).mean() > 0.85


def test_looking_at_things_beats_driving_anywhere(home: Home, drives: list[Drive]) -> None:
    """The same places seen with random headings show fewer objects, and often none or one."""
    rng = np.random.default_rng(0)
    places = np.concatenate([motion.positions[::100, :2] for motion in drives])
    around = forecast(relief_of(home), places, ROBOT.camera_height_m, ROBOT.camera_pitch_rad)
    anywhere = around[np.arange(len(places)), rng.integers(0, BEARINGS, len(places))].sum(1)
    chosen = np.concatenate([in_view(home, motion).sum(1) for motion in drives])
    assert chosen.mean() > anywhere.mean() + 0.3
    assert np.mean(chosen < 2) < 0.5 * np.mean(anywhere < 2)


def test_low_things_hide_nothing_and_tall_ones_do() -> None:
    """Over a bench one sees the shelf behind it; behind a cupboard one does not, nor through a wall."""
    bench, cupboard = (Piece("table", "box", (), rectangle(-0.2, -0.8, 0.2, 0.8), top) for top in (0.3, 1.8))
    shelf = Piece("bookshelf", "box", (), rectangle(-0.2, -0.5, 0.2, 0.5), 1.2)
    seen = []
    for front in (bench, cupboard):
        row = (Placed(1, front, 1.5, 0.0, 0.0), Placed(2, shelf, 3.0, 0.0, 0.0), Placed(3, shelf, 6.0, 0.0, 0.0))
        room = replace(furnished(2), objects=row)
        seen.append(forecast(relief_of(room), np.zeros((1, 2)), 0.45, 0.1)[0, [0, BEARINGS // 2]].tolist())
    assert seen == [[[True, True, False], [False] * 3], [[True, False, False], [False] * 3]]


def test_drives_of_one_home_differ_and_start_together(home: Home, drives: list[Drive]) -> None:
    """Other seeds take other ways from about the same place, and see mostly the same things."""
    for motion in drives:
        assert np.hypot(*(motion.positions[0, :2] - home.start)) < 1.0
    first, second = (motion.positions[:15000, :2] for motion in drives)
    assert np.hypot(*(first - second).T).mean() > 1.0
    seen = [set(np.flatnonzero(in_view(home, motion).any(0))) for motion in drives]
    assert len(set.intersection(*seen)) > 0.7 * len(home.objects)


def test_it_comes_back_to_where_it_was(drives: list[Drive]) -> None:
    """Routes overlap with themselves: the second half comes near places of the first."""
    for motion in drives:
        first, second = np.array_split(motion.positions[::200, :2], 2)
        away = np.hypot(*(second[:, None] - first[None]).transpose(2, 0, 1)).min(1)
        assert np.mean(away < 1.0) > 0.15


def test_more_steps_and_other_rates_see_the_same_drive(home: Home, drives: list[Drive]) -> None:
    """A shorter, a denser and a slower recording of a seed are beginnings of the same motion, bit for bit."""
    free = raster(home)
    for steps, rate_hz in ((20, 1.0), (60, 10.0), (3, 0.2)):
        other = drive(home, free, ROBOT, SEEDS[0], steps=steps, rate_hz=rate_hz)
        count = len(other.times_s)
        for name in ("times_s", "positions", "orientations", "gyro", "accel", "wheel_rad"):
            np.testing.assert_array_equal(getattr(other, name), getattr(drives[0], name)[:count], err_msg=name)
    short = drive(home, free, ROBOT, SEEDS[0], steps=5)
    np.testing.assert_array_equal(short.keyframes_s, drives[0].keyframes_s[:5])


@pytest.mark.parametrize("rate_hz", [10.0, 2.0, 1.0, 0.5, 0.2])
def test_images_come_at_the_rate_or_slower(rate_hz: float) -> None:
    """Intervals are 1 to 1.25 times that of the rate, and jittered."""
    times = keyframe_times(4, 80, rate_hz)
    gaps = np.diff(times) * rate_hz
    assert times[0] == 0.4
    assert len(times) == 80
    assert 1.0 - 1e-9 <= gaps.min() < gaps.max() - 0.2
    assert gaps.max() <= 1.25 + 1e-9


def test_a_recording_ends_after_its_last_image(drives: list[Drive]) -> None:
    """Samples start at 0 at 200 Hz and end 0.3 s after the last image."""
    for motion in drives:
        np.testing.assert_allclose(np.diff(motion.times_s), 1 / IMU_HZ, atol=1e-9)
        assert motion.times_s[0] == 0.0
        assert 0.3 <= motion.times_s[-1] - motion.keyframes_s[-1] < 0.3 + 2 / IMU_HZ


def test_poses_are_exact_at_samples_and_between_neighbours_else(drives: list[Drive]) -> None:
    """At a sample the pose is the sample's; in between it lies half way; past the end it stays."""
    motion = drives[0]
    for index in (0, 1, 2999, len(motion.times_s) - 1):
        exact = matrix_from_pose(motion.positions[index], motion.orientations[index])
        np.testing.assert_array_equal(motion.world_from_base(float(motion.times_s[index])), exact)
    middle = motion.world_from_base(float(motion.times_s[3000] + motion.times_s[3001]) / 2)
    np.testing.assert_allclose(middle[:3, 3], motion.positions[3000:3002].mean(0), atol=1e-12)
    np.testing.assert_array_equal(motion.world_from_base(1e6)[:3, 3], motion.positions[-1])


def test_the_same_seed_drives_the_same_way(home: Home) -> None:
    """Everything about a drive follows from home, robot and seed."""
    first, second = (drive(home, raster(home), ROBOT, 7, steps=6) for _ in range(2))
    for name in ("positions", "orientations", "gyro", "accel", "wheel_rad", "keyframes_s"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name


def test_it_visits_all_rooms_in_time() -> None:
    """Through a door opening of 0.95 m, without touching it, a long drive gets to the other room and back."""
    two = furnished(2)
    motion = drive(two, raster(two), ROBOT, 1, steps=20, rate_hz=0.2)
    other = motion.positions[:, 0] > 4.1
    assert motion.contacts == 0
    assert np.count_nonzero(np.diff(other.astype(int))) >= 2


def test_the_way_of_a_walker_is_left_free() -> None:
    """Where somebody walks to and fro the robot never goes."""
    body = Piece("person", "box", (), rectangle(-0.2, -0.2, 0.2, 0.2), 1.7)
    walker = Walker(99, body, (0.6, -2.4), (0.6, -0.6), 0.8)
    home = replace(furnished(walker=walker), start=(-0.5, 1.6))
    motion = drive(home, raster(home), ROBOT, 2, steps=40)
    x, y = motion.positions[:, 0], motion.positions[:, 1]
    away = np.hypot(x - 0.6, np.maximum(np.maximum(-2.4 - y, y + 0.6), 0.0))
    assert away.min() > WALKER_M + ROBOT_RADIUS_M - 0.1


def test_robots_differ_in_their_cameras() -> None:
    """Heights and angles are drawn per seed, within their range; the optical frame looks ahead and a little down."""
    robots = [draw_robot(seed) for seed in range(50)]
    assert draw_robot(3) == robots[3]
    assert len({robot.camera_height_m for robot in robots}) == 50
    for robot in robots:
        base_from_camera = robot.base_from_camera
        assert 0.35 <= base_from_camera[2, 3] <= 0.6
        right, down, ahead = base_from_camera[:3, :3].T
        np.testing.assert_allclose(right, (0, -1, 0), atol=1e-12)
        assert down[2] < -0.98
        assert math.radians(2) <= -math.asin(ahead[2]) <= math.radians(9)
        np.testing.assert_array_equal(robot.base_from_imu[:3, 3], robot.imu_m)


def test_impossible_wishes_are_refused(home: Home) -> None:
    """No images, a rate of nothing, and a home without floor at its start are errors that say so."""
    free = raster(home)
    for wish, words in (
        ({"steps": 0}, "shows nothing"),
        ({"rate_hz": 0.0}, "Rate `0.0`"),
        ({"rate_hz": math.nan}, "nan"),
    ):
        with pytest.raises(SemslamError, match=words):
            drive(home, free, ROBOT, 1, **wish)  # type: ignore[arg-type]
    with pytest.raises(SemslamError, match="no free floor"):
        drive(home, (np.zeros_like(free[0]), free[1]), ROBOT, 1, steps=1)
