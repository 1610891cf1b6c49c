"""Writing logs: neutral messages into an MCAP file, as ROS 2 would record them.

A log appears under its name whole or not at all, and the same messages give the same bytes.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Literal, Self

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.logs.cdr import ros2_type, serialise
from semslam.logs.messages import Sent
from semslam.logs.ros2_schemas import ros2_schema
from semslam.logs.rvl import encode_rvl

JPEG_FORMAT = "rgb8; jpeg compressed bgr8"
"""`CompressedImage.format` for the output of `encode_jpeg`, as image_transport writes it."""
PNG_DEPTH_FORMAT = "16UC1; compressedDepth png"
RVL_DEPTH_FORMAT = "16UC1; compressedDepth rvl"

_COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
_DEPTH_HEADER = struct.pack("<iff", 0, 0.0, 0.0)
"""Of integer depth: no quantisation."""
_SMALL = [cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
"""For images of few values: a filter would only hide that they repeat."""


class LogWriteError(SemslamError):
    """A log that cannot be written."""


class Ros2LogWriter:
    """Writes one log; use it as a context manager.

    The messages go to a hidden file beside `path`, which takes the name `path` when the block ends without an exception
    and is removed otherwise.

    Args:
        path: the log to write; an existing one is replaced.
        compression: of the chunks.
        chunk_bytes: a chunk is closed once it holds more than this, before compression.
        library: who wrote it, for the header of the file.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        compression: Literal["zstd", "lz4", "none"] = "zstd",
        chunk_bytes: int = 1 << 20,
        library: str = "semslam",
    ) -> None:
        self.path = Path(path)
        if compression not in _COMPRESSIONS:
            raise LogWriteError(f"`{compression}` is no compression of logs", hint="Use `zstd`, `lz4` or `none`")
        self._partial = self.path.with_name(f".{self.path.name}.partial-{os.getpid()}")
        self._compression = _COMPRESSIONS[compression]
        self._chunk_bytes = chunk_bytes
        self._library = library
        self._file: BinaryIO | None = None
        self._writer: Writer | None = None
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Topic] = {}

    def __enter__(self) -> Self:
        try:
            self._file = open(self._partial, "wb")
        except OSError as error:
            raise LogWriteError(
                f"Cannot write `{self.path}`: {error.strerror}",
                hint="Name a file in a folder that exists and is writable",
            ) from error
        self._writer = Writer(self._file, chunk_size=self._chunk_bytes, compression=self._compression)
        self._writer.start(profile="ros2", library=self._library)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._publish()
        except OSError as failure:
            raise LogWriteError(f"Cannot write `{self.path}`: {failure.strerror}") from failure
        finally:
            if self._file is not None:
                self._file.close()
            self._file = self._writer = None
            self._partial.unlink(missing_ok=True)

    def write(self, topic: str, message: Sent, log_time_nanos: int, publish_time_nanos: int | None = None) -> None:
        """Append one message; its type decides the ROS 2 type of the topic.

        `Transforms` becomes tf2_msgs/msg/TFMessage, `Pose` geometry_msgs/msg/PoseStamped, `Polygon`
        geometry_msgs/msg/PolygonStamped, the others their namesakes.

        Args:
            log_time_nanos: when the recorder got it.
            publish_time_nanos: when it was sent; None means the log time.

        Raises:
            LogWriteError: the topic already carries another type, a number does not fit, or the disk is full.
        """
        publish_time_nanos = log_time_nanos if publish_time_nanos is None else publish_time_nanos
        data = _serialised(topic, message, log_time_nanos, publish_time_nanos)
        writer = self._open_writer()
        channel = self._channel(writer, topic, ros2_type(message))
        try:
            writer.add_message(channel.id, log_time_nanos, data, publish_time_nanos, channel.sequence)
        except OSError as error:
            raise LogWriteError(f"Cannot write `{self.path}`: {error.strerror}", hint="Free some space") from error
        channel.sequence += 1

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise LogWriteError(
                f"The log `{self.path}` is not open", hint="Write inside `with Ros2LogWriter(...) as log:`"
            )
        return self._writer

    def _channel(self, writer: Writer, topic: str, type_name: str) -> _Topic:
        if topic not in self._channels:
            if type_name not in self._schemas:
                self._schemas[type_name] = writer.register_schema(type_name, "ros2msg", ros2_schema(type_name))
            channel_id = writer.register_channel(topic, "cdr", self._schemas[type_name])
            self._channels[topic] = _Topic(channel_id, type_name)
        channel = self._channels[topic]
        if channel.type_name != type_name:
            raise LogWriteError(
                f"Topic `{topic}` carries `{channel.type_name}` and cannot also carry `{type_name}`",
                hint="Use one topic for each type",
            )
        return channel

    def _publish(self) -> None:
        """Complete the hidden file and give it its name."""
        writer, file = self._open_writer(), self._file
        assert file is not None
        writer.finish()  # type: ignore[no-untyped-call]
        file.flush()
        os.fsync(file.fileno())
        os.replace(self._partial, self.path)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


class _Topic:
    """A channel of the log being written."""

    def __init__(self, channel_id: int, type_name: str) -> None:
        self.id = channel_id
        self.type_name = type_name
        self.sequence = 0


def _serialised(topic: str, message: Sent, *times_nanos: int) -> bytes:
    """The bytes of a message, before anything of it is in the log."""
    if not all(0 <= time < 2**64 for time in times_nanos):
        raise LogWriteError(f"A message for `{topic}` has the time {min(times_nanos)} ns, which does not fit a log")
    try:
        return serialise(message)
    except struct.error as error:
        raise LogWriteError(f"A message for `{topic}` holds a number that does not fit its field: {error}") from error


def encode_jpeg(rgb: NDArray[np.uint8], quality: int = 90) -> bytes:
    """A JPEG file. (H, W, 3) uint8 RGB."""
    return _encode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_png_depth(depth_mm: NDArray[np.uint16], *, small: bool = False) -> bytes:
    """The data of a `compressedDepth` message with a PNG, see `PNG_DEPTH_FORMAT`. (H, W) uint16, 0 where missing.

    `small` suits depth in coarse steps of disparity: half the bytes for four times the time.
    """
    return _DEPTH_HEADER + _encode(".png", np.ascontiguousarray(depth_mm, np.uint16), _SMALL if small else [])


def encode_png(pixels: NDArray[np.uint8 | np.uint16]) -> bytes:
    """A PNG file of ids (H, W), 8 or 16 bits as they come."""
    return _encode(".png", np.ascontiguousarray(pixels), _SMALL)


def encode_rvl_depth(depth_mm: NDArray[np.uint16]) -> bytes:
    """The data of a `compressedDepth` message with RVL, see `RVL_DEPTH_FORMAT`. (H, W) uint16, 0 where missing."""
    rows, columns = depth_mm.shape
    return _DEPTH_HEADER + struct.pack("<II", columns, rows) + encode_rvl(depth_mm)


def _encode(suffix: str, pixels: NDArray[np.uint8 | np.uint16], options: list[int]) -> bytes:
    done, file = cv2.imencode(suffix, pixels, options)
    if not done:
        raise LogWriteError(f"OpenCV cannot write an image of shape {pixels.shape} as `{suffix}`")
    return bytes(file.tobytes())
