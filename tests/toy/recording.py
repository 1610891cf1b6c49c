"""Records a drive through a toy room as an ordinary ROS 2 log, and keeps the truth for those who check results.

Writes one MCAP file: colour, depth and their calibration, IMU, wheel odometry, static transforms and the true pose.
The same plan gives the same bytes.

Frames: `world` (the room's), `odom`, `base_link` (on the floor), `camera_link`, `camera_color_optical_frame`,
`camera_depth_optical_frame`, `imu_link`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import quaternion_from_matrix
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
from semslam.logs.writer import (
    JPEG_FORMAT,
    PNG_DEPTH_FORMAT,
    RVL_DEPTH_FORMAT,
    Ros2LogWriter,
    encode_jpeg,
    encode_png_depth,
    encode_rvl_depth,
)
from tests.toy import robot
from tests.toy.render import Renderer, pinhole
from tests.toy.toyroom import RoomObject, ToyRoom, make_room

COLOUR_FRAME, DEPTH_FRAME, IMU_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame", "imu_link"
_START_NANOS = 1_773_480_600_000_000_000
"""14 March 2026, 09:30 UTC: any moment would do, but it must be the same one every time."""
_LEAD_S = 0.2
"""Sensors run this long before the first image and after the last."""
_IMU_HZ, _ODOMETRY_HZ = 100, 50
_LATENCY_NANOS = {"image": 25_000_000, "depth": 28_000_000, "info": 24_000_000, "imu": 1_000_000, "pose": 3_000_000}
"""Log time minus stamp."""

Event = tuple[int, str, Message]
"""Log time, topic, message. The stamp is earlier by the sensor's latency."""


@dataclass(frozen=True)
class Plan:
    """What to record."""

    seed: int = 0
    """Room, path and noise."""
    frames: int = 3
    """Pairs of colour and depth."""
    rate_hz: float = 1.0
    """Of the pairs."""
    size: tuple[int, int] = (320, 240)
    """Width and height of colour and depth, pixels."""
    compressed: bool = True
    """Colour as JPEG; else raw rgb8."""
    depth: str = "png"
    """png or rvl (compressedDepth), raw16 (16UC1, millimetres) or raw32 (32FC1, metres)."""
    imu: bool = True
    odometry: bool = True
    tf: bool = True
    """Static transforms; without them the IMU sits in the colour camera and has its axes."""
    truth: bool = True
    noise: bool = True
    """Noise and bias of depth, colour, IMU and wheels; without it they are exact up to rounding."""
    height_m: float = 0.55
    """Of the camera above the floor."""
    pitch_rad: float = math.radians(12.0)
    """How far the camera looks down."""
    depth_offset_m: Vector | None = None
    """Depth camera with its own frame and wider lens, this far forward, left and up of the colour camera; None gives
    depth that is registered to colour already."""


@dataclass(frozen=True)
class ToyTruth:
    """What the log was made from."""

    path: Path
    room: ToyRoom
    stamps_nanos: tuple[int, ...]
    """Of every pair."""
    poses: NDArray[np.float64]
    """(frames, 3) x, y and heading of base_link in the room: metres, radians."""
    colour_camera: Camera
    depth_camera: Camera
    base_from_camera: NDArray[np.float64]
    """4x4, of the colour camera's optical frame."""
    base_from_depth: NDArray[np.float64]
    """4x4, of the depth camera's optical frame."""

    @property
    def objects(self) -> tuple[RoomObject, ...]:
        """Furniture with class and footprint, room frame."""
        return self.room.objects


def record(path: Path, plan: Plan, progress: Callable[[int, int], None] | None = None) -> ToyTruth:
    """Drive, look, write; `progress` hears of pairs done and of all.

    Raises:
        ValueError: the plan asks for no frames or an unknown depth encoding.
        SemslamError: the file cannot be written.
    """
    if plan.frames < 1 or plan.depth not in _DEPTH_TOPICS:
        raise ValueError(f"no recording of {plan.frames} frames with depth as {plan.depth!r}")
    drive = _Drive(plan)
    with Ros2LogWriter(path) as log:
        done = 0
        for log_time, topic, message in heapq.merge(*drive.streams(), key=lambda event: event[0]):
            log.write(topic, message, log_time)
            if topic == _DEPTH_TOPICS[plan.depth]:
                done += 1
                if progress is not None:
                    progress(done, plan.frames)
    return drive.truth(path)


_DEPTH_TOPICS = {
    "png": "/camera/depth/image_raw/compressedDepth",
    "rvl": "/camera/depth/image_raw/compressedDepth",
    "raw16": "/camera/depth/image_raw",
    "raw32": "/camera/depth/image_raw",
}


class _Drive:
    """One recording in the making: every stream is an iterator of events with rising log time."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._room = make_room(plan.seed)
        self._path = robot.plan_path(self._room, plan.seed)
        width, height = plan.size
        self._colour = pinhole(width, height, math.radians(90))
        self._depth = self._colour if plan.depth_offset_m is None else pinhole(width, height, math.radians(96))
        self._base_from_link = robot.mount(0.1, 0.0, plan.height_m, pitch_rad=plan.pitch_rad)
        self._link_from_colour = robot.optical()
        self._link_from_depth = robot.optical(*(plan.depth_offset_m or (0.0, 0.0, 0.0)))
        self._base_from_imu = robot.mount(-0.05, 0.0, 0.12) if plan.tf else self._base_from_link @ robot.optical()
        self._image_times = _LEAD_S + np.arange(plan.frames) / plan.rate_hz
        self._end_s = float(self._image_times[-1]) + _LEAD_S

    def streams(self) -> list[Iterator[Event]]:
        """Of all sensors of the plan."""
        plan = self._plan
        wanted = (
            (plan.tf, self._transforms),
            (plan.imu, self._imu),
            (plan.odometry, self._odometry),
            (plan.truth, self._truth_poses),
            (True, self._pictures),
        )
        return [stream() for is_wanted, stream in wanted if is_wanted]

    def truth(self, path: Path) -> ToyTruth:
        """What was recorded."""
        times = self._image_times
        poses = np.column_stack([self._path.position(times), self._path.heading(times)])
        return ToyTruth(
            path,
            self._room,
            tuple(_stamp(time) for time in times),
            poses,
            self._colour,
            self._depth,
            self._base_from_link @ self._link_from_colour,
            self._base_from_link @ self._link_from_depth,
        )

    def _rng(self, sensor: int) -> np.random.Generator:
        """Each sensor its own noise, so that leaving one out changes no other."""
        return np.random.default_rng([self._plan.seed, 0x5E, sensor])

    def _transforms(self) -> Iterator[Event]:
        links = [("base_link", "camera_link", self._base_from_link)]
        links += [("camera_link", COLOUR_FRAME, self._link_from_colour)]
        if self._plan.depth_offset_m is not None:
            links += [("camera_link", DEPTH_FRAME, self._link_from_depth)]
        if self._plan.imu:
            links += [("base_link", IMU_FRAME, self._base_from_imu)]
        stamp = _stamp(0.0)
        yield stamp, "/tf_static", Transforms(tuple(_transform(stamp, *link) for link in links))

    def _imu(self) -> Iterator[Event]:
        times = np.arange(0.0, self._end_s, 1 / _IMU_HZ)
        noise = robot.ImuNoise() if self._plan.noise else robot.ImuNoise(0, 0, 0, 0)
        gyro, accel = robot.measure_imu(self._path, times, noise, self._rng(1), self._base_from_imu)
        frame = IMU_FRAME if self._plan.tf else COLOUR_FRAME
        for time, turn, force in zip(times, gyro, accel, strict=True):
            message = Imu(_stamp(time), frame, _vector(turn), _vector(force), None)
            yield message.stamp_nanos + _LATENCY_NANOS["imu"], "/imu/data_raw", message

    def _odometry(self) -> Iterator[Event]:
        times = np.arange(0.0, self._end_s, 1 / _ODOMETRY_HZ)
        noise = robot.OdometryNoise() if self._plan.noise else robot.OdometryNoise(0, 0, 0, 0)
        positions, headings = robot.measure_odometry(self._path, times, noise, self._rng(2))
        for time, (x, y), heading in zip(times, positions, headings, strict=True):
            at, facing = (float(x), float(y), 0.0), _facing(float(heading))
            message = Odometry(_stamp(time), "odom", "base_link", at, facing)
            yield message.stamp_nanos + _LATENCY_NANOS["pose"], "/odom", message

    def _truth_poses(self) -> Iterator[Event]:
        times = np.arange(0.0, self._end_s, 1 / _ODOMETRY_HZ)
        for time, (x, y), heading in zip(times, self._path.position(times), self._path.heading(times), strict=True):
            message = Pose(_stamp(time), "world", (float(x), float(y), 0.0), _facing(float(heading)))
            yield message.stamp_nanos + _LATENCY_NANOS["pose"], "/ground_truth/pose", message

    def _pictures(self) -> Iterator[Event]:
        renderer, rng = Renderer(self._room), self._rng(3)
        depth_frame = COLOUR_FRAME if self._plan.depth_offset_m is None else DEPTH_FRAME
        for time in self._image_times:
            stamp = _stamp(time)
            room_from_link = robot.base_pose(self._path, float(time)) @ self._base_from_link
            view = renderer.view(self._colour, room_from_link @ self._link_from_colour)
            depth_m = view.depth_m
            if self._plan.depth_offset_m is not None:
                depth_m = renderer.depth_m(self._depth, room_from_link @ self._link_from_depth)
            rgb, depth_mm = self._measured(view.rgb, depth_m, rng)
            info = stamp + _LATENCY_NANOS["info"]
            yield info, "/camera/color/camera_info", _camera_info(stamp, COLOUR_FRAME, self._colour)
            yield info, "/camera/depth/camera_info", _camera_info(stamp, depth_frame, self._depth)
            yield stamp + _LATENCY_NANOS["image"], *self._colour_message(stamp, rgb)
            yield stamp + _LATENCY_NANOS["depth"], *self._depth_message(stamp, depth_frame, depth_mm)

    def _measured(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Colour and depth as the sensors give them."""
        if not self._plan.noise:
            return rgb, np.round(depth_m * 1000).astype(np.uint16)
        noisy = rgb + rng.normal(0.0, 2.0, rgb.shape)
        return np.clip(noisy, 0, 255).astype(np.uint8), robot.measure_depth(depth_m, rng)

    def _colour_message(self, stamp: int, rgb: NDArray[np.uint8]) -> tuple[str, Message]:
        topic = "/camera/color/image_raw"
        if self._plan.compressed:
            return f"{topic}/compressed", CompressedImage(stamp, COLOUR_FRAME, JPEG_FORMAT, encode_jpeg(rgb, 90))
        return topic, _raw_image(stamp, COLOUR_FRAME, "rgb8", rgb)

    def _depth_message(self, stamp: int, frame: str, depth_mm: NDArray[np.uint16]) -> tuple[str, Message]:
        topic, kind = _DEPTH_TOPICS[self._plan.depth], self._plan.depth
        if kind == "raw16":
            return topic, _raw_image(stamp, frame, "16UC1", depth_mm)
        if kind == "raw32":
            metres = np.where(depth_mm > 0, depth_mm * np.float32(0.001), np.float32(np.nan)).astype(np.float32)
            return topic, _raw_image(stamp, frame, "32FC1", metres)
        if kind == "rvl":
            return topic, CompressedImage(stamp, frame, RVL_DEPTH_FORMAT, encode_rvl_depth(depth_mm))
        return topic, CompressedImage(stamp, frame, PNG_DEPTH_FORMAT, encode_png_depth(depth_mm))


def _stamp(time_s: float) -> int:
    return _START_NANOS + round(float(time_s) * 1e9)


def _vector(values: NDArray[np.float64]) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def _facing(heading_rad: float) -> Quaternion:
    return 0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2)


def _transform(stamp: int, parent: str, child: str, parent_from_child: NDArray[np.float64]) -> Transform:
    x, y, z, w = (float(value) for value in quaternion_from_matrix(parent_from_child))
    return Transform(stamp, parent, child, _vector(parent_from_child[:3, 3]), (x, y, z, w))


def _camera_info(stamp: int, frame: str, camera: Camera) -> CameraInfo:
    k = (camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
    r = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    p = (camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    return CameraInfo(stamp, frame, camera.width, camera.height, "plumb_bob", (0.0,) * 5, k, r, p)


def _raw_image(stamp: int, frame: str, encoding: str, pixels: NDArray[np.generic]) -> Image:
    """Rows packed, little endian."""
    height, width = pixels.shape[:2]
    return Image(stamp, frame, height, width, encoding, pixels.nbytes // height, False, pixels.tobytes())
