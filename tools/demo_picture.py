"""Draws the README's picture from the results of `semslam demo`: camera frame, observation map, final map.

semslam demo --out semslam_demo
python tools/demo_picture.py semslam_demo --frame 8
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from semslam.geometry import rle
from semslam.labels import FIRST_OBJECT
from semslam.pipeline.run_tables import LogTables, run_tables
from semslam.slam.canvas import BOLD, Canvas
from semslam.slam.palette import SOFT_INK, Colour, class_colours
from semslam.slam.panel import LEFT, TOP, draw_panel, fit_view
from semslam.slam.picture import MapCells
from semslam.slam.picture import Path as Way
from semslam.tables.parquet import TableFiles, rows_of
from semslam.tables.pictures import decode_colour
from semslam.tables.spec import DETECTIONS, FRAMES, OBSERVATIONS, Table

WIDTH, HEIGHT, GAP, HEAD = 600, 450, 24, 62
Image = NDArray[np.uint8]


def main() -> None:
    """Three pictures side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output folder of `semslam demo` or `semslam run`")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--estimator", default="surfel")
    parser.add_argument("--out", type=Path, default=Path("docs/demo.png"))
    args = parser.parse_args()
    ((log, tables),) = run_tables(args.run, (FRAMES, DETECTIONS, OBSERVATIONS)).items()
    mapped = cv2.imread(str(args.run / "results" / log / args.estimator / "map.png"))
    if mapped is None:
        raise SystemExit(f"the run has no map of `{args.estimator}`")
    colours = _colours(args.run / "results" / log / args.estimator / "map.parquet")
    camera, observed = _camera(tables, args.frame, colours), _observation(tables, args.frame, colours)
    left = np.vstack(
        [_titled("What the camera sees", camera), _titled("What one frame says: observation map", observed)]
    )
    height = max(left.shape[0], mapped.shape[0])
    gap = np.full((height, GAP, 3), 255, np.uint8)
    page = np.hstack([gap, _tall(left, height), gap, _tall(mapped, height)])
    cv2.imwrite(str(args.out), page, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{args.out}: {page.shape[1]} x {page.shape[0]} pixels, {args.out.stat().st_size / 1000:.0f} kB")


def _colours(table: Path) -> dict[str, Colour]:
    """The colours that classes have on the map, which the other pictures share."""
    columns = pq.read_table(table, columns=["class_id", "label"]).to_pydict()
    return class_colours(label for class_id, label in zip(*columns.values(), strict=True) if class_id >= FIRST_OBJECT)


def _rows(tables: LogTables, table: Table, frame: int) -> list[dict[str, Any]]:
    """Rows of a table for one keyframe."""
    return [row for row in rows_of(_table(tables, table).batches()) if row["frame"] == frame]


def _camera(tables: LogTables, frame: int, colours: dict[str, Colour]) -> Image:
    """The frame with masks and boxes of what was detected."""
    rgb = decode_colour(_rows(tables, FRAMES, frame)[0]["colour"])
    picture = np.ascontiguousarray(rgb[:, :, ::-1])
    found = _rows(tables, DETECTIONS, frame)
    colours = class_colours(row["label"] for row in found) | colours
    for row in found:
        mask = rle.decode(row["mask_runs"], *picture.shape[:2])
        picture[mask] = (0.5 * picture[mask] + 0.5 * np.asarray(colours[row["label"]])).astype(np.uint8)
    for row in found:
        left, top, right, bottom = (round(row[name]) for name in ("x0_px", "y0_px", "x1_px", "y1_px"))
        cv2.rectangle(picture, (left, top), (right, bottom), colours[row["label"]], 2, cv2.LINE_AA)
    large = cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    canvas = Canvas(WIDTH, HEIGHT)
    canvas.image[:] = large
    for row in found:
        x, y = (row["x0_px"] * WIDTH / rgb.shape[1] + 4, row["y0_px"] * HEIGHT / rgb.shape[0] + 16)
        canvas.text(x, max(16.0, y), row["label"], 14, weight=BOLD, halo=(255, 255, 255))
    return canvas.image


def _observation(tables: LogTables, frame: int, colours: dict[str, Colour]) -> Image:
    """The observation of the frame: the likeliest class of every cell, the robot in the middle looking right."""
    meta, row = _table(tables, OBSERVATIONS).meta, _rows(tables, OBSERVATIONS, frame)[0]
    side, classes = int(meta["side"]), tuple(meta["classes"])
    cells = np.asarray(row["cells"], np.int64)
    class_id, place = cells // side**2, cells % side**2
    order = np.lexsort((np.asarray(row["weights"]), class_id))  # objects over floor; the stronger object wins
    best = {int(place[i]): int(class_id[i]) for i in order}
    iy, ix = np.divmod(np.fromiter(best, np.int64), side)
    cell_m = float(meta["cell_m"])
    seen = MapCells(ix - side // 2, iy - side // 2, np.fromiter(best.values(), np.int64), classes, cell_m)
    way = Way(np.zeros(1), np.zeros(1))
    return _panel(seen, way, class_colours(classes[c] for c in seen.objects()) | colours)


def _table(tables: LogTables, table: Table) -> TableFiles:
    if table.name not in tables:
        raise SystemExit(f"the run has no {table.name}")
    return TableFiles(table, tables[table.name])


def _panel(cells: MapCells, way: Way, colours: dict[str, Colour]) -> Image:
    view = fit_view(cells, way, 0)
    canvas = Canvas(LEFT + view.width + 20, TOP + view.height + 84)
    draw_panel(canvas, view, cells, way, colours)
    panel = canvas.image[TOP - 20 :]
    scale = WIDTH / panel.shape[1]
    return np.asarray(cv2.resize(panel, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def _titled(title: str, picture: Image) -> Image:
    head = Canvas(picture.shape[1], HEAD)
    head.text(0, 44, title, 20, weight=BOLD, colour=SOFT_INK)
    return np.vstack([head.image, picture])


def _tall(picture: Image, height: int) -> Image:
    missing = height - picture.shape[0]
    return np.pad(picture, ((0, missing), (0, 0), (0, 0)), constant_values=255)


if __name__ == "__main__":
    main()
