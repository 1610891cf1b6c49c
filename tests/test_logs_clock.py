"""Stamps stay continuous across clock jumps."""

from __future__ import annotations

from semslam.logs.clock import StampClock

SECOND = 1_000_000_000
HOUR = 3600 * SECOND


def test_steady_clock_is_left_alone() -> None:
    """Jitter and a constant offset to log time change nothing."""
    clock = StampClock()
    for i in range(20):
        assert clock.stamp("/a", 50 * HOUR + i * SECOND, i * SECOND + (i % 3) * 1_000_000) == 50 * HOUR + i * SECOND
    assert clock.jumps("/a") == 0


def test_jump_is_counted_and_undone() -> None:
    """A clock set by an hour, forwards or back, gives stamps that go on as before."""
    for jump in (HOUR, -HOUR):
        clock = StampClock()
        stamps = [clock.stamp("/a", i * SECOND + 100 * HOUR + (jump if i >= 5 else 0), i * SECOND) for i in range(10)]
        assert stamps == [i * SECOND + 100 * HOUR for i in range(10)]
        assert clock.jumps("/a") == 1


def test_topic_that_starts_after_the_jump_follows_the_others() -> None:
    """A topic on the same clock, first seen after it was set, is corrected alike."""
    clock = StampClock()
    clock.stamp("/a", 100 * HOUR, 0)
    clock.stamp("/a", 101 * HOUR + SECOND, SECOND)
    assert clock.stamp("/b", 101 * HOUR + 2 * SECOND, 2 * SECOND) == 100 * HOUR + 2 * SECOND


def test_message_without_stamp_takes_log_time() -> None:
    """A zero stamp means that the driver set none."""
    assert StampClock().stamp("/a", 0, 7 * SECOND) == 7 * SECOND
