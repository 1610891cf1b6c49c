"""Topics are guessed as a roboticist would, and every guess can be overridden."""

from __future__ import annotations

import pytest

from semslam.errors import SemslamError, UsageError
from semslam.logs.channels import Channel
from semslam.logs.images import _COLOURS
from semslam.logs.messages import CameraInfo, CompressedImage, Image, Imu, Message, Odometry, Pose
from semslam.logs.roles import TopicSeen, choose_roles, describe_topics

EYE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ORIGIN, LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def seen(topic: str, kind: str, message: Message | None, messages: int = 10, refusal: str | None = None) -> TopicSeen:
    return TopicSeen(Channel(topic, f"test/{kind}", "ros2msg", b"", "cdr", {}), messages, kind, message, refusal)


def image(topic: str, encoding: str, frame: str = "color", messages: int = 10) -> TopicSeen:
    return seen(topic, "image", Image(0, frame, 1, 1, encoding, 3, False, b"123"), messages)


def compressed(topic: str, form: str, frame: str = "color") -> TopicSeen:
    return seen(topic, "compressed_image", CompressedImage(0, frame, form, b""))


def info(topic: str, frame: str) -> TopicSeen:
    return seen(topic, "camera_info", CameraInfo(0, frame, 640, 480, "plumb_bob", (), EYE, EYE, (0.0,) * 12))


def guess(*topics: TopicSeen, **overrides: str) -> dict[str, str]:
    """Topic by role."""
    return {role: t.channel.topic for role, t in choose_roles(topics, overrides).topics.items()}


def test_a_realsense_log() -> None:
    """Colour, aligned depth before raw depth, each with its own calibration; infrared is nothing."""
    found = guess(
        image("/camera/color/image_raw", "rgb8"),
        image("/camera/depth/image_rect_raw", "16UC1", "depth"),
        image("/camera/aligned_depth_to_color/image_raw", "16UC1", "color"),
        image("/camera/infra1/image_rect_raw", "mono8", "infra1"),
        info("/camera/color/camera_info", "color"),
        info("/camera/depth/camera_info", "depth"),
        info("/camera/aligned_depth_to_color/camera_info", "color"),
        info("/camera/infra1/camera_info", "infra1"),
    )
    assert found == {
        "colour": "/camera/color/image_raw",
        "depth": "/camera/aligned_depth_to_color/image_raw",
        "colour_info": "/camera/color/camera_info",
        "depth_info": "/camera/aligned_depth_to_color/camera_info",
    }


def test_compressed_topics() -> None:
    """compressedDepth is depth whatever its name, a JPEG is colour."""
    found = guess(
        compressed("/rgb/image/compressed", "rgb8; jpeg compressed bgr8"),
        compressed("/sensor/image/compressedDepth", "16UC1; compressedDepth png", "depth"),
    )
    assert found["colour"] == "/rgb/image/compressed"
    assert found["depth"] == "/sensor/image/compressedDepth"


def test_pictures_for_people_are_not_taken() -> None:
    """Debug overlays and masks lose against the camera, however many there are."""
    found = guess(
        image("/detector/debug_image", "rgb8", messages=1000),
        image("/front/rgb/image", "bgr8"),
        image("/segmentation/mask", "mono8", messages=1000),
    )
    assert found["colour"] == "/front/rgb/image"


def test_silent_and_refused_topics_are_not_taken() -> None:
    """A topic without messages, or one that cannot be decoded, plays no role."""
    dead = image("/a/color/image", "rgb8", messages=0)
    refused = seen("/b/color/image", "image", None, refusal="schema encoding ros2idl")
    assert "colour" not in guess(dead, refused)


def test_truth_calls_itself_so() -> None:
    """Odometry named ground truth is truth; a pose of anything else is nothing."""
    found = guess(
        seen("/odom", "odometry", Odometry(0, "odom", "base_link", ORIGIN, LEVEL)),
        seen("/ground_truth/odom", "odometry", Odometry(0, "world", "base_link", ORIGIN, LEVEL), 9999),
        seen("/goal_pose", "pose", Pose(0, "map", ORIGIN, LEVEL)),
        seen("/imu/data", "imu", Imu(0, "imu", ORIGIN, ORIGIN, None)),
    )
    assert found == {"odometry": "/odom", "truth": "/ground_truth/odom", "imu": "/imu/data"}


def test_equal_topics_are_chosen_by_name() -> None:
    """The choice does not depend on the order in which topics stand in the file."""
    one, other = image("/left/rgb/image", "rgb8"), image("/right/rgb/image", "rgb8")
    assert guess(one, other) == guess(other, one)
    imus = [seen(topic, "imu", Imu(0, "imu", ORIGIN, ORIGIN, None)) for topic in ("/imu/data", "/imu")]
    assert guess(*imus)["imu"] == "/imu"


@pytest.mark.parametrize("encoding", sorted(_COLOURS))
def test_every_colour_encoding_that_is_decoded_is_found(encoding: str) -> None:
    """Raw Bayer and YUV cameras too, but the driver's RGB picture of the same camera comes first."""
    assert guess(image("/cam/image_raw", encoding))["colour"] == "/cam/image_raw"
    if encoding.startswith(("bayer", "yu", "uy")):
        both = image("/cam/image_raw", encoding, messages=11), image("/cam/image_rect", "rgb8")
        assert guess(*both)["colour"] == "/cam/image_rect"


@pytest.mark.parametrize("frame", ["front", ""])
def test_of_two_cameras_the_calibrated_one_is_taken(frame: str) -> None:
    """Whatever the other is called and however much it sends; its calibration may say so by place or by frame."""
    webcam = image("/a_webcam/rgb/image", "rgb8", "webcam", messages=999)
    front = image("/robot/front/image_raw", "rgb8", "front")
    calibration = info("/front_info" if frame else "/robot/front/camera_info", frame)
    assert guess(webcam, front, calibration)["colour"] == "/robot/front/image_raw"


def test_of_two_cameras_the_one_with_depth_is_taken() -> None:
    """Depth in its frame, or beside it in the tree of names."""
    front, rear = image("/robot/front/rgb", "rgb8", "front"), image("/robot/rear/rgb", "rgb8", "rear", messages=999)
    calibrations = info("/robot/front/info", "front"), info("/robot/rear/info", "rear")
    for depth in (image("/depths/one", "16UC1", "front"), image("/robot/front/depth", "16UC1", "tof")):
        assert guess(front, rear, *calibrations, depth)["colour"] == "/robot/front/rgb"


def test_override() -> None:
    """A named topic is taken, whatever the guess would be."""
    topics = image("/a/rgb", "rgb8"), image("/b/mono", "mono8")
    assert guess(*topics, colour="/b/mono")["colour"] == "/b/mono"


def test_wrong_overrides_say_what_is_there() -> None:
    """An unknown role, a missing topic, an unsuitable type and an unreadable one: four clear errors."""
    topics = image("/a/rgb", "rgb8"), info("/a/info", "a"), seen("/x", "image", None, refusal="CDR of XCDR2")
    with pytest.raises(UsageError, match="`color`") as role:
        guess(*topics, color="/a/rgb")
    assert "colour" in role.value.hint
    with pytest.raises(SemslamError, match="/nowhere") as missing:
        guess(*topics, colour="/nowhere")
    assert "/a/info" in missing.value.details
    with pytest.raises(SemslamError, match="test/camera_info"):
        guess(*topics, colour="/a/info")
    with pytest.raises(SemslamError, match="XCDR2"):
        guess(*topics, colour="/x")


def test_many_topics_are_told_briefly() -> None:
    """Ten thousand topics do not flood the terminal."""
    short = describe_topics([image("/a", "rgb8"), compressed("/b", "jpeg"), info("/c", "")])
    assert "test/image (rgb8)" in short
    assert "test/compressed_image (jpeg)" in short
    text = describe_topics([image(f"/t{i}", "rgb8") for i in range(10_000)])
    assert "10000 topics" in text
    assert len(text.splitlines()) < 50
