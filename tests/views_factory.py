"""Views of a world of coloured boxes, for tests of what learns from views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semslam.models.training.pictures import Picture, SeenObject
from semslam.tables.parquet import write_table
from semslam.tables.pictures import encode_colour, encode_depth
from semslam.tables.spec import VIEWS

NAMES = ("cup", "shelf")
_COLOURS = ((220, 40, 40), (40, 60, 220))
_FAR_M = 4.0


def box_picture(seed: int, width: int = 160, height: int = 128, objects: int = 3) -> Picture:
    """Rectangles before a grey wall; red ones are cups and blue ones shelves, later ones are nearer."""
    rng = np.random.default_rng([seed, 0xB0])
    rgb = np.full((height, width, 3), 110, np.uint8)
    depth = np.full((height, width), _FAR_M, np.float32)
    instances = np.zeros((height, width), np.uint16)
    kinds = []
    for number in range(1, objects + 1):
        wide, high = (int(rng.integers(side // 5, side // 2)) for side in (width, height))
        left, top = int(rng.integers(width - wide)), int(rng.integers(height - high))
        kinds.append(int(rng.integers(2)))
        window = np.s_[top : top + high, left : left + wide]
        rgb[window], depth[window], instances[window] = _COLOURS[kinds[-1]], _FAR_M - 0.5 * number, number
    seen = [_seen(instances, number, kind) for number, kind in enumerate(kinds, 1)]
    return Picture(rgb, depth, instances, tuple(item for item in seen if item))


def _seen(instances: np.ndarray[Any, Any], number: int, kind: int) -> SeenObject | None:
    mask = (instances == number).astype(np.uint8)
    if not mask.any():
        return None
    left, top, width, height = cv2.boundingRect(mask)
    return SeenObject(number, kind, left, top, left + width, top + height, int(mask.sum()), 1.0, False)


def write_views(folder: Path, homes: int = 1, views: int = 4, first: int = 0, **size: int) -> Path:
    """A folder of such views as `semslam train pictures` would leave it."""
    folder.mkdir(parents=True, exist_ok=True)
    for home in range(first, first + homes):
        rows = [_row(index, box_picture(100 * home + index, **size)) for index in range(views)]
        columns = {column.name: [row[column.name] for row in rows] for column in VIEWS.columns}
        meta = {"classes": list(NAMES), "variant": "boxes", "seed": home, "unfamiliar": False}
        write_table(folder / f"home_{home:010}.parquet", VIEWS, columns, meta)
    return folder


def _row(index: int, picture: Picture) -> dict[str, Any]:
    done, instances = cv2.imencode(".png", picture.instances)
    assert done
    lens = {"fx": 100.0, "fy": 100.0, "cx": 79.5, "cy": 63.5, "camera_height_m": 0.5, "camera_pitch_rad": 0.1}
    return {
        "view": index,
        "colour": encode_colour(picture.rgb),
        "depth": encode_depth(picture.depth_m),
        "instances": instances.tobytes(),
        **lens,
        "instance": [item.instance for item in picture.objects],
        "class_id": [item.class_id for item in picture.objects],
        "boxes_px": [side for item in picture.objects for side in (item.left, item.top, item.right, item.bottom)],
        "pixels": [item.pixels for item in picture.objects],
        "share": [item.share for item in picture.objects],
        "cut": [int(item.cut) for item in picture.objects],
    }
