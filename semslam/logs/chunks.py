"""Blocks of messages: read a chunk, verify it, take it apart.

A block is a chunk, or a run of message records that stand in the file without one. Either is small enough to hold in
memory, knows its time range, and is opened in one go: read, bounded, decompressed, checked, parsed.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from semslam.logs.channels import Channel, Definitions, Scope
from semslam.logs.records import (
    CHUNK_HEAD_MAX_BYTES,
    HEAD,
    HEAD_BYTES,
    MESSAGE_FIELDS_BYTES,
    MESSAGE_HEAD,
    MESSAGE_HEAD_BYTES,
    ChunkHead,
    DamagedRecordError,
    parse_chunk_head,
    parse_message_index,
)
from semslam.logs.source import read_exactly

MAX_CHUNK_BYTES = 1 << 30
"""Chunks that claim to be larger, packed or unpacked, are skipped: recorders write chunks of 1 to 16 MB."""
ROW_COST_BYTES = 200
"""Memory a parsed message takes beside its payload, for the accounts of the merge."""

_AFTER_ALL = 1 << 64
_CRC_AT = HEAD_BYTES + 24
_SCHEMA, _CHANNEL, _MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)

Row = tuple[int, int, int, Channel, int, int]
"""(log time, payload start, payload end, channel, sequence, publish time); sorts by log time, then by place."""


@dataclass(frozen=True, slots=True)
class Block:
    """Where messages lie. Offsets and lengths in bytes of the file, times in nanoseconds of the log clock."""

    offset: int
    length: int
    start_nanos: int
    end_nanos: int
    head: ChunkHead | None
    """None for a run of bare records."""
    head_verified: bool = False
    """The head comes from a summary whose checksum holds, so it outranks the one in front of the chunk."""
    messages: int = 0
    """Messages in a run; 0 for chunks, which are counted when opened."""

    @property
    def size(self) -> int:
        """Bytes in memory once opened, payloads only."""
        return self.head.size if self.head else self.length


@dataclass(slots=True)
class Rows:
    """A block taken apart: the wanted messages as rows over `body`, and counts of all of them."""

    body: bytes
    rows: list[Row]
    counts: dict[int, int]
    """Messages by channel id, wanted or not, unknown ones included."""
    unknown: int
    """Messages whose channel nobody described."""
    start_nanos: int
    end_nanos: int

    @property
    def count(self) -> int:
        return sum(self.counts.values())

    @property
    def cost(self) -> int:
        """Bytes in memory, roughly."""
        return len(self.body) + ROW_COST_BYTES * len(self.rows)


def read_body(handle: BinaryIO, block: Block) -> tuple[bytes, bool]:
    """(records of the block, whether a checksum of their own covers them). Raises DamagedRecordError."""
    if block.head is None:
        return read_exactly(handle, block.offset, block.length), False
    head = block.head
    check_size(head)
    front = read_exactly(handle, block.offset, min(head.length, CHUNK_HEAD_MAX_BYTES))
    crc = _chunk_crc(front, head, block.head_verified)
    body = decompress(read_exactly(handle, block.offset + head.data_offset, head.stored_size), head)
    if crc == 0:
        _check_framing(body)
        _check_against_index(body, handle, block.offset + head.length)
    elif zlib.crc32(body) != crc:
        raise DamagedRecordError("checksum fails")
    return body, crc != 0


def _chunk_crc(front: bytes, expected: ChunkHead, expected_verified: bool) -> int:
    """The CRC that only the chunk itself holds; 0 for none.

    A verified index outranks the head in front of the chunk, as long as there is a CRC to have the last word. Without
    one the two must agree, or a zeroed head would pass for a chunk that never had a checksum.
    """
    crc = int.from_bytes(front[_CRC_AT : _CRC_AT + 4], "little")
    if expected_verified and crc:
        return crc
    if parse_chunk_head(front)[0] != expected:
        raise DamagedRecordError("its head and its index contradict each other")
    return crc


def check_size(head: ChunkHead) -> None:
    """Refuse absurd claims before anything is allocated."""
    for what, size in (("stored", head.stored_size), ("decompressed", head.size)):
        if size > MAX_CHUNK_BYTES:
            raise DamagedRecordError(f"claims {size:,} bytes {what}; the limit is {MAX_CHUNK_BYTES:,}")


def decompress(data: bytes, head: ChunkHead) -> bytes:
    """The records of a chunk: exactly as many bytes as its head claims, never more in memory.

    Raises DamagedRecordError on any doubt.
    """
    codec = _CODECS.get(head.compression)
    if codec is None:
        raise DamagedRecordError(f"unknown compression `{head.compression}`")
    try:
        body = codec(data, head.size)
    except Exception as error:  # zstandard raises ZstdError, lz4 RuntimeError, either MemoryError or OverflowError
        raise DamagedRecordError(f"{head.compression} cannot be decompressed: {error}") from error
    if len(body) != head.size:
        raise DamagedRecordError(f"claims {head.size:,} bytes, holds {len(body):,}")
    return body


def _from_zstd(data: bytes, size: int) -> bytes:
    stated = zstandard.frame_content_size(data)
    if stated not in (-1, size):  # the library allocates what the frame states, whatever the limit it is given
        raise DamagedRecordError(f"claims {size:,} bytes, its zstd frame {stated:,}")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""


def _from_lz4(data: bytes, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    body: bytes = decompressor.decompress(data, max_length=size + 1)
    if not decompressor.eof:
        raise DamagedRecordError("its lz4 frame does not end where it should")
    return body


_CODECS: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, _: data,
    "zstd": _from_zstd,
    "lz4": _from_lz4,
}


def frames(body: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start of the fields, end) of each record. Raises DamagedRecordError unless they fill `body` exactly."""
    position, end = 0, len(body)
    while position < end:
        if end - position < HEAD_BYTES:
            raise DamagedRecordError(f"{end - position} stray bytes after the last record")
        opcode, length = HEAD.unpack_from(body, position)
        start, position = position + HEAD_BYTES, position + HEAD_BYTES + length
        if position > end or opcode == 0:
            raise DamagedRecordError(f"record {opcode:#04x} of {length:,} bytes does not fit")
        yield opcode, start, position


def _check_framing(body: bytes) -> None:
    for opcode, start, end in frames(body):
        if opcode == Opcode.MESSAGE and end - start < MESSAGE_FIELDS_BYTES:
            raise DamagedRecordError(f"a message of {end - start} bytes")


def _check_against_index(body: bytes, handle: BinaryIO, offset: int) -> None:
    """Compare a chunk without checksum with the message index behind it, which repeats channels, times and places."""
    expected = _read_message_index(handle, offset)
    found: dict[int, list[tuple[int, int]]] = {channel_id: [] for channel_id in expected}
    for opcode, start, _ in frames(body):
        if opcode == Opcode.MESSAGE:
            at = start - HEAD_BYTES
            _, _, channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(body, at)
            found.get(channel_id, []).append((log_time, at))
    if any(sorted(entries) != sorted(found[channel_id]) for channel_id, entries in expected.items()):
        raise DamagedRecordError("has no checksum and contradicts its message index")


def _read_message_index(handle: BinaryIO, offset: int) -> dict[int, list[tuple[int, int]]]:
    """Entries by channel id; empty where there is no sound index (then there is nothing to compare with)."""
    expected: dict[int, list[tuple[int, int]]] = {}
    try:
        while True:
            opcode, length = HEAD.unpack(read_exactly(handle, offset, HEAD_BYTES))
            if opcode != Opcode.MESSAGE_INDEX:
                return expected
            if length > MAX_CHUNK_BYTES:
                return {}
            channel_id, entries = parse_message_index(read_exactly(handle, offset + HEAD_BYTES, length))
            expected.setdefault(channel_id, []).extend(entries)
            offset += HEAD_BYTES + length
    except DamagedRecordError:
        return {}


def parse_rows(body: bytes, definitions: Definitions, trusted: bool, wanted: Callable[[Channel], bool]) -> Rows:
    """Take a block's records apart. Messages are located, not copied; only wanted ones become rows, in log-time order.

    One loop over all records, written for speed: every message of every log passes through it.

    Args:
        trusted: a checksum covers `body`, so its schema and channel records outrank unchecked ones.
    """
    scope = Scope(definitions, trusted)
    chosen: dict[int, Channel | None] = {}  # None: unwanted or a stranger
    strangers: set[int] = set()
    rows: list[Row] = []
    counts: dict[int, int] = {}
    unknown, oldest, newest, in_order = 0, _AFTER_ALL, 0, True
    position, end = 0, len(body)
    while position < end:
        if end - position >= MESSAGE_HEAD_BYTES:
            opcode, length, channel_id, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(body, position)
        elif end - position >= HEAD_BYTES:
            opcode, length = HEAD.unpack_from(body, position)
        else:
            raise DamagedRecordError(f"{end - position} stray bytes after the last record")
        start = position + HEAD_BYTES
        following = start + length
        if following > end or opcode == 0:
            raise DamagedRecordError(f"record {opcode:#04x} of {length:,} bytes does not fit")
        if opcode == _MESSAGE:
            if length < MESSAGE_FIELDS_BYTES:
                raise DamagedRecordError(f"a message of {length} bytes")
            if channel_id not in chosen:
                channel = scope.channel(channel_id)
                chosen[channel_id] = channel if channel is not None and wanted(channel) else None
                if channel is None:
                    strangers.add(channel_id)
            counts[channel_id] = counts.get(channel_id, 0) + 1
            if log_time < oldest:
                oldest = log_time
            if log_time < newest:
                in_order = False
            else:
                newest = log_time
            if (channel := chosen[channel_id]) is not None:
                rows.append((log_time, position + MESSAGE_HEAD_BYTES, following, channel, sequence, publish_time))
            elif channel_id in strangers:
                unknown += 1
        elif opcode == _SCHEMA:
            scope.add_schema(body[start:following])
        elif opcode == _CHANNEL:
            defined = scope.add_channel(body[start:following])
            chosen.pop(defined, None)
            strangers.discard(defined)
        position = following
    if not in_order:
        rows.sort(key=_time_and_place)
    return Rows(body, rows, counts, unknown, min(oldest, newest), newest)


def _time_and_place(row: Row) -> tuple[int, int]:
    return row[0], row[1]
