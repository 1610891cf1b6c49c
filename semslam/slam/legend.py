"""The right-hand column of the map picture: what the colours mean, and how much there is of each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semslam.labels import FREE_FLOOR, OBSTACLE
from semslam.slam import palette
from semslam.slam.canvas import MEDIUM, Canvas
from semslam.slam.palette import HAIRLINE, SOFT_INK, TRACK, Colour, darker
from semslam.slam.picture import MapCells, Path

LEGEND_WIDTH = 316
INNER_WIDTH = LEGEND_WIDTH - 32 - 28
ROW = 27
_MAX_CLASSES = 22


def legend_height(classes: int) -> int:
    """Pixels from the top of the picture to below the legend."""
    shown = min(classes, _MAX_CLASSES) + (classes > _MAX_CLASSES)
    return 92 + ROW * (11 + max(1, shown)) + 24


def draw_legend(canvas: Canvas, x: int, y: int, cells: MapCells, path: Path, colours: Mapping[str, Colour]) -> None:
    """Objects by falling number of cells, background, trajectory."""
    y = draw_heading(canvas, x, y, "Objects", "cells")
    objects = cells.objects()
    for class_id in objects[:_MAX_CLASSES]:
        name = cells.classes[class_id]
        y = draw_row(canvas, x, y, colours[name], darker(colours[name]), name, f"{cells.count(class_id):,}")
    if len(objects) > _MAX_CLASSES:
        y = draw_note(canvas, x, y, f"and {len(objects) - _MAX_CLASSES} more classes")
    if not objects:
        y = draw_note(canvas, x, y, "none recognised")
    y = draw_heading(canvas, x, y + 14, "Background", "cells")
    y = draw_row(canvas, x, y, palette.FREE, palette.SOFT_INK, "free floor", f"{cells.count(FREE_FLOOR):,}")
    y = draw_row(canvas, x, y, palette.OBSTACLE, palette.OBSTACLE, "obstacle", f"{cells.count(OBSTACLE):,}")
    y = draw_row(canvas, x, y, palette.UNKNOWN, palette.SOFT_INK, "not seen", "")
    y = draw_heading(canvas, x, y + 14, "Trajectory", "")
    draw_track_key(canvas, x, y, path)


def draw_heading(canvas: Canvas, x: int, y: int, text: str, right: str) -> int:
    canvas.text(x, y + 14, text, 16, weight=MEDIUM)
    canvas.text(x + INNER_WIDTH, y + 14, right, 13, colour=SOFT_INK, align=1.0)
    canvas.line([[x, y + 24], [x + INNER_WIDTH, y + 24]], HAIRLINE)
    return y + 34


def draw_row(canvas: Canvas, x: int, y: int, fill: Colour, edge: Colour, name: str, right: str) -> int:
    canvas.box(x, y + 2, 20, 16, fill, edge)
    room = INNER_WIDTH - 34 - canvas.text_width(right, 15) - 10
    canvas.text(x + 32, y + 15, canvas.shortened(name, 15, 400, room), 15)
    canvas.text(x + INNER_WIDTH, y + 15, right, 15, colour=SOFT_INK, align=1.0)
    return y + ROW


def draw_note(canvas: Canvas, x: int, y: int, text: str) -> int:
    canvas.text(x, y + 15, text, 15, colour=SOFT_INK)
    return y + ROW


def draw_track_key(canvas: Canvas, x: int, y: int, path: Path) -> None:
    """A piece of line with its length, and the marks of start and end."""
    if not np.any(~np.isnan(path.x_m)):
        draw_note(canvas, x, y, "no poses")
        return
    canvas.line([[x, y + 10], [x + 20, y + 10]], TRACK, 3)
    canvas.text(x + 32, y + 15, "path of the robot", 15)
    canvas.text(x + INNER_WIDTH, y + 15, f"{path.length_m:,.1f} m", 15, colour=SOFT_INK, align=1.0)
    draw_start(canvas, x + 10, y + ROW + 10)
    canvas.text(x + 32, y + ROW + 15, "start", 15)
    draw_end(canvas, x + 120, y + ROW + 10)
    canvas.text(x + 142, y + ROW + 15, "end", 15)


def draw_start(canvas: Canvas, x: float, y: float) -> None:
    """A ring, wide enough to show the end mark inside it."""
    canvas.disc(x, y, 9.0, palette.PAGE, palette.PAGE, 4)
    canvas.disc(x, y, 8.5, palette.PAGE, TRACK, 3)


def draw_end(canvas: Canvas, x: float, y: float) -> None:
    """A filled square."""
    for half, fill in ((6.0, palette.PAGE), (4.5, TRACK)):
        canvas.polygon([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]], fill)
