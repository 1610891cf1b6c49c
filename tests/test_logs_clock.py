"""Stamps stay continuous across clock jumps."""

from __future__ import annotations

import pytest

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


def written_late(period: int, stall: tuple[int, int], until: int) -> list[tuple[int, int]]:
    """(stamp, log time) of a topic whose messages of a stall are written at its end, a microsecond apart."""
    stamps = range(0, until, period)
    log_times = [stall[1] + i * 1000 if stall[0] < stamp < stall[1] else stamp for i, stamp in enumerate(stamps)]
    return [(HOUR + stamp, log_time) for stamp, log_time in zip(stamps, log_times, strict=True)]


@pytest.mark.parametrize("period", [SECOND // 30, SECOND, 2 * SECOND])
def test_a_stalled_recorder_is_no_clock_jump(period: int) -> None:
    """Messages written late in one burst keep their stamps, and so do all after them, on fast and on slow topics."""
    clock = StampClock()
    for stamp, log_time in written_late(period, (10 * SECOND, 19 * SECOND), 60 * SECOND):
        assert clock.stamp("/a", stamp, log_time) == stamp
    assert clock.jumps("/a") == 0


def test_a_recorder_whose_clock_is_set_leaves_the_stamps_alone() -> None:
    """Log time leaps for good; a stamping clock that is set much later is still noticed."""
    clock = StampClock()
    for i in range(100):
        leap, jump = (HOUR if i >= 5 else 0), (5 * SECOND if i >= 80 else 0)
        assert clock.stamp("/a", i * SECOND + jump, i * SECOND + leap) == i * SECOND
    assert clock.jumps("/a") == 1


def test_topics_of_one_clock_are_shifted_alike() -> None:
    """Whatever their delays and rates, so that images, odometry and IMU still fit together to the nanosecond."""
    for jump in (HOUR, -HOUR, 3 * SECOND, -3 * SECOND):
        clock = StampClock()
        shifts: dict[str, set[int]] = {}
        for i in range(200):
            for topic, every, delay in (("/imu", 1, 1_000_000), ("/image", 3, 80_000_000), ("/odom", 5, 300_000_000)):
                if i % every == 0:
                    sent = 100 * HOUR + i * SECOND // 10
                    stamp = sent + (jump if i > 90 else 0)
                    log_time = i * SECOND // 10 + delay + (i + 3) % 7 * 5_000_000
                    shifts.setdefault(topic, set()).add(sent - clock.stamp(topic, stamp, log_time))
        (shift,) = set.union(*shifts.values()) - {0}
        assert abs(shift) < 50_000_000
        assert all(found == {0, shift} for found in shifts.values())
        assert [clock.jumps(topic) for topic in shifts] == [1, 1, 1]


def test_a_clock_set_forth_and_back_ends_uncorrected() -> None:
    """A glitch of a minute leaves no trace behind it."""
    clock = StampClock()
    for i in range(30):
        stamp = clock.stamp("/a", i * SECOND + (60 * SECOND if 10 <= i < 20 else 0), i * SECOND + i % 3 * 1_000_000)
        assert abs(stamp - i * SECOND) < 10_000_000
    assert stamp == 29 * SECOND
    assert clock.jumps("/a") == 2


def test_messages_a_little_out_of_order_after_a_stall_are_no_jump() -> None:
    """Several nodes write one tf topic, each with its own delay."""
    clock = StampClock()
    for stamp, log_time in ((10.0, 10.0), (10.1, 10.15), (10.05, 13.0), (10.2, 13.0001), (13.1, 13.1)):
        nanos = round(stamp * SECOND)
        assert clock.stamp("/tf", nanos, round(log_time * SECOND)) == nanos
