"""Making a data set: plan, skip what is finished, record the rest in worker processes, count.

The bytes that it leaves depend on the recipe and the versions of the software alone: not on the number of workers, on
the clock, or on how often it was interrupted.
"""

from __future__ import annotations

import errno
import os
import shutil
import statistics
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from semslam.errors import SemslamError
from semslam.processes import usable_cpus
from semslam.sim.dataset import Recipe, Recording
from semslam.sim.dataset_folder import (
    DataSetFolder,
    Receipt,
    open_data_set,
    refuse_changes,
    refuse_strangers,
    sha256_file,
    write_receipt,
)
from semslam.sim.engine import kernel_cache
from semslam.sim.pool import Died, Pool
from semslam.sim.recorder import record_home

Recorder = Callable[[Recording, Path, Path, Callable[[int], None]], Sequence[int]]
"""Writes a log (a file) and its truth (files in a folder that exists), tells frames done, returns objects in view of
every frame. A function of a module, because workers import it by name."""


@dataclass(frozen=True)
class Failure:
    """Why a log could not be made."""

    message: str
    hint: str = ""
    details: str = ""
    full: bool = False
    """The disk is full, so no other log can be made either."""


@dataclass(frozen=True)
class LogResult:
    """What became of one log: `state` is cached, done or failed."""

    recording: Recording
    state: str
    receipt: Receipt | None = None
    failure: Failure | None = None
    cpu_s: float = 0.0
    """Processor time of the worker; 0 for what was there already."""


@dataclass(frozen=True)
class Report:
    """What a command made, for people and for machines. Times are told and never stored."""

    out: Path
    results: tuple[LogResult, ...]
    wall_s: float
    notes: tuple[str, ...] = ()

    @property
    def failures(self) -> list[LogResult]:
        """Logs that could not be made."""
        return [one for one in self.results if one.state == "failed"]

    def summary(self, results: Sequence[LogResult] | None = None) -> Summary:
        """Counts over all logs, or over some."""
        return Summary.of(self.results if results is None else results)

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        whole = self.summary()
        return {
            "out": str(self.out),
            **whole.as_json(),
            "wall_s": round(self.wall_s, 3),
            "notes": list(self.notes),
            "logs": [_log_json(one) for one in self.results],
        }


@dataclass(frozen=True)
class Summary:
    """Counts over some logs; None where there is nothing to count."""

    states: Mapping[str, int]
    frames: int
    objects_median: float | None
    objects_min: int | None
    frames_per_cpu_s: float | None
    """Of logs made by this command; start of the workers and building of the homes included."""
    bytes: int

    @classmethod
    def of(cls, results: Sequence[LogResult]) -> Summary:
        """Count."""
        whole = [one.receipt for one in results if one.receipt]
        visible = [count for receipt in whole for count in receipt.visible]
        made = [one for one in results if one.state == "done" and one.receipt]
        cpu_s, frames = sum(one.cpu_s for one in made), sum(len(one.receipt.visible) for one in made if one.receipt)
        states = {state: sum(one.state == state for one in results) for state in ("cached", "done", "failed")}
        return cls(
            states,
            len(visible),
            statistics.median(visible) if visible else None,
            min(visible, default=None),
            frames / cpu_s if cpu_s else None,
            sum(receipt.bytes for receipt in whole),
        )

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        rate = self.frames_per_cpu_s
        return {
            **self.states,
            "frames": self.frames,
            "objects_per_frame": {"median": self.objects_median, "min": self.objects_min},
            "frames_per_cpu_s": None if rate is None else round(rate, 4),
            "bytes": self.bytes,
        }


class Listener(Protocol):
    """Watches a data set being made."""

    def planned(self, logs: int, cached: int, frames: int) -> None:
        """So many logs, of which so many are finished already, and so many frames to make."""

    def progressed(self, frames: int) -> None:
        """So many of these frames are done; the number falls when a log is tried again."""

    def settled(self, result: LogResult) -> None:
        """A log is done or has failed."""

    def tick(self) -> None:
        """Time passes."""


class Silence:
    """Hears nothing."""

    def planned(self, logs: int, cached: int, frames: int) -> None:
        """Nothing."""

    def progressed(self, frames: int) -> None:
        """Nothing."""

    def settled(self, result: LogResult) -> None:
        """Nothing."""

    def tick(self) -> None:
        """Nothing."""


def simulate(
    out: Path,
    recipe: Recipe,
    *,
    workers: int | None = None,
    replace: bool = False,
    verify: bool = False,
    listener: Listener | None = None,
    recorder: Recorder | None = None,
) -> Report:
    """Make a data set, or what is missing of it.

    Args:
        out: folder; made if it is not there.
        workers: processes; None means one a processor, 0 none but this.
        replace: make anew what differs from the recipe, and remove what it does not ask for.
        verify: read finished files to see if they are still what they were; otherwise their sizes must do.
        listener: told how it goes.
        recorder: what records a log; None means `record_home`.

    Raises:
        SemslamError: the folder is in use, holds something else or a data set made otherwise, or the disk is full.
    """
    start = time.monotonic()
    folder, recordings = open_data_set(out), recipe.recordings()
    with folder.locked():
        folder.clear_leftovers()
        refuse_strangers(folder, recordings)
        if not replace:
            refuse_changes(folder, recipe)
        making = _Making(folder, recipe, recordings, listener or Silence())
        making.prepare(verify=verify)
        making.make(usable_cpus() if workers is None else workers, recorder or record_home)
    return Report(out, making.in_order(), time.monotonic() - start, tuple(making.notes))


@dataclass
class _Making:
    """A data set while it is made."""

    folder: DataSetFolder
    recipe: Recipe
    recordings: Sequence[Recording]
    listener: Listener
    results: dict[str, LogResult] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def prepare(self, *, verify: bool) -> None:
        """Make folder and plan agree: what does not belong is removed, what is finished is skipped."""
        before, names = self.folder.ours(), {one.name for one in self.recordings}
        if before - names:
            self.notes.append(f"{len(before - names)} logs that are not asked for were removed")
        if before and names - before:
            self.notes.append(f"{len(before & names)} logs grow to {len(names)}: `splits.parquet` is drawn again")
        for name in sorted(before - names):
            self.folder.forget(name)
        self._find_finished(verify=verify)
        self._write_plan()
        self._write_splits()

    def _find_finished(self, *, verify: bool) -> None:
        """Skip what is finished; what is there and is not is removed, so that it lies beside no log it does not fit."""
        damaged = 0
        for one in self.recordings:
            if receipt := self.folder.finished(one, verify=verify):
                self.results[one.name] = LogResult(one, "cached", receipt)
                continue
            damaged += self.folder.claimed(one) is not None
            self.folder.forget(one.name)
        if damaged:
            self.notes.append(f"{damaged} finished logs had been changed or removed, and are made anew")

    def make(self, workers: int, recorder: Recorder) -> None:
        """Make what is not finished."""
        waiting = [one for one in self.recordings if one.name not in self.results]
        self.listener.planned(len(self.recordings), len(self.results), sum(one.steps for one in waiting))
        done = [0] * len(waiting)

        def progress(number: int, frames: int) -> None:
            done[number] = frames
            self.listener.progressed(sum(done))

        tasks = [_Task(self.folder, one, recorder) for one in waiting]
        try:
            with (
                kernel_cache() as environment,
                Pool(min(workers, len(tasks)), _make_log, _home, self.listener.tick, environment) as pool,
            ):
                for number, ended in pool.run(tasks, progress):
                    self._settle(waiting[number], ended)
        except BaseException:
            with suppress(OSError):  # what ended it is the news
                self._write_plan()
            raise
        finally:
            self.folder.clear_leftovers()
        self._write_plan()

    def _settle(self, recording: Recording, ended: LogResult | Died) -> None:
        result = _lost(recording, ended) if isinstance(ended, Died) else ended
        self.results[recording.name] = result
        self.listener.settled(result)
        if result.failure and result.failure.full:
            raise SemslamError(
                f"No space left for data set `{self.folder.root}`",
                hint="free some space, then run the same command again",
            )

    def in_order(self) -> tuple[LogResult, ...]:
        """Results in the order of the plan."""
        return tuple(self.results[one.name] for one in self.recordings)

    def _write_splits(self) -> None:
        from semslam.sim.splits import assign, write_splits  # numpy and pyarrow, which a refused command does without

        write_splits(self.folder.splits, assign(self.recordings, self.recipe.seed), self.recipe.seed)

    def _write_plan(self) -> None:
        """By the receipts there are: an interrupted command has not heard of every log its workers finished."""
        finished = {one.name: self.folder.finished(one) for one in self.recordings}
        receipts = {name: receipt for name, receipt in finished.items() if receipt}
        self.folder.write_plan(self.recipe, self.recordings, receipts)


@dataclass(frozen=True)
class _Task:
    """What a worker gets."""

    folder: DataSetFolder
    recording: Recording
    recorder: Recorder


def _home(task: _Task) -> tuple[str, int, int]:
    """Logs of the same home share what it takes to draw it."""
    return task.recording.variant, task.recording.scene, task.recording.day


def _make_log(task: _Task, report: Callable[[int], None]) -> LogResult:
    """Make one log; whatever a library throws belongs to this log alone."""
    start = time.process_time()
    try:
        receipt = _record(task, report)
    except Exception as error:
        return LogResult(task.recording, "failed", failure=_describe(error), cpu_s=time.process_time() - start)
    return LogResult(task.recording, "done", receipt, cpu_s=time.process_time() - start)


def _record(task: _Task, report: Callable[[int], None]) -> Receipt:
    """Log, truth and receipt; each appears whole, the receipt last."""
    folder, name = task.folder, task.recording.name
    truth = folder.truth(name)
    partial = truth.with_name(f".{name}.partial-{os.getpid()}")
    partial.mkdir()
    try:
        visible = tuple(int(count) for count in task.recorder(task.recording, folder.log(name), partial, report))
        shutil.rmtree(truth, ignore_errors=True)
        partial.replace(truth)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    files = [folder.log(name), *sorted(path for path in truth.rglob("*") if path.is_file())]
    listed = {str(path.relative_to(folder.root)): (path.stat().st_size, sha256_file(path)) for path in files}
    receipt = Receipt(name, task.recording.key(), listed, visible)
    write_receipt(folder, receipt)
    return receipt


def _describe(error: Exception) -> Failure:
    """What to tell of an exception."""
    full = _out_of_space(error)
    if isinstance(error, SemslamError):
        return Failure(error.message, error.hint, error.details, full)
    if isinstance(error, OSError):
        where = f": `{error.filename}`" if error.filename else ""
        return Failure(f"{error.strerror or error}{where}", "check the path and the disk it lies on", "", full)
    if isinstance(error, MemoryError):
        return Failure("Not enough memory", "run with fewer `--workers`")
    trace = "".join(traceback.format_exception(error)).rstrip()
    said = " ".join(str(error).split())[:300]
    return Failure(f"{type(error).__name__}: {said}", "this is a bug; report it with the traceback", trace)


def _lost(recording: Recording, died: Died) -> LogResult:
    message = f"The worker process {died.how}, {died.times} times"
    return LogResult(recording, "failed", failure=Failure(message, died.hint))


def _out_of_space(error: BaseException | None) -> bool:
    """Whether the error, or one that caused it, says that the disk or the quota is full."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


def _log_json(one: LogResult) -> dict[str, Any]:
    """One log for machines."""
    told: dict[str, Any] = {"log": one.recording.name, "state": one.state}
    if one.receipt:
        size, digest = next(iter(one.receipt.files.values()))
        told |= {"frames": len(one.receipt.visible), "bytes": size, "sha256": digest}
    if one.failure:
        told["failure"] = {"message": one.failure.message, "hint": one.failure.hint, "details": one.failure.details}
    return {**told, "cpu_s": round(one.cpu_s, 3)}
