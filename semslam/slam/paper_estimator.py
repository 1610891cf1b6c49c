"""The paper's estimator, step by step: look (2), check against the motion (3, 4), place (5, 6), update (7, 8 or 10).

What the paper leaves open:

- The first keyframe stands at the map's centre with heading 0 and places its observation there.
- Without any match (an empty map, or no object in common) the field is flat and says nothing. Visual-inertial mode
  then takes the inertial pose. Visual mode, which always takes the visual pose, keeps the bin of its last one: of equal
  scores the nearest wins. Placing by a flat field would smear the observation over the map, so the pose alone counts.
- Visual-inertial mode without motion takes the visual pose unchecked; if nothing matches either, there is no pose.
- Without an observation the pose is inertial; visual mode has none.
- After a keyframe without a pose the last one is held. The motion in between is lost, so the gates of equation 4 mean
  nothing until a visual pose is taken again: the next one is taken unchecked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes, object_planes, pool_observation
from semslam.labels import UNOBSERVED
from semslam.slam.checkpoint import pack, unpack
from semslam.slam.estimator import INERTIAL, NONE, START, VISUAL, Belief, Mode, PoseEstimate, Step
from semslam.slam.paper import (
    Field,
    PoseGrid,
    Window,
    best_bin,
    correlate,
    cross_check,
    field_modes,
    place_observation,
    pose_field,
    roi_mask,
    rotate_observation,
    step_inertial,
    update_map,
    visual_field,
)
from semslam.stages.settings import PaperConfig


class ClassMap(Protocol):
    """The map m_t and how it takes up what is placed on it."""

    @property
    def planes(self) -> Planes:
        """The map (L, H, W), the estimator's own: copy it before you keep it."""

    def update(self, placed: Planes, window: Window) -> None:
        """Take up what was placed (L, rows, columns) in the window; no other cell changes."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What the map remembers."""

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on from `arrays`."""


class LeakyMap:
    """The heuristic map of equation 10, all of it unobserved at first."""

    def __init__(self, classes: int, side: int, leak: float) -> None:
        self._leak = leak
        self._world: Planes = np.zeros((classes, side, side), np.float32)
        self._world[UNOBSERVED] = 1.0

    @property
    def planes(self) -> Planes:
        """The map m_t; *unobserved* is 1 where nothing was ever placed."""
        return self._world

    def update(self, placed: Planes, window: Window) -> None:
        """Equation 10 in the window, at a cost that does not depend on the rest of the map."""
        part = self._world[:, window[0], window[1]]
        part[:] = update_map(part, placed, (slice(None), slice(None)), self._leak)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The map."""
        return {"world": self._world}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on from `arrays`."""
        self._world = arrays["world"]


@dataclass(frozen=True)
class _Sight:
    """What the visual half says about a keyframe."""

    pose: SE2
    field: Field
    matched: bool
    entropy_nats: float
    modes: tuple[Mode, ...]


class PaperEstimator:
    """Visual-inertial (`inertial=True`) or visual pose tracks by equations 2 to 7, with the map of equation 8 or 10."""

    def __init__(
        self,
        config: PaperConfig,
        classes: tuple[str, ...],
        cell_m: float,
        side: int,
        modes: int,
        inertial: bool,
        model: Path | None = None,
    ) -> None:
        """`cell_m`, `side` and `classes`, the reserved ones first, are those of the observations table.

        `model` is the network of the learned update; None takes the leaky one.

        Raises:
            SemslamError: the paper's grid cannot be made from the observations' cells, or the network is none, or was
                trained for others.
        """
        self._config = config
        self._factor = pooling_factor(config, cell_m, side)
        self._grid = PoseGrid(config.headings, config.map_side, config.cell_m)
        self._modes = modes
        self._inertial = inertial
        self._map = open_map(config, classes, model)
        self._last: SE2 | None = None
        self._lost = False

    def step(self, step: Step) -> PoseEstimate:
        """Find the pose, then update the map at it."""
        rotated = None if step.observation is None else self._rotations(step.observation)
        if self._last is None:
            estimate, sight = PoseEstimate(SE2(0.0, 0.0, 0.0), START), None
        else:
            inertial = step_inertial(self._last, step.motion) if step.motion and self._inertial else None
            sight = None if rotated is None else self._look(rotated, inertial or self._last)
            estimate = _report(*self._choose(sight, inertial), sight)
        if estimate.map_from_robot and rotated is not None:
            self._update(rotated, estimate.map_from_robot, _believed_field(sight, estimate.source))
        self._remember(estimate)
        return estimate

    def belief(self) -> Belief:
        """The map m_t."""
        origin = self._grid.origin_m
        return Belief(self._map.planes.copy(), self._grid.cell_m, origin, origin)

    def state(self) -> bytes:
        """Map, last pose, and whether the track is lost."""
        last = self._last
        pose = np.array([] if last is None else [last.x_m, last.y_m, last.heading_rad])
        return pack({**self._map.arrays(), "last": pose, "lost": np.array(self._lost)})

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        arrays = unpack(state)
        last = arrays["last"].tolist()
        self._map.restore(arrays)
        self._lost = bool(arrays["lost"])
        self._last = SE2(*last) if last else None

    def _rotations(self, fine: Planes) -> Planes:
        """Pool to the paper's cells, drop noise below beta, binarise if asked, rotate: (L, s, s) -> (R, L, h, h)."""
        planes = pool_observation(fine, self._factor, self._config.side)
        objects = object_planes(planes)
        objects[objects < self._config.noise_floor] = 0.0
        if self._config.binary:
            objects[objects > 0.0] = 1.0
        return rotate_observation(planes, self._config.headings)

    def _look(self, rotated: Planes, near: SE2) -> _Sight:
        """Equation 2: the visual pose field and what it says."""
        scores = correlate(rotated, self._map.planes)
        matched = bool(scores.max() > 0.0)
        field, entropy = visual_field(scores, self._config.temperature)
        best = best_bin(scores, near, self._grid)
        modes = field_modes(field, best, self._grid, self._modes)
        return _Sight(self._grid.pose_of(best), field, matched, entropy, modes)

    def _choose(self, sight: _Sight | None, inertial: SE2 | None) -> tuple[SE2 | None, str]:
        """Equation 4 and the cases it leaves out: the pose and its source."""
        if not self._inertial:
            return (sight.pose, VISUAL) if sight else (None, NONE)
        if sight and sight.matched and (inertial is None or self._lost or self._agree(sight.pose, inertial)):
            return sight.pose, VISUAL
        return (inertial, INERTIAL) if inertial else (None, NONE)

    def _agree(self, visual: SE2, inertial: SE2) -> bool:
        config = self._config
        return cross_check(visual, inertial, config.gate_distance_m, config.gate_heading_rad, config.gate)

    def _update(self, rotated: Planes, pose: SE2, field: Field | None) -> None:
        """Equations 5 to 8 or 10; without a field the pose alone counts."""
        window = roi_mask(pose, self._grid, self._config.side)
        placed = place_observation(rotated, pose_field(pose, self._grid) if field is None else field, window)
        self._map.update(placed, window)

    def _remember(self, estimate: PoseEstimate) -> None:
        if estimate.map_from_robot is None:
            self._lost = True
            return
        self._last = estimate.map_from_robot
        if estimate.source == VISUAL:
            self._lost = False


def _believed_field(sight: _Sight | None, source: str) -> Field | None:
    """Equation 5: the visual field if the visual pose was taken for a reason; None means the pose alone."""
    return sight.field if sight and sight.matched and source == VISUAL else None


def _report(pose: SE2 | None, source: str, sight: _Sight | None) -> PoseEstimate:
    if sight is None:
        return PoseEstimate(pose, source)
    return PoseEstimate(pose, source, float(sight.field.max()), sight.entropy_nats, sight.modes)


def open_map(config: PaperConfig, classes: tuple[str, ...], model: Path | None) -> ClassMap:
    """An empty map: learned if there is a network for it, else leaky.

    Raises:
        SemslamError: the network is none, or was trained for other observations.
    """
    if model is None:
        return LeakyMap(len(classes), config.map_side, config.leak)
    from semslam.slam.learned_map import LearnedMap  # with ONNX Runtime, which dead reckoning does without

    return LearnedMap.open(model, classes, config.map_side, config.cell_m, config.side, binary=config.binary)


def pooling_factor(config: PaperConfig, cell_m: float, side: int) -> int:
    """How many observation cells make one of the paper's, along an axis: an odd number.

    Raises:
        SemslamError: `cell_m` is no odd multiple, a side is even, or the observation is too small for `side`.
    """
    for key, value in (("map_side", config.map_side), ("side", config.side)):
        if value % 2 == 0:
            raise SemslamError(
                f"`localize.paper.{key}` is {value}, but the robot starts at the middle of a cell, so it must be odd",
                hint=f"set `localize.paper.{key}` to {value - 1} or {value + 1}",
            )
    factor = round(config.cell_m / cell_m)
    if factor % 2 == 0 or abs(factor * cell_m - config.cell_m) > 1e-6 * config.cell_m:
        valid = ", ".join(f"{n * cell_m:.6g}" for n in (1, 3, 5, 7))
        raise SemslamError(
            f"`localize.paper.cell_m` is {config.cell_m:g}, which is no odd multiple of `extract.cell_m` ({cell_m:g})",
            hint=f"set `localize.paper.cell_m` to one of {valid}, or change `extract.cell_m`",
        )
    if config.side * factor >= side + 2 * factor:
        largest = (side + 2 * factor - 1) // factor
        raise SemslamError(
            f"`localize.paper.side` is {config.side} cells of {config.cell_m:g} m, but `extract.side` gives "
            f"observations of {side} cells of {cell_m:g} m",
            hint=f"set `localize.paper.side` to {largest - 1 + largest % 2} or less, or raise `extract.side`",
        )
    return factor
