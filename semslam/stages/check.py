"""`ingest --check`: what a log holds and whether it can become a map, without processing it.

One pass over the messages (rates, gaps, clock jumps, units, calibration, frame tree, pairing), then the first keyframe
as a picture: colour, and depth drawn over it, so that a wrong registration or unit is seen at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.camera import Camera
from semslam.geometry.frame_tree import FrameTree
from semslam.geometry.frames import matrix_from_pose
from semslam.logs.clock import StampClock
from semslam.logs.decode import decoder_for, kind_of
from semslam.logs.messages import CameraInfo, CompressedImage, Image, Imu, Message, Odometry, Pose, Transforms
from semslam.logs.pairing import PairBuffer, Stamped
from semslam.logs.reader import Channel, LogReader, RawMessage
from semslam.logs.roles import Roles, TopicSeen, choose_roles, frame_of, peek
from semslam.stages.keyframes import KeyframeWalk, TopicTally, static_transforms
from semslam.stages.settings import IngestConfig
from semslam.tables.pictures import decode_colour, decode_depth, encode_colour

_STANDARD_GRAVITY = 9.80665
_SAMPLES = 20_000
"""So many readings are enough for a median."""
_TIDY_MESSAGES = 1000
_MEMORY_NANOS = 20_000_000_000


@dataclass(frozen=True)
class Finding:
    """One thing a person should know. `level` is ok, warning or error; an error means no map."""

    level: str
    message: str
    hint: str = ""


@dataclass(frozen=True)
class TopicLine:
    """One topic of the log, as shown."""

    topic: str
    schema_name: str
    message_encoding: str
    role: str
    why: str
    messages: int
    rate_hz: float | None
    max_gap_s: float | None
    clock_jumps: int


@dataclass(frozen=True)
class CheckReport:
    """Everything `--check` found."""

    log: str
    duration_s: float
    topics: tuple[TopicLine, ...]
    findings: tuple[Finding, ...]
    losses: Mapping[str, Any]
    picture: str | None = None

    @property
    def ok(self) -> bool:
        """Whether ingest can make keyframes of the log."""
        return not any(finding.level == "error" for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Plain values, for `--json`."""
        return asdict(self) | {"ok": self.ok}

    def text(self) -> str:
        """For a terminal."""
        lines = [f"{self.log}   {self.duration_s:.1f} s, {len(self.topics)} topics", ""]
        lines += _topic_table(self.topics)
        lines += ["", *(_finding_line(finding) for finding in self.findings)]
        if self.picture:
            lines += ["", f"first keyframe: {self.picture}"]
        lines += ["", "usable: yes" if self.ok else "usable: no"]
        return "\n".join(lines)


def check_log(paths: Sequence[Path], config: IngestConfig, picture: Path | None) -> CheckReport:
    """Look a log over.

    Args:
        paths: files of one recording, in order.
        config: as ingest would have it.
        picture: where to write the first keyframe (PNG); None for no picture.
    """
    seen = peek(LogReader(paths))
    roles = choose_roles(seen, config.topics)
    reader = LogReader(paths)
    survey = _Survey(reader, roles, config)
    survey.read()
    findings = [*_role_findings(seen, roles), *survey.findings(), *_loss_findings(reader)]
    drawn = None
    if picture is not None and not any(finding.level == "error" for finding in findings):
        more, drawn = _draw_first(paths, roles, seen, config, picture)
        findings += more
    return CheckReport(
        log=paths[0].stem,
        duration_s=survey.duration_s,
        topics=tuple(_topic_lines(reader, roles, survey)),
        findings=tuple(findings),
        losses=reader.losses.as_json(),
        picture=str(drawn) if drawn else None,
    )


@dataclass
class _Survey:
    """What one pass over the messages tells."""

    reader: LogReader
    roles: Roles
    config: IngestConfig
    tallies: dict[Channel, TopicTally] = field(default_factory=dict)
    clock: StampClock = field(default_factory=StampClock)
    tree: FrameTree = field(default_factory=FrameTree)
    paired: int = 0
    accel: list[float] = field(default_factory=list)
    gyro: list[float] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)
    infos: dict[str, CameraInfo] = field(default_factory=dict)
    image_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    earliest: int | None = None
    latest: int = 0

    @property
    def duration_s(self) -> float:
        """Log time from first to last message."""
        return 0.0 if self.earliest is None else (self.latest - self.earliest) / 1e9

    def __post_init__(self) -> None:
        self.pairs = PairBuffer(round(self.config.pair_tolerance_s * 1e9))

    def read(self) -> None:
        """Read every message once."""
        role_of = {topic.channel: role for role, topic in self.roles.topics.items()}
        decoders: dict[Channel, Callable[[bytes], Message] | None] = {}
        for raw in self.reader.messages():
            tally = self.tallies.setdefault(raw.channel, TopicTally())
            tally.see(raw.log_time)
            self.earliest = raw.log_time if self.earliest is None else min(self.earliest, raw.log_time)
            self.latest = max(self.latest, raw.log_time)
            if raw.channel not in decoders:
                decoders[raw.channel] = _decoder(raw.channel, role_of)
            decode = decoders[raw.channel]
            if decode is not None:
                self._decode(raw, decode, role_of.get(raw.channel, "tf"), tally)
        self.paired += sum(1 for _ in self.pairs.finish())

    def _decode(self, raw: RawMessage, decode: Callable[[bytes], Message], role: str, tally: TopicTally) -> None:
        try:
            message = decode(raw.data)
            if isinstance(message, Odometry | Pose):
                matrix_from_pose(message.position, message.orientation)
        except SemslamError as error:
            tally.skip(error.message)
            return
        if isinstance(message, Transforms):
            static = "static" in raw.channel.topic
            for t in message.transforms:
                stamp = self.clock.stamp(raw.channel.topic, t.stamp_nanos, raw.log_time)
                self.tree.add(t.parent, t.child, stamp, t.translation, t.orientation, static)
                if tally.messages % _TIDY_MESSAGES == 0:
                    self.tree.forget_before(stamp - _MEMORY_NANOS)
            return
        stamp = self.clock.stamp(raw.channel.topic, message.stamp_nanos, raw.log_time)
        if isinstance(message, Image | CompressedImage):
            if len(self.offsets) < _SAMPLES:
                self.offsets.append(raw.log_time - stamp)
            self.paired += sum(
                1 for _ in self.pairs.push(role, Stamped(stamp, raw.log_time, replace(message, data=b"")))
            )
            if isinstance(message, Image):
                self.image_sizes[role] = (message.width, message.height)
        elif isinstance(message, CameraInfo):
            self.infos[role] = message
        elif isinstance(message, Imu) and len(self.accel) < _SAMPLES:
            self.accel.append(float(np.linalg.norm(message.accel)))
            self.gyro.append(float(np.linalg.norm(message.gyro)))

    def findings(self) -> Iterator[Finding]:
        """Sanity of pairing, clocks, units, calibration and frames."""
        yield from self._pairing()
        yield from self._clocks()
        yield from self._imu_units()
        for role, info in sorted(self.infos.items()):
            yield from _calibration(role, info, self.image_sizes.get(role.removesuffix("_info")))
        yield from self._frames()

    def _pairing(self) -> Iterator[Finding]:
        colour = self.roles.topics.get("colour")
        if colour is None or "depth" not in self.roles.topics:
            return
        tolerance = f"{self.config.pair_tolerance_s * 1e3:g} ms"
        total = self.tallies.get(colour.channel, TopicTally()).messages
        share = self.paired / total if total else 0.0
        level = "ok" if share > 0.9 else ("warning" if self.paired else "error")
        hint = "" if share > 0.9 else "allow more time between them with `--set ingest.pair_tolerance_s=0.1`"
        yield Finding(level, f"{self.paired:,} of {total:,} colour images have a depth image within {tolerance}", hint)

    def _clocks(self) -> Iterator[Finding]:
        for channel in self.tallies:
            if jumps := self.clock.jumps(channel.topic):
                yield Finding("warning", f"the clock of `{channel.topic}` jumps {jumps} times; stamps are corrected")
        if self.offsets and abs(float(np.median(self.offsets))) > 5e9:
            offset = float(np.median(self.offsets)) / 1e9
            yield Finding("warning", f"image stamps and log time differ by {offset:,.1f} s (header stamps are used)")
        for channel, tally in sorted(self.tallies.items(), key=lambda item: item[0].topic):
            if tally.skipped:
                yield Finding("warning", f"`{channel.topic}`: {tally.skipped:,} messages skipped: {tally.reason}")

    def _imu_units(self) -> Iterator[Finding]:
        if not self.accel:
            return
        gravity, turn = float(np.median(self.accel)), float(np.percentile(self.gyro, 99))
        if 0.8 <= gravity <= 1.2:
            yield Finding("warning", f"accelerometer reads {gravity:.2f} at the median: in g, not m/s^2?")
        elif not 0.85 * _STANDARD_GRAVITY <= gravity <= 1.15 * _STANDARD_GRAVITY:
            text = f"accelerometer reads {gravity:.2f} m/s^2 at the median, gravity is {_STANDARD_GRAVITY:.2f}"
            yield Finding("warning", text, "level without it: `--set ingest.levelling=none`")
        else:
            yield Finding("ok", f"accelerometer reads {gravity:.2f} m/s^2 at the median")
        if turn > 20.0:
            yield Finding("warning", f"gyro reads {turn:.0f} rad/s: in degrees a second?")

    def _frames(self) -> Iterator[Finding]:
        for problem in self.tree.problems():
            yield Finding("warning", f"frames: {problem}")
        frames = {role: frame_of(topic.first).lstrip("/") for role, topic in self.roles.topics.items()}
        colour = frames.get("colour", "")
        for role in ("depth", "imu"):
            other = frames.get(role, "")
            if other and colour and other != colour and self.tree.known_until(colour, other) is None:
                yield Finding("warning", f"tf does not connect `{other}` ({role}) to `{colour}` (colour)")
            elif other and role == "depth":
                where = "the same frame" if other == colour else f"`{other}`, connected to `{colour}` by tf"
                yield Finding("ok", f"depth is given in {where}")


def _decoder(channel: Channel, role_of: Mapping[Channel, str]) -> Callable[[bytes], Message] | None:
    if channel not in role_of and kind_of(channel) != "transforms":
        return None
    try:
        return decoder_for(channel)
    except SemslamError:
        return None


def _role_findings(seen: Sequence[TopicSeen], roles: Roles) -> Iterator[Finding]:
    for role, hint in (
        ("colour", "name it with `--topic colour=/...`"),
        ("depth", "name it with `--topic depth=/...`"),
        ("colour_info", "name it with `--topic colour_info=/...`"),
    ):
        if role not in roles.topics:
            yield Finding("error", f"no topic for {role}", hint)
    for role, loss in (
        ("imu", "no IMU: a tilted camera is levelled by tf only"),
        ("odometry", "no odometry: motion comes from tf or the IMU"),
        ("truth", "no ground truth: `evaluate` has nothing to compare with"),
    ):
        if role not in roles.topics:
            yield Finding("ok" if role == "truth" else "warning", loss)
    for topic in seen:
        if topic.refusal:
            yield Finding("warning", f"`{topic.channel.topic}` cannot be read: {topic.refusal}")


def _loss_findings(reader: LogReader) -> Iterator[Finding]:
    if reader.losses.state == "ok":
        yield Finding("ok", "the file is whole")
    for problem in reader.losses.problems:
        yield Finding("warning", f"damage: {problem}")


def _calibration(role: str, info: CameraInfo, image_size: tuple[int, int] | None) -> Iterator[Finding]:
    try:
        camera = Camera.from_info(info.width, info.height, info.k, info.model, info.distortion)
    except SemslamError as error:
        yield Finding("error" if role == "colour_info" else "warning", f"{role}: {error.message}", error.hint)
        return
    view = np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))
    centre = abs(camera.cx / camera.width - 0.5) < 0.15 and abs(camera.cy / camera.height - 0.5) < 0.15
    lens = info.model or "no lens model"
    if not 20 <= view <= 170:
        yield Finding("warning", f"{role}: {view:.0f} degrees of view across {camera.width} pixels is unusual")
    if not centre:
        yield Finding("warning", f"{role}: principal point ({camera.cx:.0f}, {camera.cy:.0f}) is far from the centre")
    if image_size and image_size != (info.width, info.height):
        yield Finding(
            "warning", f"{role} is for {info.width}x{info.height}, images are {image_size[0]}x{image_size[1]}"
        )
    yield Finding("ok", f"{role}: {camera.width}x{camera.height}, {view:.0f} degrees, {lens}")


def _topic_lines(reader: LogReader, roles: Roles, survey: _Survey) -> Iterator[TopicLine]:
    role_of = {topic.channel: role for role, topic in roles.topics.items()}
    for channel, _ in sorted(reader.channels(), key=lambda item: item[0].topic):
        tally = survey.tallies.get(channel, TopicTally())
        role = role_of.get(channel) or ("tf" if kind_of(channel) == "transforms" else "")
        span = (tally.last_log_time or 0) - (tally.first_log_time or 0)
        yield TopicLine(
            topic=channel.topic,
            schema_name=channel.schema_name,
            message_encoding=channel.message_encoding,
            role=role,
            why=roles.why.get(role, ""),
            messages=tally.messages,
            rate_hz=(tally.messages - 1) / (span / 1e9) if span > 0 else None,
            max_gap_s=None if tally.max_gap_nanos is None else tally.max_gap_nanos / 1e9,
            clock_jumps=survey.clock.jumps(channel.topic),
        )


def _topic_table(topics: Sequence[TopicLine]) -> list[str]:
    head = ("ROLE", "TOPIC", "TYPE", "MESSAGES", "RATE", "GAP", "GUESSED FROM")
    rows = [
        (
            line.role or "-",
            line.topic,
            line.schema_name or "(no schema)",
            f"{line.messages:,}",
            "-" if line.rate_hz is None else f"{line.rate_hz:.1f} Hz",
            "-" if line.max_gap_s is None else f"{line.max_gap_s:.2f} s",
            line.why,
        )
        for line in topics
    ]
    shown = [head, *sorted(rows, key=lambda row: (row[0] == "-", row[1]))[:60]]
    widths = [max(len(row[i]) for row in shown) for i in range(len(head))]
    right = {3, 4, 5}
    table = [
        "  ".join(
            cell.rjust(w) if i in right else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in shown
    ]
    return [line.rstrip() for line in table] + ([f"... and {len(rows) - 60} more"] if len(rows) > 60 else [])


def _finding_line(finding: Finding) -> str:
    line = f"{finding.level + ':':<9}{finding.message}"
    return f"{line}\n         hint: {finding.hint}" if finding.hint else line


def _draw_first(
    paths: Sequence[Path], roles: Roles, seen: Sequence[TopicSeen], config: IngestConfig, picture: Path
) -> tuple[list[Finding], Path | None]:
    """Write the first keyframe as a picture, and say how it was levelled and whether its depth is plausible."""
    once = replace(config, keyframes="time", period_s=3600.0)
    walk = KeyframeWalk(LogReader(paths), roles, once, {}, static_transforms(seen))
    keyframe = next(walk.keyframes(), None)
    if keyframe is None:
        warnings = "; ".join(walk.warnings[:3]) or "no pair could be decoded"
        return [Finding("error", f"no keyframe: {warnings}")], None
    frame = keyframe.frame
    colour, depth = decode_colour(frame["colour"]), decode_depth(frame["depth"])
    picture.parent.mkdir(parents=True, exist_ok=True)
    picture.write_bytes(encode_colour(np.hstack([colour, _overlay(colour, depth)])))
    tilt = f"roll {np.degrees(frame['roll_rad']):.1f}, pitch {np.degrees(frame['pitch_rad']):.1f} degrees"
    findings = [
        Finding("ok", f"first keyframe levelled by {frame['level_source']}: {tilt}"),
        Finding("ok", f"camera {frame['camera_height_m']:.2f} m above the floor, from {frame['height_source']}"),
        _depth_finding(depth),
        *(Finding("warning", warning) for warning in walk.warnings),
    ]
    return findings, picture


def _depth_finding(depth: NDArray[np.float32]) -> Finding:
    seen = depth[depth > 0]
    share = seen.size / depth.size
    if seen.size == 0:
        return Finding("warning", "the first depth image is empty")
    middle = float(np.median(seen))
    text = f"depth: {share:.0%} of pixels, median {middle:.2f} m"
    if 0.2 <= middle <= 30.0:
        return Finding("ok", text)
    return Finding("warning", text + ": wrong unit?", "give metres a step with `--set ingest.depth_unit_m=0.001`")


def _overlay(colour: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Depth as colour (near red, far blue, up to its 95th percentile) over the picture; missing depth stays grey."""
    far = float(np.percentile(depth[depth > 0], 95)) if (depth > 0).any() else 1.0
    shade = (255 - np.clip(depth / far, 0, 1) * 255).astype(np.uint8)
    painted = cv2.cvtColor(cv2.applyColorMap(shade, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    grey = cv2.cvtColor(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    mixed = cv2.addWeighted(grey, 0.45, painted, 0.55, 0)
    return np.asarray(np.where(depth[..., None] > 0, mixed, grey), np.uint8)
