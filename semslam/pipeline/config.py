"""Configuration: TOML, `--set` and options into the frozen dataclasses of the stages, and back into TOML.

Values are checked against type, range and choices of their fields (stages/settings.py); a wrong key or value is a
UsageError that names the key, the value, and what is allowed or nearest. Files named in a configuration file are taken
relative to it, others relative to the working folder.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from semslam.errors import UsageError
from semslam.models.builtin import with_shipped
from semslam.pipeline.files import canonical_json
from semslam.stages.contract import Stage
from semslam.stages.settings import ExtractConfig


@dataclass(frozen=True)
class Config:
    """The resolved configuration of a run: one dataclass a stage, by stage name."""

    sections: Mapping[str, Any]

    def of(self, stage: Stage) -> Any:
        """The stage's own configuration."""
        return self.sections[stage.name]

    def variants(self, stage: Stage) -> tuple[str, ...]:
        """Names of the stage's variants; one empty name for a stage without."""
        return tuple(getattr(self.of(stage), stage.variants)) if stage.variants else ("",)

    def for_variant(self, stage: Stage, variant: str) -> Any:
        """The configuration of one task of the stage, with the shipped models that it may use named."""
        section = self.of(stage)
        return with_shipped(section.for_variant(variant) if stage.variants else section)

    def as_json(self) -> dict[str, Any]:
        """Plain values, with paths as they are."""
        return {name: plain(section) for name, section in self.sections.items()}


@dataclass(frozen=True)
class _Where:
    """What a value is called in a message, and where relative paths start."""

    source: str
    base: Path

    def error(self, message: str, hint: str) -> UsageError:
        place = f" in {self.source}" if self.source else ""
        return UsageError(f"{message}{place}", hint=hint)


def load_config(
    stages: Sequence[Stage],
    file: Path | None = None,
    assignments: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
    stored: Mapping[str, Any] | None = None,
) -> Config:
    """Resolve defaults, then the file, then `--set KEY=VALUE`, then options given as {"section.key": value}.

    Args:
        stored: an earlier configuration as `Config.as_json` gave it, in the place of the defaults.

    Raises:
        UsageError: the file cannot be read, or a key or value is wrong.
    """
    values: dict[str, dict[str, Any]] = {stage.name: {} for stage in stages}
    classes = {stage.name: stage.config for stage in stages}
    _merge(values, _checked(classes, stored or {}, _Where("the stored configuration", Path.cwd())))
    if file is not None:
        _merge(values, _checked(classes, _read_toml(file), _Where(f"`{file}`", file.resolve().parent)))
    for text in assignments:
        _merge(values, _checked(classes, _assignment(classes, text), _Where(f"`--set {text}`", Path.cwd())))
    for key, value in (options or {}).items():
        _merge(values, _checked(classes, _nested(key, value), _Where("", Path.cwd())))
    config = Config({stage.name: _build(stage.config, values[stage.name]) for stage in stages})
    for stage in stages:
        _check_variants(stage, config)
        _check_across(config.of(stage))
    return config


def plain(value: Any) -> Any:
    """A configuration as plain JSON values."""
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, tuple) else value


def file_settings(section: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """(dotted key, path) of every setting that names a file."""
    for item in fields(section):
        value = getattr(section, item.name)
        if is_dataclass(value):
            yield from file_settings(value, f"{prefix}.{item.name}")
        elif item.metadata.get("file") and value:
            yield f"{prefix}.{item.name}", value


def as_toml(config: Config, *, comments: bool = True) -> str:
    """The configuration as TOML, each key under its documentation."""
    tables = (_toml_table(name, section, comments) for name, section in config.sections.items())
    return "\n".join(tables)


# --- reading


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(
            f"No configuration file `{file}`", hint=f"write one with `semslam config show > {file}`"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"Configuration file `{file}` cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise UsageError(
            f"Configuration file `{file}` is no TOML: {error}", hint="`semslam config show` prints a complete example"
        ) from None


def _assignment(classes: Mapping[str, type[Any]], text: str) -> dict[str, Any]:
    """`section.key=value` as a nested dict; the value is TOML, or text where that is no TOML."""
    key, equals, raw = text.partition("=")
    if not equals or "." not in key:
        raise UsageError(f"`--set {text}` is not of the form section.key=value", hint="`--set extract.min_score=0.4`")
    try:
        value = tomllib.loads(f"value = {raw}")["value"]
    except tomllib.TOMLDecodeError:
        value = raw
    kind = _kind_of(classes, key.strip().split("."))
    if kind is str and not isinstance(value, str):
        value = raw
    if get_origin(kind) is tuple and not isinstance(value, list):
        value = [part.strip() for part in raw.split(",") if part.strip()]
    return _nested(key.strip(), value)


def _kind_of(classes: Mapping[str, type[Any]], parts: Sequence[str]) -> Any:
    """Type of the setting with this dotted key; None if there is none."""
    kind: Any = classes.get(parts[0])
    for part in parts[1:]:
        kind = get_type_hints(kind).get(part) if is_dataclass(kind) else None
    return kind


def _nested(key: str, value: Any) -> dict[str, Any]:
    for part in reversed(key.split(".")):
        value = {part: value}
    nested: dict[str, Any] = value
    return nested


def _merge(into: dict[str, Any], values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = dict(value) if isinstance(value, Mapping) else value


def _build(kind: type[Any], values: Mapping[str, Any]) -> Any:
    """The dataclass with `values` over its defaults."""
    hints = get_type_hints(kind)
    given = {n: _build(hints[n], v) if is_dataclass(hints[n]) else v for n, v in values.items()}
    return kind(**given)


# --- checking


def _checked(classes: Mapping[str, type[Any]], values: Mapping[str, Any], where: _Where) -> dict[str, Any]:
    checked = {}
    for name, section in values.items():
        if name not in classes:
            raise where.error(f"Unknown section `[{name}]`", _nearest(name, classes, "sections", _owners(classes)))
        if not isinstance(section, Mapping):
            raise where.error(
                f"`{name}` must be a section, found {_shown(section)}", f"write `[{name}]` and keys below"
            )
        checked[name] = _checked_section(classes[name], name, section, where)
    return checked


def _checked_section(kind: type[Any], prefix: str, values: Mapping[str, Any], where: _Where) -> dict[str, Any]:
    hints = get_type_hints(kind)
    known = {item.name: item for item in fields(kind)}
    checked: dict[str, Any] = {}
    for name, value in values.items():
        key = f"{prefix}.{name}"
        if name not in known:
            raise where.error(f"Unknown key `{key}`", _nearest(name, known, f"keys of [{prefix}]"))
        if is_dataclass(hints[name]):
            if not isinstance(value, Mapping):
                raise where.error(f"`{key}` must be a section, found {_shown(value)}", f"write `[{key}]`")
            checked[name] = _checked_section(_as_class(hints[name]), key, value, where)
        else:
            checked[name] = _checked_value(known[name], hints[name], key, value, where)
    return checked


def _as_class(kind: Any) -> type[Any]:
    found: type[Any] = kind
    return found


def _checked_value(item: Field[Any], kind: Any, key: str, value: Any, where: _Where) -> Any:
    """The value in the field's own type, once it is known to be allowed."""
    typed = _typed(kind, value)
    if typed is None:
        raise where.error(f"`{key}` must be {_type_words(kind)}, found {_shown(value)}", _example(item, key))
    for one in typed if isinstance(typed, tuple) else (typed,):
        _check_range(item, key, one, where)
    if item.metadata.get("file") and typed:
        return os.path.normpath(where.base / Path(typed).expanduser())
    return typed


def _typed(kind: Any, value: Any) -> Any:
    """The value as `kind`, or None if it is something else. Whole numbers are fine for a float."""
    if kind is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return float(value) if number and math.isfinite(value) else None
    if get_origin(kind) is tuple:
        item_kind = get_args(kind)[0]
        items = [_typed(item_kind, one) for one in value] if isinstance(value, (list, tuple)) else [None]
        return None if None in items else tuple(items)
    if isinstance(kind, type) and kind in (str, bool, int):
        return value if type(value) is kind else None
    if isinstance(value, Mapping) and all(isinstance(v, str) for v in value.values()):
        return dict(value)
    return None


def _check_range(item: Field[Any], key: str, value: Any, where: _Where) -> None:
    low, high, choices = (item.metadata.get(name) for name in ("low", "high", "choices"))
    if choices and value not in choices:
        raise where.error(f"`{key}` cannot be {_shown(value)}", _nearest(str(value), choices, "choices"))
    if (low is not None and value < low) or (high is not None and value > high):
        raise where.error(
            f"`{key}` must be {_range_words(low, high)}, found {_shown(value)}",
            f"`semslam config show` documents every key; the default is {_shown(_default(item))}",
        )


def _check_variants(stage: Stage, config: Config) -> None:
    names = config.variants(stage)
    key = f"{stage.name}.{stage.variants}"
    if not names:
        raise UsageError(f"`{key}` is empty: nothing to run", hint=f"leave `{stage.variants}` out to run all of them")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise UsageError(f"`{key}` names `{doubled[0]}` twice", hint="name each once")


def _check_across(section: Any) -> None:
    """Settings of a section that are fine alone and make no sense together."""
    if not isinstance(section, ExtractConfig):
        return
    if section.min_depth_m >= section.max_depth_m:
        raise UsageError(
            f"`extract.min_depth_m` is {section.min_depth_m:g} and `extract.max_depth_m` is {section.max_depth_m:g}, "
            "which leaves no depth between them",
            hint=f"raise the second, such as `--set extract.max_depth_m={section.min_depth_m + 5:g}`",
        )
    if section.side % 2 == 0:
        raise UsageError(
            f"`extract.side` is {section.side}, but the camera stands at the centre of the middle cell",
            hint=f"use an odd number: `--set extract.side={section.side + 1}`",
        )


def _nearest(
    name: str, known: Mapping[str, Any] | Sequence[str], what: str, owners: Mapping[str, str] | None = None
) -> str:
    """A hint with the nearest valid word, or all of them."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    if close:
        return f"did you mean `{close[0]}`?"
    if owners and name in owners:
        return f"`{name}` belongs to section `[{owners[name]}]`"
    return f"{what}: {', '.join(f'`{one}`' for one in known)}"


def _owners(classes: Mapping[str, type[Any]]) -> dict[str, str]:
    """Section of every key, for keys written outside of theirs."""
    return {item.name: name for name, kind in classes.items() for item in fields(kind)}


def _type_words(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return "a list of texts"
    words: dict[Any, str] = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return words.get(kind, "a table of texts")


def _range_words(low: float | None, high: float | None) -> str:
    if low is None:
        return f"at most {high:g}"
    return f"at least {low:g}" if high is None else f"{low:g} to {high:g}"


def _example(item: Field[Any], key: str) -> str:
    return f"such as `{key.split('.')[-1]} = {_toml_value(_default(item))}`"


def _default(item: Field[Any]) -> Any:
    return item.default_factory() if item.default_factory is not MISSING else item.default


def _shown(value: Any) -> str:
    try:
        return f"`{canonical_json(value)}`"
    except (TypeError, ValueError):
        return f"`{value}`"


# --- writing


def _toml_table(name: str, section: Any, comments: bool) -> str:
    notes = field_notes(type(section)) if comments else {}
    lines = [f"[{name}]"]
    inner = []
    for item in fields(section):
        value = getattr(section, item.name)
        if is_dataclass(value):
            inner.append(_toml_table(f"{name}.{item.name}", value, comments))
            continue
        lines += [f"# {line}" for line in notes.get(item.name, "").splitlines()]
        if comments:
            lines += [f"# {line}" for line in _allowed(item)]
        lines.append(f"{item.name} = {_toml_value(value)}")
    return "\n".join([*lines, "", *inner])


def _allowed(item: Field[Any]) -> list[str]:
    choices, low, high = (item.metadata.get(name) for name in ("choices", "low", "high"))
    if choices:
        return [f"One of: {', '.join(choices)}." if isinstance(item.default, str) else f"Of: {', '.join(choices)}."]
    return [f"Range: {_range_words(low, high)}."] if low is not None or high is not None else []


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_toml_key(key)} = {_toml_value(item)}" for key, item in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_toml_value(item) for item in value)}]"
    return repr(value) if isinstance(value, (int, float)) else _toml_text(str(value))


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _toml_text(key)


def _toml_text(text: str) -> str:
    return canonical_json(text).replace("\x7f", "\\u007f")


def field_notes(kind: type[Any]) -> dict[str, str]:
    """The text under each field of a dataclass, read from its source."""
    tree = ast.parse(inspect.getsource(inspect.getmodule(kind) or kind))
    body = next(node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == kind.__name__)
    notes = {}
    for node, after in pairwise(body):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and (text := _text(after)):
            notes[node.target.id] = inspect.cleandoc(text)
    return notes


def _text(node: ast.stmt) -> str:
    """The string that a statement consists of; empty for any other statement."""
    value = node.value if isinstance(node, ast.Expr) else None
    return value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) else ""


def check_files(config: Config) -> None:
    """Every file that a setting names is there.

    Raises:
        UsageError: one is not, or may not be read.
    """
    for name, section in config.sections.items():
        for key, path in file_settings(section, name):
            if not os.path.isfile(path) or not os.access(path, os.R_OK):
                raise UsageError(f"`{key}` names `{path}`, which cannot be read", hint="check the path")
