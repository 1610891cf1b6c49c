"""A furnished room: four walls, a table with chairs in the middle, the other pieces along the walls facing in.

The same seed gives the same room. Around the table a corridor stays free that a small robot can drive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tests.toy.furniture import PIECES, Colour, Material, Piece, Solid, pick, shade

CLASSES: tuple[str, ...] = tuple(PIECES)
"""Class names; a class id of the simulator is an index into them."""

_WALLS: tuple[Colour, ...] = ((0.86, 0.84, 0.78), (0.74, 0.80, 0.82), (0.82, 0.76, 0.68), (0.78, 0.82, 0.74))
_FLOORS: tuple[Colour, ...] = ((0.62, 0.46, 0.30), (0.50, 0.36, 0.24), (0.60, 0.58, 0.55))
_PICTURES: tuple[Colour, ...] = ((0.70, 0.30, 0.20), (0.20, 0.40, 0.60), (0.30, 0.55, 0.30), (0.80, 0.65, 0.25))
_GAP_M = 0.12
"""Least free space between two pieces, metres."""


@dataclass(frozen=True)
class RoomObject:
    """One piece of furniture as it stands: footprint rectangle about (x_m, y_m), front towards `yaw_rad`."""

    object_id: int
    class_name: str
    x_m: float
    y_m: float
    yaw_rad: float
    depth_m: float
    width_m: float

    @property
    def class_id(self) -> int:
        """Index into CLASSES."""
        return CLASSES.index(self.class_name)

    @property
    def reach_m(self) -> float:
        """From the centre to a corner."""
        return math.hypot(self.depth_m, self.width_m) / 2

    def corners(self, margin_m: float = 0.0) -> NDArray[np.float64]:
        """(4, 2) corners of the footprint in the room frame, counter-clockwise, grown by a margin."""
        half = np.array([self.depth_m, self.width_m]) / 2 + margin_m
        signs = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])
        return np.asarray(signs * half @ turn(self.yaw_rad).T + (self.x_m, self.y_m))


@dataclass(frozen=True)
class ToyRoom:
    """Everything there is to see; `solids` are the objects' boxes and balls in the room frame."""

    width_m: float
    depth_m: float
    height_m: float
    objects: tuple[RoomObject, ...]
    solids: tuple[Solid, ...]
    wall: Material
    floor: Material
    ceiling: Material


def make_room(seed: int, *, width_m: float = 6.0, depth_m: float = 5.0) -> ToyRoom:
    """The room of that seed: 10 to 12 objects of 6 classes; x from -width/2 to width/2, y from -depth/2 to depth/2.

    Raises:
        ValueError: the room is too small for its furniture.
    """
    if min(width_m, depth_m) < 5.0:
        raise ValueError(f"a toy room needs sides of 5 m or more, not {width_m:g} x {depth_m:g}")
    rng = np.random.default_rng([seed, 0x700])
    placed: list[tuple[Piece, RoomObject]] = []
    for name in _wall_names(rng):
        _add_at_wall(placed, PIECES[name](rng), rng, (width_m, depth_m))
    _add_dining_group(placed, rng, (width_m, depth_m))
    solids = [solid for piece, where in placed for solid in _stand(piece, where)]
    wall, floor = pick(rng, _WALLS), pick(rng, _FLOORS)
    return ToyRoom(
        width_m,
        depth_m,
        2.6,
        tuple(where for _, where in placed),
        tuple(solids + _wall_pictures(rng, (width_m, depth_m))),
        Material("plaster", wall, shade(wall, 0.85)),
        Material("planks", floor, shade(floor, 0.6)),
        Material("plaster", (0.93, 0.93, 0.92), (0.88, 0.88, 0.88)),
    )


def turn(yaw_rad: float) -> NDArray[np.float64]:
    """(2, 2) rotation by `yaw_rad`."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cos, -sin], [sin, cos]])


def overlap(first: RoomObject, second: RoomObject, gap_m: float = 0.0) -> bool:
    """True if the footprints, the first grown by `gap_m`, intersect (separating axis theorem)."""
    if math.hypot(first.x_m - second.x_m, first.y_m - second.y_m) > first.reach_m + second.reach_m + 1.5 * gap_m:
        return False  # circles around them are apart already
    a, b = first.corners(gap_m), second.corners()
    for yaw in (first.yaw_rad, second.yaw_rad):
        along_a, along_b = a @ turn(yaw), b @ turn(yaw)
        if np.any((along_a.max(0) <= along_b.min(0)) | (along_b.max(0) <= along_a.min(0))):
            return False
    return True


def _wall_names(rng: np.random.Generator) -> list[str]:
    names = ["sofa", "tv", "shelf", "plant", "shelf", "plant"]
    return names + ["chair"] * int(rng.integers(2))


def _add_at_wall(
    placed: list[tuple[Piece, RoomObject]], piece: Piece, rng: np.random.Generator, room: tuple[float, float]
) -> None:
    """Stand a piece with its back to a wall: of thirty random free places, the one farthest from other pieces."""
    others = [where for _, where in placed]
    places = [_wall_place(len(placed) + 1, piece, rng, room) for _ in range(30)]
    free = [place for place in places if not any(overlap(place, other, _GAP_M) for other in others)]
    if not free:
        raise ValueError(f"no place left at the walls of a {room[0]:g} x {room[1]:g} m room for a {piece.class_name}")
    placed.append((piece, max(free, key=lambda place: _solitude(place, others))))


def _wall_place(object_id: int, piece: Piece, rng: np.random.Generator, room: tuple[float, float]) -> RoomObject:
    side = int(rng.integers(4))
    along, across = (room[1], room[0]) if side % 2 == 0 else room
    reach = along / 2 - piece.width_m / 2 - 0.05
    inwards = across / 2 - piece.depth_m / 2 - 0.03
    x, y = turn(side * np.pi / 2) @ (-inwards, rng.uniform(-reach, reach))
    return _object(object_id, piece, float(x), float(y), side * np.pi / 2)


def _solitude(place: RoomObject, others: list[RoomObject]) -> float:
    """Distance to the nearest other piece, metres."""
    return min((float(np.hypot(place.x_m - o.x_m, place.y_m - o.y_m)) for o in others), default=0.0)


def _add_dining_group(
    placed: list[tuple[Piece, RoomObject]], rng: np.random.Generator, room: tuple[float, float]
) -> None:
    """The table near the middle, three or four chairs at its long sides, where the room is longer."""
    board = PIECES["table"](rng)
    x, y = rng.uniform(-0.15, 0.15, 2)
    yaw = (0.0 if room[0] >= room[1] else np.pi / 2) + float(rng.uniform(-0.3, 0.3))
    placed.append((board, _object(len(placed) + 1, board, float(x), float(y), yaw)))
    seat = PIECES["chair"](rng)
    places = [(side, along) for side in (1, -1) for along in (-0.29, 0.29)]
    for side, along in places[: int(rng.integers(3, 5))]:
        out = board.depth_m / 2 + seat.depth_m / 2 + float(rng.uniform(0.03, 0.1))
        dx, dy = turn(yaw) @ (side * out, along)
        facing = yaw + (np.pi if side > 0 else 0.0) + float(rng.uniform(-0.1, 0.1))
        placed.append((seat, _object(len(placed) + 1, seat, float(x + dx), float(y + dy), facing)))


def _object(object_id: int, piece: Piece, x: float, y: float, yaw: float) -> RoomObject:
    return RoomObject(object_id, piece.class_name, x, y, float(yaw), piece.depth_m, piece.width_m)


def _stand(piece: Piece, where: RoomObject) -> list[Solid]:
    """The solids of a piece in the room frame."""
    local = np.array([solid.centre_m for solid in piece.solids])
    xy = local[:, :2] @ turn(where.yaw_rad).T + (where.x_m, where.y_m)
    return [
        replace(
            solid,
            centre_m=(float(x), float(y), solid.centre_m[2]),
            yaw_rad=where.yaw_rad + solid.yaw_rad,
            object_id=where.object_id,
        )
        for solid, (x, y) in zip(piece.solids, xy, strict=True)
    ]


def _wall_pictures(rng: np.random.Generator, room: Sequence[float]) -> list[Solid]:
    """One framed picture a wall, above the furniture; part of the room, not objects."""
    solids = []
    for side in range(4):
        along, across = (room[1], room[0]) if side % 2 == 0 else (room[0], room[1])
        x, y = turn(side * np.pi / 2) @ (-across / 2, rng.uniform(-0.3, 0.3) * along)
        colour = pick(rng, _PICTURES)
        material = Material("picture", colour, shade(colour, 0.5))
        half = (0.02, float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.2, 0.3)))
        solids.append(Solid((float(x), float(y), 1.75), half, material, side * np.pi / 2))
    return solids
