"""MCAP records as bytes: framing and fields, nothing about files.

Every parser is strict: a field that would run past its record raises `DamagedRecordError`. The parsers of the `mcap`
package are not used here, because they take short reads for whole fields and skip the checksum of attachments. Bytes
left over after the last known field are allowed where the specification lets records grow, and only there.

Source: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
"""Opcode and length of the body: what every record starts with."""
HEAD_BYTES = HEAD.size
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel id, sequence, log time, publish time."""
MESSAGE_HEAD_BYTES = MESSAGE_HEAD.size
MESSAGE_FIELDS_BYTES = MESSAGE_HEAD_BYTES - HEAD_BYTES
FOOTER = struct.Struct("<QQI")
FOOTER_BYTES = HEAD_BYTES + FOOTER.size
DATA_END_BYTES = HEAD_BYTES + 4
CHUNK_FIELDS = struct.Struct("<QQQII")
"""Start, end, uncompressed size, uncompressed CRC, length of the compression's name."""
MAX_COMPRESSION_NAME = 16
CHUNK_HEAD_MAX_BYTES = HEAD_BYTES + CHUNK_FIELDS.size + MAX_COMPRESSION_NAME + 8

_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_PAIR = struct.Struct("<HQ")
_STATISTICS = struct.Struct("<QHIIIIQQI")


class DamagedRecordError(ValueError):
    """Bytes that cannot be the record they claim to be."""


class CutRecordError(DamagedRecordError):
    """A record that runs past the end of what there is."""


class Fields:
    """Reads the fields of one record's body from left to right."""

    __slots__ = ("body", "position")

    def __init__(self, body: bytes | memoryview) -> None:
        self.body = body
        self.position = 0

    def take(self, length: int) -> bytes:
        start, self.position = self.position, self.position + length
        if self.position > len(self.body):
            raise DamagedRecordError(f"a field of {length:,} bytes runs past its record of {len(self.body):,}")
        return bytes(self.body[start : self.position])

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        return layout.unpack(self.take(layout.size))

    def u16(self) -> int:
        return self.unpack(_U16)[0]

    def u32(self) -> int:
        return self.unpack(_U32)[0]

    def u64(self) -> int:
        return self.unpack(_U64)[0]

    def text(self) -> str:
        try:
            return str(self.take(self.u32()), "utf-8")
        except UnicodeDecodeError as error:
            raise DamagedRecordError("a name is not UTF-8") from error

    def block(self, length: int) -> Fields:
        """The next `length` bytes as fields of their own (maps and arrays carry their length in bytes)."""
        return Fields(self.take(length))

    def mapping(self) -> dict[str, str]:
        entries, values = self.block(self.u32()), {}
        while not entries.done():
            key = entries.text()
            values[key] = entries.text()
        return values

    def pairs(self, length: int) -> Iterator[tuple[int, int]]:
        """An array of (uint16, uint64), `length` bytes long."""
        if length % _PAIR.size:
            raise DamagedRecordError(f"an array of {length} bytes does not hold whole entries")
        return ((first, second) for first, second in _PAIR.iter_unpack(self.take(length)))

    def done(self) -> bool:
        return self.position >= len(self.body)


@dataclass(frozen=True, slots=True)
class Schema:
    """A schema record; `id` is left out, since ids mean nothing outside their file."""

    name: str
    encoding: str
    data: bytes


def parse_schema(body: bytes | memoryview) -> tuple[int, Schema]:
    """(id, schema)."""
    fields = Fields(body)
    schema_id = fields.u16()
    if schema_id == 0:
        raise DamagedRecordError("a schema has the id 0")
    name, encoding = fields.text(), fields.text()
    return schema_id, Schema(name, encoding, fields.take(fields.u32()))


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """A channel record. Schema id 0 means that the channel has no schema."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


def parse_channel(body: bytes | memoryview) -> ChannelRecord:
    fields = Fields(body)
    return ChannelRecord(fields.u16(), fields.u16(), fields.text(), fields.text(), fields.mapping())


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What is known of a chunk before it is decompressed. Times in nanoseconds of the log clock, sizes in bytes."""

    start_nanos: int
    end_nanos: int
    size: int
    """Claimed size once decompressed."""
    compression: str
    stored_size: int
    """Size of the compressed data in the file."""

    @property
    def data_offset(self) -> int:
        """Where the compressed data starts, counted from the record's opcode."""
        return HEAD_BYTES + CHUNK_FIELDS.size + len(self.compression.encode()) + 8

    @property
    def length(self) -> int:
        """The whole record with its opcode and length."""
        return self.data_offset + self.stored_size


def parse_chunk_head(head: bytes) -> tuple[ChunkHead, int]:
    """(head, CRC of the decompressed data or 0) from the first bytes of a chunk record, opcode included.

    A chunk has no room for later fields, so its two lengths must agree to the byte.
    """
    fields = Fields(head)
    opcode, length = fields.unpack(HEAD)
    if opcode != Opcode.CHUNK:
        raise DamagedRecordError(f"opcode {opcode} where a chunk should start")
    start, end, size, crc, name_length = fields.unpack(CHUNK_FIELDS)
    if name_length > MAX_COMPRESSION_NAME:
        raise DamagedRecordError(f"a compression name of {name_length:,} bytes")
    chunk = ChunkHead(start, end, size, str(fields.take(name_length), "utf-8", "replace"), fields.u64())
    if chunk.length != HEAD_BYTES + length or start > end:
        raise DamagedRecordError("the lengths or times of a chunk contradict each other")
    return chunk, crc


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """Where a chunk lies; `index_length` bytes of message index records follow it."""

    offset: int
    head: ChunkHead
    index_length: int
    channel_ids: tuple[int, ...]


def parse_chunk_index(body: bytes | memoryview) -> ChunkIndex:
    fields = Fields(body)
    start, end, offset, length = fields.u64(), fields.u64(), fields.u64(), fields.u64()
    channel_ids = tuple(channel_id for channel_id, _ in fields.pairs(fields.u32()))
    index_length, compression = fields.u64(), fields.text()
    stored_size, size = fields.u64(), fields.u64()
    head = ChunkHead(start, end, size, compression, stored_size)
    if head.length != length:
        raise DamagedRecordError("the lengths in a chunk index contradict each other")
    return ChunkIndex(offset, head, index_length, channel_ids)


@dataclass(frozen=True, slots=True)
class Statistics:
    """What the writer counted."""

    message_count: int
    channel_count: int
    channel_message_counts: dict[int, int]


def parse_statistics(body: bytes | memoryview) -> Statistics:
    fields = Fields(body)
    messages, _, channels, _, _, _, _, _, length = fields.unpack(_STATISTICS)
    return Statistics(messages, channels, dict(fields.pairs(length)))


def parse_message_index(body: bytes | memoryview) -> tuple[int, list[tuple[int, int]]]:
    """(channel id, [(log time, offset in the decompressed chunk), ...])."""
    fields = Fields(body)
    channel_id, length = fields.u16(), fields.u32()
    if length % 16 or len(body) < 6 + length:
        raise DamagedRecordError("a message index does not hold whole entries")
    return channel_id, list(struct.iter_unpack("<QQ", fields.take(length)))


@dataclass(frozen=True, slots=True)
class Metadata:
    """A metadata record: named text values of the whole recording."""

    name: str
    values: dict[str, str]


def parse_metadata(body: bytes | memoryview) -> Metadata:
    fields = Fields(body)
    return Metadata(fields.text(), fields.mapping())


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside the log. Times in nanoseconds; `create_nanos` is 0 where unknown."""

    name: str
    media_type: str
    log_nanos: int
    create_nanos: int
    data: bytes = field(repr=False)


def parse_attachment(body: bytes | memoryview) -> Attachment:
    """Raises DamagedRecordError when the attachment carries a checksum and it fails."""
    fields = Fields(body)
    log_nanos, create_nanos, name, media_type = fields.u64(), fields.u64(), fields.text(), fields.text()
    data = fields.take(fields.u64())
    covered, crc = fields.position, fields.u32()
    if crc and zlib.crc32(body[:covered]) != crc:
        raise DamagedRecordError(f"the checksum of attachment `{name}` fails")
    return Attachment(name, media_type, log_nanos, create_nanos, data)
