"""Image files inside messages: JPEG, PNG and WebP, checked before they are decoded.

OpenCV returns a picture for many a file that was cut short or damaged, and allocates what the header asks for. So the
size is read from the header and bounded, and the file has to be whole, before OpenCV sees it: a PNG by the checksum of
every chunk, a JPEG by its end marker, a WebP by its length.

Source: ITU-T T.81 annex B (JPEG), https://www.w3.org/TR/png-3, https://developers.google.com/speed/webp/docs/riff_container
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 1 << 28
"""256 megapixels: no image is decoded that claims more."""

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
_DEFLATE_LIMIT = 1032
"""Deflate never expands by more, so a PNG bounds its own size (https://zlib.net/zlib_tech.html)."""
_JPEG_LIMIT = 512
"""Pixels in a byte of JPEG: each block of 8 x 8 takes one bit or more."""


@dataclass(frozen=True, slots=True)
class ImageFile:
    """What the header of a whole image file says."""

    container: str
    """`jpeg`, `png` or `webp`."""
    height: int
    width: int
    channels: int
    bits: int
    """Bits of one channel of one pixel."""


def inspect(data: bytes) -> ImageFile:
    """Read the header and check that the file is whole.

    Raises:
        ValueError: it is none of the three, cut short or damaged, or larger than `MAX_PIXELS`.
    """
    if data.startswith(PNG_MAGIC):
        image = _inspect_png(data)
    elif data.startswith(JPEG_MAGIC):
        image = _inspect_jpeg(data)
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        image = _inspect_webp(data)
    else:
        raise ValueError(f"the data starts with `{data[:8].hex(' ')}`, which is no JPEG, PNG or WebP")
    check_size(image.height, image.width)
    return image


def check_size(height: int, width: int) -> None:
    """Raises ValueError for a size that no image has."""
    if height < 1 or width < 1 or height * width > MAX_PIXELS:
        raise ValueError(f"the size {width} x {height} is not between 1 and {MAX_PIXELS} pixels")


def decode_file(data: bytes, image: ImageFile, flags: int) -> NDArray[Any]:
    """Decode a file that `inspect` described as `image`. (H, W) or (H, W, 3), of its own type. Raises ValueError."""
    # a camera that is mounted askew is a matter of its calibration, not of an EXIF tag
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None or pixels.shape[:2] != (image.height, image.width):
        raise ValueError(f"the {image.container} file of {len(data)} bytes does not decode")
    return pixels


# ----------------------------------------------------------------------------------------------------------- PNG


def _inspect_png(data: bytes) -> ImageFile:
    offset, kind, header = len(PNG_MAGIC), b"", b""
    while kind != b"IEND":
        kind, body, offset = _png_chunk(data, offset)
        header = header or (body if kind == b"IHDR" else b"")
    if len(header) != 13:
        raise ValueError("the PNG file has no header")
    width, height, bits, colour = struct.unpack_from(">IIBB", header)
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(colour, 1)
    if width * height * bits > 8 * _DEFLATE_LIMIT * len(data):
        raise ValueError(f"the PNG file of {len(data)} bytes cannot hold the {width} x {height} pixels of its header")
    return ImageFile("png", height, width, channels, bits)


def _png_chunk(data: bytes, offset: int) -> tuple[bytes, bytes, int]:
    """(kind, body, next offset)."""
    if offset + 12 > len(data):
        raise ValueError(f"the PNG file ends early, after {len(data)} bytes")
    (size,) = struct.unpack_from(">I", data, offset)
    end = offset + 8 + size
    if end + 4 > len(data):
        raise ValueError(f"the PNG file ends early, after {len(data)} bytes")
    chunk = memoryview(data)[offset + 4 : end]
    if zlib.crc32(chunk) != struct.unpack_from(">I", data, end)[0]:
        raise ValueError(f"the PNG file is damaged near byte {offset}")
    kind = bytes(chunk[:4])
    return kind, bytes(chunk[4:]) if kind == b"IHDR" else b"", end + 4


# ---------------------------------------------------------------------------------------------------------- JPEG

_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_START_OF_SCAN = 0xDA
_WITHOUT_LENGTH = frozenset((0x01, *range(0xD0, 0xD8)))


def _inspect_jpeg(data: bytes) -> ImageFile:
    frame, scan = _jpeg_headers(data)
    if data.find(b"\xff\xd9", scan) < 0:  # image data has no 0xFF without a 0x00 behind it
        raise ValueError(f"the JPEG file ends early, after {len(data)} bytes, without an end marker")
    bits, height, width, channels = struct.unpack_from(">BHHB", data, frame)
    if width * height > _JPEG_LIMIT * len(data):
        raise ValueError(f"the JPEG file of {len(data)} bytes cannot hold the {width} x {height} pixels of its header")
    return ImageFile("jpeg", height, width, channels, bits)


def _jpeg_headers(data: bytes) -> tuple[int, int]:
    """Where the body of the frame header starts, and the first scan."""
    offset, frame = 2, 0
    while offset + 4 <= len(data):
        marker = data[offset + 1]
        if data[offset] != 0xFF:
            raise ValueError(f"the JPEG file is damaged near byte {offset}")
        if marker == 0xFF:  # fill byte
            offset += 1
        elif marker in _WITHOUT_LENGTH:
            offset += 2
        elif marker == _START_OF_SCAN and frame:
            return frame, offset
        else:
            frame = offset + 4 if marker in _START_OF_FRAME else frame
            offset += 2 + max(2, int.from_bytes(data[offset + 2 : offset + 4], "big"))
    raise ValueError(f"the JPEG file ends early, after {len(data)} bytes, before its image")


# ---------------------------------------------------------------------------------------------------------- WebP


def _inspect_webp(data: bytes) -> ImageFile:
    if len(data) < 30 or int.from_bytes(data[4:8], "little") + 8 > len(data):
        raise ValueError(f"the WebP file ends early, after {len(data)} bytes")
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = (size & 0x3FFF for size in struct.unpack_from("<HH", data, 26))
    elif kind == b"VP8L":
        packed = int.from_bytes(data[21:25], "little")
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    else:
        raise ValueError("the WebP file has no image header")
    return ImageFile("webp", height, width, 3, 8)
