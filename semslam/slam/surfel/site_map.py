"""What a site looks like, once its keyframes are aligned: its cells, its keyframes as a map for other logs, and the
tracks of its logs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, planar, wrap_angles
from semslam.slam.estimator import VISUAL, PoseEstimate
from semslam.slam.evidence import Evidence
from semslam.slam.surfel.merging import Site
from semslam.slam.surfel.places import moved
from semslam.slam.surfel.prior import Grid, Remembered
from semslam.slam.verdict import verdict_of

MOST_KEYFRAMES = 400
"""Keyframes that a site's map for other logs holds, about: some 20 MB."""
_ALIKE_RAD = 0.35
_ALIKE_M = (0.1, 0.2, 0.4, 0.8)
"""Keyframes nearer to each other than this, and looking the same way, show the same; wider where there are too many."""
_ENOUGH = 2
"""Of keyframes that show the same so many stay: a log is compared with two."""


@dataclass(frozen=True)
class Pose:
    """A row of a log's track."""

    frame: int
    stamp_nanos: int
    pose: SE2
    verdict: str


def remembered(site: Site) -> list[Remembered]:
    """All keyframes where they lie in the site, log by log."""
    return [
        replace(one, place=moved(one.place, pose))
        for drive, poses in zip(site.drives, site.poses, strict=True)
        for one, pose in zip(drive.known, poses, strict=True)
    ]


def cells(known: Sequence[Remembered], grid: Grid) -> dict[str, Any]:
    """Columns of the cells table, of all observations in the order of time."""
    evidence = Evidence(grid.cell_m, grid.side)
    for one in sorted(known, key=lambda one: one.stamp_nanos):
        planes = grid.dense(one.seen)
        if planes is not None:
            evidence.add(planes, planar(one.place.pose), one.stamp_nanos)
    found = evidence.cells()
    centres = {f"{axis}_m": (found[f"i{axis}"] + 0.5) * grid.cell_m for axis in "xy"}
    labels = [grid.classes[class_id] for class_id in found["class_id"]]
    return {**found, **centres, "label": labels}


def thinned(known: Sequence[Remembered], most: int = MOST_KEYFRAMES) -> list[Remembered]:
    """All keyframes; of too many, without those that show what others do."""
    kept = list(known)
    for alike_m in _ALIKE_M:
        if len(kept) <= most:
            break
        kept = [kept[index] for index in _distinct([planar(one.place.pose) for one in kept], alike_m)]
    return kept


def _distinct(poses: Sequence[SE2], alike_m: float) -> list[int]:
    """Numbers of poses, without those that have enough like them before them."""
    places = _columns(poses)
    kept: list[int] = []
    for index in range(len(poses)):
        away = places[kept] - places[index]
        near = (np.hypot(away[:, 0], away[:, 1]) < alike_m) & (np.abs(wrap_angles(away[:, 2])) < _ALIKE_RAD)
        if np.count_nonzero(near) < _ENOUGH:
            kept.append(index)
    return kept


def _columns(poses: Sequence[SE2]) -> NDArray[np.float64]:
    """(N, 3): x, y and heading."""
    return np.array([[one.x_m, one.y_m, one.heading_rad] for one in poses])


def track_in(site: Site, number: int, own: Sequence[Pose], ok_m: float, ok_rad: float) -> Iterator[Pose]:
    """A log's track, told in its own map's frame, in that of the site.

    Keyframes that are not in the map, since pictures do not place them or show nothing new, go with the one there whose
    pose is nearest, and keep their verdict.
    """
    known, poses, errors = site.drives[number].known, site.poses[number], site.covariances[number]
    places = _columns([planar(one.place.pose) for one in known])
    numbers = {one.frame: index for index, one in enumerate(known)}
    for row in own:
        index = numbers.get(row.frame)
        nearest = _nearest(places, row.pose) if index is None else index
        shift = planar(poses[nearest]) @ planar(known[nearest].place.pose).inverse()
        verdict = row.verdict
        if index is not None and errors:
            error = tuple(errors[index].ravel().tolist())
            verdict = verdict_of(PoseEstimate(row.pose, VISUAL, covariance=error), ok_m, ok_rad)
        yield replace(row, pose=shift @ row.pose, verdict=verdict)


def _nearest(places: NDArray[np.float64], pose: SE2) -> int:
    """Number of the pose (N, 3: x, y, heading) that is nearest, a radian counting as a metre; the first of several."""
    away_m = np.hypot(places[:, 0] - pose.x_m, places[:, 1] - pose.y_m)
    return int(np.argmin(away_m + np.abs(wrap_angles(places[:, 2] - pose.heading_rad))))
