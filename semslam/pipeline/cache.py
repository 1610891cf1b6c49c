"""Entries of the cache: content-addressed, published by rename, never changed afterwards.

An entry is a folder named by its key. It holds shards (`shard-00000`, ...), `manifest.json` and `timing.json`. The
manifest says what every file is and its SHA-256, and carries a digest of itself; nothing in it varies with time, so
that equal work gives equal manifests. Only `timing.json` tells how long it took, outside of all digests.

While it is made, an entry is a work folder `.work-<key>` locked by the process that writes it. A shard is written into
`.tmp-*`, flushed, given its own manifest last, and renamed; each shard's manifest holds the digest of the one before.
A killed process therefore leaves whole shards, which the next one hashes again before it trusts them.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError
from semslam.pipeline.digest import FileStamp, sha256_file, sha256_text
from semslam.pipeline.files import TEMPORARY, canonical_json, files_below, read_json, remove, sync, write_json
from semslam.pipeline.job import InputFile

ENTRY_FORMAT = "semslam-entry"
ENTRY_VERSION = 1
MANIFEST = "manifest.json"
TIMING = "timing.json"
SHARD = "shard.json"
WORK = ".work-"
_INDEX_VERSION = 2
_LOCK_WAIT_S = 20.0
_LOCK_POLL_S = 0.05


def shard_name(index: int) -> str:
    """Folder of a shard within its entry."""
    return f"shard-{index:05d}"


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """The value with a digest of itself, for files that no other file vouches for."""
    return {**value, "sha256": sha256_text(canonical_json(dict(value)))}


def unsealed(value: Any) -> dict[str, Any] | None:
    """The value if its digest is right, else None."""
    if not isinstance(value, dict):
        return None
    content = {name: item for name, item in value.items() if name != "sha256"}
    try:
        return content if sha256_text(canonical_json(content)) == value.get("sha256") else None
    except ValueError:
        return None


def key_of(components: Mapping[str, Any]) -> str:
    """The cache key of a task: SHA-256 over the canonical JSON of all that its result depends on."""
    return sha256_text(canonical_json(components))


@dataclass(frozen=True)
class Entry:
    """What planning and showing need to know of a finished entry.

    Attributes:
        tables: digest by table name; an optional table that was not written is missing.
        rows: number of rows by table name.
        files: SHA-256 of the files that are no tables, by name.
        sizes: bytes of every stored file, by its path within the entry.
    """

    stage: str
    key: str
    tables: Mapping[str, str]
    rows: Mapping[str, int]
    files: Mapping[str, str]
    counters: Mapping[str, int]
    warnings: tuple[str, ...]
    remarks: tuple[str, ...]
    sizes: Mapping[str, int]

    @classmethod
    def of(cls, manifest: Mapping[str, Any]) -> Entry:
        """The summary of a manifest."""
        tables = manifest["tables"]
        return cls(
            manifest["stage"],
            manifest["key"],
            {name: table["digest"] for name, table in tables.items()},
            {name: sum(file["rows"] for file in table["shards"]) for name, table in tables.items()},
            {Path(file["file"]).name: file["sha256"] for file in manifest["files"]},
            manifest["counters"],
            tuple(manifest["warnings"]),
            tuple(manifest["remarks"]),
            {file["file"]: file["bytes"] for file in stored_files(manifest)},
        )

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Entry:
        """The summary as `as_json` gave it."""
        return cls(**{**value, "warnings": tuple(value["warnings"]), "remarks": tuple(value["remarks"])})

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**self.__dict__, "warnings": list(self.warnings), "remarks": list(self.remarks)}


class EntryIndex:
    """Summaries of entries, kept in one file so that a plan need not open thousands of manifests.

    A summary counts only while the stamp of its manifest is the one it was made from and every stored file is there
    with its size; entries never change, so that is true until somebody or some disk meddles with one. Contents are
    compared by whoever reads them. The file may be deleted at any time.
    """

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        self._file = cache / "index.json"
        stored = read_json(self._file)
        known = isinstance(stored, dict) and stored.get("version") == _INDEX_VERSION
        self._known: dict[str, dict[str, Any]] = stored["entries"] if known else {}
        self._changed = False

    def find(self, stage: str, key: str) -> Entry | None:
        """The entry if it is there; None if not, if its manifest is damaged, or if a file is missing or cut."""
        name = f"{stage}/{key}"
        try:
            stamp = FileStamp.of(f"{self._cache}/{name}/{MANIFEST}").as_list()
        except OSError:
            if self._known.pop(name, None) is not None:
                self._changed = True
            return None
        known = self._known.get(name)
        if known is None or known["stamp"] != stamp:
            manifest = load_manifest(self._cache / stage / key)
            if manifest is None:
                return None
            known = {"stamp": stamp, "entry": Entry.of(manifest).as_json()}
            self._known[name] = known
            self._changed = True
        entry = Entry.from_json(known["entry"])
        return entry if _all_there(f"{self._cache}/{name}", entry.sizes) else None

    def prune(self) -> None:
        """Drop summaries of entries that are gone."""
        for name in list(self._known):
            self.find(*name.split("/"))

    def save(self) -> None:
        """Write the file if anything is new."""
        if self._changed:
            write_json(self._file, {"version": _INDEX_VERSION, "entries": self._known})
            self._changed = False


def stored_files(manifest: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What a manifest says of every file of its entry: tables, then the others."""
    return [*(file for table in manifest["tables"].values() for file in table["shards"]), *manifest["files"]]


def _all_there(folder: str, sizes: Mapping[str, int]) -> bool:
    """Whether every file of an entry exists with its size."""
    try:
        return all(os.stat(f"{folder}/{name}").st_size == size for name, size in sizes.items())
    except OSError:
        return False


def _usable(folder: Path) -> bool:
    """Whether the entry in `folder` has a good manifest and all its files."""
    manifest = load_manifest(folder)
    return manifest is not None and _all_there(str(folder), Entry.of(manifest).sizes)


class DamagedEntryError(SemslamError):
    """A stored entry is damaged or incomplete: it has to be made again."""

    def __init__(self, message: str, *, hint: str = "", details: str = "", entry: Path = Path()) -> None:
        super().__init__(message, hint=hint, details=details)
        self.entry = entry


def load_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of the entry in `folder`; None if it is missing, damaged or of another version."""
    manifest = unsealed(read_json(folder / MANIFEST))
    if manifest is None or manifest.get("format") != ENTRY_FORMAT or manifest.get("version") != ENTRY_VERSION:
        return None
    return manifest


def table_files(folder: Path) -> dict[str, tuple[InputFile, ...]]:
    """Files of every table of the entry in `folder`, in the order of its shards.

    Raises:
        SemslamError: the manifest is missing or damaged.
    """
    manifest = load_manifest(folder)
    if manifest is None:
        raise DamagedEntryError(
            f"Stored entry `{folder}` is damaged: its `{MANIFEST}` cannot be read",
            hint="run the same command again; it makes the entry anew",
            entry=folder,
        )
    return {
        name: tuple(InputFile(str(folder / part["file"]), part["sha256"]) for part in table["shards"])
        for name, table in manifest["tables"].items()
    }


def entry_folders(cache: Path) -> Iterator[Path]:
    """Folders of all finished entries, sorted."""
    for stage in _folders(cache):
        yield from (entry for entry in _folders(stage) if not entry.name.startswith("."))


def unfinished(cache: Path) -> Iterator[Path]:
    """Work folders and temporary files that interrupted runs left in the cache, sorted."""
    for stage in _folders(cache):
        yield from sorted(path for path in stage.iterdir() if path.name.startswith("."))
    yield from sorted(path for path in cache.glob(f"{TEMPORARY}*"))


def _folders(parent: Path) -> list[Path]:
    return sorted(path for path in parent.iterdir() if path.is_dir()) if parent.is_dir() else []


def finished_shards(cache: Path, stage: str, key: str) -> int:
    """How many shards an unfinished entry seems to have, for the text of a decision."""
    work = cache / stage / f"{WORK}{key}"
    return sum(1 for path in work.iterdir() if path.name.startswith("shard-")) if work.is_dir() else 0


class Work:
    """The unfinished entry of one task, locked for this process.

    Raises:
        SemslamError: another process keeps writing it.
    """

    def __init__(self, stage_folder: Path, key: str) -> None:
        self._target = stage_folder / key
        self.folder = stage_folder / f"{WORK}{key}"
        self._descriptor = _lock_folder(self.folder)
        for leftover in self.folder.glob(f"{TEMPORARY}*"):
            remove(leftover)
        self.shards = self._trusted_shards()

    def _trusted_shards(self) -> list[dict[str, Any]]:
        """Manifests of the shards 0..n-1 that are whole; a damaged one and all after it are removed."""
        trusted: list[dict[str, Any]] = []
        previous = self.key
        while (shard := load_shard(self.folder / shard_name(len(trusted)), previous)) is not None:
            trusted.append(shard)
            previous = shard_digest(shard)
        good = {shard_name(index) for index in range(len(trusted))} | {TIMING}
        for path in sorted(self.folder.iterdir()):
            if path.name not in good:
                remove(path)
        return trusted

    @property
    def key(self) -> str:
        """Key of the entry."""
        return self._target.name

    @property
    def last_digest(self) -> str:
        """What the next shard has to name as its predecessor."""
        return shard_digest(self.shards[-1]) if self.shards else self.key

    def temporary(self) -> Path:
        """A new folder for the next shard."""
        path = self.folder / f"{TEMPORARY}{shard_name(len(self.shards))}"
        path.mkdir()
        return path

    def publish(self, temporary: Path, shard: Mapping[str, Any]) -> None:
        """Make a written shard exist: everything on the disk first, its manifest last, then the rename."""
        for path in files_below(temporary):
            sync(path)
        write_json(temporary / SHARD, sealed(shard), durable=True)
        temporary.rename(self.folder / shard_name(len(self.shards)))
        sync(self.folder)
        self.shards.append(dict(shard))

    def add_timing(self, seconds: float, max_rss_bytes: int) -> None:
        """Add to the time this entry took so far, over all runs."""
        before = read_json(self.folder / TIMING) or {"seconds": 0.0, "max_rss_bytes": 0}
        timing = {
            "seconds": round(before["seconds"] + seconds, 3),
            "max_rss_bytes": max(before["max_rss_bytes"], max_rss_bytes),
        }
        write_json(self.folder / TIMING, timing)

    def finish(self, manifest: Mapping[str, Any]) -> bool:
        """Publish the entry; False if somebody else published the same one first, whose result then stands."""
        write_json(self.folder / MANIFEST, sealed(manifest), durable=True)
        try:
            self.folder.rename(self._target)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            if _usable(self._target):
                remove(self.folder)
                return False
            remove(self._target)  # it is damaged: nobody can use it, and it stands in the way
            self.folder.rename(self._target)
        sync(self._target.parent)
        return True

    def close(self) -> None:
        """Give up the lock; what is published stays for the next run, an empty folder does not."""
        if not self.shards and self.folder.is_dir():
            remove(self.folder)
        os.close(self._descriptor)


def shard_digest(shard: Mapping[str, Any]) -> str:
    """Digest of a shard's manifest, which the next shard names."""
    return sha256_text(canonical_json(dict(shard)))


def load_shard(folder: Path, previous: str, *, hashed: bool = True) -> dict[str, Any] | None:
    """The manifest of a shard if it follows `previous` and (if `hashed`) every file in it is what it was; else None."""
    shard = unsealed(read_json(folder / SHARD))
    if shard is None or shard.get("previous") != previous:
        return None
    if not hashed:
        return shard
    stored = {file["file"]: file for file in (*shard["tables"].values(), *shard["files"].values())}
    if {path.name for path in folder.iterdir()} != {*stored, SHARD}:
        return None
    whole = all(sha256_file(folder / name) == file["sha256"] for name, file in stored.items())
    return shard if whole else None


def _lock_folder(folder: Path) -> int:
    """Make the work folder and hold it; waits for the workers of a killed run to notice and end.

    The lock is on the folder itself: it follows a rename, and needs no file of its own.
    """
    deadline = time.monotonic() + _LOCK_WAIT_S
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.stat(folder).st_ino == os.fstat(descriptor).st_ino:
                return descriptor
        except FileNotFoundError:
            pass  # the one who held it has published it meanwhile; start afresh
        except BlockingIOError:
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise SemslamError(
                    f"Another process is still writing `{folder}`",
                    hint="look for a leftover semslam process with `pgrep -af semslam`, end it, and run again",
                ) from None
            time.sleep(_LOCK_POLL_S)
        os.close(descriptor)


def build_manifest(
    stage: str,
    stage_version: int,
    variant: str,
    components: Mapping[str, Any],
    shards: Sequence[Mapping[str, Any]],
    provenance: Mapping[str, str],
) -> dict[str, Any]:
    """The manifest of an entry out of its shards; the same shards give the same manifest at any time."""
    counters: dict[str, int] = {}
    for shard in shards:
        for name, number in shard["counters"].items():
            counters[name] = counters.get(name, 0) + number
    return {
        "format": ENTRY_FORMAT,
        "version": ENTRY_VERSION,
        "stage": stage,
        "stage_version": stage_version,
        "variant": variant,
        "key": key_of(components),
        "components": dict(components),
        "tables": _tables(shards),
        "files": [_placed(index, file) for index, shard in enumerate(shards) for file in _sorted_files(shard)],
        "shards": len(shards),
        "counters": counters,
        "warnings": _once(shards, "warnings"),
        "remarks": _once(shards, "remarks"),
        "provenance": dict(provenance),
    }


def _once(shards: Sequence[Mapping[str, Any]], kind: str) -> list[str]:
    """Sentences of all shards, each once."""
    return list(dict.fromkeys(sentence for shard in shards for sentence in shard[kind]))


def _tables(shards: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    files: dict[str, list[dict[str, Any]]] = {}
    for index, shard in enumerate(shards):
        for name in sorted(shard["tables"]):
            files.setdefault(name, []).append(_placed(index, shard["tables"][name]))
    return {
        name: {"digest": sha256_text(canonical_json([part["sha256"] for part in parts])), "shards": parts}
        for name, parts in files.items()
    }


def _sorted_files(shard: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [shard["files"][name] for name in sorted(shard["files"])]


def _placed(index: int, file: Mapping[str, Any]) -> dict[str, Any]:
    """What a shard says of a file, with the path within the entry."""
    stored = {name: value for name, value in file.items() if name != "meta"}
    return {**stored, "file": f"{shard_name(index)}/{file['file']}"}
