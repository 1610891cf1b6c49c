"""Views of simulated homes for training: many cameras in many homes, no drive, no log.

Writes  views        data_spec.md, table 15: one file a home, `home_<seed>.parquet`

A camera stands somewhere on free floor, of random height, pitch, heading and field of view. Pictures have the noise of
the logs' cameras. A finished file is kept, so that a killed run goes on where it was; the bytes depend on seed, version
and options alone.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semslam.errors import SemslamError
from semslam.processes import usable_cpus
from semslam.sim.dataset import versions
from semslam.sim.engine import kernel_cache
from semslam.sim.pool import Died, Pool

if TYPE_CHECKING:
    import numpy as np

    from semslam.geometry.camera import Camera
    from semslam.sim.boxes import TrueBox
    from semslam.sim.home import Array, Home

WIDTH, HEIGHT = 640, 480
_HOMES_A_SEED = 1000
_PLAN = "plan.json"
_FLAT_PIXELS = 40
_LEAST_IN_VIEW = 2
_TRIES = 4
_CANDIDATES, _CHOSEN = 5, 0.75
"""Of so many cameras the one that promises most objects is taken, this often; else the first."""
_PROMISING_M = (0.8, 7.0)
_HEIGHT_M, _PITCH_DEG, _FIELD_DEG = (0.3, 0.75), (0.0, 20.0), (70.0, 95.0)
"""Of a camera: height, how far its nose is down, field of view across."""
_CLEARANCE_M, _RASTER_M = 0.3, 0.05
_VARIANTS = {"standard": 0.6, "rooms": 0.15, "plain": 0.1, "repeating": 0.05, "symmetric": 0.05, "person": 0.05}
"""Kinds of homes, and how often each is drawn."""


@dataclass(frozen=True)
class ViewRecipe:
    """What a set of views consists of."""

    homes: int = 200
    views: int = 20
    """Of every home."""
    seed: int = 1000
    """Homes are those of `semslam simulate --seed`: another seed, other homes."""
    unfamiliar: bool = False
    """Lights, palettes and cameras of the kind that training never uses."""

    def __post_init__(self) -> None:
        for name, most in (("homes", _HOMES_A_SEED), ("views", 1000), ("seed", 2**31 - 1)):
            value = getattr(self, name)
            least = 0 if name == "seed" else 1
            if not least <= value <= most:
                raise SemslamError(f"`--{name}` is {value}", hint=f"give a number from {least} to {most}")

    def home_seeds(self) -> list[int]:
        """Seeds of the homes, in order."""
        return [self.seed * _HOMES_A_SEED + index for index in range(self.homes)]


@dataclass
class ViewReport:
    """What a command made."""

    out: Path
    cached: int = 0
    done: int = 0
    failures: dict[int, str] = field(default_factory=dict)
    """Why a home gave no views, by its seed."""


def make_views(
    out: Path,
    recipe: ViewRecipe,
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ViewReport:
    """Make a set of views, or what is missing of it.

    Args:
        out: folder; made if it is not there.
        workers: processes; None means one a processor, 0 none but this.
        progress: told homes finished, and of how many.

    Raises:
        SemslamError: the folder holds views made otherwise.
    """
    out.mkdir(parents=True, exist_ok=True)
    _agree(out, recipe)
    waiting = [seed for seed in recipe.home_seeds() if not file_of(out, seed).is_file()]
    report = ViewReport(out, cached=recipe.homes - len(waiting))
    tasks = [_Task(file_of(out, seed), seed, recipe.views, recipe.unfamiliar) for seed in waiting]
    size = min(usable_cpus() if workers is None else workers, len(tasks))
    told = progress or _untold
    told(report.cached, recipe.homes)
    with kernel_cache() as environment, Pool(size, _make_home, environment=environment) as pool:
        for number, ended in pool.run(tasks, _untold):
            reason = ended.how if isinstance(ended, Died) else ended
            if reason:
                report.failures[waiting[number]] = reason
            report.done += not reason
            told(report.cached + report.done + len(report.failures), recipe.homes)
    return report


def _untold(_number: int, _of: int) -> None:
    """Progress that nobody wants to hear."""


def file_of(folder: Path, home_seed: int) -> Path:
    """Where the views of a home lie."""
    return folder / f"home_{home_seed:010}.parquet"


def _agree(out: Path, recipe: ViewRecipe) -> None:
    """Write the plan, or see that the one that is there is the same but for the number of homes."""
    plan: dict[str, Any] = {"format": "semslam views", "recipe": asdict(recipe), "versions": versions()}
    path = out / _PLAN
    if path.is_file():
        stored = _stored(path)
        was, now = ({**p["recipe"], "homes": 0} | p["versions"] for p in (stored, plan))
        differing = sorted(name for name in {*was, *now} if was.get(name) != now.get(name))
        if differing:
            changes = ", ".join(f"{name} {was.get(name)} -> {now.get(name)}" for name in differing)
            raise SemslamError(f"`{out}` holds views made otherwise: {changes}", hint="give another folder")
    elif any(out.iterdir()):
        raise SemslamError(f"`{out}` is not empty and holds no views", hint="give another folder")
    temporary = out / f".{_PLAN}.partial-{os.getpid()}"
    temporary.write_text(json.dumps(plan, indent=1, sort_keys=True) + "\n")
    temporary.replace(path)


def _stored(path: Path) -> dict[str, Any]:
    """The plan of a folder.

    Raises:
        SemslamError: it is damaged, or not of views.
    """
    try:
        plan = json.loads(path.read_text())
        if isinstance(plan, dict) and isinstance(plan["recipe"], dict) and isinstance(plan["versions"], dict):
            return plan
    except (OSError, ValueError, KeyError):
        pass
    raise SemslamError(f"`{path}` is not the plan of a set of views", hint="give another folder")


@dataclass(frozen=True)
class _Task:
    """What a worker gets."""

    path: Path
    home_seed: int
    views: int
    unfamiliar: bool


def _make_home(task: _Task, _report: Callable[[int], None]) -> str:
    """Write the views of one home; why it could not be done, or nothing."""
    try:
        record_views(task.path, task.home_seed, task.views, unfamiliar=task.unfamiliar)
    except Exception as error:  # whatever a library throws belongs to this home alone
        return f"{type(error).__name__}: {error}"
    return ""


def record_views(path: Path, home_seed: int, views: int, *, unfamiliar: bool = False) -> None:
    """Draw a home from `views` cameras and write the file, whole or not at all.

    Raises:
        SemslamError: the home cannot be drawn, or shows too little from everywhere.
        OSError: the disk is full, or the folder cannot be written.
    """
    from semslam.sim.engine import start_engine

    start_engine()
    import cv2
    import numpy as np

    from semslam.sim.layout import make_home

    cv2.setNumThreads(1)
    rng = np.random.default_rng([home_seed, 0x71E3])
    variant = str(rng.choice(list(_VARIANTS), p=list(_VARIANTS.values())))
    home = make_home(home_seed, variant)
    if unfamiliar:
        from semslam.sim.unfamiliar import estranged

        home = estranged(home, home_seed)
    rows = _looks(home, views, rng, unfamiliar=unfamiliar)
    meta = {"classes": list(home.classes), "variant": variant, "seed": home_seed, "unfamiliar": unfamiliar}
    write_views(path, rows, meta)


def write_views(path: Path, rows: Sequence[Mapping[str, Any]], meta: Mapping[str, Any]) -> None:
    """Write a file of table 15, whole or not at all.

    Raises:
        OSError: the disk is full, or the folder cannot be written.
    """
    from semslam.tables.parquet import write_table
    from semslam.tables.spec import VIEWS

    columns = {column.name: [row[column.name] for row in rows] for column in VIEWS.columns}
    temporary = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        write_table(temporary, VIEWS, columns, meta)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _looks(home: Home, views: int, rng: np.random.Generator, *, unfamiliar: bool) -> list[dict[str, Any]]:
    """Rows of the table. A look at a wall teaches little and is drawn again, a few times."""
    from semslam.sim.boxes import true_boxes
    from semslam.sim.eye import Eye

    camera, spots = _lens(rng, unfamiliar=unfamiliar), _spots(home)
    eye, rows = Eye(home, camera), list[dict[str, Any]]()
    for _ in range(_TRIES * views):
        if len(rows) == views:
            return rows
        height_m, pitch_rad = _stand(rng, unfamiliar=unfamiliar)
        poses = [_pose(rng, spots, height_m, pitch_rad) for _ in range(_CANDIDATES)]
        pose = max(poses, key=lambda one: _promise(home, camera, one)) if rng.random() < _CHOSEN else poses[0]
        sight = eye.look(pose, float(rng.uniform(0, 60)))
        seen = [box for box in true_boxes(home, sight, camera, pose) if box.pixels >= _FLAT_PIXELS]
        if len(seen) >= _LEAST_IN_VIEW:
            place = {"view": len(rows), "camera_height_m": height_m, "camera_pitch_rad": pitch_rad}
            rows.append({**place, **lens_row(camera), **_pictures(sight, rng), **object_columns(seen)})
    if len(rows) < views:
        raise SemslamError(f"Home {home.seed} shows hardly anything", hint="use another `--seed`")
    return rows


def _lens(rng: np.random.Generator, *, unfamiliar: bool) -> Camera:
    """A pinhole of 70 to 95 degrees across; a narrower one if unfamiliar."""
    from semslam.geometry.camera import Camera
    from semslam.sim import unfamiliar as strange

    low, high = strange.FIELD_DEG if unfamiliar else _FIELD_DEG
    focal = WIDTH / 2 / math.tan(math.radians(rng.uniform(low, high)) / 2)
    return Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def _stand(rng: np.random.Generator, *, unfamiliar: bool) -> tuple[float, float]:
    """Height of the camera, metres, and how far its nose is down, radians."""
    from semslam.sim import unfamiliar as strange

    height, pitch = (strange.HEIGHT_M, strange.PITCH_DEG) if unfamiliar else (_HEIGHT_M, _PITCH_DEG)
    return float(rng.uniform(*height)), math.radians(rng.uniform(*pitch))


def _spots(home: Home) -> Array:
    """(N, 2) free places, 0.3 m from everything."""
    import cv2
    import numpy as np

    from semslam.sim.layout import free_raster

    free, origin = free_raster(home)
    far = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5) * _RASTER_M > _CLEARANCE_M
    return np.asarray(np.argwhere(far)[:, ::-1] * _RASTER_M + np.asarray(origin) + _RASTER_M / 2, np.float64)


def _pose(rng: np.random.Generator, spots: Array, height_m: float, pitch_rad: float) -> Array:
    """world_from_camera (4, 4) of the optical frame."""
    import numpy as np

    heading = rng.uniform(-np.pi, np.pi)
    ahead = np.array([np.cos(heading) * np.cos(pitch_rad), np.sin(heading) * np.cos(pitch_rad), -np.sin(pitch_rad)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = (*spots[int(rng.integers(len(spots)))], height_m)
    return pose


def _promise(home: Home, camera: Camera, world_from_camera: Array) -> int:
    """Objects whose middle lies in the cone of view, near enough; walls and each other may hide them."""
    import numpy as np

    places = np.array([(item.x_m, item.y_m) for item in home.objects]) - world_from_camera[:2, 3]
    across, ahead = places @ world_from_camera[:2, 0], places @ world_from_camera[:2, 2]
    near, far = _PROMISING_M
    return int(((np.abs(across) < ahead * camera.cx / camera.fx) & (ahead > near) & (ahead < far)).sum())


def lens_row(camera: Camera) -> dict[str, float]:
    """Columns of a view that tell its lens."""
    return {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}


def _pictures(sight: Any, rng: np.random.Generator) -> dict[str, bytes]:
    """Colour, depth and instances as files, measured by cameras drawn anew."""
    from semslam.logs.writer import encode_jpeg, encode_png
    from semslam.sim.sensors import draw_colour_camera, measure_depth, measure_rgb

    rgb = measure_rgb(sight.rgb, rng, draw_colour_camera(rng))
    depth_mm = measure_depth(sight, rng)
    return {"colour": encode_jpeg(rgb, 92), "depth": encode_png(depth_mm), "instances": encode_png(sight.instances)}


def object_columns(seen: Sequence[TrueBox]) -> dict[str, list[Any]]:
    """Columns of a view that tell what is to be seen of its objects."""
    return {
        "instance": [box.instance for box in seen],
        "class_id": [box.class_id for box in seen],
        "boxes_px": [float(side) for box in seen for side in (box.left, box.top, box.right, box.bottom)],
        "pixels": [box.pixels for box in seen],
        "share": [box.share for box in seen],
        "cut": [int(box.cut) for box in seen],
    }
