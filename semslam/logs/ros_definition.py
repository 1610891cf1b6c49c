"""ROS message definitions: the text a log carries for a channel (`ros1msg`, `ros2msg`), as lists of fields.

The text is the definition of the channel's own type, then that of every type it uses, each after a line of `=` and a
line `MSG: package/Type`. Nothing of it is executed: the schema of a log is input like any other.

Source: https://mcap.dev/spec/registry, https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html,
http://wiki.ros.org/msg
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias


class Flavour(Enum):
    """Which of the two ROS generations wrote the text and the messages."""

    ROS1 = "ros1"
    ROS2 = "ros2"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a definition."""

    name: str
    """Lower case: ROS 1 spells `K` what ROS 2 spells `k`."""
    type: str
    """A primitive (`float64`, `string`, ...) or the full name of another definition (`std_msgs/Header`)."""
    is_array: bool = False
    count: int | None = None
    """Elements of a fixed array; None for a sequence of any length."""


Definitions: TypeAlias = Mapping[str, tuple[Field, ...]]
"""Fields by full type name (`package/Type`)."""

_INTEGERS = frozenset(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
PRIMITIVES = _INTEGERS | {"bool", "byte", "char", "float32", "float64", "string", "wstring"}

_SECTION = re.compile(r"^={10,}\s*$", re.MULTILINE)
_TYPE = re.compile(r"^(?P<base>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?$")
_CONSTANT = re.compile(r"^\w+\s*=")
_NAME = re.compile(r"^\w+$")
_BUILT_IN: dict[Flavour, dict[str, tuple[Field, ...]]] = {
    Flavour.ROS1: {
        "time": (Field("sec", "uint32"), Field("nanosec", "uint32")),
        "duration": (Field("sec", "int32"), Field("nanosec", "int32")),
    },
    Flavour.ROS2: {
        "builtin_interfaces/Time": (Field("sec", "int32"), Field("nanosec", "uint32")),
        "builtin_interfaces/Duration": (Field("sec", "int32"), Field("nanosec", "uint32")),
    },
}
_EMPTY = (Field("structure_needs_at_least_one_member", "uint8"),)
"""What ROS 2 sends for a message without fields, since IDL forbids empty structures."""


def short_name(type_name: str) -> str:
    """`package/msg/Type` and `package/Type` name the same type: the latter."""
    parts = type_name.split("/")
    return f"{parts[0]}/{parts[2]}" if len(parts) == 3 and parts[1] == "msg" else type_name


def parse_definitions(type_name: str, text: str, flavour: Flavour) -> Definitions:
    """Read all definitions in `text`, the first of which is that of `type_name`.

    Raises:
        ValueError: the text is no message definition; it says which line.
    """
    definitions = dict(_BUILT_IN[flavour])
    name = short_name(type_name)
    for number, section in enumerate(_SECTION.split(text)):
        if number > 0:
            name, section = _section_head(section)
        fields = tuple(_fields(section, name.rpartition("/")[0], flavour))
        definitions[name] = fields if fields or flavour is Flavour.ROS1 else _EMPTY
    return definitions


def _section_head(section: str) -> tuple[str, str]:
    """Split `MSG: package/Type` from the lines below it."""
    head, _, body = section.lstrip().partition("\n")
    label, _, name = head.partition(":")
    if label != "MSG" or not name.strip():
        raise ValueError(f"a section of the schema starts with `{head.strip()[:80]}` instead of `MSG: package/Type`")
    return short_name(name.strip()), body


def _fields(section: str, package: str, flavour: Flavour) -> Iterator[Field]:
    for line in section.splitlines():
        code = line.partition("#")[0].strip()
        type_text, rest = (code.split(maxsplit=1) + ["", ""])[:2]
        if code and not _CONSTANT.match(rest):
            yield _field(code, type_text, rest.split(), package, flavour)


def _field(code: str, type_text: str, words: list[str], package: str, flavour: Flavour) -> Field:
    match = _TYPE.match(type_text)
    if match is None or not words or not _NAME.match(words[0]):
        raise ValueError(f"the schema line `{code[:80]}` is no field of a ROS message")
    is_fixed = bool(match["count"]) and not match["bound"]
    return Field(
        name=words[0].lower(),
        type=_full_type(match["base"], package, flavour),
        is_array=match["array"] is not None,
        count=int(match["count"]) if is_fixed else None,
    )


def _full_type(base: str, package: str, flavour: Flavour) -> str:
    if base in PRIMITIVES or base in _BUILT_IN[flavour]:
        return base
    if flavour is Flavour.ROS1 and base in ("Header", "roslib/Header"):
        return "std_msgs/Header"  # the one name that ROS 1 allows outside its package
    return short_name(base) if "/" in base else f"{package}/{base}"
