"""What a person sees of a run: bars on a terminal, plain lines in a pipe, and the same table at the end of both.

Everything goes to stderr; stdout belongs to data. Colour only on a terminal and not under NO_COLOR.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TextIO

from semslam.errors import SemslamError
from semslam.pipeline.plan import Task
from semslam.pipeline.runner import RunReport, TaskResult

if TYPE_CHECKING:
    from tqdm import tqdm

MAX_LINES = 20
"""Warnings and failures shown at the end; the rest is counted."""
REMARKED_LOGS = 3
"""Logs whose remarks are shown at the end."""
_LINE_PERIOD_S = 10.0
_COLOURS = {"red": "31", "yellow": "33", "green": "32", "bold": "1"}


class Console:
    """Writes messages for people."""

    def __init__(self, stream: TextIO | None = None, *, quiet: bool = False) -> None:
        self.stream = stream or sys.stderr
        self.quiet = quiet
        self.terminal = self.stream.isatty() and os.environ.get("TERM") != "dumb" and _columns(self.stream) > 0
        self._coloured = self.terminal and not os.environ.get("NO_COLOR")

    def colour(self, text: str, name: str) -> str:
        """The text in a colour, where colours are welcome."""
        return f"\033[{_COLOURS[name]}m{text}\033[0m" if self._coloured else text

    def say(self, text: str = "") -> None:
        """A line of information; not with --quiet."""
        if not self.quiet:
            self.line(text)

    def line(self, text: str) -> None:
        """A line that is always shown."""
        print(text, file=self.stream, flush=True)

    def warn(self, text: str) -> None:
        """A warning; always shown."""
        self.line(f"{self.colour('warning:', 'yellow')} {text}")

    def error(self, error: SemslamError) -> None:
        """An error as the user gets it."""
        self.line(f"{self.colour('error:', 'red')} {error.text()}")


def _columns(stream: TextIO) -> int:
    """Width of a terminal; 0 where it does not tell, as under some recorders, and bars would be invisible."""
    try:
        return os.get_terminal_size(stream.fileno()).columns
    except OSError:
        return 0


@dataclass
class StageCount:
    """One row of the status table."""

    tasks: int = 0
    running: int = 0
    states: Counter[str] = field(default_factory=Counter)
    rows: int = 0
    seconds: float = 0.0
    units: int = 0

    @property
    def pending(self) -> int:
        """Neither running nor settled; blocked tasks stay here."""
        settled = sum(number for state, number in self.states.items() if state != "blocked")
        return self.tasks - self.running - settled


class RunView:
    """Shows a run as it goes (`Listener`)."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stages: dict[str, StageCount] = {}
        self._units: dict[str, str] = {}
        self._progress: _Progress = _Bars(console) if console.terminal else _Lines(console)
        if console.quiet:
            self._progress = _Silence()
        self._running: set[str] = set()
        self._first: dict[str, int] = {}
        self._last: dict[str, int] = {}

    def planned(self, tasks: Sequence[Task]) -> None:
        """Count the tasks of every stage."""
        for task in tasks:
            self._stages.setdefault(task.stage.name, StageCount()).tasks += 1
            self._units[task.stage.name] = task.stage.unit
        self._progress.begin(len(tasks))

    def hashing(self, files: int, total_bytes: int) -> Callable[[int], None]:
        """Show how the reading of new logs goes, if it takes long enough to matter."""
        return self._progress.hashing(files, total_bytes)

    def started(self, task: Task, decision: str) -> None:
        """A task runs now."""
        self._stages[task.stage.name].running += 1
        self._running.add(_key(task))
        self._progress.started(_key(task), task, decision)

    def progressed(self, task: Task, done: int, total: int | None) -> None:
        """A task has come so far."""
        self._first.setdefault(_key(task), done)
        self._last[_key(task)] = done
        self._progress.progressed(_key(task), done, total)

    def settled(self, result: TaskResult) -> None:
        """A task is over."""
        stage, key = self._stages[result.task.stage.name], _key(result.task)
        stage.states[result.state] += 1
        stage.rows += sum(result.entry.rows.values()) if result.entry else 0
        if key in self._running:
            self._running.remove(key)
            stage.running -= 1
            stage.seconds += result.seconds
            stage.units += self._last.get(key, 0) - (self._first.get(key, 0) if result.resumed else 0)
        self._progress.settled(key, result)

    def reopened(self, result: TaskResult) -> None:
        """A settled task is to run again."""
        stage = self._stages[result.task.stage.name]
        stage.states[result.state] -= 1
        stage.rows -= sum(result.entry.rows.values()) if result.entry else 0
        self._progress.reopened(result)

    def withdrawn(self, task: Task) -> None:
        """A running task waits again."""
        self._running.remove(_key(task))
        self._stages[task.stage.name].running -= 1
        self._progress.withdrawn(_key(task), task)

    def tick(self) -> None:
        """Keep the display alive."""
        self._progress.tick()

    def close(self) -> None:
        """Clear the bars, whatever ended the run."""
        self._progress.close()

    def table(self) -> str:
        """The status table."""
        rows = [_stage_row(name, stage, self._units[name]) for name, stage in self._stages.items()]
        head = ["STAGE", "PENDING", "RUNNING", "CACHED", "DONE", "FAILED", "ROWS", "TIME", ""]
        return table([head, *rows], left=(0, 8))


def _key(task: Task) -> str:
    return f"{task.log.name}/{task.name}"


def _stage_row(name: str, stage: StageCount, unit: str) -> list[str]:
    rate = f"{stage.units / stage.seconds:,.1f} {unit}/s" if stage.units and stage.seconds else ""
    counts = [stage.pending, stage.running, stage.states["cached"], stage.states["done"], stage.states["failed"]]
    time_text = f"{stage.seconds:,.1f} s" if stage.seconds else "-"
    return [name, *map(str, counts), f"{stage.rows:,}" if stage.rows else "-", time_text, rate]


def table(rows: Sequence[Sequence[str]], left: Iterable[int] = (0,)) -> str:
    """Rows as aligned columns; those in `left` flush left, the others right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    aligned = set(left)
    lines = (
        "  ".join(
            cell.ljust(width) if column in aligned else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


@contextmanager
def byte_bar(console: Console, name: str, total_bytes: int) -> Iterator[Callable[[int], None]]:
    """A bar over bytes on a terminal, nothing elsewhere; call what it gives with the bytes of every block."""
    if not console.terminal or console.quiet:
        yield lambda _: None
        return
    bar = _bar(console, name, "B", total_bytes, unit_scale=True)

    def seen(number: int) -> None:
        bar.update(number)

    try:
        yield seen
    finally:
        bar.close()


def bytes_text(number: int) -> str:
    """Bytes for people: 12 B, 3.4 kB, 5.6 MB, 7.8 GB."""
    size = float(number)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def say_end(console: Console, report: RunReport, out: str, places: Sequence[str], stale: Sequence[str]) -> None:
    """The last lines of a run: how input was understood, warnings, failures, and where the results lie.

    `stale` are folders with older results.
    """
    new = [r for r in report.results if r.state == "done"]
    _say_remarks(console, new)
    warnings = _grouped([(r.task, text) for r in new if r.entry for text in r.entry.warnings])
    for text in warnings[:MAX_LINES]:
        console.warn(text)
    hidden = max(0, len(warnings) - MAX_LINES)
    old = sum(len(r.entry.warnings) for r in report.results if r.state == "cached" and r.entry)
    if hidden or old:
        counts = [f"{hidden} more"] * bool(hidden) + [f"{old} of results made before"] * bool(old)
        console.say(f"warnings: {' and '.join(counts)}; `semslam status {out}` lists them")
    _say_failures(console, report.failures, out)
    for text in stale[:MAX_LINES]:
        console.warn(f"`{text}` still holds the result of an earlier run")
    if places:
        console.say(f"results: {places[0]}" + (f" and {len(places) - 1} more" if len(places) > 1 else ""))


def _say_remarks(console: Console, new: Sequence[TaskResult]) -> None:
    """How the input of the first few logs was understood."""
    with_remarks = [result for result in new if result.entry and result.entry.remarks]
    logs = list(dict.fromkeys(result.task.log.name for result in with_remarks))
    shown = [result for result in with_remarks if result.task.log.name in logs[:REMARKED_LOGS]]
    for text in _grouped([(r.task, text) for r in shown if r.entry for text in r.entry.remarks])[:MAX_LINES]:
        console.say(f"note: {text}")
    if len(logs) > REMARKED_LOGS:
        console.say(f"note: and those of {len(logs) - REMARKED_LOGS} more logs; `--json` lists them")


def _grouped(said: Sequence[tuple[Task, str]]) -> list[str]:
    """Each sentence once, with the task that said it first and how many others did."""
    places: dict[str, list[str]] = {}
    for task, text in said:
        places.setdefault(text, []).append(f"`{task.log.name}` {task.name}")
    counts = {text: f" and {len(who) - 1} more" if len(who) > 1 else "" for text, who in places.items()}
    return [f"{who[0]}{counts[text]}: {text}" for text, who in places.items()]


def _say_failures(console: Console, failures: Sequence[TaskResult], out: str) -> None:
    for result in failures[:MAX_LINES]:
        failure = result.failure
        if failure is not None:
            title = f"{result.task.name} of `{result.task.log.name}` failed: {failure.message}"
            console.error(SemslamError(title, hint=failure.hint, details=failure.details))
    if len(failures) > MAX_LINES:
        console.line(f"{len(failures) - MAX_LINES} more failures: see `semslam status {out}`")


class _Progress:
    """What the ways to show progress have in common: each does as much of this as it can show."""

    def begin(self, tasks: int) -> None:
        """So many tasks there are."""

    def hashing(self, files: int, total_bytes: int) -> Callable[[int], None]:  # noqa: ARG002
        """New logs are read for their digests."""
        return lambda _: None

    def started(self, key: str, task: Task, decision: str) -> None:
        """A task runs."""

    def progressed(self, key: str, done: int, total: int | None) -> None:
        """It has come so far."""

    def settled(self, key: str, result: TaskResult) -> None:
        """It is over."""

    def reopened(self, result: TaskResult) -> None:
        """What is stored of it is damaged; it is to run again."""

    def withdrawn(self, key: str, task: Task) -> None:
        """It stopped, to wait for an input that is made again."""

    def tick(self) -> None:
        """Some time has passed."""

    def close(self) -> None:
        """The run is over."""


class _Silence(_Progress):
    """Shows nothing."""


class _Lines(_Progress):
    """A line when a task ends, and every ten seconds one about what is running."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._running: dict[str, tuple[Task, float, int | None, int, int | None]] = {}
        self._said = time.monotonic()

    def hashing(self, files: int, total_bytes: int) -> Callable[[int], None]:
        """Say once that it happens."""
        self._console.say(f"reading {files} new log {'file' if files == 1 else 'files'}, {bytes_text(total_bytes)}")
        return lambda _: None

    def started(self, key: str, task: Task, decision: str) -> None:
        """Say what runs and why."""
        self._running[key] = (task, time.monotonic(), None, 0, None)
        self._console.say(f"{task.log.name} {task.name}: {decision}")

    def progressed(self, key: str, done: int, total: int | None) -> None:
        """Remember how far it is."""
        task, start, first, _, _ = self._running[key]
        self._running[key] = (task, start, done if first is None else first, done, total)

    def settled(self, key: str, result: TaskResult) -> None:
        """Say how it ended; what is cached or blocked shows in the table."""
        self._running.pop(key, None)
        name = f"{result.task.log.name} {result.task.name}"
        if result.state == "done" and result.entry:
            rows = sum(result.entry.rows.values())
            self._console.say(f"{name}: done, {rows:,} rows in {result.seconds:.1f} s")
        elif result.state == "failed":
            self._console.say(f"{name}: failed")

    def reopened(self, result: TaskResult) -> None:
        """Say so."""
        self._console.say(f"{result.task.log.name} {result.task.name}: stored result damaged, dropped")

    def withdrawn(self, key: str, task: Task) -> None:  # noqa: ARG002
        """It is not running now."""
        self._running.pop(key, None)

    def tick(self) -> None:
        """Every ten seconds, say how far everything is."""
        now = time.monotonic()
        if now - self._said < _LINE_PERIOD_S:
            return
        self._said = now
        for task, start, first, done, total in self._running.values():
            if first is not None:
                self._console.say(f"{task.log.name} {task.name}: {_pace(task.stage.unit, start, first, done, total)}")


def _pace(unit: str, start: float, first: int, done: int, total: int | None) -> str:
    """How far, how fast, and how long still."""
    rate = (done - first) / max(time.monotonic() - start, 1e-3)
    text = f"{done:,}/{total:,} {unit}" if total else f"{done:,} {unit}"
    left = f", {(total - done) / rate:.0f} s left" if total and rate > 0 else ""
    return f"{text}, {rate:.1f} {unit}/s{left}" if rate > 0 else text


class _Bars(_Progress):
    """One bar for the whole run and one for every running task."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._tasks = 0
        self._settled = 0
        self._whole: tqdm[Any] | None = None
        self._bars: dict[str, tqdm[Any]] = {}
        self._hashing = ExitStack()

    def begin(self, tasks: int) -> None:
        """The bar of the run appears with the first task that really runs."""
        self._tasks = tasks

    def hashing(self, files: int, total_bytes: int) -> Callable[[int], None]:
        """A bar in bytes."""
        name = f"reading {files} new log {'file' if files == 1 else 'files'}"
        return self._hashing.enter_context(byte_bar(self._console, name, total_bytes))

    def started(self, key: str, task: Task, decision: str) -> None:  # noqa: ARG002
        """A new bar below the others."""
        self._hashing.close()
        if self._whole is None:
            self._whole = _bar(self._console, "all tasks", "task", self._tasks)
            self._whole.update(self._settled)
        self._bars[key] = _bar(self._console, f"{task.log.name} {task.name}", task.stage.unit, None)

    def progressed(self, key: str, done: int, total: int | None) -> None:
        """Move its bar; what a resumed task had already does not count for the rate."""
        bar = self._bars[key]
        if bar.n == 0 and bar.initial == 0:
            bar.initial = bar.n = done
        if total is not None and bar.total != total:
            bar.total = total
        bar.update(done - bar.n)

    def settled(self, key: str, result: TaskResult) -> None:
        """Take its bar away."""
        self._settled += 1
        if (bar := self._bars.pop(key, None)) is not None:
            bar.close()
        if self._whole is not None:
            self._whole.update(1)
        if result.state == "failed":
            self.tick()

    def reopened(self, result: TaskResult) -> None:  # noqa: ARG002
        """One less is done."""
        self._settled -= 1
        if self._whole is not None:
            self._whole.update(-1)

    def withdrawn(self, key: str, task: Task) -> None:  # noqa: ARG002
        """Take its bar away; it comes back when it starts again."""
        if (bar := self._bars.pop(key, None)) is not None:
            bar.close()

    def tick(self) -> None:
        """Redraw, so that the time goes on even where nothing else does."""
        for bar in self._bars.values():
            bar.refresh()

    def close(self) -> None:
        """Take all bars away."""
        self._hashing.close()
        for bar in (*self._bars.values(), self._whole):
            if bar is not None:
                bar.close()


def _bar(console: Console, name: str, unit: str, total: int | None, *, unit_scale: bool = False) -> tqdm[Any]:
    """A bar that vanishes when closed."""
    from tqdm import tqdm  # only a run with something to do pays for the import

    return tqdm(
        desc=name,
        unit=unit if unit_scale else f" {unit}",
        total=total,
        unit_scale=unit_scale,
        leave=False,
        file=console.stream,
        dynamic_ncols=True,
        colour=None,
    )
