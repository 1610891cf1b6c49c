"""Neutral messages from Foxglove schemas, sent as protobuf or as JSON.

Protobuf messages are parsed by the official decoder with the FileDescriptorSet of the channel, JSON by the standard
library; both are then read by field name through one small interface, so each message type is written down once.
Protobuf sends no field that has its default value, so an absent number is 0 and an absent text is empty. An absent
message (a pose, a vector) has no default and is damage.

Source: https://docs.foxglove.dev/docs/sdk/schemas. `foxglove.Imu` is no official schema, but recorders in use write it,
with the fields of sensor_msgs/Imu; where the SDK gets one, only a difference in names would matter here.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from google.protobuf.message import Message as ProtobufMessage
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

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
    Vector,
)

_T = TypeVar("_T")

SECOND = 1_000_000_000
"""Nanoseconds."""

_MODELS = {"kannala_brandt": "equidistant"}
"""Foxglove's names of lens models that ROS calls otherwise; the coefficients are the same (OpenCV fisheye)."""


class Node(Protocol):
    """A message, or a message inside one, read by field name. All methods raise ValueError for a wrong value."""

    def text(self, name: str) -> str: ...
    def integer(self, name: str) -> int: ...
    def number(self, name: str) -> float: ...
    def numbers(self, name: str) -> tuple[float, ...]: ...
    def data(self, name: str) -> bytes: ...
    def node(self, name: str) -> Node | None: ...
    def nodes(self, name: str) -> Iterable[Node]: ...
    def stamp_nanos(self) -> int: ...


def decode_protobuf(type_name: str, schema_data: bytes) -> Callable[[bytes], Message]:
    """Decoder for messages of a `protobuf` schema. Raises ValueError if the schema does not fit."""
    row = FOXGLOVE_TYPES[type_name]
    parse = DecoderFactory().decoder_for(
        "protobuf", Schema(id=1, name=type_name, encoding="protobuf", data=schema_data)
    )
    if parse is None:
        raise ValueError("its schema is no FileDescriptorSet")
    described = parse(b"").DESCRIPTOR.fields_by_name
    for name in row.fields:
        if name not in described:
            raise ValueError(f"its schema of `{type_name}` has no field `{name}`")
    return lambda data: row.build(ProtobufNode(parse(data)))


def decode_json(type_name: str) -> Callable[[bytes], Message]:
    """Decoder for JSON messages; their form is fixed by `type_name`."""
    row = FOXGLOVE_TYPES[type_name]
    return lambda data: row.build(JsonNode(json.loads(data)))


# ------------------------------------------------------------------------------------------------------ protobuf


@dataclass(frozen=True, slots=True)
class ProtobufNode:
    """A parsed protobuf message."""

    message: Any

    def text(self, name: str) -> str:
        return _of(str, getattr(self.message, name), name)

    def integer(self, name: str) -> int:
        return _of(int, getattr(self.message, name), name)

    def number(self, name: str) -> float:
        return _of(float, getattr(self.message, name), name)

    def numbers(self, name: str) -> tuple[float, ...]:
        return tuple(_of(float, value, name) for value in getattr(self.message, name, ()))

    def data(self, name: str) -> bytes:
        return _of(bytes, getattr(self.message, name), name)

    def node(self, name: str) -> Node | None:
        if name not in self.message.DESCRIPTOR.fields_by_name or not self.message.HasField(name):
            return None
        return ProtobufNode(_of(ProtobufMessage, getattr(self.message, name), name))

    def nodes(self, name: str) -> Iterable[Node]:
        return [ProtobufNode(_of(ProtobufMessage, item, name)) for item in getattr(self.message, name)]

    def stamp_nanos(self) -> int:
        stamp = self.node("timestamp")
        return _nanos(stamp.integer("seconds"), stamp.integer("nanos")) if stamp else 0


# ---------------------------------------------------------------------------------------------------------- JSON


class JsonNode:
    """A parsed JSON object."""

    __slots__ = ("_fields",)

    def __init__(self, value: object) -> None:
        self._fields: Mapping[str, Any] = _of(dict, value, "message")

    def text(self, name: str) -> str:
        return _of(str, self._fields.get(name, ""), name)

    def integer(self, name: str) -> int:
        value = self._fields.get(name, 0)
        if isinstance(value, float) and value.is_integer():
            value = int(value)  # 640.0 is an integer to JSON Schema
        if isinstance(value, bool):
            raise ValueError(f"its `{name}` is {json.dumps(value)}")
        return _of(int, value, name)

    def number(self, name: str) -> float:
        return _json_float(self._fields.get(name, 0.0), name)

    def numbers(self, name: str) -> tuple[float, ...]:
        return tuple(_json_float(value, name) for value in _of(list, self._fields.get(name, []), name))

    def data(self, name: str) -> bytes:
        return base64.b64decode(self.text(name), validate=True)

    def node(self, name: str) -> Node | None:
        value = self._fields.get(name)
        return None if value is None else JsonNode(value)

    def nodes(self, name: str) -> Iterable[Node]:
        return [JsonNode(item) for item in _of(list, self._fields.get(name, []), name)]

    def stamp_nanos(self) -> int:
        stamp = self.node("timestamp")
        return _nanos(stamp.integer("sec"), stamp.integer("nsec")) if stamp else 0


def _json_float(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"its `{name}` holds `{str(value)[:40]}`, which is no number")
    return float(value)


# ------------------------------------------------------------------------------------------------------ builders


def _of(kind: type[_T], value: object, name: str) -> _T:
    if not isinstance(value, kind):
        raise ValueError(f"its `{name}` is a {type(value).__name__} instead of a {kind.__name__}")
    return value


def _nanos(seconds: int, nanos: int) -> int:
    stamp = seconds * SECOND + nanos
    if not -(2**63) <= stamp < 2**63:
        raise ValueError(f"its stamp of {seconds} s does not fit 64 bits of nanoseconds")
    return stamp


def _required(node: Node, name: str) -> Node:
    inner = node.node(name)
    if inner is None:
        raise ValueError(f"it has no `{name}`")
    return inner


def _size(node: Node, name: str) -> int:
    size = node.integer(name)
    if not 0 <= size < 2**32:
        raise ValueError(f"its `{name}` is {size}")
    return size


def _matrix(node: Node, name: str, count: int) -> tuple[float, ...]:
    """`count` numbers; zeros where the sender left the matrix out, which is how an uncalibrated camera is sent."""
    values = node.numbers(name)
    if len(values) not in (0, count):
        raise ValueError(f"its `{name}` has {len(values)} numbers instead of {count}")
    return values or (0.0,) * count


def _vector(node: Node, name: str) -> Vector:
    vector = _required(node, name)
    return vector.number("x"), vector.number("y"), vector.number("z")


def _quaternion(node: Node, name: str) -> Quaternion:
    rotation = _required(node, name)
    return rotation.number("x"), rotation.number("y"), rotation.number("z"), rotation.number("w")


def _image(node: Node) -> Image:
    return Image(
        stamp_nanos=node.stamp_nanos(),
        frame_id=node.text("frame_id"),
        height=_size(node, "height"),
        width=_size(node, "width"),
        encoding=node.text("encoding"),
        step=_size(node, "step"),
        big_endian=False,
        data=node.data("data"),
    )


def _compressed_image(node: Node) -> CompressedImage:
    return CompressedImage(node.stamp_nanos(), node.text("frame_id"), node.text("format"), node.data("data"))


def _camera_info(node: Node) -> CameraInfo:
    model = node.text("distortion_model")
    return CameraInfo(
        stamp_nanos=node.stamp_nanos(),
        frame_id=node.text("frame_id"),
        width=_size(node, "width"),
        height=_size(node, "height"),
        model=_MODELS.get(model, model),
        distortion=node.numbers("D"),
        k=_matrix(node, "K", 9),
        r=_matrix(node, "R", 9),
        p=_matrix(node, "P", 12),
    )


def _transform(node: Node) -> Transform:
    return Transform(
        stamp_nanos=node.stamp_nanos(),
        parent=node.text("parent_frame_id"),
        child=node.text("child_frame_id"),
        translation=_vector(node, "translation"),
        orientation=_quaternion(node, "rotation"),
    )


def _transforms(node: Node) -> Transforms:
    return Transforms(tuple(_transform(item) for item in node.nodes("transforms")))


def _pose(node: Node) -> Pose:
    pose = _required(node, "pose")
    return Pose(node.stamp_nanos(), node.text("frame_id"), _vector(pose, "position"), _quaternion(pose, "orientation"))


def _odometry(node: Node) -> Odometry:
    pose = _required(node, "pose")
    position, orientation = _vector(pose, "position"), _quaternion(pose, "orientation")
    return Odometry(node.stamp_nanos(), node.text("frame_id"), node.text("body_frame_id"), position, orientation)


def _imu(node: Node) -> Imu:
    gyro, accel = _vector(node, "angular_velocity"), _vector(node, "linear_acceleration")
    return Imu(node.stamp_nanos(), node.text("frame_id"), gyro, accel, _known_orientation(node))


def _known_orientation(node: Node) -> Quaternion | None:
    """None where it is absent, all zeros, or marked unknown by a covariance that starts with -1."""
    if node.node("orientation") is None:
        return None
    covariance = node.numbers("orientation_covariance")
    orientation = _quaternion(node, "orientation")
    return orientation if any(orientation) and covariance[:1] != (-1.0,) else None


# --------------------------------------------------------------------------------------------------------- types


@dataclass(frozen=True, slots=True)
class FoxgloveType:
    """One schema that is read."""

    kind: str
    fields: tuple[str, ...]
    """Fields its schema must have."""
    build: Callable[[Node], Message]


FOXGLOVE_TYPES: dict[str, FoxgloveType] = {
    "foxglove.RawImage": FoxgloveType("image", ("frame_id", "width", "height", "encoding", "step", "data"), _image),
    "foxglove.CompressedImage": FoxgloveType("compressed_image", ("frame_id", "format", "data"), _compressed_image),
    "foxglove.CameraCalibration": FoxgloveType(
        "camera_info", ("frame_id", "width", "height", "distortion_model", "D", "K", "R", "P"), _camera_info
    ),
    "foxglove.FrameTransform": FoxgloveType(
        "transforms",
        ("parent_frame_id", "child_frame_id", "translation", "rotation"),
        lambda node: Transforms((_transform(node),)),
    ),
    "foxglove.FrameTransforms": FoxgloveType("transforms", ("transforms",), _transforms),
    "foxglove.PoseInFrame": FoxgloveType("pose", ("frame_id", "pose"), _pose),
    "foxglove.Odometry": FoxgloveType("odometry", ("frame_id", "body_frame_id", "pose"), _odometry),
    "foxglove.Imu": FoxgloveType("imu", ("frame_id", "angular_velocity", "linear_acceleration"), _imu),
}
"""By schema name."""
