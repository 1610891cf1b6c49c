"""Stamps that stay continuous when the clock that makes them is set while the recorder runs.

Stamp less log time, the offset of a message, tells two things apart when message is compared with message:

- The stamp itself is torn: it goes back, or it gets further ahead of log time than it ever was. No delay does that:
  the clock was set. The stamps after it are shifted back onto the old clock.
- The stamp goes on steadily and only log time leaps: the recorder wrote late (a stall, flushed in one burst), or its
  own clock was set. The stamps are right and stay as they are.

Topics stamped by one clock are shifted alike, to the nanosecond: whoever was as far from log time as another topic
before a leap, and is as far from it again afterwards, takes the shift of the other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

JUMP_NANOS = 1_000_000_000
"""Offsets of one clock differ by no more than this from message to message and from topic to topic, for delays."""
BACK_NANOS = 100_000_000
"""Stamps that go back by less are messages out of order, not a clock that was set."""
LATE_NANOS = 60_000_000_000
"""A recorder that is late for longer (log time) has not stalled: its clock was set."""


@dataclass(frozen=True, slots=True)
class _Setting:
    """A clock as it stood for a while: its offset to log time, and the shift that undoes what was set until then."""

    offset: int
    correction: int


@dataclass(slots=True)
class _TopicClock:
    stamp: int
    """Latest stamp as recorded, and its log time."""
    log_time: int
    correction: int
    ceiling: int
    """Offset of the messages that were written promptly: the highest of late, for delay only lowers it."""
    late_since: int | None = None
    """Log time of the first message since the offset has been below the ceiling."""
    jumps: int = 0

    @property
    def offset(self) -> int:
        return self.stamp - self.log_time

    def is_torn(self, stamp: int, log_time: int) -> bool:
        """Whether no delay explains this next message."""
        if stamp - log_time > self.ceiling + JUMP_NANOS:
            return log_time > self.log_time
        return stamp < self.stamp - BACK_NANOS and stamp - log_time < self.offset - JUMP_NANOS

    def set_to(self, setting: _Setting, offset: int) -> None:
        """Go on after the clock was set."""
        self.correction, self.ceiling, self.late_since = setting.correction, offset, None
        self.jumps += 1

    def take(self, stamp: int, log_time: int) -> None:
        """Remember a message, and how prompt it was."""
        self.stamp, self.log_time = stamp, log_time
        if self.offset >= self.ceiling - JUMP_NANOS:
            self.ceiling, self.late_since = max(self.ceiling, self.offset), None
        elif self.late_since is None:
            self.late_since = log_time
        elif log_time - self.late_since > LATE_NANOS:
            self.ceiling, self.late_since = self.offset, None


class StampClock:
    """Corrects the stamps of all topics of a log, in the order of reading."""

    def __init__(self) -> None:
        self._topics: dict[str, _TopicClock] = {}
        self._settings: list[_Setting] = []

    def stamp(self, topic: str, stamp_nanos: int, log_time_nanos: int) -> int:
        """The stamp on the log's first clock; the log time if the header has no stamp (0)."""
        if stamp_nanos == 0:
            return log_time_nanos
        offset = stamp_nanos - log_time_nanos
        clock = self._topics.get(topic)
        if clock is None:
            correction = self._shared_correction(offset)
            clock = self._topics[topic] = _TopicClock(stamp_nanos, log_time_nanos, correction, offset)
            self._learn(_Setting(offset, correction))
        elif clock.is_torn(stamp_nanos, log_time_nanos):
            clock.set_to(self._setting(clock, offset), offset)
        clock.take(stamp_nanos, log_time_nanos)
        return stamp_nanos + clock.correction

    def jumps(self, topic: str) -> int:
        """Jumps seen so far on `topic`."""
        clock = self._topics.get(topic)
        return clock.jumps if clock else 0

    def _shared_correction(self, offset: int) -> int:
        """The correction of a topic on the same clock, for a topic whose first message comes after a jump."""
        for clock in self._topics.values():
            if clock.offset - JUMP_NANOS <= offset <= clock.ceiling + JUMP_NANOS:
                return clock.correction
        return 0

    def _setting(self, clock: _TopicClock, offset: int) -> _Setting:
        """What the clock of a topic was set to: as another topic has learnt already, or anew."""
        start = clock.ceiling + clock.correction  # the offset, had the clock never been set
        alike = (s for s in self._settings if abs(s.offset + s.correction - start) <= JUMP_NANOS)
        known = _nearest(alike, offset)
        return known or self._learn(_Setting(offset, start - offset))

    def _learn(self, setting: _Setting) -> _Setting:
        if setting not in self._settings:
            self._settings.append(setting)
        return setting


def _nearest(settings: Iterable[_Setting], offset: int) -> _Setting | None:
    """The setting with nearly this offset, if any; of equally near ones the one learnt first."""
    near = [setting for setting in settings if abs(setting.offset - offset) <= JUMP_NANOS]
    return min(near, key=lambda setting: abs(setting.offset - offset), default=None)
