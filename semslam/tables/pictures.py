"""Pictures inside tables: colour as JPEG or PNG, depth as 16-bit PNG in millimetres (data_spec.md, table 2)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError

_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_DEPTH = [*_FAST, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
"""One filter for all rows: half the time of choosing one a row, and the same size, on depth of a real Kinect."""
_MAX_DEPTH_MM = 65535.0


def encode_colour(rgb: NDArray[np.uint8]) -> bytes:
    """A PNG file of an (H, W, 3) picture."""
    return _png(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), _FAST)


def decode_colour(data: bytes) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of a JPEG or PNG file, as its pixels lie: what EXIF says of its orientation does not count."""
    return _decode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)


def encode_depth(depth_m: NDArray[np.float32]) -> bytes:
    """16-bit PNG in millimetres of depth (H, W) in metres; what does not fit (beyond 65.5 m) is missing."""
    millimetres = np.rint(depth_m * np.float32(1000.0))
    millimetres[millimetres > _MAX_DEPTH_MM] = 0.0
    return _png(millimetres.astype(np.uint16), _DEPTH)


def decode_depth(data: bytes) -> NDArray[np.float32]:
    """Depth (H, W) in metres of a 16-bit PNG in millimetres; 0 where missing."""
    return _decode(data, cv2.IMREAD_UNCHANGED).astype(np.float32) * np.float32(0.001)


def _png(image: NDArray[Any], options: list[int]) -> bytes:
    done, data = cv2.imencode(".png", image, options)
    if not done:
        raise SemslamError("Picture could not be stored as PNG")
    return data.tobytes()


def _decode(data: bytes, flags: int) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise SemslamError("Stored picture cannot be decoded", hint="`semslam verify OUT` lists every damaged file")
    return image
