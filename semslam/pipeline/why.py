"""Why a task ran, and what the next run would do about it."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semslam.errors import UsageError
from semslam.pipeline.cache import Entry, EntryIndex
from semslam.pipeline.config import Config
from semslam.pipeline.digest import DigestCache
from semslam.pipeline.discover import Log
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.plan import Planner, Task, stages_until, tasks_of
from semslam.pipeline.record import LogRecord, load_records
from semslam.stages.contract import Stage


@dataclass(frozen=True)
class Reason:
    """The last and the next decision about one task."""

    task: str
    last: str
    state: str
    next: str

    def as_json(self) -> dict[str, str]:
        """Plain values."""
        return dict(self.__dict__)

    def text(self) -> str:
        """For a terminal."""
        ended = f"   ({self.state})" if self.state else ""
        return f"{self.task}\n  last run   {self.last or 'never decided'}{ended}\n  next run   {self.next}"


def why(folder: OutputFolder, stages: Sequence[Stage], stage: str, record: LogRecord, config: Config) -> list[Reason]:
    """Reasons for every task of the stage (or for one, if `stage` names a variant: localize/paper)."""
    name, _, variant = stage.partition("/")
    if name not in {one.name for one in stages}:
        close = difflib.get_close_matches(name, [one.name for one in stages], n=1)
        known = ", ".join(f"`{one.name}`" for one in stages)
        raise UsageError(
            f"No stage is called `{name}`", hint=f"did you mean `{close[0]}`?" if close else f"stages: {known}"
        )
    decided = _next_decisions(folder, stages_until(stages, name), stages[-1].name, record, config)
    tasks = [task for task in decided if task.split("/")[0] == name and (not variant or task == stage)]
    if not tasks:
        raise UsageError(f"`{record.name}` has no task `{stage}`", hint=f"`semslam why {name} {record.name}`")
    return [_reason(record, task, decided[task]) for task in tasks]


def find_record(folder: OutputFolder, log: str) -> LogRecord:
    """The record of a log by its name, or by one of its files.

    Raises:
        UsageError: the folder has no such log.
    """
    records = load_records(folder.logs)
    if log in records:
        return records[log]
    for record in records.values():
        if os.path.abspath(log) in record.sources:
            return record
    close = difflib.get_close_matches(log, records, n=1)
    hint = f"did you mean `{close[0]}`?" if close else f"`semslam status {folder.root}` lists its logs"
    raise UsageError(f"`{folder.root}` has no log `{log}`", hint=hint)


def _reason(record: LogRecord, task: str, next_text: str) -> Reason:
    last = record.tasks.get(task)
    return Reason(task, last.decision if last else "", last.state if last else "", next_text)


def _next_decisions(
    folder: OutputFolder, stages: Sequence[Stage], published: str, record: LogRecord, config: Config
) -> Mapping[str, str]:
    """What a run would decide now, by task name, as far as that can be known before it."""
    index, digests = EntryIndex(folder.cache), DigestCache(folder.cache / "digests.json")
    planner = Planner(stages, config, folder.cache, index, digests, published)
    log = Log(record.name, tuple(Path(path) for path in record.sources))
    return dict(_decide_all(planner, tasks_of(stages, log, config), record))


def _decide_all(planner: Planner, tasks: Iterator[Task], record: LogRecord) -> Iterator[tuple[str, str]]:
    entries: dict[tuple[str, str], Entry] = {}
    to_run: dict[tuple[str, str], str] = {}
    for task in tasks:
        missing = next((need for need in planner.needs(task) if need in to_run), None)
        if missing is not None:
            to_run[task.stage.name, task.variant] = to_run[missing]
            yield task.name, f"known once {to_run[missing]}"
            continue
        decision = planner.decide(task, entries, record.tasks.get(task.name))
        if decision.entry is not None:
            entries[task.stage.name, task.variant] = decision.entry
        else:
            to_run[task.stage.name, task.variant] = f"{task.name} has run, which is: {decision.text}"
        yield task.name, decision.text


def as_json(log: str, reasons: Sequence[Reason]) -> dict[str, Any]:
    """Plain values."""
    return {"log": log, "tasks": [reason.as_json() for reason in reasons]}
