"""The messages of a log in one neutral form, whichever recorder, encoding or schema they came from.

All stamps are int64 nanoseconds taken from the message itself (its header), 0 where the sender set none; they are not
the log time. Quaternions are (x, y, z, w). Values are as sent: no unit is guessed, no quaternion normalised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
"""(x, y, z)."""

Quaternion: TypeAlias = tuple[float, float, float, float]
"""(x, y, z, w)."""


@dataclass(frozen=True, slots=True)
class Image:
    """Raw pixels, row by row; `semslam.logs.images` turns them into arrays."""

    stamp_nanos: int
    frame_id: str
    height: int
    width: int
    encoding: str
    """Pixel format by its ROS name: `rgb8`, `bgr8`, `mono8`, `16UC1`, `32FC1`, ..."""
    step: int
    """Bytes from one row to the next, padding included; 0 where the sender left it out (rows are packed)."""
    big_endian: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """An image file (JPEG, PNG, WebP) or a `compressedDepth` payload; `format` says which."""

    stamp_nanos: int
    frame_id: str
    format: str
    data: bytes


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Intrinsics of one camera, matrices row-major, in pixels."""

    stamp_nanos: int
    frame_id: str
    width: int
    height: int
    model: str
    """Lens model by its ROS name: `plumb_bob`, `rational_polynomial`, `equidistant`, ..."""
    distortion: tuple[float, ...]
    k: tuple[float, ...]
    """Camera matrix of the raw image, 9 numbers; `k[0] == 0` means uncalibrated."""
    r: tuple[float, ...]
    """Rectification, 9 numbers."""
    p: tuple[float, ...]
    """Projection of the rectified image, 12 numbers."""


@dataclass(frozen=True, slots=True)
class Imu:
    """One sample of an inertial sensor, in its own frame."""

    stamp_nanos: int
    frame_id: str
    gyro: Vector
    """Angular velocity, rad/s."""
    accel: Vector
    """Linear acceleration with gravity, m/s^2."""
    orientation: Quaternion | None
    """World from sensor as the sender estimated it; None where it says that it has no estimate."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """Pose of `child_frame_id` in `frame_id`; position in metres."""

    stamp_nanos: int
    frame_id: str
    child_frame_id: str
    position: Vector
    orientation: Quaternion


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose in `frame_id`; position in metres."""

    stamp_nanos: int
    frame_id: str
    position: Vector
    orientation: Quaternion


@dataclass(frozen=True, slots=True)
class Transform:
    """`parent_from_child`: maps points in `child` to points in `parent`; translation in metres."""

    stamp_nanos: int
    parent: str
    child: str
    translation: Vector
    orientation: Quaternion


@dataclass(frozen=True, slots=True)
class Transforms:
    """The transforms of one message, in its order."""

    transforms: tuple[Transform, ...]


Message: TypeAlias = Image | CompressedImage | CameraInfo | Imu | Odometry | Pose | Transforms
"""What a decoder returns."""


@dataclass(frozen=True, slots=True)
class Polygon:
    """An outline on the floor of `frame_id`, metres; sent only."""

    stamp_nanos: int
    frame_id: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class FloorObject:
    """One object as it stands: what it is, its pose, its outline on the floor in the frame of the list, its height."""

    id: int
    class_name: str
    style: str
    position: Vector
    """Middle of what it stands on, metres."""
    orientation: Quaternion
    footprint: tuple[tuple[float, float], ...]
    height_m: float
    """From what it stands on to its top."""


@dataclass(frozen=True, slots=True)
class FloorObjects:
    """All objects of a place; sent only."""

    stamp_nanos: int
    frame_id: str
    objects: tuple[FloorObject, ...]


Sent: TypeAlias = Message | Transform | Polygon | FloorObjects
"""What a writer takes."""
