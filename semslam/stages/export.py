"""Export: from poses and cells to files for people and other tools.

Reads   poses          data_spec.md, table 7
        cells          data_spec.md, table 9
        places         data_spec.md, table 16, of estimators that have one
        frames         data_spec.md, table 2: depth, for the layers and the objects
        detections     data_spec.md, table 5
Writes  trajectory     data_spec.md, table 10: keyframes with a pose
        objects        data_spec.md, table 17: the things of the map
        layers         data_spec.md, table 18: occupancy and heights, from depth alone
Files   map.png        the picture
        map.parquet    the cells table again, as a file that stands alone
        layers.png     occupancy and heights as a picture
        map.yaml, map.pgm   the occupancy for ROS map_server; left out, with a warning, for maps too large for a
                            picture of single cells
        trajectory.tum      seconds x y z qx qy qz qw
        places.parquet      the places table again, if there is one: a map in which other logs can be found
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from semslam.geometry import rle
from semslam.geometry.frames import SE2
from semslam.geometry.projection import flying, main_body, points_in_robot
from semslam.slam.depth_sight import DepthImage
from semslam.slam.exchange import map_server_doubt, map_server_files, tum_of
from semslam.slam.layer_picture import layers_subtitle, render_layers
from semslam.slam.layers import LayerCells, Layers
from semslam.slam.objects import Patch, things
from semslam.slam.picture import MapCells, Path, map_subtitle
from semslam.slam.render import render_map
from semslam.slam.tiles import LARGEST_M
from semslam.stages.contract import ShardWriter, StageContext, TableSource
from semslam.stages.settings import ExportConfig
from semslam.tables.parquet import TableFileWriter, rows_of, write_table
from semslam.tables.pictures import decode_depth
from semslam.tables.spec import CELLS, DETECTIONS, FRAMES, LAYERS, OBJECTS, PLACES, POSES, TRAJECTORY

_POSE = ("frame", "stamp_nanos", "x_m", "y_m", "heading_rad", "verdict")
_PICTURE = ("frame", "depth", "fx", "fy", "cx", "cy", "robot_from_camera")
_DETECTION = ("frame", "stamp_nanos", "class_id", "score", "mask_runs", "depth_pixels")
_FILES = 9

_Table = Mapping[str, list[Any]]


def run(ctx: StageContext) -> None:
    """Write everything, in one shard."""
    if ctx.finished:
        return
    config: ExportConfig = ctx.config
    poses, cells = ctx.read(POSES), ctx.read(CELLS)
    track, rows = poses.read(_POSE), cells.read()
    shown, placed = MapCells.of(rows, cells.meta), _placed(track)
    path = Path(np.array(track["x_m"], np.float64), np.array(track["y_m"], np.float64))
    with ctx.shard(0) as shard:
        _write_trajectory(shard, track, poses)
        write_table(shard.path("map.parquet"), CELLS, rows, dict(cells.meta))
        estimator = str(cells.meta["estimator"])
        subtitle = map_subtitle(shown, path, estimator)
        shard.path("map.png").write_bytes(render_map(shown, path, ctx.log, subtitle, config.pixels_per_cell))
        ctx.progress(3, _FILES)
        layers = _layers(ctx, placed, config)
        shard.table(LAYERS, layers.about(estimator)).append(layers.rows())
        ctx.progress(4, _FILES)
        _write_occupancy(shard, layers, config)
        ctx.progress(6, _FILES)
        subtitle = layers_subtitle(layers, estimator)
        thresholds = config.free_threshold, config.occupied_threshold
        shard.path("layers.png").write_bytes(render_layers(layers, path, ctx.log, subtitle, thresholds))
        _write_places(ctx, shard)
        ctx.progress(8, _FILES)
        _write_objects(ctx, shard, placed, dict(cells.meta), config)
        ctx.progress(_FILES, _FILES)


def _placed(track: _Table) -> dict[int, SE2]:
    """Poses of the keyframes that have one which is on the map."""
    return {
        frame: SE2(x, y, heading)
        for frame, x, y, heading in zip(*(track[name] for name in ("frame", "x_m", "y_m", "heading_rad")), strict=True)
        if x is not None and max(abs(x), abs(y)) < LARGEST_M
    }


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


def _write_objects(
    ctx: StageContext, shard: ShardWriter, poses: Mapping[int, SE2], meta: Mapping[str, Any], config: ExportConfig
) -> None:
    """The objects that the detections show at the poses."""
    patches = _patches(ctx.read(FRAMES), ctx.read(DETECTIONS), poses, config.object_depth_m)
    found = things(patches, config.object_frames)
    classes = meta["classes"]
    middles = [thing.middle.tolist() for thing in found]
    rows = {
        "object": list(range(len(found))),
        "class_id": [thing.class_id for thing in found],
        "label": [classes[thing.class_id] for thing in found],
        "x_m": [x for x, _ in middles],
        "y_m": [y for _, y in middles],
        "area_m2": [thing.area_m2 for thing in found],
        "height_m": [thing.height_m for thing in found],
        "footprint": [thing.footprint.ravel().tolist() for thing in found],
        "score": [thing.score for thing in found],
        "frames": [list(thing.frames) for thing in found],
        "first_seen_nanos": [thing.first_seen_nanos for thing in found],
        "last_seen_nanos": [thing.last_seen_nanos for thing in found],
    }
    shard.table(OBJECTS, meta).append(rows)
    shard.count("objects", len(found))


def _patches(
    frames: TableSource, detections: TableSource, poses: Mapping[int, SE2], max_depth_m: float
) -> Iterator[Patch]:
    """What each detection of keyframes with a pose covers of the ground."""
    pictures = rows_of(frames.batches(_PICTURE, batch_rows=8))
    found = rows_of(detections.batches(_DETECTION, batch_rows=8))
    for frame, group in groupby(found, key=lambda row: row["frame"]):
        picture = next((row for row in pictures if row["frame"] == frame), None)
        if picture is not None and frame in poses:
            yield from _patches_of(picture, list(group), poses[frame], max_depth_m)


def _patches_of(
    picture: Mapping[str, Any], found: Sequence[Mapping[str, Any]], pose: SE2, max_depth_m: float
) -> Iterator[Patch]:
    depth_m = decode_depth(picture["depth"])
    fx, fy, cx, cy = (picture[name] for name in ("fx", "fy", "cx", "cy"))
    robot_from_camera = np.array(picture["robot_from_camera"], np.float64).reshape(4, 4)
    points = points_in_robot(depth_m, fx, fy, cx, cy, robot_from_camera)
    near = (depth_m > 0) & (depth_m <= max_depth_m)
    usable = near & ~flying(points, near)
    for row in found:
        if not row["depth_pixels"]:
            continue
        inside = rle.decode(row["mask_runs"], *depth_m.shape) & usable
        inside[inside] = main_body(np.hypot(points[..., 0][inside], points[..., 1][inside]))
        patch = Patch.of(points[inside], pose, row["class_id"], float(row["score"]), row["frame"], row["stamp_nanos"])
        if patch is not None:
            yield patch


def _write_trajectory(shard: ShardWriter, track: _Table, poses: TableSource) -> None:
    """The keyframes with a pose, as table and as TUM file."""
    kept = [i for i, x in enumerate(track["x_m"]) if x is not None]
    posed = {name: [track[name][i] for i in kept] for name in _POSE}
    shard.table(TRAJECTORY, dict(poses.meta)).append(posed)
    shard.path("trajectory.tum").write_bytes(tum_of(posed))


def _layers(ctx: StageContext, poses: Mapping[int, SE2], config: ExportConfig) -> LayerCells:
    """Occupancy and heights from the depth of all keyframes with a pose."""
    layers = Layers.of(config)
    for picture in rows_of(ctx.read(FRAMES).batches(_PICTURE, batch_rows=8)):
        if picture["frame"] in poses:
            fx, fy, cx, cy = (picture[name] for name in ("fx", "fy", "cx", "cy"))
            robot_from_camera = np.array(picture["robot_from_camera"], np.float64).reshape(4, 4)
            image = DepthImage(decode_depth(picture["depth"]), fx, fy, cx, cy, robot_from_camera)
            layers.add(image, poses[picture["frame"]])
    return layers.cells()


def _write_occupancy(shard: ShardWriter, cells: LayerCells, config: ExportConfig) -> None:
    """map.pgm and map.yaml."""
    doubt = map_server_doubt(cells)
    if doubt:
        shard.warn(doubt)
    for name, content in map_server_files(cells, config.free_threshold, config.occupied_threshold).items():
        shard.path(name).write_bytes(content)
