"""Stamped values in time order, whatever order they arrive in: the buffer under frame trees, tracks and IMU windows."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Timeline(Generic[Value]):
    """Values by stamp (int nanoseconds). Arrival in order costs nothing extra; the first of two equal stamps wins."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values: list[Value] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def first(self) -> int | None:
        """The oldest stamp; None when empty."""
        return self._stamps[0] if self._stamps else None

    @property
    def last(self) -> int | None:
        """The newest stamp; None when empty."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_nanos: int, value: Value) -> bool:
        """Insert a value; False if the stamp is already taken."""
        stamps = self._stamps
        if not stamps or stamp_nanos > stamps[-1]:
            stamps.append(stamp_nanos)
            self._values.append(value)
            return True
        index = bisect_left(stamps, stamp_nanos)
        if stamps[index] == stamp_nanos:
            return False
        stamps.insert(index, stamp_nanos)
        self._values.insert(index, value)
        return True

    def bracket(self, stamp_nanos: int, max_gap_nanos: int) -> tuple[Value, Value, float] | None:
        """The values around a stamp and the fraction of the way from the first to the second.

        An exact hit gives that value twice and 0. None outside the stamps, or if the two are further apart than
        the gap.
        """
        index = bisect_left(self._stamps, stamp_nanos)
        if index == len(self._stamps):
            return None
        after = self._stamps[index]
        if after == stamp_nanos:
            return self._values[index], self._values[index], 0.0
        if index == 0 or after - self._stamps[index - 1] > max_gap_nanos:
            return None
        before = self._stamps[index - 1]
        return self._values[index - 1], self._values[index], (stamp_nanos - before) / (after - before)

    def between(self, start_nanos: int, stop_nanos: int) -> tuple[Sequence[int], Sequence[Value]]:
        """Stamps and values with start <= stamp < stop."""
        part = slice(bisect_left(self._stamps, start_nanos), bisect_left(self._stamps, stop_nanos))
        return self._stamps[part], self._values[part]

    def forget_before(self, stamp_nanos: int) -> None:
        """Drop what is older than the stamp, but keep the newest value at or before it, which brackets it."""
        keep_from = bisect_right(self._stamps, stamp_nanos) - 1
        if keep_from > 0:
            del self._stamps[:keep_from]
            del self._values[:keep_from]
