"""Remove what no log of the output folder refers to any more, and what interrupted runs left behind.

Goes: entries whose key is in no record, work folders, temporary files, results of logs or variants without a record.
With `everything`, all entries and records go; `results` stays. With `forget`, one log goes: its record, its
results, and what only it referred to.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import EntryIndex, entry_folders, unfinished
from semslam.pipeline.console import bytes_text
from semslam.pipeline.digest import DigestCache
from semslam.pipeline.files import TEMPORARY, remove, size_bytes
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.record import load_records
from semslam.pipeline.why import find_record


@dataclass(frozen=True)
class CleanReport:
    """What was, or would be, removed: (path, bytes)."""

    removed: tuple[tuple[Path, int], ...]
    dry_run: bool

    @property
    def total_bytes(self) -> int:
        """Bytes of all of it."""
        return sum(number for _, number in self.removed)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        removed = [{"path": str(path), "bytes": number} for path, number in self.removed]
        return {"removed": removed, "bytes": self.total_bytes, "dry_run": self.dry_run}

    def text(self) -> str:
        """For a terminal."""
        verb = "would remove" if self.dry_run else "removed"
        lines = [f"{verb} {path}  {bytes_text(number)}" for path, number in self.removed]
        return "\n".join([*lines, f"{verb} {len(self.removed)} items, {bytes_text(self.total_bytes)}"])


def clean(folder: OutputFolder, *, everything: bool = False, dry_run: bool = False, forget: str = "") -> CleanReport:
    """Clean the folder, which must be locked.

    Raises:
        UsageError: there is no log `forget`.
    """
    forgotten = find_record(folder, forget).name if forget else ""
    chosen = [(path, size_bytes(path)) for path in _removable(folder, everything, forgotten)]
    if not dry_run:
        for path, _ in chosen:
            remove(path)
        _forget(folder)
    return CleanReport(tuple(chosen), dry_run)


def _removable(folder: OutputFolder, everything: bool, forgotten: str) -> Iterator[Path]:
    records = {} if everything else load_records(folder.logs)
    if records.pop(forgotten, None) is not None:
        yield folder.logs / f"{forgotten}.json"
        yield from sorted(folder.logs.glob(f"{glob.escape(forgotten)}.*.traceback.txt"))
    used = {(task.split("/")[0], one.key) for record in records.values() for task, one in record.tasks.items()}
    for entry in entry_folders(folder.cache):
        if (entry.parent.name, entry.name) not in used:
            yield entry
    yield from unfinished(folder.cache)
    for parent in (folder.root, folder.logs, *folder.results.glob("*"), *folder.results.glob("*/*")):
        yield from sorted(parent.glob(f"{TEMPORARY}*"))
    if everything:
        yield from sorted(folder.logs.iterdir())
    else:
        variants = {name: _variants(record.tasks) for name, record in records.items()}
        yield from _stray_results(folder, variants)


def _variants(tasks: object) -> set[str]:
    """Names of folders that a log's results may have."""
    names = tasks if isinstance(tasks, dict) else {}
    return {name.partition("/")[2] for name in names}


def _stray_results(folder: OutputFolder, variants: dict[str, set[str]]) -> Iterator[Path]:
    """Result folders that no record accounts for."""
    for log in sorted(path for path in folder.results.iterdir() if path.is_dir()):
        if log.name not in variants:
            yield log
            continue
        yield from sorted(path for path in log.iterdir() if path.is_dir() and path.name not in variants[log.name])


def _forget(folder: OutputFolder) -> None:
    """Bring the memories in line with what is left."""
    index = EntryIndex(folder.cache)
    index.prune()
    index.save()
    digests = DigestCache(folder.cache / "digests.json")
    digests.forget_missing()
    digests.save()
