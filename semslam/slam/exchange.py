"""Maps and tracks in the formats of other tools: ROS map_server (YAML and PGM) and TUM trajectories."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.slam.layers import LayerCells

MAX_PIXELS = 1 << 26
"""Largest PGM that is written, in cells."""
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205


def map_server_files(cells: LayerCells, free: float, occupied: float) -> dict[str, bytes]:
    """`map.pgm` and `map.yaml` by name, for these thresholds; none if the map is too large for them."""
    found = occupancy_image(cells, free, occupied, unknown_grey(free, occupied))
    if found is None:
        return {}
    image, corner_m = found
    text = map_yaml("map.pgm", cells.columns.cell_m, corner_m, occupied, free)
    return {"map.pgm": pgm(image), "map.yaml": text.encode("ascii")}


def map_server_doubt(cells: LayerCells) -> str:
    """Why these files are left out, or are of no use; nothing if they are there and anything is known."""
    box = _box(cells)
    if box is None:
        seen = f"{cells.keyframes:,} keyframes up to {cells.columns.reach_m:g} m (`export.layer_depth_m`)"
        return f"Depth of {seen} shows nothing free or occupied: `map.pgm` is one unknown cell"
    if box[2] * box[3] <= MAX_PIXELS:
        return ""
    return (
        f"The map spans more than {MAX_PIXELS:,} cells; `map.pgm` and `map.yaml` were left out. "
        "A jump in the poses is the usual reason: look at `map.png`."
    )


def occupancy_image(
    cells: LayerCells, free: float, occupied: float, unknown: int
) -> tuple[NDArray[np.uint8], tuple[float, float]] | None:
    """Grey values of the map's bounding box, first row on top, and the map frame position of its lower left corner.

    Cells whose occupancy is above `occupied` are occupied, those below `free` free; the others are unknown. None if the
    box has more than `MAX_PIXELS` cells; an empty map is one unknown cell, because map_server refuses pictures without
    pixels.
    """
    box = _box(cells)
    if box is None:
        return np.full((1, 1), unknown, np.uint8), (0.0, 0.0)
    left, low, columns, rows = box
    if columns * rows > MAX_PIXELS:
        return None
    ix, iy, occupancy = (field[cells.known] for field in (cells.ix, cells.iy, cells.occupancy))
    image = np.full((rows, columns), unknown, np.uint8)
    image[iy - low, ix - left] = np.where(occupancy > occupied, _OCCUPIED, np.where(occupancy < free, _FREE, unknown))
    cell_m = cells.columns.cell_m
    return np.ascontiguousarray(image[::-1]), (left * cell_m, low * cell_m)


def _box(cells: LayerCells) -> tuple[int, int, int, int] | None:
    """Left column, lowest row, columns and rows of the cells whose occupancy is known; None if there are none."""
    ix, iy = cells.ix[cells.known], cells.iy[cells.known]
    if not ix.size:
        return None
    return int(ix.min()), int(iy.min()), int(np.ptp(ix)) + 1, int(np.ptp(iy)) + 1


def unknown_grey(free_threshold: float, occupied_threshold: float) -> int:
    """The grey value that map_server reads as unknown: 205 by custom, if these thresholds allow it.

    map_server takes (255 - grey) / 255 for the occupancy; below `free_threshold` it is free, above
    `occupied_threshold` occupied. Free floor is grey 254, 1/255, so the free threshold must be above that; occupied
    cells are grey 0, which is 1, so the occupied threshold must be below. Grey 205 is 0.196: any free threshold
    above that would turn everything unknown into free floor; the value in the middle between the thresholds is written
    then.

    Raises:
        SemslamError: no grey value lies between the thresholds, or one of them swallows free or occupied cells.
    """
    if not (free_threshold > (255 - _FREE) / 255 and occupied_threshold < (255 - _OCCUPIED) / 255):
        raise SemslamError(
            f"`export.free_threshold` is {free_threshold:g} and `export.occupied_threshold` is {occupied_threshold:g}; "
            "map_server would read free floor, or objects, as unknown",
            hint="set `export.free_threshold` above 0.004 and `export.occupied_threshold` below 1",
        )
    middle = round(255 * (1 - (free_threshold + occupied_threshold) / 2))
    for grey in (_UNKNOWN, middle):
        if free_threshold <= (255 - grey) / 255 <= occupied_threshold:
            return grey
    raise SemslamError(
        f"`export.free_threshold` is {free_threshold:g} and `export.occupied_threshold` is {occupied_threshold:g}, "
        "which leaves nothing between them for unknown cells",
        hint="set `export.free_threshold` to 0.196 and `export.occupied_threshold` to 0.65",
    )


def pgm(image: NDArray[np.uint8]) -> bytes:
    """A binary PGM file."""
    rows, columns = image.shape
    return f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes()


def map_yaml(image: str, cell_m: float, corner_m: tuple[float, float], occupied: float, free: float) -> str:
    """The YAML file of map_server beside the picture `image`."""
    return (
        f"image: {image}\n"
        f"mode: trinary\n"
        f"resolution: {cell_m:.6f}\n"
        f"origin: [{corner_m[0]:.6f}, {corner_m[1]:.6f}, 0.0]\n"
        f"negate: 0\n"
        f"occupied_thresh: {occupied:g}\n"
        f"free_thresh: {free:g}\n"
    )


def tum_of(track: Mapping[str, Sequence[Any]]) -> bytes:
    """A TUM file of the columns of the trajectory table."""
    columns = (track[name] for name in ("stamp_nanos", "x_m", "y_m", "heading_rad"))
    return tum(zip(*columns, strict=True)).encode("ascii")


def tum(poses: Iterable[tuple[int, float, float, float]]) -> str:
    """Lines `seconds x y z qx qy qz qw` from (stamp_nanos, x_m, y_m, heading_rad); all nine decimals of the stamps."""
    lines = []
    for stamp_nanos, x, y, heading in poses:
        seconds, nanos = divmod(stamp_nanos, 1_000_000_000)
        turn = f"{math.sin(heading / 2):.12f} {math.cos(heading / 2):.12f}"
        lines.append(f"{seconds}.{nanos:09d} {x:.9f} {y:.9f} 0.000000000 0.000000000000 0.000000000000 {turn}\n")
    return "".join(lines)
