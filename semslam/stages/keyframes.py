"""Keyframes of a log, one pass over its messages: pairing, choosing, registering, levelling, motion, truth.

Used by the ingest stage alone. Memory is bounded by a few seconds of messages. A keyframe leaves when everything that
speaks about its moment has been read: the IMU window around it, odometry and truth past it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.camera import Camera
from semslam.geometry.frame_tree import FrameTree
from semslam.geometry.frames import SE2, Matrix, invert, matrix_from_pose, planar, wrap_angle
from semslam.geometry.levelling import FloorTracker, GravityFilter, floor_height, roll_pitch
from semslam.geometry.motion import ImuIntegrator, PoseTrack, motion_between
from semslam.geometry.registration import register_depth
from semslam.geometry.rig import ASSUMED_HEIGHT_M, MAX_GAP_NANOS, Attitude, Rig, decide_rig
from semslam.logs.clock import StampClock
from semslam.logs.decode import decoder_for, kind_of
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
from semslam.logs.pairing import PairBuffer, Stamped
from semslam.logs.reader import Channel, LogReader, RawMessage
from semslam.logs.roles import Roles, TopicSeen, frame_of
from semslam.stages.settings import IngestConfig
from semslam.tables.pictures import encode_colour, encode_depth

_SLACK_NANOS = 10_000_000
"""A keyframe may come this much before its period is over: cameras jitter."""
_EDGE_NANOS = 50_000_000
"""A pose wanted this close outside a track takes the track's end."""
_MEMORY_NANOS = 20_000_000_000
"""Tracks and transforms older than this are forgotten."""
_PATIENCE_NANOS = 3_000_000_000
"""A keyframe waits no longer for data about its moment, in log time."""
_TIDY_MESSAGES = 1000
"""So many messages from one forgetting to the next."""
_CONTINUOUS = "odom"
"""Frame in which the robot's pose never jumps, by convention (ROS REP 105)."""
_ACCEL_SAMPLES = 500
_GRAVITY_IN_G = (0.8, 1.2)
_PLAUSIBLE_DEPTH_M = (0.1, 30.0)
"""Medians of depth images beyond these are a wrong unit, or no room for a robot."""
_MAX_WARNINGS = 100
_LAST_NANOS = 2**63 - 2**50
"""Latest time taken for one; arithmetic on stamps stays within int64."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Keyframe:
    """One keyframe as rows of the ingest tables."""

    frame: Row
    motion: Row
    truth: Row | None
    floor_m: float | None
    """Floor found in this frame, metres relative to the camera; None without one."""


@dataclass(frozen=True)
class _Moment:
    """Where odometry and tf had the robot at a stamp, kept so that a step may be longer than the memory of tracks."""

    stamp_nanos: int
    odometry: Matrix | None
    tf: Matrix | None


@dataclass(frozen=True)
class _Picture:
    """What a keyframe keeps of its images."""

    colour: Stamped
    depth_stamp_nanos: int
    colour_bytes: bytes
    depth_bytes: bytes
    camera: Camera
    points: NDArray[np.float64]
    """(N, 3) sparse points in the camera frame."""


class KeyframeWalk:
    """Walks through a log once and yields its keyframes.

    Args:
        reader: the log.
        roles: which topic is what; colour, depth and colour_info must be there.
        config: of the ingest stage.
        known: floor heights by stamp of keyframes that an earlier run published; they are not decoded again, and their
            rows have no images.
        statics: static transforms found ahead, since a recorder may log them late.
    """

    def __init__(
        self,
        reader: LogReader,
        roles: Roles,
        config: IngestConfig,
        known: Mapping[int, float | None],
        statics: Iterable[Transforms] = (),
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.warnings: list[str] = []
        self.topics: dict[Channel, TopicTally] = {}
        self.clock = StampClock()
        self._reader, self._roles, self._config, self._known = reader, roles, config, known
        self._role_of = {seen.channel: role for role, seen in roles.topics.items()}
        self._decoders: dict[Channel, Callable[[bytes], Message] | None] = {}
        self._infos = {role: seen.first for role, seen in roles.topics.items() if role.endswith("_info")}
        self.tree = FrameTree()
        for transforms in statics:
            self._add_transforms(transforms.transforms, 0, static=True)
        self._tracks = {"odometry": PoseTrack(), "truth": PoseTrack()}
        self._child = {"odometry": "", "truth": config.truth_frame.lstrip("/")}
        self._gravity = GravityFilter()
        self._imu = ImuIntegrator()
        self._floor = FloorTracker()
        self._pairs = PairBuffer(round(config.pair_tolerance_s * 1e9))
        self._candidates: deque[tuple[Stamped, Stamped]] = deque()
        self._waiting: deque[_Picture | Stamped] = deque()
        self._rig: Rig | None = None
        self._chosen: _Moment | None = None
        self._previous: _Moment | None = None
        self._frames = 0
        self._now = 0
        self._newest: dict[str, int] = {}
        self._taken = 0
        self._accel: list[float] = []

    # ---- the walk -------------------------------------------------------------------------------------------------

    def keyframes(self) -> Iterator[Keyframe]:
        """All keyframes in stamp order."""
        for raw in self._reader.messages():
            self._take(raw)
            yield from self._ready(ended=False)
        self._candidates.extend(self._pairs.finish())
        self._count_unpaired()
        self._choose(ended=True)
        yield from self._ready(ended=True)

    def _take(self, raw: RawMessage) -> None:
        self._taken += 1
        if self._taken % _TIDY_MESSAGES == 0:
            self._forget()
        tally = self.topics.setdefault(raw.channel, TopicTally())
        if raw.log_time > _LAST_NANOS:
            tally.skip(f"log time {raw.log_time} ns lies beyond the year 2262")
            return
        tally.see(raw.log_time)
        self._now = max(self._now, raw.log_time)
        decode = self._decoder(raw.channel, tally)
        if decode is None:
            return
        try:
            self._use(raw.channel, decode(raw.data), raw.log_time)
        except SemslamError as error:
            tally.skip(error.message)
            self.counts["messages_undecodable"] += 1

    def _decoder(self, channel: Channel, tally: TopicTally) -> Callable[[bytes], Message] | None:
        if channel not in self._decoders:
            self._decoders[channel] = None
            if channel in self._role_of or kind_of(channel) == "transforms":
                try:
                    self._decoders[channel] = decoder_for(channel)
                except SemslamError as error:
                    tally.reason = error.message
        return self._decoders[channel]

    def _use(self, channel: Channel, message: Message, log_time: int) -> None:
        if isinstance(message, Transforms):
            self._use_transforms(channel, message, log_time)
            return
        role = self._role_of[channel]
        stamp = self._stamp(channel, message.stamp_nanos, log_time)
        self._newest[role] = max(stamp, self._newest.get(role, stamp))
        if isinstance(message, Image | CompressedImage):
            self._candidates.extend(self._pairs.push(role, Stamped(stamp, log_time, message)))
            self._count_unpaired()
            self._choose(ended=False)
        elif isinstance(message, Imu):
            if len(self._accel) < _ACCEL_SAMPLES:
                self._accel.append(float(np.linalg.norm(message.accel)))
            self._gravity.add(stamp, message.gyro, message.accel)
            self._imu.add(stamp, message.gyro, message.accel)
        elif isinstance(message, Odometry | Pose):
            self._child[role] = getattr(message, "child_frame_id", "").lstrip("/") or self._child[role]
            self._tracks[role].add(stamp, matrix_from_pose(message.position, message.orientation))
        elif isinstance(message, CameraInfo):
            self._infos[role] = message

    def _stamp(self, channel: Channel, stamp_nanos: int, log_time: int) -> int:
        if not 0 <= stamp_nanos <= _LAST_NANOS:
            raise SemslamError(f"stamp of {stamp_nanos} ns is no time")
        return self.clock.stamp(channel.topic, stamp_nanos, log_time)

    def _use_transforms(self, channel: Channel, message: Transforms, log_time: int) -> None:
        for t in message.transforms:
            stamp = self._stamp(channel, t.stamp_nanos, log_time)
            self._newest["tf"] = max(stamp, self._newest.get("tf", stamp))
            self._add_transforms((t,), stamp, static="static" in channel.topic)

    def _add_transforms(self, transforms: Iterable[Transform], stamp: int, *, static: bool) -> None:
        for t in transforms:
            self.tree.add(t.parent, t.child, stamp, t.translation, t.orientation, static)

    def _count_unpaired(self) -> None:
        self.counts["colour_unpaired"] += self._pairs.unpaired
        self.counts["images_out_of_order"] += self._pairs.disordered
        self._pairs.unpaired = self._pairs.disordered = 0

    # ---- choosing -------------------------------------------------------------------------------------------------

    def _choose(self, *, ended: bool) -> None:
        """Move candidates that become keyframes to the waiting line."""
        while self._candidates:
            colour, depth = self._candidates[0]
            if not (ended or self._config.keyframes == "time" or self._can_speak(colour)):
                return
            self._candidates.popleft()
            self.counts["pairs"] += 1
            if self._is_due(colour.stamp_nanos):
                self._develop(colour, depth)

    def _can_speak(self, colour: Stamped) -> bool:
        """Whether motion up to the image is known, or will not come any more."""
        newest = self._tracks["odometry"].last
        return (newest is not None and newest >= colour.stamp_nanos) or self._waited_too_long(colour)

    def _waited_too_long(self, colour: Stamped) -> bool:
        return self._now - colour.log_time_nanos > _PATIENCE_NANOS

    def _is_due(self, stamp: int) -> bool:
        if self._chosen is None:
            return True
        elapsed = stamp - self._chosen.stamp_nanos
        period = round(self._config.period_s * 1e9)
        late = elapsed >= period - min(_SLACK_NANOS, period // 10)
        if self._config.keyframes == "time":
            return late
        here = self._rough_moment(stamp)
        moved = motion_between(self._chosen.odometry, here.odometry) or motion_between(self._chosen.tf, here.tf)
        if moved is None:
            return late  # nobody can say whether the robot moved: go by time
        far = float(np.hypot(moved.x_m, moved.y_m)) >= self._config.min_distance_m
        return far or abs(moved.heading_rad) >= self._config.min_turn_rad

    def _develop(self, colour: Stamped, depth: Stamped) -> None:
        """Decode and register a chosen pair; a damaged one is counted and its successor chosen instead."""
        if colour.stamp_nanos in self._known:
            self._waiting.append(colour)
            self._chosen = self._rough_moment(colour.stamp_nanos)
            return
        try:
            picture = self._picture(colour, depth)
        except SemslamError as error:
            self.counts["pairs_damaged"] += 1
            self._warn(f"frame at {colour.stamp_nanos} ns skipped: {error.message}")
            return
        self._waiting.append(picture)
        self._chosen = self._rough_moment(colour.stamp_nanos)

    def _picture(self, colour: Stamped, depth: Stamped) -> _Picture:
        rgb = decode_colour(colour.message)
        depth_m = decode_depth(depth.message, self._config.depth_unit_m)
        colour_camera = self._camera("colour_info", rgb.shape[:2])
        depth_camera = self._camera("depth_info", depth_m.shape[:2])
        pinhole = colour_camera.rectified()
        colour_from_depth = self._colour_from_depth(colour, depth)
        registered = register_depth(depth_m, depth_camera, pinhole, colour_from_depth)
        return _Picture(
            colour,
            depth.stamp_nanos,
            _colour_file(colour.message, rgb, colour_camera),
            encode_depth(registered),
            pinhole,
            _sparse_points(registered, pinhole),
        )

    def _camera(self, role: str, shape: tuple[int, int]) -> Camera:
        info = self._infos.get(role) or self._infos.get("colour_info")
        if not isinstance(info, CameraInfo):
            raise SemslamError(f"no {role} message yet")
        height, width = shape
        camera = Camera.from_info(info.width, info.height, info.k, info.model, info.distortion)
        if (info.width, info.height) == (width, height):
            return camera
        scale = width / info.width
        if abs(height - info.height * scale) > 1.0:
            raise SemslamError(f"image is {width}x{height}, its {role} says {info.width}x{info.height}")
        self._warn(f"{role} is for {info.width}x{info.height}, images are {width}x{height}: intrinsics scaled")
        return camera.scaled(width, height)

    def _colour_from_depth(self, colour: Stamped, depth: Stamped) -> Matrix:
        to, source = frame_of(colour.message).lstrip("/"), frame_of(depth.message).lstrip("/")
        if to == source:
            return np.eye(4)
        found = self.tree.lookup(to, source, colour.stamp_nanos, MAX_GAP_NANOS) if to and source else None
        if found is None:
            self._warn(f"tf does not connect depth frame `{source}` to colour frame `{to}`: taken to be in one place")
            return np.eye(4)
        return found

    # ---- finishing ------------------------------------------------------------------------------------------------

    def _ready(self, *, ended: bool) -> Iterator[Keyframe]:
        """Keyframes about which everything is known, oldest first."""
        while self._waiting and (ended or self._is_ready(_colour_of(self._waiting[0]))):
            yield self._finish(self._waiting.popleft())

    def _is_ready(self, colour: Stamped) -> bool:
        if self._waited_too_long(colour):
            return True
        stamp = colour.stamp_nanos
        tracks = [track.last for role, track in self._tracks.items() if role in self._roles.topics]
        known = all(last is not None and last >= stamp for last in tracks)
        return known and ("imu" not in self._roles.topics or self._gravity.ready(stamp))

    def _finish(self, waiting: _Picture | Stamped) -> Keyframe:
        colour = _colour_of(waiting)
        stamp = colour.stamp_nanos
        rig = self._rig or self._settle_rig(colour)
        attitude = self._attitude(rig, stamp)
        floor = self._known[stamp] if isinstance(waiting, Stamped) else _floor(waiting, attitude)
        height, height_source = self._height(rig, attitude, stamp, floor)
        here = self._moment(stamp)
        motion, source = self._motion(self._previous, here) if self._previous is not None else (None, "start")
        keyframe = Keyframe(
            frame=self._frame_row(waiting, attitude, height, height_source),
            motion=self._motion_row(stamp, motion, source),
            truth=self._truth_row(stamp),
            floor_m=floor,
        )
        self._count(attitude, height_source, source)
        if isinstance(waiting, _Picture):
            self._judge_depth(waiting.points[:, 2])
        self._previous, self._frames = here, self._frames + 1
        return keyframe

    def _settle_rig(self, colour: Stamped) -> Rig:
        imu = self._roles.topics.get("imu")
        self._rig = decide_rig(
            self.tree,
            camera=frame_of(colour.message),
            imu=frame_of(imu.first) if imu else "",
            odometry_child=self._child["odometry"],
            wanted=self._config.robot_frame,
            levelling=self._config.levelling,
        )
        for note in self._rig.notes:
            self._warn(note)
        return self._rig

    def _attitude(self, rig: Rig, stamp: int) -> Attitude:
        up = self._gravity.up_at(stamp)
        attitude = rig.attitude(self.tree, stamp, up)
        if attitude is None:
            self._warn(f"tf has gaps between `{rig.body}` and `{rig.camera}`: the nearest transform is used")
            known = self.tree.known_between(rig.body, rig.camera)
            near = stamp if known is None else min(max(stamp, known[0]), known[1])
            attitude = rig.attitude(self.tree, near, up)
        if attitude is None:
            attitude = Rig("", rig.camera, rig.imu, rig.levelling, ()).attitude(self.tree, stamp, up)
            self.counts["frames_without_camera_pose"] += 1
        assert attitude is not None  # a rig without a body needs no tf
        return attitude

    def _height(self, rig: Rig, attitude: Attitude, stamp: int, floor: float | None) -> tuple[float, str]:
        """Height of the camera above the floor and where it comes from."""
        tracked, source = self._floor.update(stamp, floor)
        from_tf = float(attitude.level_from_camera[2, 3])
        if self._config.camera_height_m > 0:
            return self._config.camera_height_m, "config"
        if rig.body == "base_footprint":
            return from_tf, "tf"
        if tracked is not None and source is not None:
            return tracked, source
        if rig.is_base and from_tf > 0:
            return from_tf, "tf"
        self._warn(
            f"no floor seen and no camera height known: {ASSUMED_HEIGHT_M} m assumed; set ingest.camera_height_m"
        )
        return ASSUMED_HEIGHT_M, "none"

    def _moment(self, stamp: int) -> _Moment:
        return _Moment(stamp, self._pose("odometry", stamp), self._pose_from_tf(stamp))

    def _rough_moment(self, stamp: int) -> _Moment:
        """The same for choosing keyframes, which begins before it is settled which frame is the robot's."""
        return _Moment(stamp, self._pose_of_child("odometry", stamp), self._pose_from_tf(stamp))

    def _motion(self, start: _Moment, stop: _Moment) -> tuple[SE2 | None, str]:
        """Motion of the robot between two moments, in its frame at the first, from the best source that knows it."""
        sources: dict[str, Callable[[], SE2 | None]] = {
            "odometry": lambda: motion_between(start.odometry, stop.odometry),
            "tf": lambda: motion_between(start.tf, stop.tf),
            "imu": lambda: self._motion_from_imu(start.stamp_nanos, stop.stamp_nanos),
        }
        for source in sources if self._config.motion == "auto" else [self._config.motion]:
            motion = sources[source]() if source in sources else None
            if motion is not None:
                return motion, source
        return None, "none"

    def _motion_from_imu(self, start: int, stop: int) -> SE2 | None:
        if "imu" not in self._roles.topics:
            return None
        motion = self._imu.motion(start, stop, self._gravity.up_at(start))
        if motion is None or self._rig is None:
            return motion
        body_from_imu = self._rig.body_from(self.tree, self._rig.imu, start)
        if body_from_imu is None:
            return motion
        robot_from_imu = planar(body_from_imu)
        return robot_from_imu @ motion @ robot_from_imu.inverse()

    def _pose(self, role: str, stamp: int) -> Matrix | None:
        """world_from_body from a track of poses, in that track's own world."""
        world_from_child = self._pose_of_child(role, stamp)
        if world_from_child is None or self._rig is None or not self._child[role]:
            return world_from_child
        body_from_child = self._rig.body_from(self.tree, self._child[role], stamp)
        if body_from_child is None:
            return world_from_child
        return np.asarray(world_from_child @ invert(body_from_child))

    def _pose_of_child(self, role: str, stamp: int) -> Matrix | None:
        """world_from_child as the messages of a role tell it, interpolated."""
        track = self._tracks[role]
        return track.at(_into(stamp, track.first, track.last), round(self._config.motion_gap_s * 1e9))

    def _pose_from_tf(self, stamp: int) -> Matrix | None:
        body = self._rig.body if self._rig else ""
        root = self.tree.root_of(body) if body else None
        if self.tree.known_between(_CONTINUOUS, body) is not None:
            root = _CONTINUOUS  # above it, localisation may jump, and a jump is no motion
        if root is None or root == body or self.tree.is_static_path(root, body):
            return None
        return self.tree.lookup(root, body, stamp, round(self._config.motion_gap_s * 1e9))

    # ---- rows -----------------------------------------------------------------------------------------------------

    def _frame_row(self, waiting: _Picture | Stamped, attitude: Attitude, height: float, source: str) -> Row:
        robot_from_camera = attitude.level_from_camera.copy()
        robot_from_camera[2, 3] = height
        colour = _colour_of(waiting)
        row: Row = {
            "frame": self._frames,
            "stamp_nanos": colour.stamp_nanos,
            "log_time_nanos": colour.log_time_nanos,
            "robot_from_camera": [float(value) for value in robot_from_camera.ravel()],
            "roll_rad": attitude.roll_rad,
            "pitch_rad": attitude.pitch_rad,
            "level_source": attitude.source,
            "camera_height_m": height,
            "height_source": source,
        }
        if isinstance(waiting, _Picture):
            camera = waiting.camera
            row |= {
                "colour": waiting.colour_bytes,
                "depth": waiting.depth_bytes,
                "depth_offset_nanos": waiting.depth_stamp_nanos - colour.stamp_nanos,
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
            }
        return row

    def _motion_row(self, stamp: int, motion: SE2 | None, source: str) -> Row:
        return {
            "frame": self._frames,
            "stamp_nanos": stamp,
            "dx_m": motion.x_m if motion else None,
            "dy_m": motion.y_m if motion else None,
            "dheading_rad": wrap_angle(motion.heading_rad) if motion else None,
            "source": source,
        }

    def _truth_row(self, stamp: int) -> Row | None:
        if "truth" not in self._roles.topics:
            return None
        world_from_body = self._pose("truth", stamp)
        if world_from_body is None:
            self.counts["frames_without_truth"] += 1
            return None
        pose = planar(world_from_body)
        roll, pitch = roll_pitch(world_from_body[2, :3])
        return {
            "frame": self._frames,
            "stamp_nanos": stamp,
            "x_m": pose.x_m,
            "y_m": pose.y_m,
            "z_m": float(world_from_body[2, 3]),
            "heading_rad": pose.heading_rad,
            "roll_rad": roll,
            "pitch_rad": pitch,
        }

    # ---- keeping order --------------------------------------------------------------------------------------------

    def _count(self, attitude: Attitude, height_source: str, motion_source: str) -> None:
        self.counts[f"level_{attitude.source}"] += 1
        self.counts[f"height_{height_source}"] += 1
        self.counts[f"motion_{motion_source}"] += 1

    def _judge_depth(self, depth_m: NDArray[np.float64]) -> None:
        if depth_m.size == 0:
            self.counts["frames_without_depth"] += 1
        elif not _PLAUSIBLE_DEPTH_M[0] <= float(np.median(depth_m)) <= _PLAUSIBLE_DEPTH_M[1]:
            self.counts["frames_of_implausible_depth"] += 1

    def _forget(self) -> None:
        """Keep some seconds of everything: a robot may be recorded for hours without a picture."""
        before = {role: newest - _MEMORY_NANOS for role, newest in self._newest.items()}
        if "tf" in before:
            self.tree.forget_before(before["tf"])
        if "imu" in before:
            self._gravity.forget_before(before["imu"])
            self._imu.forget_before(before["imu"])
        for role in before.keys() & self._tracks.keys():
            self._tracks[role].forget_before(before[role])

    def log_warnings(self) -> Iterator[str]:
        """What is known of the whole log at its end, for the user."""
        for channel, tally in sorted(self.topics.items(), key=lambda item: item[0].topic):
            if tally.skipped:
                of = f"{tally.skipped:,} of {tally.messages:,} messages of `{channel.topic}`"
                yield f"{of} cannot be used: {tally.reason}"
            if jumps := self.clock.jumps(channel.topic):
                yield f"the clock of `{channel.topic}` was set {jumps} times meanwhile; stamps are corrected"
        for problem in self.tree.problems():
            yield f"frames: {problem}"
        if self._accel and _GRAVITY_IN_G[0] <= float(np.median(self._accel)) <= _GRAVITY_IN_G[1]:
            yield "the accelerometer seems to measure in g, not in m/s^2: it cannot level the camera"

    def start_notes(self) -> None:
        """Begin counts and warnings anew: each shard tells its own, so that a resumed run tells the same."""
        self.counts.clear()
        self.warnings.clear()

    def _warn(self, message: str) -> None:
        """Remember a sentence for the user, once; frame by frame damage is bounded."""
        if message not in self.warnings and len(self.warnings) < _MAX_WARNINGS:
            self.warnings.append(message)


@dataclass
class TopicTally:
    """What was read of one topic."""

    messages: int = 0
    skipped: int = 0
    reason: str | None = None
    first_log_time: int | None = None
    last_log_time: int | None = None
    max_gap_nanos: int | None = None

    def see(self, log_time: int) -> None:
        """Count a message."""
        self.messages += 1
        if self.last_log_time is None:
            self.first_log_time = log_time
        else:
            self.max_gap_nanos = max(self.max_gap_nanos or 0, log_time - self.last_log_time)
        self.last_log_time = log_time

    def skip(self, reason: str) -> None:
        """Count a message that could not be used; the first reason is kept."""
        self.skipped += 1
        self.reason = self.reason or reason


def static_transforms(seen: Iterable[TopicSeen]) -> list[Transforms]:
    """Static transforms among the first messages of a log, for a recorder that writes them late."""
    return [t.first for t in seen if isinstance(t.first, Transforms) and "static" in t.channel.topic]


def _colour_of(waiting: _Picture | Stamped) -> Stamped:
    return waiting if isinstance(waiting, Stamped) else waiting.colour


def _into(stamp: int, first: int | None, last: int | None) -> int:
    """The stamp, moved onto the nearer end of a track if it lies just outside."""
    if first is not None and first - _EDGE_NANOS <= stamp < first:
        return first
    if last is not None and last < stamp <= last + _EDGE_NANOS:
        return last
    return stamp


def _colour_file(message: Image | CompressedImage, rgb: NDArray[np.uint8], camera: Camera) -> bytes:
    """The picture as a JPEG or PNG file; the recorded file itself where nothing has to change."""
    if camera.is_pinhole and isinstance(message, CompressedImage) and message.data[:2] in (b"\xff\xd8", b"\x89P"):
        return bytes(message.data)
    return encode_colour(rgb if camera.is_pinhole else camera.rectify(rgb, cv2.INTER_LINEAR))


def _sparse_points(depth_m: NDArray[np.float32], camera: Camera, step: int = 4) -> NDArray[np.float64]:
    """(N, 3) points in the camera frame from every `step`-th pixel that has depth."""
    rows, columns = np.mgrid[step // 2 : depth_m.shape[0] : step, step // 2 : depth_m.shape[1] : step]
    z = depth_m[rows, columns].astype(np.float64)
    seen = z > 0
    z, u, v = z[seen], columns[seen], rows[seen]
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)


def _floor(picture: _Picture, attitude: Attitude) -> float | None:
    """Height of the floor relative to the camera, along level z."""
    return floor_height(picture.points @ attitude.level_from_camera[:3, :3].T)
