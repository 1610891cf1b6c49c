"""Levelling: up from a moving IMU, and the camera's height from the floor it sees."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import FLU_FROM_OPTICAL, matrix_from_pose, planar, rotation_from_vector
from semslam.geometry.levelling import FloorTracker, GravityFilter, floor_height, level_rotation, roll_pitch
from semslam.geometry.motion import PoseTrack
from semslam.geometry.projection import points_in_robot

Vector = NDArray[np.float64]
SECOND = 1_000_000_000
G = 9.81


def tilt_deg(up: Vector | None, truth: Vector) -> float:
    assert up is not None
    return math.degrees(math.acos(min(1.0, float(up @ truth))))


def shaken_imu(
    seconds: float, *, bias: Sequence[float] = (0.0, 0.0, 0.0), spikes: bool = False
) -> tuple[list[int], Vector, Vector, Vector]:
    """A body that nods and turns while it is carried back and forth: stamps, gyro, accel, and true up in the body."""
    rng = np.random.default_rng(1)
    times = np.arange(0.0, seconds, 0.01)
    angles = np.stack([0.1 * np.sin(times), 0.4 + 0.3 * np.sin(0.7 * times), 0.8 * times], axis=1)
    world_from_body = np.stack(
        [
            rotation_from_vector((0, 0, yaw)) @ rotation_from_vector((0, pitch, 0)) @ rotation_from_vector((roll, 0, 0))
            for roll, pitch, yaw in angles
        ]
    )
    steps = np.transpose(world_from_body[:-1], (0, 2, 1)) @ world_from_body[1:]
    gyro = np.array([cv2.Rodrigues(step)[0].ravel() for step in steps] + [np.zeros(3)]) / 0.01 + bias
    moving = np.stack([1.5 * np.sin(5 * times), 1.2 * np.cos(7 * times), 2.0 * np.sin(11 * times)], axis=1)
    force = np.einsum("nji,nj->ni", world_from_body, moving + (0.0, 0.0, G)) + rng.normal(0, 0.05, (len(times), 3))
    if spikes:
        hit = rng.random(len(times)) < 0.1
        force[hit] += rng.normal(0, 15.0, (int(hit.sum()), 3))
    stamps = [round(t * SECOND) for t in times]
    return stamps, gyro, force, world_from_body[:, 2, :]


def filled(stamps: list[int], gyro: Vector, force: Vector) -> GravityFilter:
    gravity = GravityFilter()
    for stamp, rate, pull in zip(stamps, gyro, force, strict=True):
        assert gravity.add(stamp, rate.tolist(), pull.tolist())
    return gravity


@pytest.mark.parametrize(
    ("bias", "spikes"), [((0.0, 0.0, 0.0), False), ((0.02, -0.02, 0.01), False), ((0.0, 0.0, 0.0), True)]
)
def test_up_of_a_carried_camera(bias: tuple[float, float, float], spikes: bool) -> None:
    """Accelerations of 2 m/s^2, a gyro bias, or hits of 15 m/s^2 leave up right within about a degree."""
    stamps, gyro, force, truth = shaken_imu(12.0, bias=bias, spikes=spikes)
    gravity = filled(stamps, gyro, force)
    errors = [tilt_deg(gravity.up_at(stamps[i]), truth[i]) for i in range(200, 1000, 40)]
    raw = [tilt_deg(force[i] / np.linalg.norm(force[i]), truth[i]) for i in range(200, 1000, 40)]
    assert float(np.mean(errors)) < 0.8
    assert max(errors) < 1.5
    assert float(np.mean(raw)) > 5.0  # what a single sample would have said


def test_up_between_samples_and_at_the_ends() -> None:
    """A stamp between two samples is interpolated; the first and last stamps have half a window."""
    stamps, gyro, force, truth = shaken_imu(6.0)
    gravity = filled(stamps, gyro, force)
    assert tilt_deg(gravity.up_at(3 * SECOND + 5_000_000), truth[300]) < 1.0
    assert tilt_deg(gravity.up_at(0), truth[0]) < 2.0
    assert tilt_deg(gravity.up_at(stamps[-1]), truth[-1]) < 2.0


def test_order_of_arrival_and_repeats_do_not_matter() -> None:
    """The same samples give the same bytes."""
    stamps, gyro, force, _ = shaken_imu(4.0)
    gravity, mixed = filled(stamps, gyro, force), GravityFilter()
    for i in np.random.default_rng(0).permutation(len(stamps)).tolist() + [5]:
        mixed.add(stamps[i], gyro[i].tolist(), force[i].tolist())
    expected, found = gravity.up_at(2 * SECOND), mixed.up_at(2 * SECOND)
    assert expected is not None
    assert found is not None
    assert expected.tobytes() == found.tobytes()


def test_streaming_waits_and_forgets() -> None:
    """Ready once half a window beyond the stamp has come; forgetting changes no later answer."""
    stamps, gyro, force, _ = shaken_imu(12.0)
    gravity, streamed = filled(stamps, gyro, force), GravityFilter()
    for stamp, rate, pull in zip(stamps, gyro, force, strict=True):
        streamed.add(stamp, rate.tolist(), pull.tolist())
        assert streamed.ready(5 * SECOND) == (stamp >= 7 * SECOND)
        streamed.forget_before(min(stamp, 5 * SECOND))
    expected, found = gravity.up_at(5 * SECOND), streamed.up_at(5 * SECOND)
    assert expected is not None
    assert found is not None
    assert expected.tolist() == found.tolist()
    assert streamed.up_at(2 * SECOND) is None


def test_nothing_is_said_without_evidence() -> None:
    """Too few samples, a pause at the stamp, no gravity in the signal, numbers that are none."""
    stamps, gyro, force, _ = shaken_imu(6.0)
    assert GravityFilter().up_at(0) is None
    assert not GravityFilter().ready(0)
    assert filled(stamps[:4], gyro[:4], force[:4]).up_at(0) is None
    assert filled(stamps, gyro, force).up_at(60 * SECOND) is None
    assert filled(stamps, gyro, 0.01 * force).up_at(3 * SECOND) is None
    assert not GravityFilter().add(0, (math.nan, 0.0, 0.0), (0.0, 0.0, G))
    keep = [i for i in range(len(stamps)) if not 200 <= i < 260]
    paused = filled([stamps[i] for i in keep], gyro[keep], force[keep])
    assert paused.up_at(23 * SECOND // 10) is None
    assert paused.up_at(19 * SECOND // 10) is not None


@given(st.floats(-1.2, 1.2), st.floats(-1.4, 1.4), st.floats(-3, 3))
def test_levelling_takes_out_tilt_and_keeps_heading(roll: float, pitch: float, yaw: float) -> None:
    """level_from_body is the tilt itself; the heading of the body is that of the levelled frame."""
    tilt = rotation_from_vector((0, pitch, 0)) @ rotation_from_vector((roll, 0, 0))
    world_from_body = rotation_from_vector((0, 0, yaw)) @ tilt
    up = world_from_body[2]
    assert level_rotation(up) == pytest.approx(tilt, abs=1e-9)
    assert roll_pitch(up) == pytest.approx((roll, pitch), abs=1e-6)
    lifted = np.eye(4)
    lifted[:3, :3] = world_from_body
    assert planar(lifted).heading_rad == pytest.approx(yaw, abs=1e-6)


def test_nose_down_is_positive_pitch() -> None:
    """A camera that looks down sees up behind its x axis."""
    roll, pitch = roll_pitch(np.array([-math.sin(0.5), 0.0, math.cos(0.5)]))
    assert (roll, pitch) == pytest.approx((0.0, 0.5))


@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.sampled_from([-1.0, 1.0]))
def test_levelling_stays_sane_straight_down(off_x: float, off_y: float, side: float) -> None:
    """With x nearly vertical the y axis keeps its direction, and the result stays a rotation."""
    up = np.array([side, off_x, off_y]) / np.linalg.norm([side, off_x, off_y])
    level = level_rotation(up)
    assert level @ level.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(level) == pytest.approx(1.0)
    assert level @ up == pytest.approx([0, 0, 1], abs=1e-9)
    assert abs(level[0, 1]) < 1e-9
    assert level[1, 1] > 0.9


def test_no_direction_is_no_up() -> None:
    """A zero vector is a caller's mistake."""
    with pytest.raises(ValueError, match="no direction"):
        level_rotation(np.zeros(3))


ROOM_CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)


def room_points(
    height_m: float, pitch: float, boxes: Sequence[tuple[float, float, float, float, float]], noise_m: float = 0.01
) -> Vector:
    """Levelled points about a camera over a floor, before a wall at 4 m, with boxes (x0, x1, y0, y1, top)."""
    down = np.eye(4)
    down[:3, :3] = rotation_from_vector((0.0, pitch, 0.0))
    rays = points_in_robot(np.ones((120, 160), np.float32), 140.0, 140.0, 79.5, 59.5, down @ FLU_FROM_OPTICAL)
    rays = rays.reshape(-1, 3).astype(np.float64)
    reach = 4.0 / np.maximum(rays[:, 0], 1e-6)
    with np.errstate(divide="ignore"):
        reach = np.minimum(reach, np.where(rays[:, 2] < 0, -height_m / rays[:, 2], np.inf))
        for x0, x1, y0, y1, top in boxes:
            low, high = np.array([x0, y0, -height_m]), np.array([x1, y1, top - height_m])
            near, far = low / rays, high / rays
            enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            reach = np.where((enter < leave) & (enter > 0), np.minimum(reach, enter), reach)
    spread = 1.0 + np.random.default_rng(0).normal(0.0, noise_m, len(reach)) / np.maximum(reach, 0.3)
    return np.asarray(rays * (reach * spread)[:, None])


@pytest.mark.parametrize("pitch_deg", [10.0, 20.0, 40.0])
@pytest.mark.parametrize("height_m", [0.3, 1.0, 1.6])
def test_the_floor_of_an_empty_room(height_m: float, pitch_deg: float) -> None:
    """Within a centimetre, whatever the camera's height and pitch."""
    found = floor_height(room_points(height_m, math.radians(pitch_deg), []))
    assert found == pytest.approx(-height_m, abs=0.01)


def test_a_table_is_not_the_floor() -> None:
    """A table that fills most of the view loses against a strip of floor beside it."""
    points = room_points(1.4, 0.6, [(0.4, 2.2, -0.6, 3.0, 0.75)])
    heights = points[:, 2] + 1.4
    assert (np.abs(heights - 0.75) < 0.03).sum() > 3 * (np.abs(heights) < 0.03).sum() > 0
    assert floor_height(points) == pytest.approx(-1.4, abs=0.01)


def test_a_table_above_hidden_floor_is_no_floor() -> None:
    """With lower things in view beyond its edge, a table alone proves nothing."""
    points = room_points(1.4, 0.6, [(0.4, 2.2, -3.0, 3.0, 0.75)])
    points = points[points[:, 2] > -1.25]  # legs and chairs remain below the table, the floor does not
    assert floor_height(points) is None


def test_no_floor_in_a_wall() -> None:
    """A camera that looks at a wall, up, or nowhere."""
    wall = room_points(1.0, 0.0, [])
    assert floor_height(wall[wall[:, 2] > -0.5]) is None
    assert floor_height(room_points(1.0, -0.6, [])) is None
    assert floor_height(np.full((500, 3), np.nan)) is None
    assert floor_height(np.zeros((0, 3))) is None


def test_the_tracker_holds_through_gaps_and_jumps() -> None:
    """Not seen, or a counter top instead: the height is held and said to be."""
    tracker = FloorTracker()
    assert tracker.update(0, None) == (None, None)
    assert tracker.update(SECOND, -1.20) == (1.20, "floor")
    assert tracker.update(2 * SECOND, None) == (1.20, "held")
    assert tracker.update(3 * SECOND, -0.35) == (1.20, "held")
    height, source = tracker.update(4 * SECOND, -1.30)
    assert source == "floor"
    assert height == pytest.approx(1.27)


def test_the_tracker_corrects_a_wrong_start() -> None:
    """A log that begins over a table: the floor, once seen three times, replaces it."""
    tracker = FloorTracker()
    heights = [tracker.update(i * SECOND, floor)[0] for i, floor in enumerate([-0.5, -0.5, -1.2, -1.21, -1.22, -1.2])]
    assert heights[:4] == [0.5, 0.5, 0.5, 0.5]
    assert heights[4] == 1.22
    height, source = tracker.update(6 * SECOND, -0.5)
    assert source == "held"
    assert height == pytest.approx(1.206)


def test_a_camera_that_was_lowered_is_believed_in_the_end() -> None:
    """A higher floor must last; a table now and then never adds up to it."""
    tracker = FloorTracker()
    tracker.update(0, -1.5)
    assert [tracker.update(i * SECOND, -0.7).source for i in range(1, 31)] == ["held"] * 30
    assert tracker.update(31 * SECOND, -0.7) == (0.7, "floor")
    for i in range(40):
        assert tracker.update((40 + 2 * i) * SECOND, -0.1).source == "held"
        assert tracker.update((41 + 2 * i) * SECOND, -0.7).source == "floor"


class Kitchen:
    """Recorded by hand-held camera; truth from the recording's own tracker."""

    def __init__(self, path: Path) -> None:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        self.gravity, self.truth = GravityFilter(), PoseTrack()
        self.depth: list[tuple[int, NDArray[np.uint16]]] = []
        with path.open("rb") as stream:
            for _, channel, _, message in make_reader(
                stream, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages(
                topics=["/imu/data_raw", "/ground_truth/pose", "/camera/depth/image_raw/compressedDepth"]
            ):
                self._take(channel.topic, message)

    def _take(self, topic: str, message: Any) -> None:
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if topic.startswith("/imu"):
            rate, force = message.angular_velocity, message.linear_acceleration
            self.gravity.add(stamp, (rate.x, rate.y, rate.z), (force.x, force.y, force.z))
        elif topic.startswith("/ground_truth"):
            p, q = message.pose.position, message.pose.orientation
            self.truth.add(stamp, matrix_from_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))
        else:
            image = cv2.imdecode(np.frombuffer(message.data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
            self.depth.append((stamp, np.asarray(image, np.uint16)))

    def levelled_points(self, image: NDArray[np.uint16], up: Vector) -> Vector:
        depth = image[2::4, 2::4].astype(np.float32) * np.float32(1e-3)
        depth[depth > 10.0] = 0.0
        level = np.eye(4)
        level[:3, :3] = level_rotation(up)
        points = points_in_robot(depth, 585 / 4, 585 / 4, 318 / 4, 238 / 4, level @ FLU_FROM_OPTICAL)
        return points.reshape(-1, 3).astype(np.float64)


@pytest.fixture(scope="module")
def kitchen() -> Kitchen:
    folder = os.environ.get("SEMSLAM_TEST_DATA")
    if not folder:
        pytest.skip("set SEMSLAM_TEST_DATA to the folder with logs/redkitchen.mcap")
    return Kitchen(Path(folder) / "logs" / "redkitchen.mcap")


def test_up_in_a_real_hand(kitchen: Kitchen) -> None:
    """Mean tilt error below 0.6 degrees over a walk through a kitchen, none above 1.5."""
    errors = []
    for stamp, _ in kitchen.depth:
        world_from_body = kitchen.truth.at(stamp, SECOND)
        if world_from_body is not None:
            errors.append(tilt_deg(kitchen.gravity.up_at(stamp), world_from_body[2, :3]))
    assert len(errors) > 90
    assert float(np.mean(errors)) < 0.6
    assert max(errors) < 1.5


def test_floor_under_a_real_hand(kitchen: Kitchen) -> None:
    """The tracked height follows the true one, up to its constant, within 6 cm (one sigma); the table never wins."""
    tracker, differences = FloorTracker(), []
    for stamp, image in kitchen.depth:
        up, world_from_body = kitchen.gravity.up_at(stamp), kitchen.truth.at(stamp, SECOND)
        assert up is not None
        height, _ = tracker.update(stamp, floor_height(kitchen.levelled_points(image, up)))
        assert height is not None
        if world_from_body is not None:
            differences.append(height - float(world_from_body[2, 3]))
    assert float(np.std(differences)) < 0.06
    assert float(np.abs(np.array(differences) - np.median(differences)).max()) < 0.3  # the table is 0.75 m high
