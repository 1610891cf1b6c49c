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
        (4, "floor", FREE_FLOOR),
        (3, "obstacle", CHAIR),
        (0, "obstacle", OBSTACLE),
    ],
)
def test_a_chair_in_enough_of_ten_views_is_a_chair(chair_views: int, other: str, expected: int) -> None:
    """And one in few of many views is the misfire of a detector, unless something stands there."""
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
    """Six chairs, four floors at 0.3 m: sums of weights to the power of 0.2, log odds, and classes that nobody saw."""
    evidence = Evidence(CELL_M, SIDE)
    for view in range(10):
        evidence.add(planes_with(**{"chair" if view < 6 else "floor": [(3, 0, 1.0)]}), HERE, view)
    weight = 1 / (1 + 0.3**2 / 9)
    chairs, floors = (6 * weight) ** 0.2, (4 * weight) ** 0.2
    chair = math.exp(-3.6 + 4.3 * chairs - 1.7 * floors)
    obstacle = math.exp(-1.5 - 0.9 * chairs - 3.7 * floors)
    unseen = 12 * math.exp(-3.6 - 0.6 * chairs - 1.7 * floors)
    assert cell(evidence, 3, 0)["probability"] == pytest.approx(chair / (chair + obstacle + 1 + unseen), rel=1e-5)


def test_far_sights_count_less() -> None:
    """A floor seen from far away is less surely one than a floor seen near."""
    probabilities = []
    for ahead in (2, 12):  # 1 m and 6 m
        evidence = Evidence(0.5, SIDE)
        evidence.add(planes_with(floor=[(ahead, 0, 1.0)]), SE2(0.25, 0.25, 0.0), 1)
        probabilities.append(cell(evidence, ahead, 0)["probability"])
    assert probabilities[0] > probabilities[1] > 0.5


def test_a_detector_of_many_classes_is_no_less_sure() -> None:
    """Planes of classes that were never seen change nothing."""
    few = planes_with(chair=[(3, 0, 1.0)])
    many = np.concatenate([few, np.zeros((78, SIDE, SIDE), np.float32)])
    told = []
    for planes in (few, many):
        evidence = Evidence(CELL_M, SIDE)
        evidence.add(planes, HERE, 1)
        told.append(cell(evidence, 3, 0))
    assert told[0] == told[1]


def ring(left: int, low: int, side: int) -> list[tuple[int, int, float]]:
    """Cells around a square."""
    cells = [(left + i, low + j) for i in range(side) for j in range(side)]
    return [(x, y, 1.0) for x, y in cells if x in (left, left + side - 1) or y in (low, low + side - 1)]


def inside(left: int, low: int, side: int) -> list[tuple[int, int, float]]:
    """Cells within that ring."""
    return [(x, y, 1.0) for x in range(left + 1, left + side - 1) for y in range(low + 1, low + side - 1)]


def seen_often(views: int, **cells: list[tuple[int, int, float]]) -> Evidence:
    """Evidence of the same look, so many times."""
    evidence = Evidence(CELL_M, SIDE)
    for view in range(views):
        evidence.add(planes_with(**cells), HERE, view)
    return evidence


def test_floor_between_the_legs_of_a_table_is_the_table() -> None:
    """Seen as floor every time, and told less surely than the rim; the floor beside it stays floor."""
    evidence = seen_often(5, table=ring(2, 2, 6), floor=[*inside(2, 2, 6), (9, 4, 1.0)])
    rim, middle, beside = (cell(evidence, x, 4) for x in (2, 4, 9))
    assert [row["class_id"] for row in (rim, middle, beside)] == [TABLE, TABLE, FREE_FLOOR]
    assert 0.5 < middle["probability"] < rim["probability"]
    assert (middle["hits"], middle["views"]) == (0, 5)


def test_maps_are_compared_by_what_was_seen() -> None:
    """There the floor between the legs is floor, and a chair in four of ten views of floor a chair."""
    seen = seen_often(5, table=ring(2, 2, 6), floor=inside(2, 2, 6)).seen()
    assert np.count_nonzero(seen["class_id"] == FREE_FLOOR) == 16
    assert np.count_nonzero(seen["class_id"] == TABLE) == 20
    for chair_views, expected in ((4, CHAIR), (3, FREE_FLOOR)):
        evidence = Evidence(CELL_M, SIDE)
        for view in range(10):
            evidence.add(planes_with(**{"chair" if view < chair_views else "floor": [(3, 0, 1.0)]}), HERE, view)
        assert evidence.seen()["class_id"].tolist() == [expected]
    assert Evidence(CELL_M, SIDE).seen()["ix"].size == 0


def test_the_hull_holds_across_tiles() -> None:
    """The same table astride the corner of four tiles gives the same cells."""
    away = -4 * CELL_M
    near, far = (Evidence(CELL_M, SIDE) for _ in range(2))
    planes = planes_with(table=ring(2, 2, 6), floor=inside(2, 2, 6))
    near.add(planes, SE2(HERE.x_m + 2.0, HERE.y_m + 2.0, 0.0), 1)
    far.add(planes, SE2(HERE.x_m + away, HERE.y_m + away, 0.0), 1)
    one, other = near.cells(), far.cells()
    assert one["class_id"].tolist() == other["class_id"].tolist() == [TABLE] * 36
    np.testing.assert_array_equal(one["probability"], other["probability"])


def test_what_stands_on_a_table_is_not_the_table() -> None:
    """Cells of another object within the hull stay its own."""
    evidence = seen_often(5, table=ring(2, 2, 6), chair=inside(2, 2, 6))
    assert cell(evidence, 4, 4)["class_id"] == CHAIR


def test_what_is_wider_than_a_tile_has_no_hull() -> None:
    """Shelves along two walls do not make the room a shelf."""
    evidence = Evidence(CELL_M, SIDE)
    for step in range(9):
        wall = [(x, 0, 1.0) for x in range(-5, 5)]
        evidence.add(planes_with(table=wall), SE2(HERE.x_m + step, HERE.y_m, 0.0), 1)
        evidence.add(planes_with(table=wall), SE2(HERE.x_m - 0.5, HERE.y_m + step + 0.5, math.pi / 2), 1)
    evidence.add(planes_with(floor=[(0, 0, 1.0)]), SE2(HERE.x_m + 1.0, HERE.y_m + 1.0, 0.0), 1)
    assert cell(evidence, 10, 10)["class_id"] == FREE_FLOOR


def test_cells_read_in_between_change_nothing() -> None:
    """Tiles are read again once they or their neighbours have changed: same cells as read once at the end."""
    often, once = (Evidence(CELL_M, SIDE) for _ in range(2))
    for step in range(8):
        planes, pose = planes_with(table=ring(2, 2, 6), floor=inside(2, 2, 9)), SE2(0.7 * step, -0.9 * step, 0.5 * step)
        for evidence in (often, once):
            evidence.add(planes, pose, step)
        often.cells()
    for name, column in once.cells().items():
        np.testing.assert_array_equal(often.cells()[name], column)


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
