"""Detections of one thing become one thing, where it stands; what was seen once, or under another name, does not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.geometry.frames import SE2
from semslam.slam.objects import CELL_M, Patch, Thing, things

TABLE, CHAIR, LAMP = 3, 4, 5
SECOND = 1_000_000_000


def box(x_m: float, y_m: float, wide_m: float, deep_m: float, top_m: float) -> NDArray[np.float32]:
    """Points of a box in the world, dense enough for every cell."""
    x = np.arange(x_m - wide_m / 2 + 0.005, x_m + wide_m / 2, 0.01)
    y = np.arange(y_m - deep_m / 2 + 0.005, y_m + deep_m / 2, 0.01)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    height = np.linspace(0.05, top_m, len(grid))[:, None]
    return np.concatenate([grid, height], 1).astype(np.float32)


def patch(world: NDArray[np.float32], pose: SE2, class_id: int, frame: int, score: float = 0.8) -> Patch:
    """The points as a robot there sees them."""
    there = pose.inverse().matrix
    seen = world @ there[:3, :3].T.astype(np.float32) + there[:3, 3].astype(np.float32)
    found = Patch.of(seen, pose, class_id, score, frame, frame * SECOND)
    assert found is not None
    return found


POSES = [SE2(0.0, 0.0, 0.0), SE2(1.0, -1.0, 1.2), SE2(-2.0, 0.5, -2.9)]


def seen_from_all(world: NDArray[np.float32], class_id: int, score: float = 0.8) -> list[Patch]:
    return [patch(world, pose, class_id, frame, score) for frame, pose in enumerate(POSES)]


def only(found: list[Thing]) -> Thing:
    (one,) = found
    return one


@pytest.mark.parametrize("at", [(2.0, 1.0), (-3.0, -4.0)])
def test_a_table_seen_three_times_is_one_table(at: tuple[float, float]) -> None:
    """Footprint, place, height and witnesses are its own, wherever the robot stood; also where coordinates are < 0."""
    one = only(things(seen_from_all(box(*at, 1.2, 0.8, 0.75), TABLE), 2))
    assert one.class_id == TABLE
    assert one.middle == pytest.approx(at, abs=CELL_M)
    assert one.area_m2 == pytest.approx(1.2 * 0.8, abs=0.2)
    assert one.height_m == pytest.approx(0.75, abs=0.03)
    assert one.score == pytest.approx(0.8)
    assert one.frames == (0, 1, 2)
    assert (one.first_seen_nanos, one.last_seen_nanos) == (0, 2 * SECOND)
    x, y = one.footprint.T
    assert float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) > 0, "counter-clockwise"


def test_two_chairs_are_two_chairs() -> None:
    """Even side by side."""
    patches = seen_from_all(box(1.0, 0.0, 0.5, 0.5, 0.9), CHAIR) + seen_from_all(box(1.6, 0.0, 0.5, 0.5, 0.9), CHAIR)
    found = things(patches, 2)
    assert sorted(round(float(one.middle[0]), 1) for one in found) == [1.0, 1.6]


def test_parts_that_grow_together_are_one() -> None:
    """Left half, right half, then all of it."""
    left, right = box(1.0, 0.0, 0.6, 0.6, 0.7), box(1.6, 0.0, 0.6, 0.6, 0.7)
    whole = np.concatenate([left, right])
    parts = [left, right, whole, whole]
    found = things([patch(part, POSES[0], TABLE, frame) for frame, part in enumerate(parts)], 2)
    assert only(found).frames == (0, 1, 2, 3)
    assert only(found).area_m2 == pytest.approx(1.2 * 0.6, abs=0.15)


def test_what_was_seen_too_seldom_is_nothing() -> None:
    """Once, here; the same keyframe twice is once."""
    lonely = patch(box(1.0, 1.0, 0.5, 0.5, 0.5), POSES[0], CHAIR, 7)
    assert things([lonely, lonely], 2) == []
    assert len(things([lonely], 1)) == 1
    assert things([], 2) == []


def test_two_names_for_one_thing() -> None:
    """The one with more evidence stands; a lamp on a table is no other name of the table."""
    table, lamp = box(2.0, 1.0, 1.2, 0.8, 0.75), box(2.2, 1.1, 0.2, 0.2, 1.2)
    chairs = seen_from_all(table, CHAIR, 0.4)
    found = things([*seen_from_all(table, TABLE), *chairs, *seen_from_all(lamp, LAMP, 0.5)], 2)
    assert sorted(one.class_id for one in found) == [TABLE, LAMP]


def test_a_mask_that_spilled_over_once_does_not_widen() -> None:
    """One of eight views covers the floor behind as well."""
    table = box(2.0, 0.0, 1.0, 1.0, 0.7)
    spilled = np.concatenate([table, box(3.0, 0.0, 1.0, 1.0, 0.1)])
    patches = [patch(spilled if frame == 3 else table, POSES[0], TABLE, frame) for frame in range(8)]
    assert only(things(patches, 2)).area_m2 == pytest.approx(1.0, abs=0.15)


def test_single_pixels_make_no_patch() -> None:
    """A cell needs a few; a patch needs a cell."""
    few = np.array([[1.0, 0.0, 0.3], [2.0, 0.0, 0.3], [3.0, math.pi, 0.3]], np.float32)
    assert Patch.of(few, POSES[0], CHAIR, 0.9, 0, 0) is None
    assert Patch.of(np.zeros((0, 3), np.float32), POSES[0], CHAIR, 0.9, 0, 0) is None
