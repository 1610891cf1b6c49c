"""What an ONNX file says about itself, read without loading its weights and without ONNX Runtime.

ONNX Runtime tells neither the operator set, nor which operators a graph holds, nor where its weights lie, and it
answers a truncated file with `Protobuf parsing failed`. This reads the few protobuf fields needed for that; their
numbers are those of onnx.proto (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto).
"""

from __future__ import annotations

import hashlib
import mmap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from semslam.errors import SemslamError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_DEPTH = 32
_STARTS = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself", "Run `git lfs pull` where it came from"),
    (b"PK\x03\x04", "a zip archive, as PyTorch checkpoints are", "Export the network to ONNX first"),
    (b"\x80", "a Python pickle, as older PyTorch checkpoints are", "Export the network to ONNX first"),
    (b"<", "a web page or XML file", "Download the file itself, not the page that shows it"),
)


@dataclass(frozen=True)
class OnnxFile:
    """Facts of an ONNX file that its inputs and outputs do not tell."""

    path: Path
    ir_version: int
    opsets: tuple[tuple[str, int], ...]
    """Operator sets by domain, sorted; the domain of the standard one is `ai.onnx`."""
    producer: str
    metadata: Mapping[str, str]
    operators: tuple[str, ...]
    """Operator types in the graph and its subgraphs, sorted."""
    external_files: tuple[Path, ...]
    """Files beside the model that hold its weights, sorted."""


@dataclass
class _Found:
    """Collects facts during the walk."""

    ir_version: int = 0
    producer: str = ""
    producer_version: str = ""
    graphs: int = 0
    opsets: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    operators: set[str] = field(default_factory=set)
    locations: set[str] = field(default_factory=set)


def read_onnx(path: Path, what: str = "model") -> OnnxFile:
    """Read the facts of the ONNX file at `path`; `what` names its role in errors.

    Raises:
        SemslamError: missing, no file, empty, no ONNX, truncated, or its weight files are absent.
    """
    _check_file(path, what)
    found = _Found()
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        view = memoryview(mapped)
        try:
            problem = _try_walk(view, found)
            start = bytes(view[:64])
        finally:
            view.release()
    if problem:
        raise _not_onnx(path, what, start, problem)
    external = tuple(path.parent / name for name in sorted(found.locations))
    _check_external(path, what, external)
    return OnnxFile(
        path=path,
        ir_version=found.ir_version,
        opsets=tuple(sorted(found.opsets.items())),
        producer=f"{found.producer} {found.producer_version}".strip(),
        metadata=MappingProxyType(found.metadata),
        operators=tuple(sorted(found.operators)),
        external_files=external,
    )


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_file(path: Path, what: str) -> None:
    if path.is_dir():
        raise SemslamError(f"The {what} `{path}` is a folder", hint="Name the .onnx file inside it")
    if not path.is_file():
        raise SemslamError(f"No {what} at `{path}`", hint=_nearby(path))
    try:
        size = path.stat().st_size
        with path.open("rb"):
            pass
    except OSError as error:
        raise SemslamError(
            f"The {what} `{path}` cannot be read: {error.strerror}", hint="Check its permissions"
        ) from error
    if size == 0:
        raise SemslamError(f"The {what} `{path}` is empty (0 bytes)", hint="Download or export it again")


def _nearby(path: Path) -> str:
    if not path.parent.is_dir():
        return f"The folder `{path.parent}` does not exist either; check the path"
    names = sorted(entry.name for entry in path.parent.glob("*.onnx"))
    if not names:
        return f"`{path.parent}` holds no .onnx file; check the path"
    return f"`{path.parent}` holds {', '.join(f'`{name}`' for name in names[:5])}"


def _check_external(path: Path, what: str, external: tuple[Path, ...]) -> None:
    missing = [entry for entry in external if not entry.is_file()]
    if missing:
        raise SemslamError(
            f"The {what} `{path}` keeps its weights in `{missing[0].name}`, which is not beside it",
            hint=f"Copy `{missing[0].name}` into `{path.parent}`, or export with the weights inside "
            "(`external_data=False` in torch.onnx.export)",
        )


def _not_onnx(path: Path, what: str, start: bytes, problem: str) -> SemslamError:
    for prefix, kind, hint in _STARTS:
        if start.startswith(prefix):
            return SemslamError(f"The {what} `{path}` is no ONNX file: it looks like {kind}", hint=hint)
    size = path.stat().st_size
    return SemslamError(
        f"The {what} `{path}` ({size:,} bytes) is no ONNX file, or is damaged: {problem}",
        hint="Download or export it again, and compare its size with the original's",
    )


def _try_walk(view: memoryview, found: _Found) -> str:
    """Walk the model into `found`; the reason why it is no ONNX model, or nothing."""
    try:
        _walk_model(view, found)
    except ValueError as error:
        return str(error)
    if not found.graphs:
        return "it holds no graph"
    return "" if found.opsets else "it names no operator set"


def _walk_model(view: memoryview, found: _Found) -> None:
    for number, value in _fields(view):
        if number == 1 and isinstance(value, int):
            found.ir_version = value
        elif isinstance(value, int):
            continue
        elif number == 2:
            found.producer = _text(value)
        elif number == 3:
            found.producer_version = _text(value)
        elif number == 7:
            found.graphs += 1
            _walk_graph(value, found, 0)
        elif number == 8:
            domain, version = _opset(value)
            found.opsets[domain or "ai.onnx"] = version
        elif number == 14:
            key, text = _string_pair(value)
            found.metadata[key] = text


def _walk_graph(view: memoryview, found: _Found, depth: int) -> None:
    if depth > _MAX_DEPTH:
        raise ValueError("its graphs are nested too deeply")
    for number, value in _fields(view):
        if isinstance(value, int):
            continue
        if number == 1:
            _walk_node(value, found, depth)
        elif number == 5:
            _walk_tensor(value, found)


def _walk_node(view: memoryview, found: _Found, depth: int) -> None:
    for number, value in _fields(view):
        if isinstance(value, int):
            continue
        if number == 4:
            found.operators.add(_text(value))
        elif number == 5:
            _walk_attribute(value, found, depth)


def _walk_attribute(view: memoryview, found: _Found, depth: int) -> None:
    for number, value in _fields(view):
        if isinstance(value, int):
            continue
        if number in (5, 10):
            _walk_tensor(value, found)
        elif number in (6, 11):
            _walk_graph(value, found, depth + 1)


def _walk_tensor(view: memoryview, found: _Found) -> None:
    """Note the file of a tensor whose data lies outside the model."""
    for number, value in _fields(view):
        if number == 13 and not isinstance(value, int):
            key, text = _string_pair(value)
            if key == "location":
                found.locations.add(text)


def _opset(view: memoryview) -> tuple[str, int]:
    domain, version = "", 0
    for number, value in _fields(view):
        if number == 1 and not isinstance(value, int):
            domain = _text(value)
        elif number == 2 and isinstance(value, int):
            version = value
    return domain, version


def _string_pair(view: memoryview) -> tuple[str, str]:
    pair = ["", ""]
    for number, value in _fields(view):
        if number in (1, 2) and not isinstance(value, int):
            pair[number - 1] = _text(value)
    return pair[0], pair[1]


def _text(view: memoryview) -> str:
    return bytes(view).decode("utf-8", errors="replace")


def _fields(view: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The fields of one protobuf message as (number, value); nothing is copied.

    Raises ValueError when the bytes are no protobuf message or end too early.
    """
    at = 0
    while at < len(view):
        tag, at = _varint(view, at)
        number, wire = tag >> 3, tag & 7
        if number == 0:
            raise ValueError(f"field 0 at byte {at}")
        if wire == _VARINT:
            value, at = _varint(view, at)
            yield number, value
            continue
        size = _FIXED_SIZES.get(wire)
        if size is None:
            if wire != _BYTES:
                raise ValueError(f"wire type {wire} at byte {at}")
            size, at = _varint(view, at)
        if size > len(view) - at:
            raise ValueError(f"a field of {size:,} bytes begins {len(view) - at:,} bytes before the end")
        yield number, view[at : at + size]
        at += size


_FIXED_SIZES = {_FIXED64: 8, _FIXED32: 4}


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    value = 0
    with suppress(IndexError):
        for shift in range(0, 70, 7):
            byte = view[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value, at
        raise ValueError(f"a number of more than 10 bytes before byte {at}")
    raise ValueError("it ends in the middle of a number")
