"""Where jobs run: in this process, or in a pool of worker processes that survives the death of any of them.

The pool starts its workers by *spawn* and talks to each over a pipe of its own, so that a worker killed by the system
costs exactly the job it had. That job is tried once more; if it kills its second worker too, it has failed.
"""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from semslam.pipeline.failure import Failure
from semslam.pipeline.job import Job, Outcome
from semslam.pipeline.threads import ONE_THREAD
from semslam.processes import die_with_parent

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess

_DEATHS_ALLOWED = 1

Report = Callable[[int, int, int | None], None]
"""Called with job number, units done, and of how many if known."""


class Executor(Protocol):
    """Runs jobs; how many at a time is its own affair."""

    @property
    def free(self) -> int:
        """How many more jobs it would start at once."""

    def submit(self, job: Job) -> None:
        """Take a job; only while `free`."""

    def wait(self, report: Report, timeout_s: float) -> Sequence[Outcome]:
        """Let jobs run, pass on their progress, and return those that ended; empty after `timeout_s` without any."""

    def close(self) -> None:
        """End all workers at once; unfinished jobs keep the shards they published."""


class SerialExecutor:
    """Runs one job at a time in this process, for debugging and for tests."""

    def __init__(self) -> None:
        self._jobs: deque[Job] = deque()

    @property
    def free(self) -> int:
        """One job at a time."""
        return 1 - len(self._jobs)

    def submit(self, job: Job) -> None:
        """Take a job; it runs in the next `wait`."""
        self._jobs.append(job)

    def wait(self, report: Report, timeout_s: float) -> Sequence[Outcome]:  # noqa: ARG002
        """Run the job to its end."""
        from semslam.pipeline.worker import execute  # imports numpy and pyarrow, which planning does without

        if not self._jobs:
            return ()
        job = self._jobs.popleft()
        return (execute(job, lambda done, total: report(job.number, done, total)),)

    def close(self) -> None:
        """Nothing is running between two calls of `wait`."""


@dataclass
class _Worker:
    """A worker process, our end of its pipe, and the job it has."""

    process: SpawnProcess
    pipe: Connection[Any, Any]
    job: Job | None = None


class ProcessPool:
    """Runs jobs in up to `workers` processes; they are started when first needed."""

    def __init__(self, workers: int) -> None:
        self._size = workers
        self._workers: list[_Worker] = []
        self._again: deque[Job] = deque()
        self._deaths: dict[int, int] = {}

    @property
    def free(self) -> int:
        """Workers without a job, those not started yet included."""
        busy = sum(worker.job is not None for worker in self._workers)
        return self._size - busy - len(self._again)

    def submit(self, job: Job) -> None:
        """Give the job to an idle worker or to a new one."""
        idle = next((worker for worker in self._workers if worker.job is None), None)
        worker = idle or self._start()
        worker.job = job
        try:
            worker.pipe.send(job)
        except OSError:
            return  # it died while idle; `wait` sees that and gives the job to another

    def wait(self, report: Report, timeout_s: float) -> Sequence[Outcome]:
        """Handle what the workers say until one ends a job or `timeout_s` passes."""
        from multiprocessing.connection import wait

        while self._again:
            self.submit(self._again.popleft())
        ready = set(wait([w.pipe for w in self._workers] + [w.process.sentinel for w in self._workers], timeout_s))
        outcomes: list[Outcome] = []
        for worker in list(self._workers):
            if worker.pipe in ready:
                outcomes += self._listen(worker, report)
            elif worker.process.sentinel in ready:
                outcomes += self._bury(worker)
        return outcomes

    def close(self) -> None:
        """Kill every worker; nothing they have published can be half of anything."""
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()

    def _start(self) -> _Worker:
        import multiprocessing
        from multiprocessing import resource_tracker

        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe()
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        resource_tracker.ensure_running()  # it unblocks the signal when it starts
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a worker inherits that while it imports
        try:
            process = spawn.Process(target=_work, args=(theirs,), daemon=True)
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            _restore_environment(before)
        theirs.close()
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker

    def _listen(self, worker: _Worker, report: Report) -> list[Outcome]:
        """Everything the worker has said so far."""
        try:
            while worker.pipe.poll():
                kind, content = worker.pipe.recv()
                if kind == "ended":
                    worker.job = None
                    return [content]
                report(*content)
        except (EOFError, OSError):
            return self._bury(worker)
        return []

    def _bury(self, worker: _Worker) -> list[Outcome]:
        """A worker is dead: its job goes to another worker, or has failed if it did this before."""
        worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)
        job = worker.job
        if job is None:
            return []
        deaths = self._deaths[job.number] = self._deaths.get(job.number, 0) + 1
        if deaths <= _DEATHS_ALLOWED:
            self._again.append(job)
            return []
        return [Outcome(job.number, _killed(worker.process.exitcode, deaths), 0.0)]


def _restore_environment(before: dict[str, str | None]) -> None:
    for name, value in before.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _killed(exit_code: int | None, times: int) -> Failure:
    """What to say of a job whose workers die."""
    if exit_code is not None and exit_code < 0:
        how = f"was ended by signal {signal.Signals(-exit_code).name}"
    else:
        how = f"ended with exit code {exit_code}"
    if exit_code == -signal.SIGKILL:
        hint = "SIGKILL usually means that memory ran out: use fewer `--workers` or smaller `shard_frames`"
    else:
        hint = "a library crashed on this input; `--workers 0` runs the task in this process, for a debugger"
    return Failure("killed", f"The worker process {how}, {times} times", hint)


def _work(pipe: Connection[Any, Any]) -> None:
    """The life of a worker process: jobs in, progress and outcomes out, until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent()
    os.dup2(2, 1)  # stdout belongs to the data of the command; a chatty library must not write into it
    from semslam.pipeline.worker import execute

    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        outcome = execute(job, lambda done, total: pipe.send(("progress", (job.number, done, total))))  # noqa: B023
        pipe.send(("ended", outcome))
