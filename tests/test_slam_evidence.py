"""The map from a pose track: what a cell is called, how sure, and that nothing is lost on the way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.slam.evidence import SNAPSHOT_HALF, Evidence, sightings

SIDE, CELL_M = 31, 0.1
CHAIR, TABLE = FIRST_OBJECT, FIRST_OBJECT + 1
HERE = SE2(0.05, 0.05, 0.0)
"""The robot in the middle of cell (0, 0), so that observation cell (15 + i, 15 + j) is map cell (i, j)."""


def planes_with(**cells: list[tuple[int, int, float]]) -> Planes:
    """Planes from (ix, iy, weight) lists by class, seen from the middle."""
    planes = np.zeros((FIRST_OBJECT + 2, SIDE, SIDE), np.float32)
    ids = {"floor": FREE_FLOOR, "obstacle": OBSTACLE, "chair": CHAIR, "table": TABLE}
    for name, entries in cells.items():
        for ix, iy, weight in entries:
            planes[ids[name], iy + SIDE // 2, ix + SIDE // 2] = weight
    planes[UNOBSERVED] = ~planes[1:].any(0)
    return planes


def cell(evidence: Evidence, ix: int, iy: int) -> dict[str, float]:
    """The row of one cell."""
    rows = evidence.cells()
    (index,) = np.flatnonzero((rows["ix"] == ix) & (rows["iy"] == iy))
    return {name: column[index].item() for name, column in rows.items()}


@pytest.mark.parametrize(
    ("chair_views", "other", "expected"),
    [
        (6, "floor", CHAIR),
        (4, "floor", CHAIR),
        (3, "floor", FREE_FLOOR),
        (4, "obstacle", CHAIR),
        (2, "obstacle", OBSTACLE),
    ],
)
def test_a_chair_in_enough_of_ten_views_is_a_chair(chair_views: int, other: str, expected: int) -> None:
    """And one in few of many views is the misfire of a detector."""
    evidence = Evidence(CELL_M, SIDE)
    for view in range(10):
        seen = planes_with(**{"chair" if view < chair_views else other: [(3, 0, 1.0)]})
        evidence.add(seen, HERE, stamp_nanos=100 + view)
    row = cell(evidence, 3, 0)
    assert row["class_id"] == expected
    assert row["views"] == 10
    assert row["hits"] == (chair_views if expected == CHAIR else 10 - chair_views)
    assert (row["first_seen_nanos"], row["last_seen_nanos"]) == (100, 109)


def test_probability_is_the_documented_formula() -> None:
    """Six chairs, four floors at 0.3 m: 2 E / (1 + sum s E) with the weight of that distance."""
    evidence = Evidence(CELL_M, SIDE)
    for view in range(10):
        evidence.add(planes_with(**{"chair" if view < 6 else "floor": [(3, 0, 1.0)]}), HERE, view)
    weight = 1 / (1 + 0.3**2 / 9)
    expected = 12 * weight / (1 + 12 * weight + 4 * weight)
    assert cell(evidence, 3, 0)["probability"] == pytest.approx(expected, rel=1e-5)


def test_far_sights_count_less() -> None:
    """One obstacle seen near outweighs two floors seen from far away."""
    evidence = Evidence(0.5, SIDE)
    floor = planes_with(floor=[(12, 0, 1.0)])  # 6 m ahead
    for stamp in (1, 2):
        evidence.add(floor, SE2(0.25, 0.25, 0.0), stamp)
    evidence.add(planes_with(obstacle=[(2, 0, 1.0)]), SE2(5.25, 0.25, 0.0), 3)
    assert cell(evidence, 12, 0)["class_id"] == OBSTACLE


def test_within_a_keyframe_objects_cover_obstacles_cover_floor() -> None:
    """A chair's cell is no obstacle, an obstacle's cell no floor, in the same look."""
    spots = [(0, 0, 1.0), (1, 0, 1.0), (2, 0, 1.0)]
    sights = sightings(planes_with(floor=spots, obstacle=spots[:2], chair=spots[:1]))
    row = {name: sights[name][SIDE // 2, SIDE // 2 : SIDE // 2 + 3].tolist() for name in (CHAIR, OBSTACLE, FREE_FLOOR)}
    assert row == {CHAIR: [True, False, False], OBSTACLE: [False, True, False], FREE_FLOOR: [False, False, True]}


def test_a_big_sofa_is_seen_though_each_of_its_cells_weighs_little() -> None:
    """A weight of 0.005 a cell, beside a small table of the same class with 0.25 a cell."""
    sofa = [(x, y, 0.005) for x in range(-14, 6) for y in range(10)]
    small = [(x, y, 0.25) for x in (10, 11) for y in (-10, -9)]
    seen = sightings(planes_with(table=sofa + small))[TABLE]
    assert np.count_nonzero(seen) == 204


def test_spill_of_a_mask_is_not_seen() -> None:
    """A few pixels on the wall behind the chair, and the ragged edge of the chair itself."""
    chair = [(x, y, 0.04) for x in range(5) for y in range(4)]
    edge, spill = [(5, 0, 0.003)], [(10, 0, 0.02), (10, 1, 0.02)]
    seen = sightings(planes_with(chair=chair + edge + spill))[CHAIR]
    assert np.count_nonzero(seen) == 20


@settings(max_examples=25, deadline=None)
@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-math.pi, math.pi))
def test_a_turned_observation_leaves_no_holes_and_goes_where_it_belongs(x: float, y: float, heading: float) -> None:
    """Every map cell whose middle lies within the seen square is seen, and no other."""
    floor = planes_with(floor=[(i, j, 1.0) for i in range(-3, 12) for j in range(-5, 6)])
    evidence, pose = Evidence(CELL_M, SIDE), SE2(x, y, heading)
    evidence.add(floor, pose, 1)
    rows = evidence.cells()
    left, low = math.floor(x / CELL_M) - 25, math.floor(y / CELL_M) - 25
    ix, iy = (axis.ravel() for axis in np.meshgrid(np.arange(left, left + 50), np.arange(low, low + 50)))
    inside = pose.inverse().apply(np.stack([ix + 0.5, iy + 0.5], 1) * CELL_M) / CELL_M
    clear = np.minimum.reduce([inside[:, 0] + 3.5, 11.5 - inside[:, 0], inside[:, 1] + 5.5, 5.5 - inside[:, 1]])
    found = set(zip(rows["ix"].tolist(), rows["iy"].tolist(), strict=True))
    sure = {(int(i), int(j)) for i, j in zip(ix[clear > 1e-6], iy[clear > 1e-6], strict=True)}
    possible = {(int(i), int(j)) for i, j in zip(ix[clear > -1e-6], iy[clear > -1e-6], strict=True)}
    assert sure <= found <= possible


def test_the_map_grows_across_tiles_in_any_direction() -> None:
    """Rows come by iy, then ix, whatever the order of the keyframes."""
    evidence = Evidence(CELL_M, SIDE)
    for number, (x, y) in enumerate([(50.05, -20.95), (-6.35, -6.35), (6.45, 0.05)]):
        evidence.add(
            planes_with(floor=[(i, j, 1.0) for i in range(-15, 16) for j in range(-15, 16)]), SE2(x, y, 0.0), number
        )
    rows = evidence.cells()
    assert len(rows["ix"]) == 3 * SIDE * SIDE
    keys = list(zip(rows["iy"].tolist(), rows["ix"].tolist(), strict=True))
    assert keys == sorted(set(keys))
    assert rows["ix"].min() == -64 - 15
    assert rows["iy"].min() == -210 - 15


def test_a_pose_beyond_all_maps_is_refused() -> None:
    """A broken odometry must not cost the map or overflow its indices."""
    evidence = Evidence(CELL_M, SIDE)
    assert not evidence.add(planes_with(floor=[(0, 0, 1.0)]), SE2(1e12, 0.0, 0.0), 1)
    assert not evidence.add(planes_with(floor=[(0, 0, 1.0)]), SE2(math.nan, 0.0, 0.0), 1)
    assert len(evidence.cells()["ix"]) == 0


@pytest.mark.parametrize("cell_m", [0.1, 0.001])
def test_the_map_outlives_a_teleport(cell_m: float) -> None:
    """A robot that odometry throws off any map: what was seen before stays, the snapshot there is empty."""
    evidence = Evidence(cell_m, SIDE)
    seen = planes_with(floor=[(0, 0, 1.0)])
    assert evidence.add(seen, SE2(0.5 * cell_m, 0.5 * cell_m, 0.0), 1)
    for x_m in (1e6, 9.9e6, 1e9, 1e300, math.inf, math.nan):
        away = SE2(x_m, -x_m, 0.1)
        assert evidence.add(seen, away, 2) == (x_m < min(1e7, cell_m * 2**30))
        assert evidence.snapshot(away).cells.size <= 1
    cells = evidence.cells()
    assert (cells["ix"].dtype, cells["ix"].min()) == (np.int32, 0)


def test_a_snapshot_of_very_many_classes_stays_within_its_numbers() -> None:
    """It shows less of the map rather than wrong cells."""
    evidence, planes = Evidence(CELL_M, 3), np.zeros((3000, 3, 3), np.float32)
    planes[-1, 1, 1] = 1.0
    for x_m in (-65.0, -45.0, 0.05, 45.0, 65.0):
        for y_m in (-65.0, 0.05, 65.0):
            evidence.add(planes, SE2(x_m, y_m, 0.0), 1)
    snapshot = evidence.snapshot(SE2(0.0, 0.0, 0.0))
    assert snapshot.cells.size == 3
    assert snapshot.cells.max() < 2**32
    assert 3000 * snapshot.rows * snapshot.columns <= 2**32


def test_snapshot_holds_the_same_cells() -> None:
    """As sparse planes over the bounding box; far parts of a torn map stay out of it."""
    evidence = Evidence(CELL_M, SIDE)
    evidence.add(planes_with(floor=[(1, 0, 1.0)], chair=[(4, 2, 1.0)]), HERE, 1)
    snapshot = evidence.snapshot(HERE)
    assert (snapshot.rows, snapshot.columns) == (3, 4)
    assert (snapshot.origin_x_m, snapshot.origin_y_m) == (pytest.approx(0.1), 0.0)
    assert snapshot.cells.tolist() == [FREE_FLOOR * 12, CHAIR * 12 + 2 * 4 + 3]
    far = SE2(HERE.x_m + (SNAPSHOT_HALF + 20) * CELL_M, 0.05, 0.0)
    assert evidence.snapshot(far).cells.size == 0


def test_restored_evidence_goes_on_bit_for_bit() -> None:
    """Same cells and same state, after any number of keyframes."""
    looks = [planes_with(chair=[(3, 1, 0.5), (4, 1, 0.5)], floor=[(1, y, 1.0) for y in range(9)])] * 6
    poses = [SE2(0.7 * i, 0.1 * i, 0.3 * i) for i in range(6)]
    straight, first, second = (Evidence(CELL_M, SIDE) for _ in range(3))
    for i in range(6):
        straight.add(looks[i], poses[i], i)
    for i in range(3):
        first.add(looks[i], poses[i], i)
    second.restore(first.state())
    for i in range(3, 6):
        second.add(looks[i], poses[i], i)
    assert second.state() == straight.state()
    for name, column in straight.cells().items():
        np.testing.assert_array_equal(second.cells()[name], column)
