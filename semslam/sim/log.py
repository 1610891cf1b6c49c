"""Records a drive through a simulated home as an ordinary ROS 2 log, with the truth on topics of its own.

Writes one MCAP file. What every robot of this kind records:

| topic | type | rate |
|---|---|---|
| /camera/color/image_raw/compressed | sensor_msgs/CompressedImage, JPEG | keyframes |
| /camera/depth/image_raw/compressedDepth | sensor_msgs/CompressedImage, millimetres, registered to colour | keyframes |
| /camera/color/camera_info, /camera/depth/camera_info | sensor_msgs/CameraInfo | keyframes |
| /imu/data_raw | sensor_msgs/Imu | 200 Hz |
| /odom | nav_msgs/Odometry, `odom` to `base_link` | 50 Hz |
| /tf | tf2_msgs/TFMessage, the same | 50 Hz |
| /tf_static | tf2_msgs/TFMessage, `base_link` to camera and IMU | once |

And the truth, in the frame `world` (the home's) or with the stamp and frame of its colour image:

| topic | type | content |
|---|---|---|
| /ground_truth/pose | geometry_msgs/PoseStamped, 50 Hz | `base_link`, tilt included |
| /ground_truth/instances | sensor_msgs/CompressedImage, PNG of 16 bits | id of the object; 0 is the building |
| /ground_truth/classes | sensor_msgs/CompressedImage, PNG of 8 bits | class id: `labels.class_list(home.classes)` |
| /ground_truth/objects | semslam_msgs/FloorObjects, once | every object: id, class, style, pose, footprint, height |
| /ground_truth/outline | geometry_msgs/PolygonStamped, once a polygon | polygons whose union is the floor |

Markers would show objects in viewers, but have no field that says class, height or outline; hence a type of its own,
whose definition the log carries. The same arguments give the same bytes.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.camera import Camera
from semslam.geometry.frames import FLU_FROM_OPTICAL, Matrix, invert, quaternion_from_matrix
from semslam.logs.messages import (
    CameraInfo,
    CompressedImage,
    FloorObject,
    FloorObjects,
    Imu,
    Odometry,
    Polygon,
    Pose,
    Quaternion,
    Sent,
    Transform,
    Transforms,
    Vector,
)
from semslam.logs.writer import (
    JPEG_FORMAT,
    PNG_DEPTH_FORMAT,
    RVL_DEPTH_FORMAT,
    Ros2LogWriter,
    encode_jpeg,
    encode_png,
    encode_png_depth,
    encode_rvl_depth,
)
from semslam.sim.home import Array, Home, Placed
from semslam.sim.inertial import LEVELS, measure_imu, measure_odometry
from semslam.sim.sensors import draw_colour_camera, measure_depth, measure_rgb

if TYPE_CHECKING:
    from semslam.sim.eye import Sight
    from semslam.sim.vehicle import Drive, RobotSpec

COLOUR, DEPTH = "/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth"
COLOUR_INFO, DEPTH_INFO = "/camera/color/camera_info", "/camera/depth/camera_info"
IMU, ODOMETRY, TF, TF_STATIC = "/imu/data_raw", "/odom", "/tf", "/tf_static"
POSE, OBJECTS, OUTLINE = "/ground_truth/pose", "/ground_truth/objects", "/ground_truth/outline"
INSTANCES, CLASS_IMAGE = "/ground_truth/instances", "/ground_truth/classes"

CAMERA_FRAME, IMU_FRAME, WORLD = "camera_color_optical_frame", "imu_link", "world"
VISIBLE_PIXELS = 100
"""An object with more pixels than this at 640x480 counts as visible; in proportion at other sizes."""

_POSE_HZ = 50.0
_INFO = "info"
_FIRST_START_S, _START_DAYS = 1_735_718_400, 480
"""1 January 2025, 08:00 UTC; a log starts within ten hours of that time of some later day."""
_HOURS = 10
_DELAY_MS = {
    TF_STATIC: (0.3, 0.2),
    IMU: (0.8, 0.5),
    ODOMETRY: (2.0, 1.2),
    TF: (2.2, 1.2),
    POSE: (2.5, 1.0),
    _INFO: (21.0, 2.0),
    COLOUR: (27.0, 5.0),
    DEPTH: (31.0, 6.0),
    INSTANCES: (33.0, 6.0),
    CLASS_IMAGE: (33.0, 6.0),
}
"""Log time minus stamp: what it takes at least, and the mean of what comes on top."""

Event: TypeAlias = tuple[int, str, Sent]
"""Log time, topic, message."""
Observer: TypeAlias = Callable[[int, int, "Sight", Matrix], None]
"""Hears of every keyframe: its index, stamp, what there was to see, and world_from_camera."""


class Looker(Protocol):
    """What takes pictures: `eye.Eye`, or a stand-in."""

    def look(self, world_from_camera: Array, time_s: float = 0.0) -> Sight:
        """The view from a pose of the optical frame."""
        ...


@dataclass(frozen=True)
class LogOptions:
    """What a log is like, apart from home, robot, drive and seed."""

    noise: str = "standard"
    """Noise of wheels and IMU: a name of `inertial.LEVELS`."""
    camera_noise: bool = True
    """Noise, holes and exposure of the pictures; without it they are exact up to coding."""
    size: tuple[int, int] = (640, 480)
    """Width and height, pixels."""
    field_of_view_rad: float = math.pi / 2
    """Horizontal."""
    jpeg_quality: int = 90
    depth: str = "png"
    """png or rvl; a PNG takes half the bytes."""
    truth: bool = True
    """Write the topics of the truth."""

    @property
    def camera(self) -> Camera:
        """Pinhole with square pixels, axis through the middle."""
        width, height = self.size
        focal = width / 2 / math.tan(self.field_of_view_rad / 2)
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


@dataclass(frozen=True)
class LogReceipt:
    """What was written."""

    path: Path
    stamps_nanos: tuple[int, ...]
    """Of every image pair."""
    visible_objects: tuple[int, ...]
    """Of every image: objects with more than `VISIBLE_PIXELS`."""
    messages: dict[str, int]
    """By topic."""
    size_bytes: int


def record_log(
    path: Path,
    home: Home,
    robot: RobotSpec,
    drive: Drive,
    *,
    seed: int,
    options: LogOptions | None = None,
    observer: Observer | None = None,
    eye: Looker | None = None,
) -> LogReceipt:
    """Write a drive as a log, which appears whole or not at all.

    Args:
        path: file to write; an existing one is replaced.
        seed: of all noise, latencies and the date.
        observer: called at every keyframe in order, so that nobody has to look twice.
        eye: who looks, with the camera of the options; by default an `Eye`.

    Raises:
        SemslamError: the options make no sense, or the file cannot be written.
    """
    options = options or LogOptions()
    _check(options)
    if eye is None:
        from semslam.sim.eye import Eye  # brings MuJoCo along

        eye = Eye(home, options.camera)
    recording = _Recording(home, robot, drive, seed, options, observer, eye)
    messages: dict[str, int] = {}
    with Ros2LogWriter(path) as log:
        for log_time, topic, message in heapq.merge(*recording.streams(), key=lambda event: event[0]):
            log.write(topic, message, log_time)
            messages[topic] = messages.get(topic, 0) + 1
    return LogReceipt(path, recording.stamps, tuple(recording.visible), messages, path.stat().st_size)


def start_nanos(home: Home, seed: int) -> int:
    """When the log of a seed begins, Unix time: a home has its date, and its next day is one to fourteen days later."""
    rng = np.random.default_rng([home.seed, 0x5717, 0])
    date = int(rng.integers(_START_DAYS)) + home.day * int(rng.integers(1, 15))
    daytime = int(np.random.default_rng([seed, 0x5717, 1]).integers(_HOURS * 3600 * 10**9))
    return (_FIRST_START_S + 86400 * date) * 10**9 + daytime


def visible_count(sight: Sight, home: Home) -> int:
    """Objects with more than `VISIBLE_PIXELS` in a view, in proportion to its size; who walks about is none."""
    pixels = np.bincount(sight.instances.ravel())
    ids = [item.instance for item in home.objects if item.instance < len(pixels)]
    return int((pixels[ids] > VISIBLE_PIXELS * sight.instances.size / (640 * 480)).sum())


def _check(options: LogOptions) -> None:
    choices = (("noise", options.noise, tuple(LEVELS)), ("depth", options.depth, ("png", "rvl")))
    for name, value, known in choices:
        if value not in known:
            raise SemslamError(f"`{value}` is no {name} of a simulated log", hint=f"choose one of {', '.join(known)}")
    if min(options.size) < 8 or not 1 <= options.jpeg_quality <= 100:
        raise SemslamError(
            f"No camera takes pictures of {options.size[0]} x {options.size[1]} in quality {options.jpeg_quality}",
            hint="use a size like 640 x 480 and a quality from 1 to 100",
        )


class _Recording:
    """One log in the making: every stream is an iterator of events with rising log time."""

    def __init__(
        self,
        home: Home,
        robot: RobotSpec,
        drive: Drive,
        seed: int,
        options: LogOptions,
        observer: Observer | None,
        eye: Looker,
    ) -> None:
        self._home, self._robot, self._drive, self._seed = home, robot, drive, seed
        self._options, self._observer, self._eye = options, observer, eye
        self._start = start_nanos(home, seed)
        self._colour_camera = draw_colour_camera(self._rng(5))
        level = LEVELS[options.noise]
        self._gyro, self._accel = measure_imu(drive, level, self._rng(1))
        self._odometry = measure_odometry(drive, self._gyro, level, self._rng(2))
        self.stamps = tuple(self._stamps(drive.keyframes_s))
        self.visible: list[int] = []

    def streams(self) -> list[Iterator[Event]]:
        """Of all topics; the pictures last, for they take longest to come."""
        truth = [self._place(), self._true_poses()] if self._options.truth else []
        wheels = [self._odometry_messages(), self._transform_messages()]
        return [self._static(), self._imu(), *wheels, *truth, self._pictures()]

    def _rng(self, *concern: int) -> np.random.Generator:
        """Each concern its own randomness, so that leaving one out changes no other."""
        return np.random.default_rng([self._seed, 0x5E, *concern])

    def _stamps(self, times_s: NDArray[np.float64]) -> list[int]:
        return [self._start + round(time * 1e9) for time in np.asarray(times_s, np.float64).tolist()]

    def _logged(self, stamps: Sequence[int], topic: str, stream: int) -> list[int]:
        """Log times of messages with these stamps; a queue keeps their order."""
        least, more = _DELAY_MS[topic]
        delays = (least + self._rng(9, stream).gamma(2.0, more / 2, len(stamps))) * 1e6
        return list(np.maximum.accumulate(np.asarray(stamps, np.int64) + delays.astype(np.int64)).tolist())

    def _static(self) -> Iterator[Event]:
        stamp = self._start
        base_from_link = self._robot.base_from_camera @ invert(FLU_FROM_OPTICAL)
        links = (
            ("base_link", "camera_link", base_from_link),
            ("camera_link", CAMERA_FRAME, FLU_FROM_OPTICAL),
            ("base_link", IMU_FRAME, self._robot.base_from_imu),
        )
        message = Transforms(tuple(_transform(stamp, *link) for link in links))
        yield self._logged([stamp], TF_STATIC, 0)[0], TF_STATIC, message

    def _imu(self) -> Iterator[Event]:
        stamps = self._stamps(self._drive.times_s)
        logged = self._logged(stamps, IMU, 1)
        for stamp, log_time, gyro, accel in zip(stamps, logged, _single(self._gyro), _single(self._accel), strict=True):
            yield log_time, IMU, Imu(stamp, IMU_FRAME, _vector(gyro), _vector(accel), None)

    def _wheels(self) -> Iterator[tuple[int, Vector, Quaternion]]:
        """Stamp, place and direction by the wheels."""
        times, places, headings = self._odometry
        for stamp, (x, y), heading in zip(self._stamps(times), places.tolist(), headings.tolist(), strict=True):
            yield stamp, (x, y, 0.0), _facing(heading)

    def _odometry_messages(self) -> Iterator[Event]:
        logged = self._logged(self._stamps(self._odometry[0]), ODOMETRY, 2)
        for log_time, (stamp, at, facing) in zip(logged, self._wheels(), strict=True):
            yield log_time, ODOMETRY, Odometry(stamp, "odom", "base_link", at, facing)

    def _transform_messages(self) -> Iterator[Event]:
        logged = self._logged(self._stamps(self._odometry[0]), TF, 3)
        for log_time, (stamp, at, facing) in zip(logged, self._wheels(), strict=True):
            yield log_time, TF, Transforms((Transform(stamp, "odom", "base_link", at, facing),))

    def _place(self) -> Iterator[Event]:
        """What the home is like."""
        stamp = self._start
        log_time = self._logged([stamp], TF_STATIC, 4)[0]
        objects = tuple(_floor_object(item) for item in self._home.objects)
        yield log_time, OBJECTS, FloorObjects(stamp, WORLD, objects)
        for polygon in self._home.outline:
            log_time += 20_000
            yield log_time, OUTLINE, Polygon(stamp, WORLD, _points(polygon))

    def _true_poses(self) -> Iterator[Event]:
        drive = self._drive
        every = max(1, round(float(1.0 / (_POSE_HZ * np.median(np.diff(drive.times_s))))))
        stamps = self._stamps(drive.times_s[::every])
        positions, turns = drive.positions[::every].tolist(), drive.orientations[::every].tolist()
        logged = self._logged(stamps, POSE, 5)
        for stamp, log_time, position, (x, y, z, w) in zip(stamps, logged, positions, turns, strict=True):
            yield log_time, POSE, Pose(stamp, WORLD, _vector(position), (x, y, z, w))

    def _pictures(self) -> Iterator[Event]:
        """Pictures and calibrations of a keyframe, in the order in which they arrive."""
        logged = [self._logged(self.stamps, topic, 10 + number) for number, topic in enumerate(_DELAY_MS)]
        arrival = dict(zip(_DELAY_MS, logged, strict=True))
        for index, (stamp, time_s) in enumerate(zip(self.stamps, self._drive.keyframes_s.tolist(), strict=True)):
            info, info_time = _camera_info(stamp, self._options.camera), arrival[_INFO][index]
            events: list[Event] = [(info_time, COLOUR_INFO, info), (info_time + 40_000, DEPTH_INFO, info)]
            events += [(arrival[topic][index], topic, image) for topic, image in self._look(index, stamp, time_s)]
            yield from sorted(events, key=lambda event: event[0])

    def _look(self, index: int, stamp: int, time_s: float) -> Iterator[tuple[str, CompressedImage]]:
        """Topics and images of one keyframe."""
        world_from_camera = self._drive.world_from_base(time_s) @ self._robot.base_from_camera
        sight = self._eye.look(world_from_camera, time_s)
        if self._observer is not None:
            self._observer(index, stamp, sight, world_from_camera)
        self.visible.append(visible_count(sight, self._home))
        yield COLOUR, self._colour(index, stamp, sight)
        yield DEPTH, self._depth(index, stamp, sight)
        if self._options.truth:
            yield INSTANCES, CompressedImage(stamp, CAMERA_FRAME, "png", encode_png(sight.instances))
            yield CLASS_IMAGE, CompressedImage(stamp, CAMERA_FRAME, "png", encode_png(sight.classes))

    def _colour(self, index: int, stamp: int, sight: Sight) -> CompressedImage:
        rgb = sight.rgb
        if self._options.camera_noise:
            rgb = measure_rgb(rgb, self._rng(3, index), self._colour_camera)
        return CompressedImage(stamp, CAMERA_FRAME, JPEG_FORMAT, encode_jpeg(rgb, self._options.jpeg_quality))

    def _depth(self, index: int, stamp: int, sight: Sight) -> CompressedImage:
        if self._options.camera_noise:
            depth_mm = measure_depth(sight, self._rng(4, index))
        else:
            depth_mm = np.rint(np.clip(sight.depth_m, 0.0, 65.0) * np.float32(1000.0)).astype(np.uint16)
        if self._options.depth == "rvl":
            return CompressedImage(stamp, CAMERA_FRAME, RVL_DEPTH_FORMAT, encode_rvl_depth(depth_mm))
        return CompressedImage(stamp, CAMERA_FRAME, PNG_DEPTH_FORMAT, encode_png_depth(depth_mm, small=True))


def _single(values: NDArray[np.float64]) -> list[list[float]]:
    """Rows of numbers in single precision, as the chip's driver has them."""
    rows: list[list[float]] = values.astype(np.float32).astype(np.float64).tolist()
    return rows


def _vector(values: Sequence[float] | NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _facing(heading_rad: float) -> Quaternion:
    return 0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2)


def _points(polygon: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in polygon)


def _floor_object(item: Placed) -> FloorObject:
    at = (item.x_m, item.y_m, item.z_m)
    return FloorObject(
        item.instance,
        item.class_name,
        item.piece.style,
        at,
        _facing(item.yaw_rad),
        _points(item.footprint),
        item.piece.height_m,
    )


def _transform(stamp: int, parent: str, child: str, parent_from_child: Matrix) -> Transform:
    x, y, z, w = (float(value) for value in quaternion_from_matrix(parent_from_child))
    return Transform(stamp, parent, child, _vector(parent_from_child[:3, 3]), (x, y, z, w))


def _camera_info(stamp: int, camera: Camera) -> CameraInfo:
    k = (camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
    r = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    p = (camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    return CameraInfo(stamp, CAMERA_FRAME, camera.width, camera.height, "plumb_bob", (0.0,) * 5, k, r, p)
