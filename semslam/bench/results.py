"""All that a bench found, and how to ask it: by row and protocol, by method and quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.bench.maps import curve, found_again
from semslam.bench.tracks import TrackScore
from semslam.map_metrics import Overlaps

_FLOATS = NDArray[np.float64]


@dataclass(frozen=True)
class Conditions:
    """Under what all figures were made; printed above them."""

    dataset: str
    scenes: int
    logs: int
    noise: str
    """Of IMU and wheels, as the data set says."""
    steps: int
    """Keyframes scored of each log."""
    seeds: int
    test_logs: Mapping[str, int]
    """By protocol."""
    paper: Mapping[str, Any]
    """Section `[localize.paper]`."""
    detector: str
    versions: Mapping[str, str]
    quick: bool = False


@dataclass(frozen=True)
class MapResult:
    """Maps of one method, as `maps.build` gives them; `quality` is one of `SIGHTS`."""

    method: str
    quality: str
    seed: int
    values: Mapping[str, Any]


@dataclass(frozen=True)
class NoiseScore:
    """A track with more or less noise than the logs have."""

    level: float
    """Times theirs."""
    track: TrackScore


@dataclass(frozen=True)
class NotRun:
    """A row, or a cell of table 4, that has no figure, and why."""

    name: str
    where: str
    """Protocol or quality."""
    reason: str


@dataclass(frozen=True)
class Trained:
    """A network, and what it cost."""

    kind: str
    protocol: str
    quality: str
    seed: int
    seconds: float
    bytes: int


@dataclass(frozen=True)
class Results:
    """Everything that tables and figures show."""

    conditions: Conditions
    tracks: tuple[TrackScore, ...]
    maps: tuple[MapResult, ...]
    missing: tuple[NotRun, ...]
    trained: tuple[Trained, ...] = ()
    noise: tuple[NoiseScore, ...] = ()

    def of_row(self, row: str, protocol: str) -> list[TrackScore]:
        """Scores of a row, by seed and log."""
        found = [one for one in self.tracks if (one.row, one.protocol) == (row, protocol)]
        return sorted(found, key=lambda one: (one.seed, one.log))

    def poses(self, row: str, protocol: str, what: str) -> _FLOATS:
        """(seeds, logs) of `ape_m`, `de_deg` or `coverage`; logs sorted by name, (0, logs) without any score."""
        logs = sorted({one.log for one in self.tracks if one.protocol == protocol})
        return _by_seed_and_log(self.of_row(row, protocol), logs, what)

    def noise_poses(self, row: str, level: float, what: str) -> _FLOATS:
        """The same for a row at a level of noise, across scenes."""
        found = [one.track for one in self.noise if (one.track.row, one.level) == (row, level)]
        return _by_seed_and_log(found, sorted({one.log for one in found}), what)

    def pose_curves(self, row: str, protocol: str, what: str) -> _FLOATS:
        """(seeds, logs, steps) of `distance_m` or `turn_deg`; NaN where there is no pose."""
        found = self.of_row(row, protocol)
        seeds, logs = sorted({one.seed for one in found}), sorted({one.log for one in found})
        values = np.full((len(seeds), len(logs), self.conditions.steps), np.nan)
        for one in found:
            steps = getattr(one, what)
            values[seeds.index(one.seed), logs.index(one.log), : len(steps)] = steps
        return values

    def of_method(self, method: str, quality: str) -> list[MapResult]:
        """Maps of a method, by seed."""
        found = [one for one in self.maps if (one.method, one.quality) == (method, quality)]
        return sorted(found, key=lambda one: one.seed)

    def map_curves(self, method: str, quality: str, cells: str = "reached") -> _FLOATS:
        """(seeds, logs, steps) of the mean squared error over a set of cells."""
        found = self.of_method(method, quality)
        if not found:
            return np.zeros((0, 0, 0))
        return np.stack([curve(one.values, sorted(one.values["logs"]), cells) for one in found])

    def map_errors(self, method: str, quality: str, cells: str = "reached") -> _FLOATS:
        """(seeds, logs) of the mean squared error, averaged over steps as the loss of equation 9 is."""
        curves = self.map_curves(method, quality, cells)
        return mean_over(curves, 2)

    def map_scores(self, method: str, quality: str, what: str, cells: str = "reached") -> _FLOATS:
        """(seeds, logs) of a score of the last map: brier, ece, object_iou, boundary_f1 or mse."""
        found = self.of_method(method, quality)
        values = [[one.values["logs"][log]["last"][cells][what] for log in sorted(one.values["logs"])] for one in found]
        return np.array(values, np.float64).reshape(len(found), -1)

    def found_again(self, method: str, quality: str, what: str) -> _FLOATS:
        """(seeds, logs) of `ape_m`, `de_deg` or `coverage` of visual poses in maps that were built at true poses."""
        found = self.of_method(method, quality)
        errors = [[found_again(one.values, log) for log in sorted(one.values["logs"])] for one in found]
        if not errors:
            return np.zeros((0, 0))
        if what == "coverage":
            values = [[float(np.mean(~np.isnan(log[:, 0]))) for log in logs] for logs in errors]
        else:
            column = ("ape_m", "de_deg").index(what)
            values = [[float(mean_over(log[:, column], 0)) for log in logs] for logs in errors]
        return np.array(values, np.float64)

    def class_iou(self, method: str, quality: str) -> dict[str, float]:
        """Intersection over union of each class, cells of all last maps together; NaN for classes in none."""
        found = [
            (one.values["classes"], log["overlaps"])
            for one in self.of_method(method, quality)
            for log in one.values["logs"].values()
        ]
        parts = [Overlaps(np.array(cells["intersection"]), np.array(cells["union"])) for _, cells in found]
        if not parts:
            return {}
        whole = sum(parts[1:], parts[0])
        return dict(zip(found[0][0], whole.iou.tolist(), strict=True))

    @property
    def reasons(self) -> tuple[NotRun, ...]:
        """What is missing, places with the same reason together."""
        places: dict[tuple[str, str], list[str]] = {}
        for one in self.missing:
            places.setdefault((one.name, one.reason), []).append(one.where)
        return tuple(NotRun(name, "; ".join(where), reason) for (name, reason), where in places.items())


def _by_seed_and_log(found: Sequence[TrackScore], logs: Sequence[str], what: str) -> _FLOATS:
    seeds = sorted({one.seed for one in found})
    values = np.full((len(seeds), len(logs)), np.nan)
    for one in found:
        values[seeds.index(one.seed), logs.index(one.log)] = getattr(one, what)
    return values


def mean_over(values: _FLOATS, axis: int) -> _FLOATS:
    """Mean over an axis of what is no NaN; NaN where nothing else is."""
    known = ~np.isnan(values)
    count = known.sum(axis)
    total = np.where(known, values, 0.0).sum(axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def rows_in(results: Results, names: Sequence[str]) -> list[str]:
    """The names that were run or should have been."""
    known = {one.row for one in results.tracks} | {one.name for one in results.missing}
    return [name for name in names if name in known]
