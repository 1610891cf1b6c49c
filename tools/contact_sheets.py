"""Contact sheets of simulated homes: the plan with the drive, and what the camera sees along it.

    python tools/contact_sheets.py docs/sim home_00 rooms_00 home_00_d1

A name is that of a home in the data set that `semslam simulate --seed SEED` makes; the pictures are those of its first
trajectory. Needs `pip install '.[sim]'`.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import planar
from semslam.sim.dataset import Recipe, Recording
from semslam.sim.engine import require_engine, start_engine
from semslam.sim.home import Home

if TYPE_CHECKING:
    from semslam.sim.vehicle import Drive

Image: TypeAlias = NDArray[np.uint8]
"""(H, W, 3) RGB."""

DEFAULT = (
    *("home_00", "home_01", "home_02", "home_03"),
    *("plain_00", "repeating_00", "symmetric_00", "rooms_00", "person_00", "home_00_d1"),
)
COLUMNS, ROWS = 4, 4
TILE = (400, 300)
"""Width and height of a frame on the sheet; the plan takes two by two."""
FRAMES = COLUMNS * ROWS - 4
HEAD_PX, CAPTION_PX, GAP_PX = 34, 20, 4
MOST_BYTES = 230_000
PAPER, INK, ROUTE = (255, 255, 255), (40, 40, 44), (214, 60, 40)
_NAME = re.compile(r"(?P<kind>[a-z]+)_(?P<scene>\d+)(_d(?P<day>[01]))?\Z")


@dataclass(frozen=True)
class View:
    """One picture of the drive."""

    rgb: Image
    time_s: float
    place: tuple[float, float]
    heading_rad: float
    objects: int


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the sheets that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the pictures go, as NAME.jpg")
    parser.add_argument("names", nargs="*", help=f"homes; by default {', '.join(DEFAULT)}")
    parser.add_argument("--seed", type=int, default=1, help="of the data set")
    given = parser.parse_args(arguments)
    try:
        require_engine()
        recordings = {name: recording_of(name, given.seed) for name in given.names or DEFAULT}
        given.folder.mkdir(parents=True, exist_ok=True)
        start_engine()
        for name, recording in recordings.items():
            path = given.folder / f"{name}.jpg"
            path.write_bytes(encoded(sheet(name, recording)))
            print(f"{path}  {path.stat().st_size:,} bytes", flush=True)
    except SemslamError as error:
        parser.exit(error.exit_code, f"error: {error.text()}\n")


def recording_of(name: str, seed: int) -> Recording:
    """The first log of a home.

    Raises:
        SemslamError: the name is not one of a home.
    """
    match = _NAME.match(name)
    if match is None:
        raise SemslamError(
            f"`{name}` is no name of a home", hint="names are like `home_03`, `rooms_00` or `home_03_d1`"
        )
    variant = "standard" if match["kind"] == "home" else match["kind"]
    scene, day = int(match["scene"]), int(match["day"] or 0)
    recipe = Recipe(scenes=scene + 1, trajectories=1, seed=seed, variants=(variant,), days=day + 1)
    return next(one for one in recipe.recordings() if (one.scene, one.day) == (scene, day))


def sheet(name: str, recording: Recording) -> Image:
    """Head, plan with the drive, and frames evenly spread over it."""
    from semslam.sim.eye import Eye
    from semslam.sim.layout import free_raster, make_home
    from semslam.sim.log import LogOptions, visible_count
    from semslam.sim.sensors import draw_colour_camera, measure_rgb
    from semslam.sim.vehicle import draw_robot, drive

    home, robot = make_home(recording.home_seed, recording.variant, recording.day), draw_robot(recording.home_seed)
    free, origin = free_raster(home)
    motion = drive(home, (free, np.asarray(origin)), robot, recording.drive_seed, steps=recording.steps)
    eye = Eye(home, LogOptions().camera)
    rng = np.random.default_rng([recording.drive_seed, 0x5EE7])
    lens, views = draw_colour_camera(rng), []
    for time_s in chosen(home, motion):
        world_from_base = motion.world_from_base(time_s)
        sight, pose = eye.look(world_from_base @ robot.base_from_camera, time_s), planar(world_from_base)
        rgb = measure_rgb(sight.rgb, rng, lens)
        views.append(View(rgb, time_s, (pose.x_m, pose.y_m), pose.heading_rad, visible_count(sight, home)))
    classes = len({item.class_name for item in home.objects})
    head = (
        f"{name}   {recording.variant}{f', day {recording.day + 1}' if recording.day else ''}   "
        f"{len(home.objects)} objects of {classes} classes   camera {robot.camera_height_m:.2f} m high   "
        f"{recording.steps} frames in {motion.keyframes_s[-1]:.0f} s"
    )
    return composed(head, plan_of(home, motion.positions[:, :2], views), views)


def chosen(home: Home, motion: Drive) -> list[float]:
    """Times spread evenly over the drive, moved a little to where somebody who walks about is ahead."""
    times = motion.keyframes_s.tolist()
    slots = np.array_split(np.arange(len(times)), FRAMES)
    return [next((times[k] for k in slot if _ahead(home, motion, times[k])), times[slot[0]]) for slot in slots]


def _ahead(home: Home, motion: Drive, time_s: float) -> bool:
    if home.walker is None:
        return False
    pose = planar(motion.world_from_base(time_s))
    x, y, _ = home.walker.pose(time_s)
    ahead, left = pose.inverse().apply(np.array([[x, y]]))[0]
    return bool(1.0 < ahead < 6.0 and abs(left) < 0.8 * ahead)


def plan_of(home: Home, route: NDArray[np.float64], views: Sequence[View]) -> Image:
    """The plan as large as two by two tiles allow, with the drive and the numbered views."""
    from semslam.sim.plan import draw_plan

    wide, high = 2 * TILE[0] + GAP_PX, 2 * (TILE[1] + CAPTION_PX) + GAP_PX
    x0, _, x1, y1 = home.bounds
    first = draw_plan(home, 60.0)
    scale = 60.0 * min(wide / first.shape[1], high / first.shape[0])
    image = draw_plan(home, scale)[:high, :wide].copy()
    margin = (image.shape[1] / scale - (x1 - x0)) / 2

    def pixel(x: float, y: float) -> tuple[int, int]:
        return round((x - x0 + margin) * scale * 16), round((y1 + margin - y) * scale * 16)

    line = np.array([pixel(x, y) for x, y in route[::20].tolist()], np.int32)
    cv2.polylines(image, [line], False, ROUTE, 1, cv2.LINE_AA, 4)
    for number, view in enumerate(views, 1):
        _draw_view(image, number, view, pixel)
    canvas = np.full((high, wide, 3), PAPER, np.uint8)
    top, left = (high - image.shape[0]) // 2, (wide - image.shape[1]) // 2
    canvas[top : top + image.shape[0], left : left + image.shape[1]] = image
    return canvas


def _draw_view(image: Image, number: int, view: View, pixel: Callable[[float, float], tuple[int, int]]) -> None:
    """A dot with a number, and the field of view as two short lines."""
    x, y = view.place
    centre = pixel(x, y)
    for side in (-math.pi / 4, math.pi / 4):
        angle = view.heading_rad + side
        end = pixel(x + 0.5 * math.cos(angle), y + 0.5 * math.sin(angle))
        cv2.line(image, centre, end, ROUTE, 1, cv2.LINE_AA, 4)
    cv2.circle(image, centre, 9 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    cv2.circle(image, centre, 9 * 16, ROUTE, 1, cv2.LINE_AA, 4)
    text = str(number)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.38, 1)
    at = (centre[0] // 16 - width // 2, centre[1] // 16 + height // 2)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.38, INK, 1, cv2.LINE_AA)


def composed(head: str, plan: Image, views: Sequence[View]) -> Image:
    """All of it on one sheet: the plan at the upper left, frames around it in reading order."""
    step_x, step_y = TILE[0] + GAP_PX, TILE[1] + CAPTION_PX + GAP_PX
    canvas = np.full((HEAD_PX + ROWS * step_y, COLUMNS * step_x - GAP_PX, 3), PAPER, np.uint8)
    _write(canvas, head, (8, 23), 0.62)
    canvas[HEAD_PX : HEAD_PX + plan.shape[0], : plan.shape[1]] = plan
    free = [(row, column) for row in range(ROWS) for column in range(COLUMNS) if row > 1 or column > 1]
    for number, ((row, column), view) in enumerate(zip(free, views, strict=True), 1):
        left, top = column * step_x, HEAD_PX + row * step_y
        canvas[top : top + TILE[1], left : left + TILE[0]] = cv2.resize(view.rgb, TILE, interpolation=cv2.INTER_AREA)
        caption = f"{number}   {view.time_s:.0f} s   {view.objects} objects in view"
        _write(canvas, caption, (left + 4, top + TILE[1] + 15), 0.42)
    return canvas


def _write(image: Image, text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)


def encoded(image: Image) -> bytes:
    """A JPEG file, as good as `MOST_BYTES` allow."""
    for quality in range(90, 30, -3):
        _, data = cv2.imencode(
            ".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        )
        if data.size <= MOST_BYTES:
            break
    return bytes(data.tobytes())


if __name__ == "__main__":
    main()
