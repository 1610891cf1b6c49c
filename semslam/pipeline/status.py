"""What an output folder holds: every log with the state of its tasks, its warnings and failures. Changes nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from semslam.pipeline.cache import Entry, EntryIndex, unfinished
from semslam.pipeline.console import MAX_LINES, bytes_text, table
from semslam.pipeline.failure import Failure
from semslam.pipeline.files import size_bytes
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.record import TaskRecord, load_records
from semslam.stages.contract import Stage


@dataclass(frozen=True)
class TaskStatus:
    """One task: done, failed, blocked, running, interrupted, or gone (its result was removed)."""

    log: str
    task: str
    state: str
    decision: str
    key: str
    entry: Entry | None
    failure: Failure | None

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "log": self.log,
            "task": self.task,
            "state": self.state,
            "decision": self.decision,
            "key": self.key,
            "rows": dict(self.entry.rows) if self.entry else {},
            "counters": dict(self.entry.counters) if self.entry else {},
            "warnings": list(self.entry.warnings) if self.entry else [],
            "failure": self.failure.as_json() if self.failure else None,
        }


@dataclass(frozen=True)
class Status:
    """Everything `status` shows."""

    out: str
    stages: tuple[str, ...]
    tasks: tuple[TaskStatus, ...]
    cache_bytes: int
    unfinished: int

    @property
    def logs(self) -> tuple[str, ...]:
        """Names of the logs, sorted."""
        return tuple(dict.fromkeys(task.log for task in self.tasks))

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "format": "semslam-status",
            "version": 1,
            "out": self.out,
            "tasks": [task.as_json() for task in self.tasks],
            "cache_bytes": self.cache_bytes,
            "unfinished": self.unfinished,
        }

    def text(self) -> str:
        """For a terminal."""
        if not self.tasks:
            return f"{self.out} holds no logs yet"
        rows = [["LOG", *self.stages, "ROWS", "WARNINGS"], *(self._row(log) for log in self.logs)]
        lines = [table(rows, left=range(len(self.stages) + 1)), "", *self._messages(), self._last_line()]
        return "\n".join(lines)

    def _row(self, log: str) -> list[str]:
        own = [task for task in self.tasks if task.log == log]
        cells = [_cell([task for task in own if task.task.split("/")[0] == stage]) for stage in self.stages]
        entries = [task.entry for task in own if task.entry]
        rows = sum(sum(entry.rows.values()) for entry in entries)
        warnings = sum(len(entry.warnings) for entry in entries)
        return [log, *cells, f"{rows:,}", str(warnings) if warnings else "-"]

    def _messages(self) -> Iterator[str]:
        """Failures, then warnings, bounded."""
        failures = [f"failed: {t.task} of `{t.log}`: {t.failure.message}" for t in self.tasks if t.failure]
        warnings = [f"warning: `{t.log}` {t.task}: {w}" for t in self.tasks if t.entry for w in t.entry.warnings]
        for lines in (failures, warnings):
            yield from lines[:MAX_LINES]
            if len(lines) > MAX_LINES:
                yield f"{len(lines) - MAX_LINES} more: see `semslam status {self.out} --json`"

    def _last_line(self) -> str:
        count = f"{len(self.logs)} {'log' if len(self.logs) == 1 else 'logs'}"
        line = f"{count}, cache {bytes_text(self.cache_bytes)}"
        return line + (f", {self.unfinished} unfinished" if self.unfinished else "")


def status(folder: OutputFolder, stages: Sequence[Stage]) -> Status:
    """Look at the folder."""
    index, busy = EntryIndex(folder.cache), folder.busy()
    tasks = [
        _task_status(index, busy, name, task, record.tasks[task])
        for name, record in load_records(folder.logs).items()
        for task in sorted(record.tasks, key=lambda task: _place(stages, task))
    ]
    return Status(
        out=str(folder.root),
        stages=tuple(stage.name for stage in stages),
        tasks=tuple(tasks),
        cache_bytes=size_bytes(folder.cache),
        unfinished=sum(1 for _ in unfinished(folder.cache)),
    )


def _place(stages: Sequence[Stage], task: str) -> tuple[int, str]:
    names = [stage.name for stage in stages]
    stage = task.split("/")[0]
    return (names.index(stage) if stage in names else len(names), task)


def _task_status(index: EntryIndex, busy: bool, log: str, task: str, record: TaskRecord) -> TaskStatus:
    stage = task.split("/")[0]
    entry = index.find(stage, record.key) if record.key else None
    state = record.state
    if state in ("done", "cached"):
        state = "done" if entry else "gone"
    elif state == "running" and not busy:
        state = "interrupted"
    shown = entry if state == "done" else None
    return TaskStatus(log, task, state or "pending", record.decision, record.key, shown, record.failure)


def _cell(tasks: Sequence[TaskStatus]) -> str:
    """The tasks of one stage of one log in a word or two."""
    states = [task.state for task in tasks]
    if len(states) <= 1:
        return states[0] if states else "-"
    worst = next((s for s in ("failed", "blocked", "gone", "interrupted", "running", "pending") if s in states), "")
    return f"{states.count('done')}/{len(states)} done" + (f", {states.count(worst)} {worst}" if worst else "")
