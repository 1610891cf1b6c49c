"""A run: decide every task, hand out what has to run, keep what came of it.

The loop is driven by one thread. Tasks are decided as soon as those before them are settled; tasks of different logs
that turn out to be the same work (equal keys) run once. One failed task blocks those that need it and nothing else; it
is tried again by every run, because a cause outside the key (memory, a missing library) may be gone.

A task that finds a stored input damaged is no failure yet: the damaged entry is dropped, made again, and the task tried
once more.
"""

from __future__ import annotations

import contextlib
import heapq
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, Protocol

from semslam.errors import SemslamError, UsageError
from semslam.pipeline.cache import DamagedEntryError, Entry, EntryIndex, table_files
from semslam.pipeline.config import Config
from semslam.pipeline.digest import DigestCache
from semslam.pipeline.discover import Log
from semslam.pipeline.executors import Executor
from semslam.pipeline.failure import Failure
from semslam.pipeline.files import out_of_space, read_json, remove, write_json
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.job import InputFile, Job, Outcome
from semslam.pipeline.plan import Decision, Planner, Task, tasks_of
from semslam.pipeline.preflight import check_new
from semslam.pipeline.record import RecordBook
from semslam.pipeline.results import Results
from semslam.stages.contract import Stage

_TICK_S = 0.2


@dataclass(frozen=True)
class TaskResult:
    """How a task came out.

    Attributes:
        state: cached, done, failed, or blocked by the failure of an earlier stage.
        decision: what was decided about it, in words.
        components: what `key` was made from; empty if it could not be made.
        entry: its result; None if it has none.
        seconds: time it took in this run.
        resumed: shards that an earlier run had finished.
    """

    task: Task
    state: str
    decision: str
    key: str = ""
    components: Mapping[str, Any] = field(default_factory=dict)
    entry: Entry | None = None
    failure: Failure | None = None
    seconds: float = 0.0
    max_rss_bytes: int = 0
    resumed: int = 0


@dataclass(frozen=True)
class RunReport:
    """All tasks of a run, in the order of logs and stages."""

    results: tuple[TaskResult, ...]
    seconds: float

    @property
    def failures(self) -> tuple[TaskResult, ...]:
        """The failed tasks; blocked ones are not among them."""
        return tuple(result for result in self.results if result.state == "failed")


class Listener(Protocol):
    """Who watches a run."""

    def planned(self, tasks: Sequence[Task]) -> None:
        """All tasks of the run are known."""

    def hashing(self, files: int, total_bytes: int) -> Callable[[int], None]:
        """Files are about to be read for their digests; the result is called with the bytes of every block."""

    def started(self, task: Task, decision: str) -> None:
        """The task was handed to the executor."""

    def progressed(self, task: Task, done: int, total: int | None) -> None:
        """The task has done so many units."""

    def settled(self, result: TaskResult) -> None:
        """The task is cached, done, failed or blocked."""

    def reopened(self, result: TaskResult) -> None:
        """A task that was settled so has to run again, because what is stored of it is damaged."""

    def withdrawn(self, task: Task) -> None:
        """A task that was started ended without a result and waits for a damaged input to be made again."""

    def tick(self) -> None:
        """Some time has passed."""


@dataclass
class _LogState:
    """What a run knows of one log."""

    log: Log
    number: int
    undecided: list[tuple[int, Task]]
    entries: dict[tuple[str, str], Entry] = field(default_factory=dict)
    failed: set[tuple[str, str]] = field(default_factory=set)


@dataclass
class _Making:
    """A key that is being made, for the task that asked first and for others that turned out to need the same."""

    state: _LogState
    task: Task
    decision: Decision
    inputs: tuple[Entry, ...]
    followers: list[tuple[_LogState, Task, Decision]] = field(default_factory=list)


class Runner:
    """One run over an output folder, which must be locked.

    Args:
        stages: those to run, in order; every stage another needs is among them.
        published: name of the stage whose files go to `results`.
        threads: how many new logs are read at once for their digests.
        book: the records of the folder, if they were read already.
    """

    def __init__(
        self,
        folder: OutputFolder,
        stages: Sequence[Stage],
        config: Config,
        logs: Sequence[Log],
        executor: Executor,
        listener: Listener,
        published: str,
        threads: int = 1,
        book: RecordBook | None = None,
    ) -> None:
        self._folder = folder
        self._stages = tuple(stages)
        self._config = config
        self._executor = executor
        self._listener = listener
        self._published = published
        self._threads = threads
        self._index = EntryIndex(folder.cache)
        self._digests = DigestCache(folder.cache / "digests.json")
        self._book = book or RecordBook(folder.logs)
        self._results = Results(folder)
        self._planner = Planner(stages, config, folder.cache, self._index, self._digests, published)
        self._states = [
            _LogState(log, number, list(enumerate(tasks_of(self._stages, log, config))))
            for number, log in enumerate(logs)
        ]
        self._ready: list[tuple[int, int, str]] = []
        self._making: dict[str, _Making] = {}
        self._running: dict[int, str] = {}
        self._numbers = count()
        self._settled: dict[tuple[int, str], TaskResult] = {}
        self._dropped: set[Path] = set()
        self._retried: set[tuple[int, str, Path]] = set()

    def run(self) -> RunReport:
        """Do all there is to do.

        Raises:
            UsageError: a file named in the configuration cannot be read, or a stage would refuse its configuration.
            SemslamError: no space is left.
            KeyboardInterrupt: as it came; what was finished stays.
        """
        start = time.monotonic()
        self._listener.planned([task for state in self._states for _, task in state.undecided])
        self._prepare()
        try:
            for state in self._states:
                self._advance(state)
            while self._ready or self._running:
                self._hand_out()
                for outcome in self._executor.wait(self._progress, _TICK_S):
                    self._take(outcome)
                self._listener.tick()
        except OSError as error:
            if not out_of_space(error):
                raise
            raise self._no_space() from error
        finally:
            self._executor.close()
            self._save()
        return RunReport(tuple(self._in_order()), time.monotonic() - start)

    def _prepare(self) -> None:
        """Know the configuration's and the logs' files before anything depends on them."""
        tasks = [task for state in self._states[:1] for _, task in state.undecided]
        self._planner.check_settings(tasks)
        check_new(self._planner, self._config, tasks, self._book.records.values())
        resolved = self._config.as_json()
        if read_json(self._folder.config) != resolved:
            write_json(self._folder.config, resolved)
        missing = self._digests.unknown(path for state in self._states for path in state.log.sources)
        if missing:
            seen = self._listener.hashing(len(missing), sum(size for _, size in missing))
            self._digests.warm([path for path, _ in missing], self._threads, seen)
            self._digests.save()
        for state in self._states:
            self._start_record(state, resolved)

    def _start_record(self, state: _LogState, resolved: Mapping[str, Any]) -> None:
        """Bring the record of a log to this run: its files and configuration, and no variants it no longer has."""
        record = self._book.of(state.log.name)
        record.sources = [str(path) for path in state.log.sources]
        record.config = {**record.config, **resolved}
        planned = {task.name for _, task in state.undecided}
        stages = {stage.name for stage in self._stages}
        record.tasks = {n: t for n, t in record.tasks.items() if n in planned or n.split("/")[0] not in stages}

    def _advance(self, state: _LogState) -> None:
        """Decide every task of a log whose inputs are settled."""
        undecided = []
        for number, task in state.undecided:
            needs = self._planner.needs(task)
            if not state.failed.isdisjoint(needs):
                self._block(state, task, next(need for need in needs if need in state.failed))
            elif all(need in state.entries for need in needs):
                self._decide(state, number, task)
            else:
                undecided.append((number, task))
        state.undecided = undecided

    def _decide(self, state: _LogState, number: int, task: Task) -> None:
        record = self._book.of(state.log.name).tasks.get(task.name)
        try:
            decision = self._planner.decide(task, state.entries, record)
        except UsageError:
            raise
        except SemslamError as error:
            failure = Failure("refused", error.message, error.hint, error.details)
            self._settle(state, TaskResult(task, "failed", "run (new)", failure=failure))
            return
        if decision.entry is not None:
            self._settle(state, _ended(task, decision, decision.entry, None, "cached"))
            return
        place = f"{task.stage.name}/{decision.key}"
        if place in self._making:
            self._making[place].followers.append((state, task, decision))
            return
        inputs = tuple(state.entries[need] for need in self._planner.needs(task))
        self._making[place] = _Making(state, task, decision, inputs)
        heapq.heappush(self._ready, (state.number, number, place))

    def _hand_out(self) -> None:
        while self._ready and self._executor.free > 0:
            _, _, place = heapq.heappop(self._ready)
            making = self._making[place]
            number = next(self._numbers)
            try:
                job = self._job(number, making)
            except DamagedEntryError as error:
                if not self._heal(place, error.entry):
                    self._end(place, Failure("damaged", error.message, error.hint, error.details), None)
                continue
            except SemslamError as error:
                self._end(place, Failure("refused", error.message, error.hint, error.details), None)
                continue
            self._running[number] = place
            self._note_start(making)
            self._executor.submit(job)

    def _job(self, number: int, making: _Making) -> Job:
        """The task as a worker gets it."""
        task = making.task
        guards = tuple((str(path), self._digests.stamp(path)) for path in self._planner.input_files(task))
        return Job(
            number=number,
            stage=task.stage,
            variant=task.variant,
            log=task.log.name,
            sources=task.log.sources if task.stage.from_log else (),
            config=self._planner.task_config(task),
            key=making.decision.key,
            components=making.decision.components,
            inputs=self._inputs(making),
            guards=guards,
            stage_folder=self._folder.stage(task.stage.name),
        )

    def _inputs(self, making: _Making) -> dict[str, tuple[InputFile, ...]]:
        """Stored files of all tables the task reads."""
        stored: dict[str, tuple[InputFile, ...]] = {}
        for entry in making.inputs:
            stored |= table_files(self._folder.stage(entry.stage) / entry.key)
        return {table.name: stored[table.name] for table in making.task.stage.reads if table.name in stored}

    def _progress(self, number: int, done: int, total: int | None) -> None:
        self._listener.progressed(self._making[self._running[number]].task, done, total)

    def _take(self, outcome: Outcome) -> None:
        """A job ended."""
        if outcome.out_of_space:
            raise self._no_space()
        place = self._running.pop(outcome.number)
        failure = outcome.failure
        if failure is not None and failure.kind == "damaged":
            task = self._making[place].task
            if self._heal(place, Path(failure.entry)):
                self._listener.withdrawn(task)
                return
        self._end(place, failure, outcome)

    def _heal(self, place: str, damaged: Path) -> bool:
        """Drop a damaged entry and take up again all who made it or wait for it; False if that was tried in vain."""
        making = self._making[place]
        attempt = (making.state.number, making.task.name, damaged)
        if attempt in self._retried:
            return False
        self._retried.add(attempt)
        if damaged not in self._dropped:
            self._dropped.add(damaged)
            remove(damaged)
        del self._making[place]
        for state, task, _ in [(making.state, making.task, making.decision), *making.followers]:
            state.undecided.append((self._order(state, task), task))
        for state in self._states:
            self._reopen(state, damaged)
            self._advance(state)
        return True

    def _reopen(self, state: _LogState, damaged: Path) -> None:
        """Take back what a log has of an entry that was dropped, unless it was made again meanwhile."""
        for place, entry in list(state.entries.items()):
            if (entry.stage, entry.key) == (damaged.parent.name, damaged.name) and not damaged.exists():
                task = next(task for task in tasks_of(self._stages, state.log, self._config) if _place(task) == place)
                del state.entries[place]
                state.undecided.append((self._order(state, task), task))
                self._listener.reopened(self._settled.pop((state.number, task.name)))
        state.undecided.sort(key=lambda numbered: numbered[0])

    def _order(self, state: _LogState, task: Task) -> int:
        """Place of a task among those of its log."""
        return [one.name for one in tasks_of(self._stages, state.log, self._config)].index(task.name)

    def _end(self, place: str, failure: Failure | None, outcome: Outcome | None) -> None:
        """Settle the task that made a key and all that waited for the same key."""
        making = self._making.pop(place)
        entry = None if failure else self._index.find(making.task.stage.name, making.decision.key)
        if entry is None and failure is None:
            failure = Failure("unexpected", f"The finished entry `{place}` cannot be read back", "check the disk")
        first = _ended(making.task, making.decision, entry, failure, "done")
        if outcome is not None:
            first = replace(
                first, seconds=outcome.seconds, max_rss_bytes=outcome.max_rss_bytes, resumed=outcome.resumed
            )
        self._settle(making.state, first)
        for state, task, decision in making.followers:
            same = replace(decision, text=f"same work as `{making.task.log.name}`")
            self._settle(state, _ended(task, same, entry, failure, "cached"))
            self._advance(state)
        self._advance(making.state)

    def _block(self, state: _LogState, task: Task, need: tuple[str, str]) -> None:
        self._settle(state, TaskResult(task, "blocked", f"blocked: {need[0]} failed"))

    def _settle(self, state: _LogState, result: TaskResult) -> None:
        """Note what became of a task, in memory and in the log's record."""
        task = result.task
        place = _place(task)
        if result.entry is not None:
            state.entries[place] = result.entry
            if task.stage.name == self._published:
                self._results.publish(task.log.name, task.variant, result.entry)
        else:
            state.failed.add(place)
        result = self._with_traceback(result)
        self._settled[state.number, task.name] = result
        self._note(state, result)
        self._listener.settled(result)

    def _with_traceback(self, result: TaskResult) -> TaskResult:
        """Move the traceback of an unexpected error into a file that the message names."""
        failure, task = result.failure, result.task
        if failure is None or not failure.traceback:
            return result
        path = self._book.write_traceback(task.log.name, task.stage.name, task.variant, failure.traceback)
        return replace(result, failure=replace(failure, hint=f"this is a bug; the traceback is in `{path}`"))

    def _note_start(self, making: _Making) -> None:
        """Tell the listener, and leave a trace for `status` should this run be killed."""
        task = making.task
        record = self._book.of(task.log.name).task(task.stage.name, task.variant)
        record.decision, record.state = making.decision.text, "running"
        self._book.save(task.log.name)
        self._listener.started(task, making.decision.text)

    def _note(self, state: _LogState, result: TaskResult) -> None:
        record = self._book.of(state.log.name).task(result.task.stage.name, result.task.variant)
        record.decision, record.state, record.failure = result.decision, result.state, result.failure
        record.failed_key = result.key if result.failure else ""
        if result.entry is not None:
            record.key, record.components = result.key, result.components
        if result.state != "cached":
            self._book.save(state.log.name)

    def _in_order(self) -> Iterator[TaskResult]:
        for state in self._states:
            for task in tasks_of(self._stages, state.log, self._config):
                yield self._settled[state.number, task.name]

    def _save(self) -> None:
        """Write records and memories; a full disk is told once, by whoever met it first."""
        with contextlib.suppress(OSError):
            for state in self._states:
                self._book.save(state.log.name)
            self._index.save()
            self._digests.save()
            self._results.save()

    def _no_space(self) -> SemslamError:
        return SemslamError(
            f"No space left for output folder `{self._folder.root}`",
            hint="free some space, or remove old results with `semslam clean`; then run the same command again: "
            "finished parts are kept",
        )


def _place(task: Task) -> tuple[str, str]:
    return (task.stage.name, task.variant)


def _ended(task: Task, decision: Decision, entry: Entry | None, failure: Failure | None, state: str) -> TaskResult:
    """The result of a task whose key is known: `state` if there is an entry, else failed."""
    return TaskResult(
        task=task,
        state=state if entry is not None else "failed",
        decision=decision.text,
        key=decision.key,
        components=decision.components,
        entry=entry,
        failure=failure,
    )
