"""Decoders: from the bytes of a channel to neutral messages (`semslam.logs.messages`).

Channels are chosen by the name of their type and decoded by the schema that the log carries for them. A channel that
cannot be read is refused by name with the reason, a damaged message raises `DecodeError`, and neither stops the others.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TypeAlias

from semslam.errors import SemslamError
from semslam.logs.channels import Channel
from semslam.logs.decode_foxglove import FOXGLOVE_TYPES, decode_json, decode_protobuf
from semslam.logs.decode_ros import ROS_TYPES, decode_cdr, decode_ros1
from semslam.logs.messages import Message
from semslam.logs.ros_definition import short_name

Decoder: TypeAlias = Callable[[bytes], Message]

KINDS = ("image", "compressed_image", "camera_info", "imu", "odometry", "pose", "transforms")
"""What `kind_of` can answer."""


class UnsupportedChannelError(SemslamError):
    """A channel that cannot be decoded, whatever its messages hold."""


class DecodeError(SemslamError):
    """A message that does not hold what its channel promises."""


def kind_of(channel: Channel) -> str | None:
    """Which of `KINDS` the channel carries, by the name of its type; None for a type without use here."""
    ros, foxglove = ROS_TYPES.get(short_name(channel.schema_name)), FOXGLOVE_TYPES.get(channel.schema_name)
    row = ros or foxglove
    return row.kind if row else None


def decoder_for(channel: Channel) -> Decoder:
    """A function that turns the messages of `channel` into neutral ones; it raises `DecodeError` and nothing else.

    Raises:
        UnsupportedChannelError: no message of this channel can be decoded, for the reason that it gives.
    """
    try:
        decode = _decoder(channel)
    except UnsupportedChannelError:
        raise
    except Exception as error:  # the schema is input: parsers of three kinds fail in as many ways
        raise _unsupported(channel, _reason(error)) from error
    return _guarded(decode, channel.topic)


def _guarded(decode: Decoder, topic: str) -> Decoder:
    def guarded(data: bytes) -> Message:
        try:
            return decode(data)
        except Exception as error:  # struct.error, UnicodeDecodeError, protobuf's DecodeError, RecursionError, ...
            text = f"ends early, after {len(data)} bytes" if isinstance(error, struct.error) else _reason(error)
            raise DecodeError(f"A message on `{topic}` is damaged: {text}") from error

    return guarded


def _reason(error: Exception) -> str:
    return str(error) if type(error) is ValueError else f"{type(error).__name__}: {str(error)[:200]}"


def _decoder(channel: Channel) -> Decoder:
    name, schema = channel.schema_name, (channel.message_encoding, channel.schema_encoding)
    if kind_of(channel) is None:
        raise _unsupported(channel, "messages of this type have no use here", hint="")
    is_ros = short_name(name) in ROS_TYPES
    if is_ros and schema in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
        text = _schema_text(channel)
        return decode_cdr(name, text) if schema[0] == "cdr" else decode_ros1(name, text)
    if not is_ros and schema == ("protobuf", "protobuf"):
        return decode_protobuf(name, channel.schema_data)
    if not is_ros and schema in (("json", "jsonschema"), ("json", "")):
        return decode_json(name)
    raise _unsupported(channel, _why_not(channel, is_ros))


def _schema_text(channel: Channel) -> str:
    text = str(channel.schema_data, "utf-8")
    if not text.strip():
        raise ValueError("its schema is empty")
    return text


def _why_not(channel: Channel, is_ros: bool) -> str:
    if channel.schema_encoding in ("ros2idl", "omgidl"):
        return f"its schema is written in `{channel.schema_encoding}`, which is not read; `ros2msg` is"
    encodings = "`cdr` (with `ros2msg`) and `ros1` (with `ros1msg`)" if is_ros else "`protobuf` and `json`"
    found = f"`{channel.message_encoding}` with a schema in `{channel.schema_encoding}`"
    return f"its messages are encoded as {found}; for this type {encodings} are read"


_HINT = (
    "Record the topic again with an MCAP recorder that stores `ros2msg`, `ros1msg`, `protobuf` or `jsonschema` schemas"
)


def _unsupported(channel: Channel, reason: str, hint: str = _HINT) -> UnsupportedChannelError:
    name = channel.schema_name or "no schema"
    return UnsupportedChannelError(f"Topic `{channel.topic}` (`{name}`) cannot be decoded: {reason}", hint=hint)
