"""SHA-256 of what a task depends on, and a memory of it so that unchanged logs are not read again.

The memory (`cache/digests.json`) trusts path, size, modification time, change time and inode together. A file changed
less than two seconds before it was read is not remembered: it could change again within the same time stamp.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from semslam.pipeline.files import read_json, write_json

_BLOCK_BYTES = 1 << 20
_SETTLED_NANOS = 2_000_000_000


@dataclass(frozen=True)
class FileStamp:
    """What tells, without reading it, whether a file is still the one that was digested."""

    bytes: int
    mtime_nanos: int
    ctime_nanos: int
    inode: int

    @classmethod
    def of(cls, path: str | Path) -> FileStamp:
        """The stamp of the file as it is now; OSError if it cannot be reached."""
        found = os.stat(path)
        return cls(found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino)

    def same_content(self, other: FileStamp) -> bool:
        """Whether nothing says that the content differs; the change time may, by a new link or owner."""
        return (self.bytes, self.mtime_nanos, self.inode) == (other.bytes, other.mtime_nanos, other.inode)

    def as_list(self) -> list[int]:
        """Plain numbers for JSON."""
        return [self.bytes, self.mtime_nanos, self.ctime_nanos, self.inode]


def sha256_text(text: str) -> str:
    """SHA-256 of the text as UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_file(path: str | Path, seen: Callable[[int], None] | None = None) -> str:
    """SHA-256 of the file's content in hexadecimal; `seen` is told the bytes of every block."""
    state = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while block := file.read(_BLOCK_BYTES):
            state.update(block)
            if seen is not None:
                seen(len(block))
    return state.hexdigest()


class DigestCache:
    """Digests of files by path, kept between runs in one JSON file. Within a run a file is digested once."""

    def __init__(self, memory: Path) -> None:
        self._memory = memory
        stored = read_json(memory)
        self._known: dict[str, list[int | str]] = stored if isinstance(stored, dict) else {}
        self._seen: dict[str, tuple[FileStamp, str]] = {}
        self._changed = False

    def lookup(self, path: str | Path) -> str | None:
        """The digest of the file if no reading is needed for it; OSError if it cannot be reached."""
        name = os.path.abspath(path)
        if name in self._seen:
            return self._seen[name][1]
        known = self._known.get(name)
        stamp = FileStamp.of(path)
        if known is None or known[:4] != stamp.as_list():
            return None
        self._seen[name] = (stamp, str(known[4]))
        return str(known[4])

    def digest(self, path: str | Path, seen: Callable[[int], None] | None = None) -> str:
        """The digest of the file, read only if it is not known.

        Raises:
            OSError: the file cannot be read.
        """
        known = self.lookup(path)
        if known is not None:
            return known
        name, before = os.path.abspath(path), FileStamp.of(path)
        digest = sha256_file(path, seen)
        self._seen[name] = (before, digest)
        settled = time.time_ns() - before.mtime_nanos > _SETTLED_NANOS
        if settled and FileStamp.of(path) == before:
            self._known[name] = [*before.as_list(), digest]
            self._changed = True
        return digest

    def stamp(self, path: str | Path) -> FileStamp:
        """The stamp that the file had when it was digested in this run; KeyError if it was not."""
        return self._seen[os.path.abspath(path)][0]

    def unknown(self, paths: Iterable[str | Path]) -> list[tuple[Path, int]]:
        """Those files, with their bytes, whose content has to be read; unreachable ones are left out."""
        missing = []
        for path in paths:
            try:
                if self.lookup(path) is None:
                    missing.append((Path(path), os.stat(path).st_size))
            except OSError:
                continue
        return missing

    def warm(self, paths: Sequence[Path], threads: int, seen: Callable[[int], None]) -> None:
        """Digest many files at once; what cannot be read is left for `digest` to complain about."""
        from concurrent.futures import ThreadPoolExecutor  # only a run with new logs pays for the import

        def one(path: Path) -> None:
            try:
                self.digest(path, seen)
            except OSError:
                return

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(one, paths))

    def forget_missing(self) -> None:
        """Drop what is known of files that no longer exist."""
        gone = [path for path in self._known if not os.path.exists(path)]
        for path in gone:
            del self._known[path]
        self._changed = self._changed or bool(gone)

    def save(self) -> None:
        """Write the memory if it changed."""
        if self._changed:
            write_json(self._memory, self._known)
            self._changed = False
