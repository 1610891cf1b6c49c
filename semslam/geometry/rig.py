"""The rig: which frame is the robot's body, how the camera sits on it, and how it is tilted against gravity.

Frames of this module: `camera` is the optical frame of the colour camera; `body` is the robot's own frame, x forward,
y left, z up, tilted as the robot is; `level` shares its origin and heading, but its z axis is vertical. A robot frame
of data_spec.md is `level` with z counted from the floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frame_tree import FrameTree
from semslam.geometry.frames import FLU_FROM_OPTICAL, Matrix
from semslam.geometry.levelling import level_rotation, roll_pitch

Vector = NDArray[np.float64]

BASE_FRAMES = ("base_footprint", "base_link", "base")
"""Names of a ground robot's body, by convention level when nothing says otherwise (ROS REP 105)."""
GRAVITY_FRAMES = ("map", "odom", "world", "earth")
"""Names of frames whose z axis is vertical by convention (ROS REP 105)."""
MAX_GAP_NANOS = 500_000_000
"""Moving transforms further apart than this are not interpolated."""
ASSUMED_HEIGHT_M = 1.0
"""Camera height when nothing tells it; the stage warns."""


@dataclass(frozen=True)
class Attitude:
    """The camera on the levelled robot at one moment."""

    level_from_camera: Matrix
    """(4, 4); translation from the body's origin, along level axes."""
    roll_rad: float
    pitch_rad: float
    source: str
    """tf, imu or none."""


@dataclass(frozen=True)
class Rig:
    """Decided once a log, from its frame tree."""

    body: str
    """Frame of the robot's body; empty if nothing carries the camera: its own axes, turned to forward-left-up."""
    camera: str
    imu: str
    levelling: str
    """auto, tf, imu or none, as configured."""
    notes: tuple[str, ...]
    """What had to be assumed, for the user."""

    @property
    def is_base(self) -> bool:
        """Whether the body is a ground robot's base."""
        return self.body in BASE_FRAMES

    def attitude(self, tree: FrameTree, stamp_nanos: int, up_in_imu: Vector | None) -> Attitude | None:
        """Camera and tilt at a stamp; None while tf cannot say where the camera sits."""
        body_from_camera = self.body_from(tree, self.camera, stamp_nanos)
        if body_from_camera is None:
            return None
        up, source = self._up_in_body(tree, stamp_nanos, up_in_imu)
        level_from_body = np.eye(4)
        level_from_body[:3, :3] = level_rotation(up)
        roll, pitch = roll_pitch(up)
        return Attitude(level_from_body @ body_from_camera, roll, pitch, source)

    def body_from(self, tree: FrameTree, frame: str, stamp_nanos: int) -> Matrix | None:
        """body_from_frame at a stamp, if tf connects the two."""
        if self.body:
            return tree.lookup(self.body, frame, stamp_nanos, MAX_GAP_NANOS) if frame else None
        camera_from_frame = np.eye(4) if frame == self.camera else None
        if camera_from_frame is None and frame:
            camera_from_frame = tree.lookup(self.camera, frame, stamp_nanos, MAX_GAP_NANOS)
        return None if camera_from_frame is None else FLU_FROM_OPTICAL @ camera_from_frame

    def _up_in_body(self, tree: FrameTree, stamp_nanos: int, up_in_imu: Vector | None) -> tuple[Vector, str]:
        if self.levelling in ("auto", "tf"):
            up = self._up_from_tf(tree, stamp_nanos)
            if up is not None:
                return up, "tf"
        if self.levelling in ("auto", "imu") and up_in_imu is not None:
            body_from_imu = self.body_from(tree, self.imu, stamp_nanos)
            if body_from_imu is None:
                return up_in_imu, "imu"
            return np.asarray(body_from_imu[:3, :3] @ up_in_imu), "imu"
        return np.array([0.0, 0.0, 1.0]), "none"

    def _up_from_tf(self, tree: FrameTree, stamp_nanos: int) -> Vector | None:
        root = tree.root_of(self.body) if self.body else None
        if root in GRAVITY_FRAMES and root != self.body:
            gravity_from_body = tree.lookup(root, self.body, stamp_nanos, MAX_GAP_NANOS)
            if gravity_from_body is not None:
                return np.asarray(gravity_from_body[2, :3])  # the third row: level z axis in body coordinates
        return np.array([0.0, 0.0, 1.0]) if self.is_base else None


def decide_rig(tree: FrameTree, *, camera: str, imu: str, odometry_child: str, wanted: str, levelling: str) -> Rig:
    """Choose the body frame and say what had to be assumed.

    Args:
        tree: frames seen so far.
        camera: frame of the colour image; empty if its messages name none.
        imu: frame of the IMU, likewise.
        odometry_child: frame whose motion the odometry tells, likewise.
        wanted: body frame asked for in the configuration; empty to choose.
        levelling: auto, tf, imu or none.

    Raises:
        SemslamError: the wanted frame is not connected to the camera.
    """
    camera, imu, odometry_child = camera.lstrip("/"), imu.lstrip("/"), odometry_child.lstrip("/")
    body = _body(tree, camera, odometry_child, wanted.lstrip("/"))
    notes = []
    if not body:
        notes.append("tf says nothing about where the camera sits: it is taken to look along the robot's x axis")
    elif not _connected(tree, body, odometry_child) and odometry_child:
        notes.append(f"tf does not connect `{odometry_child}` to `{body}`: they are taken to move as one, levelled")
    uses_imu = levelling == "imu" or (levelling == "auto" and body not in BASE_FRAMES)
    if uses_imu and imu and not _connected(tree, body or camera, imu):
        notes.append(f"tf does not connect `{imu}` to `{body or camera}`: their axes are taken to be parallel")
    return Rig(body, camera, imu, levelling, tuple(notes))


def _body(tree: FrameTree, camera: str, odometry_child: str, wanted: str) -> str:
    if wanted:
        if not _connected(tree, wanted, camera):
            raise SemslamError(
                f"Robot frame `{wanted}` is not connected to the camera's frame `{camera}`",
                details="frames in the log: " + (", ".join(tree.frames()) or "none"),
                hint="name another one with `--set ingest.robot_frame=NAME`",
            )
        return wanted
    for name in (*BASE_FRAMES, odometry_child):
        if name and _connected(tree, name, camera):
            return name
    root = tree.static_root_of(camera)
    return "" if root is None or root == camera else root


def _connected(tree: FrameTree, one: str, other: str) -> bool:
    return bool(one and other) and (one == other or tree.known_until(one, other) is not None)
