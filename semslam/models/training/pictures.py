"""Pictures to learn from: colour, depth, the object of every pixel, and what can be seen of each object.

Reads   views        data_spec.md, table 15: a folder with one file a home, as `semslam train pictures` leaves it
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import shrinking
from semslam.models.onnxfile import file_digest
from semslam.tables.parquet import TableFiles
from semslam.tables.pictures import decode_colour, decode_depth
from semslam.tables.spec import VIEWS

MIN_SHARE, MIN_PIXELS, MIN_SIDE_PX = 0.25, 480, 16
"""An object counts from this share of its silhouette, this many visible pixels and this shorter side on, at 640x480;
lesser glimpses are neither wanted nor punished."""
CLASSES = (
    "chair", "table", "sofa", "bed", "bookshelf", "dresser", "plant", "lamp", "tv", "bin", "refrigerator", "toilet",
)  # fmt: skip
"""Of simulated homes; a test compares them with the simulator's."""
_LISTS = ("class_id", "pixels", "share", "cut")
_AREA_PX, _WIDTH_PX = 640 * 480, 640


@dataclass(frozen=True)
class SeenObject:
    """An object as far as a picture shows it."""

    instance: int
    class_id: int
    """Index into the class names of its set."""
    left: float
    top: float
    right: float
    bottom: float
    """Edges of its visible pixels; right and bottom exclusive."""
    pixels: int
    share: float
    """Visible share of its silhouette, 0 to 1."""
    cut: bool
    """It touches the edge of the picture."""

    def counts(self, width: int, height: int) -> bool:
        """If a detector should find it in a picture of this size."""
        enough = self.pixels >= MIN_PIXELS * width * height / _AREA_PX and self.share >= MIN_SHARE
        return enough and min(self.right - self.left, self.bottom - self.top) >= MIN_SIDE_PX * width / _WIDTH_PX


@dataclass(frozen=True, eq=False)
class Picture:
    """A view and its truth."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    depth_m: NDArray[np.float32]
    """(H, W), 0 where missing."""
    instances: NDArray[np.uint16]
    """(H, W) id of the object of every pixel; 0 is no object."""
    objects: tuple[SeenObject, ...]

    @property
    def counting(self) -> tuple[SeenObject, ...]:
        """The objects that a detector should find."""
        height, width = self.instances.shape
        return tuple(item for item in self.objects if item.counts(width, height))

    @property
    def glimpses(self) -> tuple[SeenObject, ...]:
        """The others."""
        height, width = self.instances.shape
        return tuple(item for item in self.objects if not item.counts(width, height))


@dataclass(frozen=True, eq=False)
class PictureSet:
    """All views of a folder, in memory as the files hold them and decoded when asked for."""

    class_names: tuple[str, ...]
    rows: Sequence[dict[str, Any]]
    digest: str
    """Of names and content of the files."""
    homes: tuple[str, ...] = ()
    """Names of the files."""
    origin: str = ""
    """The command that made it, as far as the folder tells."""

    @staticmethod
    def open(folder: Path, *, homes: slice = slice(None)) -> PictureSet:
        """Open the views of a folder, or of some of its homes.

        Raises:
            SemslamError: no views there, a damaged file, or files with different classes.
        """
        paths = sorted(folder.glob("*.parquet"))[homes]
        if folder.is_file():
            raise SemslamError(f"`{folder}` is a file", hint="name the folder that `semslam train pictures` made")
        if not paths:
            raise SemslamError(f"No views in `{folder}`", hint=f"make some: `semslam train pictures {folder}`")
        homes_read = [_home(path) for path in paths]
        names = {home_names for home_names, _ in homes_read}
        if len(names) > 1:
            raise SemslamError(
                f"Files in `{folder}` disagree about the classes", hint="keep each set in its own folder"
            )
        rows = [row for _, home_rows in homes_read for row in home_rows]
        if not any(len(row["class_id"]) for row in rows):
            raise SemslamError(f"No view in `{folder}` shows an object", hint="make others: `semslam train pictures`")
        return PictureSet(
            names.pop(), rows, _fingerprint(paths), tuple(path.stem for path in paths), _origin(folder, len(paths))
        )

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Picture:
        return _picture(self.rows[index])

    @cached_property
    def classes_of(self) -> list[frozenset[int]]:
        """The classes in each view, without decoding it."""
        return [frozenset(int(number) for number in row["class_id"]) for row in self.rows]


def resized(picture: Picture, width: int, height: int) -> Picture:
    """The picture at another size, resampled as at run time; the objects' boxes and pixels scale with it."""
    rows, columns = picture.instances.shape
    if (rows, columns) == (height, width):
        return picture
    across, down = width / columns, height / rows
    size = (width, height)
    return Picture(
        np.asarray(cv2.resize(picture.rgb, size, interpolation=shrinking(min(across, down))), np.uint8),
        np.asarray(cv2.resize(picture.depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32),
        np.asarray(cv2.resize(picture.instances, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint16),
        tuple(_scaled(item, across, down) for item in picture.objects),
    )


def _scaled(item: SeenObject, across: float, down: float) -> SeenObject:
    left, right, top, bottom = item.left * across, item.right * across, item.top * down, item.bottom * down
    pixels = round(item.pixels * across * down)
    return SeenObject(item.instance, item.class_id, left, top, right, bottom, pixels, item.share, item.cut)


def _home(path: Path) -> tuple[tuple[str, ...], list[dict[str, Any]]]:
    """Class names and rows of the views of one home.

    Raises:
        SemslamError: the file is damaged, empty, or contradicts itself.
    """
    again = f"remove `{path}`, then run the `semslam train pictures` again that made it"
    try:
        file = TableFiles(VIEWS, [path])
        columns, names = file.read(), tuple(str(name) for name in file.meta.get("classes", ()))
    except SemslamError as error:
        raise SemslamError(error.message, hint=again) from error
    rows = [{name: values[index] for name, values in columns.items()} for index in range(file.rows)]
    if not rows or not names or not all(_consistent(row, len(names)) for row in rows):
        raise SemslamError(f"`{path}` holds no views, or such that contradict themselves", hint=again)
    return names, rows


def _consistent(row: dict[str, Any], classes: int) -> bool:
    """If the lists of a view go together and tell of classes and boxes that there are."""
    count = len(row["instance"])
    if len(row["boxes_px"]) != 4 * count or any(len(row[name]) != count for name in _LISTS):
        return False
    known = all(0 <= number < classes for number in row["class_id"])
    return known and bool(np.isfinite(np.asarray(row["boxes_px"], np.float64)).all())


def _picture(row: dict[str, Any]) -> Picture:
    data = np.frombuffer(row["instances"], np.uint8)
    instances = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    rgb, depth_m = decode_colour(row["colour"]), decode_depth(row["depth"])
    if instances is None or not instances.shape == depth_m.shape == rgb.shape[:2]:
        raise SemslamError("The pictures of a view do not go together", hint="make the views again")
    boxes = np.asarray(row["boxes_px"], np.float64).reshape(-1, 4).tolist()
    objects = tuple(
        SeenObject(int(instance), int(class_id), left, top, right, bottom, int(pixels), float(share), bool(cut))
        for instance, class_id, (left, top, right, bottom), pixels, share, cut in zip(
            row["instance"], row["class_id"], boxes, row["pixels"], row["share"], row["cut"], strict=True
        )
    )
    return Picture(rgb, depth_m, np.asarray(instances, np.uint16), objects)


def _origin(folder: Path, homes: int) -> str:
    """What to type for the same views, from the plan that `semslam train pictures` leaves; else the folder's name."""
    try:
        recipe = json.loads((folder / "plan.json").read_text())["recipe"]
        unfamiliar = " --unfamiliar" if recipe["unfamiliar"] else ""
        wanted = int(recipe["homes"])
        made = f"--homes {wanted} --views {recipe['views']} --seed {recipe['seed']}{unfamiliar}"
    except (OSError, ValueError, KeyError, TypeError):
        return folder.name
    missing = f" ({homes} of them)" if homes != wanted else ""
    return f"semslam train pictures {folder.name} {made}{missing}"


def _fingerprint(paths: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(f"{path.name} {file_digest(path)}\n".encode())
    return digest.hexdigest()[:16]
