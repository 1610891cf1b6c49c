"""Reading chosen fields out of serialised ROS messages, by the schema that the log itself carries.

A definition is compiled once per channel into a few steps. Neighbouring fields of fixed size become one `struct` call
in which everything that nobody asked for is padding; strings and sequences follow one by one. So a message costs
microseconds, byte arrays stay bytes, and a field is found by its name wherever a recorder's schema puts it.

CDR (ROS 2) aligns every value to its own size, counted from the end of the 4-byte encapsulation header, and ends
strings with a NUL; ROS 1 packs everything, always little endian. Sequences and strings start with a uint32 count in
both. Every count is compared with the bytes that are left before anything is allocated.

Source: OMG DDSI-RTPS 2.5, section 10 (CDR encapsulation); http://wiki.ros.org/ROS/Technical%20Overview
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from operator import itemgetter
from typing import Any, TypeAlias

from semslam.logs.ros_definition import PRIMITIVES, Definitions, Field, Flavour

MAX_FIELDS = 2048
"""Fields a schema may expand to, so that no schema makes work without end. The largest message read here has 60."""
MAX_DEPTH = 16
MAX_FIXED_BYTES = 1 << 28

_CODES = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""`struct` codes. ROS 1 signs its deprecated `byte`; no field read here is one that this would change."""
_COUNT = (struct.Struct(">I"), struct.Struct("<I"))
_TEXTS = ("string", "wstring")


class Shape(Enum):
    """What a wanted field has to be."""

    INTEGER = "an integer"
    NUMBER = "a number"
    NUMBERS = "numbers"
    TEXT = "a string"
    BYTES = "a byte array"
    RECORDS = "an array of messages"


@dataclass(frozen=True, slots=True)
class Want:
    """One field to read: `path` from the top of the message, names in lower case joined by dots."""

    path: str
    shape: Shape
    count: int | None = None
    """Length a NUMBERS field must have; None: any."""
    record: tuple[Want, ...] = ()
    """What to read from each element of a RECORDS field."""


Step: TypeAlias = Callable[[bytes, int, int, list[Any]], int]
"""(data, offset, little, out) -> next offset; appends what is wanted to `out`. `little` is 0 or 1."""


@dataclass(frozen=True, slots=True)
class Layout:
    """A compiled definition."""

    steps: tuple[Step, ...]
    pick: Callable[[list[Any]], tuple[Any, ...]]
    min_bytes: int
    """No message is shorter, wherever it starts."""

    def read(self, data: bytes, offset: int, little: int) -> tuple[tuple[Any, ...], int]:
        """Values in the order of the record (NUMBERS as sequences, RECORDS as lists of tuples), and the next offset.

        Raises:
            ValueError, struct.error: the message ends early or holds no valid text.
        """
        out: list[Any] = []
        for step in self.steps:
            offset = step(data, offset, little, out)
        return self.pick(out), offset


def compile_layout(definitions: Definitions, type_name: str, record: Sequence[Want], flavour: Flavour) -> Layout:
    """Compile the definition of `type_name` for reading `record`.

    Raises:
        ValueError: the definition lacks a wanted field, has it in another shape, or cannot be laid out.
    """
    return _Compiler(definitions, flavour).layout(type_name, record, 0)


class _Compiler:
    """Turns the definitions of one channel into layouts, with one budget of fields for all of them."""

    def __init__(self, definitions: Definitions, flavour: Flavour) -> None:
        self._definitions = definitions
        self._flavour = flavour
        self._budget = MAX_FIELDS

    def layout(self, type_name: str, record: Sequence[Want], depth: int) -> Layout:
        leaves = list(self._leaves(type_name, "", depth))
        _check_wanted(type_name, leaves, record)
        wanted = {want.path: want for want in record}
        groups = list(_groups(leaves))
        steps, sizes = [], []
        for group in groups:
            step, min_bytes = self._step(group, wanted, depth)
            steps.append(step)
            sizes.append(min_bytes)
        slots = _slots(groups, wanted)
        return Layout(tuple(steps), _picker([slots[want.path] for want in record]), sum(sizes))

    def _leaves(self, type_name: str, prefix: str, depth: int) -> Iterator[Field]:
        """Fields in the order of the bytes, single nested messages expanded, named by their path."""
        if depth > MAX_DEPTH:
            raise ValueError(f"its schema nests deeper than {MAX_DEPTH} messages")
        if type_name not in self._definitions:
            raise ValueError(f"its schema uses `{type_name}` but does not define it")
        for field in self._definitions[type_name]:
            self._budget -= 1
            if self._budget < 0:
                raise ValueError(f"its schema expands to more than {MAX_FIELDS} fields")
            if field.type in PRIMITIVES or field.is_array:
                yield Field(prefix + field.name, field.type, field.is_array, field.count)
            else:
                yield from self._leaves(field.type, f"{prefix}{field.name}.", depth + 1)

    def _step(self, group: list[Field], wanted: dict[str, Want], depth: int) -> tuple[Step, int]:
        """The step that reads one group, and the fewest bytes it takes."""
        leaf, aligned = group[0], self._flavour is Flavour.ROS2
        if _is_fixed(leaf):
            return _fixed_step(group, wanted, aligned), _packed_bytes(group)
        if leaf.type == "wstring":
            raise ValueError(f"its schema has the wide string `{leaf.name}`, which recorders do not agree on")
        if leaf.type in PRIMITIVES and leaf.type != "string":
            return _sequence_step(_CODES[leaf.type], wanted.get(leaf.name), aligned), 4
        if not leaf.is_array:
            return _text_step(leaf.name in wanted, aligned), 4
        layout = self._element(leaf, wanted.get(leaf.name), aligned, depth)
        min_bytes = 4 if leaf.count is None else leaf.count * layout.min_bytes
        return _repeat_step(layout, leaf.count, leaf.name in wanted, aligned), min_bytes

    def _element(self, leaf: Field, want: Want | None, aligned: bool, depth: int) -> Layout:
        if leaf.type == "string":
            return Layout((_text_step(False, aligned),), tuple, 4)
        return self.layout(leaf.type, want.record if want else (), depth + 1)


def _slots(groups: Sequence[Sequence[Field]], wanted: dict[str, Want]) -> dict[str, int | slice]:
    """Where the values of each wanted field stand in the list that the steps fill."""
    slots: dict[str, int | slice] = {}
    filled = 0
    for leaf in (leaf for group in groups for leaf in group if leaf.name in wanted):
        is_block = _is_fixed(leaf) and leaf.count is not None
        width = leaf.count if is_block and leaf.count is not None else 1
        slots[leaf.name] = slice(filled, filled + width) if is_block else filled
        filled += width
    return slots


def _picker(slots: list[int | slice]) -> Callable[[list[Any]], tuple[Any, ...]]:
    if len(slots) < 2:
        return lambda out: tuple(out[slot] for slot in slots)
    getter: Callable[[list[Any]], tuple[Any, ...]] = itemgetter(*slots)
    return getter


def _groups(leaves: Sequence[Field]) -> Iterator[list[Field]]:
    """Neighbours of fixed size together, everything else alone."""
    group: list[Field] = []
    for leaf in leaves:
        if group and not (_is_fixed(leaf) and _is_fixed(group[-1])):
            yield group
            group = []
        group.append(leaf)
    if group:
        yield group


def _is_fixed(leaf: Field) -> bool:
    is_scalar = leaf.type in PRIMITIVES and leaf.type not in _TEXTS
    return is_scalar and (not leaf.is_array or leaf.count is not None)


def _check_wanted(type_name: str, leaves: Sequence[Field], record: Sequence[Want]) -> None:
    found = {leaf.name: leaf for leaf in leaves}
    for want in record:
        leaf = found.get(want.path)
        if leaf is None:
            raise ValueError(f"its schema of `{type_name}` has no field `{want.path}`")
        if not _fits(leaf, want):
            raise ValueError(f"its schema of `{type_name}` has a field `{want.path}` that is not {want.shape.value}")


def _fits(leaf: Field, want: Want) -> bool:
    is_float, is_text = leaf.type.startswith("float"), leaf.type == "string"
    is_record = leaf.type not in PRIMITIVES
    match want.shape:
        case Shape.TEXT:
            return is_text and not leaf.is_array
        case Shape.INTEGER:
            return not (leaf.is_array or is_float or is_text or is_record)
        case Shape.NUMBER:
            return is_float and not leaf.is_array
        case Shape.NUMBERS:
            return is_float and leaf.is_array and want.count in (None, leaf.count)
        case Shape.BYTES:
            return leaf.type in ("uint8", "byte", "char", "int8") and leaf.is_array and leaf.count is None
        case Shape.RECORDS:
            return is_record and leaf.is_array


# --------------------------------------------------------------------------------------------------------- steps


def _bytes_of(type_name: str) -> int:
    return struct.calcsize("=" + _CODES[type_name])


def _fixed_step(leaves: Sequence[Field], wanted: dict[str, Want], aligned: bool) -> Step:
    """One `struct` call for neighbours of fixed size: one compiled form for each byte order and start modulo 8."""
    phases = range(8) if aligned else [0] * 8
    forms = tuple(struct.Struct(order + _format(leaves, wanted, aligned, phase)) for order in "><" for phase in phases)

    def step(data: bytes, offset: int, little: int, out: list[Any]) -> int:
        form = forms[little << 3 | (offset + 4) & 7]  # the encapsulation header does not count
        out += form.unpack_from(data, offset)
        return offset + form.size

    return step


def _format(leaves: Sequence[Field], wanted: dict[str, Want], aligned: bool, phase: int) -> str:
    codes, position = [], phase
    for leaf in leaves:
        size = _packed_bytes([leaf])
        gap = -position % _bytes_of(leaf.type) if aligned and size else 0
        position += gap + size
        if position > MAX_FIXED_BYTES:
            raise ValueError(f"its schema has the field `{leaf.name}` of {size} bytes")
        count = 1 if leaf.count is None else leaf.count
        codes.append(f"{gap}x{count}{_CODES[leaf.type]}" if leaf.name in wanted else f"{gap + size}x")
    return "".join(codes)


def _packed_bytes(leaves: Sequence[Field]) -> int:
    return sum(_bytes_of(leaf.type) * (1 if leaf.count is None else leaf.count) for leaf in leaves)


def _read_count(data: bytes, offset: int, little: int, aligned: bool) -> tuple[int, int]:
    start = offset + (-offset & 3) if aligned else offset
    count: int = _COUNT[little].unpack_from(data, start)[0]
    return count, start + 4


def _require(data: bytes, end: int) -> None:
    if end > len(data):
        raise ValueError(f"it ends after {len(data)} bytes where its fields need {end}")


def _text_step(is_wanted: bool, aligned: bool) -> Step:
    def step(data: bytes, offset: int, little: int, out: list[Any]) -> int:
        count, start = _read_count(data, offset, little, aligned)
        _require(data, start + count)
        if is_wanted:
            stop = start + count - 1 if aligned and count else start + count  # CDR counts the closing NUL
            out.append(str(data[start:stop], "utf-8"))
        return start + count

    return step


def _sequence_step(code: str, want: Want | None, aligned: bool) -> Step:
    size = struct.calcsize("=" + code)

    def step(data: bytes, offset: int, little: int, out: list[Any]) -> int:
        count, start = _read_count(data, offset, little, aligned)
        if aligned and count:
            start += (4 - start) % size
        end = start + count * size
        _require(data, end)
        if want is not None and want.shape is Shape.BYTES:
            out.append(data[start:end])
        elif want is not None:
            out.append(struct.unpack_from(f"{'><'[little]}{count}{code}", data, start))
        return end

    return step


def _repeat_step(layout: Layout, fixed_count: int | None, is_wanted: bool, aligned: bool) -> Step:
    def step(data: bytes, offset: int, little: int, out: list[Any]) -> int:
        count = fixed_count
        if count is None:
            count, offset = _read_count(data, offset, little, aligned)
        _require(data, offset + count * layout.min_bytes)
        records = []
        for _ in range(count if layout.min_bytes else 0):  # ROS 1 sends nothing for a message without fields
            values, offset = layout.read(data, offset, little)
            if is_wanted:
                records.append(values)
        if is_wanted:
            out.append(records)
        return offset

    return step
