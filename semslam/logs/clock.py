"""Stamps that stay continuous when a recorder's clock is set while it runs.

A header stamp and the log time of one topic differ by a nearly constant offset. When that offset jumps, the stamping
clock was set; the stamps after it are shifted back onto the old clock, so that time in the log stays what it was.
"""

from __future__ import annotations

from dataclasses import dataclass

JUMP_NANOS = 1_000_000_000
"""Offsets that change by more than this between two messages of a topic are a clock jump."""


@dataclass(slots=True)
class _TopicClock:
    offset: int
    """Latest stamp minus log time, as recorded."""
    correction: int = 0
    jumps: int = 0


class StampClock:
    """Corrects the stamps of all topics of a log, in the order of reading."""

    def __init__(self) -> None:
        self._topics: dict[str, _TopicClock] = {}

    def stamp(self, topic: str, stamp_nanos: int, log_time_nanos: int) -> int:
        """The stamp on the log's first clock; the log time if the header has no stamp (0)."""
        if stamp_nanos == 0:
            return log_time_nanos
        offset = stamp_nanos - log_time_nanos
        clock = self._topics.get(topic)
        if clock is None:
            clock = self._topics[topic] = _TopicClock(offset, self._shared_correction(offset))
        elif abs(offset - clock.offset) > JUMP_NANOS:
            clock.correction -= offset - clock.offset
            clock.jumps += 1
        clock.offset = offset
        return stamp_nanos + clock.correction

    def jumps(self, topic: str) -> int:
        """Jumps seen so far on `topic`."""
        clock = self._topics.get(topic)
        return clock.jumps if clock else 0

    def _shared_correction(self, offset: int) -> int:
        """The correction of a topic on the same clock, for a topic whose first message comes after a jump."""
        for clock in self._topics.values():
            if abs(clock.offset - offset) <= JUMP_NANOS:
                return clock.correction
        return 0
