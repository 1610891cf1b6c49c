"""Masks as run lengths: row by row, background first, as column `mask_runs` of the detections table holds them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError


def encode(mask: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Run lengths of a mask (H, W), alternating background and foreground; they add up to H * W.

    The first run is background, and 0 if the first pixel is foreground. An empty image has no runs.
    """
    flat = np.ascontiguousarray(mask, dtype=bool).ravel()
    if flat.size == 0:
        return np.zeros(0, np.uint32)
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    leading = [0, 0] if flat[0] else [0]
    return np.diff(np.concatenate([leading, changes, [flat.size]])).astype(np.uint32)


def decode(runs: Sequence[int] | NDArray[np.uint32], height: int, width: int) -> NDArray[np.bool_]:
    """The mask (height, width) of run lengths; the inverse of `encode`.

    Raises:
        SemslamError: the runs do not add up to the size of the image.
    """
    lengths = np.asarray(runs, np.int64)
    total = int(lengths.sum())
    if total != height * width or (lengths < 0).any():
        raise SemslamError(f"Mask runs add up to {total} pixels, the image has {width} x {height} = {width * height}")
    values = np.arange(lengths.size) % 2 == 1
    return np.repeat(values, lengths).reshape(height, width)
