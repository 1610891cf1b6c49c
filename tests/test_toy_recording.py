"""The recorded log: an ordinary ROS 2 log that says what the simulator knows."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from semslam.geometry.camera import Camera
from semslam.geometry.frames import matrix_from_pose
from semslam.logs.decode import decoder_for
from semslam.logs.images import decode_colour, decode_depth
from semslam.logs.messages import CompressedImage, Image, Message, Odometry, Pose, Transforms
from semslam.logs.reader import LogReader
from tests.make_log import make_log
from tests.toy.recording import Plan, record
from tests.toy.render import Renderer

COLOUR, DEPTH = "/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth"


def official(path: Path) -> dict[str, list[Any]]:
    """Messages by topic as the official MCAP and ROS 2 packages read them."""
    found = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found[channel.topic].append(message)
    return found


def ours(path: Path) -> dict[str, list[Message]]:
    """Messages by topic as semslam reads them."""
    found: dict[str, list[Message]] = defaultdict(list)
    reader = LogReader([path])
    for raw in reader.messages(lambda _: True):
        found[raw.channel.topic].append(decoder_for(raw.channel)(raw.data))
    assert reader.losses.state == "ok"
    return found


def test_the_same_plan_gives_the_same_bytes(tmp_path: Path) -> None:
    """Recorded twice, equal; another seed, another log."""
    first, again, other = (make_log(tmp_path / f"{n}.mcap", frames=2, seed=n // 2) for n in (0, 1, 2))
    assert first.path.read_bytes() == again.path.read_bytes()
    assert first.path.read_bytes() != other.path.read_bytes()


def test_other_software_reads_the_log(tmp_path: Path) -> None:
    """The official decoder finds every topic, at its rate, in the order of log time."""
    log = make_log(tmp_path / "log.mcap", frames=3, rate_hz=2.0)
    found = official(log.path)
    counts = {topic: len(messages) for topic, messages in found.items()}
    span = 1.4
    assert counts == {
        "/tf_static": 1,
        "/imu/data_raw": pytest.approx(span * 100, abs=1),
        "/odom": pytest.approx(span * 50, abs=1),
        "/ground_truth/pose": pytest.approx(span * 50, abs=1),
        **dict.fromkeys((COLOUR, DEPTH, "/camera/color/camera_info", "/camera/depth/camera_info"), 3),
    }
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in found[COLOUR]]
    assert tuple(stamps) == log.stamps_nanos
    picture: Any = cv2.imdecode(np.frombuffer(found[COLOUR][0].data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (120, 160, 3)


def test_nothing_in_the_log_says_simulated(tmp_path: Path) -> None:
    """Names of topics, frames and the file header are those of any robot."""
    log = make_log(tmp_path / "log.mcap", frames=1)
    content = log.path.read_bytes().lower()
    for found in official(log.path).values():
        content += "".join(str(getattr(message, "header", "")) for message in found[:1]).lower().encode()
    assert not [word for word in (b"simul", b"toy", b"gazebo", b"synthetic") if word in content]


def test_a_stamp_is_earlier_than_its_log_time(tmp_path: Path) -> None:
    """Sensors have a latency, and log time never runs backwards."""
    log = make_log(tmp_path / "log.mcap", frames=2)
    times, late = [], []
    with log.path.open("rb") as stream:
        for _, _, raw, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
            log_time_order=False
        ):
            times.append(raw.log_time)
            if hasattr(message, "header"):
                late.append(raw.log_time - message.header.stamp.sec * 10**9 - message.header.stamp.nanosec)
    assert times == sorted(times)
    assert 0 < min(late) < max(late) < 50_000_000


@pytest.mark.parametrize("depth", ["png", "rvl", "raw16", "raw32"])
@pytest.mark.parametrize("compressed", [True, False])
def test_every_encoding_carries_the_same_picture(tmp_path: Path, depth: str, compressed: bool) -> None:
    """Without noise, depth is the renderer's to half a millimetre, and colour what JPEG leaves of it."""
    log = make_log(tmp_path / "log.mcap", frames=1, depth=depth, compressed=compressed, noise=False)
    view = Renderer(log.room).view(log.colour_camera, room_from_base(log.poses[0]) @ log.base_from_camera)
    pictures = [m for messages in ours(log.path).values() for m in messages if isinstance(m, Image | CompressedImage)]
    colour, depth_m = decode_colour(pictures[0]), decode_depth(pictures[1])
    assert np.nan_to_num(depth_m) == pytest.approx(view.depth_m, abs=0.00051)
    error = np.abs(colour.astype(int) - view.rgb).mean()
    assert error < 4 if compressed else error == 0


def room_from_base(pose: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """4x4 from x, y, heading."""
    return matrix_from_pose((pose[0], pose[1], 0.0), (0.0, 0.0, math.sin(pose[2] / 2), math.cos(pose[2] / 2)))


def test_the_true_pose_topic_agrees_with_the_factory(tmp_path: Path) -> None:
    """At every image stamp there is a pose, and it is the one the picture was taken from."""
    log = make_log(tmp_path / "log.mcap", frames=3)
    poses = {m.stamp_nanos: m for m in ours(log.path)["/ground_truth/pose"] if isinstance(m, Pose)}
    for stamp, (x, y, heading) in zip(log.stamps_nanos, log.poses, strict=True):
        pose = poses[stamp]
        assert pose.position == pytest.approx((x, y, 0.0))
        assert 2 * math.atan2(pose.orientation[2], pose.orientation[3]) == pytest.approx(heading)


def test_wheels_without_noise_follow_the_truth(tmp_path: Path) -> None:
    """Odometry is the true motion seen from its own start."""
    log = make_log(tmp_path / "log.mcap", frames=3, noise=False)
    found = ours(log.path)
    first = found["/ground_truth/pose"][0]
    for wheels, truth in zip(found["/odom"], found["/ground_truth/pose"], strict=True):
        assert isinstance(wheels, Odometry)
        assert isinstance(truth, Pose)
        assert isinstance(first, Pose)
        moved = np.linalg.inv(matrix_from_pose(first.position, first.orientation)) @ matrix_from_pose(
            truth.position, truth.orientation
        )
        assert matrix_from_pose(wheels.position, wheels.orientation) == pytest.approx(moved, abs=1e-9)


def test_static_transforms_lead_to_both_cameras(tmp_path: Path) -> None:
    """base_link to camera_link to the optical frames: the same as the truth says, offset and pitch included."""
    offset = (0.01, 0.03, -0.02)
    log = make_log(tmp_path / "log.mcap", frames=1, pitch_rad=0.5, height_m=0.7, depth_camera_offset=offset)
    (message,) = ours(log.path)["/tf_static"]
    assert isinstance(message, Transforms)
    links = {link.child: matrix_from_pose(link.translation, link.orientation) for link in message.transforms}
    assert [link.parent for link in message.transforms] == ["base_link", "camera_link", "camera_link", "base_link"]
    colour = links["camera_link"] @ links["camera_color_optical_frame"]
    depth = links["camera_link"] @ links["camera_depth_optical_frame"]
    assert colour == pytest.approx(log.base_from_camera)
    assert depth == pytest.approx(log.base_from_depth)
    assert colour[2, 3] == pytest.approx(0.7)
    assert math.asin(-colour[2, 2]) == pytest.approx(0.5)
    assert np.linalg.inv(colour) @ depth[:, 3] == pytest.approx((-0.03, 0.02, 0.01, 1.0))


def test_an_offset_depth_camera_sees_the_same_room(tmp_path: Path) -> None:
    """Its points, carried through the transforms into the colour picture, have the depth that colour pixels have."""
    log = make_log(tmp_path / "log.mcap", frames=1, depth_camera_offset=(0.0, 0.03, 0.0), noise=False)
    (message,) = ours(log.path)[DEPTH]
    assert isinstance(message, CompressedImage)
    assert message.frame_id == "camera_depth_optical_frame"
    points = rays(log.depth_camera) * decode_depth(message)[..., None]
    colour_from_depth = np.linalg.inv(log.base_from_camera) @ log.base_from_depth
    moved = points.reshape(-1, 3) @ colour_from_depth[:3, :3].T + colour_from_depth[:3, 3]
    view = Renderer(log.room).view(log.colour_camera, room_from_base(log.poses[0]) @ log.base_from_camera)
    u = np.round(moved[:, 0] / moved[:, 2] * log.colour_camera.fx + log.colour_camera.cx).astype(int)
    v = np.round(moved[:, 1] / moved[:, 2] * log.colour_camera.fy + log.colour_camera.cy).astype(int)
    inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
    difference = np.abs(view.depth_m[v[inside], u[inside]] - moved[inside, 2])
    assert inside.mean() > 0.7
    assert np.median(difference) < 0.01
    assert (difference < 0.1).mean() > 0.9


def rays(camera: Camera) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(H, W, 3) with z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def test_what_is_left_out_is_left_out_and_changes_nothing_else(tmp_path: Path) -> None:
    """Sensors are independent: without IMU, wheels and truth the pictures are the same, bit for bit."""
    full, bare = (
        make_log(tmp_path / "full.mcap"),
        make_log(tmp_path / "bare.mcap", imu=False, odometry=False, tf=False, truth=False),
    )
    everything, rest = ours(full.path), ours(bare.path)
    assert set(everything) - set(rest) == {"/imu/data_raw", "/odom", "/tf_static", "/ground_truth/pose"}
    assert all(rest[topic] == everything[topic] for topic in (COLOUR, DEPTH))


def test_without_transforms_the_imu_has_the_axes_of_the_camera(tmp_path: Path) -> None:
    """A hand-held camera looking 30 degrees down feels gravity between up and backwards."""
    log = make_log(tmp_path / "log.mcap", tf=False, pitch_rad=math.radians(30))
    samples = official(log.path)["/imu/data_raw"]
    assert {sample.header.frame_id for sample in samples} == {"camera_color_optical_frame"}
    up = np.mean([(s.linear_acceleration.y, s.linear_acceleration.z) for s in samples], axis=0)
    assert math.degrees(math.atan2(-up[1], -up[0])) == pytest.approx(30, abs=2)


def test_an_impossible_plan_is_refused(tmp_path: Path) -> None:
    """No frames, or an encoding nobody knows: nothing is written."""
    for plan in (Plan(frames=0), Plan(depth="jpeg")):
        with pytest.raises(ValueError, match="no recording"):
            record(tmp_path / "log.mcap", plan)
    assert list(tmp_path.iterdir()) == []
