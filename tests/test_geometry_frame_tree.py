"""The frame tree: look-ups at any stamp, and logs whose frames are no tree."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semslam.geometry.frame_tree import FOREVER, FrameTree
from semslam.geometry.frames import matrix_from_pose
from semslam.geometry.timeline import Timeline

STRAIGHT = (0.0, 0.0, 0.0, 1.0)
LEFT = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # a quarter turn
SECOND = 1_000_000_000


def robot_tree() -> FrameTree:
    """odom -> base_link (moving 1 m/s along x) -> camera_link -> optical, and base_link -> imu."""
    tree = FrameTree()
    for second in range(5):
        tree.add("odom", "base_link", second * SECOND, (float(second), 0.0, 0.0), STRAIGHT, False)
    tree.add("base_link", "camera_link", 0, (0.2, 0.0, 0.5), LEFT, True)
    tree.add("camera_link", "optical", 0, (0.0, 0.1, 0.0), STRAIGHT, True)
    tree.add("base_link", "imu", 0, (0.0, 0.0, 0.1), STRAIGHT, True)
    return tree


def place(tree: FrameTree, parent: str, child: str, stamp: int, gap: int = SECOND) -> list[float] | None:
    """Where the child's origin lies in the parent."""
    matrix = tree.lookup(parent, child, stamp, gap)
    return None if matrix is None else [round(float(value), 9) for value in matrix[:3, 3]]


def test_static_chain_by_hand() -> None:
    """0.1 m left of a camera that looks left is 0.1 m behind."""
    assert place(robot_tree(), "base_link", "optical", 77) == [0.1, 0.0, 0.5]


def test_moving_transforms_are_interpolated() -> None:
    """Half a second after 1 s the robot is at 1.5 m."""
    assert place(robot_tree(), "odom", "base_link", 3 * SECOND // 2) == [1.5, 0.0, 0.0]
    assert place(robot_tree(), "odom", "optical", 3 * SECOND // 2) == [1.6, 0.0, 0.5]


def test_siblings_and_the_way_down() -> None:
    """Any two connected frames, in either direction."""
    tree = robot_tree()
    assert place(tree, "imu", "camera_link", 0) == [0.2, 0.0, 0.4]
    down, up = tree.lookup("optical", "odom", SECOND, 0), tree.lookup("odom", "optical", SECOND, 0)
    assert down is not None
    assert up is not None
    assert down @ up == pytest.approx(np.eye(4))
    assert place(tree, "imu", "imu", 0) == [0.0, 0.0, 0.0]


def test_no_extrapolation_and_no_bridging_of_gaps() -> None:
    """Outside the samples, or between samples too far apart, nothing is known; an exact stamp always is."""
    tree = robot_tree()
    assert place(tree, "odom", "base_link", 4 * SECOND + 1) is None
    assert place(tree, "odom", "base_link", -1) is None
    assert place(tree, "odom", "base_link", SECOND // 2, gap=SECOND - 1) is None
    assert place(tree, "odom", "base_link", SECOND, gap=0) == [1.0, 0.0, 0.0]


def test_unknown_or_unconnected_frames_have_no_transform() -> None:
    """Two trees stay apart, and the report names their roots."""
    tree = robot_tree()
    tree.add("mocap", "ball", 0, (0.0, 0.0, 0.0), STRAIGHT, True)
    assert place(tree, "odom", "ball", 0) is None
    assert place(tree, "odom", "nowhere", 0) is None
    assert tree.known_until("odom", "ball") is None
    assert tree.problems() == ["2 separate trees, with roots `odom`, `mocap`"]


def test_leading_slashes_do_not_count() -> None:
    """ROS 1 names and ROS 2 names are the same frames."""
    tree = FrameTree()
    tree.add("/base", "camera", 0, (1.0, 0.0, 0.0), STRAIGHT, True)
    assert place(tree, "base", "/camera", 0) == [1.0, 0.0, 0.0]
    assert tree.frames() == ("base", "camera")


def test_roots_and_rigid_roots() -> None:
    """The top of the tree, and the top of what moves as one."""
    tree = robot_tree()
    assert tree.root_of("optical") == "odom"
    assert tree.root_of("nowhere") is None
    assert tree.static_root_of("optical") == "base_link"
    assert tree.is_static_path("imu", "optical")
    assert not tree.is_static_path("odom", "optical")


def test_how_far_a_pair_is_known() -> None:
    """A streaming reader can tell whether to wait."""
    tree = robot_tree()
    assert tree.known_until("odom", "optical") == 4 * SECOND
    assert tree.known_until("imu", "optical") == FOREVER


def test_order_of_arrival_does_not_matter() -> None:
    """Late transforms go where they belong; of two with one stamp the first stays."""
    tree = FrameTree()
    for second in (3, 0, 2, 1):
        tree.add("odom", "base", second * SECOND, (float(second), 0.0, 0.0), STRAIGHT, False)
    assert not tree.add("odom", "base", 2 * SECOND, (99.0, 0.0, 0.0), STRAIGHT, False)
    assert place(tree, "odom", "base", 5 * SECOND // 2) == [2.5, 0.0, 0.0]


def test_the_first_of_two_parents_wins() -> None:
    """The second is ignored, counted and told."""
    tree = robot_tree()
    for second in range(3):
        assert not tree.add("map", "base_link", second, (9.0, 9.0, 9.0), STRAIGHT, False)
    assert place(tree, "odom", "base_link", 0) == [0.0, 0.0, 0.0]
    assert tree.problems() == [
        "`base_link` has two parents, `odom` and `map`; the first is used (3 transforms ignored)"
    ]


def test_loops_are_left_open() -> None:
    """An edge that would close a loop is refused, a frame that is its own parent too."""
    tree = robot_tree()
    assert not tree.add("optical", "odom", 0, (0.0, 0.0, 0.0), STRAIGHT, True)
    assert not tree.add("odom", "odom", 0, (0.0, 0.0, 0.0), STRAIGHT, True)
    assert len(tree.problems()) == 2
    assert all("loop" in problem for problem in tree.problems())


@pytest.mark.parametrize(
    ("translation", "orientation"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.2)),
        ((math.nan, 0.0, 0.0), STRAIGHT),
        ((0.0, 0.0), STRAIGHT),
    ],
)
def test_poses_that_are_none_are_counted(translation: tuple[float, ...], orientation: tuple[float, ...]) -> None:
    """A transform that is no rigid motion never gets into the tree."""
    tree = FrameTree()
    assert not tree.add("base", "camera", 0, translation, orientation, True)
    assert tree.frames() == ()
    assert "no unit quaternion" in tree.problems()[0]


def test_a_static_transform_sent_again_replaces() -> None:
    """As in ROS; but one cannot be both static and moving."""
    tree = robot_tree()
    tree.add("base_link", "imu", 5, (0.0, 0.0, 0.3), STRAIGHT, True)
    assert place(tree, "base_link", "imu", 0) == [0.0, 0.0, 0.3]
    assert not tree.add("base_link", "imu", 5, (0.0, 0.0, 0.4), STRAIGHT, False)
    assert "static and as moving" in tree.problems()[0]


def test_forgetting_keeps_what_is_still_needed() -> None:
    """Look-ups from the stamp on give the same, and memory stays that of the window."""
    tree = robot_tree()
    for second in range(5, 1000):
        tree.add("odom", "base_link", second * SECOND, (float(second), 0.0, 0.0), STRAIGHT, False)
        tree.forget_before((second - 2) * SECOND - 1)
    assert place(tree, "odom", "base_link", 997 * SECOND - 1) is not None
    assert place(tree, "odom", "base_link", 900 * SECOND) is None
    assert place(tree, "base_link", "optical", 0) == [0.1, 0.0, 0.5]


def test_a_flood_of_frames_is_bounded() -> None:
    """A damaged log that names a new frame in every message cannot fill the memory."""
    tree = FrameTree()
    for index in range(10_500):
        tree.add("root", f"frame{index}", 0, (0.0, 0.0, 0.0), STRAIGHT, True)
    assert len(tree.frames()) <= 10_000
    assert "more than 10000 frames" in tree.problems()[0]


@given(st.lists(st.integers(0, 50), max_size=30), st.integers(-5, 55), st.integers(0, 60))
def test_a_timeline_brackets_like_a_sorted_list(stamps: list[int], wanted: int, gap: int) -> None:
    """Any order of arrival, duplicates included, against the definition."""
    timeline: Timeline[int] = Timeline()
    for stamp in stamps:
        timeline.add(stamp, stamp)
    found = timeline.bracket(wanted, gap)
    before, after = [s for s in stamps if s <= wanted], [s for s in stamps if s >= wanted]
    if wanted in stamps:
        assert found == (wanted, wanted, 0.0)
    elif not before or not after or min(after) - max(before) > gap:
        assert found is None
    else:
        low, high = max(before), min(after)
        assert found == (low, high, (wanted - low) / (high - low))
    timeline.forget_before(wanted)
    if before and after:
        assert timeline.bracket(wanted, gap) == found
    assert len(timeline) == len({s for s in stamps if s >= (max(before) if before else wanted)})


@given(st.floats(0, 1), st.floats(-3, 3))
def test_interpolated_turns_are_even(fraction: float, turn: float) -> None:
    """Between two samples the heading changes in proportion to time."""
    tree = FrameTree()
    for stamp, heading in ((0, 0.0), (SECOND, turn)):
        rotation = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        tree.add("odom", "base", stamp, (0.0, 0.0, 0.0), rotation, False)
    stamp = round(fraction * SECOND)
    heading = turn * stamp / SECOND
    expected = matrix_from_pose((0, 0, 0), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)))
    assert tree.lookup("odom", "base", stamp, SECOND) == pytest.approx(expected, abs=1e-9)
