"""Pixels: from image messages to arrays.

Colour is (H, W, 3) uint8 RGB; depth is (H, W) float32 metres along the optical axis with 0 where there is no
measurement. A damaged, short or absurdly large image raises `ImageError` before anything of its size is allocated.

`compressedDepth` is a 12-byte header (int32 kind, float32 A, float32 B) before a 16-bit PNG or before uint32 columns,
uint32 rows and an RVL stream. A `16UC1` image holds its values as they were; a `32FC1` image holds inverse depth v, and
depth = A / (v - B).

Source: REP 118 (depth images); image_transport_plugins, compressed_depth_image_transport
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.logs.image_files import PNG_MAGIC, check_size, decode_file, inspect
from semslam.logs.messages import CompressedImage, Image
from semslam.logs.rvl import decode_rvl

Colour: TypeAlias = NDArray[np.uint8]
"""(H, W, 3) RGB."""
Depth: TypeAlias = NDArray[np.float32]
"""(H, W) metres, 0 where missing."""

MILLIMETRE_M = 0.001
"""Metres in one step of an integer depth image (REP 118)."""

_Array = TypeVar("_Array")


class ImageError(SemslamError):
    """An image message that cannot be turned into pixels."""


def decode_colour(message: Image | CompressedImage) -> Colour:
    """RGB pixels of a colour or grey image. (H, W, 3) uint8.

    `8UC3` is taken as BGR, the order of OpenCV; 16-bit grey keeps its high byte. The colours of a file are those that
    its own format defines: the ROS names in `format` (`rgb8; jpeg compressed bgr8`) tell what the sender once had.

    Raises:
        ImageError: the encoding is no colour one, or the data is damaged, short or absurdly large.
    """
    return _guarded(_colour_of_file if isinstance(message, CompressedImage) else _colour_of_rows, message)


def decode_depth(message: Image | CompressedImage, unit_m: float = 0.0) -> Depth:
    """Depth in metres, 0 where the sensor gave none (0, negative, NaN, infinite). (H, W) float32.

    Args:
        message: `16UC1`, `mono16` or `32FC1`; a 16-bit PNG; `compressedDepth` (PNG or RVL).
        unit_m: metres in one step of an integer image; 0 means 1 mm. Images of floats are in metres in any case.

    Raises:
        ImageError: the encoding is no depth one, or the data is damaged, short or absurdly large.
    """
    unit_m = unit_m or MILLIMETRE_M
    read = _depth_of_file if isinstance(message, CompressedImage) else _depth_of_rows
    return _guarded(lambda image: read(image, unit_m), message)


def image_size(message: Image | CompressedImage) -> tuple[int, int]:
    """(height, width) from the headers, without decoding. Raises ImageError."""

    def size(image: Any) -> tuple[int, int]:
        if isinstance(image, Image):
            return image.height, image.width
        if _is_compressed_depth(image) and "rvl" in image.format.lower():
            return _rvl_size(image.data)
        file = inspect(image.data[_HEADER.size :] if _is_compressed_depth(image) else image.data)
        return file.height, file.width

    return _guarded(size, message)


def _guarded(read: Callable[[Any], _Array], message: Image | CompressedImage) -> _Array:
    """Call `read`, and turn whatever it raises into an ImageError."""
    try:
        return read(message)
    except Exception as error:  # cv2.error, struct.error and MemoryError besides our own ValueErrors
        form = message.format if isinstance(message, CompressedImage) else message.encoding
        reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {str(error)[:200]}"
        raise ImageError(
            f"An image (`{form[:60]}`) in frame `{message.frame_id[:60]}` is unusable: {reason}"
        ) from error


# ---------------------------------------------------------------------------------------------------------- rows


def _rows(message: Image, pixel_bytes: int) -> NDArray[np.uint8]:
    """The bytes of the pixels without the padding of their rows. (H, W * pixel_bytes) uint8, read-only."""
    check_size(message.height, message.width)
    row_bytes = message.width * pixel_bytes
    step = message.step or row_bytes
    if step < row_bytes:
        raise ValueError(f"a row of {message.width} pixels takes {row_bytes} bytes, `step` says {step}")
    needed = step * (message.height - 1) + row_bytes
    if len(message.data) < needed:
        raise ValueError(f"{message.width} x {message.height} pixels take {needed} bytes, it has {len(message.data)}")
    data = np.frombuffer(message.data, np.uint8)
    return np.lib.stride_tricks.as_strided(data, (message.height, row_bytes), (step, 1), writeable=False)


def _values(message: Image, dtype: str) -> NDArray[Any]:
    """Pixels of one channel in the byte order of the message. (H, W)."""
    ordered = np.dtype(dtype).newbyteorder(">" if message.big_endian else "<")
    return np.ascontiguousarray(_rows(message, ordered.itemsize)).view(ordered)


_COLOURS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8uc3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8uc4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8uc1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}
"""Bytes of a pixel and OpenCV's conversion to RGB, by encoding in lower case."""

_DEPTHS = {"16uc1": "u2", "mono16": "u2", "32fc1": "f4"}


def _colour_of_rows(message: Image) -> Colour:
    encoding = message.encoding.lower()
    if encoding == "mono16":
        grey = (_values(message, "u2") >> 8).astype(np.uint8)
        return np.repeat(grey[:, :, np.newaxis], 3, axis=2)
    if encoding not in _COLOURS:
        raise ValueError(f"`{message.encoding}` is no colour encoding that is read")
    pixel_bytes, conversion = _COLOURS[encoding]
    pixels = _rows(message, pixel_bytes).reshape(message.height, message.width, pixel_bytes)  # (H, W, C)
    if conversion is None:
        return pixels.copy()
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), np.uint8)


def _depth_of_rows(message: Image, unit_m: float) -> Depth:
    dtype = _DEPTHS.get(message.encoding.lower())
    if dtype is None:
        raise ValueError(f"`{message.encoding}` is no depth encoding that is read")
    values = _values(message, dtype)
    return _metres(values) if dtype == "f4" else _scaled(values, unit_m)


def _scaled(steps: NDArray[Any], unit_m: float) -> Depth:
    depth: Depth = np.multiply(steps, np.float32(unit_m), dtype=np.float32)
    return depth


def _metres(depth_m: NDArray[Any]) -> Depth:
    """Keep what is a distance, set all else to 0."""
    depth = depth_m.astype(np.float32)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0
    return depth


# --------------------------------------------------------------------------------------------------------- files

_HEADER = struct.Struct("<iff")
_RVL_SIZE = struct.Struct("<II")


def _colour_of_file(message: CompressedImage) -> Colour:
    if _is_compressed_depth(message):
        raise ValueError("it holds depth, not colour")
    return decode_file(message.data, inspect(message.data), cv2.IMREAD_COLOR_RGB).astype(np.uint8, copy=False)


def _depth_of_file(message: CompressedImage, unit_m: float) -> Depth:
    if not _is_compressed_depth(message):
        return _scaled(_depth_png(message.data), unit_m)
    data, form = message.data, message.format.lower()
    _, a, b = _HEADER.unpack_from(data)
    steps = _depth_rvl(data) if "rvl" in form else _depth_png(data[_HEADER.size :])
    return _from_inverse(steps, a, b) if form.startswith("32fc1") else _scaled(steps, unit_m)


def _is_compressed_depth(message: CompressedImage) -> bool:
    """By the bytes where they are clear, else by name: both recorders that omit the header and the name exist."""
    if message.data.startswith(PNG_MAGIC):
        return False
    return "compresseddepth" in message.format.lower() or message.data[_HEADER.size :].startswith(PNG_MAGIC)


def _depth_png(data: bytes) -> NDArray[Any]:
    """(H, W) uint16."""
    file = inspect(data)
    if (file.container, file.channels, file.bits) != ("png", 1, 16):
        raise ValueError(f"a {file.container} file with {file.channels} x {file.bits} bits a pixel is no depth image")
    return decode_file(data, file, cv2.IMREAD_UNCHANGED)


def _rvl_size(data: bytes) -> tuple[int, int]:
    columns, rows = _RVL_SIZE.unpack_from(data, _HEADER.size)
    check_size(rows, columns)
    return rows, columns


def _depth_rvl(data: bytes) -> NDArray[np.uint16]:
    """(H, W) uint16."""
    rows, columns = _rvl_size(data)
    return decode_rvl(data[_HEADER.size + _RVL_SIZE.size :], rows * columns).reshape(rows, columns)


def _from_inverse(steps: NDArray[Any], a: float, b: float) -> Depth:
    """depth = A / (v - B), in metres; 0 marks a missing value. (H, W) -> (H, W)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = np.float32(a) / (steps.astype(np.float32) - np.float32(b))
    return _metres(np.where(steps > 0, depth, np.float32(0)))
