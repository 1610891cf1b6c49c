"""The folder of a site: one map of all its logs, and the track of each in that map's frame.

    SITE/                        named after the site's first log
      places.parquet             table 16: a map for `--prior`
      map.parquet                table 9
      layers.parquet             table 18, from the thinned depth of places.parquet
      map.png, layers.png
      map.yaml, map.pgm          of the layers
      <log>/trajectory.parquet   table 10
      <log>/trajectory.tum

The formats, pictures and lines below titles are those of a single log's files, which `export` writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semslam.geometry.frames import planar
from semslam.slam.depth_sight import DepthImage
from semslam.slam.exchange import map_server_doubt, map_server_files, tum_of
from semslam.slam.layer_picture import layers_subtitle, render_layers
from semslam.slam.layers import LayerCells, Layers
from semslam.slam.picture import MapCells, map_subtitle
from semslam.slam.picture import Path as DrawnPath
from semslam.slam.render import render_map
from semslam.slam.surfel.merging import Site
from semslam.slam.surfel.prior import Grid, Remembered, place_row
from semslam.slam.surfel.site_map import Pose, cells, remembered, thinned
from semslam.stages.settings import ExportConfig
from semslam.tables.parquet import TableFileWriter, write_table
from semslam.tables.spec import CELLS, LAYERS, PLACES, TRAJECTORY


@dataclass(frozen=True)
class SiteStyle:
    """How a site's files are made."""

    estimator: str
    grid: Grid
    export: ExportConfig

    @property
    def meta(self) -> dict[str, Any]:
        """Of the cells table."""
        return {"classes": list(self.grid.classes), "cell_m": self.grid.cell_m, "estimator": self.estimator}


def write_site(folder: Path, site: Site, tracks: Sequence[Sequence[Pose]], style: SiteStyle) -> str:
    """Write all files of a site into a new folder, `tracks` of its logs among them; what there is to warn of, or
    nothing."""
    folder.mkdir()
    known = remembered(site)
    _write_places(folder / "places.parquet", thinned(known), style)
    columns = cells(known, style.grid)
    write_table(folder / "map.parquet", CELLS, columns, style.meta)
    shown = MapCells.of(columns, style.meta)
    for drive, track in zip(site.drives, tracks, strict=True):
        (folder / drive.name).mkdir()
        _write_track(folder / drive.name, track, style)
    path = _drawn(tracks)
    title, subtitle = _title(site), map_subtitle(shown, path, style.estimator)
    (folder / "map.png").write_bytes(render_map(shown, path, title, subtitle, style.export.pixels_per_cell))
    return _write_layers(folder, _layers(known, style.export), path, title, style)


def _layers(known: Sequence[Remembered], config: ExportConfig) -> LayerCells:
    """Occupancy and heights from the depth that the map remembers."""
    layers = Layers.of(config)
    for one in known:
        if one.place.keyframe is not None:
            sight = one.place.keyframe.sight
            layers.add(DepthImage(sight.depth_m, *sight.intrinsics, sight.robot_from_camera), planar(one.place.pose))
    return layers.cells()


def _write_layers(folder: Path, layers: LayerCells, path: DrawnPath, title: str, style: SiteStyle) -> str:
    """As table, picture, and for map_server; what there is to warn of, or nothing."""
    write_table(folder / "layers.parquet", LAYERS, layers.rows(), layers.about(style.estimator))
    thresholds = style.export.free_threshold, style.export.occupied_threshold
    subtitle = layers_subtitle(layers, style.estimator)
    (folder / "layers.png").write_bytes(render_layers(layers, path, title, subtitle, thresholds))
    for name, content in map_server_files(layers, *thresholds).items():
        (folder / name).write_bytes(content)
    return map_server_doubt(layers)


def _write_places(path: Path, known: Sequence[Remembered], style: SiteStyle) -> None:
    """Keyframes are numbered anew, since those of several logs have the same numbers."""
    file = TableFileWriter(path, PLACES, {**style.meta, "side": style.grid.side})
    try:
        for number, one in enumerate(known):
            file.append(place_row(number, one.stamp_nanos, one.place, one.seen))
    finally:
        file.close()


def _write_track(folder: Path, track: Sequence[Pose], style: SiteStyle) -> None:
    """As table and as TUM file."""
    rows: dict[str, list[Any]] = {
        "frame": [row.frame for row in track],
        "stamp_nanos": [row.stamp_nanos for row in track],
        "x_m": [row.pose.x_m for row in track],
        "y_m": [row.pose.y_m for row in track],
        "heading_rad": [row.pose.heading_rad for row in track],
        "verdict": [row.verdict for row in track],
    }
    write_table(folder / "trajectory.parquet", TRAJECTORY, rows, {"estimator": style.estimator})
    (folder / "trajectory.tum").write_bytes(tum_of(rows))


def _drawn(tracks: Sequence[Sequence[Pose]]) -> DrawnPath:
    """The ways of all logs."""
    rows = [row.pose for track in tracks for row in track]
    starts = np.cumsum([len(track) for track in tracks[:-1]], dtype=np.int64).tolist()
    return DrawnPath(np.array([row.x_m for row in rows]), np.array([row.y_m for row in rows]), tuple(starts))


def _title(site: Site) -> str:
    others = len(site.drives) - 1
    return site.drives[0].name + (f" and {others} more {'log' if others == 1 else 'logs'}" if others else "")
