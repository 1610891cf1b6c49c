"""How well two keyframes agree about the space between them: every pixel of one looked up in the other.

Alignment of surfaces tells how to move, and is easily content: a wall slides along a wall. This tells whether the
result is right. Seen from the true pose, all depth of one picture is found again in the other; from a wrong one edges
do not meet and things hang in space that was seen through. Where one picture looks past or behind what the other saw
nothing is said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix, invert
from semslam.slam.estimator import View

_COLUMNS = 160
"""Samples along a row of the picture, about; every second of every second row is looked up."""
_NEAREST_M = 0.3
_NOISE_M, _NOISE_PER_M = 0.01, 0.004
"""Differences of depth are measured in _NOISE_M + _NOISE_PER_M * depth^2: noise, and rounding to a sample."""
WORST = 1.6
"""Mean difference, in standard deviations, above which two pictures do not show the same place."""
_MOST = 3.0
"""A larger difference counts as this."""
_NOWHERE = np.float32(-1e4)
"""A pixel outside of any picture."""
_LONGEST_ROW = 1024
_STRANGERS, _STRANGERS_SURE = 0.12, 0.05
"""Share of samples that hang in space that was seen through, up to which two pictures may show the same place: people
walk. At right poses it is 0.01 in simulated homes and 0.04 in a real recording; at wrong ones, found in logs of robots
that had been carried, 0.065 to 0.22."""
_STRANGE = 6.0
"""What a sample counts, beyond its difference, that hangs in space that was seen through."""
_TOLD_SURE = 0.1
"""Share of samples that must be found again where nothing but the pictures speaks for a pose; of keyframes a second
apart 0.15 to 0.6 are."""


@dataclass(frozen=True)
class Agreement:
    """What came of looking one picture up in another, and the other in the one."""

    difference: float
    """Sum of differences of depth, each 0 to 3 standard deviations."""
    looked_up: int
    """Samples that fell on one with depth."""
    hidden: int = 0
    """Those of them that lie behind what was measured, by 3 standard deviations or more: seen from elsewhere alone."""
    strangers: int = 0
    """Those that lie as far before it: where one picture has a thing the other looked through."""

    @property
    def mean(self) -> float:
        """Difference of a sample; 3, the worst, where there was none."""
        return self.difference / self.looked_up if self.looked_up else _MOST

    @property
    def dissent(self) -> float:
        """Difference of a sample, those that hang in seen-through space counting more: what is merely hidden may be so
        from elsewhere. 0 without any."""
        return (self.difference + _STRANGE * self.strangers) / max(1, self.looked_up)

    @property
    def told(self) -> int:
        """Samples that say whether the place is the same: those that are not hidden."""
        return self.looked_up - self.hidden

    def same_place(self, samples: int, *, sure: bool) -> bool:
        """Whether the pictures show one place, of whose `samples` these were found.

        Args:
            samples: of the pictures, wherever they fall.
            sure: the pictures alone must tell; else motion says the same already.
        """
        if sure:
            return self.alike and self.told >= _TOLD_SURE * samples
        return self.mean <= WORST and self.told >= 1 and self.strangers <= _STRANGERS * self.told

    @property
    def alike(self) -> bool:
        """Whether hardly anything of what the pictures have in common speaks against their showing one place."""
        return self.mean <= WORST and self.told >= 1 and self.strangers <= _STRANGERS_SURE * self.told

    def __add__(self, other: Agreement) -> Agreement:
        return Agreement(
            self.difference + other.difference,
            self.looked_up + other.looked_up,
            self.hidden + other.hidden,
            self.strangers + other.strangers,
        )


@dataclass(frozen=True, eq=False)
class Sight:
    """A thinned depth image and its camera."""

    depth_m: NDArray[np.float32]
    """(h, w), 0 where missing or too far."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy of the thinned image."""
    robot_from_camera: Matrix

    @staticmethod
    def of(view: View, max_depth_m: float) -> Sight:
        """Samples of a picture."""
        step = max(1, round(view.depth_m.shape[1] / _COLUMNS))
        depth = view.depth_m[step // 2 :: step, step // 2 :: step]
        known = (depth > _NEAREST_M) & (depth < max_depth_m)
        inner = ((view.cx - step // 2) / step, (view.cy - step // 2) / step)
        thinned = np.where(known, depth, np.float32(0)).astype(np.float32)
        return Sight(thinned, (view.fx / step, view.fy / step, *inner), view.robot_from_camera)

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """(M, 3) robot frame, of every second sample of every second row."""
        rows, columns = np.nonzero(self.depth_m[::2, ::2])
        depth = self.depth_m[::2, ::2][rows, columns].astype(np.float64)
        fx, fy, cx, cy = self.intrinsics
        x, y = (2 * columns - cx) / fx, (2 * rows - cy) / fy
        in_camera = np.stack([x, y, np.ones_like(x)], 1) * depth[:, None]
        in_robot = in_camera @ self.robot_from_camera[:3, :3].T + self.robot_from_camera[:3, 3]
        return in_robot.astype(np.float32)

    def look_up(self, points: NDArray[np.float32], robot_from_points: Matrix) -> Agreement:
        """Points (M, 3) of another frame in this picture."""
        if not len(points):
            return Agreement(0.0, 0)
        camera_from_points = (invert(self.robot_from_camera) @ robot_from_points).astype(np.float32)
        x, y, depth = camera_from_points[:3, :3] @ points.T + camera_from_points[:3, 3:]
        ahead = depth > _NEAREST_M
        scale = np.divide(np.float32(1.0), depth, out=np.zeros_like(depth), where=ahead)
        fx, fy, cx, cy = (np.float32(value) for value in self.intrinsics)
        column, row = np.where(ahead, x * scale * fx + cx, _NOWHERE), y * scale * fy + cy
        measured = _sampled(self.depth_m, column, row)
        known = measured > 0
        measured, depth = measured[known], depth[known]
        behind = (depth - measured) / (_NOISE_M + _NOISE_PER_M * measured * measured)
        difference = float(np.minimum(np.abs(behind), _MOST).sum(dtype=np.float64))
        return Agreement(difference, len(behind), int((behind >= _MOST).sum()), int((behind <= -_MOST).sum()))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything, to be kept."""
        return {
            "depth": self.depth_m,
            "intrinsics": np.array(self.intrinsics),
            "robot_from_camera": self.robot_from_camera,
        }

    @staticmethod
    def from_arrays(arrays: dict[str, NDArray[Any]]) -> Sight:
        """The inverse of `arrays`."""
        fx, fy, cx, cy = arrays["intrinsics"].tolist()
        return Sight(arrays["depth"], (fx, fy, cx, cy), arrays["robot_from_camera"])


def _sampled(image: NDArray[np.float32], column: NDArray[np.float32], row: NDArray[np.float32]) -> NDArray[np.float32]:
    """(M,) the nearest pixels; 0 outside."""
    rows = math.ceil(len(column) / _LONGEST_ROW)  # of the maps that remap takes, which are bounded
    where = np.full((2, rows * _LONGEST_ROW), _NOWHERE, np.float32)
    where[0, : len(column)], where[1, : len(row)] = column, row
    maps = where.reshape(2, rows, _LONGEST_ROW)
    found = cv2.remap(image, maps[0], maps[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    return np.asarray(found, np.float32).ravel()[: len(column)]


def agreement(first: Sight, second: Sight, first_from_second: Matrix) -> Agreement:
    """Each looked up in the other."""
    there = first.look_up(second.points, first_from_second)
    return there + second.look_up(first.points, invert(first_from_second))
