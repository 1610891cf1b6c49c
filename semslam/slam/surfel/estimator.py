"""The estimator of whole logs: walk through all keyframes, align all of them with each other, and, if there is a map
made before, find them in it.

Nothing is told of a keyframe before the last one was taken, since the last one may move the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, planar
from semslam.slam.checkpoint import as_array, pack, unpack
from semslam.slam.estimator import INERTIAL, NONE, START, VISUAL, Mode, PoseEstimate, Step
from semslam.slam.surfel.motion_prior import MotionPrior, noise_sigmas
from semslam.slam.surfel.places import Anchor, Edges, Keyframe, Place, moved, placed
from semslam.slam.surfel.prior import Grid, Seen, place_row, read_prior, submap_of
from semslam.slam.surfel.registration import AMBIGUOUS, Placement, place_in
from semslam.slam.surfel.rejoining import rejoined, without_specks
from semslam.slam.surfel.sight import Sight
from semslam.slam.surfel.smoothing import Smoothed, smooth
from semslam.slam.surfel.surfels import Surfels
from semslam.slam.surfel.tracking import SHORTEST_S, Track
from semslam.slam.surfel.uncertainty import along, lever, turn_of
from semslam.stages.settings import SurfelConfig

_Arrays = dict[str, NDArray[Any]]
Floats = NDArray[np.float64]


class SurfelEstimator:
    """A pose track from depth, with motion where depth says nothing."""

    def __init__(self, config: SurfelConfig, grid: Grid, modes: int = 5) -> None:
        """`grid` of the observations; `modes`: ways to lie on a map made before that are told, at most.

        Raises:
            SemslamError: the map made before cannot be read, or was made of other observations.
        """
        self._config = config
        self._grid = grid
        self._modes = modes
        self._prior = read_prior(Path(config.prior), grid) if config.prior else None
        self._track = Track(config)
        self._frames: list[int] = []
        self._stamps: list[int] = []
        self._seen: list[Seen] = []
        self._kept = 0  # keyframes that earlier parts hold
        self._places: list[Place] = []
        self._sources: list[str] = []
        self._covariances: list[Floats] = []
        self._placement: Placement | None = None

    def step(self, step: Step) -> None:
        """Take the next keyframe."""
        seconds = (step.stamp_nanos - self._stamps[-1]) / 1e9 if self._stamps else 0.0
        keyframe = Keyframe.of(step.view, self._config) if step.view else None
        place = self._track.step(keyframe, step.motion, max(0.0, seconds))
        self._frames.append(step.frame)
        self._stamps.append(step.stamp_nanos)
        self._seen.append(Seen.of(None if place.anchor else step.observation))

    def finish(self, watch: Callable[[int], None] | None = None) -> list[PoseEstimate]:
        """The poses of all keyframes; `watch` hears of each round over them."""
        if not self._track.places:
            return []
        smoothed = self._smoothed(watch)
        # Of the first one's tilt nothing: what is upright all keyframes tell together.
        start = planar(smoothed.places[0].pose).inverse().matrix
        self._places = [moved(place, start @ place.pose) for place in smoothed.places]
        self._sources = _sources(self._places, smoothed.parts)
        self._covariances = _covariances(smoothed, self._track.prior)
        if self._prior is None:
            self._sources[0] = START
            return self._told()
        known = list(self._known())
        own = submap_of([place for _, place, _ in known], [seen for _, _, seen in known], self._grid)
        self._placement = place_in(own, self._prior)
        return self._laid(self._placement)

    def _smoothed(self, watch: Callable[[int], None] | None) -> Smoothed:
        """All keyframes aligned, and parts that nothing ties to the first one looked for in its map."""
        walked, scale = without_specks(self._track.places), self._track.prior.scale
        smoothed = smooth(walked, self._track.prior.bias, self._config, watch, scale)
        if len(smoothed.parts) < 2:
            return smoothed
        places = rejoined(smoothed, self._seen, self._grid)
        if places is None:
            return smoothed
        again = smooth(places, smoothed.bias, self._config, scale=scale)
        return again if again.equations else smoothed

    def _known(self) -> Iterator[tuple[int, Place, Seen]]:
        """Number, place and observation of keyframes whose place pictures tell."""
        whole = zip(self._places, self._sources, self._seen, strict=True)
        for index, (place, source, seen) in enumerate(whole):
            if source in (START, VISUAL) and place.keyframe is not None:
                yield index, place, seen

    def _told(self) -> list[PoseEstimate]:
        """The poses as they stand."""
        known = [tuple(error.ravel().tolist()) for error in self._covariances]
        errors: list[tuple[float, ...] | None] = [*known] or [None] * len(self._places)
        return [
            PoseEstimate(None, NONE) if source == NONE else PoseEstimate(planar(place.pose), source, covariance=error)
            for place, source, error in zip(self._places, self._sources, errors, strict=True)
        ]

    def _laid(self, placement: Placement) -> list[PoseEstimate]:
        """The poses in the map made before. None if that is not sure; if there are several ways, they are the modes."""
        ways = [(way.other_from_own, way.probability) for way in placement.proposals[: self._modes]]
        told: dict[str, Any] = {}
        if ways:
            shares = [way.probability for way in placement.proposals if way.probability > 0]
            told = {"peak": ways[0][1], "entropy_nats": sum(-share * math.log(share) for share in shares)}
        modes = [
            tuple(Mode(way @ planar(place.pose), probability) for way, probability in ways) for place in self._places
        ]
        found = placement.other_from_own
        if found is None:
            known = modes if placement.verdict == AMBIGUOUS else [()] * len(modes)
            return [PoseEstimate(None, NONE, modes=some, **(told if some else {})) for some in known]
        error = placement.proposals[0].covariance
        self._covariances = [
            _carried(found, error, planar(place.pose), own)
            for place, own in zip(self._places, self._covariances, strict=False)
        ]
        self._places = [moved(place, found.matrix @ place.pose) for place in self._places]
        return [replace(one, modes=some, **told) for one, some in zip(self._told(), modes, strict=True)]

    def warnings(self) -> Iterator[str]:
        """What a user should know of the track, once it is finished."""
        placement = self._placement
        apart = sum(source != VISUAL for source in self._sources[1:])
        if apart:
            yield (
                f"{apart:,} keyframes show nothing that the others do; their poses, if any, are those of motion alone, "
                "and they are left out of `places.parquet`"
            )
        if placement is None or placement.other_from_own is not None:
            return
        if placement.verdict == AMBIGUOUS:
            chances = ", ".join(f"{way.probability:.0%}" for way in placement.proposals[: self._modes])
            yield (
                f"ambiguous: the log fits the map of `localize.surfel.prior` in several ways alike ({chances}); "
                "it has no poses, and the poses table holds the ways as modes"
            )
        else:
            yield "lost: the log was not found in the map of `localize.surfel.prior`; it has no poses"

    def rows(self) -> Iterator[dict[str, list[Any]]]:
        """Rows of the places table, once the track is finished; none of a log that was not found in the map."""
        if self._placement is not None and self._placement.other_from_own is None:
            return
        for index, place, seen in self._known():
            yield place_row(self._frames[index], self._stamps[index], place, seen)

    def part(self) -> bytes:
        """What came since the last part, and how far the track has got."""
        new = range(self._kept, len(self._stamps))
        self._kept = len(self._stamps)
        prior = self._track.prior
        arrays: _Arrays = {"bias": prior.bias, "covariance": prior.covariance, "speed": prior.speed}
        arrays["surprise"] = np.array([prior.surprise, prior.steps])
        arrays["open"] = self._track.open
        arrays["group"] = np.array([self._track.group, self._track.parked])
        arrays["frames"] = np.array([self._frames[index] for index in new], np.int64)
        arrays["stamps"] = np.array([self._stamps[index] for index in new], np.int64)
        kept = {str(index): as_array(_packed(self._track.places[index], self._seen[index])) for index in new}
        return pack(arrays | kept)

    def restore(self, parts: Sequence[bytes]) -> None:
        """Go on where the last of these parts was taken; they are all that were."""
        self._track, self._frames, self._stamps, self._seen = Track(self._config), [], [], []
        for part in parts:
            arrays = unpack(part)
            prior = self._track.prior
            prior.bias, prior.covariance, prior.speed = arrays["bias"], arrays["covariance"], arrays["speed"]
            prior.surprise, prior.steps = float(arrays["surprise"][0]), float(arrays["surprise"][1])
            self._track.open = arrays["open"]
            self._track.group, self._track.parked = int(arrays["group"][0]), bool(arrays["group"][1])
            for frame, stamp in zip(arrays["frames"].tolist(), arrays["stamps"].tolist(), strict=True):
                place, seen = _unpacked(arrays[str(len(self._stamps))].tobytes())
                self._track.recall(place)
                self._seen.append(seen)
                self._frames.append(frame)
                self._stamps.append(stamp)
        self._kept = len(self._stamps)


def _sources(places: Sequence[Place], parts: Sequence[Sequence[int]]) -> list[str]:
    """Where poses come from: pictures that are tied to the first, else unbroken motion from there, else nowhere."""
    sources: list[str] = []
    tied = set(parts[0]) if parts else set()
    for index, place in enumerate(places):
        if index in tied:
            sources.append(VISUAL)
        elif not sources or (place.motion is not None and sources[-1] != NONE):
            sources.append(INERTIAL)
        else:
            sources.append(NONE)
    return sources


def _covariances(smoothed: Smoothed, prior: MotionPrior) -> list[Floats]:
    """(3, 3) of every pose; of those that nothing ties to the first one, what motion leaves open since the last that
    is; empty if nothing was aligned."""
    known = smoothed.covariances()
    tied = set(smoothed.parts[0]) if smoothed.parts else {0}
    whole = np.zeros((6, 6))  # of the pose, and of the steady error of motion, which is the same in every step
    found: list[Floats] = []
    for index, covariance in enumerate(known):
        if index == 0 or index in tied:
            whole = np.zeros((6, 6))
            whole[:3, :3], whole[3:, 3:] = covariance, prior.scale * prior.covariance
        else:
            whole = _grown(whole, smoothed.places[index - 1], smoothed.places[index], prior)
        found.append(whole[:3, :3].copy())
    return found


def _grown(whole: Floats, before: Place, place: Place, prior: MotionPrior) -> Floats:
    """Covariance (6, 6) of pose and steady error after a step that motion alone tells."""
    seconds = max(place.seconds, SHORTEST_S)
    x, y = (place.pose - before.pose)[:2, 3]
    step = np.eye(6)
    step[:3, :3] = lever(float(x), float(y))
    random = prior.expect(None, seconds).covariance
    if place.motion is not None:
        step[:3, 3:] = turn_of(before.pose) * seconds
        random = prior.scale * seconds * np.diag(noise_sigmas(prior.config) ** 2)
    after = step @ whole @ step.T
    after[:3, :3] += along(random, before.pose)
    return np.asarray(after)


def _carried(other_from_own: SE2, error: Floats, own: SE2, own_error: Floats) -> Floats:
    """Covariance (3, 3) of a pose in another map, from those of the map's place there and of the pose in its own."""
    there = other_from_own.matrix
    x, y = there[:2, :2] @ [own.x_m, own.y_m]
    arm = lever(float(x), float(y))
    return np.asarray(arm @ error @ arm.T + along(own_error, there))


def _values(pose: SE2 | None) -> NDArray[np.float64]:
    """(3,), or empty for none."""
    return np.array([] if pose is None else [pose.x_m, pose.y_m, pose.heading_rad])


def _told_by_edges(edges: Edges | None) -> NDArray[np.float64]:
    """(8,), or empty for none."""
    if edges is None:
        return np.array([])
    return np.concatenate([[edges.index], _values(edges.other_from_robot), edges.information.ravel()])


def _packed(place: Place, seen: Seen) -> bytes:
    arrays: _Arrays = {
        "pose": place.pose,
        "seconds": np.array(place.seconds),
        "motion": _values(place.motion),
        "edges": _told_by_edges(place.edges),
        "linked": np.array([place.linked, place.group]),
        "cells": seen.cells,
        "weights": seen.weights,
    }
    if place.anchor:
        arrays |= {"anchor": np.array(place.anchor.index), "anchor_from_robot": place.anchor.anchor_from_robot}
        arrays["hessian"] = place.anchor.hessian
    if place.keyframe:
        surfels = place.keyframe.surfels
        arrays |= {name: getattr(surfels, name).astype(np.float32) for name in ("points", "normals", "sigma_m")}
        arrays |= place.keyframe.sight.arrays()
    return pack(arrays)


def _unpacked(packed: bytes) -> tuple[Place, Seen]:
    arrays = unpack(packed)
    keyframe = None
    if "points" in arrays:
        surfels = Surfels(*(arrays[name].astype(np.float64) for name in ("points", "normals", "sigma_m")))
        keyframe = Keyframe(surfels, Sight.from_arrays(arrays))
    motion = SE2(*arrays["motion"].tolist()) if arrays["motion"].size else None
    linked, group = arrays["linked"].tolist()
    seconds = arrays["seconds"].item()
    place = placed(keyframe, arrays["pose"], seconds, motion, linked=bool(linked), group=group)
    if arrays["edges"].size:
        values = arrays["edges"].tolist()
        place = replace(place, edges=Edges(int(values[0]), SE2(*values[1:4]), np.array(values[4:]).reshape(2, 2)))
    if "anchor" in arrays:
        tied = Anchor(int(arrays["anchor"]), arrays["anchor_from_robot"], arrays["hessian"])
        place = replace(place, anchor=tied)
    return place, Seen(arrays["cells"], arrays["weights"])
