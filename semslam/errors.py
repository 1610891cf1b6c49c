"""The one family of errors, and nothing else: the command line prints them, every other room raises them."""

from __future__ import annotations


class SemslamError(Exception):
    """Something the user can act on.

    Args:
        message: one sentence that names the file, topic or key (in backticks) and what was found.
        hint: something to type or to change; shown on a line of its own after `hint:`.
        details: facts that help, possibly several lines, shown between message and hint.
    """

    exit_code = 1

    def __init__(self, message: str, *, hint: str = "", details: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.details = details

    @property
    def in_a_line(self) -> str:
        """Message and hint together, for tables of what went wrong."""
        return f"{self.message}; {self.hint}" if self.hint else self.message

    def __reduce__(self) -> tuple[object, ...]:
        """Keep hint and details when the error crosses a process boundary."""
        return (_rebuild, (type(self), self.message, self.hint, self.details))

    def text(self) -> str:
        """The whole error as shown to a person, without the leading `error:`."""
        parts = [self.message]
        if self.details:
            parts += ["", self.details.rstrip(), ""]
        if self.hint:
            parts.append(f"hint: {self.hint}")
        return "\n".join(parts)


class UsageError(SemslamError):
    """The command line or the configuration asks for something impossible (exit code 2)."""

    exit_code = 2


def _rebuild(kind: type[SemslamError], message: str, hint: str, details: str) -> SemslamError:
    return kind(message, hint=hint, details=details)
