"""Does what is stored still say what it said? Hashes every file again; on request makes every result again.

Checked: the digest that each manifest carries of itself, its key against its components, the chain of its shards, size
and SHA-256 of every file, files that should not be there, results against the entries they were copied from, whether
every result that a log refers to exists, and `sites`, the folder of a merge.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import (
    MANIFEST,
    SHARD,
    TIMING,
    Entry,
    EntryIndex,
    build_manifest,
    entry_folders,
    key_of,
    load_manifest,
    load_shard,
    shard_digest,
    shard_name,
    stored_files,
)
from semslam.pipeline.config import load_config
from semslam.pipeline.console import Console, byte_bar
from semslam.pipeline.digest import sha256_file
from semslam.pipeline.discover import Log
from semslam.pipeline.files import TEMPORARY, canonical_json, files_below, remove, size_bytes
from semslam.pipeline.folder import OutputFolder, create_folder
from semslam.pipeline.merge_folder import changed
from semslam.pipeline.plan import changes
from semslam.pipeline.record import LogRecord, load_records
from semslam.pipeline.results import published_key, result_names
from semslam.pipeline.run import run_logs
from semslam.pipeline.runner import TaskResult
from semslam.stages.contract import Stage


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be. `entry` is the folder to drop, if a stored entry is damaged."""

    path: str
    what: str
    entry: Path | None = None


@dataclass(frozen=True)
class VerifyReport:
    """What was looked at and what was found."""

    entries: int
    files: int
    rederived: int
    findings: tuple[Finding, ...]
    removed: int = 0

    @property
    def ok(self) -> bool:
        """Whether everything is as it should be."""
        return not self.findings

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "ok": self.ok,
            "entries": self.entries,
            "files": self.files,
            "rederived": self.rederived,
            "removed": self.removed,
            "findings": [{"path": finding.path, "what": finding.what} for finding in self.findings],
        }

    def text(self) -> str:
        """For a terminal."""
        lines = [f"{finding.path}: {finding.what}" for finding in self.findings]
        done = f"{self.entries} entries, {self.files} files hashed"
        done += f", {self.rederived} results made again" if self.rederived else ""
        if self.removed:
            lines.append(f"removed {self.removed} damaged entries; run the same command again to make them anew")
        return "\n".join([*lines, f"{done}: {'all as stored' if self.ok else f'{len(self.findings)} findings'}"])


def verify_folder(
    folder: OutputFolder,
    stages: Sequence[Stage],
    console: Console,
    *,
    again: bool = False,
    drop: bool = False,
    workers: int | None = None,
) -> VerifyReport:
    """Check the folder, make results `again`, `drop` damaged entries, as asked.

    Raises:
        SemslamError: a run holds the folder and something is to be written.
    """
    if not again and not drop:
        return _verify_shown(folder, console)
    with folder.locked():
        report = _verify_shown(folder, console)
        if again:
            compared, findings = rederive(folder, stages, workers, console)
            report = replace(report, rederived=compared, findings=(*report.findings, *findings))
        return replace(report, removed=drop_damaged(report)) if drop else report


def _verify_shown(folder: OutputFolder, console: Console) -> VerifyReport:
    with byte_bar(console, "hashing", stored_bytes(folder)) as seen:
        return verify(folder, seen)


def verify(folder: OutputFolder, seen: Callable[[int], None]) -> VerifyReport:
    """Hash everything stored; `seen` is told the bytes of every block."""
    folders = list(entry_folders(folder.cache))
    findings = [finding for path in folders for finding in _check_entry(path, seen)]
    findings += _check_records(folder)
    again = f"`semslam merge {folder.root}`, with the `--log` it was made with, if any,"
    findings += [Finding(str(path), what) for path, what in changed(folder.sites, seen, again)]
    files = sum(1 for path in (*folders, folder.sites) for _ in files_below(path))
    return VerifyReport(len(folders), files, 0, tuple(findings))


def stored_bytes(folder: OutputFolder) -> int:
    """Bytes that `verify` will read."""
    sites = 0
    with suppress(OSError):  # what cannot be read is said later
        sites = size_bytes(folder.sites) if folder.sites.is_dir() else 0
    return sites + sum(size_bytes(path) for path in entry_folders(folder.cache))


def drop_damaged(report: VerifyReport) -> int:
    """Remove the damaged entries, so that the next run makes them anew; returns how many there were."""
    entries = sorted({finding.entry for finding in report.findings if finding.entry is not None})
    for entry in entries:
        remove(entry)
    return len(entries)


def _check_entry(folder: Path, seen: Callable[[int], None]) -> Iterator[Finding]:
    manifest = load_manifest(folder)
    if manifest is None:
        yield Finding(str(folder / MANIFEST), "missing or damaged", folder)
        return
    if manifest["key"] != folder.name or key_of(manifest["components"]) != folder.name:
        yield Finding(str(folder / MANIFEST), "does not belong to the name of its folder", folder)
    yield from _check_files(folder, manifest, seen)
    yield from _check_shards(folder, manifest)


def _check_files(folder: Path, manifest: dict[str, Any], seen: Callable[[int], None]) -> Iterator[Finding]:
    """Every stored file against its digest, and none besides."""
    stored = {file["file"]: file for file in stored_files(manifest)}
    for name, file in stored.items():
        try:
            found = sha256_file(folder / name, seen)
        except OSError as error:
            yield Finding(str(folder / name), f"cannot be read: {error.strerror}", folder)
            continue
        if found != file["sha256"]:
            yield Finding(str(folder / name), "damaged: its content is not what was stored", folder)
    shards = {f"{shard_name(index)}/{SHARD}" for index in range(manifest["shards"])}
    known = {*stored, *shards, MANIFEST, TIMING}
    for path in files_below(folder):
        if str(path.relative_to(folder)) not in known:
            yield Finding(str(path), "nobody stored it here", folder)


def _check_shards(folder: Path, manifest: dict[str, Any]) -> Iterator[Finding]:
    """The chain of the shards, and that the manifest is what they add up to."""
    previous, shards = manifest["key"], []
    for index in range(manifest["shards"]):
        shard = load_shard(folder / shard_name(index), previous, hashed=False)
        if shard is None:
            yield Finding(str(folder / shard_name(index) / SHARD), "missing, damaged or out of order", folder)
            return
        shards.append(shard)
        previous = shard_digest(shard)
    told = build_manifest(
        manifest["stage"],
        manifest["stage_version"],
        manifest["variant"],
        manifest["components"],
        shards,
        manifest["provenance"],
    )
    if told != manifest:
        yield Finding(str(folder / MANIFEST), "does not add up to its shards", folder)


def _check_records(folder: OutputFolder) -> Iterator[Finding]:
    """Every result that a log refers to exists, and its copy under `results` is the same."""
    index = EntryIndex(folder.cache)
    for name, record in load_records(folder.logs).items():
        for task, one in record.tasks.items():
            stage, _, variant = task.partition("/")
            entry = index.find(stage, one.key) if one.key else None
            if one.key and entry is None:
                yield Finding(f"{name} {task}", "its result is gone or damaged; the next run makes it anew")
            elif entry is not None and (folder.results / name / variant).is_dir():
                yield from _check_results(folder, name, variant, entry)


def _check_results(folder: OutputFolder, log: str, variant: str, entry: Entry) -> Iterator[Finding]:
    place = folder.results / log / variant
    if published_key(folder, log, variant) != entry.key:
        return
    for name, file in result_names(load_manifest(folder.stage(entry.stage) / entry.key) or {}).items():
        path = place / name
        if not path.is_file():
            yield Finding(str(path), "missing; the next run copies it again")
        elif sha256_file(path) != file["sha256"]:
            yield Finding(str(path), "differs from the stored result; the next run copies it again")


# --- making results again


def rederive(
    folder: OutputFolder, stages: Sequence[Stage], workers: int | None, console: Console
) -> tuple[int, list[Finding]]:
    """Run every recorded task again into a temporary folder and compare digests; (results compared, findings)."""
    groups: dict[str, list[LogRecord]] = {}
    for record in load_records(folder.logs).values():
        until = _last_stage(stages, record)
        if until:
            groups.setdefault(canonical_json([record.config, until]), []).append(record)
    compared = 0
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory(prefix=f"{TEMPORARY}rederive-", dir=folder.root) as temporary:
        again = create_folder(Path(temporary) / "out")
        for records in groups.values():
            for result in _run_again(again, stages, records, workers, console):
                compared += 1
                findings += _compare(folder, result, {record.name: record for record in records})
    return compared, findings


def _last_stage(stages: Sequence[Stage], record: LogRecord) -> str:
    """Name of the last stage of which the log has a result; empty for none."""
    made = {task.split("/")[0] for task, one in record.tasks.items() if one.key}
    return next((stage.name for stage in reversed(stages) if stage.name in made), "")


def _run_again(
    again: OutputFolder, stages: Sequence[Stage], records: Sequence[LogRecord], workers: int | None, console: Console
) -> tuple[TaskResult, ...]:
    first = records[0]
    config = load_config(stages, stored=first.config)
    logs = [Log(record.name, tuple(map(Path, record.sources))) for record in records]
    report = run_logs(again, stages, _last_stage(stages, first), config, logs, workers, console)
    return report.results


def _compare(folder: OutputFolder, result: TaskResult, records: dict[str, LogRecord]) -> Iterator[Finding]:
    """What differs between the stored result and the one made again."""
    log, task = result.task.log.name, result.task.name
    record = records[log].tasks.get(task)
    place = f"{log} {task}"
    if record is None or not record.key:
        return
    stored = EntryIndex(folder.cache).find(result.task.stage.name, record.key)
    if result.entry is None:
        reason = result.failure.message if result.failure else result.decision
        yield Finding(place, f"cannot be made again: {reason}")
    elif stored is None:
        yield Finding(place, "its result is gone; there is nothing to compare with")
    elif result.key != record.key:
        said = "; ".join(changes(result.task.stage.name, record.components, result.components))
        yield Finding(place, f"cannot be compared, its inputs are others now: {said}")
    else:
        yield from _differences(place, stored, result.entry)


def _differences(place: str, stored: Entry, made: Entry) -> Iterator[Finding]:
    for what, old, new in (("table", stored.tables, made.tables), ("file", stored.files, made.files)):
        for name in sorted({*old, *new}):
            if old.get(name) != new.get(name):
                yield Finding(place, f"{what} `{name}` comes out differently when made again")
