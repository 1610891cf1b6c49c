"""The output folder: what lies where, whether it may be used, and who is using it.

    OUT/
      semslam.json                 {"format": "semslam", "version": 1}
      config.json                  configuration of the last run, resolved
      logs/<log>.json              sources, configuration, and of each task: key, components, decision, failure
      logs/<log>.<stage>.traceback.txt   where an unexpected error came from
      cache/<stage>/<key>/         a finished entry: manifest.json, timing.json, shard-00000/<table>.parquet, ...
      cache/<stage>/.work-<key>/   the finished shards of an unfinished entry
      cache/digests.json           digests of input files, by path and stamp
      cache/index.json             what planning needs of every entry, by the stamp of its manifest
      cache/results.json           which entry each folder of results was copied from, and the stamps of the copies
      results/<log>/<variant>/     the files of the last stage under stable names
      results/evaluation.parquet   what `semslam evaluate` wrote last
      sites/                       what `semslam merge` wrote last
      .lock                        held by the run that works here, with its process id

Everything under `cache` but its three `.json` files is published by renaming a finished folder and never changed
afterwards. Those three are memories that only save reading, and may be deleted at any time.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from semslam.errors import SemslamError, UsageError
from semslam.pipeline.files import TEMPORARY, read_json, write_json

FORMAT = "semslam"
FORMAT_VERSION = 1
CHECK_PICTURE = ".check.png"
"""End of the names of pictures that `ingest --check` puts into a folder before any run does."""
_MARK = "semslam.json"
_LOCK = ".lock"
_LOCK_TRIES = 5
_LOCK_PAUSE_S = 0.02


@dataclass(frozen=True)
class OutputFolder:
    """Paths within an output folder that has been checked."""

    root: Path

    @property
    def cache(self) -> Path:
        """Entries of all stages."""
        return self.root / "cache"

    @property
    def logs(self) -> Path:
        """One record a log."""
        return self.root / "logs"

    @property
    def results(self) -> Path:
        """Files for people."""
        return self.root / "results"

    @property
    def sites(self) -> Path:
        """What a merge writes, if it is not told where."""
        return self.root / "sites"

    @property
    def config(self) -> Path:
        """Configuration of the last run."""
        return self.root / "config.json"

    def stage(self, name: str) -> Path:
        """Entries of one stage."""
        return self.cache / name

    def busy(self) -> bool:
        """Whether a run holds the folder now."""
        try:
            descriptor = os.open(self.root / _LOCK, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(descriptor)
        return False

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for one run; the lock ends with the process, however it ends.

        Raises:
            SemslamError: another run holds it.
        """
        path = self.root / _LOCK
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if not _try_lock(descriptor):
                raise _busy(self.root, path)
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
            yield
        finally:
            os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    """Lock at once or after a moment, which is as long as `busy` holds on to it."""
    for _ in range(_LOCK_TRIES):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(_LOCK_PAUSE_S)
    return False


def create_folder(root: Path) -> OutputFolder:
    """Open an output folder, making it if nothing is there.

    Raises:
        UsageError: it is a file, holds something else, or is of another format version.
    """
    if root.exists() and not root.is_dir():
        raise UsageError(f"`{root}` is a file, not a folder", hint="name another folder with `--out`")
    if not (root / _MARK).exists():
        _refuse_foreign(root)
        root.mkdir(parents=True, exist_ok=True)
        write_json(root / _MARK, {"format": FORMAT, "version": FORMAT_VERSION}, durable=True)
    folder = open_folder(root)
    for path in (folder.cache, folder.logs, folder.results):
        path.mkdir(exist_ok=True)
    return folder


def open_folder(root: Path) -> OutputFolder:
    """Open an output folder that exists.

    Raises:
        UsageError: there is none, or it is of another format version.
    """
    mark = root / _MARK
    if not mark.exists():
        raise UsageError(
            f"`{root}` is not an output folder of semslam: it has no `{_MARK}`",
            hint=f"make one with `semslam run LOG.mcap --out {root}`",
        )
    found = read_json(mark)
    version = found.get("version") if isinstance(found, dict) and found.get("format") == FORMAT else None
    if type(version) is not int:
        raise UsageError(
            f"Output folder `{root}` is marked by a damaged or unreadable `{_MARK}`",
            hint=f'if semslam made the folder, write {{"format": "{FORMAT}", "version": {FORMAT_VERSION}}} into '
            f"`{mark}`; else name another folder with `--out`",
        )
    if version != FORMAT_VERSION:
        raise UsageError(
            f"Output folder `{root}` is of format version {version}; this semslam reads version {FORMAT_VERSION}",
            hint="name another folder with `--out`, or use the version of semslam that wrote it",
        )
    return OutputFolder(root)


def _refuse_foreign(root: Path) -> None:
    """An unknown folder with content is not ours to write into."""
    if not root.exists():
        return
    content = sorted(n for n in os.listdir(root) if not n.startswith(TEMPORARY) and not n.endswith(CHECK_PICTURE))
    if content:
        shown = ", ".join(f"`{name}`" for name in content[:3]) + (", ..." if len(content) > 3 else "")
        raise UsageError(
            f"Folder `{root}` is not empty and no output folder of semslam: it holds {shown}",
            hint=f"name a new folder, such as `--out {root / 'semslam'}`",
        )


def _busy(root: Path, lock: Path) -> SemslamError:
    try:
        holder = lock.read_text().strip()
    except OSError:
        holder = ""
    who = f"process {holder}" if holder else "another process"
    return SemslamError(
        f"Output folder `{root}` is in use by {who}",
        hint=f"wait for it to end, stop it with `kill {holder or 'PID'}`, or name another folder with `--out`",
    )
