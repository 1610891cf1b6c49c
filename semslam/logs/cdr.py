"""Serialising neutral messages as ROS 2 messages: CDR, little endian.

Covariances and twists, which neutral messages do not carry, are written as 0, which ROS defines as unknown.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

from semslam.logs.messages import (
    CameraInfo,
    CompressedImage,
    FloorObject,
    FloorObjects,
    Image,
    Imu,
    Odometry,
    Polygon,
    Pose,
    Sent,
    Transform,
    Transforms,
)

SECOND = 1_000_000_000
"""Nanoseconds."""


class CdrBuffer:
    """Bytes of one message under construction; every value is aligned to its own size."""

    def __init__(self) -> None:
        self._parts = bytearray(b"\x00\x01\x00\x00")

    def pack(self, code: str, *values: float) -> None:
        """Append values of one `struct` code."""
        self._parts += bytes((4 - len(self._parts)) % struct.calcsize("=" + code))  # the header does not count
        self._parts += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, value: str) -> None:
        encoded = value.encode() + b"\x00"
        self.pack("I", len(encoded))
        self._parts += encoded

    def data(self, value: bytes) -> None:
        self.pack("I", len(value))
        self._parts += value

    def doubles(self, values: Sequence[float]) -> None:
        """A sequence of any length."""
        self.pack("I", len(values))
        if values:
            self.pack("d", *values)

    def header(self, stamp_nanos: int, frame_id: str) -> None:
        sec, nanosec = divmod(stamp_nanos, SECOND)
        self.pack("i", sec)
        self.pack("I", nanosec)
        self.text(frame_id)

    def done(self) -> bytes:
        return bytes(self._parts)


def ros2_type(message: Sent) -> str:
    """Full name of the ROS 2 type that carries `message`."""
    return _TYPES[type(message)][0]


def serialise(message: Sent) -> bytes:
    """The bytes of `message` as its ROS 2 type.

    Raises:
        struct.error: a number does not fit its field (a stamp after 2038, a negative width).
    """
    buffer = CdrBuffer()
    _TYPES[type(message)][1](buffer, message)
    return buffer.done()


def _image(buffer: CdrBuffer, image: Image) -> None:
    buffer.header(image.stamp_nanos, image.frame_id)
    buffer.pack("I", image.height, image.width)
    buffer.text(image.encoding)
    buffer.pack("B", image.big_endian)
    buffer.pack("I", image.step)
    buffer.data(image.data)


def _compressed_image(buffer: CdrBuffer, image: CompressedImage) -> None:
    buffer.header(image.stamp_nanos, image.frame_id)
    buffer.text(image.format)
    buffer.data(image.data)


def _camera_info(buffer: CdrBuffer, info: CameraInfo) -> None:
    buffer.header(info.stamp_nanos, info.frame_id)
    buffer.pack("I", info.height, info.width)
    buffer.text(info.model)
    buffer.doubles(info.distortion)
    buffer.pack("d", *info.k, *info.r, *info.p)
    buffer.pack("I", 0, 0, 0, 0, 0, 0)  # binning and region of interest: the whole image
    buffer.pack("B", 0)


def _imu(buffer: CdrBuffer, imu: Imu) -> None:
    unknown = imu.orientation is None
    buffer.header(imu.stamp_nanos, imu.frame_id)
    buffer.pack("d", *(imu.orientation or (0.0, 0.0, 0.0, 1.0)))
    buffer.pack("d", -1.0 if unknown else 0.0, *[0.0] * 8)
    buffer.pack("d", *imu.gyro, *[0.0] * 9)
    buffer.pack("d", *imu.accel, *[0.0] * 9)


def _odometry(buffer: CdrBuffer, odometry: Odometry) -> None:
    buffer.header(odometry.stamp_nanos, odometry.frame_id)
    buffer.text(odometry.child_frame_id)
    buffer.pack("d", *odometry.position, *odometry.orientation, *[0.0] * (36 + 6 + 36))


def _pose(buffer: CdrBuffer, pose: Pose) -> None:
    buffer.header(pose.stamp_nanos, pose.frame_id)
    buffer.pack("d", *pose.position, *pose.orientation)


def _transform(buffer: CdrBuffer, transform: Transform) -> None:
    buffer.header(transform.stamp_nanos, transform.parent)
    buffer.text(transform.child)
    buffer.pack("d", *transform.translation, *transform.orientation)


def _transforms(buffer: CdrBuffer, message: Transforms) -> None:
    buffer.pack("I", len(message.transforms))
    for transform in message.transforms:
        _transform(buffer, transform)


def _polygon(buffer: CdrBuffer, polygon: Polygon) -> None:
    buffer.header(polygon.stamp_nanos, polygon.frame_id)
    _points(buffer, polygon.points)


def _points(buffer: CdrBuffer, points: Sequence[tuple[float, float]]) -> None:
    """geometry_msgs/Polygon, at height 0."""
    buffer.pack("I", len(points))
    for x, y in points:
        buffer.pack("f", x, y, 0.0)


def _floor_objects(buffer: CdrBuffer, message: FloorObjects) -> None:
    buffer.header(message.stamp_nanos, message.frame_id)
    buffer.pack("I", len(message.objects))
    for found in message.objects:
        _floor_object(buffer, found)


def _floor_object(buffer: CdrBuffer, found: FloorObject) -> None:
    buffer.pack("I", found.id)
    buffer.text(found.class_name)
    buffer.text(found.style)
    buffer.pack("d", *found.position, *found.orientation)
    _points(buffer, found.footprint)
    buffer.pack("d", found.height_m)


_TYPES: dict[type, tuple[str, Callable[[CdrBuffer, Any], None]]] = {
    Image: ("sensor_msgs/msg/Image", _image),
    CompressedImage: ("sensor_msgs/msg/CompressedImage", _compressed_image),
    CameraInfo: ("sensor_msgs/msg/CameraInfo", _camera_info),
    Imu: ("sensor_msgs/msg/Imu", _imu),
    Odometry: ("nav_msgs/msg/Odometry", _odometry),
    Pose: ("geometry_msgs/msg/PoseStamped", _pose),
    Polygon: ("geometry_msgs/msg/PolygonStamped", _polygon),
    FloorObjects: ("semslam_msgs/msg/FloorObjects", _floor_objects),
    Transform: ("geometry_msgs/msg/TransformStamped", _transform),
    Transforms: ("tf2_msgs/msg/TFMessage", _transforms),
}
