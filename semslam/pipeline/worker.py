"""One job, from its work folder to a published entry, or to a description of what went wrong.

Nothing is thrown at whoever runs it: every exception becomes a `Failure`, because one bad log must not stop the others.
"""

from __future__ import annotations

import importlib.metadata
import platform
import re
import sysconfig
import time
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path

import semslam
from semslam.errors import SemslamError
from semslam.pipeline.cache import DamagedEntryError, Work, build_manifest
from semslam.pipeline.context import Context, max_rss_bytes
from semslam.pipeline.digest import FileStamp
from semslam.pipeline.failure import Failure
from semslam.pipeline.files import out_of_space
from semslam.pipeline.job import Job, Outcome


def execute(job: Job, report: Callable[[int, int | None], None]) -> Outcome:
    """Run the job to its end; `report` is told units done and their total."""
    start = time.monotonic()
    resumed = 0
    failure, full = None, False
    try:
        resumed = _run(job, report)
    except Exception as error:  # whatever a stage or a library throws belongs to this task alone
        failure, full = describe(error), out_of_space(error)
    return Outcome(job.number, failure, time.monotonic() - start, max_rss_bytes(), resumed, full)


def _run(job: Job, report: Callable[[int, int | None], None]) -> int:
    """Make and publish the entry; returns the number of shards that were there already."""
    work = Work(job.stage_folder, job.key)
    try:
        resumed = len(work.shards)
        job.stage.load()(Context(job, work, report))
        if not work.shards:
            raise ValueError(f"stage {job.stage.name} ended without writing a shard")
        _check_unchanged(job)
        work.finish(
            build_manifest(job.stage.name, job.stage.version, job.variant, job.components, work.shards, provenance())
        )
        return resumed
    finally:
        work.close()


def _check_unchanged(job: Job) -> None:
    """Refuse to publish under a key that was made from another content."""
    for path, stamp in job.guards:
        if not FileStamp.of(path).same_content(stamp):
            raise SemslamError(
                f"`{path}` changed while it was read", hint="run the same command again once nothing writes it any more"
            )


def describe(error: Exception) -> Failure:
    """What to tell and to keep of an exception."""
    if isinstance(error, DamagedEntryError):
        return Failure("damaged", error.message, error.hint, error.details, entry=str(error.entry))
    if isinstance(error, SemslamError):
        return Failure("refused", error.message, error.hint, error.details)
    if isinstance(error, MemoryError):
        return Failure("memory", "Not enough memory", "run with fewer `--workers`", str(error))
    frames = traceback.extract_tb(error.__traceback__)
    last = next((frame for frame in reversed(frames) if _ours(frame.filename)), frames[-1])
    said = " ".join(str(error).split())[:500]
    message = f"{type(error).__name__} in {_place(last.filename)}:{last.lineno}: {said}"
    trace = "".join(traceback.format_exception(error))
    return Failure("unexpected", message, "this is a bug; report it with the traceback", "", trace)


def _ours(filename: str) -> bool:
    """Whether a file of a traceback belongs to semslam or to a stage, rather than to a library."""
    libraries = tuple(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
    return "/semslam/" in filename or not filename.startswith((*libraries, "<"))


def _place(filename: str) -> str:
    """The file of a traceback from its package on."""
    parts = Path(filename).parts
    start = parts.index("site-packages") + 1 if "site-packages" in parts else max(0, len(parts) - 3)
    return "/".join(parts[start:])


@cache
def provenance() -> dict[str, str]:
    """Versions of semslam, Python and every library it requires."""
    versions = {"semslam": semslam.__version__, "python": platform.python_version()}
    try:
        required = importlib.metadata.requires("semslam") or []
    except importlib.metadata.PackageNotFoundError:  # run from a source tree that is not installed
        return versions
    for requirement in required:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        if "extra ==" not in requirement:
            versions[name] = importlib.metadata.version(name)
    return versions
