"""The map itself on the map picture: cells, metre grid, path, labels, scale bar."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE
from semslam.slam import palette
from semslam.slam.canvas import MEDIUM, Canvas
from semslam.slam.legend import draw_end, draw_start
from semslam.slam.palette import INK, PAGE, SOFT_INK, TRACK, Colour, darker
from semslam.slam.picture import MapCells, Path

LEFT, TOP, BOTTOM = 78, 98, 84
"""Pixels around the panel."""
_LARGEST, _LEAST = (1010, 880), (560, 440)
"""Pixels of the panel, width and height: what is aimed at, and the least."""
_COARSEST = 24
"""Pixels a cell, at most, where the picture may choose."""
_MARGIN_M = 0.3
_MAX_PIXELS = 4000
_MAX_LABELS = 24
_LABEL_M2 = 0.05
"""Smaller blobs get no label."""
_LABEL_INSIDE = 26
"""Lower blobs, in pixels, are labelled above or below, so that the label does not hide them."""
_ARROW_EVERY = 90.0
"""Pixels of path between direction arrows."""

_Raster = NDArray[np.int32]


@dataclass(frozen=True)
class View:
    """The cells that the panel shows, and their size on the picture."""

    left: int
    """First cell column."""
    low: int
    """First cell row, at the bottom."""
    columns: int
    rows: int
    cell_m: float
    scale: float
    """Pixels a cell: a whole number, or less than 1."""
    x: int = LEFT
    """Where the panel begins on the picture, pixels from the left, ..."""
    y: int = TOP
    """... and from the top."""

    @property
    def width(self) -> int:
        """Of the panel, pixels."""
        return math.ceil(self.columns * self.scale)

    @property
    def height(self) -> int:
        """Of the panel, pixels."""
        return math.ceil(self.rows * self.scale)

    @property
    def pixels_per_m(self) -> float:
        """Of the picture."""
        return self.scale / self.cell_m

    def pixels(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map frame (N, 2) to picture (N, 2)."""
        x = self.x + (points_m[:, 0] / self.cell_m - self.left) * self.scale
        y = self.y + self.height - (points_m[:, 1] / self.cell_m - self.low) * self.scale
        return np.stack([x, y], 1) - 0.5


def fit_view(cells: MapCells, path: Path, pixels_per_cell: int) -> View:
    """The smallest window about cells and path, enlarged to the least size of the panel."""
    corners = np.stack([cells.ix, cells.iy], 1)
    return fit_cells(corners, cells.cell_m, path, pixels_per_cell, _LARGEST, _LEAST)


def fit_cells(
    corners: NDArray[np.int64],
    cell_m: float,
    path: Path,
    pixels_per_cell: int,
    largest: tuple[int, int],
    least: tuple[int, int],
) -> View:
    """The smallest window about cells (N, 2) and path on a panel of those sizes, width and height in pixels."""
    low, high = _bounds(corners.astype(np.float64), cell_m, path)
    extent = high - low
    fitting = float(min(largest / extent))
    scale = float(min(math.floor(fitting), _COARSEST)) if fitting >= 1.0 else fitting
    if pixels_per_cell and pixels_per_cell * extent.max() <= _MAX_PIXELS:
        scale = float(pixels_per_cell)
    wanted = np.maximum(extent, np.ceil(np.array(least) / scale))
    left, bottom = (int(v) for v in low - (wanted - extent) // 2)
    return View(left, bottom, int(wanted[0]), int(wanted[1]), cell_m, scale)


def _bounds(corners: NDArray[np.float64], cell_m: float, path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """First and last (exclusive) column and row, with a margin, of everything there is to show."""
    every = np.concatenate([corners, corners + 1, path.posed / cell_m])
    if not len(every):
        every = np.zeros((1, 2))
    margin = _MARGIN_M / cell_m
    return np.floor(every.min(0) - margin), np.ceil(every.max(0) + margin)


def draw_panel(canvas: Canvas, view: View, cells: MapCells, path: Path, colours: Mapping[str, Colour]) -> None:
    """Everything inside the axes, and the axes."""
    raster = _rasterize(cells, view)
    _paint_cells(canvas, raster, cells.classes, colours, view)
    draw_axes(canvas, view)
    taken = [box for part in path.parts for box in draw_path(canvas, part, view)]
    _draw_labels(canvas, raster, cells.classes, view, taken)
    if not cells.ix.size:
        middle = view.x + view.width / 2, view.y + view.height / 2
        canvas.text(*middle, "No cells were mapped", 22, weight=MEDIUM, align=0.5, halo=palette.UNKNOWN)
        note = "No keyframe with a pose saw floor, obstacles or objects."
        canvas.text(middle[0], middle[1] + 28, note, 15, colour=SOFT_INK, align=0.5, halo=palette.UNKNOWN)
    draw_scale(canvas, view)


def _rasterize(cells: MapCells, view: View) -> _Raster:
    """Class of every pixel of the panel, row 0 at the top.

    Where a pixel holds several cells, objects win over obstacles, those over free floor.
    """
    shrink = min(1.0, view.scale)
    raster = np.zeros((math.ceil(view.rows * shrink), math.ceil(view.columns * shrink)), np.int32)
    rank = np.where(cells.class_id == FREE_FLOOR, 0, np.where(cells.class_id == OBSTACLE, 1, 2))
    order = np.lexsort((cells.class_id, rank))
    row, column = (
        ((axis[order] - first) * shrink).astype(np.int64)
        for axis, first in ((cells.iy, view.low), (cells.ix, view.left))
    )
    raster[row, column] = cells.class_id[order]
    enlarge = max(1, int(view.scale))
    return raster[::-1].repeat(enlarge, 0).repeat(enlarge, 1)


def _paint_cells(
    canvas: Canvas, raster: _Raster, classes: tuple[str, ...], colours: Mapping[str, Colour], view: View
) -> None:
    """Flat colours; a metre grid over the background; objects on top with a dark outline."""
    panel = canvas.image[view.y : view.y + view.height, view.x : view.x + view.width]
    panel[...] = palette.UNKNOWN
    panel[raster == FREE_FLOOR] = palette.FREE
    paint_grid(panel, view)
    panel[raster == OBSTACLE] = palette.OBSTACLE
    for class_id in np.unique(raster[raster >= FIRST_OBJECT]):
        mask = (raster == class_id).astype(np.uint8)
        colour = colours[classes[class_id]]
        panel[mask > 0] = colour
        if view.scale >= 3:
            inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
            panel[(mask > 0) & (inner == 0)] = darker(colour)


def paint_grid(panel: NDArray[np.uint8], view: View) -> None:
    """Darken the lines at whole ticks a little."""
    for _, x in _ticks(view.left * view.cell_m, view.width, view.pixels_per_m):
        panel[:, x] = (panel[:, x] * 0.93).astype(np.uint8)
    for _, y in _ticks(view.low * view.cell_m, view.height, view.pixels_per_m):
        panel[view.height - 1 - y] = (panel[view.height - 1 - y] * 0.93).astype(np.uint8)


def _ticks(start_m: float, pixels: int, pixels_per_m: float) -> Iterator[tuple[float, int]]:
    """(metres, pixels from the start) of the ticks along an axis, at least 55 pixels apart."""
    step = _round_step(55.0 / pixels_per_m)
    for number in range(math.ceil(start_m / step), math.floor((start_m + pixels / pixels_per_m) / step) + 1):
        pixel = round((number * step - start_m) * pixels_per_m)
        if 0 <= pixel < pixels:
            yield number * step, pixel


def _round_step(least: float) -> float:
    """The smallest of 0.1, 0.2, 0.5, 1, 2, 5, ... that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(max(least, 0.1)))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least * (1 - 1e-9))


def draw_axes(canvas: Canvas, view: View) -> None:
    right, bottom = view.x + view.width, view.y + view.height
    frame = [
        [view.x - 1, view.y - 1],
        [right, view.y - 1],
        [right, bottom],
        [view.x - 1, bottom],
        [view.x - 1, view.y - 1],
    ]
    canvas.line(frame, SOFT_INK)
    for metres, pixel in _ticks(view.left * view.cell_m, view.width, view.pixels_per_m):
        canvas.line([[view.x + pixel, bottom], [view.x + pixel, bottom + 5]], SOFT_INK)
        canvas.text(view.x + pixel, bottom + 20, _number(metres), 13, colour=SOFT_INK, align=0.5)
    for metres, pixel in _ticks(view.low * view.cell_m, view.height, view.pixels_per_m):
        canvas.line([[view.x - 6, bottom - 1 - pixel], [view.x - 1, bottom - 1 - pixel]], SOFT_INK)
        canvas.text(view.x - 11, bottom + 4 - pixel, _number(metres), 13, colour=SOFT_INK, align=1.0)
    canvas.text(view.x, bottom + 48, "metres; x ahead of the start, y to its left", 13, colour=SOFT_INK)


def _number(metres: float) -> str:
    return f"{metres + 0.0:g}".replace("-", "−")


def draw_path(canvas: Canvas, path: Path, view: View) -> list[tuple[float, float, float, float]]:
    """The path with direction arrows, start and end; gives the boxes (x0, y0, x1, y1) that labels should avoid."""
    points = view.pixels(path.posed)
    if not len(points):
        return []
    for pieces, colour, thickness in (
        (_pieces(path, view), PAGE, 6),
        (_gaps(path, view), PAGE, 4),
        (_gaps(path, view), TRACK, 2),
        (_pieces(path, view), TRACK, 3),
    ):
        for piece in pieces:
            canvas.line(piece, colour, thickness)
    for tip, direction in _arrows(points):
        _draw_arrow(canvas, tip, direction)
    draw_start(canvas, *points[0])
    draw_end(canvas, *points[-1])
    return [(x - 12, y - 12, x + 12, y + 12) for x, y in (points[0], points[-1])]


def _pieces(path: Path, view: View) -> list[NDArray[np.float64]]:
    """Runs of keyframes with poses, in pixels."""
    known = np.flatnonzero(~np.isnan(path.x_m))
    runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [view.pixels(np.stack([path.x_m[run], path.y_m[run]], 1)) for run in runs if run.size]


def _gaps(path: Path, view: View) -> list[NDArray[np.float64]]:
    """Straight lines from the end of each run to the start of the next."""
    pieces = _pieces(path, view)
    return [np.stack([before[-1], after[0]]) for before, after in pairwise(pieces)]


def _arrows(points: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Position and unit direction of arrows, evenly along the path."""
    steps = np.diff(points, axis=0)
    lengths = np.hypot(*steps.T) if len(steps) else np.zeros(0)
    travelled = np.concatenate([[0.0], np.cumsum(lengths)])
    for along in np.arange(_ARROW_EVERY / 2, travelled[-1], _ARROW_EVERY):
        index = int(np.searchsorted(travelled, along, side="right")) - 1
        direction = steps[index] / lengths[index]
        yield points[index] + direction * (along - travelled[index]), direction


def _draw_arrow(canvas: Canvas, middle: NDArray[np.float64], direction: NDArray[np.float64]) -> None:
    side = np.array([-direction[1], direction[0]])
    for size, fill in ((1.35, PAGE), (1.0, TRACK)):
        tail = middle - 6 * size * direction
        canvas.polygon([middle + 10 * size * direction, tail + 7.5 * size * side, tail - 7.5 * size * side], fill)


def _draw_labels(
    canvas: Canvas,
    raster: _Raster,
    classes: tuple[str, ...],
    view: View,
    taken: list[tuple[float, float, float, float]],
) -> None:
    """Names on the larger objects, largest first, where they cover neither each other nor the marks."""
    boxes = list(taken)
    for class_id, x, top, middle, bottom in _blobs(raster, view)[:_MAX_LABELS]:
        name = classes[class_id]
        half = canvas.text_width(name, 14, MEDIUM) / 2 + 3
        x = min(max(x, view.x + half + 2), view.x + view.width - half - 2)
        beside = (top - 6, bottom + 17)
        for baseline in (middle + 5, *beside) if bottom - top >= _LABEL_INSIDE else (*beside, middle + 5):
            box = (x - half, baseline - 14, x + half, baseline + 5)
            inside = box[1] >= view.y and box[3] <= view.y + view.height
            if inside and not any(_overlap(box, other) for other in boxes):
                canvas.text(x, baseline, name, 14, weight=MEDIUM, colour=INK, align=0.5, halo=PAGE)
                boxes.append(box)
                break


def _blobs(raster: _Raster, view: View) -> list[tuple[int, float, float, float, float]]:
    """Objects (class, x, top, middle, bottom) in pixels of the picture, largest first."""
    found = []
    for class_id in np.unique(raster[raster >= FIRST_OBJECT]):
        _, _, stats, centres = cv2.connectedComponentsWithStats((raster == class_id).astype(np.uint8), connectivity=8)
        for (_, top, _, height, area), (x, middle) in zip(stats[1:].tolist(), centres[1:].tolist(), strict=True):
            if area / view.pixels_per_m**2 >= _LABEL_M2:
                found.append((-area, int(class_id), view.x + x, view.y + top, view.y + middle, view.y + top + height))
    return [blob[1:] for blob in sorted(found)]


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def draw_scale(canvas: Canvas, view: View) -> None:
    """A bar of a round length below the panel, at the right."""
    length_m = _round_step(90.0 / view.pixels_per_m)
    right, y = float(view.x + view.width), view.y + view.height + 46.0
    left = right - length_m * view.pixels_per_m
    canvas.line([[left, y], [right, y]], INK, 3)
    for x in (left, right):
        canvas.line([[x, y - 5], [x, y + 5]], INK, 2)
    canvas.text((left + right) / 2, y + 22, f"{length_m:g} m", 15, weight=MEDIUM, align=0.5)
