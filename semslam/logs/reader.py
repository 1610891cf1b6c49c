"""Read a recording as if the robot had lost power while making it.

`LogReader` yields the messages of one recording, whole or damaged, split over any number of files or not, in log-time
order, in memory that does not grow with the files. Nothing unverified passes where a checksum exists:

- an intact file is read by its chunk index, every chunk under its checksum;
- a file without a sound summary is walked from front to back first, which rebuilds the index (`semslam.logs.salvage`);
- what fails is left out, whole chunks at a time, and counted in `losses`, which ends up in the manifest;
- messages that no checksum covers (the writer stored none: rosbag2 and unchunked logs, by default) are read when their
  structure and, where there is one, their message index agree, and are counted as `messages_unverified`. When the
  data section as a whole has a checksum and that fails, they are left out: any of them may be the damaged one.

The last, cut chunk of an unfinished file is left out as well: only a whole chunk can be verified.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path

from semslam.errors import SemslamError
from semslam.logs.channels import Channel, ChannelPool
from semslam.logs.file_index import open_index
from semslam.logs.losses import FileLosses, LossReport
from semslam.logs.merge import FileReading, Merge, RawMessage
from semslam.logs.records import Attachment, Metadata
from semslam.logs.source import empty_file

__all__ = ["Attachment", "Channel", "FileLosses", "LogReader", "LossReport", "Metadata", "RawMessage"]

MEMORY_BYTES = 512 << 20
"""Decompressed chunks held at once, at most; one chunk is always held, whatever its size."""


class LogReader:
    """One recording.

    Args:
        paths: the file, or the files a recorder split it into, in recording order.
        memory_bytes: limit for the chunks held at once where their time ranges overlap.

    Raises SemslamError when a file cannot be opened or nothing in it looks like MCAP; an empty file is a loss as long
    as another one is not empty. Opening reads the summaries; a file without a sound one is read through once, so that
    its messages can be given in order.
    """

    def __init__(self, paths: Sequence[Path], *, memory_bytes: int = MEMORY_BYTES) -> None:
        if not paths:
            raise SemslamError("No log file given", hint="Name at least one `.mcap` file")
        _refuse_repeats(paths)
        pool = ChannelPool()
        self._files = [open_index(Path(path), pool) for path in paths]
        if not any(file.source.size for file in self._files):
            raise empty_file(self._files[0].source)
        self._memory_bytes = memory_bytes
        self.losses = LossReport([file.losses.copy() for file in self._files])
        """What the latest reading lost; complete once `messages()` is exhausted."""

    def channels(self) -> list[tuple[Channel, int | None]]:
        """Every channel with its number of messages, by topic.

        The number is what an intact summary says, or what a walk through a file without one has found; None where a
        sound summary came without statistics.
        """
        totals: dict[Channel, int | None] = {}
        for file in self._files:
            for channel, count in file.channel_counts().items():
                known = totals.get(channel, 0)
                totals[channel] = None if known is None or count is None else known + count
        return sorted(totals.items(), key=lambda entry: _sort_key(entry[0]))

    def messages(self, wanted: Callable[[Channel], bool] | None = None) -> Iterator[RawMessage]:
        """The sound messages of the wanted channels, all of them by default, by ascending log time.

        Files are merged: a recording split over several files comes out as if it were one. Equal log times keep the
        order of `paths` and, within a file, of its bytes. The order is broken only by `losses.late_messages`.

        Args:
            wanted: asked once per channel; messages it refuses are verified but never copied.
        """
        readings = [FileReading(file, file.losses.copy()) for file in self._files]
        self.losses = LossReport([reading.losses for reading in readings])
        yield from Merge(readings, cache(wanted or _everything), self._memory_bytes).messages()
        for reading in readings:
            reading.finish()

    def attachments(self) -> Iterator[Attachment]:
        """The attachments of all files whose checksum holds; one at a time in memory."""
        for rank, file in enumerate(self._files):
            yield from file.attachments(partial(self._lost, rank))

    def metadata(self) -> Iterator[Metadata]:
        """The metadata records of all files. The format gives them no checksum; their structure is checked."""
        for rank, file in enumerate(self._files):
            yield from file.metadata(partial(self._lost, rank))

    def _lost(self, rank: int, length: int, problem: str) -> None:
        """Count a record for this reading and those to come, once."""
        for losses in (self._files[rank].losses, self.losses.files[rank]):
            if problem not in losses.problems:
                losses.skip(length, problem)


def _everything(_: Channel) -> bool:
    return True


def _sort_key(channel: Channel) -> tuple[object, ...]:
    metadata = sorted(channel.metadata.items())
    schema = (channel.schema_name, channel.schema_encoding, channel.schema_data)
    return (channel.topic, *schema, channel.message_encoding, metadata)


def _refuse_repeats(paths: Sequence[Path]) -> None:
    seen: set[Path] = set()
    for path in paths:
        resolved = Path(path).resolve()
        if resolved in seen:
            raise SemslamError(f"`{path}` is given twice", hint="Name each file of the recording once")
        seen.add(resolved)
