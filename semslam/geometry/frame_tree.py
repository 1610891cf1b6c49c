"""The tree of coordinate frames that a log describes (ROS tf, Foxglove FrameTransform), looked up at any stamp.

Logs are not always trees. What contradicts an earlier transform is refused and counted, never guessed: the first parent
of a frame wins, an edge that would close a loop is left out, and `problems` tells what was found.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from semslam.geometry.frames import QUATERNION_TOLERANCE, Matrix, interpolate, invert, matrix_from_pose
from semslam.geometry.timeline import Timeline

FOREVER = 2**63 - 1
"""Stamp until which a static transform is known."""

MAX_FRAMES = 10_000
"""Frames kept; a damaged log that names more is refused beyond, so that memory stays bounded."""

Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Translation in metres and orientation (x, y, z, w), as the log has them."""


@dataclass
class _Edge:
    """How a frame hangs on its parent: one pose for ever, or poses by stamp."""

    parent: str
    static: Pose | None
    moving: Timeline[Pose] = field(default_factory=Timeline)

    def parent_from_child(self, stamp_nanos: int, max_gap_nanos: int) -> Matrix | None:
        if self.static is not None:
            return matrix_from_pose(*self.static)
        found = self.moving.bracket(stamp_nanos, max_gap_nanos)
        if found is None:
            return None
        before, after, fraction = found
        if fraction == 0.0:
            return matrix_from_pose(*before)
        return interpolate(matrix_from_pose(*before), matrix_from_pose(*after), fraction)


class FrameTree:
    """Frames and the transforms between them. Leading slashes of names (ROS 1) do not count."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._frames: dict[str, None] = {}  # a set that keeps the order of appearance
        self._refused: Counter[tuple[str, str, str]] = Counter()

    def add(
        self,
        parent: str,
        child: str,
        stamp_nanos: int,
        translation: Sequence[float],
        orientation: Sequence[float],
        static: bool,
    ) -> bool:
        """Take in parent_from_child: metres, quaternion (x, y, z, w). False if it is refused and counted.

        A static transform sent again replaces the earlier one, as in ROS; of moving ones with equal stamps the first
        stays.
        """
        parent, child = _name(parent), _name(child)
        edge = self._edges.get(child)
        trouble = self._trouble(parent, child, edge, translation, orientation, static)
        if trouble:
            self._refuse(trouble, parent, child)
            return False
        x, y, z = (float(value) for value in translation)
        qx, qy, qz, qw = (float(value) for value in orientation)
        pose: Pose = ((x, y, z), (qx, qy, qz, qw))
        if edge is None:
            edge = self._edges[child] = _Edge(parent, pose if static else None)
            self._frames.setdefault(parent)
            self._frames.setdefault(child)
        if static:
            edge.static = pose
            return True
        return edge.moving.add(int(stamp_nanos), pose)

    def _trouble(
        self,
        parent: str,
        child: str,
        edge: _Edge | None,
        translation: Sequence[float],
        orientation: Sequence[float],
        static: bool,
    ) -> str:
        """What is wrong with a transform, in a word of `_PROBLEMS`; empty if nothing is."""
        if not parent or not child:
            return "nameless"
        if not _is_pose(translation, orientation):
            return "no_rotation"
        if edge is not None:
            if edge.parent != parent:
                return "second_parent"
            return "static_and_moving" if static != (edge.static is not None) else ""
        if child == parent or child in self._ancestors(parent):
            return "cycle"
        if len(self._frames) + 2 > MAX_FRAMES and not {parent, child} <= self._frames.keys():
            return "too_many"
        return ""

    def _refuse(self, trouble: str, parent: str, child: str) -> None:
        key = ("too_many", "", "") if trouble == "too_many" else (trouble, parent, child)
        if key in self._refused or len(self._refused) < MAX_FRAMES:
            self._refused[key] += 1

    def lookup(self, parent: str, child: str, stamp_nanos: int, max_gap_nanos: int) -> Matrix | None:
        """parent_from_child at a stamp, between any two connected frames.

        Moving transforms are interpolated between the samples around the stamp. None if there is no path, if the stamp
        lies outside the samples (nothing is extrapolated), or if the two samples are further apart than the gap.
        """
        path = self._path(parent, child)
        if path is None:
            return None
        up, down = path  # frames below the common ancestor, from the parent's side and from the child's
        parent_from_common = self._chain(up, stamp_nanos, max_gap_nanos)
        child_from_common = self._chain(down, stamp_nanos, max_gap_nanos)
        if parent_from_common is None or child_from_common is None:
            return None
        return np.asarray(parent_from_common @ invert(child_from_common))

    def _chain(self, frames: Sequence[str], stamp_nanos: int, max_gap_nanos: int) -> Matrix | None:
        """lowest_from_common along frames given from the lowest upwards."""
        lowest_from_common: Matrix = np.eye(4)
        for frame in frames:
            parent_from_frame = self._edges[frame].parent_from_child(stamp_nanos, max_gap_nanos)
            if parent_from_frame is None:
                return None
            lowest_from_common = lowest_from_common @ invert(parent_from_frame)
        return lowest_from_common

    def _path(self, parent: str, child: str) -> tuple[list[str], list[str]] | None:
        """Frames from either end up to, not including, the common ancestor; None without a path."""
        parent, child = _name(parent), _name(child)
        if parent not in self._frames or child not in self._frames:
            return ([], []) if parent == child and parent else None
        from_parent, from_child = self._ancestors(parent), self._ancestors(child)
        if from_parent[-1] != from_child[-1]:
            return None
        shared = 0
        while shared < min(len(from_parent), len(from_child)) and from_parent[-1 - shared] == from_child[-1 - shared]:
            shared += 1
        return from_parent[:-shared], from_child[:-shared]

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None:
            chain.append(edge.parent)
        return chain

    def is_static_path(self, parent: str, child: str) -> bool:
        """Whether the two frames are connected by static transforms alone."""
        path = self._path(parent, child)
        return path is not None and all(self._edges[frame].static is not None for frame in path[0] + path[1])

    def known_until(self, parent: str, child: str) -> int | None:
        """The newest stamp at which the pair can be looked up; `FOREVER` if all is static, None without a path.

        A streaming reader waits until this passes the stamp it needs.
        """
        path = self._path(parent, child)
        if path is None:
            return None
        moving = [self._edges[frame].moving.last for frame in path[0] + path[1] if self._edges[frame].static is None]
        return min((stamp for stamp in moving if stamp is not None), default=FOREVER)

    def known_between(self, parent: str, child: str) -> tuple[int, int] | None:
        """The oldest and newest stamps at which the pair can be looked up; None without a path or without samples."""
        path = self._path(parent, child)
        if path is None:
            return None
        moving = [self._edges[frame].moving for frame in path[0] + path[1] if self._edges[frame].static is None]
        ends = [(line.first, line.last) for line in moving if line.first is not None and line.last is not None]
        if len(ends) < len(moving):
            return None
        return max((first for first, _ in ends), default=-FOREVER), min((last for _, last in ends), default=FOREVER)

    def root_of(self, frame: str) -> str | None:
        """The topmost frame above `frame`; None if the tree has no such frame."""
        frame = _name(frame)
        return self._ancestors(frame)[-1] if frame in self._frames else None

    def static_root_of(self, frame: str) -> str | None:
        """The topmost frame that `frame` is rigidly fixed to (possibly itself); None if the tree has no such frame."""
        frame = _name(frame)
        if frame not in self._frames:
            return None
        while (edge := self._edges.get(frame)) is not None and edge.static is not None:
            frame = edge.parent
        return frame

    def frames(self) -> tuple[str, ...]:
        """All frames in the order of their first appearance."""
        return tuple(self._frames)

    def roots(self) -> tuple[str, ...]:
        """Frames without a parent, in the order of their first appearance."""
        return tuple(frame for frame in self._frames if frame not in self._edges)

    def forget_before(self, stamp_nanos: int) -> None:
        """Drop moving samples that no lookup at or after the stamp can need."""
        for edge in self._edges.values():
            edge.moving.forget_before(stamp_nanos)

    def problems(self) -> list[str]:
        """What a person should know about the tree, a sentence each; empty if all is well."""
        roots = self.roots()
        found = []
        if len(roots) > 1:
            shown = ", ".join(f"`{root}`" for root in roots[:8]) + (", ..." if len(roots) > 8 else "")
            found.append(f"{len(roots)} separate trees, with roots {shown}")
        for (trouble, parent, child), times in self._refused.items():
            kept = self._edges[child].parent if child in self._edges else ""
            text = _PROBLEMS[trouble].format(parent=parent, child=child, kept=kept)
            found.append(f"{text} ({times} {'transform' if times == 1 else 'transforms'} ignored)")
        return found


_PROBLEMS = {
    "nameless": "transform from `{child}` to `{parent}` lacks a frame name",
    "no_rotation": "transform from `{child}` to `{parent}` has no finite position or no unit quaternion",
    "second_parent": "`{child}` has two parents, `{kept}` and `{parent}`; the first is used",
    "static_and_moving": "transform from `{child}` to `{parent}` is sent as static and as moving; the first is used",
    "cycle": "transform from `{child}` to `{parent}` would close a loop",
    "too_many": f"more than {MAX_FRAMES} frames",
}


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _is_pose(translation: Sequence[float], orientation: Sequence[float]) -> bool:
    if len(translation) != 3 or len(orientation) != 4:
        return False
    if not all(math.isfinite(value) for value in (*translation, *orientation)):
        return False
    return abs(math.hypot(*orientation) - 1.0) <= QUATERNION_TOLERANCE
