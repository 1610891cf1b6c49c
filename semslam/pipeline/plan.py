"""From logs and configuration to tasks, their keys, and what to do about each.

A task is a stage of a log, in a variant where the stage or one before it has variants. Its key is made of all that its
result depends on: stage, version, variant, own configuration with the content of files in place of their paths, the
versions of the libraries it computes with, the execution provider of its networks, the digests of the *tables* it
reads, the digests of the log's files where it reads those, and the version of the tables.
Since keys chain by digests of results, a task can be decided only when those before it are finished, and a stage
that runs again with the same result stops the wave.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError, UsageError
from semslam.models.onnxfile import read_onnx
from semslam.pipeline.cache import Entry, EntryIndex, finished_shards, key_of
from semslam.pipeline.config import Config, file_settings, plain
from semslam.pipeline.digest import DigestCache, sha256_text
from semslam.pipeline.discover import Log
from semslam.pipeline.files import canonical_json
from semslam.pipeline.record import TaskRecord, task_name
from semslam.stages.contract import Stage

ABSENT = "absent"
"""Stands in a key for the digest of an optional table that the log does not have, or for a library's version."""
PROVIDER = "SEMSLAM_PROVIDER"
"""Environment variable that names the execution provider of networks; `auto` in a key where it is not set."""


@dataclass(frozen=True)
class Task:
    """A stage of a log, in one variant (empty for none)."""

    log: Log
    stage: Stage
    variant: str

    @property
    def name(self) -> str:
        """Name within the log, such as `localize/paper`."""
        return task_name(self.stage.name, self.variant)


@dataclass(frozen=True)
class Decision:
    """What to do about a task.

    Attributes:
        entry: the result if it is in the cache already, else None.
        text: the decision in words, as `why` prints it.
    """

    key: str
    components: Mapping[str, Any]
    entry: Entry | None
    text: str


def stages_until(stages: Sequence[Stage], last: str) -> tuple[Stage, ...]:
    """The stage named `last` and all it needs, in order."""
    needed = {last}
    for stage in reversed(stages):
        if stage.name in needed:
            needed |= {table.stage for table in stage.reads}
    return tuple(stage for stage in stages if stage.name in needed)


def variants_of(stages: Sequence[Stage], stage: Stage, config: Config) -> tuple[str, ...]:
    """Variants in which a stage runs: its own, else those of the stages before it."""
    if stage.variants:
        return config.variants(stage)
    by_name = {one.name: one for one in stages}
    before = {variants_of(stages, by_name[table.stage], config) for table in stage.reads}
    return max(before, key=lambda names: (names != ("",), names), default=("",))


def tasks_of(stages: Sequence[Stage], log: Log, config: Config) -> Iterator[Task]:
    """All tasks of a log, in an order in which each comes after those it needs."""
    for stage in stages:
        for variant in variants_of(stages, stage, config):
            yield Task(log, stage, variant)


class Planner:
    """Keys and decisions for the tasks of a run.

    Args:
        published: name of the stage that makes the files for people. They carry the log's name, so it is part of the
            stage's keys; logs of equal content share the results of all other stages.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        config: Config,
        cache: Path,
        index: EntryIndex,
        digests: DigestCache,
        published: str,
    ) -> None:
        self._stages = {stage.name: stage for stage in stages}
        self._order = tuple(stages)
        self._config = config
        self._cache = cache
        self._index = index
        self._digests = digests
        self._published = published
        self._settings: dict[tuple[str, str], dict[str, Any]] = {}
        self._needs: dict[tuple[str, str], tuple[tuple[str, str], ...]] = {}

    def needs(self, task: Task) -> tuple[tuple[str, str], ...]:
        """(stage, variant) of the tasks of the same log that this one reads from."""
        place = (task.stage.name, task.variant)
        if place not in self._needs:
            names = dict.fromkeys(table.stage for table in task.stage.reads)
            self._needs[place] = tuple((name, self._variant_before(name, task.variant)) for name in names)
        return self._needs[place]

    def _variant_before(self, stage: str, variant: str) -> str:
        """Variant of an earlier stage that a task of `variant` reads."""
        return variant if variant in variants_of(self._order, self._stages[stage], self._config) else ""

    def task_config(self, task: Task) -> Any:
        """The configuration a task runs with."""
        return self._config.for_variant(task.stage, task.variant)

    def input_files(self, task: Task) -> list[Path]:
        """Files outside the cache that the task depends on: the log's, if it reads the log, and those of settings."""
        own = [Path(path) for _, path in file_settings(self.task_config(task), task.stage.name)]
        beside = [extra for path in own for extra in external_data(path)]
        return [*(task.log.sources if task.stage.from_log else ()), *own, *beside]

    def check_settings(self, tasks: Iterable[Task]) -> None:
        """Read the files named in the configuration, once for all logs.

        Raises:
            UsageError: one cannot be read.
        """
        for task in tasks:
            self._settings_of(task)

    def components(self, task: Task, before: Mapping[tuple[str, str], Entry]) -> dict[str, Any]:
        """All that the result of the task depends on; `before` holds the entries of `needs`.

        Raises:
            UsageError: a file named in the configuration cannot be read.
            SemslamError: a file of the log cannot be read.
        """
        stage = task.stage
        value = {**self.standing(task), "inputs": self._input_digests(task, before)}
        if stage.name == self._published:
            value["log"] = task.log.name
        if stage.from_log:
            value["sources"] = [self._source_digest(path) for path in task.log.sources]
        return value

    def standing(self, task: Task) -> dict[str, Any]:
        """The components that are the same for all logs.

        Raises:
            UsageError: a file named in the configuration cannot be read.
        """
        stage = task.stage
        value: dict[str, Any] = {
            "stage": stage.name,
            "version": stage.version,
            "variant": task.variant,
            "config": self._settings_of(task),
            "spec": _versions(stage),
            "libraries": {name: library_version(name) for name in stage.libraries},
        }
        if any(path.lower().endswith(".onnx") for _, path in file_settings(self.task_config(task), stage.name)):
            value["provider"] = os.environ.get(PROVIDER) or "auto"
        return value

    def _input_digests(self, task: Task, before: Mapping[tuple[str, str], Entry]) -> dict[str, str]:
        """Digest of every table the task reads."""
        variants = dict(self.needs(task))
        return {
            table.name: before[table.stage, variants[table.stage]].tables.get(table.name, ABSENT)
            for table in task.stage.reads
        }

    def decide(self, task: Task, before: Mapping[tuple[str, str], Entry], record: TaskRecord | None) -> Decision:
        """Whether the task has a result, and if not, why it has to run."""
        components = self.components(task, before)
        key = key_of(components)
        entry = self._index.find(task.stage.name, key)
        text = "cached" if entry else self._reason(task.stage.name, key, components, record or TaskRecord())
        return Decision(key, components, entry, text)

    def _reason(self, stage: str, key: str, components: Mapping[str, Any], record: TaskRecord) -> str:
        shards = finished_shards(self._cache, stage, key)
        if record.failure is not None and record.failed_key == key:
            return f"try again (failed before: {record.failure.message})"
        if shards:
            return f"resume ({shards} {'shard' if shards == 1 else 'shards'})"
        if not record.key:
            return "run (new)"
        if record.key == key:
            return "run (its result is gone or damaged)"
        return "stale: " + "; ".join(changes(stage, record.components, components))

    def _settings_of(self, task: Task) -> dict[str, Any]:
        """The configuration of a task as it goes into the key; the same for all logs."""
        place = (task.stage.name, task.variant)
        if place not in self._settings:
            self._settings[place] = self._keyed(self.task_config(task), task.stage.name, task.variant)
        return self._settings[place]

    def _keyed(self, section: Any, prefix: str, variant: str = "") -> dict[str, Any]:
        """Plain values of a section; files by their content, and nothing of what other variants alone look at."""
        values: dict[str, Any] = {}
        for item in fields(section):
            if variant not in item.metadata.get("variants", (variant,)):
                continue
            value, key = getattr(section, item.name), f"{prefix}.{item.name}"
            if is_dataclass(value):
                values[item.name] = self._keyed(value, key)
            elif item.metadata.get("file") and value:
                values[item.name] = self._file_digest(key, Path(value))
            else:
                values[item.name] = plain(value)
        return values

    def _file_digest(self, key: str, path: Path) -> str:
        """Content of a file named in the configuration, with that of data files that an ONNX model keeps beside it."""
        try:
            digests = [self._digests.digest(one) for one in (path, *external_data(path))]
        except OSError as error:
            raise UsageError(
                f"`{key}` names `{path}`, which cannot be read: {error.strerror}",
                hint=f"check the path, or set it with `--set {key}=FILE`",
            ) from None
        return "sha256:" + (digests[0] if len(digests) == 1 else sha256_text(canonical_json(digests)))

    def _source_digest(self, path: Path) -> str:
        try:
            return self._digests.digest(path)
        except OSError as error:
            raise SemslamError(
                f"`{path}` cannot be read: {error.strerror}", hint="check that the file is there and readable"
            ) from None


def external_data(path: Path) -> tuple[Path, ...]:
    """Files in which an ONNX model says that it keeps its weights; none for what is no readable ONNX model.

    Why a model cannot be read is for those to say who open it.
    """
    try:
        found = os.stat(path)
    except OSError:
        return ()
    return _external_data(path, found.st_size, found.st_mtime_ns)


@cache
def _external_data(path: Path, size: int, mtime_nanos: int) -> tuple[Path, ...]:  # noqa: ARG001
    try:
        return read_onnx(path).external_files
    except (SemslamError, OSError):
        return ()


@cache
def library_version(name: str) -> str:
    """Version of an installed distribution as `major.minor`; its later parts are taken not to change results."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return ".".join(version(name).split(".")[:2])
    except PackageNotFoundError:
        return ABSENT


def changes(stage: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """What differs between the components of two keys, in words; never empty for different keys."""
    found = list(_config_changes(stage, old.get("config", {}), new["config"]))
    before = old.get("inputs", {})
    tables = [name for name, digest in new["inputs"].items() if before.get(name) != digest]
    if tables:
        found.append(f"input {', '.join(tables)} changed")
    if old.get("sources") != new.get("sources"):
        found.append("log files changed")
    if old.get("log") != new.get("log"):
        found.append(f"log renamed from `{old.get('log')}`")
    if old.get("version") != new["version"]:
        found.append(f"stage version {old.get('version')} -> {new['version']}")
    if old.get("spec") != new["spec"]:
        found.append(f"table versions {old.get('spec')} -> {new['spec']}")
    found += _library_changes(old.get("libraries", {}), new.get("libraries", {}))
    if old.get("provider") != new.get("provider"):
        found.append(f"provider {_shown(old.get('provider'))} -> {_shown(new.get('provider'))}")
    return found or ["stored under another key"]


def _library_changes(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    names = sorted(name for name in {*old, *new} if old.get(name) != new.get(name))
    return [f"{name} {_shown(old.get(name))} -> {_shown(new.get(name))}" for name in names]


def _config_changes(prefix: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for name in sorted({*old, *new}):
        before, after, key = old.get(name), new.get(name), f"{prefix}.{name}"
        if before == after:
            continue
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            yield from _config_changes(key, before, after)
        elif str(before).startswith("sha256:") and str(after).startswith("sha256:"):
            yield f"{key} has another content"
        else:
            yield f"{key} {_shown(before)} -> {_shown(after)}"


def _shown(value: Any) -> str:
    if value is None:
        return "(none)"
    if isinstance(value, str):
        return f"content {value[7:15]}" if value.startswith("sha256:") else value or '""'
    return canonical_json(value)


def _versions(stage: Stage) -> int | dict[str, int]:
    """Versions of the tables that a stage reads and writes; 1 if all are first ones."""
    versions = {table.name: table.version for table in (*stage.reads, *stage.writes)}
    return 1 if set(versions.values()) <= {1} else versions
