"""Pictures with truth from the test logs of a data set of `semslam simulate`, as they are or in unfamiliar settings.

Reads   plan.json, splits.parquet, logs/NAME.mcap, truth/NAME/truth.parquet and home_objects.parquet of the data set
Writes  WORK/<familiar or unfamiliar>_every<K>/NAME.parquet, table `views` of data_spec.md, `view` being the keyframe

Colour, depth and instances are those of the log; boxes and shares are worked out from the true pose and the home. In
unfamiliar settings the same places are looked at again by another camera, in the home as `estranged` makes it. Finished
files are kept: remove the folder after a change of the simulator.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.camera import Camera
from semslam.geometry.frames import Matrix, invert
from semslam.logs.decode import decoder_for
from semslam.logs.images import decode_depth
from semslam.logs.messages import CompressedImage
from semslam.logs.reader import LogReader
from semslam.logs.writer import encode_jpeg, encode_png
from semslam.models.training.pictures import PictureSet
from semslam.sim.boxes import TrueBox, true_boxes
from semslam.sim.home import CLASSES, Home
from semslam.sim.layout import make_home
from semslam.sim.log import COLOUR, DEPTH, INSTANCES, LogOptions
from semslam.sim.splits import load_split
from semslam.sim.unfamiliar import estranged, unfamiliar_camera
from semslam.sim.vehicle import draw_robot
from semslam.sim.views import lens_row, object_columns, write_views
from semslam.tables.parquet import TableFiles
from semslam.tables.pictures import encode_depth
from semslam.tables.spec import HOME_OBJECTS, TRUTH, VIEWS

LEAST_PIXELS = 40
"""Objects that show less are not even glimpses."""
_STREAM = 0xE4E5


@dataclass(frozen=True)
class TestLog:
    """A log of the data set that tests, and what made it."""

    folder: Path
    """Of the data set."""
    name: str
    home_seed: int
    variant: str
    day: int
    home: int
    """Number among the homes that test, from 0."""

    @property
    def path(self) -> Path:
        return self.folder / "logs" / f"{self.name}.mcap"

    def table(self, name: str) -> Path:
        """A file of the log's truth."""
        return self.folder / "truth" / self.name / f"{name}.parquet"


@dataclass(frozen=True, eq=False)
class LogViews:
    """The pictures of one log."""

    log: TestLog
    pictures: PictureSet
    frames: tuple[int, ...]
    """Keyframe of every picture."""


def finished_test_logs(folder: Path) -> tuple[list[TestLog], list[str]]:
    """The test logs of the cross-scene split that are recorded, and the names of those still missing."""
    names = load_split(folder / "splits.parquet", "cross", "test")
    plan = {entry["name"]: entry for entry in json.loads((folder / "plan.json").read_text())["logs"]}
    seeds = sorted({plan[name]["home_seed"] for name in names})
    logs = [
        TestLog(folder, name, one["home_seed"], one["variant"], one["day"], seeds.index(one["home_seed"]))
        for name, one in ((name, plan[name]) for name in names)
    ]
    done = [log for log in logs if log.path.is_file() and log.table("obstructed").is_file()]
    return done, [log.name for log in logs if log not in done]


def log_views(log: TestLog, work: Path, every: int, *, unfamiliar: bool, most: int | None = None) -> LogViews:
    """The pictures of a log, every so many keyframes, from the work folder if they are there.

    Args:
        most: only so many of them; kept apart from whole ones.
    """
    kind = f"{'unfamiliar' if unfamiliar else 'familiar'}_every{every}{f'_most{most}' if most else ''}"
    path = work / kind / log.name / f"{log.name}.parquet"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        poses = poses_of(log)
        frames = sorted(poses)[::every][:most]
        rows = list(_unfamiliar_rows(log, poses, frames) if unfamiliar else _recorded_rows(log, poses, frames))
        write_views(path, rows, {"classes": list(CLASSES), "variant": log.variant, "seed": log.home_seed})
    return LogViews(log, PictureSet.open(path.parent), tuple(TableFiles(VIEWS, [path]).read(["view"])["view"]))


def poses_of(log: TestLog) -> dict[int, Matrix]:
    """world_from_base of every keyframe, tilt included."""
    rows = TableFiles(TRUTH, [log.table("truth")]).read()
    columns = (rows[name] for name in ("frame", "x_m", "y_m", "z_m", "heading_rad", "pitch_rad", "roll_rad"))
    return {frame: _pose(*pose) for frame, *pose in zip(*columns, strict=True)}


def robot_from_camera(log: TestLog, world_from_base: Matrix) -> Matrix:
    """Optical frame to the levelled robot on the floor, as the true maps have it."""
    upright = _pose(*planar_parts(world_from_base), 0.0, 0.0)
    return invert(upright) @ world_from_base @ draw_robot(log.home_seed).base_from_camera


def planar_parts(matrix: Matrix) -> tuple[float, float, float, float]:
    """x, y, height of the floor (0) and heading of a pose."""
    return float(matrix[0, 3]), float(matrix[1, 3]), 0.0, float(np.arctan2(matrix[1, 0], matrix[0, 0]))


def armchairs(log: TestLog) -> frozenset[int]:
    """Instances that are sofas here and chairs elsewhere."""
    rows = TableFiles(HOME_OBJECTS, [log.table("home_objects")]).read(["instance", "style"])
    return frozenset(i for i, style in zip(rows["instance"], rows["style"], strict=True) if style == "armchair")


def _pose(
    x_m: float, y_m: float, z_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
) -> Matrix:
    """Rz(heading) Ry(pitch) Rx(roll), then the place."""
    (ch, cp, cr), (sh, sp, sr) = ([f(a) for a in (heading_rad, pitch_rad, roll_rad)] for f in (np.cos, np.sin))
    pose = np.eye(4)
    pose[:3, :3] = (
        np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    pose[:3, 3] = x_m, y_m, z_m
    return pose


# ------------------------------------------------------------------------------------------------------ as recorded


def _recorded_rows(log: TestLog, poses: Mapping[int, Matrix], frames: Sequence[int]) -> Iterator[dict[str, Any]]:
    home, robot, camera = _home(log), draw_robot(log.home_seed), LogOptions().camera
    images, stamps = _images(log), _stamps(log)
    place = {"camera_height_m": robot.camera_height_m, "camera_pitch_rad": robot.camera_pitch_rad}
    for frame in frames:
        colour, depth, shown = (images[topic].get(stamps[frame]) for topic in (COLOUR, DEPTH, INSTANCES))
        if colour is None or depth is None or shown is None:
            print(f"{log.name}: keyframe {frame} has lost a picture and is left out")
            continue
        pictures = {"colour": colour.data, "depth": encode_depth(decode_depth(depth)), "instances": shown.data}
        seen = _seen(home, camera, poses[frame] @ robot.base_from_camera, _decoded(shown.data))
        yield {"view": frame, **pictures, **place, **lens_row(camera), **object_columns(seen)}


def _images(log: TestLog) -> dict[str, dict[int, CompressedImage]]:
    """The picture messages of a log by topic and stamp."""
    found: dict[str, dict[int, CompressedImage]] = {COLOUR: {}, DEPTH: {}, INSTANCES: {}}
    decoder = cache(decoder_for)
    for raw in LogReader([log.path]).messages(lambda channel: channel.topic in found):
        message = decoder(raw.channel)(raw.data)
        if not isinstance(message, CompressedImage):
            raise SemslamError(f"`{log.path}` has raw pictures on `{raw.channel.topic}`", hint="simulate it again")
        found[raw.channel.topic][message.stamp_nanos] = message
    return found


def _stamps(log: TestLog) -> dict[int, int]:
    rows = TableFiles(TRUTH, [log.table("truth")]).read(["frame", "stamp_nanos"])
    return dict(zip(rows["frame"], rows["stamp_nanos"], strict=True))


def _decoded(data: bytes) -> NDArray[np.uint16]:
    import cv2

    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), np.uint16)


# -------------------------------------------------------------------------------------------------- unfamiliar settings


def _unfamiliar_rows(log: TestLog, poses: Mapping[int, Matrix], frames: Sequence[int]) -> Iterator[dict[str, Any]]:
    from semslam.sim.eye import Eye
    from semslam.sim.sensors import draw_colour_camera, measure_depth, measure_rgb

    rng = np.random.default_rng([_STREAM, log.home_seed, *log.name.encode()])
    robot, camera = unfamiliar_camera(rng)
    home = estranged(_home(log), log.home)
    eye, lens = Eye(home, camera), draw_colour_camera(rng)
    place = {"camera_height_m": robot.camera_height_m, "camera_pitch_rad": robot.camera_pitch_rad}
    for frame in frames:
        pose = _pose(*planar_parts(poses[frame])) @ robot.base_from_camera
        sight = eye.look(pose)
        pictures = {
            "colour": encode_jpeg(measure_rgb(sight.rgb, rng, lens), 90),
            "depth": encode_png(measure_depth(sight, rng)),
            "instances": encode_png(sight.instances),
        }
        seen = _seen(home, camera, pose, sight.instances)
        yield {"view": frame, **pictures, **place, **lens_row(camera), **object_columns(seen)}


# --------------------------------------------------------------------------------------------------------------- rows


@cache
def _home(log: TestLog) -> Home:
    return make_home(log.home_seed, log.variant, log.day)


def _seen(home: Home, camera: Camera, world_from_camera: Matrix, instances: NDArray[np.uint16]) -> list[TrueBox]:
    """Objects in view; of a sight only the instances matter for boxes."""
    from semslam.sim.eye import Sight

    blank = np.zeros(instances.shape, np.float32)
    rgb = np.zeros((*instances.shape, 3), np.uint8)
    sight = Sight(rgb, blank, instances, np.zeros(instances.shape, np.uint8), blank)
    return [box for box in true_boxes(home, sight, camera, world_from_camera) if box.pixels >= LEAST_PIXELS]
