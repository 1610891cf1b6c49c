"""`logs/<log>.json`: what became of a log, task by task, for `status`, `why`, `evaluate`, `verify` and `clean`.

A record only explains and refers; whether a result exists is decided by the cache alone.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semslam.pipeline.failure import Failure
from semslam.pipeline.files import read_json, write_json, write_text

RECORD_VERSION = 1


def task_name(stage: str, variant: str) -> str:
    """Name of a task within its log: the stage, and the variant if there are several."""
    return f"{stage}/{variant}" if variant else stage


@dataclass
class TaskRecord:
    """What is known of one task.

    Attributes:
        key: key of the result the log has now; empty before the first.
        components: what that key was made from, to explain the next change.
        decision: what the last run decided, in words.
        state: done, cached, failed, blocked (an earlier stage failed) or interrupted.
        failure: why it failed, with the key it had, or None.
    """

    key: str = ""
    components: Mapping[str, Any] = field(default_factory=dict)
    decision: str = ""
    state: str = ""
    failure: Failure | None = None
    failed_key: str = ""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        value: dict[str, Any] = {
            "key": self.key,
            "components": self.components,
            "decision": self.decision,
            "state": self.state,
        }
        if self.failure is not None:
            value["failure"] = {**self.failure.as_json(), "key": self.failed_key}
        return value

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> TaskRecord:
        """The record as `as_json` gave it."""
        failure = value.get("failure")
        return cls(
            value["key"],
            value["components"],
            value["decision"],
            value["state"],
            Failure.from_json(failure) if failure else None,
            failure["key"] if failure else "",
        )


@dataclass
class LogRecord:
    """A log in an output folder.

    Attributes:
        sources: absolute paths of its files in recording order.
        config: configuration of its last run, by stage name.
        tasks: by task name (`task_name`).
    """

    name: str
    sources: list[str] = field(default_factory=list)
    config: Mapping[str, Any] = field(default_factory=dict)
    tasks: dict[str, TaskRecord] = field(default_factory=dict)

    def task(self, stage: str, variant: str) -> TaskRecord:
        """The record of a task, a new one if there is none."""
        return self.tasks.setdefault(task_name(stage, variant), TaskRecord())

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "version": RECORD_VERSION,
            "log": self.name,
            "sources": self.sources,
            "config": self.config,
            "tasks": {name: task.as_json() for name, task in self.tasks.items()},
        }


def load_record(folder: Path, name: str) -> LogRecord | None:
    """The record of a log; None if there is none that can be read."""
    value = read_json(folder / f"{name}.json")
    if not isinstance(value, dict) or value.get("version") != RECORD_VERSION:
        return None
    try:
        tasks = {task: TaskRecord.from_json(content) for task, content in value["tasks"].items()}
        return LogRecord(value["log"], list(value["sources"]), value["config"], tasks)
    except (KeyError, TypeError, AttributeError):
        return None


def load_records(folder: Path) -> dict[str, LogRecord]:
    """All records of an output folder by name, sorted."""
    names = sorted(name[:-5] for name in os.listdir(folder) if name.endswith(".json") and not name.startswith("."))
    records = ((name, load_record(folder, name)) for name in names)
    return {name: record for name, record in records if record is not None}


class RecordBook:
    """The records of a run; each is written when it differs from what lies on the disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.records = load_records(folder)
        self._stored = {name: record.as_json() for name, record in self.records.items()}

    def of(self, log: str) -> LogRecord:
        """The record of a log, a new one if there is none."""
        return self.records.setdefault(log, LogRecord(log))

    def save(self, log: str) -> None:
        """Write the record of a log if it changed."""
        value = self.of(log).as_json()
        if self._stored.get(log) != value:
            write_json(self._folder / f"{log}.json", value)
            self._stored[log] = _detached(value)

    def write_traceback(self, log: str, stage: str, variant: str, text: str) -> Path:
        """Keep the traceback of an unexpected error in a file of its own."""
        name = ".".join(part for part in (log, stage, variant, "traceback.txt") if part)
        write_text(self._folder / name, text)
        return self._folder / name


def _detached(value: dict[str, Any]) -> dict[str, Any]:
    """A copy that later changes of the record do not reach; components are replaced, never changed."""
    return {**value, "sources": list(value["sources"]), "tasks": {n: dict(t) for n, t in value["tasks"].items()}}
