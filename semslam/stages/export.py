"""Export: from poses and cells to files for people and other tools.

Reads   poses          data_spec.md, table 7
        cells          data_spec.md, table 9
        places         data_spec.md, table 16, of estimators that have one
Writes  trajectory     data_spec.md, table 10: keyframes with a pose
Files   map.png        the picture
        map.parquet    the cells table again, as a file that stands alone
        map.yaml, map.pgm   ROS map_server; left out, with a warning, for maps too large for a picture of single cells
        trajectory.tum      seconds x y z qx qy qz qw
        places.parquet      the places table again, if there is one: a map in which other logs can be found
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from semslam.slam.exchange import MAX_PIXELS, map_yaml, occupancy_image, pgm, tum, unknown_grey
from semslam.slam.picture import MapCells, Path
from semslam.slam.render import render_map
from semslam.stages.contract import ShardWriter, StageContext, TableSource
from semslam.stages.settings import ExportConfig
from semslam.tables.parquet import TableFileWriter, write_table
from semslam.tables.spec import CELLS, PLACES, POSES, TRAJECTORY

_POSE = ("frame", "stamp_nanos", "x_m", "y_m", "heading_rad", "verdict")
_FILES = 5

Columns = Mapping[str, list[Any]]


def run(ctx: StageContext) -> None:
    """Write everything, in one shard."""
    if ctx.finished:
        return
    config: ExportConfig = ctx.config
    poses, cells = ctx.read(POSES), ctx.read(CELLS)
    track, rows = poses.read(_POSE), cells.read()
    shown = _map_cells(rows, cells.meta)
    with ctx.shard(0) as shard:
        _write_trajectory(shard, track, poses)
        ctx.progress(1, _FILES)
        write_table(shard.path("map.parquet"), CELLS, rows, dict(cells.meta))
        ctx.progress(2, _FILES)
        _write_occupancy(shard, shown, config)
        ctx.progress(4, _FILES)
        path = Path(*(np.array(track[name], np.float64) for name in ("x_m", "y_m")))
        subtitle = _subtitle(str(cells.meta["estimator"]), path, shown)
        shard.path("map.png").write_bytes(render_map(shown, path, ctx.log, subtitle, config.pixels_per_cell))
        _write_places(ctx, shard)
        ctx.progress(_FILES, _FILES)


def _write_places(ctx: StageContext, shard: ShardWriter) -> None:
    """places.parquet, row by row: a row is some 50 kB."""
    try:
        places = ctx.read(PLACES)
    except KeyError:
        return
    if not places.rows:
        return
    file = TableFileWriter(shard.path("places.parquet"), PLACES, dict(places.meta))
    try:
        for rows in places.batches(batch_rows=8):
            file.append(rows)
    finally:
        file.close()


def _map_cells(rows: Columns, meta: Mapping[str, Any]) -> MapCells:
    ix, iy, class_id = (np.array(rows[name], np.int64) for name in ("ix", "iy", "class_id"))
    return MapCells(ix, iy, class_id, tuple(meta["classes"]), float(meta["cell_m"]))


def _write_trajectory(shard: ShardWriter, track: Columns, poses: TableSource) -> None:
    """The keyframes with a pose, as table and as TUM file."""
    kept = [i for i, x in enumerate(track["x_m"]) if x is not None]
    posed = {name: [track[name][i] for i in kept] for name in _POSE}
    shard.table(TRAJECTORY, dict(poses.meta)).append(posed)
    lines = tum(zip(*(posed[name] for name in _POSE[1:-1]), strict=True))
    shard.path("trajectory.tum").write_text(lines, encoding="ascii", newline="\n")


def _write_occupancy(shard: ShardWriter, cells: MapCells, config: ExportConfig) -> None:
    """map.pgm and map.yaml."""
    occupied, free = config.occupied_threshold, config.free_threshold
    found = occupancy_image(cells, unknown_grey(free, occupied))
    if found is None:
        shard.warn(
            f"The map spans more than {MAX_PIXELS:,} cells; `map.pgm` and `map.yaml` were left out. "
            "A jump in the poses is the usual reason: look at `map.png`."
        )
        return
    image, corner = found
    shard.path("map.pgm").write_bytes(pgm(image))
    text = map_yaml("map.pgm", cells.cell_m, corner, occupied, free)
    shard.path("map.yaml").write_text(text, encoding="ascii", newline="\n")


def _subtitle(estimator: str, path: Path, cells: MapCells) -> str:
    keyframes = f"{len(path.x_m):,} keyframes"
    posed = len(path.posed)
    if posed < len(path.x_m):
        keyframes += f", {posed:,} with a pose"
    return "  ·  ".join([f"estimator {estimator}", keyframes, f"cell {cells.cell_m:.2f} m", f"{len(cells.ix):,} cells"])
