"""The export stage: every file read back by other means than those that wrote it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from evo.tools import file_interface

from semslam.errors import SemslamError
from semslam.geometry import rle
from semslam.geometry.frames import FLU_FROM_OPTICAL
from semslam.labels import FREE_FLOOR, OBSTACLE, class_list
from semslam.slam import exchange
from semslam.stages import export
from semslam.stages.contract import FinishedShard
from semslam.stages.settings import ExportConfig
from semslam.tables.parquet import TableFiles, write_table
from semslam.tables.pictures import encode_colour, encode_depth
from semslam.tables.spec import CELLS, DETECTIONS, FRAMES, LAYERS, OBJECTS, POSES, TRAJECTORY
from tests.slam_world import MemoryContext

CLASSES = class_list(("chair",))
META = {"classes": list(CLASSES), "cell_m": 0.1, "estimator": "paper"}
STAMP = 1_700_000_000_123_456_789
ROS = ExportConfig(occupied_threshold=0.65, free_threshold=0.196)


def write_poses(path: Path, poses: list[tuple[float, float, float] | None]) -> None:
    nothing: list[Any] = [None] * len(poses)
    lists: list[list[float]] = [[] for _ in poses]
    columns = {
        name: [pose[i] if pose else None for pose in poses] for i, name in enumerate(("x_m", "y_m", "heading_rad"))
    }
    rows = {
        "frame": list(range(len(poses))), "stamp_nanos": [STAMP + i * 10**9 for i in range(len(poses))], **columns,
        "source": ["inertial" if pose else "none" for pose in poses], "peak": nothing, "entropy_nats": nothing,
        "verdict": ["uncertain" if pose else "lost" for pose in poses], "covariance": lists,
        "mode_x_m": lists, "mode_y_m": lists, "mode_heading_rad": lists, "mode_probability": lists,
    }  # fmt: skip
    write_table(path, POSES, rows, META)


def write_cells(path: Path, cells: dict[tuple[int, int], int]) -> None:
    ix, iy = [x for x, _ in cells], [y for _, y in cells]
    count = len(cells)
    rows = {
        "ix": ix, "iy": iy, "x_m": [(i + 0.5) * 0.1 for i in ix], "y_m": [(i + 0.5) * 0.1 for i in iy],
        "class_id": list(cells.values()), "label": [CLASSES[i] for i in cells.values()], "probability": [0.7] * count,
        "hits": [2] * count, "views": [3] * count, "first_seen_nanos": [1] * count, "last_seen_nanos": [2] * count,
    }  # fmt: skip
    write_table(path, CELLS, rows, META)


def write_sights(folder: Path, count: int, seen: Sequence[int]) -> None:
    """A board two metres ahead, half a metre wide, in all frames; a chair in those that see it as one."""
    depth_m = np.full((120, 160), 5.0, np.float32)
    depth_m[40:80, 60:100] = 2.0
    board = rle.encode(depth_m == 2.0)
    robot_from_camera = FLU_FROM_OPTICAL.copy()
    robot_from_camera[2, 3] = 0.5
    same: dict[str, Any] = {
        "log_time_nanos": 0, "depth_offset_nanos": 0, "width": 160, "height": 120, "fx": 160.0, "fy": 160.0, "cx": 79.5,
        "cy": 59.5, "roll_rad": 0.0, "pitch_rad": 0.0, "level_source": "tf", "camera_height_m": 0.5,
        "height_source": "tf", "robot_from_camera": robot_from_camera.ravel().tolist(),
        "colour": encode_colour(np.zeros((120, 160, 3), np.uint8)), "depth": encode_depth(depth_m),
    }  # fmt: skip
    frames = range(count)
    rows = {name: [value] * count for name, value in same.items()}
    stamps = [STAMP + frame * 10**9 for frame in frames]
    write_table(folder / "frames.parquet", FRAMES, {**rows, "frame": list(frames), "stamp_nanos": stamps})
    found: dict[str, Any] = {
        "detection": 0, "class_id": 3, "label": "chair", "source_label": "chair", "score": 0.5, "x0_px": 60.0,
        "y0_px": 40.0, "x1_px": 100.0, "y1_px": 80.0, "mask_runs": board, "mask_pixels": 1600, "depth_pixels": 1600,
        "min_x_m": 2.0, "min_y_m": -0.25, "min_z_m": 0.25, "max_x_m": 2.0, "max_y_m": 0.25, "max_z_m": 0.75,
    }  # fmt: skip
    rows = {name: [value] * len(seen) for name, value in found.items()}
    stamps = [STAMP + frame * 10**9 for frame in seen]
    meta = {"classes": list(CLASSES)}
    write_table(folder / "detections.parquet", DETECTIONS, {**rows, "frame": list(seen), "stamp_nanos": stamps}, meta)


def exported(
    folder: Path,
    poses: list[tuple[float, float, float] | None],
    cells: dict[tuple[int, int], int],
    config: ExportConfig = ROS,
    seen: Sequence[int] = (),
) -> MemoryContext:
    folder.mkdir(parents=True, exist_ok=True)
    write_poses(folder / "poses.parquet", poses)
    write_cells(folder / "cells.parquet", cells)
    write_sights(folder, len(poses), seen)
    tables = (POSES, CELLS, FRAMES, DETECTIONS)
    inputs = {table.name: TableFiles(table, [folder / f"{table.name}.parquet"]) for table in tables}
    context = MemoryContext(folder / "out", inputs, config, "paper")
    export.run(context)
    return context


POSE_LIST: list[tuple[float, float, float] | None] = [(0.0, 0.0, 0.0), None, (1.25, -0.5, math.pi / 2)]
CELL_LIST = {(-3, -2): FREE_FLOOR, (-2, -2): OBSTACLE, (0, 1): 3}


def test_all_files_are_there(tmp_path: Path) -> None:
    """Exactly these."""
    context = exported(tmp_path, POSE_LIST, CELL_LIST)
    assert sorted(path.name for path in (context.folder / "shard-0").iterdir()) == [
        "layers.parquet", "layers.png", "map.parquet", "map.pgm", "map.png", "map.yaml", "objects.parquet",
        "trajectory.parquet", "trajectory.tum",
    ]  # fmt: skip
    assert context.done[-1] == (9, 9)
    assert context.shards[0].warnings == []


def test_trajectory_leaves_out_keyframes_without_a_pose(tmp_path: Path) -> None:
    """Table and TUM file agree; stamps keep all nine decimals."""
    context = exported(tmp_path, POSE_LIST, CELL_LIST)
    rows = context.results(TRAJECTORY)["trajectory"].read()
    assert rows == {
        "frame": [0, 2], "stamp_nanos": [STAMP, STAMP + 2 * 10**9], "x_m": [0.0, 1.25], "y_m": [0.0, -0.5],
        "heading_rad": [0.0, math.pi / 2], "verdict": ["uncertain", "uncertain"],
    }  # fmt: skip
    lines = (context.folder / "shard-0" / "trajectory.tum").read_text().splitlines()
    assert lines[1].split()[0] == "1700000002.123456789"
    track = file_interface.read_tum_trajectory_file(str(context.folder / "shard-0" / "trajectory.tum"))
    np.testing.assert_allclose(track.positions_xyz, [[0, 0, 0], [1.25, -0.5, 0]])
    np.testing.assert_allclose(track.get_orientations_euler()[:, 2], [0, math.pi / 2])


def test_map_server_files(tmp_path: Path) -> None:
    """From depth, not from the semantic cells: a board, free floor before it, and what neither hides nor shows."""
    context = exported(tmp_path, POSE_LIST[:1], CELL_LIST)
    shard = context.folder / "shard-0"
    yaml = dict(line.split(": ", 1) for line in (shard / "map.yaml").read_text().splitlines())
    origin = [float(word) for word in yaml.pop("origin").strip("[]").split(",")]
    assert yaml == {
        "image": "map.pgm", "mode": "trinary", "resolution": "0.050000", "negate": "0", "occupied_thresh": "0.65",
        "free_thresh": "0.196",
    }  # fmt: skip
    image = cv2.imread(str(shard / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert set(np.unique(image)) == {0, 205, 254}

    def grey(x_m: float, y_m: float) -> int:
        column, row = (int((place - corner) / 0.05) for place, corner in zip((x_m, y_m), origin[:2], strict=True))
        return int(image[image.shape[0] - 1 - row, column])

    assert (grey(2.02, 0.02), grey(2.02, -0.2)) == (0, 0)
    assert {grey(1.6, y_m) for y_m in (-0.2, 0.02, 0.2)} == {254}
    assert grey(2.4, 0.02) == 205


def test_a_map_without_anything_known_is_warned_of(tmp_path: Path) -> None:
    """Depth is cut off before the board: one unknown cell, with the setting that did it."""
    context = exported(tmp_path, POSE_LIST[:1], CELL_LIST, ExportConfig(layer_depth_m=0.1))
    image = cv2.imread(str(context.folder / "shard-0" / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.tolist() == [[205]]
    assert "up to 0.1 m (`export.layer_depth_m`)" in context.shards[0].warnings[0]


def test_layers_lie_on_the_map_at_the_poses(tmp_path: Path) -> None:
    """Rows by row and column, heights of the board, null where nothing is known; metadata as it should be."""
    poses = [(1.0, 2.0, math.pi / 2), None]
    config = ExportConfig(layer_cell_m=0.1, max_obstacle_height_m=1.0)
    table = exported(tmp_path, poses, CELL_LIST, config).results(LAYERS)["layers"]
    rows = table.read()
    assert table.meta == {
        "cell_m": 0.1, "min_obstacle_height_m": 0.1, "max_obstacle_height_m": 1.0, "estimator": "paper",
    }  # fmt: skip
    assert list(zip(rows["iy"], rows["ix"], strict=True)) == sorted(zip(rows["iy"], rows["ix"], strict=True))
    assert rows["x_m"] == pytest.approx([(ix + 0.5) * 0.1 for ix in rows["ix"]])
    board = list(zip(rows["ix"], rows["iy"], strict=True)).index((9, 40))
    assert rows["occupancy"][board] == pytest.approx(0.88, abs=0.01)
    assert rows["top_m"][board] == pytest.approx(0.72, abs=0.04)
    assert (rows["floor_m"][board], rows["views"][board]) == (None, 1)
    assert rows["points"][board] > 10
    before = list(zip(rows["ix"], rows["iy"], strict=True)).index((9, 36))
    assert rows["occupancy"][before] == pytest.approx(0.18, abs=0.01)
    assert rows["top_m"][before] is None


@pytest.mark.parametrize(("free", "occupied"), [(0.196, 0.65), (0.25, 0.65), (0.1, 0.15), (0.004, 0.999), (0.5, 0.9)])
def test_map_server_reads_the_three_values_as_meant(free: float, occupied: float) -> None:
    """Also under thresholds that would turn the customary 205 into free floor or wall."""
    occupancy = [(255 - grey) / 255 for grey in (0, 254, exchange.unknown_grey(free, occupied))]
    assert occupancy[0] > occupied
    assert occupancy[1] < free
    assert free <= occupancy[2] <= occupied


@pytest.mark.parametrize(("free", "occupied"), [(0.7, 0.3), (0.0, 0.65), (1 / 255, 0.65), (0.196, 1.0)])
def test_thresholds_that_lose_one_of_the_three_values_are_refused(tmp_path: Path, free: float, occupied: float) -> None:
    """No room for unknown cells, or free floor or objects that map_server reads as unknown. Both keys are named."""
    with pytest.raises(SemslamError) as caught:
        exported(tmp_path, POSE_LIST, CELL_LIST, ExportConfig(free_threshold=free, occupied_threshold=occupied))
    assert "`export.free_threshold`" in caught.value.text()
    assert "`export.occupied_threshold`" in caught.value.text()


def test_map_parquet_stands_alone(tmp_path: Path) -> None:
    """Any Parquet reader, all columns; class list and cell in the metadata."""
    shard = exported(tmp_path, POSE_LIST, CELL_LIST).folder / "shard-0"
    table = pq.read_table(shard / "map.parquet")
    assert table.column_names == [c.name for c in CELLS.columns]
    assert table.column("label").to_pylist() == ["free_floor", "obstacle", "chair"]
    assert TableFiles(CELLS, [shard / "map.parquet"]).meta == META


def test_an_empty_map_and_no_poses(tmp_path: Path) -> None:
    """Every file is still there and can be read."""
    shard = exported(tmp_path, [], {}).folder / "shard-0"
    picture = cv2.imread(str(shard / "map.png"))
    occupancy = cv2.imread(str(shard / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape[1] > 800
    assert occupancy is not None
    assert occupancy.tolist() == [[205]]
    assert (shard / "trajectory.tum").read_text() == ""


def test_a_torn_map_warns_instead_of_filling_the_disk(tmp_path: Path) -> None:
    """Two keyframes a thousand kilometres apart: no PGM, but pictures, and a word about it."""
    torn: list[tuple[float, float, float] | None] = [(0.0, 0.0, 0.0), (1e6, 1e6, 0.0)]
    context = exported(tmp_path, torn, {(0, 0): OBSTACLE, (10_000_000, 10_000_000): OBSTACLE})
    names = {path.name for path in (context.folder / "shard-0").iterdir()}
    assert "map.pgm" not in names
    assert "map.yaml" not in names
    assert {"map.png", "layers.png"} < names
    assert "map.pgm" in context.shards[0].warnings[0]


def test_a_pose_off_any_map_is_left_out_of_the_layers(tmp_path: Path) -> None:
    """The others make the same table as without it."""
    far: list[tuple[float, float, float] | None] = [(0.0, 0.0, 0.0), (1e12, 0.0, 0.0)]
    near: list[tuple[float, float, float] | None] = [(0.0, 0.0, 0.0), None]
    first, second = (exported(tmp_path / name, poses, {}) for name, poses in (("far", far), ("near", near)))
    assert first.results(LAYERS)["layers"].read() == second.results(LAYERS)["layers"].read()


def test_same_tables_same_bytes(tmp_path: Path) -> None:
    """All files of two runs."""
    first, second = (exported(tmp_path / name, POSE_LIST, CELL_LIST).folder / "shard-0" for name in ("a", "b"))
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes(), path.name


def test_a_finished_export_is_not_repeated(tmp_path: Path) -> None:
    """The shard is published already."""
    context = exported(tmp_path, POSE_LIST, CELL_LIST)
    context.finished = (FinishedShard(0, {}, {}, context.folder / "shard-0"),)
    export.run(context)
    assert len(context.shards) == 1


def test_objects_stand_where_detections_lie_at_the_poses(tmp_path: Path) -> None:
    """Seen from keyframes with a pose alone; one that too few saw is left out."""
    poses = [(1.0, 2.0, math.pi / 2), None, (1.0, 2.0, math.pi / 2)]
    context = exported(tmp_path / "seen", poses, CELL_LIST, seen=[0, 1, 2])
    rows = context.results(OBJECTS)["objects"].read()
    assert (rows["label"], rows["frames"]) == (["chair"], [[0, 2]])
    assert rows["x_m"][0] == pytest.approx(1.0, abs=0.05)
    assert rows["y_m"][0] == pytest.approx(4.0, abs=0.05)
    assert rows["height_m"][0] == pytest.approx(0.75, abs=0.02)
    assert (rows["first_seen_nanos"], rows["last_seen_nanos"]) == ([STAMP], [STAMP + 2 * 10**9])
    assert context.results(OBJECTS)["objects"].meta["classes"] == list(CLASSES)
    alone = exported(tmp_path / "alone", poses, CELL_LIST, seen=[0, 1])
    assert alone.results(OBJECTS)["objects"].read()["label"] == []
    config = ExportConfig(object_frames=1)
    assert len(exported(tmp_path / "one", poses, CELL_LIST, config, [0]).results(OBJECTS)["objects"].read()["x_m"]) == 1
