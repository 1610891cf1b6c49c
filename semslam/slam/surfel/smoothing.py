"""All keyframes of a log aligned with each other at once: surfaces seen twice tie any two keyframes, whenever they were
taken, edges in pictures tie some, motion ties neighbours in time, and the steady error of motion is one more unknown.

Each round finds the pairs of keyframes that see most of the same, compares their surfels, and solves the normal
equations of all poses together (gtsam, sparse Cholesky). Going round a room thereby closes the loop, and a first
keyframe that later ones hardly saw is still held by those that did.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, Matrix, cross_matrix
from semslam.slam.surfel.alignment import change_between, nudged, pair_equations
from semslam.slam.surfel.comparisons import Comparison, Comparisons
from semslam.slam.surfel.motion_prior import PAUSE_S, UNKNOWN_SPEED_M_S, UNKNOWN_TURN_RAD_S, bias_sigmas, noise_sigmas
from semslam.slam.surfel.places import Kept, Place, moved, shared_voxels
from semslam.slam.surfel.search import unlevel
from semslam.slam.surfel.tracking import SHORTEST_S
from semslam.stages.settings import SurfelConfig

Floats = NDArray[np.float64]

_REACHES_M = (0.15, 0.1, 0.08, 0.06)
"""Of the rounds; later ones reach as far as the last."""
_LEAST_SHARED = 0.15
"""Share of the smaller one's voxels that two keyframes must have in common."""
_MOST_SIGMAS = 5.0
"""Motion that is farther off than this has less than half of its weight (Cauchy): slipping wheels, a parked robot."""
_STILL = 1e-3
"""Metres and radians of a change that is no improvement any more."""
_MOST_MARGINALS = 500
"""Poses whose covariance is worked out exactly: each takes longer, the more there are."""
_FIXED = 1e8
"""Information that keeps the first keyframe where it is."""
_HELD = 1e4
"""Information that keeps the first one of keyframes of which nothing tells where they are among the others."""
_FREE = 1e-3
"""Keeps what nothing ties solvable."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """What came of it."""

    places: list[Place]
    bias: Floats
    """(3,) steady error of motion, m/s, m/s, rad/s."""
    ties: list[tuple[int, int]]
    """Keyframes that surfaces tie to each other."""
    equations: _Equations | None = None
    """The last ones; None if nothing was aligned."""
    scale: float = 1.0
    """How much larger the variances of motion are than the configuration says."""

    def covariances(self) -> list[Floats]:
        """(3, 3) of each place's x, y and heading along the axes of the first one; empty if nothing was aligned."""
        return self.equations.covariances() if self.equations else []

    @property
    def parts(self) -> list[list[int]]:
        """Keyframes with pictures that surfaces tie together, over whatever others: in the end, or when they were
        taken and it was sure. Each part rising, in the order of their first ones."""
        pictured = [index for index, place in enumerate(self.places) if place.pictured]
        group = list(range(len(self.places)))
        linked = [index for index in pictured if self.places[index].linked]
        walked = [pair for pair in pairwise(linked) if _may_tie(self.places, *pair)]
        anchored = [(place.anchor.index, index) for index, place in enumerate(self.places) if place.anchor]
        for first, second in (*self.ties, *walked, *anchored):
            one, other = _root(group, first), _root(group, second)
            group[max(one, other)] = min(one, other)
        found: dict[int, list[int]] = {}
        for index in pictured:
            found.setdefault(_root(group, index), []).append(index)
        return list(found.values())


def _root(group: list[int], index: int) -> int:
    while group[index] != index:
        group[index] = group[group[index]]
        index = group[index]
    return index


def smooth(
    places: Sequence[Place],
    bias: Floats,
    config: SurfelConfig,
    watch: Callable[[int], None] | None = None,
    scale: float = 1.0,
) -> Smoothed:
    """Align all places with each other; `watch` hears of each round. Variances of motion are `scale` times those of the
    configuration."""
    result, comparisons = Smoothed(list(places), bias, [], scale=scale), Comparisons()
    for number in range(config.rounds):
        reach_m = _REACHES_M[min(number, len(_REACHES_M) - 1)]
        before, these = result, _equations(result, reach_m, config, comparisons)
        after = _solved(result, these)
        if after is None:  # motion that leads to some part is so doubtful that it is none
            these = _equations(result, reach_m, config, comparisons, hold_all=True)
            after = _solved(result, these)
        if after is None:
            break
        result = after
        if watch:
            watch(number + 1)
        if number >= len(_REACHES_M) and _settled(before.places, result.places):
            break
    return result


def _settled(before: Sequence[Place], after: Sequence[Place]) -> bool:
    """Whether no pose has changed by more than `_STILL`."""
    changes = [change_between(one.pose, other.pose) for one, other in zip(before, after, strict=True)]
    return bool(np.abs(changes).max(initial=0.0) < _STILL)


def _equations(
    before: Smoothed, reach_m: float, config: SurfelConfig, comparisons: Comparisons, *, hold_all: bool = False
) -> _Equations:
    """What surfaces, levels and motion tell of all poses where they are now; parts that nothing ties to the others are
    kept where they are if no motion leads there, or all of them."""
    places = before.places
    equations = _Equations(len(places))
    pairs = [pair for pair in pairs_of(places, config.neighbours) if _may_tie(places, *pair)]
    compared = ((pair, comparisons.of(places, *pair, reach_m)) for pair in pairs)
    equations.ties = [pair for pair, comparison in compared if _tie(equations, places, pair, comparison)]
    for part in replace(before, ties=equations.ties).parts[1:]:
        if hold_all or not _led_to(places, set(part)):
            _hold(equations, part[0])
    for index in range(len(places)):
        _level(equations, places, index, config)
        if index:
            _move(equations, before, index, config)
            _edges(equations, places, index)
        _anchor(equations, places, index)
    known = before.scale * bias_sigmas(config) ** 2
    equations.add((equations.bias,), np.diag(1.0 / known), before.bias / known)
    return equations


def _solved(before: Smoothed, equations: _Equations) -> Smoothed | None:
    """All poses anew; None if they cannot be solved for."""
    changes = equations.solved()
    if changes is None:
        return None
    poses = [nudged(place.pose, change) for place, change in zip(before.places, changes[:-1], strict=True)]
    after = [moved(place, pose) for place, pose in zip(before.places, poses, strict=True)]
    return Smoothed(after, before.bias + changes[-1], equations.ties, equations, before.scale)


def _may_tie(places: Sequence[Place], first: int, second: int) -> bool:
    """Whether it is sure that they are near each other if their poses are."""
    return places[first].group == places[second].group


def _led_to(places: Sequence[Place], part: set[int]) -> bool:
    """Whether motion leads into a part, or out of it."""
    into = any(places[index].motion for index in part if index and index - 1 not in part)
    return into or any(places[index + 1].motion for index in part if index + 1 < len(places) and index + 1 not in part)


def _hold(equations: _Equations, index: int) -> None:
    """Keep a keyframe about where it is."""
    equations.add((index,), np.diag([_FREE, _FREE, _HELD, _HELD, _HELD, _FREE]), np.zeros(6))


def pairs_of(places: Sequence[Place], most: int) -> list[tuple[int, int]]:
    """Keyframes that see the same: of each those, at most so many, with which it shares most voxels; and neighbours."""
    found = {(index, index + 1) for index in range(len(places) - 1)}
    kept = Kept.of(places)
    for index, place in enumerate(places):
        sizes = {
            other: count
            for other, count in shared_voxels(places, place, kept).items()
            if other != index and count >= _LEAST_SHARED * min(len(place.voxels), len(places[other].voxels))
        }
        for other in sorted(sizes, key=lambda one: (-sizes[one], one))[:most]:
            found.add((min(index, other), max(index, other)))
    return sorted(found)


def _tie(equations: _Equations, places: Sequence[Place], pair: tuple[int, int], comparison: Comparison) -> bool:
    """Tell what the surfaces of two keyframes do; False if they do not tie them after all."""
    for laid, (source, target) in ((comparison.there, pair), (comparison.back, pair[::-1])):
        if laid:
            pose = places[target].pose
            equations.add((source, target), *pair_equations(laid.hessian, laid.gradient, laid.target_from_source, pose))
    return comparison.ties


def _level(equations: _Equations, places: Sequence[Place], index: int, config: SurfelConfig) -> None:
    """The robot stands upright on its floor; the first keyframe's place and heading are the map frame's."""
    tilt, height = config.tilt_noise_rad**-2, config.height_noise_m**-2
    place = _FIXED if index == 0 else _FREE
    weight = np.diag([tilt, tilt, place, place, place, height])
    error = unlevel(places[index].pose) if index else unlevel(places[0].pose) * [1, 1, 0, 0, 0, 1]
    equations.add((index,), weight, weight @ error)


def _move(equations: _Equations, known: Smoothed, index: int, config: SurfelConfig) -> None:
    """Motion between neighbours in time, less its steady error; of a robot that does not tell it, what is likely."""
    before, place = known.places[index - 1], known.places[index]
    seconds = max(place.seconds, SHORTEST_S)
    if place.motion is None:
        x, y, turn, steady = 0.0, 0.0, 0.0, 0.0
        noise = np.array([UNKNOWN_SPEED_M_S, UNKNOWN_SPEED_M_S, UNKNOWN_TURN_RAD_S]) ** 2 * seconds**2
    else:
        measured = np.array([place.motion.x_m, place.motion.y_m, place.motion.heading_rad])
        x, y, turn = measured - known.bias * min(seconds, PAUSE_S)
        noise, steady = known.scale * noise_sigmas(config) ** 2 * seconds, min(seconds, PAUSE_S)
    error, of_poses = _off(before.pose, place.pose, SE2(x, y, turn).matrix)
    jacobian = np.zeros((6, 15))  # of a change of the pose before, of this one, and of the bias
    jacobian[:, :12] = of_poses
    jacobian[2, 14] = steady
    jacobian[3:, 12:14] = before.pose[:3, :2] * steady
    doubt = 1.0 + float((error[[2, 3, 4]] ** 2 / noise[[2, 0, 1]]).sum()) / _MOST_SIGMAS**2
    weight = np.diag([_FREE, _FREE, 1 / noise[2], 1 / noise[0], 1 / noise[1], _FREE]) / doubt
    weighted = jacobian.T @ weight
    equations.add((index - 1, index, equations.bias), weighted @ jacobian, weighted @ error)


def _edges(equations: _Equations, places: Sequence[Place], index: int) -> None:
    """Edges in pictures, by which the walk chose between places where surfaces lie equally well."""
    edges = places[index].edges
    if edges is None or not edges.information.any() or not _may_tie(places, edges.index, index):
        return
    other = places[edges.index].pose
    error, jacobian = _off(other, places[index].pose, edges.other_from_robot.matrix)
    told = other[:2, :2] @ edges.information @ other[:2, :2].T
    doubt = 1.0 + float(error[3:5] @ told @ error[3:5]) / _MOST_SIGMAS**2
    weight = np.zeros((6, 6))
    weight[3:5, 3:5] = told / doubt
    weighted = jacobian.T @ weight
    equations.add((edges.index, index), weighted @ jacobian, weighted @ error)


def _anchor(equations: _Equations, places: Sequence[Place], index: int) -> None:
    """A keyframe whose pictures were not kept stays where it was found beside its anchor, as far as surfaces told."""
    anchor, pose = places[index].anchor, places[index].pose
    if anchor is None:
        return
    known = places[anchor.index].pose
    error, jacobian = _off(known, pose, anchor.anchor_from_robot)
    turn = np.kron(np.eye(2), known[:3, :3])
    weighted = jacobian.T @ turn @ anchor.hessian @ turn.T
    equations.add((anchor.index, index), weighted @ jacobian, weighted @ error)


def _off(first: Matrix, second: Matrix, first_from_second: Matrix) -> tuple[Floats, Floats]:
    """(6,) how far a pose is from where another and the way between them put it, and (6, 12) how that depends on
    changes of both."""
    error = change_between(first @ first_from_second, second)
    jacobian = np.concatenate([-np.eye(6), np.eye(6)], 1)
    jacobian[3:, :3] = cross_matrix(first[:3, :3] @ first_from_second[:3, 3])
    return error, jacobian


class _Equations:
    """Normal equations of all poses and the bias."""

    def __init__(self, poses: int) -> None:
        import gtsam  # loading it takes a tenth of a second

        self._gtsam: Any = gtsam
        self._graph: Any = gtsam.GaussianFactorGraph()
        self.bias = poses
        """Key of the bias; poses have the keys before it."""
        self.ties: list[tuple[int, int]] = []
        """Keyframes that surfaces tie."""

    def add(self, keys: tuple[int, ...], hessian: Floats, gradient: Floats) -> None:
        """Add the squares whose Hessian and gradient, for the unknowns of `keys` in a row, are these."""
        sizes = [3 if key == self.bias else 6 for key in keys]
        ends = np.cumsum(sizes)
        parts = [slice(end - size, end) for end, size in zip(ends.tolist(), sizes, strict=True)]
        blocks: list[Any] = []
        for number, part in enumerate(parts):
            blocks += [hessian[part, other] for other in parts[number:]]
            blocks.append(-gradient[part])
        self._graph.add(self._gtsam.HessianFactor(*keys, *blocks, 0.0))

    def solved(self) -> list[Floats] | None:
        """The changes of all poses (6,), then that of the bias (3,); None if the equations do not determine them."""
        try:
            found = self._graph.optimize()
        except RuntimeError:  # gtsam's IndeterminantLinearSystemException: steps of years, motion beyond the planet
            return None
        changes = [np.asarray(found.at(key)) for key in range(self.bias + 1)]
        return changes if all(np.isfinite(change).all() for change in changes) else None

    def covariances(self) -> list[Floats]:
        """(3, 3) of x, y and heading of every pose; of many, exactly of some, and of those between as of the worse one
        beside them; empty if the equations do not determine them."""
        marginals = self._gtsam.Marginals(self._graph, self._gtsam.VectorValues())
        keep, step = np.ix_([3, 4, 2], [3, 4, 2]), math.ceil(self.bias / _MOST_MARGINALS)
        exact = sorted({*range(0, self.bias, step), self.bias - 1})
        try:
            known = {key: np.asarray(marginals.marginalCovariance(key))[keep] for key in exact}
        except RuntimeError:
            return []
        beside = [(exact[bisect_right(exact, key) - 1], exact[bisect_left(exact, key)]) for key in range(self.bias)]
        found = [max((known[one], known[other]), key=np.trace) for one, other in beside]
        return found if all(np.isfinite(one).all() for one in found) else []
