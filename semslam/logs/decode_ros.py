"""Neutral messages from ROS 1 and ROS 2 serialisation.

One row of `ROS_TYPES` says which fields of a message type are read and how they become a neutral message; the rest is
done by the schema of the channel (`ros_layout`). The same rows serve both generations.

The official decoders are the reference in the tests and not used here: that of ROS 1 writes the schema text of a log
into a Python file and imports it, that of ROS 2 takes several times as long, and both hand on a byte array that was cut
short as if it were whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from semslam.logs.messages import (
    CameraInfo,
    CompressedImage,
    Image,
    Imu,
    Message,
    Odometry,
    Pose,
    Quaternion,
    Transform,
    Transforms,
)
from semslam.logs.ros_definition import Flavour, parse_definitions, short_name
from semslam.logs.ros_layout import Layout, Shape, Want, compile_layout

SECOND = 1_000_000_000
"""Nanoseconds."""


def decode_cdr(type_name: str, schema_text: str) -> Callable[[bytes], Message]:
    """Decoder for CDR messages of a `ros2msg` schema. Raises ValueError if the schema does not fit."""
    row, layout = _compile(type_name, schema_text, Flavour.ROS2)
    build = row.build

    def decode(data: bytes) -> Message:
        values, end = layout.read(data, 4, _byte_order(data))
        if len(data) - end >= 8:  # some middleware pads, never by this much
            raise ValueError(f"{len(data) - end} bytes are left after the last field of its schema")
        return build(*values)

    return decode


def decode_ros1(type_name: str, schema_text: str) -> Callable[[bytes], Message]:
    """Decoder for ROS 1 messages of a `ros1msg` schema. Raises ValueError if the schema does not fit."""
    row, layout = _compile(type_name, schema_text, Flavour.ROS1)

    def decode(data: bytes) -> Message:
        values, end = layout.read(data, 0, 1)
        if end != len(data):
            raise ValueError(f"{len(data) - end} bytes are left after the last field of its schema")
        return row.build(*values)

    return decode


@dataclass(frozen=True, slots=True)
class RosType:
    """One message type that is read."""

    kind: str
    record: tuple[Want, ...]
    build: Callable[..., Message]
    """Takes the values of `record` in order."""


def _compile(type_name: str, schema_text: str, flavour: Flavour) -> tuple[RosType, Layout]:
    row = ROS_TYPES[short_name(type_name)]
    definitions = parse_definitions(type_name, schema_text, flavour)
    return row, compile_layout(definitions, short_name(type_name), row.record, flavour)


def _byte_order(data: bytes) -> int:
    """0 (big endian) or 1 (little endian) from the encapsulation header."""
    if len(data) < 4:
        raise ValueError(f"it has {len(data)} bytes, fewer than a CDR header")
    if data[0] != 0 or data[1] > 1:
        raise ValueError(
            f"its encapsulation is 0x{data[0]:02x}{data[1]:02x}; plain CDR (0x0000, 0x0001) is read, XCDR2 is not"
        )
    return data[1]


# ------------------------------------------------------------------------------------------------------ builders


def _image(
    sec: int,
    nanosec: int,
    frame_id: str,
    height: int,
    width: int,
    encoding: str,
    is_bigendian: int,
    step: int,
    data: bytes,
) -> Image:
    return Image(sec * SECOND + nanosec, frame_id, height, width, encoding, step, bool(is_bigendian), data)


def _compressed_image(sec: int, nanosec: int, frame_id: str, image_format: str, data: bytes) -> CompressedImage:
    return CompressedImage(sec * SECOND + nanosec, frame_id, image_format, data)


def _camera_info(
    sec: int, nanosec: int, frame_id: str, height: int, width: int, model: str, *matrices: Sequence[float]
) -> CameraInfo:
    distortion, k, r, p = (tuple(matrix) for matrix in matrices)
    return CameraInfo(sec * SECOND + nanosec, frame_id, width, height, model, distortion, k, r, p)


def _imu(
    sec: int,
    nanosec: int,
    frame_id: str,
    x: float,
    y: float,
    z: float,
    w: float,
    covariance: Sequence[float],
    *rates: float,
) -> Imu:
    """Orientation is unknown where its covariance starts with -1 (sensor_msgs/Imu) or it is no rotation at all."""
    known = covariance[0] != -1.0 and (x or y or z or w)
    gyro, accel = rates[:3], rates[3:]
    return Imu(sec * SECOND + nanosec, frame_id, gyro, accel, (x, y, z, w) if known else None)  # type: ignore[arg-type]


def _odometry(
    sec: int, nanosec: int, frame_id: str, child: str, x: float, y: float, z: float, *orientation: float
) -> Odometry:
    return Odometry(sec * SECOND + nanosec, frame_id, child, (x, y, z), _quaternion(orientation))


def _pose(sec: int, nanosec: int, frame_id: str, x: float, y: float, z: float, *orientation: float) -> Pose:
    return Pose(sec * SECOND + nanosec, frame_id, (x, y, z), _quaternion(orientation))


def _transform(
    sec: int, nanosec: int, parent: str, child: str, x: float, y: float, z: float, *orientation: float
) -> Transform:
    return Transform(sec * SECOND + nanosec, parent, child, (x, y, z), _quaternion(orientation))


def _quaternion(values: tuple[float, ...]) -> Quaternion:
    x, y, z, w = values
    return x, y, z, w


def _one_transform(*values: Any) -> Transforms:
    return Transforms((_transform(*values),))


def _transforms(records: Sequence[tuple[Any, ...]]) -> Transforms:
    return Transforms(tuple(_transform(*values) for values in records))


# -------------------------------------------------------------------------------------------------------- fields


def _numbers(prefix: str, names: str) -> tuple[Want, ...]:
    return tuple(Want(f"{prefix}.{name}", Shape.NUMBER) for name in names)


def _integers(*paths: str) -> tuple[Want, ...]:
    return tuple(Want(path, Shape.INTEGER) for path in paths)


def _pose_at(prefix: str, position: str = "position", orientation: str = "orientation") -> tuple[Want, ...]:
    return _numbers(f"{prefix}.{position}", "xyz") + _numbers(f"{prefix}.{orientation}", "xyzw")


_HEADER = (*_integers("header.stamp.sec", "header.stamp.nanosec"), Want("header.frame_id", Shape.TEXT))
_CHILD = Want("child_frame_id", Shape.TEXT)
_DATA = Want("data", Shape.BYTES)
_STAMPED_TRANSFORM = (*_HEADER, _CHILD, *_pose_at("transform", "translation", "rotation"))
_TF_MESSAGE = RosType("transforms", (Want("transforms", Shape.RECORDS, record=_STAMPED_TRANSFORM),), _transforms)

ROS_TYPES: dict[str, RosType] = {
    "sensor_msgs/Image": RosType(
        "image",
        (
            *_HEADER,
            *_integers("height", "width"),
            Want("encoding", Shape.TEXT),
            *_integers("is_bigendian", "step"),
            _DATA,
        ),
        _image,
    ),
    "sensor_msgs/CompressedImage": RosType(
        "compressed_image", (*_HEADER, Want("format", Shape.TEXT), _DATA), _compressed_image
    ),
    "sensor_msgs/CameraInfo": RosType(
        "camera_info",
        (
            *_HEADER,
            *_integers("height", "width"),
            Want("distortion_model", Shape.TEXT),
            Want("d", Shape.NUMBERS),
            Want("k", Shape.NUMBERS, 9),
            Want("r", Shape.NUMBERS, 9),
            Want("p", Shape.NUMBERS, 12),
        ),
        _camera_info,
    ),
    "sensor_msgs/Imu": RosType(
        "imu",
        (
            *_HEADER,
            *_numbers("orientation", "xyzw"),
            Want("orientation_covariance", Shape.NUMBERS, 9),
            *_numbers("angular_velocity", "xyz"),
            *_numbers("linear_acceleration", "xyz"),
        ),
        _imu,
    ),
    "nav_msgs/Odometry": RosType("odometry", (*_HEADER, _CHILD, *_pose_at("pose.pose")), _odometry),
    "geometry_msgs/PoseStamped": RosType("pose", (*_HEADER, *_pose_at("pose")), _pose),
    "geometry_msgs/PoseWithCovarianceStamped": RosType("pose", (*_HEADER, *_pose_at("pose.pose")), _pose),
    "geometry_msgs/TransformStamped": RosType("transforms", _STAMPED_TRANSFORM, _one_transform),
    "tf2_msgs/TFMessage": _TF_MESSAGE,
    "tf/tfMessage": _TF_MESSAGE,  # ROS 1 before tf2, as in the TUM RGB-D logs
}
"""By short type name."""
