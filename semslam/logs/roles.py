"""Which topic plays which role: guessed from type, encoding, frame and name; every guess can be overridden.

Reads the first message of each topic (`peek`), writes nothing. A role is a word of `ROLES`; transforms need no role,
every tf topic is used.
"""

from __future__ import annotations

import posixpath
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from semslam.errors import SemslamError, UsageError
from semslam.logs.decode import decoder_for, kind_of
from semslam.logs.messages import CameraInfo, CompressedImage, Image, Message, Odometry
from semslam.logs.reader import Channel, LogReader

ROLES = ("colour", "depth", "colour_info", "depth_info", "imu", "odometry", "truth")

_KINDS = {
    "colour": ("image", "compressed_image"),
    "depth": ("image", "compressed_image"),
    "colour_info": ("camera_info",),
    "depth_info": ("camera_info",),
    "imu": ("imu",),
    "odometry": ("odometry",),
    "truth": ("pose", "odometry"),
}
_COLOUR_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8", "8uc3", "8uc4", "mono8", "8uc1")
_RAW_COLOUR_ENCODINGS = (
    *("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"),
    *("yuv422", "uyvy", "yuv422_yuy2", "yuyv"),
)
_DEPTH_ENCODINGS = ("16uc1", "32fc1", "mono16")
_TRUTH_WORDS = ("ground_truth", "groundtruth", "truth", "mocap", "vicon", "optitrack", "/gt")
_DEBUG_WORDS = ("debug", "mask", "label", "segment", "overlay", "annotated", "confidence", "infra", "fisheye")
_PEEK_MESSAGES = 50_000
_PEEK_BYTES = 512 << 20


@dataclass(frozen=True)
class TopicSeen:
    """One topic of a log as the first look saw it."""

    channel: Channel
    messages: int | None
    kind: str | None
    first: Message | None = None
    refusal: str | None = None
    """Why its messages cannot be decoded; None if they can or there is no use for them."""


@dataclass(frozen=True)
class Roles:
    """Topic of each role; absent roles are absent. `why` says for each where the choice came from."""

    topics: Mapping[str, TopicSeen] = field(default_factory=dict)
    why: Mapping[str, str] = field(default_factory=dict)


def peek(reader: LogReader) -> list[TopicSeen]:
    """The first decodable message of every topic we have a use for, reading no further than needed."""
    listed = reader.channels()
    decoders: dict[Channel, Callable[[bytes], Message]] = {}
    refusals: dict[Channel, str] = {}
    for channel, _ in listed:
        if kind_of(channel):
            try:
                decoders[channel] = decoder_for(channel)
            except SemslamError as error:
                refusals[channel] = error.message
    awaited = {channel for channel, count in listed if channel in decoders and count != 0}
    first = _first_messages(reader, decoders, awaited)
    return [TopicSeen(c, n, kind_of(c), first.get(c), refusals.get(c)) for c, n in listed]


def _first_messages(
    reader: LogReader, decoders: Mapping[Channel, Callable[[bytes], Message]], awaited: set[Channel]
) -> dict[Channel, Message]:
    first: dict[Channel, Message] = {}
    left, budget = _PEEK_MESSAGES, _PEEK_BYTES
    if not awaited:
        return first
    for raw in reader.messages(lambda channel: channel in decoders):
        left, budget = left - 1, budget - len(raw.data)
        if raw.channel not in first:
            try:
                first[raw.channel] = decoders[raw.channel](raw.data)
                awaited.discard(raw.channel)
            except SemslamError:
                pass  # a damaged first message; a later one may do
        if not awaited or left <= 0 or budget <= 0:
            break
    return first


def choose_roles(seen: Sequence[TopicSeen], overrides: Mapping[str, str]) -> Roles:
    """Give every role its topic.

    Raises:
        UsageError: an override names an unknown role.
        SemslamError: an override names a topic that is missing or of an unsuitable type.
    """
    for role in overrides:
        if role not in ROLES:
            raise UsageError(f"Unknown topic role `{role}`", hint=f"roles are {', '.join(ROLES)}")
    chosen: dict[str, TopicSeen] = {}
    why: dict[str, str] = {}
    for role in ROLES:
        if role in overrides:
            chosen[role], why[role] = _named(role, overrides[role], seen), "named"
            continue
        best = _best(seen, lambda topic, role=role: _score(role, topic, chosen, seen))  # type: ignore[misc]
        if best is not None:
            chosen[role], why[role] = best, _reason(role, best)
    return Roles(chosen, why)


def describe_topics(seen: Sequence[TopicSeen]) -> str:
    """A small table of the log's topics, for messages to people."""
    rows = [
        (t.channel.topic, _content(t), "?" if t.messages is None else f"{t.messages:,}")
        for t in sorted(seen, key=lambda t: t.channel.topic)
    ]
    shown, wide = rows[:40], [max((len(r[i]) for r in rows[:40]), default=0) for i in range(3)]
    lines = [f"  {topic:<{wide[0]}}  {name:<{wide[1]}}  {count:>{wide[2]}} messages" for topic, name, count in shown]
    more = [f"  ... and {len(rows) - 40} more"] if len(rows) > 40 else []
    return "\n".join([f"The log has {len(rows)} topics", *lines, *more])


def _content(topic: TopicSeen) -> str:
    """Type of a topic, and for images the encoding."""
    name, message = topic.channel.schema_name or "(no schema)", topic.first
    if isinstance(message, Image):
        return f"{name} ({message.encoding})"
    return f"{name} ({message.format})" if isinstance(message, CompressedImage) and message.format else name


def _named(role: str, topic: str, seen: Sequence[TopicSeen]) -> TopicSeen:
    named = [t for t in seen if t.channel.topic == topic]
    fitting = [t for t in named if t.kind in _KINDS[role]]
    usable = [t for t in fitting if t.refusal is None]
    if usable:
        return max(usable, key=lambda t: (t.messages or 0, t.first is not None))
    if fitting:
        raise SemslamError(f"Topic `{topic}`, named as {role}, cannot be read: {fitting[0].refusal}")
    if named:
        raise SemslamError(
            f"Topic `{topic}`, named as {role}, holds `{named[0].channel.schema_name}`",
            hint=f"{role} wants a topic of kind {' or '.join(_KINDS[role])}",
        )
    raise SemslamError(
        f"No topic `{topic}`, named as {role}, in the log",
        details=describe_topics(seen),
        hint=f"name another one with `--topic {role}=/...`",
    )


def _best(seen: Iterable[TopicSeen], score: Callable[[TopicSeen], float | None]) -> TopicSeen | None:
    """The topic of the highest score; of equal ones that with most messages, then the alphabetically first."""
    scored = [(s, t) for t in seen if t.refusal is None and (s := score(t)) is not None]
    return min(scored, key=lambda st: (-st[0], -(st[1].messages or 0), st[1].channel.topic), default=(0.0, None))[1]


def _score(role: str, topic: TopicSeen, chosen: Mapping[str, TopicSeen], seen: Sequence[TopicSeen]) -> float | None:
    """How well a topic fits a role; None if it cannot."""
    if topic.kind not in _KINDS[role] or topic.messages == 0 or topic.first is None:
        return None
    name = topic.channel.topic.lower()
    if role == "colour":
        score = _score_colour(topic.first, name)
        return None if score is None else score + _score_company(topic, seen)
    if role == "depth":
        return _score_depth(topic.first, name, chosen.get("colour"))
    if role in ("colour_info", "depth_info"):
        return _score_info(topic, chosen.get(role.removesuffix("_info")))
    is_truth = any(word in name for word in _TRUTH_WORDS)
    if role == "truth":
        return 1.0 if is_truth else None
    if role == "odometry":
        return None if is_truth else (2.0 if "wheel" in name or "odom" in name else 1.0)
    return 0.0 if any(word in name for word in ("accel/", "gyro/")) else 1.0


def _is_depth(message: Message, name: str) -> bool:
    if isinstance(message, Image):
        return message.encoding.lower() in _DEPTH_ENCODINGS
    if isinstance(message, CompressedImage):
        form = message.format.lower()
        return "compresseddepth" in form or "compresseddepth" in name or form.startswith(_DEPTH_ENCODINGS)
    return False


def _score_colour(message: Message, name: str) -> float | None:
    encoding = message.encoding.lower() if isinstance(message, Image) else "rgb8"
    if _is_depth(message, name) or encoding not in (*_COLOUR_ENCODINGS, *_RAW_COLOUR_ENCODINGS):
        return None
    grey, raw = encoding in ("mono8", "8uc1"), encoding in _RAW_COLOUR_ENCODINGS
    score = 4.0 if any(word in name for word in ("color", "colour", "rgb")) else 2.0
    score -= 2.0 * any(word in name for word in _DEBUG_WORDS) + 1.5 * grey + 0.5 * raw
    score -= 1.0 * ("depth" in name)
    return score + 0.25 * isinstance(message, Image)  # raw before its compressed twin


def _score_company(colour: TopicSeen, seen: Sequence[TopicSeen]) -> float:
    """What speaks for a camera among several: a calibration above all, and depth from the same place."""
    present = [t for t in seen if t.first is not None and t.refusal is None and t.messages != 0]
    calibrated = any(t.kind == "camera_info" and _calibrates(t, colour) for t in present)
    depths = [t for t in present if t.first is not None and _is_depth(t.first, t.channel.topic.lower())]
    return 3.0 * calibrated + max((_closeness(t, colour) for t in depths), default=0.0)


def _calibrates(info: TopicSeen, image: TopicSeen) -> bool:
    """Whether a calibration stands beside the image, or is given in the same frame."""
    folder = posixpath.dirname(info.channel.topic)
    beside = posixpath.dirname(image.channel.topic) == folder
    above = folder not in ("", "/") and image.channel.topic.startswith(f"{folder}/")
    return beside or above or _shares_frame(info, image)


def _closeness(depth: TopicSeen, colour: TopicSeen) -> float:
    """1 in the same frame, else up to that with every name at the front that both topics share."""
    shared = len(posixpath.commonprefix([topic.channel.topic.strip("/").split("/") for topic in (depth, colour)]))
    return 1.0 if _shares_frame(depth, colour) else min(1.0, 0.2 * shared)


def _shares_frame(one: TopicSeen, other: TopicSeen) -> bool:
    return frame_of(one.first) == frame_of(other.first) != ""


def _score_depth(message: Message, name: str, colour: TopicSeen | None) -> float | None:
    if not _is_depth(message, name):
        return None
    score = 2.0 + 1.0 * ("depth" in name) - 2.0 * any(word in name for word in _DEBUG_WORDS)
    score += 1.0 * any(word in name for word in ("aligned", "registered"))
    same_frame = colour is not None and frame_of(colour.first) not in ("", None)
    score += 1.0 * (same_frame and frame_of(message) == frame_of(colour.first if colour else None))
    return score + 0.25 * isinstance(message, Image)


def _score_info(topic: TopicSeen, image: TopicSeen | None) -> float | None:
    if image is None or not isinstance(topic.first, CameraInfo):
        return None
    parts, wanted = topic.channel.topic.split("/"), image.channel.topic.split("/")
    common = len(posixpath.commonprefix([parts, wanted]))
    same_frame = _shares_frame(topic, image)
    if common < 2 and not same_frame:
        return None
    return common + (1.5 if same_frame else 0.0)


def frame_of(message: Message | None) -> str:
    """Frame a message is given in; empty if it names none."""
    return getattr(message, "frame_id", "") or ""


def _reason(role: str, topic: TopicSeen) -> str:
    message = topic.first
    if isinstance(message, Image):
        return f"{message.encoding}, {message.width}x{message.height}, frame `{message.frame_id}`"
    if isinstance(message, CompressedImage):
        return f"{message.format or 'compressed'}, frame `{message.frame_id}`"
    if isinstance(message, CameraInfo):
        return f"{message.model or 'no lens model'}, {message.width}x{message.height}, frame `{message.frame_id}`"
    if isinstance(message, Odometry):
        return f"`{message.frame_id}` to `{message.child_frame_id}`"
    return f"frame `{frame_of(message)}`" if role != "truth" else f"in frame `{frame_of(message)}`"
