"""The summary section at the end of a file: read if intact, otherwise not believed at all."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.opcode import Opcode

from semslam.logs.records import (
    DATA_END_BYTES,
    FOOTER,
    FOOTER_BYTES,
    HEAD,
    HEAD_BYTES,
    MAGIC,
    ChunkIndex,
    DamagedRecordError,
    Statistics,
    parse_chunk_index,
    parse_statistics,
)
from semslam.logs.source import Source, read_exactly

_WINDOW_BYTES = 1 << 20
MAX_RECORD_BYTES = 1 << 28
"""Records other than chunks, messages and attachments that claim more are not believed."""


@dataclass
class Summary:
    """What the end of a file says about the rest of it. Schema and channel records stay bodies, in file order."""

    data_end: int
    """Offset of the record that ends the data section."""
    verified: bool
    """A checksum covers the section and holds; False where the writer stored none."""
    schemas: list[bytes] = field(default_factory=list)
    channels: list[bytes] = field(default_factory=list)
    chunks: list[ChunkIndex] = field(default_factory=list)
    statistics: Statistics | None = None


@dataclass(frozen=True)
class _Footer:
    offset: int
    start: int
    """Where it says that the summary starts; 0 where there is none."""
    crc: int
    covered: bytes
    """Its own bytes that the CRC covers."""


def read_summary(source: Source) -> Summary:
    """Read the footer and the section it points to; an empty Summary where the writer left none.

    Raises DamagedRecordError when there is no footer, when the checksum fails, or when anything in the section
    contradicts itself.
    """
    with source.open() as handle:
        footer = _read_footer(handle, source.size)
        summary = _read_section(handle, footer, footer.start)
        if not summary.verified:
            _check_data_end(handle, summary.data_end)
    return summary


def read_displaced_summary(source: Source, data_end: int) -> Summary:
    """The section behind the data section as a walk has found it, though the footer points elsewhere.

    Its checksum decides; without one, or as `read_summary`, raises DamagedRecordError.
    """
    with source.open() as handle:
        summary = _read_section(handle, _read_footer(handle, source.size), data_end + DATA_END_BYTES)
    if not summary.verified:
        raise DamagedRecordError("no checksum covers the summary, and its place is in doubt")
    return summary


def has_footer(source: Source) -> bool:
    """Whether the file ends as a finished recording does; what the footer says is not looked at."""
    with source.open() as handle:
        try:
            _read_footer(handle, source.size)
        except DamagedRecordError:
            return False
    return True


def _read_footer(handle: BinaryIO, size: int) -> _Footer:
    offset = size - len(MAGIC) - FOOTER_BYTES
    if offset < 0:
        raise DamagedRecordError("the file has no footer")
    tail = read_exactly(handle, offset, FOOTER_BYTES + len(MAGIC))
    if not tail.endswith(MAGIC) or HEAD.unpack_from(tail) != (Opcode.FOOTER, FOOTER.size):
        raise DamagedRecordError("the file has no footer")
    start, _, crc = FOOTER.unpack_from(tail, HEAD_BYTES)
    return _Footer(offset, start, crc, tail[: FOOTER_BYTES - 4])


def _read_section(handle: BinaryIO, footer: _Footer, start: int) -> Summary:
    """The records in [start, footer), verified where there is a checksum; nothing where `start` is 0."""
    if start == 0:
        return Summary(footer.offset - DATA_END_BYTES, verified=False)
    if not len(MAGIC) + DATA_END_BYTES <= start <= footer.offset:
        raise DamagedRecordError("the footer points outside the file")
    summary = Summary(start - DATA_END_BYTES, _check_crc(handle, start, footer))
    _fill(summary, handle, start, footer.offset)
    return summary


def _check_data_end(handle: BinaryIO, offset: int) -> None:
    if offset < len(MAGIC):
        raise DamagedRecordError("the file is too short to have a data section")
    if HEAD.unpack(read_exactly(handle, offset, HEAD_BYTES)) != (Opcode.DATA_END, 4):
        raise DamagedRecordError("the data section does not end where the footer says")


def _check_crc(handle: BinaryIO, start: int, footer: _Footer) -> bool:
    """True: holds; False: there is none. DamagedRecordError: fails."""
    if footer.crc == 0:
        return False
    crc = 0
    for position in range(start, footer.offset, _WINDOW_BYTES):
        crc = zlib.crc32(read_exactly(handle, position, min(_WINDOW_BYTES, footer.offset - position)), crc)
    if zlib.crc32(footer.covered, crc) != footer.crc:
        raise DamagedRecordError("the checksum of the summary fails")
    return True


def _fill(summary: Summary, handle: BinaryIO, start: int, end: int) -> None:
    for opcode, body in _records(handle, start, end):
        if opcode == Opcode.SCHEMA:
            summary.schemas.append(body)
        elif opcode == Opcode.CHANNEL:
            summary.channels.append(body)
        elif opcode == Opcode.CHUNK_INDEX:
            summary.chunks.append(parse_chunk_index(body))
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parse_statistics(body)


def _records(handle: BinaryIO, position: int, end: int) -> Iterator[tuple[int, bytes]]:
    while position < end:
        opcode, length = HEAD.unpack(read_exactly(handle, position, HEAD_BYTES))
        position += HEAD_BYTES + length
        if opcode == 0 or position > end or length > MAX_RECORD_BYTES:
            raise DamagedRecordError(f"record {opcode:#04x} of {length:,} bytes does not fit into the summary")
        yield opcode, read_exactly(handle, position - length, length)
