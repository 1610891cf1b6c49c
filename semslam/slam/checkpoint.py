"""Arrays as bytes and back: equal arrays give equal bytes (numpy's zip members carry no time)."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def pack(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Named arrays as a compressed npz, in the order given."""
    buffer, named = io.BytesIO(), dict[str, Any](arrays)
    np.savez_compressed(buffer, **named)
    return buffer.getvalue()


def unpack(packed: bytes) -> dict[str, NDArray[Any]]:
    """The inverse of `pack`."""
    with np.load(io.BytesIO(packed), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def as_array(packed: bytes) -> NDArray[np.uint8]:
    """Bytes as an array, so that one pack can hold another."""
    return np.frombuffer(packed, np.uint8)
