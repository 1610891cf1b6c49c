"""Equation 1: from masks and depth to the observation map, on small scenes computed by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semslam.geometry.frames import FLU_FROM_OPTICAL, Matrix, rotation_from_vector
from semslam.geometry.grid import Planes
from semslam.geometry.projection import extent, flying, main_body, observe, points_in_robot, window
from semslam.labels import FREE_FLOOR, OBSTACLE, UNOBSERVED

CHAIR, TABLE, CLASSES = 3, 4, 5
GRID: dict[str, Any] = {"cell_m": 0.25, "side": 41, "floor_tolerance_m": 0.05, "max_height_m": 2.0, "min_pixels": 3}
CENTRE = 20


def mounted(height_m: float, pitch: float) -> Matrix:
    """robot_from_camera of a camera above the robot's origin, pitched nose down."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_vector((0.0, pitch, 0.0))
    matrix[2, 3] = height_m
    return np.asarray(matrix @ FLU_FROM_OPTICAL)


class Room:
    """Floor, a wall across at x = 3 m, and a box: x 1.5 to 2.0, y -0.25 to 0.5, 0.6 m high."""

    WIDTH, HEIGHT, FOCAL = 320, 240, 150.0
    BOX = np.array([[1.5, -0.25, 0.0], [2.0, 0.5, 0.6]])

    def __init__(self, height_m: float = 1.0, pitch: float = 0.3) -> None:
        self.robot_from_camera = mounted(height_m, pitch)
        rays = self.points(np.ones((self.HEIGHT, self.WIDTH), np.float32)).astype(np.float64)
        origin = self.robot_from_camera[:3, 3]
        rays = rays - origin  # z = 1 in the camera, so lengths are depths
        with np.errstate(divide="ignore", invalid="ignore"):
            floor = np.where(rays[..., 2] < 0, -height_m / rays[..., 2], np.inf)
            wall = np.where(rays[..., 0] > 0, 3.0 / rays[..., 0], np.inf)
            near, far = (self.BOX[0] - origin) / rays, (self.BOX[1] - origin) / rays
        enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
        self.box = (enter < leave) & (enter > 0) & (enter < np.minimum(floor, wall))
        self.depth_m = np.where(self.box, enter, np.minimum(floor, wall)).astype(np.float32)

    def points(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        return points_in_robot(depth_m, self.FOCAL, self.FOCAL, 159.5, 119.5, self.robot_from_camera)

    def observe(self, masks: NDArray[np.bool_] | None = None, ids: tuple[int, ...] = (CHAIR,)) -> Planes:
        chosen = self.box[None] if masks is None else masks
        return observe(chosen, np.array(ids), self.points(self.depth_m), self.depth_m > 0, CLASSES, **GRID)


def cell(x_m: float, y_m: float) -> tuple[int, int]:
    """(iy, ix) of a place in the robot frame."""
    return math.floor(y_m / GRID["cell_m"] + GRID["side"] / 2), math.floor(x_m / GRID["cell_m"] + GRID["side"] / 2)


def test_points_by_hand() -> None:
    """A pixel right of and below the centre of a camera 1 m up lies ahead, right and lower; no depth is no point."""
    depth = np.array([[0.0, 2.0, 2.0]], np.float32)
    points = points_in_robot(depth, 2.0, 2.0, 1.0, -0.5, mounted(1.0, 0.0))
    assert np.isnan(points[0, 0]).all()
    assert points[0, 1].tolist() == [2.0, 0.0, 0.5]
    assert points[0, 2].tolist() == [2.0, -1.0, 0.5]


def test_a_box_stands_in_its_cells() -> None:
    """The object plane is where the box is and nowhere else, and sums to 1."""
    planes = Room().observe()
    rows, columns = np.nonzero(planes[CHAIR])
    assert planes[CHAIR].sum() == pytest.approx(1.0, abs=1e-5)
    assert (rows.min(), columns.min()) == cell(1.5, -0.249)
    assert (rows.max(), columns.max()) == cell(1.99, 0.49)
    assert planes[TABLE].sum() == 0.0


def test_what_the_box_hides_is_unobserved() -> None:
    """Behind the box there is no floor to be seen, beside it there is; beyond the wall is nothing."""
    planes = Room(height_m=0.5, pitch=0.1).observe()
    behind, beside, beyond = cell(2.6, 0.1), cell(2.6, 1.2), cell(4.0, 0.0)
    assert planes[UNOBSERVED][behind] == 1.0
    assert planes[FREE_FLOOR][behind] == 0.0
    assert planes[FREE_FLOOR][beside] == 1.0
    assert planes[UNOBSERVED][beyond] == 1.0
    assert planes[UNOBSERVED][CENTRE, CENTRE] == 1.0
    assert planes[OBSTACLE][cell(3.01, 1.2)] == 1.0


def test_without_a_mask_the_box_is_an_obstacle() -> None:
    """What nobody detected still stands in the way."""
    room = Room()
    planes = room.observe(np.zeros((0, *room.box.shape), bool), ())
    assert planes[OBSTACLE][cell(1.51, 0.1)] == 1.0
    assert planes[CHAIR:].sum() == 0.0


@given(st.floats(0.0, 0.6))
@settings(max_examples=8, deadline=None)
def test_pitch_does_not_change_the_map(pitch: float) -> None:
    """A camera pitched down by up to 30 degrees gives the cells of a level one, wherever both of them look."""
    level, pitched = Room(pitch=0.0).observe(), Room(pitch=pitch).observe()
    seen = (level[UNOBSERVED] == 0) & (pitched[UNOBSERVED] == 0)
    assert seen.sum() > 40
    same = (level[:CHAIR] == pitched[:CHAIR]).all(axis=0) & ((level[CHAIR] > 0) == (pitched[CHAIR] > 0))
    assert same[seen].mean() > 0.9  # cells that a border cuts may differ by a pixel
    centre = [np.average(np.nonzero(p[CHAIR])[1], weights=p[CHAIR][np.nonzero(p[CHAIR])]) for p in (level, pitched)]
    assert centre[0] == pytest.approx(centre[1], abs=1.0)


def test_every_cell_is_exactly_something() -> None:
    """Unobserved means none of the others; floor and obstacle exclude each other; nothing leaves 0 to 1."""
    planes = Room().observe()
    others = planes[FREE_FLOOR : CHAIR + 2].sum(axis=0) > 0
    assert np.array_equal(planes[UNOBSERVED] == 0, others)
    assert not ((planes[FREE_FLOOR] > 0) & (planes[OBSTACLE] > 0)).any()
    assert planes.min() >= 0.0
    assert planes.max() <= 1.0
    assert set(np.unique(planes[: OBSTACLE + 1])) == {0.0, 1.0}


def flat_scene(xs: list[float], ys: list[float], zs: list[float]) -> NDArray[np.float32]:
    """One row of pixels at these places."""
    return np.stack([xs, ys, zs], axis=-1).astype(np.float32)[None]


def test_fractions_by_hand() -> None:
    """Four of five usable pixels in one cell and one in the next; the sixth has no depth and does not count."""
    points = flat_scene([1.02, 1.05, 1.08, 1.11, 1.15, 0.0], [0.0] * 6, [0.5] * 6)
    valid = np.array([[True] * 5 + [False]])
    mask = np.ones((1, 1, 6), bool)
    planes = observe(mask, np.array([CHAIR]), points, valid, CLASSES, **GRID)
    assert planes[CHAIR][cell(1.0, 0.0)] == pytest.approx(0.8)
    assert planes[CHAIR][cell(1.15, 0.0)] == pytest.approx(0.2)
    assert np.count_nonzero(planes[CHAIR]) == 2


def test_instances_of_a_class_add_and_are_capped() -> None:
    """Two chairs in one cell make 1, a table there stays its own plane."""
    points = flat_scene([1.0, 1.01, 1.02, 1.03], [0.0] * 4, [0.5] * 4)
    masks = np.array([[[True, True, False, False]], [[False, False, True, False]], [[False, False, False, True]]])
    planes = observe(masks, np.array([CHAIR, CHAIR, TABLE]), points, np.ones((1, 4), bool), CLASSES, **GRID)
    assert planes[CHAIR][cell(1.0, 0.0)] == 1.0
    assert planes[TABLE][cell(1.0, 0.0)] == 1.0


def test_part_of_an_object_beyond_the_grid_counts_in_its_size() -> None:
    """Half a sofa in the grid weighs a half."""
    edge = GRID["cell_m"] * GRID["side"] / 2
    points = flat_scene([edge - 0.02, edge - 0.01, edge + 0.01, edge + 0.02], [0.0] * 4, [0.5] * 4)
    planes = observe(np.ones((1, 1, 4), bool), np.array([CHAIR]), points, np.ones((1, 4), bool), CLASSES, **GRID)
    assert planes[CHAIR].sum() == pytest.approx(0.5)


def test_evidence_and_heights() -> None:
    """Two pixels are too few; below 5 cm is floor, lamps above 2 m are nothing, holes in the floor neither."""
    heights = {0.0: FREE_FLOOR, 0.04: FREE_FLOOR, -0.04: FREE_FLOOR, 0.06: OBSTACLE, 2.5: UNOBSERVED, -0.3: UNOBSERVED}
    for height, expected in heights.items():
        for pixels in (2, 3):
            points = flat_scene([1.0] * pixels, [0.0] * pixels, [height] * pixels)
            masks = np.zeros((0, 1, pixels), bool)
            planes = observe(masks, np.zeros(0, int), points, np.ones((1, pixels), bool), CLASSES, **GRID)
            assert planes[expected if pixels == 3 else UNOBSERVED][cell(1.0, 0.0)] == 1.0


def test_a_sloppy_mask_does_not_paint_the_wall() -> None:
    """A mask grown over its object's outline leaves the wall behind to be an obstacle, not a chair."""
    room = Room(height_m=0.5, pitch=0.0)
    rows, columns = np.nonzero(room.box)
    box = np.zeros((1, *room.box.shape), bool)
    box[0, rows.min() - 12 : rows.max() - 5, columns.min() - 12 : columns.max() + 12] = True
    planes = room.observe(box)
    assert planes[CHAIR][:, cell(2.9, 0.0)[1] :].sum() == 0.0
    assert planes[OBSTACLE][cell(3.01, -0.3)] == 1.0
    assert planes[CHAIR][:, : cell(2.2, 0.0)[1]].sum() == pytest.approx(1.0, abs=1e-5)


def test_mixed_pixels_hang_nowhere() -> None:
    """Pixels between an object and the wall behind it are dropped; the edges on either side stay."""
    room = Room()
    depth = room.depth_m.copy()
    outline = room.box[:, 1:-1] & ~room.box[:, 2:]  # right edge of the box
    rows, columns = np.nonzero(outline)
    depth[rows, columns + 2] = 0.5 * (depth[rows, columns + 1] + depth[rows, columns + 3])
    clear = np.abs(depth[rows, columns + 1] - depth[rows, columns + 3]) > 0.6
    found = flying(room.points(depth), depth > 0)
    assert clear.sum() > 20
    assert found[rows[clear], columns[clear] + 2].mean() > 0.9
    assert not found[rows, columns + 1].any()
    assert found.sum() <= 1.1 * len(rows)
    args = room.points(depth), depth > 0
    planes = observe(np.zeros((0, *depth.shape), bool), np.zeros(0, int), *args, CLASSES, **GRID)
    assert planes[OBSTACLE][:, cell(2.3, 0.0)[1] : cell(2.7, 0.0)[1] + 1].sum() == 0.0


def test_a_floor_seen_flat_is_no_edge() -> None:
    """At a grazing view neighbouring floor pixels lie far apart, and count all the same."""
    rows = np.arange(121, 240, dtype=np.float32)[:, None]
    depth = np.repeat(0.5 * 150.0 / (rows - 119.5), 320, axis=1)
    depth[depth > 6.0] = 0.0
    depth = np.concatenate([np.zeros((121, 320), np.float32), depth.astype(np.float32)])
    points = points_in_robot(depth, 150.0, 150.0, 159.5, 119.5, mounted(0.5, 0.0))
    near = (depth > 0) & (depth < 3.0)
    assert not flying(points, depth > 0)[near].any()


def test_the_main_body_of_a_mask() -> None:
    """A long table stays whole; what lies beyond a gap is cut off, in front as well as behind."""
    table = np.arange(1.5, 3.5, 0.02).tolist()
    body = main_body(np.array([0.5] * 5 + table + [4.2] * 9, np.float32))
    assert body.tolist() == [False] * 5 + [True] * len(table) + [False] * 9
    assert main_body(np.zeros(0, np.float32)).tolist() == []


def test_extent_ignores_stray_points() -> None:
    """2nd to 98th percentile; nothing without a point."""
    line = np.zeros((101, 3), np.float32)
    line[:, 0] = np.arange(101)
    line[100, 2] = 50.0
    span = extent(line)
    assert span is not None
    assert span[0].tolist() == [2.0, 0.0, 0.0]
    assert span[1].tolist() == [98.0, 0.0, 0.0]
    assert extent(np.full((4, 3), np.nan, np.float32)) is None
    assert extent(np.zeros((0, 3), np.float32)) is None


@given(st.integers(1, 120), st.integers(0, 2**32 - 1))
def test_extent_is_the_quantile_of_numpy(points: int, seed: int) -> None:
    """To the last bit, for any number of points, in whatever order they lie in memory."""
    cloud = np.random.default_rng(seed).normal(size=(3, points)).astype(np.float32)
    expected = np.quantile(cloud.astype(np.float64), (0.02, 0.98), axis=1)
    for given_points in (cloud.T, np.ascontiguousarray(cloud.T)):
        span = extent(given_points)
        assert span is not None
        assert np.array_equal(span, expected)


def test_the_window_of_a_mask() -> None:
    """The rows and columns of its pixels, and nothing for a mask without any."""
    mask = np.zeros((6, 8), bool)
    assert mask[window(mask)].size == 0
    mask[2, 3] = mask[4, 7] = True
    assert window(mask) == (slice(2, 5), slice(3, 8))
    assert window(np.ones((6, 8), bool)) == (slice(0, 6), slice(0, 8))
