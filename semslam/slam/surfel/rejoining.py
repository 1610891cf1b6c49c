"""Parts of a log that nothing ties together: the robot was carried, the camera covered, the odometry set anew.

Each part has a map of its own, which is laid on that of the others as a log is laid on a map made before
(`registration`), without a first guess. Where that is not sure the part stays as it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from semslam.slam.surfel.places import Place, moved
from semslam.slam.surfel.prior import Grid, Seen, submap_of
from semslam.slam.surfel.registration import Submap, place_in
from semslam.slam.surfel.smoothing import Smoothed

_LEAST = 5
"""Keyframes of a part that is looked for: fewer show too little to be sure."""


def rejoined(smoothed: Smoothed, seen: Sequence[Seen], grid: Grid) -> list[Place] | None:
    """All places, with the parts that were found laid where they belong; None if none was.

    `seen`: the observation of each.
    """
    main = smoothed.parts[0]
    places, whole = list(smoothed.places), list(main)
    there: Submap | None = None  # that of `whole`
    for part in _large(smoothed):
        there = there or _map(places, seen, grid, whole)
        found = place_in(_map(places, seen, grid, part), there).other_from_own
        if found is not None:
            for index in _with_followers(part, smoothed):
                place = moved(places[index], found.matrix @ places[index].pose)
                places[index] = replace(place, group=places[main[0]].group)
            whole, there = whole + part, None
    return places if len(whole) > len(main) else None


def _with_followers(part: Sequence[int], smoothed: Smoothed) -> list[int]:
    """A part, and after each of its keyframes those of no part worth looking for, to which motion leads from there:
    what shows nothing that others do goes where its neighbours in time go."""
    looked_for = {index for one in (smoothed.parts[0], *_large(smoothed)) for index in one}
    found = set(part)
    for index in range(min(part) + 1, len(smoothed.places)):
        if index - 1 in found and index not in looked_for and smoothed.places[index].motion is not None:
            found.add(index)
    return sorted(found)


def _large(smoothed: Smoothed) -> list[list[int]]:
    """Parts that are looked for, the largest first."""
    return sorted((part for part in smoothed.parts[1:] if len(part) >= _LEAST), key=len, reverse=True)


def without_specks(places: Sequence[Place]) -> list[Place]:
    """Groups of fewer keyframes than can be looked for become part of the one before, where motion leads from there;
    their links are forgotten: alignment has to find them again."""
    sizes = Counter(place.group for place in places if place.pictured)
    kept: list[Place] = []
    for place in places:
        if place.group == places[0].group or sizes[place.group] >= _LEAST:
            kept.append(place)
        else:
            before = kept[-1]
            there = moved(place, before.pose @ place.motion.matrix) if place.motion else place
            kept.append(replace(there, group=before.group, linked=False, anchor=None, edges=None))
    return kept


def _map(places: Sequence[Place], seen: Sequence[Seen], grid: Grid, part: Sequence[int]) -> Submap:
    rising = sorted(part)
    return submap_of([places[index] for index in rising], [seen[index] for index in rising], grid)
