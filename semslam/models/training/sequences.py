"""Sequences of pictures with true poses, for the networks that learn motion from pictures.

Reads   frames, truth   data_spec.md, tables 2 and 4: of a run of `semslam ingest`, or truth of the data set
Writes  one array file a log into a cache folder, named by the content it was made from

Pictures are kept as thumbnails (models/small_view.py): 78 logs of 80 keyframes take 270 MB.
"""

from __future__ import annotations

import hashlib
import math
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import wrap_angles
from semslam.models.onnxfile import file_digest
from semslam.models.small_view import HEIGHT, PART, WIDTH, SmallView, network_input, small_view
from semslam.tables.parquet import TableFiles, rows_of
from semslam.tables.pictures import decode_colour, decode_depth
from semslam.tables.spec import FRAMES, TRUTH

_VERSION = 1
"""Of the array files; raised when thumbnails or their points change."""
_COLUMNS = ("stamp_nanos", "colour", "depth", "fx", "fy", "cx", "cy", "robot_from_camera")
_GAIN, _LIFT = 0.3, 0.1
"""Contrast varies by this share either way, brightness by this much."""


@dataclass(frozen=True)
class DriveFiles:
    """Where a log's pictures and true poses lie."""

    name: str
    frames: tuple[Path, ...]
    """Shards of the frames table."""
    truth: tuple[Path, ...]
    """Shards of a truth table."""


@dataclass(frozen=True, eq=False)
class PictureDrive:
    """One log, keyframe by keyframe."""

    name: str
    pictures: NDArray[np.uint8]
    """(T, HEIGHT, WIDTH, 3)"""
    ground_m: NDArray[np.float32]
    """(T, PARTS, 2) where the parts of each picture lie, in the robot frame; NaN for nowhere."""
    poses: NDArray[np.float64]
    """(T, 3) true x, y, heading in the log's own world; NaN where there is no truth."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Some keyframes in a row, as a network sees them in training."""

    pictures: NDArray[np.float32]
    """(T, 3, HEIGHT, WIDTH), 0 to 1."""
    ground_m: NDArray[np.float32]
    """(T, PARTS, 2)"""
    poses: NDArray[np.float64]
    """(T, 3) in the frame of the first."""


@dataclass(frozen=True, eq=False)
class PictureDrives:
    """All logs to learn from, in memory."""

    drives: tuple[PictureDrive, ...]
    digest: str
    """Of what they were made from."""

    def __len__(self) -> int:
        return len(self.drives)

    @staticmethod
    def open(
        files: Sequence[DriveFiles], cache: Path, watch: Callable[[int, int], None] | None = None
    ) -> PictureDrives:
        """Take logs from the cache folder, or make them there first.

        Args:
            files: where the logs lie.
            cache: folder for the array files; may hold those of other logs too.
            watch: hears how many of how many logs are open.

        Raises:
            SemslamError: no logs, a damaged table or picture, or a log without any true pose.
        """
        if not files:
            raise SemslamError("No logs to learn from", hint="`semslam run DATASET/logs --out RUN` makes their tables")
        cache.mkdir(parents=True, exist_ok=True)
        drives, digest = [], hashlib.sha256()
        for done, one in enumerate(files, 1):
            fingerprint = _fingerprint(one)
            digest.update(f"{one.name} {fingerprint}\n".encode())
            drives.append(_opened(one, cache / f"{one.name}-{fingerprint}.npz"))
            if watch:
                watch(done, len(files))
        return PictureDrives(tuple(drives), digest.hexdigest()[:16])

    def windows(self, length: int) -> NDArray[np.int64]:
        """(N, 2) drive and first keyframe of all windows of that many keyframes with truth.

        Raises:
            SemslamError: there is none.
        """
        found = [
            (index, start) for index, drive in enumerate(self.drives) for start in _whole(drive.poses, length).tolist()
        ]
        if not found:
            raise SemslamError(f"No log has {length} keyframes with truth in a row", hint="make longer trajectories")
        return np.array(found, np.int64)

    def clip(self, drive: int, start: int, length: int) -> Clip:
        """A window as it is."""
        chosen, part = self.drives[drive], slice(start, start + length)
        return Clip(network_input(chosen.pictures[part]), chosen.ground_m[part], from_first(chosen.poses[part]))


def drive_files(dataset: Path, names: Sequence[str], frames: Mapping[str, Sequence[Path]]) -> list[DriveFiles]:
    """The logs of a data set folder by name (drives.py, `logs_of`), with the shards of their frames tables in a run.

    Raises:
        SemslamError: a log has no frames.
    """
    missing = [name for name in names if not frames.get(name)]
    if missing:
        raise SemslamError(
            f"{len(missing)} of {len(names)} logs have no keyframes, such as `{missing[0]}`",
            hint=f"`semslam ingest {dataset / 'logs'} --out RUN` makes them",
        )
    return [DriveFiles(name, tuple(frames[name]), (dataset / "truth" / name / "truth.parquet",)) for name in names]


def from_first(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 3) in the frame of the first one; headings in (-pi, pi]."""
    offset = poses - poses[:1]
    cosine, sine = math.cos(poses[0, 2]), math.sin(poses[0, 2])
    x, y = cosine * offset[:, 0] + sine * offset[:, 1], cosine * offset[:, 1] - sine * offset[:, 0]
    return np.stack([x, y, wrap_angles(offset[:, 2])], 1)


def motions_of(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The motion from each pose to the next, in the frame of the former: (T, 3) -> (T - 1, 3)."""
    return np.concatenate([from_first(poses[index : index + 2])[1:] for index in range(len(poses) - 1)])


def mirrored(clip: Clip) -> Clip:
    """What a robot would have seen in the mirrored home: left and right change sides, exactly."""
    turned = np.array([1.0, -1.0, -1.0])
    across = clip.ground_m.reshape(len(clip.poses), HEIGHT // PART, WIDTH // PART, 2)
    ground = (across[:, :, ::-1] * turned[:2].astype(np.float32)).reshape(clip.ground_m.shape)
    return Clip(clip.pictures[..., ::-1], ground, clip.poses * turned)


def varied(clip: Clip, rng: np.random.Generator) -> Clip:
    """Mirrored or not, and in another light, which is the same in all pictures of the clip."""
    clip = mirrored(clip) if rng.random() < 0.5 else clip
    gain, lift = 1 + rng.uniform(-_GAIN, _GAIN), rng.uniform(-_LIFT, _LIFT)
    pictures = np.clip((clip.pictures - 0.5) * np.float32(gain) + np.float32(0.5 + lift), 0.0, 1.0)
    return Clip(np.ascontiguousarray(pictures, np.float32), clip.ground_m, clip.poses)


def _whole(poses: NDArray[np.float64], length: int) -> NDArray[np.int64]:
    """First keyframes of the windows without a gap in the truth."""
    known = np.concatenate([[0], np.cumsum(np.isfinite(poses).all(1))])
    return np.flatnonzero(known[length:] - known[:-length] == length) if len(poses) >= length else np.zeros(0, np.int64)


def _fingerprint(files: DriveFiles) -> str:
    """Of content and version; the same log of another run keeps its array file."""
    digests = [file_digest(path) for path in (*files.frames, *files.truth) if path.is_file()]
    opened = f"{_VERSION} {cv2.__version__} {WIDTH} {HEIGHT} {digests}"
    return hashlib.sha256(opened.encode()).hexdigest()[:16]


def _opened(files: DriveFiles, path: Path) -> PictureDrive:
    """The drive from its array file; one that is missing or damaged is made again."""
    arrays = _read(path)
    if arrays is None:
        arrays = _made(files)
        _write(path, arrays)
    return PictureDrive(files.name, arrays["pictures"], arrays["ground_m"], arrays["poses"])


def _read(path: Path) -> dict[str, NDArray[Any]] | None:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in ("pictures", "ground_m", "poses")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    temporary = path.with_name(f".{path.stem}.partial-{os.getpid()}.npz")
    named = dict[str, Any](arrays)
    try:
        np.savez(temporary, **named)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _made(files: DriveFiles) -> dict[str, NDArray[Any]]:
    """Decode and shrink all keyframes of a log and join them with the truth by stamp."""
    truth = TableFiles(TRUTH, files.truth).read(["stamp_nanos", "x_m", "y_m", "heading_rad"])
    places = zip(truth["x_m"], truth["y_m"], truth["heading_rad"], strict=True)
    pose_at = dict(zip(truth["stamp_nanos"], places, strict=True))
    stamps: list[int] = []
    views: list[SmallView] = []
    for row in rows_of(TableFiles(FRAMES, files.frames).batches(_COLUMNS, batch_rows=8)):
        stamps.append(row["stamp_nanos"])
        views.append(_small(row))
    nowhere = (math.nan, math.nan, math.nan)
    poses = np.array([pose_at.get(stamp, nowhere) for stamp in stamps], np.float64).reshape(-1, 3)
    if not np.isfinite(poses).all(1).any():
        raise SemslamError(f"No keyframe of `{files.name}` has a true pose", hint="learn from simulated logs")
    return {
        "pictures": np.stack([view.picture for view in views]),
        "ground_m": np.stack([view.ground_m for view in views]),
        "poses": poses,
    }


def _small(row: Mapping[str, Any]) -> SmallView:
    camera = {name: row[name] for name in ("fx", "fy", "cx", "cy")}
    robot_from_camera = np.array(row["robot_from_camera"], np.float64).reshape(4, 4)
    pictures = decode_colour(row["colour"]), decode_depth(row["depth"])
    return small_view(*pictures, **camera, robot_from_camera=robot_from_camera)
