"""Logs whose tracks and maps are known in advance: keyframes in rooms of boxes, at true poses but for a centimetre.

Of the stages' logs only the names matter: `LOGS` says what each is of.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from semslam.geometry.frames import SE2
from semslam.slam.estimator import Step
from semslam.slam.surfel.merging import Drive
from semslam.slam.surfel.places import Keyframe, placed
from semslam.slam.surfel.prior import Remembered, Seen, place_row
from semslam.stages.catalogue import STAGES
from semslam.stages.contract import StageContext
from semslam.stages.settings import SurfelConfig
from semslam.tables.spec import MOTION, PLACES, POSES
from tests.depth_world import Room, make_drive, make_room, make_views, matrix, observed, symmetric
from tests.slam_world import CELL_M, CLASSES, SIDE

CONFIG = SurfelConfig(surfels=600)
STARTS = {"here": SE2(0.0, 0.0, 0.0), "there": SE2(0.9, -0.6, 2.2), "back": SE2(-0.8, 0.7, -2.0)}
"""Where drives begin in the frame of their room."""
LOGS = {
    "monday": ("box5", "here", 9),
    "tuesday": ("box5", "there", 8),
    "cellar": ("box11", "here", 3),
    "attic": ("box12", "here", 3),
    "dark": ("box5", "here", 3),
    "other": ("box5", "here", 3),
}
"""Room, start and keyframes by the name of the log. In `dark` nothing was seen; `other` is of another detector."""


def room_of(word: str) -> Room:
    """A room by its name."""
    seed = int(word[3:])
    return symmetric(make_room(seed, boxes=7)) if word.startswith("sym") else make_room(seed)


def true_drive(start: str, keyframes: int) -> list[SE2]:
    """In the frame of the room."""
    return [STARTS[start] @ pose for pose in make_drive(keyframes)]


@cache
def make_known(name: str, room: str, start: str, keyframes: int, noise_m: float = 0.01) -> Drive:
    """A log's map, whose keyframes after the first are off by some noise."""
    drive = true_drive(start, keyframes)
    random = np.random.default_rng(sum(map(ord, name)))
    steps = observed(make_views(room_of(room), drive))
    known = []
    for step, pose in zip(steps, drive, strict=True):
        x, y = random.normal(0.0, noise_m, 2) if step.frame else (0.0, 0.0)
        known.append(_known(step, drive[0].between(pose) @ SE2(float(x), float(y), 0.0)))
    return Drive(name, tuple(known))


def _known(step: Step, pose: SE2) -> Remembered:
    assert step.view is not None
    place = placed(Keyframe.of(step.view, CONFIG), matrix(pose), 0.0, None, linked=True)
    return Remembered(step.frame, step.stamp_nanos, place, Seen.of(step.observation))


def localize(ctx: StageContext) -> None:
    """The tables of such a log; its second keyframe has a pose, but no place."""
    drive = make_known(ctx.log, *LOGS[ctx.log])
    meta = {"classes": list(CLASSES[:-1] if ctx.log == "other" else CLASSES), "cell_m": CELL_M, "side": SIDE}
    with ctx.shard(0) as shard:
        for table in STAGES[2].writes:
            if table != PLACES:
                shard.table(table)
        places = shard.table(PLACES, {**meta, "estimator": "surfel"})
        for one in drive.known:
            if one.frame != 1 and ctx.log != "dark":
                places.append(place_row(one.frame, one.stamp_nanos, one.place, one.seen))
            _append_pose(shard.table(POSES), one)


def _append_pose(poses: object, one: Remembered) -> None:
    x, y = one.place.pose[:2, 3].tolist()
    row = {
        "frame": one.frame,
        "stamp_nanos": one.stamp_nanos,
        "x_m": x,
        "y_m": y,
        "heading_rad": float(np.arctan2(one.place.pose[1, 0], one.place.pose[0, 0])),
        "source": "inertial" if one.frame == 1 else "visual",
        "verdict": "uncertain" if one.frame == 1 else "ok",
        "covariance": [],
        "peak": None,
        "entropy_nats": None,
        **{f"mode_{name}": [] for name in ("x_m", "y_m", "heading_rad", "probability")},
    }
    poses.append({name: [value] for name, value in row.items()})  # type: ignore[attr-defined]


def ingest(ctx: StageContext) -> None:
    """Nothing but the first row of motion, whose stamp tells logs apart: equal tables would be one entry."""
    with ctx.shard(0) as shard:
        for table in STAGES[0].writes:
            shard.table(table)
        row = {"frame": 0, "stamp_nanos": int.from_bytes(ctx.log.encode()[:6], "big"), "source": "start"}
        row |= dict.fromkeys(("dx_m", "dy_m", "dheading_rad"))
        shard.table(MOTION).append({name: [value] for name, value in row.items()})


def extract(ctx: StageContext) -> None:
    """Nothing."""
    with ctx.shard(0) as shard:
        for table in STAGES[1].writes:
            shard.table(table)


SURFEL_STAGES = (*(replace(stage, entry=f"tests.fake_surfel:{stage.name}") for stage in STAGES[:3]), STAGES[3])
