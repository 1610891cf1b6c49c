"""What the surfaces of two keyframes tell of each other, kept from round to round while the two stay as they are.

Most pairs do not move any more after a few rounds. Then the normal equations of the last comparison still hold, but for
the little that they have moved since: gradient + Hessian * change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semslam.geometry.frames import Matrix, invert
from semslam.slam.surfel.alignment import between, change_between, shows_wall
from semslam.slam.surfel.places import Keyframe, Place
from semslam.slam.surfel.sight import agreement

Floats = NDArray[np.float64]

_MIN_MATCHES = 30
_UNMOVED = 5e-4
"""Metres and radians between two keyframes up to which an earlier comparison of theirs is taken."""


@dataclass(frozen=True, eq=False)
class Laid:
    """One keyframe's surfels on another's."""

    target_from_source: Matrix
    hessian: Floats
    """(6, 6) for a turn of the source about its origin, and a shift, along the target's axes."""
    gradient: Floats
    """(6,)"""
    ties: bool
    """Whether there is a wall: a floor alone tells heights, not places."""

    def now(self, target_from_source: Matrix) -> Laid:
        """After a small change of the two poses."""
        change = change_between(self.target_from_source, target_from_source)
        return replace(self, target_from_source=target_from_source, gradient=self.gradient + self.hessian @ change)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two keyframes laid on each other, either way round; None where too little comes to lie on anything."""

    first_from_second: Matrix
    reach_m: float
    there: Laid | None = None
    """The first on the second."""
    back: Laid | None = None

    @property
    def ties(self) -> bool:
        """Whether the one tells where the other is."""
        return any(laid is not None and laid.ties for laid in (self.there, self.back))

    def now(self, first_from_second: Matrix) -> Comparison:
        """After a small change of the two poses."""
        there = self.there.now(invert(first_from_second)) if self.there else None
        return Comparison(
            first_from_second, self.reach_m, there, self.back.now(first_from_second) if self.back else None
        )


class Comparisons:
    """Of all pairs that were asked for."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], Comparison] = {}

    def of(self, places: Sequence[Place], first: int, second: int, reach_m: float) -> Comparison:
        """The comparison of two keyframes, anew unless it is known; `reach_m`: how far surfels may be apart."""
        relative = between(places[first].pose, places[second].pose)
        known = self._known.get((first, second))
        if known and known.reach_m == reach_m and _unmoved(known.first_from_second, relative):
            return known.now(relative)
        found = _compared(places[first], places[second], relative, reach_m, beside=second - first == 1)
        self._known[first, second] = found
        return found


def _unmoved(before: Matrix, after: Matrix) -> bool:
    return bool(np.abs(change_between(before, after)).max() < _UNMOVED)


def _compared(one: Place, other: Place, relative: Matrix, reach_m: float, *, beside: bool) -> Comparison:
    """Of keyframes whose pictures show the same; `beside`: taken one after the other."""
    nothing = Comparison(relative, reach_m)
    if not (one.keyframe and other.keyframe):
        return nothing
    seen = agreement(one.keyframe.sight, other.keyframe.sight, relative)
    samples = len(one.keyframe.sight.points) + len(other.keyframe.sight.points)
    near = beside or (one.linked and other.linked)  # else motion leads from neither to the other
    if not seen.same_place(samples, sure=not near):
        return nothing
    there = _laid(one.keyframe, other.keyframe, invert(relative), reach_m)
    return replace(nothing, there=there, back=_laid(other.keyframe, one.keyframe, relative, reach_m))


def _laid(source: Keyframe, target: Keyframe, target_from_source: Matrix, reach_m: float) -> Laid | None:
    fit = target.target.fit(source.surfels.moved(target_from_source), reach_m)
    if len(fit) < _MIN_MATCHES:
        return None
    hessian, gradient = fit.information(target_from_source[:3, 3])
    return Laid(target_from_source, hessian, gradient, shows_wall(hessian))
