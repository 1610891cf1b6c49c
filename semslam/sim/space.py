"""The floor of a home as a robot sees it: what blocks it, a raster of what is free, how much can be reached."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.sim.home import FLOOR_KINDS, SKY_KINDS, Array, Fixture, Home
from semslam.sim.polygons import fill
from semslam.sim.walk import strip_of

REACH_M = 0.25
"""Half the width of the corridor that must lead everywhere."""


def stops_robot(fixture: Fixture) -> bool:
    """True if one cannot drive through or over it."""
    return fixture.footprint is not None and fixture.kind not in (*FLOOR_KINDS, *SKY_KINDS)


def blocked_polygons(home: Home) -> list[Array]:
    """Outlines (N, 2) of everything that stands on the floor: objects, then fixtures, walls included."""
    outlines = [item.footprint for item in home.objects]
    return outlines + [f.footprint for f in home.fixtures if f.footprint is not None and stops_robot(f)]


def free_raster(home: Home, cell_m: float = 0.05) -> tuple[NDArray[np.bool_], tuple[float, float]]:
    """Where the floor is free of everything, and the world place of the raster's low corner.

    Rows run along y, columns along x; a cell that something touches is not free. The strip in which somebody walks to
    and fro counts as taken.
    """
    x0, y0, x1, y1 = home.bounds
    shape = math.ceil((y1 - y0) / cell_m), math.ceil((x1 - x0) / cell_m)
    mask, origin = np.zeros(shape, np.uint8), (x0, y0)
    for polygon in home.outline:
        fill(mask, polygon, origin, cell_m, 1)
    taken = blocked_polygons(home) + ([strip_of(home.walker)] if home.walker is not None else [])
    for polygon in taken:
        fill(mask, polygon, origin, cell_m, 0)
    return mask.astype(bool), origin


def reachable(home: Home, cell_m: float = 0.05) -> NDArray[np.bool_]:
    """Cells of the free raster that the middle of a robot can reach from the start with REACH_M around it."""
    free, origin = free_raster(home, cell_m)
    wide = clearance_m(free, cell_m) >= REACH_M
    _, labels = cv2.connectedComponents(wide.astype(np.uint8), connectivity=4)
    row, column = cell_of(home.start, origin, cell_m)
    return np.asarray((labels == labels[row, column]) & wide[row, column] & wide)


def clearance_m(free: NDArray[np.bool_], cell_m: float) -> NDArray[np.float32]:
    """Distance of every cell to the nearest that is not free, or to the edge of the raster."""
    padded = np.pad(free, 1).astype(np.uint8)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance[1:-1, 1:-1] * cell_m, np.float32)


def cell_of(place: tuple[float, float], origin: tuple[float, float], cell_m: float) -> tuple[int, int]:
    """Row and column of a place."""
    return math.floor((place[1] - origin[1]) / cell_m), math.floor((place[0] - origin[0]) / cell_m)
