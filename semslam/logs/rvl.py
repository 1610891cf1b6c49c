"""RVL, the lossless depth codec of `compressedDepth` (run length, variable length), vectorised.

An image is a chain of runs: how many zeros, how many non-zero pixels, then each non-zero pixel as the difference to
the non-zero pixel before it (0 before the first), folded so that small differences of either sign are small numbers.
Every number is a string of nibbles: three bits each, low ones first, the fourth bit says that more follow. Eight
nibbles fill a 32-bit word from its high end, and words are stored little endian.

Source: A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017, https://doi.org/10.1145/3132272.3134144
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_NIBBLES = 10
"""Nibbles of the largest number that occurs (a run of 2^28 pixels)."""


class RvlError(ValueError):
    """The payload is no RVL image of the stated size."""


def decode_rvl(payload: bytes, pixels: int) -> NDArray[np.uint16]:
    """Decode `pixels` depth values.

    Raises:
        RvlError: the payload ends early, or its runs do not add up to `pixels`, or a value leaves 1 to 65535.
    """
    numbers = _numbers(_nibbles(payload))
    starts, lengths, is_count = _runs(numbers, pixels)
    values = _values(numbers[~is_count])
    depth = np.zeros(pixels, np.uint16)
    depth[_inside(starts, lengths, pixels)] = values
    return depth


def encode_rvl(depth: NDArray[np.uint16]) -> bytes:
    """Encode an array of any shape, in row order."""
    flat = np.ascontiguousarray(depth, np.uint16).ravel()
    present = flat[flat != 0].astype(np.int64)
    delta = np.diff(present, prepend=0)
    zeros, lengths = _run_lengths(flat != 0)
    numbers = np.empty(2 * zeros.size + delta.size, np.int64)
    before = np.cumsum(lengths) - lengths  # values before each run
    counts_at = before + 2 * np.arange(zeros.size)
    numbers[counts_at], numbers[counts_at + 1] = zeros, lengths
    is_delta = np.ones(numbers.size, bool)
    is_delta[counts_at] = is_delta[counts_at + 1] = False
    numbers[is_delta] = (delta << 1) ^ (delta >> 63)
    return _pack(numbers)


# ------------------------------------------------------------------------------------------------------ decoding


def _nibbles(payload: bytes) -> NDArray[np.uint8]:
    """Nibbles in the order of writing."""
    if len(payload) % 4:
        raise RvlError(f"the RVL payload of {len(payload)} bytes does not end on a word")
    high_first = np.frombuffer(payload, "<u4").byteswap().view(np.uint8)
    nibbles = np.empty(2 * high_first.size, np.uint8)
    nibbles[0::2] = high_first >> 4
    nibbles[1::2] = high_first & 15
    return nibbles


def _numbers(nibbles: NDArray[np.uint8]) -> NDArray[np.int32]:
    """All numbers of the stream; what follows an unfinished last one is dropped."""
    ends = np.flatnonzero(nibbles < 8)
    longest = int(np.diff(ends, prepend=-1).max(initial=1))
    if longest > MAX_NIBBLES:
        raise RvlError(f"the RVL payload has a number of {longest} nibbles")
    digits = (nibbles & 7).astype(np.int32)
    weights = nibbles[:-1].astype(np.int32) & 8  # 8 where the next nibble belongs to the same number, else 0
    values = digits.copy()  # (N,) of the number from each nibble on; one more nibble is right after each round
    for _ in range(longest - 1):
        values[:-1] = digits[:-1] + weights * values[1:]
    starts = np.concatenate(([0], ends[:-1] + 1))[: ends.size]
    return values[starts]


def _runs(numbers: NDArray[np.int32], pixels: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """First pixel and length of each run of non-zero pixels, and which numbers are not differences."""
    starts, lengths, counts_at = [], [], []
    at, filled, stream = 0, 0, numbers.data
    while filled < pixels:
        if at + 1 >= len(stream):
            raise RvlError(f"the RVL payload ends after {filled} of {pixels} pixels")
        zeros, length = stream[at], stream[at + 1]
        starts.append(filled + zeros)
        lengths.append(length)
        counts_at.append(at)
        filled += zeros + length
        at += 2 + length
    if filled > pixels or at > len(stream):
        raise RvlError(
            f"the RVL payload has runs for {filled} pixels and {len(stream)} numbers; the image has {pixels} pixels"
        )
    is_count = np.zeros(len(stream), bool)
    is_count[counts_at] = True
    is_count[np.asarray(counts_at, np.int64) + 1] = True
    is_count[at:] = True  # the last word is filled up with zeros
    return np.asarray(starts, np.int64), np.asarray(lengths, np.int64), is_count


def _values(folded: NDArray[np.int32]) -> NDArray[np.uint16]:
    """Depth from folded differences."""
    values = np.cumsum((folded >> 1) ^ -(folded & 1), dtype=np.int64)
    if values.size and (values.min() < 1 or values.max() > 65535):
        raise RvlError("the RVL payload has differences that lead out of 1 to 65535")
    return values.astype(np.uint16)


def _inside(starts: NDArray[np.int64], lengths: NDArray[np.int64], pixels: int) -> NDArray[np.bool_]:
    """Which pixels lie in a run of non-zero ones."""
    edges = np.zeros(pixels + 1, np.int8)
    filled = lengths > 0
    edges[starts[filled]] += 1  # runs are disjoint, so no start occurs twice
    edges[starts[filled] + lengths[filled]] -= 1
    return np.cumsum(edges[:-1], dtype=np.int8).view(np.bool_)


# ------------------------------------------------------------------------------------------------------ encoding


def _run_lengths(is_present: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Lengths of the alternating runs: zeros and the non-zeros after them; either may be 0 at the ends."""
    if is_present.size == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    edges = np.flatnonzero(is_present[1:] != is_present[:-1]) + 1
    lengths = np.diff(edges, prepend=0, append=is_present.size)
    if is_present[0]:
        lengths = np.concatenate(([0], lengths))
    if lengths.size % 2:
        lengths = np.concatenate((lengths, [0]))
    return lengths[0::2], lengths[1::2]


def _pack(numbers: NDArray[np.int64]) -> bytes:
    """Numbers as nibbles, eight to a word."""
    sizes = np.ones(numbers.size, np.int64)
    for digit in range(1, MAX_NIBBLES):
        sizes += numbers >= 1 << (3 * digit)
    starts = np.cumsum(sizes) - sizes
    nibbles = np.zeros(-(-int(sizes.sum()) // 8) * 8, np.uint8)
    for digit in range(int(sizes.max(initial=0))):
        longer = sizes > digit
        more = np.where(sizes[longer] > digit + 1, 8, 0)
        nibbles[starts[longer] + digit] = (numbers[longer] >> (3 * digit)) & 7 | more
    return (nibbles[0::2] << 4 | nibbles[1::2]).view("<u4").byteswap().tobytes()
