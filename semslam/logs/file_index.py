"""Where everything lies in one MCAP file: taken from its summary when that is sound, from a walk otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mcap.opcode import Opcode

from semslam.logs.channels import Channel, ChannelPool, Definitions, Scope
from semslam.logs.chunks import MAX_CHUNK_BYTES, Block, Rows, parse_rows, read_body
from semslam.logs.losses import FileLosses
from semslam.logs.records import (
    HEAD,
    HEAD_BYTES,
    MAGIC,
    Attachment,
    DamagedRecordError,
    Metadata,
    parse_attachment,
    parse_metadata,
)
from semslam.logs.salvage import Layout, Walk, looks_like_mcap
from semslam.logs.source import Source, not_an_mcap_file, open_source, read_exactly
from semslam.logs.summary import Summary, has_footer, read_displaced_summary, read_summary


@dataclass
class FileIndex:
    """One file, ready to be read block by block."""

    source: Source
    definitions: Definitions
    summary: Summary | None
    """None where the file has none that can be believed."""
    layout: Layout
    losses: FileLosses
    """What opening the file has shown already; each reading starts from a copy."""

    @cached_property
    def data_holds(self) -> bool | None:
        """Whether the checksum over the whole data section holds; None where there is none. Reads the file once.

        Asked only for messages that no nearer checksum covers.
        """
        offset = self.summary.data_end if self.summary else self.layout.data_end
        if offset is None:
            return None
        with self.source.open() as handle:
            record = read_exactly(handle, offset, HEAD_BYTES + 4)
        expected = int.from_bytes(record[HEAD_BYTES:], "little")
        if expected == 0 or HEAD.unpack_from(record) != (Opcode.DATA_END, 4):
            return None
        return self.source.checksum(offset) == expected

    def open_block(self, block: Block, wanted: Callable[[Channel], bool], losses: FileLosses) -> Rows | None:
        """The wanted messages of a block; None, and the loss counted, where the block cannot be believed."""
        try:
            body, checked = self._read(block)
            rows = parse_rows(body, self.definitions, checked, wanted)
        except DamagedRecordError as error:
            _count_loss(block, losses, error)
            return None
        losses.chunks_read += block.head is not None
        losses.messages_read += rows.count - rows.unknown
        losses.messages_unknown_channel += rows.unknown
        losses.messages_unverified += 0 if checked else rows.count - rows.unknown
        return rows

    def _read(self, block: Block) -> tuple[bytes, bool]:
        """(records, whether a checksum covers them). DamagedRecordError for whatever is wrong with them."""
        with self.source.open() as handle:
            body, checked = read_body(handle, block)
        if not checked and self.data_holds is False:
            raise DamagedRecordError("no checksum of its own, and that of the data section fails")
        return body, checked or bool(self.data_holds)

    def channel_counts(self) -> dict[Channel, int | None]:
        """Every channel described in the file; None where a sound index came without counts."""
        statistics = self.summary.statistics if self.summary and self.losses.indexed else None
        counts: dict[Channel, int | None] = {}
        for channel_id in self.definitions.ids():
            channel = self.definitions.channel(channel_id)
            if channel is not None and self.losses.indexed and statistics is None:
                counts[channel] = None
            elif channel is not None:
                by_id = statistics.channel_message_counts if statistics else self.layout.counts
                counts[channel] = (counts.get(channel) or 0) + by_id.get(channel_id, 0)
        return counts

    def attachments(self, report: Callable[[int, str], None]) -> Iterator[Attachment]:
        for offset, length in self.layout.attachments:
            try:
                yield parse_attachment(self._body(offset, length))
            except DamagedRecordError as error:
                report(length, f"attachment at byte {offset:,} skipped: {error}")

    def metadata(self, report: Callable[[int, str], None]) -> Iterator[Metadata]:
        for offset, length in self.layout.metadata:
            try:
                yield parse_metadata(self._body(offset, length))
            except DamagedRecordError as error:
                report(length, f"metadata at byte {offset:,} skipped: {error}")

    def _body(self, offset: int, length: int) -> bytes:
        if length > MAX_CHUNK_BYTES:
            raise DamagedRecordError(f"{length:,} bytes; the limit is {MAX_CHUNK_BYTES:,}")
        with self.source.open() as handle:
            return read_exactly(handle, offset, length)


def open_index(path: Path, pool: ChannelPool) -> FileIndex:
    """Find out what lies where. Reads the summary; without a sound one, walks and verifies the whole file.

    A file without a byte, which a recorder that died while opening it leaves behind, is a truncated one.

    Raises SemslamError when `path` is not a file that can be read, or nothing in it looks like MCAP.
    """
    source, definitions, losses = open_source(path), Definitions(pool), FileLosses(path.name)
    if source.size == 0:
        losses.truncated = True
        losses.note("is empty (0 bytes)")
        return FileIndex(source, definitions, None, Layout(), losses)
    finished = has_footer(source)
    start = _start(source, definitions, losses, finished)
    losses.truncated = not finished
    summary = _summary(source, definitions, losses) if finished else None
    if not finished:
        losses.note("has no footer: the recording was cut short")
    walk = Walk(source, definitions, losses, take_summary=not finished)
    if summary is not None and _is_usable(summary, definitions):
        losses.indexed = True
        _follow(summary, walk, start)
    else:
        walk.stretch(start, summary.data_end if summary else source.size)
        if losses.summary_damaged:
            summary = _displaced_summary(source, walk.layout.data_end, definitions)
    losses.messages_expected = summary.statistics.message_count if summary and summary.statistics else None
    return FileIndex(source, definitions, summary, walk.layout, losses)


def _start(source: Source, definitions: Definitions, losses: FileLosses, finished: bool) -> int:
    """Where the first record stands, or 0 where the file has lost its first bytes."""
    if source.head(len(MAGIC)) == MAGIC:
        return len(MAGIC)
    if not finished and not looks_like_mcap(source, definitions):
        raise not_an_mcap_file(source)
    losses.note("does not start as an MCAP file does")
    return 0


def _summary(source: Source, definitions: Definitions, losses: FileLosses) -> Summary | None:
    """The summary, its definitions taken in; None and a note where it cannot be believed."""
    try:
        summary = read_summary(source)
        _define(summary, definitions)
    except DamagedRecordError as error:
        losses.summary_damaged = True
        losses.note(f"summary not used: {error}")
        return None
    return summary


def _displaced_summary(source: Source, data_end: int | None, definitions: Definitions) -> Summary | None:
    """The summary behind the data section as the walk has found it: sound, though not where the footer says.

    Where bytes are missing in the middle of a file, and with them the chunk that described the channels, this is the
    only description left.
    """
    if data_end is None:
        return None
    try:
        summary = read_displaced_summary(source, data_end)
        _define(summary, definitions)
    except DamagedRecordError:
        return None
    return summary


def _define(summary: Summary, definitions: Definitions) -> None:
    """Take in every schema and channel, or none: DamagedRecordError where one cannot be parsed."""
    for body in summary.schemas:
        definitions.pool.schema(body)
    for body in summary.channels:
        definitions.pool.record(body)
    scope = Scope(definitions, summary.verified)
    for body in summary.schemas:
        scope.add_schema(body)
    for body in summary.channels:
        scope.add_channel(body)


def _is_usable(summary: Summary, definitions: Definitions) -> bool:
    """Whether the chunk index can be followed: present, free of overlaps, and every channel it names is described.

    Channels that the summary does not repeat are described in some chunk, perhaps one that comes later in time: then
    the file is walked.
    """
    used = {channel_id for chunk in summary.chunks for channel_id in chunk.channel_ids}
    used |= summary.statistics.channel_message_counts.keys() if summary.statistics else set()
    declared = summary.statistics.channel_count if summary.statistics else 1
    described = all(definitions.channel(channel_id) is not None for channel_id in used)
    position, apart = len(MAGIC), True
    for chunk in sorted(summary.chunks, key=lambda chunk: chunk.offset):
        apart = apart and chunk.offset >= position
        position = chunk.offset + chunk.head.length + chunk.index_length
    inside = apart and position <= summary.data_end
    return bool(summary.chunks) and inside and described and len(summary.channels) >= declared


def _follow(summary: Summary, walk: Walk, start: int) -> None:
    """Take the chunks from the index, and walk what lies between them: attachments, metadata, bare messages."""
    position = start
    for chunk in sorted(summary.chunks, key=lambda chunk: chunk.offset):
        walk.stretch(position, chunk.offset)
        head = chunk.head
        block = Block(chunk.offset, head.length, head.start_nanos, head.end_nanos, head, summary.verified)
        walk.layout.blocks.append(block)
        position = chunk.offset + head.length + chunk.index_length
    walk.stretch(position, summary.data_end)


def _count_loss(block: Block, losses: FileLosses, error: Exception) -> None:
    what = "chunk" if block.head else f"{block.messages:,} messages"
    losses.chunks_skipped += block.head is not None
    losses.messages_damaged += block.messages
    losses.skip(block.length, f"{what} at byte {block.offset:,} skipped: {error}")
