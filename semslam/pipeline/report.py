"""The outcome of a run as one JSON object, for machines (`--json`)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from semslam.pipeline.discover import Problem
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.runner import RunReport, TaskResult

REPORT_FORMAT = "semslam-run"
REPORT_VERSION = 1


@dataclass(frozen=True)
class RunOutcome:
    """A finished run; `problems` are files that could not even be opened, `warnings` name parts that seem to miss."""

    folder: OutputFolder
    report: RunReport
    problems: tuple[Problem, ...]
    warnings: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """1 if anything failed, else 0."""
        return 1 if self.report.failures or self.problems else 0

    def as_json(self) -> dict[str, Any]:
        """Tasks with decisions, digests, warnings and failures."""
        logs: dict[str, dict[str, Any]] = {}
        for result in self.report.results:
            log = result.task.log
            place = logs.setdefault(log.name, {"log": log.name, "sources": [str(s) for s in log.sources], "tasks": []})
            place["tasks"].append(task_json(result))
        return {
            "format": REPORT_FORMAT,
            "version": REPORT_VERSION,
            "out": str(self.folder.root),
            "results": str(self.folder.results),
            "counts": dict(sorted(Counter(result.state for result in self.report.results).items())),
            "seconds": round(self.report.seconds, 3),
            "logs": list(logs.values()),
            "unreadable": [{"path": str(problem.path), "reason": problem.reason} for problem in self.problems],
            "warnings": list(self.warnings),
            "exit_code": self.exit_code,
        }


def task_json(result: TaskResult) -> dict[str, Any]:
    """One task."""
    entry = result.entry
    return {
        "stage": result.task.stage.name,
        "variant": result.task.variant,
        "state": result.state,
        "decision": result.decision,
        "key": result.key,
        "tables": dict(entry.tables) if entry else {},
        "rows": dict(entry.rows) if entry else {},
        "files": dict(entry.files) if entry else {},
        "counters": dict(entry.counters) if entry else {},
        "remarks": list(entry.remarks) if entry else [],
        "warnings": list(entry.warnings) if entry else [],
        "failure": result.failure.as_json() if result.failure else None,
        "seconds": round(result.seconds, 3),
        "max_rss_bytes": result.max_rss_bytes,
        "resumed_shards": result.resumed,
    }
