"""A flat world of coloured tiles, and a camera that looks down at it: pictures with depth whose poses are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import FLU_FROM_OPTICAL, SE2, Matrix
from semslam.models.small_view import HEIGHT, WIDTH, small_view
from semslam.models.training.sequences import DriveFiles, PictureDrive, PictureDrives
from semslam.slam.estimator import Step, View
from semslam.tables.parquet import write_table
from semslam.tables.pictures import encode_colour, encode_depth
from semslam.tables.spec import FRAMES, TRUTH

TILE_M = 0.3
_FOCAL_PX = WIDTH / 2  # 90 degrees
_TILES = 128


def robot_from_camera(height_m: float = 1.0, pitch_rad: float = 0.6) -> Matrix:
    """A camera above the robot's middle, nose down."""
    cosine, sine = math.cos(pitch_rad), math.sin(pitch_rad)
    tilt = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    matrix = FLU_FROM_OPTICAL.copy()
    matrix[:3, :3] = tilt @ FLU_FROM_OPTICAL[:3, :3]
    matrix[2, 3] = height_m
    return matrix


def make_tiles(seed: int) -> NDArray[np.uint8]:
    """A colour for every tile."""
    return np.random.default_rng(seed).integers(0, 256, (_TILES, _TILES, 3), dtype=np.uint8)


def look(tiles: NDArray[np.uint8], world_from_robot: SE2, scale: int = 1) -> View:
    """What the camera sees; the sky is black and has no depth."""
    width, height, focal = WIDTH * scale, HEIGHT * scale, _FOCAL_PX * scale
    cx, cy = (width - 1) / 2, (height - 1) / 2
    v, u = np.mgrid[:height, :width]
    camera = robot_from_camera()
    rays = np.stack([(u - cx) / focal, (v - cy) / focal, np.ones(u.shape)], -1) @ camera[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, -camera[2, 3] / rays[..., 2], 0.0)
    depth[depth > 6.0] = 0.0
    ground = world_from_robot.apply(rays[..., :2] * depth[..., None])
    column, row = np.moveaxis(np.floor(ground / TILE_M).astype(int) % _TILES, -1, 0)
    rgb = np.where(depth[..., None] > 0, tiles[row, column], 0).astype(np.uint8)
    return View(rgb, depth.astype(np.float32), focal, focal, cx, cy, camera)


def make_drive(frames: int, seed: int) -> list[SE2]:
    """A walk from a random place: a quarter of a metre ahead, with turns of up to half a right angle."""
    rng = np.random.default_rng(seed)
    walk = [SE2(*rng.uniform(-5.0, 5.0, 2).tolist(), float(rng.uniform(-math.pi, math.pi)))]
    for turn in rng.uniform(-0.8, 0.8, frames - 1).tolist():
        walk.append(walk[-1] @ SE2(0.25, 0.0, turn))
    return walk


def make_drives(logs: int = 2, frames: int = 12, seed: int = 0) -> PictureDrives:
    """Drives through one world each, as training has them in memory."""
    return PictureDrives(tuple(_drive(seed + log, frames) for log in range(logs)), f"world {seed}")


def _drive(seed: int, frames: int) -> PictureDrive:
    walk = make_drive(frames, seed)
    views = [look(make_tiles(seed), pose) for pose in walk]
    small = [small_view(v.rgb, v.depth_m, v.fx, v.fy, v.cx, v.cy, v.robot_from_camera) for v in views]
    poses = np.array([(pose.x_m, pose.y_m, pose.heading_rad) for pose in walk])
    pictures, ground = np.stack([one.picture for one in small]), np.stack([one.ground_m for one in small])
    return PictureDrive(f"log_{seed}", pictures, ground, poses)


def make_steps(frames: int, seed: int = 0, without_view: Sequence[int] = ()) -> list[Step]:
    """Keyframes of one drive as an estimator gets them."""
    tiles = make_tiles(seed)
    walk = make_drive(frames, seed)
    return [
        Step(frame, frame, None, None, None if frame in without_view else look(tiles, pose))
        for frame, pose in enumerate(walk)
    ]


def write_drive(folder: Path, frames: int, seed: int = 0, untrue: Sequence[int] = ()) -> DriveFiles:
    """The tables of a drive, as ingest and the simulator write them; `untrue` frames have no truth."""
    tiles, walk = make_tiles(seed), make_drive(frames, seed)
    views = [look(tiles, pose, scale=2) for pose in walk]
    stamps = [10 * frame for frame in range(frames)]
    constant = {"log_time_nanos": 0, "depth_offset_nanos": 0, "roll_rad": 0.0, "pitch_rad": 0.0}
    text = {"level_source": "tf", "height_source": "tf", "camera_height_m": 1.0}
    folder.mkdir(parents=True, exist_ok=True)
    rows = {
        "frame": list(range(frames)),
        "stamp_nanos": stamps,
        "colour": [encode_colour(view.rgb) for view in views],
        "depth": [encode_depth(view.depth_m) for view in views],
        "width": [view.rgb.shape[1] for view in views],
        "height": [view.rgb.shape[0] for view in views],
        **{name: [getattr(view, name) for view in views] for name in ("fx", "fy", "cx", "cy")},
        "robot_from_camera": [view.robot_from_camera.ravel().tolist() for view in views],
        **{name: [value] * frames for name, value in {**constant, **text}.items()},
    }
    write_table(folder / "frames.parquet", FRAMES, rows)
    true = [frame for frame in range(frames) if frame not in untrue]
    flat = {name: [0.0] * len(true) for name in ("z_m", "roll_rad", "pitch_rad")}
    poses = {name: [getattr(walk[frame], name) for frame in true] for name in ("x_m", "y_m", "heading_rad")}
    stamped = {"frame": true, "stamp_nanos": [stamps[frame] for frame in true]}
    write_table(folder / "truth.parquet", TRUTH, {**stamped, **poses, **flat})
    return DriveFiles(f"log_{seed}", (folder / "frames.parquet",), (folder / "truth.parquet",))
