"""A pool of worker processes that survives the death of any of them.

Workers start by *spawn*, use one thread each, and have a pipe of their own, so that a worker killed by the system
costs exactly the task it had. That task is tried once more; if it kills its second worker too, it has failed. Workers
end with their parent, however that ends.
"""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, TypeVar

from semslam.processes import die_with_parent

Task = TypeVar("Task")
Result = TypeVar("Result")
Job = Callable[[Task, Callable[[int], None]], Result]
"""Runs a task and tells, as it goes, how many units are done. It throws nothing: what goes wrong is part of its result.
A function of a module, because workers import it by name."""

ONE_THREAD: Mapping[str, str] = {
    **dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"),
        "1",
    ),
    "OPENCV_FOR_THREADS_NUM": "1",
    "CUDA_VISIBLE_DEVICES": "",
}
"""Environment of a worker: sums come out alike on every machine, and no library looks for a GPU."""

_DEATHS_ALLOWED = 1
_TICK_S = 0.2


@dataclass(frozen=True)
class Died:
    """The end of a task whose workers died."""

    how: str
    hint: str
    times: int


@dataclass
class _Worker:
    """A worker process, our end of its pipe, the number of the task it has, and the kind of its last one."""

    process: SpawnProcess
    pipe: Connection[Any, Any]
    number: int | None = None
    kind: Hashable = None


class Pool(Generic[Task, Result]):
    """Runs tasks in up to `workers` processes, which start when first needed. A context manager; leaving it kills them.

    Args:
        workers: processes; 0 means none but this one, one task after another.
        job: what to do with a task.
        kind: tasks of one kind go to one worker as far as that keeps nobody waiting, which may remember something.
        tick: called a few times a second while waiting.
        environment: what the workers have in their environment beside `ONE_THREAD`.
    """

    def __init__(
        self,
        workers: int,
        job: Job[Task, Result],
        kind: Callable[[Task], Hashable] = lambda _: None,
        tick: Callable[[], None] = lambda: None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._size = workers
        self._job = job
        self._kind = kind
        self._tick = tick
        self._environment = {**ONE_THREAD, **(environment or {})}
        self._workers: list[_Worker] = []
        self._waiting: deque[int] = deque()
        self._deaths: dict[int, int] = {}

    def __enter__(self) -> Pool[Task, Result]:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()

    def run(self, tasks: Sequence[Task], progress: Callable[[int, int], None]) -> Iterator[tuple[int, Result | Died]]:
        """Numbers and results of all tasks, in the order in which they end.

        `progress` is called with the number of a task and its units done; these fall back to 0 when it is tried again.
        """
        if self._size == 0:
            for number, task in enumerate(tasks):
                yield number, self._job(task, self._told(number, progress))
                self._tick()
            return
        self._waiting.extend(range(len(tasks)))
        while self._waiting or any(worker.number is not None for worker in self._workers):
            self._hand_out(tasks)
            yield from self._hear(progress)
            self._tick()

    def _told(self, number: int, progress: Callable[[int, int], None]) -> Callable[[int], None]:
        """What a job in this process reports to."""

        def report(done: int) -> None:
            progress(number, done)
            self._tick()

        return report

    def _hand_out(self, tasks: Sequence[Task]) -> None:
        """Give waiting tasks to idle workers and to new ones."""
        idle = [worker for worker in self._workers if worker.number is None]
        while self._waiting and (idle or len(self._workers) < self._size):
            worker = idle.pop() if idle else self._start()
            worker.number = self._choose(worker, tasks)
            worker.kind = self._kind(tasks[worker.number])
            try:
                worker.pipe.send((worker.number, tasks[worker.number]))
            except OSError:
                continue  # it died while idle; `_hear` sees that and gives the task to another

    def _choose(self, worker: _Worker, tasks: Sequence[Task]) -> int:
        """Take the first waiting task of the worker's kind, else of a kind that nobody works on, else of any."""
        busy = {other.kind for other in self._workers if other is not worker}
        kinds = [self._kind(tasks[number]) for number in self._waiting]
        same = (place for place, kind in enumerate(kinds) if kind == worker.kind)
        new = (place for place, kind in enumerate(kinds) if kind not in busy)
        number = self._waiting[next(same, next(new, 0))]
        self._waiting.remove(number)
        return number

    def _hear(self, progress: Callable[[int, int], None]) -> Iterator[tuple[int, Result | Died]]:
        """Handle what the workers say within a tick."""
        ready = set(wait([w.pipe for w in self._workers] + [w.process.sentinel for w in self._workers], _TICK_S))
        for worker in list(self._workers):
            if worker.pipe in ready:
                yield from self._listen(worker, progress)
            elif worker.process.sentinel in ready:
                yield from self._bury(worker, progress)

    def _listen(self, worker: _Worker, progress: Callable[[int, int], None]) -> Iterator[tuple[int, Result | Died]]:
        """Everything the worker has said so far."""
        try:
            while worker.pipe.poll():
                kind, number, content = worker.pipe.recv()
                if kind == "progress":
                    progress(number, content)
                else:
                    worker.number = None
                    yield number, content
        except (EOFError, OSError):
            yield from self._bury(worker, progress)

    def _bury(self, worker: _Worker, progress: Callable[[int, int], None]) -> Iterator[tuple[int, Result | Died]]:
        """A worker is dead: its task goes to another worker, or has failed if it did this before."""
        worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)
        if worker.number is None:
            return
        deaths = self._deaths[worker.number] = self._deaths.get(worker.number, 0) + 1
        progress(worker.number, 0)
        if deaths <= _DEATHS_ALLOWED:
            self._waiting.appendleft(worker.number)
        else:
            yield worker.number, _died(worker.process.exitcode, deaths)

    def _start(self) -> _Worker:
        import multiprocessing
        from multiprocessing import resource_tracker

        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe()
        resource_tracker.ensure_running()  # it unblocks the signal when it starts
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a worker inherits that while it imports
        try:
            with _changed_environment(self._environment):
                process = spawn.Process(target=_work, args=(theirs, self._job), daemon=True)
                process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        theirs.close()
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker


@contextmanager
def _changed_environment(values: Mapping[str, str]) -> Iterator[None]:
    """Some variables set for a while."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _died(exit_code: int | None, times: int) -> Died:
    """What to say of a task whose workers die."""
    if exit_code is not None and exit_code < 0:
        how = f"was ended by signal {signal.Signals(-exit_code).name}"
    else:
        how = f"ended with exit code {exit_code}"
    if exit_code == -signal.SIGKILL:
        hint = "SIGKILL usually means that memory ran out: use fewer `--workers`"
    else:
        hint = "a library crashed; `--workers 0` works in this process, for a debugger"
    return Died(how, hint, times)


def _work(pipe: Connection[Any, Any], job: Job[Any, Any]) -> None:
    """The life of a worker process: tasks in, progress and results out, until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent()
    os.dup2(2, 1)  # stdout belongs to the data of the command; a chatty library must not write into it
    while True:
        try:
            number, task = pipe.recv()
        except EOFError:
            return
        result = job(task, lambda done: pipe.send(("progress", number, done)))  # noqa: B023
        pipe.send(("ended", number, result))
