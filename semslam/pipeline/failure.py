"""Why a task failed, as plain values that are shown, stored in the record of the log and sent between processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Failure:
    """What went wrong.

    Attributes:
        kind: refused (the log or a setting does not do), damaged (a stored input), unexpected (a bug), memory, killed,
            or blocked.
        traceback: where an unexpected error came from; empty for the others.
        entry: folder of the stored entry that is damaged; empty for the other kinds.
    """

    kind: str
    message: str
    hint: str = ""
    details: str = ""
    traceback: str = ""
    entry: str = ""

    def as_json(self) -> dict[str, str]:
        """Plain values without the traceback, which lies in a file of its own."""
        return {"kind": self.kind, "message": self.message, "hint": self.hint, "details": self.details}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Failure:
        """The failure as `as_json` gave it."""
        return cls(value["kind"], value["message"], value["hint"], value["details"])
