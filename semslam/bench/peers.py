"""Other people's packages on the same keyframes, each in a process of its own: a crash costs that log its coverage.

Reads   frames, motion    data_spec.md, tables 2 and 3
Gives   stamps and poses  of the robot in the frame of the first keyframe; keyframes without a pose are left out

Of them only small_gicp comes with semslam: `pip install kiss-icp pyorbslam3`. pyorbslam3 also needs ORB-SLAM3's
vocabulary, whose file its environment variable `PYORBSLAM3_VOCAB` names; `benchmarks/orb_vocabulary.py` makes one.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice, tee
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2, planar
from semslam.geometry.projection import points_in_robot
from semslam.tables.parquet import TableFiles, rows_of
from semslam.tables.pictures import decode_colour, decode_depth
from semslam.tables.spec import FRAMES, MOTION

TASK = "semslam.bench.peers:track"
VERSION = 4
TIMEOUT_S = 900.0
_VOXEL_M, _REACH_M, _MAX_DEPTH_M, _NEIGHBOURS = 0.1, 0.3, 6.0, 20
"""Settings of small_gicp: of reaches of 0.2, 0.3 and 0.5 m and voxels of 0.05 and 0.1 m the best over three drives
that train. kiss-icp shares depth and voxels."""
_MOST_PAUSE_S = 2.0
"""Between keyframes of pyorbslam3: gaps in a log need not be waited for."""

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Keyframe:
    """One row of the frames table, decoded, with the motion since the one before."""

    stamp_nanos: int
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    intrinsics: tuple[float, float, float, float]
    robot_from_camera: Matrix
    motion: SE2 | None

    @property
    def cloud(self) -> Matrix:
        """(N, 3) points in the robot frame, as many as have depth up to 6 m."""
        points = points_in_robot(self.depth_m, *self.intrinsics, self.robot_from_camera)
        near = (self.depth_m > 0) & (self.depth_m < _MAX_DEPTH_M)
        return np.ascontiguousarray(points[near], np.float64)


Poses = Iterator[Matrix | None]
"""first_from_robot (4, 4) of each keyframe, or None."""


def installed(peer: str) -> bool:
    """Whether the package of a peer can be imported."""
    return find_spec(peer) is not None


def version(peer: str) -> str:
    """Version of the package of a peer."""
    from importlib.metadata import version as installed_version

    return installed_version(peer)


def track(arguments: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Run a peer over the first keyframes of a log: peer, frames and motion (files of the tables), steps."""
    whole = keyframes(*([Path(file) for file in arguments[name]] for name in ("frames", "motion")))
    frames, theirs = tee(islice(whole, arguments["steps"]))
    rows: dict[str, list[float]] = {name: [] for name in ("stamp_nanos", "x_m", "y_m", "heading_rad")}
    for frame, pose in zip(frames, _PEERS[arguments["peer"]](theirs, folder), strict=True):
        if pose is not None:
            heading = float(np.arctan2(pose[1, 0], pose[0, 0]))
            values = (frame.stamp_nanos, float(pose[0, 3]), float(pose[1, 3]), heading)
            for name, value in zip(rows, values, strict=True):
                rows[name].append(value)
    return dict(rows)


def keyframes(frames: Sequence[Path], motion: Sequence[Path]) -> Iterator[Keyframe]:
    """All keyframes of a log."""
    moved = TableFiles(MOTION, motion).read(["stamp_nanos", "dx_m", "dy_m", "dheading_rad"])
    motions = dict(zip(moved["stamp_nanos"], zip(*(moved[n] for n in list(moved)[1:]), strict=True), strict=True))
    for row in rows_of(TableFiles(FRAMES, frames).batches(batch_rows=4)):
        known = motions.get(row["stamp_nanos"], (None,))
        yield Keyframe(
            row["stamp_nanos"],
            decode_colour(row["colour"]),
            decode_depth(row["depth"]),
            (row["fx"], row["fy"], row["cx"], row["cy"]),
            np.array(row["robot_from_camera"], np.float64).reshape(4, 4),
            None if None in known else SE2(*known),
        )


def small_gicp(frames: Iterator[Keyframe], folder: Path) -> Poses:
    """Motion, then GICP of the cloud against the points of all earlier ones; the robot stays on its floor."""
    del folder
    gicp = importlib.import_module("small_gicp")
    pose, world = np.eye(4), np.zeros((0, 3))
    for frame in frames:
        cloud = frame.cloud
        source, _ = gicp.preprocess_points(cloud, _VOXEL_M, num_neighbors=_NEIGHBOURS)
        if len(world):
            pose = pose @ (frame.motion or SE2(0.0, 0.0, 0.0)).matrix
            target, tree = gicp.preprocess_points(world, _VOXEL_M, num_neighbors=_NEIGHBOURS)
            found = gicp.align(target, source, tree, pose, max_correspondence_distance=_REACH_M, max_iterations=50)
            pose = planar(found.T_target_source).matrix if found.converged else pose
        moved = cloud @ pose[:3, :3].T + pose[:3, 3]
        world = gicp.voxelgrid_sampling(np.concatenate([world, moved]), _VOXEL_M / 2).points()[:, :3]
        yield pose


def _kiss_icp(frames: Iterator[Keyframe], folder: Path) -> Poses:
    """Depth as if it were a scan, without motion."""
    del folder
    settings = importlib.import_module("kiss_icp.config").load_config(None)
    settings.data.max_range, settings.data.min_range, settings.data.deskew = _MAX_DEPTH_M, 0.0, False
    settings.mapping.voxel_size = 2 * _VOXEL_M
    settings.registration.max_num_threads = 1
    odometry = importlib.import_module("kiss_icp.kiss_icp").KissICP(settings)
    for frame in frames:
        odometry.register_frame(frame.cloud, np.zeros(0))
        yield np.asarray(odometry.last_pose)


def _pyorbslam3(frames: Iterator[Keyframe], folder: Path) -> Poses:
    """ORB-SLAM3 in its RGB-D mode, settings as ORB-SLAM3's own TUM example has them.

    Once lost, ORB-SLAM3 starts another map at the identity, exactly, and nothing ties that to the first keyframe: from
    there on there is no pose. Neither is there while it is only lately lost and guesses. Its threads race: no two runs
    are quite alike.
    """
    slam: Any = importlib.import_module("pyorbslam3")
    vocabulary, system, first, maps = _orb_vocabulary(slam), None, np.eye(4), 0
    for frame in _at_pace(frames):
        if system is None:
            settings = folder / "orb_slam3.yaml"
            settings.write_text(_orb_settings(frame))
            system, first = slam.Slam(vocabulary, settings, slam.Sensor.RGBD), frame.robot_from_camera
        found = system.track_rgbd(frame.rgb, frame.depth_m, frame.stamp_nanos * 1e-9)
        pose = np.asarray(found.pose_wc, np.float64) if found.ok else None
        maps += pose is not None and np.array_equal(pose, np.eye(4))
        yield None if pose is None or maps > 1 else first @ pose @ np.linalg.inv(frame.robot_from_camera)


def _at_pace(frames: Iterator[Keyframe]) -> Iterator[Keyframe]:
    """Keyframes no sooner after each other than they were recorded, as ORB-SLAM3's examples play recordings.

    It maps in a thread of its own, which has that long on a robot.
    """
    before, due_s = None, time.monotonic()
    for frame in frames:
        apart_s = 0.0 if before is None else (frame.stamp_nanos - before) * 1e-9
        due_s += min(max(apart_s, 0.0), _MOST_PAUSE_S)
        time.sleep(max(0.0, due_s - time.monotonic()))
        before, due_s = frame.stamp_nanos, time.monotonic()
        yield frame


def _orb_vocabulary(slam: Any) -> str:
    """File of the vocabulary; never fetched from anywhere."""
    try:
        return str(slam.vocabulary_path(download=False))
    except FileNotFoundError as error:
        raise SemslamError(
            "pyorbslam3 has no vocabulary",
            hint="name ORBvoc.txt in the environment variable `PYORBSLAM3_VOCAB`, or a file that "
            "`python benchmarks/orb_vocabulary.py RUN OUT.txt` makes from the pictures of a run",
        ) from error


_PEERS: dict[str, Callable[[Iterator[Keyframe], Path], Poses]] = {
    "small_gicp": small_gicp,
    "kiss_icp": _kiss_icp,
    "pyorbslam3": _pyorbslam3,
}


def _orb_settings(frame: Keyframe) -> str:
    """Camera and thresholds in ORB-SLAM3's format."""
    height, width = frame.depth_m.shape
    camera = dict(zip(("fx", "fy", "cx", "cy"), frame.intrinsics, strict=True))
    values: dict[str, Any] = {
        "File.version": '"1.0"',
        "Camera.type": '"PinHole"',
        **{f"Camera1.{name}": f"{value:.6f}" for name, value in camera.items()},
        **{f"Camera1.{name}": "0.0" for name in ("k1", "k2", "p1", "p2")},
        "Camera.width": width,
        "Camera.height": height,
        "Camera.fps": 1,
        "Camera.RGB": 1,
        "Stereo.ThDepth": "40.0",
        "Stereo.b": "0.0747",
        "RGBD.DepthMapFactor": "1.0",
        "ORBextractor.nFeatures": 1000,
        "ORBextractor.scaleFactor": "1.2",
        "ORBextractor.nLevels": 8,
        "ORBextractor.iniThFAST": 20,
        "ORBextractor.minThFAST": 7,
        **{f"Viewer.{name}": "1.0" for name in _VIEWER},
    }
    return "%YAML:1.0\n---\n" + "".join(f"{name}: {value}\n" for name, value in values.items())


_VIEWER = (
    "KeyFrameSize", "KeyFrameLineWidth", "GraphLineWidth", "PointSize", "CameraSize", "CameraLineWidth",
    "ViewpointX", "ViewpointY", "ViewpointZ", "ViewpointF",
)  # fmt: skip
"""What ORB-SLAM3 wants to know of a viewer that is not opened."""
