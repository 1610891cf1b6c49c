"""The folder of a data set: what lies where, what of it is finished, and who is working in it.

    OUT/
      plan.json             recipe, versions; of every log its recording, size and SHA-256 (null until it is made)
      splits.parquet        data_spec.md, table 12
      logs/NAME.mcap        nothing else lies here, so that `semslam run OUT/logs` takes the data set
      truth/NAME/           tables of exact truth
      receipts/NAME.json    proof that a log is finished: its key, sizes and SHA-256 of its files, objects of its frames
      .lock                 held by the command that works here

Every file is whole or absent. A receipt is written last, by the worker that made the log.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError, UsageError
from semslam.sim.dataset import Recipe, Recording, as_json, differences, versions

FORMAT, FORMAT_VERSION = "semslam data set", 1
_PLAN, _LOCK = "plan.json", ".lock"
_LOCK_TRIES, _LOCK_PAUSE_S = 5, 0.02
_BLOCK_BYTES = 1 << 20


@dataclass(frozen=True)
class Receipt:
    """Proof that a log and its truth are finished."""

    log: str
    key: str
    """`Recording.key` of what was recorded."""
    files: dict[str, tuple[int, str]]
    """Bytes and SHA-256 by path within the data set; the log is the first."""
    visible: tuple[int, ...]
    """Objects in view, keyframe by keyframe."""

    @property
    def bytes(self) -> int:
        """Of all files together."""
        return sum(size for size, _ in self.files.values())


@dataclass(frozen=True)
class DataSetFolder:
    """Paths of a data set, and what is known of them."""

    root: Path

    @property
    def logs(self) -> Path:
        """The logs and nothing else."""
        return self.root / "logs"

    def log(self, name: str) -> Path:
        """File of a log."""
        return self.logs / f"{name}.mcap"

    def truth(self, name: str) -> Path:
        """Folder of a log's true tables."""
        return self.root / "truth" / name

    def receipt(self, name: str) -> Path:
        """Where the receipt of a log lies."""
        return self.root / "receipts" / f"{name}.json"

    @property
    def splits(self) -> Path:
        """Which logs train and which test."""
        return self.root / "splits.parquet"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder; the lock ends with the process, however it ends.

        Raises:
            SemslamError: another command holds it.
        """
        path = self.root / _LOCK
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock(descriptor, self.root)
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
            yield
            os.ftruncate(descriptor, 0)  # or else two data sets would differ by this
        finally:
            os.close(descriptor)

    def stored_plan(self) -> dict[str, Any] | None:
        """What `plan.json` holds; None if there is none.

        Raises:
            SemslamError: it is damaged or of another format version.
        """
        path = self.root / _PLAN
        if not path.exists():
            return None
        found: dict[str, Any] = _read_json(path)
        if not _is_plan(found):
            raise SemslamError(f"`{path}` is damaged or no plan of a data set", hint="name another folder")
        if found.get("version") != FORMAT_VERSION:
            raise SemslamError(
                f"`{path}` is of format version {found.get('version')}; this semslam knows version {FORMAT_VERSION}",
                hint="name another folder, or use the version of semslam that wrote it",
            )
        return found

    def write_plan(self, recipe: Recipe, recordings: Sequence[Recording], receipts: dict[str, Receipt]) -> None:
        """Write what the data set is made of, and of its finished logs size and digest."""
        logs = [
            {**asdict(one), "bytes": size, "sha256": digest}
            for one in recordings
            for size, digest in [_log_file(receipts.get(one.name))]
        ]
        plan = {"format": FORMAT, "version": FORMAT_VERSION, "recipe": as_json(recipe), "versions": versions()}
        write_json(self.root / _PLAN, {**plan, "logs": logs})

    def finished(self, recording: Recording, *, verify: bool = False) -> Receipt | None:
        """The receipt of a log that is as the recording wants it; `verify` reads all its files, else sizes must do."""
        receipt = self.claimed(recording)
        for name, (size, digest) in receipt.files.items() if receipt else ():
            path = self.root / name
            if not path.is_file() or path.stat().st_size != size or (verify and sha256_file(path) != digest):
                return None
        return receipt

    def claimed(self, recording: Recording) -> Receipt | None:
        """The receipt of a log for just this recording, whatever became of its files."""
        receipt = _as_receipt(_read_json(self.receipt(recording.name)))
        return receipt if receipt and (receipt.log, receipt.key) == (recording.name, recording.key()) else None

    def forget(self, name: str) -> None:
        """Remove a log and all that belongs to it, receipt first."""
        self.receipt(name).unlink(missing_ok=True)
        self.log(name).unlink(missing_ok=True)
        shutil.rmtree(self.truth(name), ignore_errors=True)

    def ours(self) -> set[str]:
        """Names of logs that were made here, finished or not."""
        stored = self.stored_plan() or {}
        return {str(one.get("name")) for one in stored.get("logs", ())} | _stems(self.root / "receipts")

    def strangers(self, recordings: Sequence[Recording]) -> list[str]:
        """Files among the logs that were not made here and will not be."""
        known = self.ours() | {one.name for one in recordings}
        return sorted(path.name for path in _visible(self.logs) if path.stem not in known or path.suffix != ".mcap")

    def clear_leftovers(self) -> None:
        """Remove all unfinished files. Only while the folder is locked and no worker works: then nobody needs them."""
        for folder in (self.root, self.logs, self.root / "truth", self.root / "receipts"):
            for path in folder.glob(".*.partial-*"):
                _remove(path)


def open_data_set(root: Path) -> DataSetFolder:
    """The folder, made if nothing is there.

    Raises:
        UsageError: it is a file, holds something else, or cannot be written to.
    """
    if root.exists() and not root.is_dir():
        raise UsageError(
            f"`{root}` is a file, not a folder", hint="name another folder, as in `semslam simulate homes`"
        )
    folder = DataSetFolder(root)
    try:
        if not (root / _PLAN).exists():
            _refuse_foreign(root)
        for path in (folder.logs, root / "truth", root / "receipts"):
            path.mkdir(parents=True, exist_ok=True)
        with folder.locked():
            pass
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        hint = f"look at the permissions with `ls -ld {root.parent}`, or name another folder"
        raise UsageError(f"Cannot write to `{root}`: {error.strerror}", hint=hint) from error
    return folder


def refuse_changes(folder: DataSetFolder, recipe: Recipe) -> None:
    """Refuse to mix logs of two recipes or of two versions in one folder.

    Raises:
        SemslamError: the folder's logs were made otherwise, or there are more than the recipe asks for.
    """
    stored = folder.stored_plan()
    if found := [] if stored is None else differences(stored, recipe):
        raise SemslamError(
            f"Data set `{folder.root}` was made otherwise than asked for now",
            details="\n".join(f"  {line}" for line in found),
            hint="name another folder, or let `--replace` make anew what differs and remove what is not asked for",
        )


def refuse_strangers(folder: DataSetFolder, recordings: Sequence[Recording]) -> None:
    """Refuse to leave a log among the others, or to remove one, that was not made here.

    Raises:
        SemslamError: there is one.
    """
    if found := folder.strangers(recordings):
        shown = ", ".join(f"`{name}`" for name in found[:3]) + (", ..." if len(found) > 3 else "")
        raise SemslamError(
            f"Among the logs of data set `{folder.root}` lies what was not made there: {shown}",
            hint=f"move it out of `{folder.logs}`",
        )


def _is_plan(found: Any) -> bool:
    """If something read from JSON has the shape of a plan."""
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        return False
    logs = found.get("logs")
    shaped = isinstance(found.get("recipe"), dict) and isinstance(found.get("versions"), dict)
    return shaped and isinstance(logs, list) and all(isinstance(one, dict) for one in logs)


def write_json(path: Path, value: Any) -> None:
    """Replace `path` by readable JSON, whole or not at all."""
    temporary = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_receipt(folder: DataSetFolder, receipt: Receipt) -> None:
    """Say that a log is finished, once it is on the disk."""
    value = {**asdict(receipt), "files": {name: list(entry) for name, entry in receipt.files.items()}}
    write_json(folder.receipt(receipt.log), value)


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    state = hashlib.sha256()
    with path.open("rb", buffering=0) as file:
        while block := file.read(_BLOCK_BYTES):
            state.update(block)
    return state.hexdigest()


def _as_receipt(value: Any) -> Receipt | None:
    """A stored receipt; None if it is none."""
    try:
        files = {str(name): (int(size), str(digest)) for name, (size, digest) in value["files"].items()}
        receipt = Receipt(str(value["log"]), str(value["key"]), files, tuple(map(int, value["visible"])))
        return receipt if next(iter(files), "") == f"logs/{receipt.log}.mcap" else None
    except (TypeError, KeyError, ValueError, AttributeError):
        return None


def _log_file(receipt: Receipt | None) -> tuple[int | None, str | None]:
    return (None, None) if receipt is None else next(iter(receipt.files.values()))


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None


def _visible(folder: Path) -> Iterator[Path]:
    return (path for path in folder.glob("*") if not path.name.startswith("."))


def _stems(folder: Path) -> set[str]:
    return {path.stem for path in _visible(folder)}


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _refuse_foreign(root: Path) -> None:
    """An unknown folder with content is not ours to write into."""
    content = sorted(name for name in os.listdir(root) if not name.startswith(".")) if root.exists() else []
    empty = {name for name in content if name in ("logs", "truth", "receipts") and not any((root / name).iterdir())}
    if foreign := [name for name in content if name not in empty]:
        shown = ", ".join(f"`{name}`" for name in foreign[:3]) + (", ..." if len(foreign) > 3 else "")
        raise UsageError(
            f"Folder `{root}` is not empty and no data set of semslam: it holds {shown}",
            hint=f"name a new folder, such as `semslam simulate {root / 'homes'}`",
        )


def _lock(descriptor: int, root: Path) -> None:
    for _ in range(_LOCK_TRIES):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            time.sleep(_LOCK_PAUSE_S)
    holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip()
    raise SemslamError(
        f"Data set `{root}` is in use by {f'process {holder}' if holder else 'another process'}",
        hint=f"wait for it to end, stop it with `kill {holder or 'PID'}`, or name another folder",
    )
