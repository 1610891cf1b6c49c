"""Rooms with boxes of furniture, drawn by hand: homes for a robot to drive in, without meshes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.sim.home import CLASSES, Array, Home, Piece, Placed, Room, Walker

HALF_M, GAP_M, DOOR_M = 4.0, 0.1, 0.95
CELL_M = 0.05

WALLS_AND_MIDDLE = (
    # class, x, y, depth, width, height, heading in quarter turns
    ("bookshelf", -3.8, 2.2, 0.3, 1.2, 1.8, 0),
    ("dresser", -3.75, -2.4, 0.45, 1.1, 0.9, 0),
    ("sofa", -2.0, 3.5, 0.9, 1.8, 0.8, 3),
    ("lamp", -0.6, 3.7, 0.3, 0.3, 1.5, 3),
    ("tv", 1.0, 3.75, 0.4, 1.0, 1.0, 3),
    ("plant", 2.6, 3.6, 0.4, 0.4, 1.2, 3),
    ("bed", 2.5, -2.9, 2.0, 1.5, 0.6, 1),
    ("refrigerator", -1.6, -3.6, 0.7, 0.7, 1.8, 1),
    ("bin", -0.4, -3.7, 0.3, 0.3, 0.5, 1),
    ("toilet", 3.6, 2.4, 0.7, 0.45, 0.8, 2),
    ("table", -1.8, 1.2, 0.8, 1.2, 0.75, 0),
    ("chair", -1.1, 0.2, 0.45, 0.45, 0.9, 1),
    ("chair", 1.7, 1.2, 0.45, 0.45, 0.9, 2),
    ("plant", 1.0, -1.4, 0.4, 0.4, 0.9, 0),
    ("table", -1.9, -1.4, 0.6, 0.6, 0.5, 0),
    ("chair", -2.7, 0.9, 0.45, 0.45, 0.9, 0),
    ("lamp", -3.75, 0.2, 0.3, 0.3, 1.5, 0),
    ("dresser", 3.75, 0.7, 0.45, 1.0, 0.8, 2),
    ("plant", -3.7, 3.6, 0.4, 0.4, 1.3, 0),
    ("bin", 3.75, -1.2, 0.3, 0.3, 0.5, 2),
    ("chair", 0.9, 2.5, 0.45, 0.45, 0.9, 3),
)


def furnished(rooms: int = 1, *, walker: Walker | None = None) -> Home:
    """Rooms of 8 x 8 m in a row along x, with a door opening between neighbours, each with the same furniture."""
    middles = [index * (2 * HALF_M + GAP_M) for index in range(rooms)]
    floors = [rectangle(x - HALF_M, -HALF_M, x + HALF_M, HALF_M) for x in middles]
    doors = [_doorway(x + HALF_M) for x in middles[:-1]]
    places = [(f"room {x:.0f}", (x - HALF_M, -HALF_M), (x + HALF_M, HALF_M)) for x in middles]
    things = [_placed(number, x, *row) for number, (x, row) in enumerate(_rows(middles), start=1)]
    return Home(
        1,
        "boxes",
        0,
        tuple(Room(*place) for place in places),
        (*floors, *doors),
        2.6,
        tuple(things),
        (),
        (),
        (0, 0),
        walker,
    )


def raster(home: Home) -> tuple[NDArray[np.bool_], Array]:
    """Free cells and the corner of the first one."""
    x0, y0, x1, y1 = home.bounds
    free = np.zeros((round((y1 - y0) / CELL_M), round((x1 - x0) / CELL_M)), np.uint8)
    outlines = [(polygon, 1) for polygon in home.outline] + [(item.footprint, 0) for item in home.objects]
    for polygon, value in outlines:
        cells = np.round(((polygon - (x0, y0)) / CELL_M - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(free, [cells], value, shift=4)
    return free.astype(bool), np.array([x0, y0])


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Array:
    """(4, 2) counter-clockwise."""
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], np.float64)


def _doorway(x: float) -> Array:
    return rectangle(x - 0.02, -DOOR_M / 2, x + GAP_M + 0.02, DOOR_M / 2)


def _rows(middles: list[float]) -> list[tuple[float, tuple[str, float, float, float, float, float, int]]]:
    return [(x, row) for x in middles for row in WALLS_AND_MIDDLE]


def _placed(
    number: int, middle: float, name: str, x: float, y: float, depth: float, width: float, height: float, quarters: int
) -> Placed:
    assert name in CLASSES
    piece = Piece(name, "box", (), rectangle(-depth / 2, -width / 2, depth / 2, width / 2), height)
    return Placed(number, piece, middle + x, y, quarters * np.pi / 2)
