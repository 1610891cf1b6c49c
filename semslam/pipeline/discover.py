"""From what the user names (files, folders, globs) to logs with unique names.

Split recordings that belong together are one log: `NAME_0.mcap`, `NAME_1.mcap`, ... in one folder, numbered from 0
without a gap, or any numbers beside the `metadata.yaml` that rosbag2 writes. A file named alone is a log alone.
"""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, pairwise
from pathlib import Path

from semslam.errors import UsageError

_SPLIT = re.compile(r"(?P<name>.+)_(?P<number>\d+)\.mcap\Z", re.IGNORECASE)
_FOREIGN = {".bag", ".db3"}


@dataclass(frozen=True)
class Log:
    """A recording: its name in the output folder and its files in recording order."""

    name: str
    sources: tuple[Path, ...]


@dataclass(frozen=True)
class Problem:
    """Something found in a folder that looks like a log and cannot be read."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Discovery:
    """Logs sorted by name, what had to be left out, and which parts of split recordings seem to be missing."""

    logs: tuple[Log, ...]
    problems: tuple[Problem, ...]
    warnings: tuple[str, ...] = ()


def discover(names: Sequence[str], known: Mapping[str, Sequence[str]] | None = None) -> Discovery:
    """Find the logs behind files, folders (searched for *.mcap) and globs.

    `known` holds the sources of the logs that the output folder has by name: such a log keeps its name, and another
    log does not take it while the files of the first still exist.

    Raises:
        UsageError: a name leads to nothing, or to a file that is no log.
    """
    problems: list[Problem] = []
    files: dict[str, Path] = {}
    for name in names:
        for path in _expand(name, problems):
            files.setdefault(os.path.realpath(path), Path(os.path.abspath(path)))
    if not files and not problems:
        raise UsageError("No logs were named", hint="name files, folders or globs, such as `semslam run logs/`")
    groups = sorted(_grouped(files.values()))
    return Discovery(tuple(_named(groups, known or {})), tuple(problems), tuple(_gaps(files.values())))


def _expand(name: str, problems: list[Problem]) -> Iterator[Path]:
    """The files behind one name."""
    path = Path(name).expanduser()
    if path.is_dir():
        yield from _search(path, problems)
    elif path.exists():
        yield _accepted(path)
    elif glob.has_magic(name):
        yield from _globbed(name, problems)
    elif path.is_symlink():
        raise UsageError(f"`{name}` is a broken link to `{os.readlink(path)}`", hint="repair it or name the log itself")
    else:
        raise UsageError(f"No such file or folder: `{name}`", hint=_sibling_hint(path))


def _accepted(path: Path) -> Path:
    if path.suffix.lower() in _FOREIGN:
        raise UsageError(
            f"`{path}` is a {path.suffix} recording; only MCAP logs are read",
            hint=f"convert it with `mcap convert {path} {path.with_suffix('.mcap')}`",
        )
    if not os.access(path, os.R_OK):
        raise UsageError(f"`{path}` may not be read by this user", hint=f"`chmod +r {path}`")
    return path


def _globbed(pattern: str, problems: list[Problem]) -> Iterator[Path]:
    found = sorted(glob.glob(os.path.expanduser(pattern), recursive=True))
    if not found:
        raise UsageError(f"Nothing matches `{pattern}`", hint="name a folder to search it for *.mcap")
    for path in map(Path, found):
        if path.is_dir():
            yield from _search(path, problems, may_be_empty=True)
        elif reason := _unreadable(path):
            problems.append(Problem(path, reason))
        elif path.suffix.lower() not in _FOREIGN:
            yield path


def _search(folder: Path, problems: list[Problem], *, may_be_empty: bool = False) -> Iterator[Path]:
    """All *.mcap below a folder, through links to folders too, none twice."""
    found_any, seen = False, set()
    for parent, folders, names in os.walk(folder, followlinks=True, onerror=lambda e: _note(problems, e)):
        real = os.path.realpath(parent)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders.sort()
        for name in sorted(names):
            if not name.lower().endswith(".mcap"):
                continue
            found_any = True
            path = Path(parent, name)
            if reason := _unreadable(path):
                problems.append(Problem(path, reason))
            else:
                yield path
    if not found_any and not may_be_empty and not problems:
        raise UsageError(f"No *.mcap in folder `{folder}`", hint="name the log files or another folder")


def _note(problems: list[Problem], error: OSError) -> None:
    problems.append(Problem(Path(error.filename), error.strerror or "cannot be searched"))


def _unreadable(path: Path) -> str:
    """Why a file cannot be read; empty if it can."""
    if path.is_symlink() and not path.exists():
        return f"a broken link to `{os.readlink(path)}`"
    if not path.is_file():
        return "not a file"
    return "" if os.access(path, os.R_OK) else "may not be read by this user"


def _sibling_hint(path: Path) -> str:
    import difflib  # only a mistyped name pays for the import

    try:
        beside = os.listdir(path.parent)
    except OSError:
        return f"there is no folder `{path.parent}` either"
    close = difflib.get_close_matches(path.name, beside, n=1, cutoff=0.75)
    return f"did you mean `{path.parent / close[0]}`?" if close else "check the path, or name a folder"


def _grouped(files: Iterable[Path]) -> Iterator[tuple[Path, ...]]:
    """Files as logs: split recordings together in recording order, all others alone."""
    paths = list(files)
    yield from ((path,) for path in paths if not _SPLIT.match(path.name))
    for parts in _numbered(paths):
        if _belong_together(parts):
            yield tuple(path for _, path in parts)
        else:
            yield from ((path,) for _, path in parts)


def _numbered(files: Iterable[Path]) -> list[list[tuple[int, Path]]]:
    """Files called NAME_NUMBER.mcap with their numbers, rising, those of one NAME in one folder together."""
    splits: dict[tuple[Path, str], list[tuple[int, Path]]] = {}
    for path in files:
        if match := _SPLIT.match(path.name):
            splits.setdefault((path.parent, match["name"]), []).append((int(match["number"]), path))
    return [sorted(parts) for parts in splits.values()]


def _belong_together(parts: Sequence[tuple[int, Path]]) -> bool:
    consecutive = [number for number, _ in parts] == list(range(len(parts)))
    return len(parts) > 1 and (consecutive or (parts[0][1].parent / "metadata.yaml").exists())


def _gaps(files: Iterable[Path]) -> Iterator[str]:
    """A sentence for every gap in the numbers of what is, or would be, a split recording."""
    for parts in sorted(_numbered(files), key=lambda parts: parts[0][1]):
        if len(parts) < 2 or not (parts[0][0] == 0 or _belong_together(parts)):
            continue
        apart = "" if _belong_together(parts) else f"; they are taken as {len(parts)} logs"
        if parts[0][0] > 0:
            yield f"{_missing(parts[0][1], 0, parts[0][0])} missing before `{parts[0][1].name}`"
        for (low, before), (high, after) in pairwise(parts):
            if high > low + 1:
                yield f"{_missing(before, low + 1, high)} missing between `{before.name}` and `{after.name}`{apart}"


def _missing(like: Path, start: int, stop: int) -> str:
    """Names of the parts [start, stop), with the verb, written as the name of the part `like`."""
    match = _SPLIT.match(like.name)
    digits = match["number"] if match else ""
    width = len(digits) if digits.startswith("0") else 0
    names = [f"`{match['name'] if match else ''}_{number:0{width}d}.mcap`" for number in (start, stop - 1)]
    return f"{names[0]} is" if stop == start + 1 else f"{names[0]} to {names[1]} are"


def _named(groups: Sequence[tuple[Path, ...]], known: Mapping[str, Sequence[str]]) -> list[Log]:
    """Give every log a name of its own, its stem if that is free, else with as many parent folders as it takes."""
    kept = {tuple(sources): name for name, sources in known.items()}
    names = {group: kept[key] for group in groups if (key := tuple(map(str, group))) in kept}
    taken = {name for name, sources in known.items() if any(os.path.exists(path) for path in sources)}
    waiting = [group for group in groups if group not in names]
    depth = 0
    while waiting:
        wanted = {group: _name(group, depth) for group in waiting}
        counts = Counter(wanted.values())
        for group, name in wanted.items():
            if counts[name] == 1 and name not in taken:
                names[group] = name
            elif depth > len(group[0].parts):  # names that differ only in characters a folder cannot have
                names[group] = next(free for n in count(2) if (free := f"{name}-{n}") not in taken)
            taken |= {names[group]} if group in names else set()
        waiting = [group for group in waiting if group not in names]
        depth += 1
    return sorted((Log(name, group) for group, name in names.items()), key=lambda log: log.name)


def _name(group: tuple[Path, ...], depth: int) -> str:
    """Name of a log with `depth` parent folders before its stem; plain enough for a folder name."""
    first = group[0]
    match = _SPLIT.match(first.name)
    stem = match["name"] if match and len(group) > 1 else re.sub(r"\.mcap\Z", "", first.name, flags=re.IGNORECASE)
    parents = [part for part in first.parts[:-1] if part != os.sep]
    parts = [*parents[len(parents) - min(depth, len(parents)) :], stem]
    return re.sub(r"[^\w.+=@-]", "_", "-".join(parts)).lstrip(".") or "log"
