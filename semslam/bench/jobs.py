"""Parts in worker processes, one process a part: a crash or a hang costs that part alone.

A part takes seconds to minutes, so that a fresh process each costs little; and a network's training, or a package that
aborts, leaves nothing behind in the next.
"""

from __future__ import annotations

import importlib
import os
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from semslam.bench.store import Part, Store
from semslam.errors import SemslamError
from semslam.pipeline.files import write_text
from semslam.pipeline.threads import ONE_THREAD
from semslam.processes import die_with_parent

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess

_TRACEBACK = "traceback.txt"


@dataclass(frozen=True)
class Outcome:
    """How a part came out: a result, or the reason why there is none."""

    part: Part
    result: dict[str, Any] | None
    reason: str = ""
    cached: bool = False
    seconds: float = 0.0


@dataclass
class _Running:
    part: Part
    process: SpawnProcess
    pipe: Connection[Any, Any]
    started: float

    @property
    def late(self) -> bool:
        """Whether its time is over."""
        return self.part.timeout_s is not None and time.monotonic() - self.started > self.part.timeout_s


def run_parts(
    store: Store, parts: Sequence[Part], workers: int, settled: Callable[[Outcome], None] | None = None
) -> dict[str, Outcome]:
    """Do what is not done yet, at most `workers` at once (0: in this process), and return outcomes by key.

    Args:
        settled: hears of every part as it ends, in no fixed order.
    """
    outcomes: dict[str, Outcome] = {}

    def keep(outcome: Outcome) -> None:
        outcomes[outcome.part.key] = outcome
        if settled:
            settled(outcome)

    waiting = {part.key: part for part in parts}
    for part in list(waiting.values()):
        result = store.result(part)
        if result is not None:
            keep(Outcome(waiting.pop(part.key), result, cached=True))
    if workers == 0:
        for part in waiting.values():
            keep(_here(store, part))
    else:
        _there(store, list(waiting.values()), workers, keep)
    return {part.key: outcomes[part.key] for part in parts}


def _here(store: Store, part: Part) -> Outcome:
    """Do a part in this process."""
    started = time.monotonic()
    reason = _do(store, part)
    return Outcome(part, store.result(part), reason, seconds=time.monotonic() - started)


def _there(store: Store, waiting: list[Part], workers: int, keep: Callable[[Outcome], None]) -> None:
    """Do parts in processes of their own."""
    from multiprocessing.connection import wait

    waiting.reverse()
    running: list[_Running] = []
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_start(store, waiting.pop()))
            wait([one.process.sentinel for one in running], 0.5)
            for one in list(running):
                if one.late:
                    one.process.kill()
                if one.late or not one.process.is_alive():
                    running.remove(one)
                    keep(_end(store, one))
    finally:
        for one in running:
            one.process.kill()
            one.process.join()


def _start(store: Store, part: Part) -> _Running:
    import multiprocessing

    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe(duplex=False)
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # read once, when the process loads its libraries
    try:
        process = spawn.Process(target=_work, args=(theirs, store, part), daemon=True)
        process.start()
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
    theirs.close()
    return _Running(part, process, ours, time.monotonic())


def _end(store: Store, one: _Running) -> Outcome:
    """What a process that has ended, or was ended, leaves."""
    late = one.late
    one.process.join()
    seconds = time.monotonic() - one.started
    try:
        reason = one.pipe.recv() if one.pipe.poll() else ""
    except (EOFError, OSError):
        reason = ""
    one.pipe.close()
    result = store.result(one.part)
    if result is None and not reason:
        store.spent(one.part, seconds)
        reason = f"took more than {one.part.timeout_s:.0f} s" if late else _death(one.process.exitcode)
    return Outcome(one.part, result, reason, seconds=seconds)


def _death(code: int | None) -> str:
    if code is not None and code < 0:
        return f"its process was ended by signal {signal.Signals(-code).name}"
    return f"its process ended with exit code {code}"


def _work(pipe: Connection[Any, Any], store: Store, part: Part) -> None:
    """The life of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent()
    os.dup2(2, 1)  # stdout belongs to the data of the command
    pipe.send(_do(store, part))
    pipe.close()


def _do(store: Store, part: Part) -> str:
    """Do a part and keep its result; the reason if it has none."""
    started = time.monotonic()
    folder = store.begin(part)
    try:
        module, name = part.task.split(":")
        result = getattr(importlib.import_module(module), name)(dict(part.arguments), folder)
    except SemslamError as error:
        store.spent(part, time.monotonic() - started)
        return error.in_a_line
    except Exception as error:
        store.spent(part, time.monotonic() - started)
        write_text(folder / _TRACEBACK, traceback.format_exc())
        return f"{type(error).__name__}: {error} (`{folder / _TRACEBACK}`)"
    (folder / _TRACEBACK).unlink(missing_ok=True)
    store.finish(part, result, time.monotonic() - started)
    return ""
