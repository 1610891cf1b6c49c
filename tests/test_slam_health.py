"""What is said of odometry that jumps."""

from __future__ import annotations

from semslam.geometry.frames import SE2
from semslam.slam.estimator import START, VISUAL, PoseEstimate, Step
from semslam.slam.health import TrackHealth

SECOND = 1_000_000_000


def warnings(*x_m: float | None) -> list[str]:
    """Of a track along x whose odometry claims 500 m before its third keyframe; None is no pose."""
    health = TrackHealth(uses_motion=True)
    for frame, x in enumerate(x_m):
        motion = SE2(500.0 if frame == 2 else 0.5, 0.0, 0.0)
        pose = None if x is None else SE2(x, 0.0, 0.0)
        health.see(Step(frame, frame * SECOND, None, motion, None), PoseEstimate(pose, VISUAL if frame else START))
        state = health.state()  # as a run does that is cut and goes on
        health = TrackHealth(uses_motion=True)
        health.restore(state)
    return list(health.warnings())


def test_a_jump_that_the_poses_follow_may_tear_the_map() -> None:
    """So may one across which nothing is known."""
    assert [line.endswith("the map may be torn there") for line in warnings(0.0, 0.5, 500.5, 501.0)] == [True]
    assert warnings(0.0, None, 0.5)[-1].endswith("the map may be torn there")


def test_a_jump_that_the_poses_do_not_follow_is_harmless() -> None:
    """It is said, since the odometry is worth a look, but the map is whole."""
    (line,) = warnings(0.0, 0.5, 1.0, 1.5)
    assert line == "odometry jumps 500 m between keyframes 1 and 2; the poses do not follow it"
