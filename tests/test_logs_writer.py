"""Logs that are written hold what was given, for every reader, and appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from semslam.logs.cdr import ros2_type, serialise
from semslam.logs.channels import Channel
from semslam.logs.decode import decoder_for
from semslam.logs.images import decode_colour, decode_depth
from semslam.logs.messages import (
    CameraInfo,
    CompressedImage,
    Image,
    Imu,
    Message,
    Odometry,
    Pose,
    Transform,
    Transforms,
)
from semslam.logs.ros2_schemas import ros2_schema
from semslam.logs.writer import (
    JPEG_FORMAT,
    PNG_DEPTH_FORMAT,
    RVL_DEPTH_FORMAT,
    LogWriteError,
    Ros2LogWriter,
    encode_jpeg,
    encode_png_depth,
    encode_rvl_depth,
)

STAMP = 1_700_000_000_123_456_789
TURN = (0.0, 0.0, 0.6, 0.8)
K = (525.0, 0.0, 320.0, 0.0, 525.0, 240.0, 0.0, 0.0, 1.0)
R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
P = (525.0, 0.0, 320.0, 0.0, 0.0, 525.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0)

MESSAGES: dict[str, Message] = {
    "/image": Image(STAMP, "camera", 2, 3, "mono8", 4, False, bytes(range(8))),
    "/compressed": CompressedImage(STAMP, "camera", "jpeg", b"\xff\xd8\xff"),
    "/info": CameraInfo(STAMP, "camera", 640, 480, "plumb_bob", (0.1, -0.2, 0.0, 0.0, 0.3), K, R, P),
    "/ideal_info": CameraInfo(STAMP, "camera", 640, 480, "", (), K, R, P),
    "/imu": Imu(STAMP, "imu_link", (0.1, -0.2, 0.3), (0.0, 0.5, 9.81), None),
    "/ahrs": Imu(STAMP, "imu_link", (0.1, -0.2, 0.3), (0.0, 0.5, 9.81), TURN),
    "/odom": Odometry(STAMP, "odom", "base_link", (1.0, 2.0, 0.5), TURN),
    "/pose": Pose(STAMP, "map", (1.0, -2.0, 0.0), TURN),
    "/tf": Transforms((Transform(STAMP, "odom", "base_link", (1.0, 2.0, 3.0), TURN),)),
    "/tf_static": Transforms(()),
}


def write_all(path: Path, **options: Any) -> None:
    with Ros2LogWriter(path, **options) as log:
        for number, (topic, message) in enumerate(MESSAGES.items()):
            log.write(topic, message, STAMP + number, STAMP)


def decoder_of(schema: Schema, topic: str, encoding: str) -> Any:
    return decoder_for(Channel(topic, schema.name, schema.encoding, schema.data, encoding, {}))


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_written_log_reads_back_as_it_was_given(tmp_path: Path, compression: Literal["zstd", "lz4", "none"]) -> None:
    """By this package, with the schemas in the log, under every compression."""
    write_all(tmp_path / "log.mcap", compression=compression)
    with (tmp_path / "log.mcap").open("rb") as stream:
        records = list(make_reader(stream, validate_crcs=True).iter_messages())
    read = {c.topic: decoder_of(s, c.topic, c.message_encoding)(m.data) for s, c, m in records if s is not None}
    assert read == MESSAGES
    assert [m.log_time - STAMP for _, _, m in records] == list(range(len(MESSAGES)))
    assert {m.publish_time for _, _, m in records} == {STAMP}


def test_a_written_log_means_the_same_to_the_official_decoder(tmp_path: Path) -> None:
    """Spot values of every type, by names from the schemas in the log."""
    write_all(tmp_path / "log.mcap")
    with (tmp_path / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        read = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    assert list(read) == list(MESSAGES)
    for topic, message in read.items():
        if not topic.startswith("/tf"):
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == STAMP
    assert (read["/image"].height, read["/image"].width, read["/image"].step) == (2, 3, 4)
    assert bytes(read["/image"].data) == bytes(range(8))
    assert (read["/compressed"].format, bytes(read["/compressed"].data)) == ("jpeg", b"\xff\xd8\xff")
    info = read["/info"]
    assert (info.d, info.k, info.r, info.p) == ([0.1, -0.2, 0.0, 0.0, 0.3], list(K), list(R), list(P))
    assert (info.binning_x, info.roi.width, info.roi.do_rectify) == (0, 0, False)
    assert (read["/ideal_info"].d, read["/ideal_info"].distortion_model) == ([], "")
    assert read["/imu"].orientation_covariance == [-1.0] + [0.0] * 8
    assert (read["/imu"].linear_acceleration.z, read["/imu"].angular_velocity.y) == (9.81, -0.2)
    assert (read["/ahrs"].orientation_covariance[0], read["/ahrs"].orientation.z) == (0.0, 0.6)
    assert (read["/odom"].child_frame_id, read["/odom"].pose.pose.position.y) == ("base_link", 2.0)
    assert read["/odom"].twist.covariance == [0.0] * 36
    assert (read["/pose"].header.frame_id, read["/pose"].pose.orientation.w) == ("map", 0.8)
    [transform] = read["/tf"].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    assert (transform.transform.translation.z, transform.transform.rotation.z) == (3.0, 0.6)
    assert read["/tf_static"].transforms == []


names = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=9)
numbers = st.floats(allow_nan=False)
stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
vectors = st.tuples(numbers, numbers, numbers)
turns = st.tuples(numbers, numbers, numbers, numbers)
transforms = st.builds(Transform, stamps, names, names, vectors, turns)
sizes = st.integers(0, 2**32 - 1)
any_message = st.one_of(
    st.builds(Image, stamps, names, sizes, sizes, names, sizes, st.booleans(), st.binary(max_size=20)),
    st.builds(CompressedImage, stamps, names, names, st.binary(max_size=20)),
    st.builds(
        CameraInfo,
        stamps,
        names,
        sizes,
        sizes,
        names,
        st.lists(numbers, max_size=8).map(tuple),
        st.tuples(*[numbers] * 9),
        st.tuples(*[numbers] * 9),
        st.tuples(*[numbers] * 12),
    ),
    st.builds(Imu, stamps, names, vectors, vectors, st.none() | turns.filter(any)),
    st.builds(Odometry, stamps, names, names, vectors, turns),
    st.builds(Pose, stamps, names, vectors, turns),
    st.builds(Transforms, st.lists(transforms, max_size=3).map(tuple)),
)


@given(any_message)
@settings(max_examples=150, deadline=None)
def test_any_message_survives_serialising_and_decoding(message: Message) -> None:
    """Whatever its names, numbers and lengths, which move everything behind them."""
    name = ros2_type(message)
    assert decoder_for(Channel("/t", name, "ros2msg", ros2_schema(name), "cdr", {}))(serialise(message)) == message


def test_a_single_transform_is_a_transform_stamped(tmp_path: Path) -> None:
    """Some drivers publish transforms outside /tf."""
    transform = Transform(STAMP, "base_link", "camera", (0.1, 0.2, 0.3), TURN)
    with Ros2LogWriter(tmp_path / "log.mcap") as log:
        log.write("/mount", transform, STAMP)
    with (tmp_path / "log.mcap").open("rb") as stream:
        [(schema, channel, message)] = make_reader(stream).iter_messages()
    assert schema is not None
    assert schema.name == "geometry_msgs/msg/TransformStamped"
    assert message.publish_time == STAMP
    assert decoder_of(schema, channel.topic, channel.message_encoding)(message.data) == Transforms((transform,))


def test_the_same_messages_give_the_same_bytes(tmp_path: Path) -> None:
    """No clock, no process id, no order of a set reaches the file."""
    write_all(tmp_path / "a.mcap")
    write_all(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_messages_of_a_topic_are_numbered_and_chunks_are_closed(tmp_path: Path) -> None:
    """Sequence numbers count each topic; `chunk_bytes` bounds a chunk."""
    with Ros2LogWriter(tmp_path / "log.mcap", chunk_bytes=2000, library="test") as log:
        for number in range(30):
            log.write("/imu", MESSAGES["/imu"], number)
            log.write("/pose", MESSAGES["/pose"], number)
    with (tmp_path / "log.mcap").open("rb") as stream:
        reader = make_reader(stream)
        sequences = [message.sequence for _, channel, message in reader.iter_messages() if channel.topic == "/pose"]
        summary = reader.get_summary()
        assert reader.get_header().library == "test"
    assert sequences == list(range(30))
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.chunk_count > 5


def test_a_log_that_fails_half_way_does_not_appear(tmp_path: Path) -> None:
    """The old log of that name stays, and nothing else is left behind."""
    path = tmp_path / "log.mcap"
    path.write_bytes(b"the old log")

    def fail() -> None:
        with Ros2LogWriter(path) as log:
            log.write("/imu", MESSAGES["/imu"], STAMP)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert path.read_bytes() == b"the old log"
    assert os.listdir(tmp_path) == ["log.mcap"]


def test_a_log_appears_under_its_name_only_when_it_is_whole(tmp_path: Path) -> None:
    """While it is written, the folder holds a hidden file only."""
    path = tmp_path / "log.mcap"
    with Ros2LogWriter(path) as log:
        log.write("/imu", MESSAGES["/imu"], STAMP)
        assert not path.exists()
        assert all(name.startswith(".") for name in os.listdir(tmp_path))
    assert os.listdir(tmp_path) == ["log.mcap"]


def test_misuse_is_refused_with_what_to_do(tmp_path: Path) -> None:
    """Two types on a topic, a missing folder, an unknown compression, numbers that do not fit, a closed log."""
    with pytest.raises(LogWriteError, match=r"missing.*log.mcap"), Ros2LogWriter(tmp_path / "missing" / "log.mcap"):
        pass
    with pytest.raises(LogWriteError, match="`gzip`"):
        Ros2LogWriter(tmp_path / "log.mcap", compression="gzip")  # type: ignore[arg-type]
    with Ros2LogWriter(tmp_path / "log.mcap") as log:
        log.write("/imu", MESSAGES["/imu"], STAMP)
        with pytest.raises(LogWriteError, match=r"`/imu` carries `sensor_msgs/msg/Imu`") as caught:
            log.write("/imu", MESSAGES["/pose"], STAMP)
        assert caught.value.hint
        with pytest.raises(LogWriteError, match="does not fit"):
            log.write("/late", Pose(2**31 * 10**9, "map", (0.0, 0.0, 0.0), TURN), STAMP)
        with pytest.raises(LogWriteError, match="does not fit"):
            log.write("/early", MESSAGES["/pose"], -1)
        log.write("/imu", MESSAGES["/imu"], STAMP)
    with pytest.raises(LogWriteError, match="is not open"):
        log.write("/imu", MESSAGES["/imu"], STAMP)
    with (tmp_path / "log.mcap").open("rb") as stream:
        assert [channel.topic for _, channel, _ in make_reader(stream).iter_messages()] == ["/imu", "/imu"]


@pytest.mark.parametrize("name", sorted({ros2_type(message) for message in MESSAGES.values()}))
def test_schemas_define_every_type_that_they_use(name: str) -> None:
    """The official parser accepts each and reads a serialised message with it."""
    schema = Schema(id=1, name=name, encoding="ros2msg", data=ros2_schema(name))
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    message = next(message for message in MESSAGES.values() if ros2_type(message) == name)
    assert decode(serialise(message)) is not None
    text = ros2_schema(name).decode()
    assert text.count("MSG: std_msgs/Header") == text.count("MSG: builtin_interfaces/Time") == 1


def test_encoded_images_round_trip() -> None:
    """JPEG within its loss, PNG and RVL depth exactly, under the formats that go with them."""
    y, x = np.mgrid[:48, :64]
    rgb = np.stack([x * 4, y * 5, (x + y) * 2], axis=2).astype(np.uint8)
    colour = decode_colour(CompressedImage(0, "c", JPEG_FORMAT, encode_jpeg(rgb, 95)))
    assert np.abs(colour.astype(int) - rgb).mean() < 3
    depth_mm = (1000 + x * 10 + y).astype(np.uint16)
    depth_mm[:5] = 0
    for form, data in ((PNG_DEPTH_FORMAT, encode_png_depth(depth_mm)), (RVL_DEPTH_FORMAT, encode_rvl_depth(depth_mm))):
        depth = decode_depth(CompressedImage(0, "c", form, data))
        np.testing.assert_array_equal(np.rint(depth * 1000).astype(np.uint16), depth_mm)
