"""A room of boxes seen by a depth camera, exactly: rays against boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import FLU_FROM_OPTICAL, SE2, Matrix
from semslam.geometry.grid import Planes
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.slam.estimator import Step, View
from semslam.slam.surfel.surfels import surfels_of
from tests.slam_world import CELL_M, CLASSES, SIDE

SECOND = 1_000_000_000
WIDTH, HEIGHT, FOCAL_PX = 160, 120, 80.0
ROBOT_FROM_CAMERA: Matrix = FLU_FROM_OPTICAL.copy()
ROBOT_FROM_CAMERA[:3, 3] = 0.05, 0.0, 0.5


@dataclass(frozen=True)
class Room:
    """A room from lower to upper corner (3,), and boxes (N, 2, 3) in it, in the world frame, metres."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    boxes: NDArray[np.float64]

    def view(self, world_from_robot: Matrix, noise: np.random.Generator | None = None) -> View:
        """What the camera sees; with noise, as a camera that measures disparity."""
        column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
        rays = np.stack([(column - middle[0]) / FOCAL_PX, (row - middle[1]) / FOCAL_PX, np.ones_like(column)], -1)
        world_from_camera = world_from_robot @ ROBOT_FROM_CAMERA
        in_world = np.moveaxis(rays @ world_from_camera[:3, :3].T, -1, 0)
        depth = self._hit(world_from_camera[:3, 3], np.ascontiguousarray(in_world))
        if noise is not None:
            depth = 1.0 / (1.0 / depth + 0.002 * noise.standard_normal(depth.shape))
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        return View(picture, depth.astype(np.float32), FOCAL_PX, FOCAL_PX, *middle, ROBOT_FROM_CAMERA)

    def _hit(self, origin: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """(H, W) lengths, in units of the rays (3, H, W), to the nearest surface: the far side of the room, the near of
        a box."""
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = ((corner - origin)[:, None, None] / rays for corner in (self.lower, self.upper))
            depth = np.maximum(*walls).min(0)
            for box in self.boxes:
                first, second = ((corner - origin)[:, None, None] / rays for corner in box)
                enter, leave = np.minimum(first, second).max(0), np.maximum(first, second).min(0)
                depth = np.where((enter < leave) & (enter > 0.05), np.minimum(depth, enter), depth)
        return np.asarray(depth)


def make_room(seed: int = 0, boxes: int = 14) -> Room:
    """A room of 7 x 6 m with boxes along its walls and some on them."""
    random = np.random.default_rng(seed)
    lower, upper = np.array([-3.5, -3.0, 0.0]), np.array([3.5, 3.0, 2.5])
    placed = []
    for number in range(boxes):
        size = random.uniform((0.2, 0.2, 0.3), (1.0, 0.7, 1.6))
        along = random.uniform(-1.0, 1.0)
        wall = number % 4
        x, y = ((along * 2.8, 2.9), (along * 2.8, -2.9), (3.4, along * 2.4), (-3.4, along * 2.4))[wall]
        corner = np.array([x, y, 0.0]) - size * (0.5, 0.5, 0.0)
        placed.append((corner, corner + size))
    return Room(lower, upper, np.array(placed))


def make_drive(frames: int = 24) -> list[SE2]:
    """A round through the middle of the room, more than once about, from the origin on."""
    drive = [SE2(0.0, 0.0, 0.0)]
    for number in range(frames - 1):
        turn = 0.75 if number % 6 == 4 else 0.3
        drive.append(drive[-1] @ SE2(0.2, 0.0, turn))
    return drive


def make_views(
    room: Room, drive: Sequence[SE2], *, bias: SE2 | None = None, noise_m: float = 0.0, noise_rad: float = 0.0
) -> list[Step]:
    """What a robot on that drive sees and measures, one keyframe a second."""
    random = np.random.default_rng(1)
    bias = bias or SE2(0.0, 0.0, 0.0)
    steps = [Step(0, 0, None, None, room.view(matrix(drive[0]), random))]
    for frame, (before, now) in enumerate(pairwise(drive), 1):
        true, error = before.between(now), random.standard_normal(3) * (noise_m, noise_m, noise_rad)
        values = np.array([true.x_m + bias.x_m, true.y_m + bias.y_m, true.heading_rad + bias.heading_rad]) + error
        steps.append(Step(frame, frame * SECOND, None, SE2(*values.tolist()), room.view(matrix(now), random)))
    return steps


def symmetric(room: Room) -> Room:
    """The same room with every box again, half a turn about the middle away: it looks the same from both ends."""
    turn = np.array([-1.0, -1.0, 1.0])
    turned = room.boxes * turn
    again = np.stack([turned.min(1), turned.max(1)], 1)
    return Room(room.lower, room.upper, np.concatenate([room.boxes, again]))


def observed(steps: Sequence[Step]) -> list[Step]:
    """The steps with observations: free floor, and chairs where something stands that is half a metre high or less."""
    return [replace(step, observation=_observation(step.view)) for step in steps]


def _observation(view: View | None) -> Planes:
    planes = np.zeros((len(CLASSES), SIDE, SIDE), np.float32)
    if view is not None:
        points = surfels_of(view, 100_000, 6.0).points
        column, row = np.floor(points[:, :2] / CELL_M + SIDE / 2).astype(int).T
        inside = (column >= 0) & (column < SIDE) & (row >= 0) & (row < SIDE) & (points[:, 2] < 2.0)
        column, row, height = column[inside], row[inside], points[inside, 2]
        for class_id, low, high in ((FREE_FLOOR, -1.0, 0.08), (OBSTACLE, 0.08, 2.0), (FIRST_OBJECT, 0.08, 0.6)):
            chosen = (height > low) & (height < high)
            planes[class_id, row[chosen], column[chosen]] = 1.0
    planes[UNOBSERVED] = ~planes[1:].any(0)
    return planes


def matrix(pose: SE2) -> Matrix:
    """A pose on the floor, (4, 4), written out on its own as a second witness."""
    cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return np.array([[cosine, -sine, 0, pose.x_m], [sine, cosine, 0, pose.y_m], [0, 0, 1, 0], [0, 0, 0, 1.0]])
