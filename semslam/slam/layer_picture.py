"""The layers as a picture in the style of the map's: what is occupied and what is free, and beside it how high it is.

On the left a cell is free, occupied or undecided, as map_server reads it. On the right it has the colour of its top,
where there is one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.slam import palette
from semslam.slam.canvas import BOLD, MEDIUM, REGULAR, Canvas, Image
from semslam.slam.layers import LayerCells
from semslam.slam.legend import INNER_WIDTH, LEGEND_WIDTH, ROW, draw_heading, draw_row, draw_track_key
from semslam.slam.palette import INK, OBJECTS, SOFT_INK
from semslam.slam.panel import BOTTOM, LEFT, TOP, View, draw_axes, draw_path, draw_scale, fit_cells, paint_grid
from semslam.slam.picture import Path

_LARGEST, _LEAST = (640, 820), (420, 380)
"""Pixels of each panel, width and height: what is aimed at, and the least."""
_BETWEEN = 84
"""Pixels between the panels."""
_DOWN = 30
"""How much lower than that of the map the panels begin: each has a name."""
UNDECIDED = OBJECTS[0]
"""Free to some keyframes and occupied to others."""
_KEY_HEIGHT = 22
_LEGEND_HEIGHT = 620

_Mask = NDArray[np.bool_]


def render_layers(cells: LayerCells, path: Path, title: str, subtitle: str, thresholds: tuple[float, float]) -> bytes:
    """The picture as a PNG file.

    Args:
        cells: the layers; they may be empty.
        path: the trajectory; it may be empty.
        title: the first line, large.
        subtitle: the line below, small.
        thresholds: below the first a cell counts as free, above the second as occupied.
    """
    left = replace(_fit(cells, path), y=TOP + _DOWN)
    right = replace(left, x=LEFT + left.width + _BETWEEN)
    end = right.x + right.width
    canvas = Canvas(end + LEGEND_WIDTH, max(left.y + left.height + BOTTOM, _LEGEND_HEIGHT))
    room = end + LEGEND_WIDTH - LEFT - 24
    canvas.text(LEFT, 44, canvas.shortened(title, 27, BOLD, room), 27, weight=BOLD)
    canvas.text(LEFT, 71, canvas.shortened(subtitle, 15, REGULAR, room), 15, colour=SOFT_INK)
    _draw_panel(canvas, left, cells, _kinds(cells, thresholds), "Occupancy")
    for part in path.parts:
        draw_path(canvas, part, left)
    _draw_panel(canvas, right, cells, _heights(cells), "Height of the top above the floor")
    _draw_legend(canvas, end + 32, cells, path, thresholds)
    return canvas.png()


def layers_subtitle(cells: LayerCells, estimator: str) -> str:
    """What the layers were made of, in a line."""
    columns = cells.columns
    words = [
        f"estimator {estimator}",
        f"depth of {cells.keyframes:,} keyframes",
        f"cell {columns.cell_m:g} m",
        f"obstacles from {columns.low_m:g} to {columns.high_m:g} m",
    ]
    return "  ·  ".join(words)


def _fit(cells: LayerCells, path: Path) -> View:
    corners = np.stack([cells.ix, cells.iy], 1)
    return fit_cells(corners, cells.columns.cell_m, path, 0, _LARGEST, _LEAST)


def _kinds(cells: LayerCells, thresholds: tuple[float, float]) -> Image:
    """(n, 3) colours of cells by occupancy."""
    free, occupied, undecided = _sorted(cells, thresholds)
    colours = np.broadcast_to(np.array(palette.UNKNOWN, np.uint8), (len(free), 3)).copy()
    for chosen, colour in ((free, palette.FREE), (occupied, INK), (undecided, UNDECIDED)):
        colours[chosen] = colour
    return colours


def _sorted(cells: LayerCells, thresholds: tuple[float, float]) -> tuple[_Mask, _Mask, _Mask]:
    """(n,) each: which cells are free, occupied, and seen but neither."""
    free, occupied = cells.occupancy < thresholds[0], cells.occupancy > thresholds[1]  # false for NaN
    return free, occupied, ~np.isnan(cells.occupancy) & ~free & ~occupied


def _heights(cells: LayerCells) -> Image:
    """(n, 3) colours of cells by their tops, white where there is nothing but floor."""
    top = ~np.isnan(cells.top_m)
    floor = (cells.occupancy < 0.5) | ~np.isnan(cells.floor_m)  # the first false for NaN
    ground = np.where(floor[:, None], np.array(palette.FREE), np.array(palette.UNKNOWN))
    return np.where(top[:, None], _ramp(_share(cells)), ground).astype(np.uint8)


def _share(cells: LayerCells) -> NDArray[np.float64]:
    """(n,) how far up in the band of obstacles a cell's top is, 0 to 1."""
    low_m, high_m = cells.columns.low_m, cells.columns.high_m
    return np.clip((np.nan_to_num(cells.top_m) - low_m) / (high_m - low_m), 0.0, 1.0)


def _ramp(share: NDArray[np.float64]) -> Image:
    """(n, 3) from light, low, to dark, high: evenly, also in grey and to colour-blind eyes."""
    steps = np.rint((1 - share) * 235).astype(np.uint8).reshape(-1, 1)
    if not steps.size:
        return np.zeros((0, 3), np.uint8)
    return np.asarray(cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS)[:, 0], np.uint8)


def _draw_panel(canvas: Canvas, view: View, cells: LayerCells, colours: Image, name: str) -> None:
    """One of the two panels with its axes."""
    canvas.text(view.x, view.y - 12, name, 16, weight=MEDIUM)
    panel = canvas.image[view.y : view.y + view.height, view.x : view.x + view.width]
    painted = _rasterize(cells, view, colours)
    panel[...] = painted
    gridded = painted.copy()
    paint_grid(gridded, view)
    open_floor = (painted == np.array(palette.FREE)).all(-1) | (painted == np.array(palette.UNKNOWN)).all(-1)
    panel[open_floor] = gridded[open_floor]
    draw_axes(canvas, view)
    draw_scale(canvas, view)
    if not cells.ix.size:
        x, y = view.x + view.width / 2, view.y + view.height / 2
        canvas.text(x, y, "No depth at any pose", 18, weight=MEDIUM, align=0.5, halo=palette.UNKNOWN)


def _rasterize(cells: LayerCells, view: View, colours: Image) -> Image:
    """Every pixel of the panel, row 0 at the top; where it holds several cells, that of the most occupied one."""
    shrink = min(1.0, view.scale)
    shape = math.ceil(view.rows * shrink), math.ceil(view.columns * shrink)
    raster = np.broadcast_to(np.array(palette.UNKNOWN, np.uint8), (*shape, 3)).copy()
    order = np.argsort(np.nan_to_num(cells.occupancy, nan=-1.0), kind="stable")
    row, column = (
        ((axis[order] - first) * shrink).astype(np.int64)
        for axis, first in ((cells.iy, view.low), (cells.ix, view.left))
    )
    raster[row, column] = colours[order]
    enlarge = max(1, int(view.scale))
    return raster[::-1].repeat(enlarge, 0).repeat(enlarge, 1)


def _draw_legend(canvas: Canvas, x: int, cells: LayerCells, path: Path, thresholds: tuple[float, float]) -> None:
    """Colours of both panels with the areas that have them, and the trajectory."""
    y = draw_heading(canvas, x, TOP, "Occupancy", "area")
    kinds = ("free", palette.FREE), ("occupied", INK), ("undecided", UNDECIDED)
    for (name, fill), chosen in zip(kinds, _sorted(cells, thresholds), strict=True):
        y = draw_row(canvas, x, y, fill, SOFT_INK, name, _area(cells, chosen))
    y = draw_row(canvas, x, y, palette.UNKNOWN, SOFT_INK, "not seen, or too little", "")
    y = draw_heading(canvas, x, y + 14, "Height", "metres")
    y = _draw_ramp(canvas, x, y + 4, cells)
    y = draw_row(canvas, x, y + 8, palette.FREE, SOFT_INK, "floor", "")
    y = draw_heading(canvas, x, y + 14, "Trajectory", "")
    draw_track_key(canvas, x, y, path)


def _area(cells: LayerCells, chosen: _Mask) -> str:
    return f"{np.count_nonzero(chosen) * cells.columns.cell_m**2:,.1f} m²"


def _draw_ramp(canvas: Canvas, x: int, y: int, cells: LayerCells) -> int:
    """The colours of heights from the lowest obstacle to the highest, with numbers below."""
    low_m, high_m = cells.columns.low_m, cells.columns.high_m
    canvas.image[y : y + _KEY_HEIGHT, x : x + INNER_WIDTH] = _ramp(np.linspace(0.0, 1.0, INNER_WIDTH))
    for share, align in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        number = f"{low_m + share * (high_m - low_m):.2g}"
        text = f"{number} and more" if share == 1.0 else number
        canvas.text(x + share * INNER_WIDTH, y + _KEY_HEIGHT + 17, text, 13, colour=SOFT_INK, align=align)
    return y + ROW + _KEY_HEIGHT
