"""What a log lost: counted per file while reading, kept in the manifest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

MAX_PROBLEMS = 50
"""Sentences kept per file; the rest is counted."""


@dataclass
class FileLosses:
    """What became of one file. Complete once its messages have been read to the end."""

    name: str
    indexed: bool = False
    """The summary was sound and its chunk index was followed; otherwise the records were walked one by one."""
    truncated: bool = False
    """The file has no footer: the recording was cut short."""
    summary_damaged: bool = False
    """There is a footer, but what it points to contradicts itself or its checksum."""
    messages_read: int = 0
    """Messages found sound, of all channels, wanted or not."""
    messages_expected: int | None = None
    """Messages the writer counted; None where no sound summary says so."""
    messages_missing: int = 0
    """Expected less read, known once the file has been read to its end."""
    messages_unverified: int = 0
    """Part of `messages_read` that no checksum covers: the writer stored none."""
    messages_unknown_channel: int = 0
    """Dropped: no surviving record says what channel they belong to."""
    messages_damaged: int = 0
    """Dropped: messages outside chunks at a place where the file is broken, or under a failed data checksum."""
    chunks_read: int = 0
    chunks_skipped: int = 0
    """Dropped whole: checksum, compression or structure failed."""
    bytes_skipped: int = 0
    """Bytes of the file that could not be used, skipped chunks included."""
    late_messages: int = 0
    """Yielded after a message with a later log time (overlap beyond the memory allowed, or wrong chunk times)."""
    lost_by_topic: dict[str, int] = field(default_factory=dict)
    """Expected less read, where the writer's counts survived; only topics that lost something."""
    problems: list[str] = field(default_factory=list)
    problems_left_out: int = 0

    @property
    def state(self) -> str:
        """`ok`, or `salvaged` when anything at all is missing."""
        messages = self.messages_missing + self.messages_unknown_channel + self.messages_damaged
        bytes_or_chunks = self.bytes_skipped + self.chunks_skipped
        damaged = self.truncated or self.summary_damaged or messages or bytes_or_chunks
        return "salvaged" if damaged else "ok"

    def note(self, problem: str) -> None:
        """Keep a sentence, up to a bound: a log damaged in a million places must not fill the manifest."""
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(problem)
        else:
            self.problems_left_out += 1

    def skip(self, byte_count: int, problem: str) -> None:
        self.bytes_skipped += byte_count
        self.note(problem)

    def copy(self) -> FileLosses:
        return replace(self, lost_by_topic=dict(self.lost_by_topic), problems=list(self.problems))

    def as_json(self) -> dict[str, object]:
        """Plain values, in a fixed order; no name, so that logs of equal content have equal reports."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "name"}
        return {"state": self.state} | values


@dataclass
class LossReport:
    """What became of a recording: one entry a file, totals over all of them."""

    files: Sequence[FileLosses]

    @property
    def state(self) -> str:
        """`ok`, or `salvaged` when any file lost anything."""
        return "salvaged" if any(file.state == "salvaged" for file in self.files) else "ok"

    @property
    def truncated(self) -> bool:
        return any(file.truncated for file in self.files)

    @property
    def messages_read(self) -> int:
        return sum(file.messages_read for file in self.files)

    @property
    def messages_expected(self) -> int | None:
        """None as soon as one file cannot say."""
        counts = [file.messages_expected for file in self.files]
        return None if None in counts else sum(count for count in counts if count is not None)

    @property
    def messages_missing(self) -> int:
        return sum(file.messages_missing for file in self.files)

    @property
    def messages_unverified(self) -> int:
        return sum(file.messages_unverified for file in self.files)

    @property
    def messages_unknown_channel(self) -> int:
        return sum(file.messages_unknown_channel for file in self.files)

    @property
    def messages_damaged(self) -> int:
        return sum(file.messages_damaged for file in self.files)

    @property
    def chunks_read(self) -> int:
        return sum(file.chunks_read for file in self.files)

    @property
    def chunks_skipped(self) -> int:
        return sum(file.chunks_skipped for file in self.files)

    @property
    def bytes_skipped(self) -> int:
        return sum(file.bytes_skipped for file in self.files)

    @property
    def late_messages(self) -> int:
        return sum(file.late_messages for file in self.files)

    @property
    def problems(self) -> list[str]:
        """Every kept sentence, led by the number of the file it is about where there are several."""
        count = len(self.files)
        leads = [f"file {number} of {count}: " if count > 1 else "" for number in range(1, count + 1)]
        return [f"{lead}{problem}" for lead, file in zip(leads, self.files, strict=True) for problem in file.problems]

    def as_json(self) -> dict[str, object]:
        """Plain values for the manifest."""
        totals = {name: getattr(self, name) for name in _TOTALS}
        return {"state": self.state, **totals, "files": [file.as_json() for file in self.files]}


_TOTALS = (
    "truncated",
    "messages_read",
    "messages_expected",
    "messages_missing",
    "messages_unverified",
    "messages_unknown_channel",
    "messages_damaged",
    "chunks_read",
    "chunks_skipped",
    "bytes_skipped",
    "late_messages",
)
