"""The rig: which frame is the robot, and how the camera is tilted on it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semslam.errors import SemslamError
from semslam.geometry.frame_tree import FrameTree
from semslam.geometry.frames import FLU_FROM_OPTICAL, quaternion_from_matrix, rotation_from_vector
from semslam.geometry.rig import Rig, decide_rig

SECOND = 1_000_000_000
LEVEL = (0.0, 0.0, 0.0, 1.0)


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> tuple[float, ...]:
    """Quaternion of a rotation vector, radians."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_vector([x, y, z])
    return tuple(float(v) for v in quaternion_from_matrix(matrix))


OPTICAL = tuple(float(v) for v in quaternion_from_matrix(FLU_FROM_OPTICAL))


def tree(*links: tuple[str, str, tuple[float, ...], tuple[float, ...]], moving: bool = False) -> FrameTree:
    """A tree from (parent, child, translation, orientation)."""
    built = FrameTree()
    for parent, child, translation, orientation in links:
        for stamp in (0, SECOND // 4) if moving else (0,):
            built.add(parent, child, stamp, translation, orientation, not moving)
    return built


def decide(built: FrameTree, *, odometry: str = "", wanted: str = "", levelling: str = "auto", imu: str = "imu") -> Rig:
    return decide_rig(built, camera="cam", imu=imu, odometry_child=odometry, wanted=wanted, levelling=levelling)


def test_base_is_the_robot_and_level() -> None:
    """With a base frame, the mounting in tf is all the tilt there is."""
    built = tree(("base_link", "mast", (0.1, 0, 1.0), turned(y=0.3)), ("mast", "cam", (0, 0, 0), OPTICAL))
    rig = decide(built)
    assert rig.body == "base_link"
    attitude = rig.attitude(built, 0, np.array([1.0, 0.0, 0.0]))
    assert attitude is not None
    assert attitude.source == "tf"
    assert attitude.level_from_camera[:3, 3] == pytest.approx([0.1, 0, 1.0])
    looking = attitude.level_from_camera[:3, 2]
    assert math.asin(-looking[2]) == pytest.approx(0.3)


def test_world_above_the_base_tells_how_it_leans() -> None:
    """A robot on a ramp of 0.2 rad in tf is levelled by it."""
    built = tree(("base_link", "cam", (0, 0, 1), OPTICAL))
    for stamp in (0, SECOND // 4):
        built.add("map", "base_link", stamp, (0, 0, 0), turned(y=0.2), False)
    attitude = decide(built).attitude(built, SECOND // 8, None)
    assert attitude is not None
    assert attitude.pitch_rad == pytest.approx(0.2)
    assert attitude.level_from_camera[:3, 3] == pytest.approx([math.sin(0.2), 0, math.cos(0.2)])


def test_handheld_camera_is_levelled_by_its_imu() -> None:
    """Without a base, the IMU says where up is, through its own mounting."""
    built = tree(("rig", "cam", (0, 0, 0), OPTICAL), ("rig", "imu", (0, 0, 0), turned(z=math.pi / 2)))
    rig = decide(built, odometry="base_link")
    assert rig.body == "rig"
    assert any("base_link" in note for note in rig.notes)
    up_in_rig = np.array([-math.sin(0.5), 0.0, math.cos(0.5)])  # nose down by half a radian
    up_in_imu = rotation_from_vector([0, 0, -math.pi / 2]) @ up_in_rig
    attitude = rig.attitude(built, 0, up_in_imu)
    assert attitude is not None
    assert attitude.source == "imu"
    assert attitude.pitch_rad == pytest.approx(0.5)
    assert attitude.roll_rad == pytest.approx(0.0, abs=1e-9)


def test_imu_in_the_camera_has_its_axes() -> None:
    """Without any tree, an IMU that names the camera's frame measures along optical axes."""
    rig = decide(FrameTree(), imu="cam")
    assert rig.body == ""
    up_in_camera = np.array([0.0, -math.cos(0.4), -math.sin(0.4)])
    attitude = rig.attitude(FrameTree(), 0, up_in_camera)
    assert attitude is not None
    assert attitude.pitch_rad == pytest.approx(0.4)


def test_levelling_none_leaves_the_camera_as_it_is() -> None:
    """Without levelling, the camera looks along x, tilted or not."""
    rig = decide(FrameTree(), levelling="none")
    attitude = rig.attitude(FrameTree(), 0, np.array([0.0, -1.0, 0.0]))
    assert attitude is not None
    assert attitude.source == "none"
    assert np.allclose(attitude.level_from_camera, FLU_FROM_OPTICAL)


def test_wanted_frame_must_be_connected() -> None:
    """A robot frame that tf does not connect to the camera is an error that lists the frames."""
    built = tree(("rig", "cam", (0, 0, 0), OPTICAL))
    with pytest.raises(SemslamError, match="`turret`") as error:
        decide(built, wanted="turret")
    assert "rig" in error.value.details
    assert decide(built, wanted="/rig").body == "rig"


def test_tree_whose_camera_moves_in_the_world_keeps_the_world_out() -> None:
    """The body is what carries the camera rigidly, not the world it moves in."""
    built = tree(("rig", "cam", (0, 0, 0), OPTICAL))
    built.add("world", "rig", 0, (5, 0, 0), LEVEL, False)
    assert decide(built).body == "rig"
