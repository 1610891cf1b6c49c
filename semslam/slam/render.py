"""The map as a picture for a slide: what stands where, what is free, what nobody saw, and the way the robot took.

x points right and y up: the robot starts at heading 0, looking to the right. `panel` and `legend` draw the two halves.
"""

from __future__ import annotations

from semslam.slam.canvas import BOLD, REGULAR, Canvas
from semslam.slam.legend import LEGEND_WIDTH, draw_legend, legend_height
from semslam.slam.palette import SOFT_INK, class_colours
from semslam.slam.panel import BOTTOM, LEFT, TOP, draw_panel, fit_view
from semslam.slam.picture import MapCells, Path


def render_map(cells: MapCells, path: Path, title: str, subtitle: str, pixels_per_cell: int = 0) -> bytes:
    """The picture as a PNG file.

    Args:
        cells: the map; it may be empty.
        path: the trajectory; it may be empty.
        title: the first line, large.
        subtitle: the line below, small.
        pixels_per_cell: 0 chooses a picture of about 1400 x 1000 pixels; huge maps are thinned to fit either way.
    """
    view = fit_view(cells, path, pixels_per_cell)
    colours = class_colours(cells.classes[class_id] for class_id in cells.objects())
    height = max(TOP + view.height + BOTTOM, legend_height(len(colours)))
    canvas = Canvas(LEFT + view.width + LEGEND_WIDTH, height)
    room = view.width + LEGEND_WIDTH - 24
    canvas.text(LEFT, 44, canvas.shortened(title, 27, BOLD, room), 27, weight=BOLD)
    canvas.text(LEFT, 71, canvas.shortened(subtitle, 15, REGULAR, room), 15, colour=SOFT_INK)
    draw_panel(canvas, view, cells, path, colours)
    draw_legend(canvas, LEFT + view.width + 32, TOP, cells, path, colours)
    return canvas.png()
