"""What a simulated home consists of: looks, meshes, furniture, the building, lights, and who walks about.

Frame `world`: metres, z up, floor at z = 0, origin near the middle of the home. A piece of furniture stands in its own
frame: centre of the footprint at the origin, floor at z = 0, front towards +x, y to the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Colour: TypeAlias = tuple[float, float, float]
"""Red, green, blue; 0 to 1."""
Vector: TypeAlias = tuple[float, float, float]
"""x, y, z, metres."""
Array: TypeAlias = NDArray[np.float64]

CLASSES: tuple[str, ...] = (
    "chair",
    "table",
    "sofa",
    "bed",
    "bookshelf",
    "dresser",
    "plant",
    "lamp",
    "tv",
    "bin",
    "refrigerator",
    "toilet",
)
"""Classes of objects; a class id of the simulator is an index into them."""


@dataclass(frozen=True)
class Look:
    """What a surface looks like: a pattern of `textures.PATTERNS` in these colours."""

    pattern: str
    colours: tuple[Colour, ...]
    tile_m: float = 1.0
    """Edge of the square that one texture tile covers, metres."""
    shine: float = 0.0
    """Strength of highlights, 0 to 1."""
    glow: float = 0.0
    """Light that it gives off by itself, 0 to 1."""
    seed: int = 0
    """Of the pattern's randomness; two looks with different seeds differ in detail, not in kind."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, counter-clockwise seen from outside. Corners that should look sharp have vertices of their own."""

    vertices: NDArray[np.float32]
    """(V, 3) metres."""
    normals: NDArray[np.float32]
    """(V, 3) unit length."""
    uv: NDArray[np.float32]
    """(V, 2) place on the texture, metres along the surface."""
    faces: NDArray[np.int32]
    """(F, 3) indices of vertices."""


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh and its look."""

    mesh: Mesh
    look: Look


@dataclass(frozen=True)
class Top:
    """A level surface on which small things may stand: a rectangle in the frame of its piece."""

    z_m: float
    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Piece:
    """One piece of furniture in its own frame."""

    class_name: str
    style: str
    parts: tuple[Part, ...]
    footprint: Array
    """(N, 2) outline of its projection on the floor, counter-clockwise, simple, may be concave."""
    height_m: float
    tops: tuple[Top, ...] = ()

    @property
    def depth_m(self) -> float:
        """Extent along x."""
        return float(np.ptp(self.footprint[:, 0]))

    @property
    def width_m(self) -> float:
        """Extent along y."""
        return float(np.ptp(self.footprint[:, 1]))


@dataclass(frozen=True, eq=False)
class Placed:
    """An object as it stands in the home."""

    instance: int
    """From 1, unique in the home, also in the instance images."""
    piece: Piece
    x_m: float
    y_m: float
    yaw_rad: float
    z_m: float = 0.0
    """Height of what it stands on (a tv on its bench); 0 on the floor."""

    @property
    def class_name(self) -> str:
        return self.piece.class_name

    @property
    def class_id(self) -> int:
        """Index into CLASSES."""
        return CLASSES.index(self.piece.class_name)

    @property
    def footprint(self) -> Array:
        """(N, 2) outline in the world frame."""
        return np.asarray(self.piece.footprint @ turn(self.yaw_rad).T + (self.x_m, self.y_m))


FLOOR_KINDS = ("floor", "rug")
"""Fixtures that one can drive over."""
SKY_KINDS = ("ceiling",)
"""Fixtures that are no obstacle because they are overhead."""


@dataclass(frozen=True, eq=False)
class Fixture:
    """What belongs to the building, or a loose thing that is no object of the class list; parts in the world frame."""

    kind: str
    """floor, rug, ceiling, wall, door, window, picture, curtain, clutter, ..."""
    parts: tuple[Part, ...]
    footprint: Array | None = None
    """(N, 2) outline of what stops a robot, world frame; None where nothing does."""


@dataclass(frozen=True)
class Light:
    """A lamp; `point` lights shine from `position` in all directions, `sun` along `direction`."""

    kind: str
    position: Vector
    direction: Vector
    colour: Colour
    """Brightness included: may exceed 1."""
    shadow: bool = False
    fade: Vector = (1.0, 0.0, 0.0)
    """Attenuation 1 / (a + b d + c d^2), of point lights."""


@dataclass(frozen=True)
class Room:
    """A rectangle of floor, inner sides of its walls."""

    name: str
    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Walker:
    """A person-sized thing that walks to and fro between two points at constant speed, turning at once at the ends."""

    instance: int
    piece: Piece
    """class_name is `person`."""
    start: tuple[float, float]
    end: tuple[float, float]
    speed_m_s: float
    phase_s: float = 0.0

    def pose(self, time_s: float) -> tuple[float, float, float]:
        """x, y and heading at a time: metres, radians."""
        along = np.subtract(self.end, self.start)
        length = float(np.hypot(*along))
        way = ((time_s + self.phase_s) * self.speed_m_s) % (2 * length)
        back = way > length
        share = (2 * length - way if back else way) / length
        heading = math.atan2(along[1], along[0]) + (math.pi if back else 0.0)
        return float(self.start[0] + share * along[0]), float(self.start[1] + share * along[1]), heading


@dataclass(frozen=True, eq=False)
class Home:
    """Everything there is to see and to bump into."""

    seed: int
    variant: str
    day: int
    rooms: tuple[Room, ...]
    outline: tuple[Array, ...]
    """Polygons (N, 2) whose union is the floor, doorways included: rooms and the gaps between them."""
    height_m: float
    objects: tuple[Placed, ...]
    fixtures: tuple[Fixture, ...]
    lights: tuple[Light, ...]
    """Always LIGHTS of them; a light that is off is black."""
    start: tuple[float, float]
    """Where trajectories begin, free floor near the middle of the home."""
    walker: Walker | None = None

    classes: tuple[str, ...] = field(default=CLASSES)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Least x, least y, greatest x, greatest y of the floor."""
        points = np.concatenate(self.outline)
        (x0, y0), (x1, y1) = points.min(0), points.max(0)
        return float(x0), float(y0), float(x1), float(y1)


LIGHTS = 4
"""Lights of every home: the renderer compiles for a fixed number."""


def turn(yaw_rad: float) -> Array:
    """(2, 2) rotation by `yaw_rad`."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, -sin], [sin, cos]])
