"""Messages come out of every encoding as they were sent, and damage comes out as one kind of error."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import struct
import time
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    FrameTransform_pb2,
    FrameTransforms_pb2,
    Odometry_pb2,
    Pose_pb2,
    PoseInFrame_pb2,
    Quaternion_pb2,
    RawImage_pb2,
    Vector3_pb2,
)
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import Writer as McapWriter
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros1.decoder import DecoderFactory as Ros1Factory
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2.decoder import DecoderFactory as Ros2Factory

from semslam.logs.channels import Channel
from semslam.logs.decode import DecodeError, UnsupportedChannelError, decoder_for, kind_of
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

STAMP = 1_700_000_000_123_456_789
SEC, NANOSEC = divmod(STAMP, 1_000_000_000)
K = (525.0, 0.0, 320.0, 0.0, 525.0, 240.0, 0.0, 0.0, 1.0)
R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
P = (525.0, 0.0, 320.0, 0.0, 0.0, 525.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0)
TURN = (0.0, 0.0, 0.6, 0.8)
FAST = settings(max_examples=40, deadline=None)

MESSAGES: dict[str, Message] = {
    "sensor_msgs/msg/Image": Image(STAMP, "camera", 2, 3, "mono8", 4, True, bytes(range(8))),
    "sensor_msgs/msg/CompressedImage": CompressedImage(STAMP, "camera", "jpeg", b"\xff\xd8\xff\x00\x01"),
    "sensor_msgs/msg/CameraInfo": CameraInfo(
        STAMP, "camera", 640, 480, "plumb_bob", (0.1, -0.2, 0.0, 0.0, 0.3), K, R, P
    ),
    "sensor_msgs/msg/Imu": Imu(STAMP, "imu_link", (0.1, -0.2, 0.3), (0.0, 0.5, 9.81), TURN),
    "nav_msgs/msg/Odometry": Odometry(STAMP, "odom", "base_link", (1.0, 2.0, 0.5), TURN),
    "geometry_msgs/msg/PoseStamped": Pose(STAMP, "map", (1.0, -2.0, 0.0), TURN),
    "geometry_msgs/msg/TransformStamped": Transforms((Transform(STAMP, "odom", "base", (0.1, 0.2, 0.3), TURN),)),
    "tf2_msgs/msg/TFMessage": Transforms(
        (
            Transform(STAMP, "odom", "base_link", (1.0, 2.0, 3.0), TURN),
            Transform(STAMP + 5, "base_link", "camera", (0.0, 0.0, 1.2), (0.5, -0.5, 0.5, -0.5)),
        )
    ),
}


class HandMadeCdr:
    """A second CDR serialiser, for either byte order, written from the specification for these tests only."""

    def __init__(self, order: str) -> None:
        self.order = order
        self.body = b""

    def put(self, code: str, *values: float) -> HandMadeCdr:
        for value in values:
            while len(self.body) % struct.calcsize(code):
                self.body += b"\x00"
            self.body += struct.pack(self.order + code, value)
        return self

    def text(self, value: str) -> HandMadeCdr:
        self.put("I", len(value.encode()) + 1)
        self.body += value.encode() + b"\x00"
        return self

    def blob(self, value: bytes) -> HandMadeCdr:
        self.put("I", len(value))
        self.body += value
        return self

    def header(self, stamp: int, frame: str) -> HandMadeCdr:
        return self.put("i", stamp // 10**9).put("I", stamp % 10**9).text(frame)

    def bytes(self) -> bytes:
        return (b"\x00\x01\x00\x00" if self.order == "<" else b"\x00\x00\x00\x00") + self.body


def hand_made(type_name: str, order: str) -> bytes:
    """`MESSAGES[type_name]` as CDR."""
    cdr, zeros = HandMadeCdr(order), [0.0] * 36
    match MESSAGES[type_name]:
        case Image(stamp, frame, height, width, encoding, step, big, data):
            cdr.header(stamp, frame).put("I", height, width).text(encoding).put("B", big).put("I", step).blob(data)
        case CompressedImage(stamp, frame, form, data):
            cdr.header(stamp, frame).text(form).blob(data)
        case CameraInfo(stamp, frame, width, height, model, distortion, k, r, p):
            cdr.header(stamp, frame).put("I", height, width).text(model).put("I", len(distortion)).put("d", *distortion)
            cdr.put("d", *k, *r, *p).put("I", 1, 1, 0, 0, 0, 0).put("B", 0)
        case Imu(stamp, frame, gyro, accel, orientation):
            assert orientation is not None
            cdr.header(stamp, frame).put("d", *orientation, *zeros[:9], *gyro, *zeros[:9], *accel, *zeros[:9])
        case Odometry(stamp, frame, child, position, orientation):
            cdr.header(stamp, frame).text(child).put("d", *position, *orientation, *zeros, *zeros[:6], *zeros)
        case Pose(stamp, frame, position, orientation):
            cdr.header(stamp, frame).put("d", *position, *orientation)
        case Transforms(transforms):
            if type_name.endswith("TFMessage"):
                cdr.put("I", len(transforms))
            for item in transforms:
                cdr.header(item.stamp_nanos, item.parent).text(item.child).put(
                    "d", *item.translation, *item.orientation
                )
    return cdr.bytes()


def ros2_channel(type_name: str, schema: bytes | None = None, **other: str) -> Channel:
    parts = {"schema_encoding": "ros2msg", "message_encoding": "cdr", **other}
    data = ros2_schema(type_name) if schema is None else schema
    return Channel("/topic", type_name, parts["schema_encoding"], data, parts["message_encoding"], {})


def imu_channel(schema: bytes | None = None, **other: str) -> Channel:
    return ros2_channel("sensor_msgs/msg/Imu", schema, **other)


def official_ros2(type_name: str, schema: bytes | None = None) -> Callable[[bytes], Any]:
    """The official decoder of a ROS 2 type."""
    data = ros2_schema(type_name) if schema is None else schema
    decode = Ros2Factory().decoder_for("cdr", Schema(id=1, name=type_name, encoding="ros2msg", data=data))
    assert decode is not None
    return decode


def channels_of(log: bytes) -> list[tuple[Channel, bytes]]:
    """Every message of a log with its channel, read by the official reader."""
    return [
        (
            Channel(
                c.topic, s.name if s else "", s.encoding if s else "", s.data if s else b"", c.message_encoding, {}
            ),
            m.data,
        )
        for s, c, m in make_reader(io.BytesIO(log)).iter_messages()
    ]


def same_fields(official: Any, ours: Message) -> None:
    """Compare with what an official ROS decoder returns."""
    if isinstance(ours, Transforms):
        items = getattr(official, "transforms", [official])
        assert len(items) == len(ours.transforms)
        for theirs, transform in zip(items, ours.transforms, strict=True):
            same_stamp(theirs.header, transform.stamp_nanos, transform.parent)
            assert theirs.child_frame_id == transform.child
            assert vector(theirs.transform.translation) == transform.translation
            assert quaternion(theirs.transform.rotation) == transform.orientation
        return
    same_stamp(official.header, ours.stamp_nanos, ours.frame_id)
    match ours:
        case Image():
            assert (official.height, official.width, official.step) == (ours.height, ours.width, ours.step)
            assert (official.encoding, bool(official.is_bigendian)) == (ours.encoding, ours.big_endian)
            assert bytes(official.data) == ours.data
        case CompressedImage():
            assert (official.format, bytes(official.data)) == (ours.format, ours.data)
        case CameraInfo():
            lower = {name.lower(): getattr(official, name) for name in official.__slots__}
            assert (lower["height"], lower["width"], lower["distortion_model"]) == (ours.height, ours.width, ours.model)
            assert [tuple(lower[name]) for name in "dkrp"] == [ours.distortion, ours.k, ours.r, ours.p]
        case Imu():
            assert vector(official.angular_velocity) == ours.gyro
            assert vector(official.linear_acceleration) == ours.accel
            assert ours.orientation is None or quaternion(official.orientation) == ours.orientation
        case Odometry():
            assert official.child_frame_id == ours.child_frame_id
            assert vector(official.pose.pose.position) == ours.position
            assert quaternion(official.pose.pose.orientation) == ours.orientation
        case Pose():
            assert vector(official.pose.position) == ours.position
            assert quaternion(official.pose.orientation) == ours.orientation


def same_stamp(header: Any, stamp_nanos: int, frame_id: str) -> None:
    sec = getattr(header.stamp, "sec", getattr(header.stamp, "secs", None))
    nanosec = getattr(header.stamp, "nanosec", getattr(header.stamp, "nsecs", None))
    assert (sec, nanosec) == divmod(stamp_nanos, 10**9)
    assert header.frame_id == frame_id


def vector(value: Any) -> tuple[float, ...]:
    return value.x, value.y, value.z


def quaternion(value: Any) -> tuple[float, ...]:
    return value.x, value.y, value.z, value.w


# --------------------------------------------------------------------------------------------------------- ROS 2


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("type_name", MESSAGES)
def test_cdr_bytes_written_by_hand_decode_as_sent(type_name: str, order: str) -> None:
    """Every ROS 2 type, in both byte orders, gives what was written and what the official decoder reads."""
    data = hand_made(type_name, order)
    ours = decoder_for(ros2_channel(type_name))(data)
    assert ours == MESSAGES[type_name]
    same_fields(official_ros2(type_name)(data), ours)


def test_imu_equals_the_official_decoder_for_any_frame_and_numbers() -> None:
    """The length of the frame id moves every number behind it, in all eight phases of alignment."""
    ours, official = decoder_for(imu_channel()), official_ros2("sensor_msgs/msg/Imu")
    zeros = [0.0] * 9

    @given(
        st.text(st.characters(codec="utf-8"), max_size=12),
        st.lists(st.floats(allow_nan=False), min_size=10, max_size=10),
        st.sampled_from("<>"),
    )
    @FAST
    def compare(frame: str, numbers: list[float], order: str) -> None:
        cdr = HandMadeCdr(order).header(STAMP, frame)
        data = cdr.put("d", *numbers[:4], *zeros, *numbers[4:7], *zeros, *numbers[7:], *zeros).bytes()
        same_fields(official(data), ours(data))

    compare()


def test_schemas_that_the_official_parser_refuses_are_read() -> None:
    """A default value may hold an equals sign, and a type name may be the full one with `msg`."""
    schema = b'string note "x=1"\nuint8 A=1\nuint8 B = 2\n' + ros2_schema("geometry_msgs/msg/PoseStamped")
    schema = schema.replace(b"std_msgs/Header header", b"std_msgs/msg/Header header")
    data = HandMadeCdr("<").text("note").header(STAMP, "map").put("d", 1.0, 2.0, 3.0, *TURN).bytes()
    pose = decoder_for(ros2_channel("geometry_msgs/msg/PoseStamped", schema))(data)
    assert pose == Pose(STAMP, "map", (1.0, 2.0, 3.0), TURN)


@pytest.mark.parametrize(
    ("orientation", "covariance", "expected"),
    [
        ((0.0, 0.0, 0.0, 1.0), 0.0, (0.0, 0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0, 1.0), -1.0, None),
        ((0.0, 0.0, 0.0, 0.0), 0.0, None),
    ],
)
def test_an_imu_without_an_orientation_says_so(
    orientation: tuple[float, ...], covariance: float, expected: tuple[float, ...] | None
) -> None:
    """A covariance of -1 and an all-zero quaternion both mean that there is no estimate."""
    cdr = HandMadeCdr("<").header(STAMP, "imu").put("d", *orientation, covariance, *[0.0] * 32)
    imu = decoder_for(imu_channel())(cdr.bytes())
    assert isinstance(imu, Imu)
    assert imu.orientation == expected


def test_fields_are_found_by_name_wherever_the_schema_of_a_log_has_them() -> None:
    """A recorder's own schema, with constants, comments, defaults, extra and moved fields, is what counts."""
    schema = (
        'uint8 VERSION=3 # not a field\r\nstring NAME = "a=b # c"\r\n\r\n# a comment\r\n'
        'string[] tags\nstring<=8 note "x"\nduration_msgs/Span[2] spans\ngeometry_msgs/Pose pose\n'
        "float32[<=4] weights\nstd_msgs/Header header\n"
        "================================================================================\n"
        "MSG: duration_msgs/Span\nuint16 ticks\nEmpty none\n"
        "================================================================================\nMSG: duration_msgs/Empty\n\n"
        "================================================================================\n"
        "MSG: geometry_msgs/Pose\nQuaternion orientation\nPoint position\n"
        "================================================================================\n"
        "MSG: geometry_msgs/Quaternion\nfloat64 w 1\nfloat64 x\nfloat64 y\nfloat64 z\n"
        "================================================================================\n"
        "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
        "================================================================================\n"
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    )
    cdr = HandMadeCdr("<").put("I", 2).text("a").text("bcd").text("note")
    cdr.put("H", 1).put("B", 0).put("H", 2).put("B", 0)  # two spans, each with an empty message of one byte
    cdr.put("d", 0.8, 0.0, 0.0, 0.6, 1.0, 2.0, 3.0).put("I", 1).put("f", 0.5).header(STAMP, "map")
    pose = decoder_for(ros2_channel("geometry_msgs/msg/PoseStamped", schema.encode()))(cdr.bytes())
    assert pose == Pose(STAMP, "map", (1.0, 2.0, 3.0), TURN)
    assert isinstance(pose, Pose)
    same_fields(official_ros2("geometry_msgs/msg/PoseStamped", schema.encode())(cdr.bytes()), pose)


def test_stamps_stay_exact_and_may_lie_before_1970() -> None:
    """Nanoseconds are integers: no stamp goes through a float."""
    cdr = HandMadeCdr("<").header(-999_999_999, "map").put("d", 0, 0, 0, 0, 0, 0, 1)
    pose = decoder_for(ros2_channel("geometry_msgs/msg/PoseStamped"))(cdr.bytes())
    assert isinstance(pose, Pose)
    assert pose.stamp_nanos == -999_999_999


def test_an_image_of_a_megabyte_decodes_in_a_moment() -> None:
    """Pixels are copied as bytes, never one by one."""
    image = HandMadeCdr("<").header(STAMP, "camera").put("I", 480, 640).text("rgb8").put("B", 0).put("I", 1920)
    data = image.blob(bytes(921_600)).bytes()
    decode = decoder_for(ros2_channel("sensor_msgs/msg/Image"))
    start = time.process_time()
    message = decode(data)
    assert time.process_time() - start < 0.02
    assert isinstance(message, Image)
    assert message.data == bytes(921_600)


# --------------------------------------------------------------------------------------------------------- ROS 1


def ros1_schema(type_name: str) -> bytes:
    """The ROS 1 definition of a type, from the ROS 2 one."""
    text = ros2_schema(type_name).decode()
    text = text.replace("builtin_interfaces/Time stamp\n", "uint32 seq\ntime stamp\n")
    head, _, rest = text.partition("=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n")
    text = (head + rest).replace(" x 0", " x").replace(" y 0", " y").replace(" z 0", " z").replace(" w 1", " w")
    text = text.replace("std_msgs/Header header", "Header header")
    for name in "dkrp":
        text = text.replace(f"] {name}\n", f"] {name.upper()}\n")
    return text.replace(" d\n", " D\n").encode()


def ros1_log(messages: Iterable[tuple[str, Message]]) -> bytes:
    """A log by the official ROS 1 writer: one message for each type."""
    out = io.BytesIO()
    writer = Ros1Writer(out)
    for number, (type_name, ours) in enumerate(messages):
        name = type_name.replace("/msg/", "/")
        schema = Schema(id=1, name=name, encoding="ros1msg", data=ros1_schema(type_name))
        decode = Ros1Factory().decoder_for("ros1", schema)
        assert decode is not None
        message = decode(bytes(4000))
        fill_ros1(message, ours)
        writer.write_message(f"/topic{number}", message, log_time=number, publish_time=number)
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def fill_ros1(message: Any, ours: Message) -> None:
    """Set the fields of a ROS 1 message object."""
    if isinstance(ours, Transforms):
        if hasattr(message, "transforms"):
            kind = Ros1Factory().decoder_for(
                "ros1",
                Schema(
                    1, ros1_schema("geometry_msgs/msg/TransformStamped"), "ros1msg", "geometry_msgs/TransformStamped"
                ),
            )
            assert kind is not None
            message.transforms = [kind(bytes(400)) for _ in ours.transforms]
        for item, transform in zip(getattr(message, "transforms", [message]), ours.transforms, strict=True):
            fill_header(item.header, transform.stamp_nanos, transform.parent)
            item.child_frame_id = transform.child
            set_axes(item.transform.translation, transform.translation)
            set_axes(item.transform.rotation, transform.orientation)
        return
    fill_header(message.header, ours.stamp_nanos, ours.frame_id)
    match ours:
        case Image():
            message.height, message.width, message.step = ours.height, ours.width, ours.step
            message.encoding, message.is_bigendian, message.data = ours.encoding, int(ours.big_endian), ours.data
        case CompressedImage():
            message.format, message.data = ours.format, ours.data
        case CameraInfo():
            message.height, message.width, message.distortion_model = ours.height, ours.width, ours.model
            message.D, message.K, message.R, message.P = ours.distortion, ours.k, ours.r, ours.p
        case Imu():
            set_axes(message.angular_velocity, ours.gyro)
            set_axes(message.linear_acceleration, ours.accel)
            set_axes(message.orientation, ours.orientation or (0, 0, 0, 0))
        case Odometry():
            message.child_frame_id = ours.child_frame_id
            set_axes(message.pose.pose.position, ours.position)
            set_axes(message.pose.pose.orientation, ours.orientation)
        case Pose():
            set_axes(message.pose.position, ours.position)
            set_axes(message.pose.orientation, ours.orientation)


def fill_header(header: Any, stamp_nanos: int, frame_id: str) -> None:
    header.stamp.secs, header.stamp.nsecs = divmod(stamp_nanos, 10**9)
    header.seq, header.frame_id = 7, frame_id


def set_axes(target: Any, values: tuple[float, ...]) -> None:
    for axis, value in zip("xyzw", values, strict=False):
        setattr(target, axis, value)


def test_a_ros1_log_decodes_as_sent() -> None:
    """Every type, written by the official ROS 1 writer and read back through the schemas in the log."""
    read = [decoder_for(channel)(data) for channel, data in channels_of(ros1_log(MESSAGES.items()))]
    assert read == list(MESSAGES.values())


def test_ros1_transforms_from_before_tf2_are_read() -> None:
    """Old logs send tf/tfMessage, which has the layout of tf2_msgs/TFMessage."""
    transforms = MESSAGES["tf2_msgs/msg/TFMessage"]
    [(channel, data)] = channels_of(ros1_log([("tf2_msgs/msg/TFMessage", transforms)]))
    old = Channel("/tf", "tf/tfMessage", "ros1msg", channel.schema_data, "ros1", {})
    assert (kind_of(old), decoder_for(old)(data)) == ("transforms", transforms)


# ------------------------------------------------------------------------------------------------------ Foxglove


def pb_stamp() -> Timestamp:
    return Timestamp(seconds=SEC, nanos=NANOSEC)


def pb_vector(values: tuple[float, ...]) -> Any:
    return Vector3_pb2.Vector3(x=values[0], y=values[1], z=values[2])


def pb_quaternion(values: tuple[float, ...]) -> Any:
    return Quaternion_pb2.Quaternion(x=values[0], y=values[1], z=values[2], w=values[3])


def pb_transform(transform: Transform) -> Any:
    stamp = Timestamp(seconds=transform.stamp_nanos // 10**9, nanos=transform.stamp_nanos % 10**9)
    return FrameTransform_pb2.FrameTransform(
        timestamp=stamp,
        parent_frame_id=transform.parent,
        child_frame_id=transform.child,
        translation=pb_vector(transform.translation),
        rotation=pb_quaternion(transform.orientation),
    )


def pb_imu_class() -> Any:
    """foxglove.Imu as recorders define it for themselves; the schema package has none."""
    file = descriptor_pb2.FileDescriptorProto(name="foxglove/Imu.proto", package="foxglove", syntax="proto3")
    file.dependency.extend(["google/protobuf/timestamp.proto", "foxglove/Vector3.proto", "foxglove/Quaternion.proto"])
    imu = file.message_type.add(name="Imu")
    label = descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL
    types = [
        ("timestamp", ".google.protobuf.Timestamp"),
        ("frame_id", ""),
        ("orientation", ".foxglove.Quaternion"),
        ("angular_velocity", ".foxglove.Vector3"),
        ("linear_acceleration", ".foxglove.Vector3"),
    ]
    for number, (name, type_name) in enumerate(types, start=1):
        kind = (
            descriptor_pb2.FieldDescriptorProto.TYPE_MESSAGE
            if type_name
            else descriptor_pb2.FieldDescriptorProto.TYPE_STRING
        )
        imu.field.add(name=name, number=number, label=label, type=kind, type_name=type_name or None)
    pool = descriptor_pool.DescriptorPool()
    for module in (Timestamp, Vector3_pb2.Vector3, Quaternion_pb2.Quaternion):
        copy = descriptor_pb2.FileDescriptorProto()
        module.DESCRIPTOR.file.CopyToProto(copy)
        pool.Add(copy)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.Imu"))


def pb_imu(orientation: tuple[float, ...] | None) -> Any:
    imu = pb_imu_class()(frame_id="imu")
    imu.timestamp.seconds, imu.timestamp.nanos = SEC, NANOSEC
    set_axes(imu.angular_velocity, (0.1, -0.2, 0.3))
    set_axes(imu.linear_acceleration, (0.0, 0.5, 9.81))
    if orientation is not None:
        set_axes(imu.orientation, orientation)
    return imu


TRANSFORMS = MESSAGES["tf2_msgs/msg/TFMessage"]
assert isinstance(TRANSFORMS, Transforms)

FOXGLOVE: list[tuple[Any, dict[str, Any], Message]] = [
    (
        RawImage_pb2.RawImage(
            timestamp=pb_stamp(), frame_id="camera", width=3, height=2, encoding="mono8", step=4, data=bytes(range(8))
        ),
        {"width": 3, "height": 2.0, "encoding": "mono8", "step": 4, "data": base64.b64encode(bytes(range(8))).decode()},
        Image(STAMP, "camera", 2, 3, "mono8", 4, False, bytes(range(8))),
    ),
    (
        CompressedImage_pb2.CompressedImage(
            timestamp=pb_stamp(), frame_id="camera", format="jpeg", data=b"\xff\xd8\x01"
        ),
        {"format": "jpeg", "data": "/9gB"},
        CompressedImage(STAMP, "camera", "jpeg", b"\xff\xd8\x01"),
    ),
    (
        CameraCalibration_pb2.CameraCalibration(
            timestamp=pb_stamp(),
            frame_id="camera",
            width=640,
            height=480,
            distortion_model="kannala_brandt",
            D=[0.1, 0.2, 0.3, 0.4],
            K=K,
            R=R,
            P=P,
        ),
        {"width": 640, "height": 480, "distortion_model": "kannala_brandt"}
        | {"D": [0.1, 0.2, 0.3, 0.4], "K": list(K), "R": list(R), "P": list(P)},
        CameraInfo(STAMP, "camera", 640, 480, "equidistant", (0.1, 0.2, 0.3, 0.4), K, R, P),
    ),
    (
        pb_transform(TRANSFORMS.transforms[0]),
        {"parent_frame_id": "odom", "child_frame_id": "base_link"}
        | {"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8}},
        Transforms(TRANSFORMS.transforms[:1]),
    ),
    (
        FrameTransforms_pb2.FrameTransforms(transforms=[pb_transform(item) for item in TRANSFORMS.transforms]),
        {
            "transforms": [
                {
                    "timestamp": {"sec": item.stamp_nanos // 10**9, "nsec": item.stamp_nanos % 10**9},
                    "parent_frame_id": item.parent,
                    "child_frame_id": item.child,
                    "translation": dict(zip("xyz", item.translation, strict=True)),
                    "rotation": dict(zip("xyzw", item.orientation, strict=True)),
                }
                for item in TRANSFORMS.transforms
            ]
        },
        TRANSFORMS,
    ),
    (
        PoseInFrame_pb2.PoseInFrame(
            timestamp=pb_stamp(),
            frame_id="camera",
            pose=Pose_pb2.Pose(position=pb_vector((1.0, -2.0, 0.0)), orientation=pb_quaternion(TURN)),
        ),
        {"pose": {"position": {"x": 1.0, "y": -2.0}, "orientation": {"z": 0.6, "w": 0.8}}},
        Pose(STAMP, "camera", (1.0, -2.0, 0.0), TURN),
    ),
    (
        Odometry_pb2.Odometry(
            timestamp=pb_stamp(),
            frame_id="camera",
            body_frame_id="base_link",
            pose=Pose_pb2.Pose(position=pb_vector((1.0, -2.0, 0.0)), orientation=pb_quaternion(TURN)),
        ),
        {
            "body_frame_id": "base_link",
            "pose": {"position": {"x": 1.0, "y": -2.0}, "orientation": {"z": 0.6, "w": 0.8}},
        },
        Odometry(STAMP, "camera", "base_link", (1.0, -2.0, 0.0), TURN),
    ),
    (
        pb_imu(None),
        {"frame_id": "imu", "angular_velocity": {"x": 0.1, "y": -0.2, "z": 0.3}}
        | {"linear_acceleration": {"x": 0, "y": 0.5, "z": 9.81}, "orientation": None},
        Imu(STAMP, "imu", (0.1, -0.2, 0.3), (0.0, 0.5, 9.81), None),
    ),
    (
        pb_imu(TURN),
        {"frame_id": "imu", "angular_velocity": {"x": 0.1, "y": -0.2, "z": 0.3}}
        | {"linear_acceleration": {"x": 0, "y": 0.5, "z": 9.81}, "orientation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8}},
        Imu(STAMP, "imu", (0.1, -0.2, 0.3), (0.0, 0.5, 9.81), TURN),
    ),
]


def protobuf_log() -> bytes:
    out = io.BytesIO()
    writer = ProtobufWriter(out)
    for number, (message, _, _) in enumerate(FOXGLOVE):
        writer.write_message(f"/topic{number}", message, log_time=number, publish_time=number)
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def json_log() -> bytes:
    out = io.BytesIO()
    writer = McapWriter(out)
    writer.start()
    stamp = {"timestamp": {"sec": SEC, "nsec": NANOSEC}, "frame_id": "camera"}
    for number, (message, fields, _) in enumerate(FOXGLOVE):
        name = message.DESCRIPTOR.full_name
        schema = writer.register_schema(name, "jsonschema", json.dumps({"title": name, "type": "object"}).encode())
        channel = writer.register_channel(f"/topic{number}", "json", schema)
        writer.add_message(channel, number, json.dumps(stamp | fields).encode(), number)
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


@pytest.mark.parametrize("log", [protobuf_log, json_log])
def test_a_foxglove_log_decodes_as_sent(log: Callable[[], bytes]) -> None:
    """Every schema, as protobuf and as JSON, written by the official writers."""
    read = [decoder_for(channel)(data) for channel, data in channels_of(log())]
    assert read == [expected for _, _, expected in FOXGLOVE]


def test_an_uncalibrated_foxglove_camera_has_zero_matrices() -> None:
    """Protobuf leaves empty matrices out; K[0] = 0 is how both Foxglove and ROS say uncalibrated."""
    channel = Channel("/info", "foxglove.CameraCalibration", "jsonschema", b"{}", "json", {})
    info = decoder_for(channel)(b'{"width": 640, "height": 480}')
    assert info == CameraInfo(0, "", 640, 480, "", (), (0.0,) * 9, (0.0,) * 9, (0.0,) * 12)


def test_a_foxglove_imu_without_an_orientation_says_so() -> None:
    """By a covariance of -1, or by an all-zero quaternion."""
    channel = Channel("/imu", "foxglove.Imu", "jsonschema", b"{}", "json", {})
    fields = {"angular_velocity": {"x": 1}, "linear_acceleration": {"z": 9}, "orientation": {"w": 1}}
    for change in ({"orientation_covariance": [-1] + [0] * 8}, {"orientation": {"w": 0}}):
        imu = decoder_for(channel)(json.dumps(fields | change).encode())
        assert imu == Imu(0, "", (1.0, 0.0, 0.0), (0.0, 0.0, 9.0), None)


@pytest.mark.parametrize(
    ("schema_name", "text", "reason"),
    [
        ("foxglove.PoseInFrame", '{"frame_id": "map"}', "no `pose`"),
        ("foxglove.PoseInFrame", '{"pose": 3}', "`message` is a int"),
        ("foxglove.PoseInFrame", "[1, 2]", "instead of a dict"),
        ("foxglove.PoseInFrame", "{", "JSONDecodeError"),
        ("foxglove.PoseInFrame", "[" * 100_000, "RecursionError"),
        ("foxglove.CompressedImage", '{"data": "@@@@"}', "Error"),
        ("foxglove.CompressedImage", '{"data": 7}', "`data` is a int instead of a str"),
        ("foxglove.RawImage", '{"width": true}', "`width` is true"),
        ("foxglove.RawImage", '{"width": -1}', "`width` is -1"),
        ("foxglove.RawImage", '{"width": 1.5}', "`width` is a float"),
        ("foxglove.CameraCalibration", '{"K": [1, 2]}', "`K` has 2 numbers instead of 9"),
        ("foxglove.CameraCalibration", '{"D": ["a"]}', "`D` holds `a`, which is no number"),
        ("foxglove.CompressedImage", '{"timestamp": {"sec": 1e30}}', "does not fit 64 bits"),
    ],
)
def test_wrong_json_is_one_error_that_says_what_is_wrong(schema_name: str, text: str, reason: str) -> None:
    """The message names the topic and the field."""
    channel = Channel("/fox", schema_name, "jsonschema", b"{}", "json", {})
    with pytest.raises(DecodeError, match=r"`/fox` is damaged") as caught:
        decoder_for(channel)(text.encode())
    assert reason in caught.value.message


# ------------------------------------------------------------------------------------------------------- choices


@pytest.mark.parametrize(
    ("schema_name", "kind"),
    [
        ("sensor_msgs/msg/Image", "image"),
        ("sensor_msgs/Image", "image"),
        ("sensor_msgs/msg/CompressedImage", "compressed_image"),
        ("sensor_msgs/msg/CameraInfo", "camera_info"),
        ("sensor_msgs/Imu", "imu"),
        ("nav_msgs/msg/Odometry", "odometry"),
        ("geometry_msgs/msg/PoseStamped", "pose"),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", "pose"),
        ("geometry_msgs/TransformStamped", "transforms"),
        ("tf2_msgs/msg/TFMessage", "transforms"),
        ("foxglove.RawImage", "image"),
        ("foxglove.CompressedImage", "compressed_image"),
        ("foxglove.CameraCalibration", "camera_info"),
        ("foxglove.FrameTransform", "transforms"),
        ("foxglove.FrameTransforms", "transforms"),
        ("foxglove.PoseInFrame", "pose"),
        ("foxglove.Odometry", "odometry"),
        ("foxglove.Imu", "imu"),
        ("std_msgs/msg/String", None),
        ("sensor_msgs/msg/Imu/x", None),
        ("", None),
    ],
)
def test_the_kind_follows_from_the_name_of_the_type(schema_name: str, kind: str | None) -> None:
    """ROS names with and without `msg`, Foxglove names, and types without a use."""
    assert kind_of(Channel("/topic", schema_name, "", b"", "", {})) == kind


RULE = b"=" * 80
IMU = ros2_schema("sensor_msgs/msg/Imu")
RECURSIVE = b"A a\n" + RULE + b"\nMSG: sensor_msgs/A\nA a\n"
LOOP = b"A[] a\n" + IMU + RULE + b"\nMSG: sensor_msgs/A\nA[] a\n"
IMAGE_WITH_TEXT = ros2_schema("sensor_msgs/msg/Image").replace(b"uint8[] data", b"string data")


def wide_schema() -> bytes:
    """Fourteen levels of messages, each with nine of the next: 9^14 fields in 4 kB."""
    levels = [
        RULE + b"\nMSG: sensor_msgs/A%d\n" % level + b"".join(b"A%d a%d\n" % (level + 1, n) for n in range(9))
        for level in range(14)
    ]
    return b"A0 a\n" + b"".join(levels) + RULE + b"\nMSG: sensor_msgs/A14\n"


@pytest.mark.parametrize(
    ("channel", "reason"),
    [
        (imu_channel(schema_encoding="ros2idl"), "written in `ros2idl`"),
        (imu_channel(schema_encoding="omgidl"), "written in `omgidl`"),
        (imu_channel(message_encoding="wrong_format"), "`wrong_format`"),
        (imu_channel(message_encoding="ros1"), "`ros1` with a schema in `ros2msg`"),
        (imu_channel(b"", schema_encoding=""), "`cdr` with a schema in ``"),
        (imu_channel(b"  \n"), "its schema is empty"),
        (imu_channel(b"\xff\xfe\x00"), "UnicodeDecodeError"),
        (imu_channel(b"this is; not a schema!"), "`this is; not a schema!` is no field"),
        (imu_channel(IMU.replace(b"MSG:", b"IDL:")), "instead of `MSG: package/Type`"),
        (imu_channel(b"Header header"), "`sensor_msgs/Header` but does not define it"),
        (imu_channel(b"float64 x"), "no field `header.stamp.sec`"),
        (imu_channel(ros2_schema("nav_msgs/msg/Odometry")), "no field `orientation.x`"),
        (ros2_channel("sensor_msgs/msg/Image", IMAGE_WITH_TEXT), "field `data` that is not a byte array"),
        (imu_channel(b"wstring x\n" + IMU), "wide string `x`"),
        (imu_channel(b"float64[4000000000] x\n" + IMU), "`x` of 32000000000 bytes"),
        (imu_channel(RECURSIVE), "nests deeper"),
        (imu_channel(LOOP), "nests deeper"),
        (imu_channel(wide_schema()), "expands to more than"),
        (imu_channel(b"A0[] a\n" + IMU + wide_schema()[5:].replace(b" a", b"[] a")), "expands to more than"),
        (ros2_channel("std_msgs/msg/String", b"string data"), "no use here"),
        (Channel("/topic", "", "", b"", "json", {}), "`no schema`"),
        (Channel("/topic", "foxglove.RawImage", "protobuf", b"\xff\xff\xff", "protobuf", {}), "DecodeError"),
        (Channel("/topic", "foxglove.RawImage", "protobuf", b"", "protobuf", {}), "missing that schema"),
        (Channel("/topic", "foxglove.RawImage", "flatbuffer", b"", "flatbuffer", {}), "`flatbuffer`"),
        (
            imu_channel(b"{}", message_encoding="json", schema_encoding="jsonschema"),
            "`json` with a schema in `jsonschema`",
        ),
    ],
)
def test_a_channel_that_cannot_be_read_is_refused_with_the_reason(channel: Channel, reason: str) -> None:
    """One error that names the topic, the type and what is the matter, whatever the schema holds, and at once."""
    start = time.process_time()
    with pytest.raises(UnsupportedChannelError, match=r"Topic `/topic` \(`") as caught:
        decoder_for(channel)
    assert reason in caught.value.message
    assert time.process_time() - start < 1.0


def test_a_protobuf_schema_without_a_field_is_refused() -> None:
    """A recorder's own foxglove.Imu has to have the fields that are read."""
    file = descriptor_pb2.FileDescriptorProto(name="imu.proto", package="foxglove", syntax="proto3")
    file.message_type.add(name="Imu")
    schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    with pytest.raises(UnsupportedChannelError, match="no field `frame_id`"):
        decoder_for(Channel("/imu", "foxglove.Imu", "protobuf", schema, "protobuf", {}))


# -------------------------------------------------------------------------------------------------------- damage


def sample_channels() -> list[tuple[Channel, bytes]]:
    """One channel and one sound message of every type in every encoding."""
    ros2 = [(ros2_channel(name), hand_made(name, "<")) for name in MESSAGES]
    return ros2 + channels_of(ros1_log(MESSAGES.items())) + channels_of(protobuf_log()) + channels_of(json_log())


SAMPLES = sample_channels()
SAMPLE_NAMES = [f"{channel.message_encoding}-{channel.schema_name}" for channel, _ in SAMPLES]


@pytest.mark.parametrize(("channel", "data"), SAMPLES, ids=SAMPLE_NAMES)
def test_damage_raises_one_kind_of_error(channel: Channel, data: bytes) -> None:
    """Any bytes at all, cuts and flips: a message or a DecodeError, never anything else."""
    decode = decoder_for(channel)

    @given(st.one_of(st.binary(max_size=64), st.integers(0, len(data)).map(lambda cut: data[:cut]), flipped(data)))
    @FAST
    def attempt(damaged: bytes) -> None:
        with contextlib.suppress(DecodeError):
            decode(damaged)

    attempt()


def flipped(data: bytes) -> st.SearchStrategy[bytes]:
    """The message with up to four bytes replaced."""
    places = st.lists(st.tuples(st.integers(0, len(data) - 1), st.integers(0, 255)), min_size=1, max_size=4)

    def replace(edits: list[tuple[int, int]]) -> bytes:
        changed = bytearray(data)
        for at, value in edits:
            changed[at] = value
        return bytes(changed)

    return places.map(replace)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_ros_message_cut_anywhere_is_never_taken_for_whole(encoding: str) -> None:
    """A short message is damage even where all that is wanted has been read."""
    for channel, data in SAMPLES:
        if channel.message_encoding == encoding:
            decode = decoder_for(channel)
            for cut in range(len(data)):
                with pytest.raises(DecodeError):
                    decode(data[:cut])


@pytest.mark.parametrize("extra", [8, 1000])
def test_a_ros_message_longer_than_its_schema_is_refused(extra: int) -> None:
    """Left-over bytes mean that message and schema do not belong together."""
    decode = decoder_for(imu_channel())
    with pytest.raises(DecodeError, match="left after the last field"):
        decode(hand_made("sensor_msgs/msg/Imu", "<") + bytes(extra))
    assert decode(hand_made("sensor_msgs/msg/Imu", "<") + bytes(3)) == MESSAGES["sensor_msgs/msg/Imu"]


@pytest.mark.parametrize("kind", [b"\x00\x07", b"\x00\x09", b"\x00\x03", b"\x01\x00"])
def test_xcdr2_and_parameter_lists_are_refused_by_name(kind: bytes) -> None:
    """Their layout differs, so reading on would give wrong numbers."""
    with pytest.raises(DecodeError, match=f"encapsulation is 0x{kind.hex()}"):
        decoder_for(imu_channel())(kind + hand_made("sensor_msgs/msg/Imu", "<")[2:])


@pytest.mark.parametrize("type_name", ["sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"])
def test_absurd_counts_are_refused_before_anything_is_allocated(type_name: str) -> None:
    """A count of four billion in a short message costs neither memory nor time."""
    data = hand_made(type_name, "<")
    marks = {"sensor_msgs/msg/Image": struct.pack("<I", 8), "sensor_msgs/msg/CameraInfo": struct.pack("<I", 5)}
    mark = marks.get(type_name, struct.pack("<I", 2))
    at = data.rfind(mark + b"\x00\x01") if type_name.endswith("Image") else data.find(mark, 4)
    damaged = data[:at] + b"\xff\xff\xff\xff" + data[at + 4 :]
    decode = decoder_for(ros2_channel(type_name))
    tracemalloc.start()
    with pytest.raises(DecodeError, match=r"ends after \d+ bytes where its fields need"):
        decode(damaged)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def test_arrays_of_nothing_cost_nothing() -> None:
    """ROS 1 sends no byte for an empty message, so any count of them fits any message."""
    rule = "=" * 80
    schema = ros1_schema("geometry_msgs/msg/PoseStamped") + f"{rule}\nMSG: geometry_msgs/Empty\n".encode()
    channel = Channel("/pose", "geometry_msgs/PoseStamped", "ros1msg", b"Empty[] none\n" + schema, "ros1", {})
    pose = struct.pack("<IIII", 0xFFFFFFFF, 7, SEC, NANOSEC) + struct.pack("<I3s7d", 3, b"map", 1, 2, 3, *TURN)
    assert decoder_for(channel)(pose) == Pose(STAMP, "map", (1.0, 2.0, 3.0), TURN)


@given(st.binary(max_size=200), st.sampled_from(SAMPLES))
@FAST
def test_no_schema_can_do_more_than_be_refused(schema: bytes, sample: tuple[Channel, bytes]) -> None:
    """Schemas come from the log and may be damaged too."""
    channel, data = sample
    cut = Channel(
        channel.topic,
        channel.schema_name,
        channel.schema_encoding,
        channel.schema_data[: len(schema)] + schema,
        channel.message_encoding,
        {},
    )
    with contextlib.suppress(UnsupportedChannelError, DecodeError):
        decoder_for(cut)(data)


# ----------------------------------------------------------------------------------------------------- real logs

SHARED = os.environ.get("SEMSLAM_TEST_DATA", "")
needs_data = pytest.mark.skipif(not SHARED, reason="SEMSLAM_TEST_DATA does not name the folder of shared test logs")


def read_log(path: Path) -> list[tuple[Channel, bytes]]:
    return channels_of(path.read_bytes())


@needs_data
def test_a_real_recording_decodes_whole_and_as_the_official_decoder_reads_it() -> None:
    """Every message of every topic of the kitchen log."""
    counts: dict[str, int] = {}
    decoders: dict[str, Any] = {}
    for number, (channel, data) in enumerate(read_log(Path(SHARED) / "logs" / "redkitchen.mcap")):
        if channel.topic not in decoders:
            official = official_ros2(channel.schema_name, channel.schema_data)
            decoders[channel.topic] = decoder_for(channel), official
        ours, official = decoders[channel.topic]
        message = ours(data)
        kind = kind_of(channel) or ""
        counts[kind] = counts.get(kind, 0) + 1
        if number % 10 == 0:
            same_fields(official(data), message)
    assert counts == {
        "transforms": 1,
        "camera_info": 200,
        "compressed_image": 200,
        "imu": 3330,
        "odometry": 1000,
        "pose": 1000,
    }


@needs_data
def test_every_channel_of_the_rosbag2_logs_is_decoded_or_refused_by_name() -> None:
    """Services, odd schemas, wrong encodings: each channel has a decoder or a reason."""
    paths = sorted((Path(SHARED) / "mcap-rosbag2").rglob("*.mcap"))
    assert len(paths) >= 18
    for path in paths:
        for channel in {channel.topic: channel for channel, _ in read_log(path)}.values():
            with pytest.raises(UnsupportedChannelError, match=f"`{channel.topic}`"):
                decoder_for(channel)
            assert kind_of(channel) is None
