"""The folder that `merge` writes: whole or not at all, never in the place of what somebody else put there.

It is made beside its target and renamed into place. What it replaces waits under another name until that is done, and
is put back if it was cut short.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from semslam.errors import SemslamError, UsageError
from semslam.pipeline.digest import sha256_file
from semslam.pipeline.files import TEMPORARY, files_below, read_json, remove, write_json
from semslam.pipeline.folder import OutputFolder

MARK = "merge.json"
MERGE_FORMAT = "semslam-sites"
MERGE_VERSION = 3
"""Rises whenever the same logs give other files."""


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A new folder to write into, which is put in place at the end if nothing went wrong."""
    temporary = target.with_name(f"{TEMPORARY}{target.name}-{os.getpid()}")
    remove(temporary)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        _put(temporary, target)
    finally:
        remove(temporary)


def mark(folder: Path, key: str, warnings: Sequence[str]) -> None:
    """Say what the folder was made of, and what lies in it."""
    about = {"format": MERGE_FORMAT, "version": MERGE_VERSION, "key": key, "warnings": list(warnings)}
    write_json(folder / MARK, {**about, "files": dict(_digests(folder))}, durable=True)


def untouched(folder: Path, key: str) -> bool:
    """Whether the folder was made of this, and still holds what was written."""
    known = read_json(folder / MARK)
    if not isinstance(known, dict) or known.get("key") != key or not isinstance(known.get("warnings"), list):
        return False
    return not any(changed(folder, lambda _: None, ""))


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Errors of writing that name no file, such as that of a full disk, name the folder."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        error.filename = error.filename or str(target)
        raise


def changed(folder: Path, seen: Callable[[int], None], again: str) -> Iterator[tuple[Path, str]]:
    """Files of a finished folder that are not what was written, what is wrong with each, and what to do; none of a
    folder that is not there. `again` names the command that merges, `seen` is told the bytes of every block."""
    known = read_json(folder / MARK)
    files = known.get("files") if isinstance(known, dict) else None
    if not isinstance(files, dict):
        if any(files_below(folder)):
            yield folder / MARK, f"missing or damaged; remove the folder, then {again} makes it anew"
        return
    for name in sorted(files):
        path = folder / name
        try:
            if not path.is_file():
                yield path, f"missing; {again} makes it anew"
            elif sha256_file(path, seen) != files[name]:
                yield path, f"damaged: its content is not what was stored; {again} makes it anew"
        except OSError as error:
            yield path, f"cannot be read: {error.strerror}"
    for path in files_below(folder):
        if path != folder / MARK and str(path.relative_to(folder)) not in files:
            yield path, "nobody stored it here; move it elsewhere"


def notes_of(folder: Path) -> list[str]:
    """The warnings of an untouched folder."""
    known = read_json(folder / MARK)
    return [str(note) for note in known["warnings"]] if isinstance(known, dict) else []


def refuse(target: Path, out: OutputFolder) -> None:
    """What no merge wrote is not ours to replace, and nothing is written where other commands keep theirs.

    Raises:
        UsageError: there is something else, or the folder would lie within that of the run.
    """
    own = out.sites.parent.resolve() / out.sites.name
    inside = target.resolve()
    if inside != own and inside.is_relative_to(out.root.resolve()):
        raise UsageError(f"`{target}` lies within output folder `{out.root}`", hint=f"leave `--into` out for `{own}`")
    if target.is_symlink():
        raise UsageError(f"`{target}` is a link", hint="name the folder it leads to with `--into`, or remove the link")
    if not target.exists():
        return
    if not target.is_dir():
        raise UsageError(f"`{target}` is a file", hint=f"name a new folder, such as `--into {target}_sites`")
    _refuse_strange(target)


def _refuse_strange(target: Path) -> None:
    """A folder that holds anything that no merge put there."""
    known = read_json(target / MARK)
    if any(target.iterdir()) and not (isinstance(known, dict) and known.get("format") == MERGE_FORMAT):
        raise UsageError(
            f"`{target}` is not empty and no folder of `semslam merge`, or its `{MARK}` is damaged",
            hint=f"remove it, or name a new folder, such as `--into {target}_sites`",
        )
    ours = known.get("files") if isinstance(known, dict) else None
    listed = set(ours) if isinstance(ours, dict) else set()
    for path in sorted(target.rglob("*")):
        name = str(path.relative_to(target))
        if not (path.is_dir() and not path.is_symlink()) and name != MARK and name not in listed:
            raise UsageError(
                f"`{path}` was not written by `semslam merge`, which would replace the whole folder",
                hint=f"move it elsewhere, or name a new folder, such as `--into {target}_sites`",
            )


def recover(target: Path) -> None:
    """Put the folder back that was about to be replaced when that was cut short, and remove what killed merges left."""
    old = _before(target)
    if old.exists() and not target.exists():
        old.rename(target)
    for stale in sorted(target.parent.glob(f"{TEMPORARY}{target.name}-*")):
        if not _alive(stale.name.rpartition("-")[2]):
            remove(stale)


def _alive(pid: str) -> bool:
    """Whether the process that made a temporary folder still runs, as far as can be known."""
    if not pid.isdigit():
        return True
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _before(target: Path) -> Path:
    """Where the folder that is replaced waits; `clean` leaves it alone."""
    return target.with_name(f".{target.name}-before")


def _put(temporary: Path, target: Path) -> None:
    """Rename the folder into place; the one before goes away once the new one is there."""
    old = _before(target)
    remove(old)
    try:
        if target.exists():
            target.rename(old)
        temporary.rename(target)
    except BaseException:
        if old.exists() and not target.exists():
            old.rename(target)
        raise
    with suppress(OSError, SemslamError):  # what stays of it is in nobody's way
        remove(old)


def _digests(folder: Path) -> Iterator[tuple[str, str]]:
    """SHA-256 of all files but the mark."""
    for path in files_below(folder):
        if path != folder / MARK:
            yield str(path.relative_to(folder)), sha256_file(path)
