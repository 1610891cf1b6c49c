"""A home of boxes, an eye that casts rays at them by hand, and a drive along a curve: tests of logs without MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.geometry.frames import FLU_FROM_OPTICAL, Matrix, matrix_from_pose
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.sim.home import (
    LIGHTS,
    Array,
    Fixture,
    Home,
    Light,
    Look,
    Part,
    Piece,
    Placed,
    Room,
    Vector,
    Walker,
)
from semslam.sim.shapes import box

HALF_X_M, HALF_Y_M, HEIGHT_M, WALL_M = 3.0, 2.5, 2.6, 0.16
SPEED_M_S, TURN_RAD_S, RATE_HZ = 0.25, 0.2, 200


def rectangle(low: tuple[float, float], high: tuple[float, float]) -> Array:
    """(4, 2) counter-clockwise."""
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])], np.float64)


def box_piece(class_name: str, depth_m: float, width_m: float, height_m: float) -> Piece:
    """A box of that class."""
    x, y = depth_m / 2, width_m / 2
    return Piece(class_name, "plain", (block((-x, -y, 0), (x, y, height_m)),), rectangle((-x, -y), (x, y)), height_m)


def block(low: Vector, high: Vector) -> Part:
    """A grey box."""
    return Part(box(low, high), Look("paint", ((0.6, 0.55, 0.5),)))


OBJECTS = (
    Placed(1, box_piece("sofa", 0.9, 1.8, 0.8), 2.0, 0.5, math.pi),
    Placed(2, box_piece("chair", 0.45, 0.45, 0.9), 0.8, -1.2, 0.6),
    Placed(3, box_piece("bin", 0.3, 0.3, 0.4), 1.2, 1.7, 0.0),
    Placed(4, box_piece("dresser", 0.5, 1.0, 1.0), -2.6, 0.0, 0.0),
    Placed(5, box_piece("plant", 0.4, 0.4, 1.2), -0.8, 2.0, 0.3),
)


def box_home(objects: tuple[Placed, ...] = OBJECTS, *, walker: bool = False) -> Home:
    """6 x 5 x 2.6 m with walls around."""
    x, y, out = HALF_X_M, HALF_Y_M, WALL_M
    walls = (
        rectangle((-x - out, -y - out), (x + out, -y)),
        rectangle((-x - out, y), (x + out, y + out)),
        rectangle((-x - out, -y), (-x, y)),
        rectangle((x, -y), (x + out, y)),
    )
    fixtures = [
        Fixture("wall", (block((*wall.min(0), 0.0), (*wall.max(0), HEIGHT_M)),), wall)  # type: ignore[arg-type]
        for wall in walls
    ]
    fixtures.append(Fixture("floor", (block((-x, -y, -0.05), (x, y, 0.0)),)))
    fixtures.append(Fixture("ceiling", (block((-x, -y, HEIGHT_M), (x, y, HEIGHT_M + 0.05)),)))
    person = Walker(9, box_piece("person", 0.3, 0.5, 1.7), (-0.5, -1.5), (1.8, -1.5), 0.5)
    return Home(
        7,
        "standard",
        0,
        (Room("living", (-x, -y), (x, y)),),
        (rectangle((-x, -y), (x, y)),),
        HEIGHT_M,
        objects,
        tuple(fixtures),
        (Light("sun", (0, 0, 2), (-0.3, 0.2, -1), (0.4, 0.4, 0.4)),) * LIGHTS,
        (-1.5, -0.5),
        person if walker else None,
    )


@dataclass(frozen=True, eq=False)
class BoxSight:
    """As `eye.Sight`."""

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    instances: NDArray[np.uint16]
    classes: NDArray[np.uint8]
    normals_cos: NDArray[np.float32]


class BoxEye:
    """As `eye.Eye`: exact, flat colours."""

    def __init__(self, home: Home, camera: Camera) -> None:
        self._home = home
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        self._rays = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1
        )  # (H, W, 3)
        self.looks = 0

    def look(self, world_from_camera: Array, time_s: float = 0.0) -> BoxSight:
        """What the rays hit first: floor, ceiling, walls, objects, or who walks about."""
        self.looks += 1
        rays, eye = self._rays @ world_from_camera[:3, :3].T, world_from_camera[:3, 3]
        low, high = np.array([-HALF_X_M, -HALF_Y_M, 0.0]), np.array([HALF_X_M, HALF_Y_M, HEIGHT_M])
        with np.errstate(divide="ignore"):
            exits = np.where(rays > 0, (high - eye) / rays, (low - eye) / rays)
        axis, depth = exits.argmin(-1), exits.min(-1)
        classes = np.select([axis < 2, rays[..., 2] < 0], [OBSTACLE, FREE_FLOOR], UNOBSERVED)
        instances = np.zeros(depth.shape, np.uint16)
        cos = np.abs(np.take_along_axis(rays, axis[..., None], -1)[..., 0]) / np.linalg.norm(rays, axis=-1)
        for item, class_id in self._solids(time_s):
            hit_m, facing = _box_hits(item, eye, rays)
            nearer = hit_m < depth
            depth, cos = np.where(nearer, hit_m, depth), np.where(nearer, facing, cos)
            classes, instances = np.where(nearer, class_id, classes), np.where(nearer, item.instance, instances)
        shade = 60 + 12 * classes + 60 * cos
        rgb = np.stack([shade, 200 - 8.0 * classes, 90 + 90 * cos], -1).clip(0, 255).astype(np.uint8)
        return BoxSight(
            rgb,
            depth.astype(np.float32),
            instances.astype(np.uint16),
            classes.astype(np.uint8),
            cos.astype(np.float32),
        )

    def _solids(self, time_s: float) -> list[tuple[Placed, int]]:
        solids = [(item, FIRST_OBJECT + item.class_id) for item in self._home.objects]
        if self._home.walker is not None:
            x, y, heading = self._home.walker.pose(time_s)
            solids.append((Placed(self._home.walker.instance, self._home.walker.piece, x, y, heading), OBSTACLE))
        return solids


def _box_hits(item: Placed, eye: Array, rays: Array) -> tuple[Array, Array]:
    """Distance along each ray (in rays) to a box, inf where it misses, and the cosine to the face that it hits."""
    cosine, sine = math.cos(item.yaw_rad), math.sin(item.yaw_rad)
    local_from_world = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    start = local_from_world @ (eye - (item.x_m, item.y_m, item.z_m))
    way = rays @ local_from_world.T
    low = np.array([*item.piece.footprint.min(0), 0.0])
    high = np.array([*item.piece.footprint.max(0), item.piece.height_m])
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - start) / way, (high - start) / way
    entry, leave = np.minimum(first, second), np.maximum(first, second)
    axis, near, far = entry.argmax(-1), entry.max(-1), leave.min(-1)
    cos = np.abs(np.take_along_axis(way, axis[..., None], -1)[..., 0]) / np.linalg.norm(way, axis=-1)
    return np.where((near <= far) & (near > 0), near, np.inf), cos


@dataclass(frozen=True)
class BoxRobot:
    """As `vehicle.RobotSpec`."""

    camera_height_m: float = 0.45
    pitch_rad: float = 0.09

    @property
    def base_from_camera(self) -> Matrix:
        """Forward of the wheels, looking ahead and a little down."""
        half = self.pitch_rad / 2
        return matrix_from_pose((0.05, 0.0, self.camera_height_m), (0.0, math.sin(half), 0.0, math.cos(half))) @ (
            FLU_FROM_OPTICAL
        )

    @property
    def base_from_imu(self) -> Matrix:
        """Behind the wheels, level."""
        return matrix_from_pose((-0.03, 0.0, 0.08), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class BoxDrive:
    """As `vehicle.Drive`: a slow bend from (-1.5, -0.5), level, after 0.4 s of standing still."""

    keyframes_s: Array
    times_s: Array = field(init=False)
    positions: Array = field(init=False)
    orientations: Array = field(init=False)
    gyro: Array = field(init=False)
    accel: Array = field(init=False)
    wheel_rad: Array = field(init=False)
    contacts: int = 0

    def __post_init__(self) -> None:
        times = np.arange(round((float(self.keyframes_s[-1]) + 0.3) * RATE_HZ) + 1) / RATE_HZ
        poses = np.array([self._pose(float(time)) for time in times])
        zero = np.zeros(len(times))
        speed = np.where(times > 0.4, 1.0, 0.0)
        set_ = object.__setattr__
        set_(self, "times_s", times)
        set_(self, "positions", np.column_stack([poses[:, :2], zero]))
        set_(self, "orientations", np.column_stack([zero, zero, np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)]))
        set_(self, "gyro", np.column_stack([zero, zero, TURN_RAD_S * speed]))
        set_(self, "accel", np.column_stack([zero, SPEED_M_S * TURN_RAD_S * speed, zero + 9.81]))
        way = SPEED_M_S * np.maximum(times - 0.4, 0.0)
        turned = TURN_RAD_S * np.maximum(times - 0.4, 0.0)
        set_(self, "wheel_rad", np.column_stack([way - 0.08 * turned, way + 0.08 * turned]) / 0.033)

    def _pose(self, time_s: float) -> tuple[float, float, float]:
        heading = TURN_RAD_S * max(0.0, time_s - 0.4) - 0.3
        radius = SPEED_M_S / TURN_RAD_S
        x = radius * (math.sin(heading) - math.sin(-0.3))
        return -1.5 + x, -0.5 - radius * (math.cos(heading) - math.cos(-0.3)), heading

    def world_from_base(self, time_s: float) -> Matrix:
        """Exact at any time."""
        x, y, heading = self._pose(time_s)
        return matrix_from_pose((x, y, 0.0), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)))

    def headings(self) -> Array:
        """Of every sample, not wrapped."""
        return np.array([self._pose(float(time))[2] for time in self.times_s])


def box_drive(frames: int = 3, period_s: float = 1.1) -> BoxDrive:
    """A drive with that many image pairs."""
    return BoxDrive(0.4123 + period_s * np.arange(frames))
