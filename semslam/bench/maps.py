"""Maps at true poses: what the paper's table 4 compares, one method and one quality of observations at a time.

A step places the observation at the bin of the true pose (equations 5 and 6) inside the region of interest (7) and lets
the map take it up (8 or 10). After every step the map is compared with the class map of what has been *visible so far*.

Three sets of cells are told apart, because no method knows a cell that no region of interest has reached:

    reached   inside the region of interest of some step so far: the main one
    visible   reached, and visible so far
    all       the whole map, where cells out of reach cost every method the same

Before each update the observation is looked for in the map as it stands (equation 2): how well a pose is found again
when all poses before it were right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2, wrap_angle
from semslam.geometry.grid import Planes
from semslam.labels import FIRST_OBJECT
from semslam.map_metrics import Ids, Mask, class_overlaps, labels_of, map_mse, score_map
from semslam.models.training.drives import Drive, DriveSet, RunTables
from semslam.slam.paper import (
    PoseGrid,
    Window,
    best_bin,
    correlate,
    place_observation,
    pose_field,
    roi_mask,
    rotate_observation,
)
from semslam.slam.paper_estimator import open_map
from semslam.stages.settings import PaperConfig

CELL_SETS = ("reached", "visible", "all")
TASK = "semslam.bench.maps:build"
VERSION = 3
"""Raise it whenever the same part would come out differently."""


@dataclass(frozen=True)
class Laid:
    """One step: what is placed where, and what would be right."""

    rotated: Planes
    """(R, L, h, h)"""
    placed: Planes
    """(L, rows, columns)"""
    window: Window
    truth: Ids
    """(H, W) visible so far."""
    reached: Mask
    """(H, W) inside a region of interest so far."""


def build(arguments: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Build the maps of some logs and score them; plain values, with pictures of the first log's map.

    Args:
        arguments: dataset, logs, quality, run ({log: [motion files, observation files]}), paper (its settings), steps.
        folder: not used; nothing but the result is kept.

    Raises:
        SemslamError: a table or the network is missing or does not fit.
    """
    del folder
    paper = PaperConfig(**arguments["paper"])
    run = {log: RunTables(*(tuple(map(Path, files)) for files in both)) for log, both in arguments["run"].items()}
    drives = DriveSet.open(Path(arguments["dataset"]), arguments["logs"], arguments["quality"], run=run, paper=paper)
    result: dict[str, Any] = {"classes": list(drives.classes), "cell_m": paper.cell_m, "logs": {}, "panels": []}
    for number, drive in enumerate(drives.drives):
        wanted = _panel_steps(min(len(drive), arguments["steps"])) if number == 0 else ()
        result["logs"][drive.name], panels = _one(drive, drives.classes, paper, arguments["steps"], wanted)
        result["panels"] += panels
    return result


def _one(
    drive: Drive, classes: tuple[str, ...], paper: PaperConfig, steps: int, wanted: Sequence[int]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Scores of every step and of the last map of one drive, cells of its classes in both maps, and its panels."""
    world = open_map(paper, classes, Path(paper.model) if paper.update == "learned" else None)
    curves: dict[str, list[float | None]] = {name: [] for name in CELL_SETS}
    found: list[tuple[float, float] | None] = []
    panels = []
    laid = None
    for step, laid in enumerate(steps_of(drive, paper, steps)):
        if step:
            found.append(_found_again(laid.rotated, world.planes, drive, step, paper))
        before = labels_of(world.planes) if step in wanted else None
        world.update(laid.placed, laid.window)
        for name, cells in _cell_sets(laid).items():
            curves[name].append(_number(map_mse(world.planes, laid.truth, cells)))
        if before is not None:
            panels.append(_panel(step, before, laid, labels_of(world.planes), drive, paper.noise_floor))
    if laid is None:
        raise SemslamError(f"`{drive.name}` has no keyframe", hint="`semslam status OUT` shows what was read of it")
    scores = {name: asdict(score_map(world.planes, laid.truth, cells)) for name, cells in _cell_sets(laid).items()}
    last = {name: {key: _number(value) for key, value in values.items()} for name, values in scores.items()}
    overlaps = class_overlaps(labels_of(world.planes), laid.truth, len(classes), laid.reached)
    pooled = {"intersection": overlaps.intersection.tolist(), "union": overlaps.union.tolist()}
    return {"mse": curves, "last": last, "overlaps": pooled, "found": found}, panels


def _found_again(
    rotated: Planes, world: Planes, drive: Drive, step: int, paper: PaperConfig
) -> tuple[float, float] | None:
    """Metres and degrees between the visual pose (equation 2) and the true one; None if nothing fits anywhere.

    Of poses that fit equally well the one nearest to the true pose of the step before counts.
    """
    scores = correlate(rotated, world)
    if scores.max() <= 0.0:
        return None
    grid = PoseGrid(paper.headings, paper.map_side, paper.cell_m)
    before, true = (SE2(*drive.poses[at].tolist()) for at in (step - 1, step))
    pose = grid.pose_of(best_bin(scores, before, grid))
    turned = math.degrees(abs(wrap_angle(pose.heading_rad - true.heading_rad)))
    return math.hypot(pose.x_m - true.x_m, pose.y_m - true.y_m), turned


def steps_of(drive: Drive, paper: PaperConfig, steps: int) -> Iterator[Laid]:
    """What each step of a drive lays on the map at its true pose."""
    grid = PoseGrid(paper.headings, paper.map_side, paper.cell_m)
    reached = np.zeros(drive.labels.shape, np.bool_)
    if drive.labels.shape != (paper.map_side, paper.map_side):
        raise SemslamError(
            f"The true map of `{drive.name}` has {drive.labels.shape[0]} cells a side, not {paper.map_side}",
            hint=f"set `localize.paper.map_side` to {drive.labels.shape[0]}",
        )
    for step, planes in enumerate(drive.observations[:steps]):
        pose = SE2(*drive.poses[step].tolist())
        window = roi_mask(pose, grid, paper.side)
        rotated = rotate_observation(planes, paper.headings)
        placed = place_observation(rotated, pose_field(pose, grid), window)
        reached[window] = True
        yield Laid(rotated, placed, window, drive.visible(step), reached.copy())


def _cell_sets(laid: Laid) -> dict[str, Mask]:
    visible = laid.truth != 0
    return {"reached": laid.reached, "visible": laid.reached & visible, "all": np.ones_like(laid.reached)}


def _panel_steps(steps: int) -> tuple[int, ...]:
    """Early, in the middle, and the last."""
    return tuple(dict.fromkeys((min(4, steps - 1), steps // 2, steps - 1)))


def _panel(step: int, before: Ids, laid: Laid, after: Ids, drive: Drive, beta: float) -> dict[str, Any]:
    """Label maps of one step for a picture, plain values."""
    observed = np.zeros_like(before)
    observed[laid.window] = _shown(laid.placed, beta)
    pictures = {"previous": before, "observation": observed, "updated": after, "truth": laid.truth}
    x, y, heading = drive.poses[step].tolist()
    return {
        "log": drive.name,
        "step": step,
        "pose": [x, y, heading],
        "window": [[part.start, part.stop] for part in laid.window],
        **{name: ids.tolist() for name, ids in pictures.items()},
    }


def _shown(placed: Planes, beta: float) -> Ids:
    """(rows, columns) of the strongest object where there is any: its weights are shares and would lose to floor."""
    objects = placed[FIRST_OBJECT:]
    return np.where(objects.max(0) >= beta, objects.argmax(0) + FIRST_OBJECT, labels_of(placed))


def _number(value: float) -> float | None:
    """NaN is no JSON."""
    return None if np.isnan(value) else float(value)


def curve(result: Mapping[str, Any], logs: Sequence[str], cells: str) -> NDArray[np.float64]:
    """(logs, steps) mean squared errors; shorter logs end in NaN."""
    curves = [result["logs"][log]["mse"][cells] for log in logs]
    whole = np.full((len(curves), max(map(len, curves))), np.nan)
    for row, values in zip(whole, curves, strict=True):
        row[: len(values)] = [np.nan if value is None else value for value in values]
    return whole


def found_again(result: Mapping[str, Any], log: str) -> NDArray[np.float64]:
    """(steps, 2) metres and degrees at every step of a log after its first; NaN where nothing fitted."""
    rows = [(math.nan, math.nan) if one is None else one for one in result["logs"][log]["found"]]
    return np.array(rows, np.float64).reshape(-1, 2)


def paper_settings(paper: PaperConfig, **changes: Any) -> dict[str, Any]:
    """The paper's settings as plain values, some changed."""
    return asdict(replace(paper, **changes))
