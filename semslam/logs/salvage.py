"""Walk a log record by record where there is no index to trust, and find the way back after damage.

The walk verifies every chunk it meets (size, compression, checksum, structure), so that what it hands on is a list of
sound blocks with their true time ranges: an index rebuilt. Where a record cannot be true, the walk searches for the
next chunk whose head, lengths and checksum agree, or, in a log without chunks, for the next three messages in a row.

Never handed on: a chunk that fails, a chunk that is cut (nothing verifies its beginning), and the last bare record
before a broken place (its length may be what broke).
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import BinaryIO

from mcap.opcode import Opcode

from semslam.logs.channels import Definitions, Scope
from semslam.logs.chunks import MAX_CHUNK_BYTES, Block, Rows, parse_rows, read_body
from semslam.logs.losses import FileLosses
from semslam.logs.records import (
    CHUNK_HEAD_MAX_BYTES,
    FOOTER,
    HEAD,
    HEAD_BYTES,
    MAGIC,
    MESSAGE_FIELDS_BYTES,
    MESSAGE_HEAD,
    MESSAGE_HEAD_BYTES,
    ChunkHead,
    CutRecordError,
    DamagedRecordError,
    Fields,
    parse_chunk_head,
    parse_metadata,
)
from semslam.logs.source import Source, read_exactly
from semslam.logs.summary import MAX_RECORD_BYTES

RUN_BYTES = 4 << 20
"""Bare records are gathered into runs of about this many bytes, and at most `RUN_RECORDS` records."""
RUN_RECORDS = 20_000
_WINDOW_BYTES = 1 << 20
_CHAIN = 3
"""Sound message records in a row that count as having found the way back in a log without chunks."""
_MAX_GROWTH_BYTES = 1024
"""Bytes that later versions of the format may add to a record. More than that is a damaged length."""

# One pattern each, led by its opcode: so they are searched at memory speed, a hundred times faster than as one. The
# zeros are the upper bytes of the length: chunks below 2^40 bytes, messages below 2^32.
_CHUNK_START = re.compile(rb"\x06(?=.{5}\0\0\0.{28}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0))", re.DOTALL)
_MESSAGE_START = re.compile(rb"\x05(?=.{4}\0\0\0\0)", re.DOTALL)
_DATA_END = re.compile(rb"\x0f\x04\0\0\0\0\0\0\0")
_LANDMARKS = (_CHUNK_START, _DATA_END)
_LANDMARK_BYTES = HEAD_BYTES + 28 + 8

_DEFINITIONS = frozenset((Opcode.SCHEMA, Opcode.CHANNEL))
_INDEXES = frozenset(
    (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET)
)
_AFTER_DATA = _DEFINITIONS | _INDEXES | {Opcode.FOOTER}
_FIRST_UNKNOWN_OPCODE = max(Opcode) + 1


@dataclass
class Layout:
    """What a walk found. `attachments` and `metadata` are (offset of the body, its length)."""

    blocks: list[Block] = field(default_factory=list)
    attachments: list[tuple[int, int]] = field(default_factory=list)
    metadata: list[tuple[int, int]] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    """Messages seen by channel id."""
    data_end: int | None = None
    """Offset of the record that ends the data section; None where it was not found."""


@dataclass
class _Run:
    """Bare records in a row, while they are being gathered."""

    offset: int
    end: int
    start_nanos: int = 1 << 64
    end_nanos: int = 0
    messages: int = 0
    records: int = 0


@dataclass(frozen=True)
class _Bare:
    """A schema, channel or message record outside chunks, held back until the record after it is seen to be sound."""

    offset: int
    end: int
    opcode: int
    channel_id: int = 0
    log_nanos: int = 0
    body: bytes = b""


class Walk:
    """One walk over one file, possibly in several stretches.

    Args:
        definitions: filled with every schema and channel met.
        losses: told of everything that could not be used.
        take_summary: believe schemas and channels behind the data section too. False when its checksum failed.
    """

    def __init__(self, source: Source, definitions: Definitions, losses: FileLosses, *, take_summary: bool) -> None:
        self.layout = Layout()
        self._source = source
        self._definitions = definitions
        self._losses = losses
        self._take_summary = take_summary
        self._scope = Scope(definitions, trusted=False)
        self._run: _Run | None = None
        self._held: _Bare | None = None
        self._bare_messages = 0
        self._chunks = 0
        self._takers: dict[int, Callable[[BinaryIO, int, int], None]] = {
            Opcode.HEADER: self._header,
            Opcode.MESSAGE_INDEX: self._message_index,
            Opcode.ATTACHMENT: self._attachment,
            Opcode.METADATA: self._metadata,
        }

    def stretch(self, start: int, end: int) -> None:
        """Walk the records in the bytes [start, end) of the file."""
        with self._source.open() as handle:
            position = start
            while position < end:
                try:
                    position = self._record(handle, position, end)
                except DamagedRecordError as error:
                    position = self._resume(handle, position, end, error)
        self._release_held()
        self._close_run()

    def _record(self, handle: BinaryIO, position: int, end: int) -> int:
        """Take in one record and return the offset of the next."""
        opcode, length = _head_at(handle, position, end)
        self._release_held()
        if self.layout.data_end is not None:
            return self._record_after_data(handle, position, opcode, length, end)
        if opcode in _DEFINITIONS or opcode == Opcode.MESSAGE:
            self._hold(handle, position, opcode, length)
            return position + HEAD_BYTES + length
        self._close_run()
        if opcode == Opcode.CHUNK:
            self._chunk(handle, position, end)
        elif opcode == Opcode.DATA_END:
            return self._data_end(position, length, end)
        elif opcode in self._takers:
            self._takers[opcode](handle, position + HEAD_BYTES, length)
        else:
            _check_unknown(handle, opcode, position + HEAD_BYTES + length, end)
        return position + HEAD_BYTES + length

    # -- the data section, record by record

    def _hold(self, handle: BinaryIO, position: int, opcode: int, length: int) -> None:
        end = position + HEAD_BYTES + length
        if opcode != Opcode.MESSAGE:
            body = _small_body(handle, position + HEAD_BYTES, length)
            parse = self._definitions.pool.schema if opcode == Opcode.SCHEMA else self._definitions.pool.record
            parse(body)
            self._held = _Bare(position, end, opcode, body=body)
            return
        if not MESSAGE_FIELDS_BYTES <= length <= MAX_CHUNK_BYTES:
            raise DamagedRecordError(f"a message of {length:,} bytes")
        front = read_exactly(handle, position, MESSAGE_HEAD_BYTES)
        _, _, channel_id, _, log_nanos, _ = MESSAGE_HEAD.unpack(front)
        self._held = _Bare(position, end, opcode, channel_id, log_nanos)

    def _release_held(self) -> None:
        """Accept the record held back: what follows it is sound."""
        held, self._held = self._held, None
        if held is None:
            return
        if held.opcode == Opcode.SCHEMA:
            self._scope.add_schema(held.body)
        elif held.opcode == Opcode.CHANNEL:
            self._scope.add_channel(held.body)
        if self.layout.data_end is None:
            self._extend_run(held)

    def _drop_held(self) -> None:
        """Refuse the record held back: what follows it is broken, so its length, or its end, may be."""
        held, self._held = self._held, None
        if held is None:
            return
        self._losses.messages_damaged += held.opcode == Opcode.MESSAGE
        self._losses.skip(held.end - held.offset, f"the record at byte {held.offset:,} stands before a broken place")

    def _extend_run(self, record: _Bare) -> None:
        run = self._run or _Run(record.offset, record.offset)
        self._run = run
        run.end, run.records = record.end, run.records + 1
        if record.opcode == Opcode.MESSAGE:
            run.messages += 1
            run.start_nanos, run.end_nanos = (
                min(run.start_nanos, record.log_nanos),
                max(run.end_nanos, record.log_nanos),
            )
            self._bare_messages += 1
            self._count({record.channel_id: 1})
        if run.end - run.offset >= RUN_BYTES or run.records >= RUN_RECORDS:
            self._close_run()

    def _close_run(self) -> None:
        run, self._run = self._run, None
        if run is not None and run.messages:
            length = run.end - run.offset
            block = Block(run.offset, length, run.start_nanos, run.end_nanos, None, messages=run.messages)
            self.layout.blocks.append(block)

    def _count(self, counts: dict[int, int]) -> None:
        for channel_id, count in counts.items():
            self.layout.counts[channel_id] = self.layout.counts.get(channel_id, 0) + count

    def _chunk(self, handle: BinaryIO, position: int, end: int) -> None:
        """Verify a chunk; skip it when it fails but the record behind it stands where it should."""
        self._chunks += 1
        head = _chunk_head_at(handle, position)
        block = Block(position, head.length, head.start_nanos, head.end_nanos, head)
        try:
            rows = _verify(handle, block, self._definitions)
        except DamagedRecordError as error:
            if position + head.length < end:
                _head_at(handle, position + head.length, end)
            self._losses.chunks_skipped += 1
            self._losses.skip(head.length, f"chunk at byte {position:,} skipped: {error}")
            return
        self._count(rows.counts)
        self.layout.blocks.append(replace(block, start_nanos=rows.start_nanos, end_nanos=rows.end_nanos))

    def _header(self, handle: BinaryIO, offset: int, length: int) -> None:
        fields = Fields(_small_body(handle, offset, length))
        fields.text(), fields.text()

    def _message_index(self, handle: BinaryIO, offset: int, length: int) -> None:
        listed = int.from_bytes(read_exactly(handle, offset, 6)[2:], "little")
        if listed % 16 or not 6 + listed <= length <= 6 + listed + _MAX_GROWTH_BYTES:
            raise DamagedRecordError("the lengths of a message index contradict each other")

    def _attachment(self, handle: BinaryIO, offset: int, length: int) -> None:
        fields = Fields(read_exactly(handle, offset, min(length, 1 << 16)))
        fields.u64(), fields.u64(), fields.text(), fields.text()
        data_length = fields.u64()
        needed = fields.position + data_length + 4
        if not needed <= length <= needed + _MAX_GROWTH_BYTES:
            raise DamagedRecordError("the lengths of an attachment contradict each other")
        self.layout.attachments.append((offset, length))

    def _metadata(self, handle: BinaryIO, offset: int, length: int) -> None:
        parse_metadata(_small_body(handle, offset, length))
        self.layout.metadata.append((offset, length))

    def _data_end(self, position: int, length: int, end: int) -> int:
        if length != 4:
            raise DamagedRecordError(f"a data end of {length:,} bytes")
        self.layout.data_end = position
        return position + HEAD_BYTES + length if self._take_summary else end

    def _record_after_data(self, handle: BinaryIO, position: int, opcode: int, length: int, end: int) -> int:
        following = position + HEAD_BYTES + length
        if opcode in _DEFINITIONS:
            self._hold(handle, position, opcode, length)
        elif opcode == Opcode.FOOTER and length == FOOTER.size:
            self._note_appendix(following + len(MAGIC), end)
            return end
        elif opcode not in _INDEXES:
            _check_unknown(handle, opcode, following, end)
        return following

    def _note_appendix(self, position: int, end: int) -> None:
        if position < end:
            self._losses.skip(end - position, f"{end - position:,} bytes after the end of the recording not read")

    # -- the way back

    def _resume(self, handle: BinaryIO, position: int, end: int, error: DamagedRecordError) -> int:
        """Account for what is broken at `position` and return where to go on, `end` if nowhere."""
        found = self.next_landmark(handle, position + 1, end)
        cut = isinstance(error, CutRecordError) and end == self._source.size and found is None
        if cut:
            self._release_held()
        else:
            self._drop_held()
        self._close_run()
        self._losses.chunks_skipped += self.layout.data_end is None and _starts_chunk(handle, position)
        going_on = end if found is None else found
        self._losses.skip(going_on - position, f"{going_on - position:,} bytes at byte {position:,} skipped: {error}")
        return going_on

    def next_landmark(self, handle: BinaryIO, start: int, end: int) -> int | None:
        """The next offset in [start, end) from which the walk can go on; None where there is none."""
        without_chunks = self._bare_messages > 0 and self._chunks == 0
        patterns = (*_LANDMARKS, _MESSAGE_START) if without_chunks else _LANDMARKS
        for candidate in _matches(handle, patterns, start, end):
            try:
                if self._is_sound(handle, candidate, end):
                    return candidate
            except DamagedRecordError:
                continue
        return None

    def _is_sound(self, handle: BinaryIO, position: int, end: int) -> bool:
        """Whether a record that must be true stands here; False, or DamagedRecordError, for other bytes."""
        opcode, length = _head_at(handle, position, end)
        following = position + HEAD_BYTES + length
        if opcode == Opcode.DATA_END:
            return following == end or _head_at(handle, following, end)[0] in _AFTER_DATA
        if opcode == Opcode.MESSAGE:
            return self._is_chain(handle, position, end)
        head = _chunk_head_at(handle, position)
        block = Block(position, head.length, head.start_nanos, head.end_nanos, head)
        return _verify(handle, block, Definitions(self._definitions.pool)).count > 0

    def _is_chain(self, handle: BinaryIO, position: int, end: int) -> bool:
        """Whether messages of known channels stand here one behind the other, up to the end or `_CHAIN` of them."""
        for link in range(_CHAIN):
            if link and position == end:
                return True
            opcode, length = _head_at(handle, position, end)
            if opcode == Opcode.DATA_END and length == 4:
                return True
            channel_id = int.from_bytes(read_exactly(handle, position + HEAD_BYTES, 2), "little")
            known = self._definitions.channel(channel_id) is not None
            if opcode != Opcode.MESSAGE or length < MESSAGE_FIELDS_BYTES or not known:
                return False
            position += HEAD_BYTES + length
        return True


def looks_like_mcap(source: Source, definitions: Definitions, search_bytes: int = 64 << 20) -> bool:
    """Whether a file without MCAP's first bytes holds a sound chunk near its beginning all the same."""
    walk = Walk(source, definitions, FileLosses(source.path.name), take_summary=False)
    with source.open() as handle:
        return walk.next_landmark(handle, 0, min(source.size, search_bytes)) is not None


def _head_at(handle: BinaryIO, position: int, end: int) -> tuple[int, int]:
    """(opcode, length) of a record that fits into what is left before `end`."""
    if end - position < HEAD_BYTES:
        raise CutRecordError(f"{end - position} bytes are left, too few for a record")
    opcode, length = HEAD.unpack(read_exactly(handle, position, HEAD_BYTES))
    if opcode == 0:
        raise DamagedRecordError("no record starts with a zero byte")
    if position + HEAD_BYTES + length > end:
        raise CutRecordError(f"record {opcode:#04x} claims {length:,} bytes, {end - position - HEAD_BYTES:,} are left")
    return opcode, length


def _check_unknown(handle: BinaryIO, opcode: int, following: int, end: int) -> None:
    """Records of later versions are skipped, as the specification asks, if a record follows where they end."""
    if opcode < _FIRST_UNKNOWN_OPCODE:
        raise DamagedRecordError(f"record {opcode:#04x} in the wrong place")
    if following < end:
        _head_at(handle, following, end)


def _small_body(handle: BinaryIO, offset: int, length: int) -> bytes:
    if length > MAX_RECORD_BYTES:
        raise DamagedRecordError(f"a record claims {length:,} bytes; the limit is {MAX_RECORD_BYTES:,}")
    return read_exactly(handle, offset, length)


def _chunk_head_at(handle: BinaryIO, position: int) -> ChunkHead:
    _, length = HEAD.unpack(read_exactly(handle, position, HEAD_BYTES))
    return parse_chunk_head(read_exactly(handle, position, min(HEAD_BYTES + length, CHUNK_HEAD_MAX_BYTES)))[0]


def _starts_chunk(handle: BinaryIO, position: int) -> bool:
    try:
        return read_exactly(handle, position, 1)[0] == Opcode.CHUNK
    except DamagedRecordError:
        return False


def _verify(handle: BinaryIO, block: Block, definitions: Definitions) -> Rows:
    """Read a chunk as if for its messages, but keep none of them."""
    body, checked = read_body(handle, block)
    return parse_rows(body, definitions, checked, wanted=lambda _: False)


def _matches(handle: BinaryIO, patterns: Sequence[re.Pattern[bytes]], start: int, end: int) -> Iterator[int]:
    """Offsets in [start, end) at which one of the patterns matches, ascending, reading a window at a time."""
    while start < end:
        window = _window(handle, start, min(_WINDOW_BYTES, end - start))
        last = start + len(window) >= end
        reach = len(window) if last else len(window) - _LANDMARK_BYTES
        for at in heapq.merge(*(_starts(pattern, window) for pattern in patterns)):
            if at >= reach:
                break
            yield start + at
        if last:
            return
        start += reach


def _starts(pattern: re.Pattern[bytes], window: bytes) -> Iterator[int]:
    return (match.start() for match in pattern.finditer(window))


def _window(handle: BinaryIO, start: int, length: int) -> bytes:
    """Bytes to search; zeros, in which nothing is found, where the disk cannot read them."""
    try:
        return read_exactly(handle, start, length)
    except DamagedRecordError:
        return bytes(length)
