"""One MCAP file on disk: opened by name for every read, refused with a reason when it cannot be a log."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from semslam.errors import SemslamError
from semslam.logs.records import MAGIC, CutRecordError, DamagedRecordError

_WINDOW_BYTES = 1 << 20

_OTHER_FORMATS = (
    (b"#ROSBAG V", "a ROS 1 bag", "Convert it with `mcap convert {name} {stem}.mcap`"),
    (b"SQLite format 3", "a ROS 2 sqlite3 bag", "Convert it with `ros2 bag convert`, output storage `mcap`"),
    (b"\x28\xb5\x2f\xfd", "a zstd-compressed file", "Decompress it with `zstd -d {name}`"),
    (b"\x04\x22\x4d\x18", "an lz4-compressed file", "Decompress it with `lz4 -d {name}`"),
    (b"\x1f\x8b", "a gzip-compressed file", "Decompress it with `gunzip {name}`"),
    (b"version https://git-lfs", "a Git LFS pointer, not the log itself", "Fetch the log with `git lfs pull`"),
)


@dataclass(frozen=True)
class Source:
    """A readable file and its size. Holds no handle, so a recording may be split over any number of files."""

    path: Path
    size: int

    @contextmanager
    def open(self) -> Iterator[BinaryIO]:
        """A buffered handle; a file that can no longer be opened raises SemslamError."""
        try:
            handle = self.path.open("rb")
        except OSError as error:
            raise SemslamError(f"Cannot open `{self.path}`: {error.strerror}", hint=_hint(error)) from error
        with handle:
            yield handle

    def head(self, length: int) -> bytes:
        """The first `length` bytes, or all of a shorter file; nothing where the disk cannot read them."""
        try:
            with self.open() as handle:
                return read_exactly(handle, 0, min(length, self.size))
        except DamagedRecordError:
            return b""

    def checksum(self, end: int) -> int:
        """CRC-32 of the bytes [0, end)."""
        crc = 0
        with self.open() as handle:
            for position in range(0, end, _WINDOW_BYTES):
                crc = zlib.crc32(read_exactly(handle, position, min(_WINDOW_BYTES, end - position)), crc)
        return crc


def read_exactly(handle: BinaryIO, offset: int, length: int) -> bytes:
    """The bytes [offset, offset + length).

    Raises CutRecordError where the file ends sooner, DamagedRecordError where the disk fails.
    """
    try:
        handle.seek(offset)
        data = handle.read(length)
    except OSError as error:
        raise DamagedRecordError(f"{length:,} bytes at {offset:,} cannot be read: {error.strerror}") from error
    if len(data) != length:
        raise CutRecordError(f"{length:,} bytes wanted at {offset:,}, {len(data):,} are there")
    return data


def open_source(path: Path) -> Source:
    """Check that `path` names a file that can be read; it may be empty. Raises SemslamError."""
    try:
        status = path.stat()
    except OSError as error:
        raise SemslamError(f"Cannot read `{path}`: {error.strerror}", hint=_hint(error)) from error
    if path.is_dir():
        raise SemslamError(f"`{path}` is a folder, not an MCAP file", hint=_hint_for_folder(path))
    if not path.is_file():
        raise SemslamError(
            f"`{path}` is not a regular file", hint="Copy the stream into a file first: MCAP needs seeking"
        )
    source = Source(path, status.st_size)
    with source.open():
        return source


def empty_file(source: Source) -> SemslamError:
    """The error for a recording without a single byte."""
    return SemslamError(
        f"`{source.path}` is empty (0 bytes)", hint="Leave the file out, or copy it again from the robot"
    )


def not_an_mcap_file(source: Source) -> SemslamError:
    """The error for a file in which nothing looks like MCAP, naming what it is instead where that is plain to see."""
    head = source.head(32)
    for prefix, what, hint in _OTHER_FORMATS:
        if head.startswith(prefix):
            hint = hint.format(name=source.path.name, stem=source.path.name.split(".")[0])
            return SemslamError(f"`{source.path}` is {what}", hint=hint)
    facts = f"It has {source.size:,} bytes and starts with {head[: len(MAGIC)]!r}; an MCAP file starts with {MAGIC!r}."
    hint = f"Check where the file came from: `head -c 32 {source.path.name} | xxd`"
    return SemslamError(f"`{source.path}` is not an MCAP file", details=facts, hint=hint)


def _hint(error: OSError) -> str:
    if isinstance(error, PermissionError):
        return "Make the file readable: `chmod +r FILE`"
    if isinstance(error, FileNotFoundError):
        return "Check the spelling; quote names with spaces or stars"
    return "Check the disk or the connection to it, then run the same command again"


def _hint_for_folder(path: Path) -> str:
    inside = sorted(path.glob("*.mcap"))
    return f"Name the files in it: `{path}/*.mcap`" if inside else "Name a file that ends in `.mcap`"
