"""Names of a detector's classes, from its metadata or from a text file."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError

_KEYS = ("names", "classes", "labels", "class_names")


def names_from_file(path: Path) -> list[str]:
    """One name a line; blank lines, spaces, Windows line ends and a byte order mark do not count.

    Raises:
        SemslamError: the file cannot be read as text, or names none, or one twice.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise SemslamError(
            f"Class file `{path}` cannot be read: {reason}", hint="give a text file, a name a line"
        ) from error
    names = [line.strip() for line in lines if line.strip()]
    if not names:
        raise SemslamError(f"Class file `{path}` names no class", hint="give a text file, a name a line")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SemslamError(f"Class file `{path}` names `{twice[0]}` twice", hint="class names must differ")
    return names


def names_from_metadata(metadata: Mapping[str, str]) -> list[str] | None:
    """Names in a model's metadata, as JSON, a Python literal or a comma-separated list; None if there are none.

    Raises:
        SemslamError: names by number leave numbers out.
    """
    for key in _KEYS:
        if metadata.get(key, "").strip():
            names = _parsed(metadata[key].strip())
            if names:
                return names
    return None


def _parsed(text: str) -> list[str]:
    value: Any = None
    for parse in (json.loads, ast.literal_eval):
        try:
            value = parse(text)
            break
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            continue
    if isinstance(value, dict):
        return _by_number(value)
    if isinstance(value, list | tuple):
        return [str(name) for name in value]
    return [part.strip() for part in text.split(",") if part.strip()] if "," in text and "{" not in text else []


def _by_number(names: Mapping[Any, Any]) -> list[str]:
    try:
        numbered = {int(key): str(name) for key, name in names.items()}
    except (TypeError, ValueError):
        return []
    if sorted(numbered) != list(range(len(names))):
        raise SemslamError(
            f"The model's metadata names classes {', '.join(map(str, sorted(numbered)[:8]))} and leaves others out",
            hint="give all names with `--classes FILE.txt`",
        )
    return [numbered[number] for number in range(len(names))]
