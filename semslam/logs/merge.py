"""Merge the blocks of a recording into one stream of messages in log-time order, in bounded memory.

A block is opened when the stream reaches its first message and let go with its last, so only blocks whose time ranges
overlap are in memory together. A recording in which too many overlap for the memory allowed is still read whole: blocks
then open when room is made, and messages that come too late for their place are yielded all the same, and counted.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from semslam.logs.channels import Channel
from semslam.logs.chunks import Block, Rows
from semslam.logs.file_index import FileIndex
from semslam.logs.losses import FileLosses

_NEVER = 1 << 65


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as recorded. Times in nanoseconds of the log clock; `data` is encoded as its channel says."""

    channel: Channel
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


@dataclass
class FileReading:
    """One file while it is read: its index, and what this reading found and lost."""

    index: FileIndex
    losses: FileLosses
    counts: dict[int, int] = field(default_factory=dict)
    """Messages read by channel id, wanted or not."""

    def open(self, block: Block, wanted: Callable[[Channel], bool]) -> Rows | None:
        rows = self.index.open_block(block, wanted, self.losses)
        for channel_id, count in rows.counts.items() if rows else ():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + count
        return rows

    def finish(self) -> None:
        """Compare what was read with what the writer counted."""
        if self.losses.messages_expected is not None:
            self.losses.messages_missing = max(0, self.losses.messages_expected - self.losses.messages_read)
        summary = self.index.summary
        expected = summary.statistics.channel_message_counts if summary and summary.statistics else {}
        for channel_id, count in sorted(expected.items()):
            missing = count - self.counts.get(channel_id, 0)
            channel = self.index.definitions.channel(channel_id)
            if missing > 0 and channel is not None:
                lost = self.losses.lost_by_topic
                lost[channel.topic] = lost.get(channel.topic, 0) + missing


@dataclass(slots=True)
class _Open:
    """A block in memory and how far it has been yielded."""

    rows: Rows
    losses: FileLosses
    next: int = 0


class Merge:
    """One pass over all blocks of a recording. Equal log times keep the order of files and, within a file, of bytes."""

    def __init__(self, readings: Sequence[FileReading], wanted: Callable[[Channel], bool], memory_bytes: int) -> None:
        blocks = [(reading, block) for reading in readings for block in _by_offset(reading)]
        entries = ((block.start_nanos, rank, reading, block) for rank, (reading, block) in enumerate(blocks))
        self._waiting = sorted(entries, key=lambda entry: entry[:2], reverse=True)
        self._open: list[tuple[int, int, _Open]] = []
        self._open_bytes = 0
        self._wanted = wanted
        self._memory_bytes = memory_bytes

    def messages(self) -> Iterator[RawMessage]:
        latest = 0
        while self._fill():
            _, rank, block = heapq.heappop(self._open)
            rows, body, position, end = block.rows.rows, block.rows.body, block.next, len(block.rows.rows)
            horizon = self._horizon(rank)
            while position < end:
                log_time, first, last, channel, sequence, publish_time = rows[position]
                if log_time >= horizon:
                    break
                position += 1
                if log_time < latest:
                    block.losses.late_messages += 1
                else:
                    latest = log_time
                yield RawMessage(channel, log_time, publish_time, sequence, body[first:last])
            self._put_back(rank, block, position)

    def _fill(self) -> bool:
        """Open every block that may hold the next message, as far as memory allows. False when all is done."""
        while self._waiting and (not self._open or (self._waiting[-1][:2] < self._open[0][:2] and self._fits())):
            _, rank, reading, block = self._waiting.pop()
            rows = reading.open(block, self._wanted)
            if rows is not None and rows.rows:
                self._open_bytes += rows.cost
                heapq.heappush(self._open, (rows.rows[0][0], rank, _Open(rows, reading.losses)))
        return bool(self._open)

    def _fits(self) -> bool:
        return self._open_bytes + self._waiting[-1][3].size <= self._memory_bytes

    def _horizon(self, rank: int) -> int:
        """The first log time at which another block has a say before the block of this rank."""
        others = [self._open[0][:2]] if self._open else []
        if self._waiting and self._fits():
            others.append(self._waiting[-1][:2])
        time, other = min(others, default=(_NEVER, 0))
        return time if other < rank else time + 1

    def _put_back(self, rank: int, block: _Open, position: int) -> None:
        if position == len(block.rows.rows):
            self._open_bytes -= block.rows.cost
            return
        block.next = position
        heapq.heappush(self._open, (block.rows.rows[position][0], rank, block))


def _by_offset(reading: FileReading) -> list[Block]:
    return sorted(reading.index.layout.blocks, key=lambda block: block.offset)
