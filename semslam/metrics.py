"""How far a pose track is from the truth: the paper's APE and DE, the coverage it leaves out, and what luck scores.

Both tracks are expressed from their first common keyframe and nothing else is aligned: no rotation, no scale, no best
fit. An estimator's map frame is the first keyframe's robot frame, so for a track that starts with the truth this only
moves the truth into the map frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semslam.geometry.frames import SE2, wrap_angles

_FLOATS = NDArray[np.float64]
_DRAWS = 1000
"""Random tracks that `chance` averages over; its APE is then within 0.5 % for 30 frames."""


@dataclass(frozen=True)
class Track:
    """Poses by keyframe, rising, keyframes without a pose left out; equally long columns."""

    frames: NDArray[np.int64]
    stamp_nanos: NDArray[np.int64]
    x_m: _FLOATS
    y_m: _FLOATS
    heading_rad: _FLOATS

    @staticmethod
    def of(frames: ArrayLike, stamp_nanos: ArrayLike, x_m: ArrayLike, y_m: ArrayLike, heading_rad: ArrayLike) -> Track:
        """A track from plain columns, such as those of the poses table; rows whose x is None or NaN are left out."""
        x, y, heading = (np.asarray(column, np.float64) for column in (x_m, y_m, heading_rad))
        kept = ~np.isnan(x)
        frame, stamp = (np.asarray(column, np.int64)[kept] for column in (frames, stamp_nanos))
        return Track(frame, stamp, x[kept], y[kept], heading[kept])

    def by_stamp(self) -> dict[int, SE2]:
        """Poses by their stamps."""
        columns = (column.tolist() for column in (self.stamp_nanos, self.x_m, self.y_m, self.heading_rad))
        return {stamp: SE2(*pose) for stamp, *pose in zip(*columns, strict=True)}


@dataclass(frozen=True)
class Score:
    """Errors of one track. The four errors are None if no keyframe has both truth and pose."""

    frames: int
    """Keyframes with truth."""
    coverage: float
    """Share of those with a pose, 0 to 1."""
    ape_m: float | None
    """Mean Euclidean position error."""
    de_deg: float | None
    """Mean absolute heading error, wrapped."""
    ape_worst_m: float | None
    de_worst_deg: float | None
    ok: float = 0.0
    """Share of the keyframes with truth whose pose the estimator calls ok."""
    ok_wrong: float | None = None
    """Share of those that are farther off than `ok` promises; None if there is none."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of one track, keyframe by keyframe; equally long columns, keyframes without a pose left out."""

    frames: NDArray[np.int64]
    distance_m: _FLOATS
    turn_deg: _FLOATS
    """0 to 180."""


def errors(truth: Track, estimate: Track) -> Errors:
    """Errors of `estimate` at the keyframes that both tracks have."""
    frames, true_rows, rows = np.intersect1d(truth.frames, estimate.frames, assume_unique=True, return_indices=True)
    if not len(rows):
        return Errors(frames, np.zeros(0), np.zeros(0))
    expected, found = _from_first(truth, true_rows), _from_first(estimate, rows)
    turn = np.degrees(np.abs(wrap_angles(found[2] - expected[2])))
    return Errors(frames, np.hypot(*(found[:2] - expected[:2])), turn)


def score(truth: Track, estimate: Track) -> Score:
    """Errors of `estimate` at the keyframes of `truth`; keyframes without a pose lower the coverage, not the errors."""
    found, frames = errors(truth, estimate), len(truth.frames)
    if not len(found.frames):
        return Score(frames, 0.0, None, None, None, None)
    distance, turn = found.distance_m, found.turn_deg
    summary = (distance.mean(), turn.mean(), distance.max(), turn.max())
    return Score(frames, len(found.frames) / frames, *(float(error) for error in summary))


def trusted(found: Score, wrong: Errors, ok_frames: Iterable[int], ok_m: float, ok_deg: float) -> Score:
    """With what became of the keyframes that the estimator calls ok: it promises that they are nearer than the bounds.

    Args:
        found: the score of the track.
        wrong: the errors of the track.
        ok_frames: keyframes that are called so.
        ok_m: bound of the distance.
        ok_deg: bound of the turn.
    """
    called = np.isin(wrong.frames, np.fromiter(ok_frames, np.int64))
    if not called.any():
        return found
    beyond = (wrong.distance_m[called] > ok_m) | (wrong.turn_deg[called] > ok_deg)
    return replace(found, ok=int(called.sum()) / found.frames, ok_wrong=float(beyond.mean()))


def _from_first(track: Track, rows: NDArray[Any]) -> _FLOATS:
    """(3, N): x, y and heading seen from the first of the rows."""
    x, y, heading = track.x_m[rows], track.y_m[rows], track.heading_rad[rows]
    cosine, sine = math.cos(heading[0]), math.sin(heading[0])
    x, y = x - x[0], y - y[0]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, heading - heading[0]])


def standstill(truth: Track) -> Score:
    """What an estimator scores that never leaves its first pose."""
    zero = np.zeros(len(truth.frames))
    return score(truth, Track(truth.frames, truth.stamp_nanos, zero, zero, zero))


def chance(truth: Track, map_half_m: float = 4.95, seed: int = 0) -> Score:
    """What uniformly random poses score on a square map about the first pose, as the mean over many random tracks.

    Args:
        truth: the true track.
        map_half_m: half the side of the map, metres; 4.95 is the paper's map of 33 cells.
        seed: of the random poses.
    """
    frames = len(truth.frames)
    if frames == 0:
        return Score(0, 0.0, None, None, None, None)
    distance, turn = _random_errors(truth, map_half_m, seed)
    worst = (float(errors.max(1).mean()) for errors in (distance, turn))
    return Score(frames, 1.0, float(distance.mean()), float(turn.mean()), *worst)


def chance_errors(truth: Track, map_half_m: float = 4.95, seed: int = 0) -> Errors:
    """What `chance` scores at each keyframe, as the mean over its random tracks."""
    if not len(truth.frames):
        return Errors(truth.frames, np.zeros(0), np.zeros(0))
    distance, turn = _random_errors(truth, map_half_m, seed)
    return Errors(truth.frames, distance.mean(0), turn.mean(0))


def _random_errors(truth: Track, map_half_m: float, seed: int) -> tuple[_FLOATS, _FLOATS]:
    """Position errors in metres and heading errors in degrees of random tracks, (draws, frames) each."""
    frames = len(truth.frames)
    expected = _from_first(truth, np.arange(frames))
    random = np.random.default_rng(seed)
    place = random.uniform(-map_half_m, map_half_m, (2, _DRAWS, frames))
    heading = random.uniform(-math.pi, math.pi, (_DRAWS, frames))
    turn = np.degrees(np.abs(wrap_angles(heading - expected[2])))
    return np.hypot(*(place - expected[:2, None])), turn
