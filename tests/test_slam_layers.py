"""Occupancy and heights from depth: what stands in a room, what is free, and what nobody could know."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.slam.depth_sight import Columns, DepthImage, nearest_depth
from semslam.slam.exchange import occupancy_image
from semslam.slam.layer_picture import render_layers
from semslam.slam.layers import LayerCells, Layers
from semslam.slam.picture import Path
from tests.depth_world import Room, matrix

COLUMNS = Columns(0.05, 0.1, 1.5, 6.0)
FREE, OCCUPIED = 0.196, 0.65
BOX = ((1.5, -0.3, 0.0), (2.1, 0.3, 0.4))
BEFORE, BEHIND = SE2(0.0, 0.0, 0.0), SE2(3.2, 0.0, math.pi)


def room(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Room:
    """A room of 7 x 6 m with boxes in it."""
    corners = np.array(boxes, np.float64).reshape(-1, 2, 3)
    return Room(np.array([-3.5, -3.0, 0.0]), np.array([3.5, 3.0, 2.5]), corners)


def image(world: Room, pose: SE2, noise: np.random.Generator | None = None) -> DepthImage:
    """What a robot there sees."""
    view = world.view(matrix(pose), noise)
    return DepthImage(view.depth_m, view.fx, view.fy, view.cx, view.cy, view.robot_from_camera)


def layers_of(world: Room, poses: Sequence[SE2], columns: Columns = COLUMNS) -> LayerCells:
    """The layers of a drive through a room."""
    layers = Layers(columns)
    for pose in poses:
        assert layers.add(image(world, pose), pose)
    return layers.cells()


def within(cells: LayerCells, x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.bool_]:
    """Cells whose middles lie in a rectangle."""
    at_x, at_y = ((axis + 0.5) * cells.columns.cell_m for axis in (cells.ix, cells.iy))
    return np.asarray((at_x > x[0]) & (at_x < x[1]) & (at_y > y[0]) & (at_y < y[1]))


def test_a_box_seen_from_one_side() -> None:
    """It is occupied, as high as it is, the floor before it is free, and what lies behind it stays unknown."""
    cells = layers_of(room(BOX), [BEFORE])
    front = within(cells, (1.5, 1.55), (-0.25, 0.25))
    assert np.count_nonzero(front) == 10
    assert (cells.occupancy[front] > OCCUPIED).all()
    assert cells.top_m[front] == pytest.approx(0.4, abs=0.03)
    floor = within(cells, (0.9, 1.4), (-0.25, 0.25))
    assert np.count_nonzero(floor) == 100
    assert (cells.occupancy[floor] < FREE).all()
    assert np.nan_to_num(cells.floor_m[floor]) == pytest.approx(0.0, abs=0.03)
    assert np.isnan(cells.top_m[floor]).all()
    assert np.isnan(cells.occupancy[within(cells, (2.2, 3.2), (-0.2, 0.2))]).all()


def test_a_box_seen_from_two_sides() -> None:
    """What was unknown behind it is free, and the box is where it was."""
    cells = layers_of(room(BOX), [BEFORE, BEHIND])
    behind = within(cells, (2.2, 2.5), (-0.2, 0.2))
    assert np.count_nonzero(behind) == 48
    assert (cells.occupancy[behind] < FREE).all()
    for face in ((1.5, 1.55), (2.05, 2.1)):
        chosen = within(cells, face, (-0.25, 0.25))
        assert (cells.occupancy[chosen] > OCCUPIED).all()
        assert cells.top_m[chosen] == pytest.approx(0.4, abs=0.03)
    assert not (cells.occupancy[within(cells, (1.5, 2.1), (-0.3, 0.3))] < FREE).any()


def test_a_noisy_camera_sees_the_same() -> None:
    """Walls stand, floor is free, heights hold."""
    layers, random = Layers(COLUMNS), np.random.default_rng(0)
    for turn in range(8):
        pose = SE2(0.0, 0.0, 0.1 * (turn - 4))
        layers.add(image(room(BOX), pose, random), pose)
    cells = layers.cells()
    front = within(cells, (1.5, 1.55), (-0.25, 0.25))
    assert (cells.occupancy[front] > OCCUPIED).all()
    assert np.median(cells.top_m[front]) == pytest.approx(0.4, abs=0.03)
    floor = within(cells, (0.9, 1.4), (-0.5, 0.5))
    assert (cells.occupancy[floor] < FREE).mean() > 0.98
    assert cells.top_m[within(cells, (3.5, 3.55), (-1.0, 1.0))] == pytest.approx(1.5, abs=0.1)


def test_floor_under_a_table_is_floor_and_the_table_is_in_the_way() -> None:
    """A slab at 0.7 m: occupied, with its top; the floor beneath is told as well."""
    cells = layers_of(room(((1.5, -0.5, 0.66), (2.3, 0.5, 0.7))), [BEFORE, SE2(-1.0, 0.0, 0.0)])
    edge = within(cells, (1.5, 1.55), (-0.4, 0.4))
    assert (cells.occupancy[edge] > OCCUPIED).all()
    assert cells.top_m[edge] == pytest.approx(0.7, abs=0.04)
    beneath = within(cells, (1.6, 2.2), (-0.4, 0.4))
    assert np.nanmax(np.abs(cells.floor_m[beneath])) < 0.03
    assert np.count_nonzero(~np.isnan(cells.floor_m[beneath])) > 100
    assert not (cells.occupancy[beneath] < FREE).any()


def test_what_hangs_above_the_robot_or_lies_flat_is_no_obstacle() -> None:
    """A lamp at two metres and a rug of three centimetres; with other heights they are."""
    world = room(((1.5, -0.5, 1.7), (2.0, 0.5, 1.9)), ((1.4, -0.5, 0.0), (2.0, 0.5, 0.03)))
    poses = [BEFORE, SE2(-1.5, 0.0, 0.0)]
    there = (1.5, 1.95), (-0.45, 0.45)
    cells = layers_of(world, poses)
    assert (cells.occupancy[within(cells, *there)] < FREE).all()
    assert np.nanmedian(cells.floor_m[within(cells, *there)]) == pytest.approx(0.03, abs=0.02)
    tall = layers_of(world, poses, replace(COLUMNS, high_m=2.0))
    assert (tall.occupancy[within(tall, (1.5, 1.55), (-0.45, 0.45))] > OCCUPIED).all()
    flat = layers_of(world, poses, replace(COLUMNS, low_m=0.01))
    assert (flat.occupancy[within(flat, *there)] > OCCUPIED).any()


def test_somebody_who_walked_through_is_forgotten() -> None:
    """Three keyframes of a person, then views of the empty place."""
    somebody = ((1.5, -0.2, 0.0), (1.8, 0.2, 1.7))
    layers = Layers(COLUMNS)
    for _ in range(3):
        layers.add(image(room(somebody), BEFORE), BEFORE)
    there = (1.5, 1.55), (-0.15, 0.15)
    cells = layers.cells()
    assert (cells.occupancy[within(cells, *there)] > 0.9).all()
    for _ in range(6):
        layers.add(image(room(), BEFORE), BEFORE)
    cells = layers.cells()
    assert (cells.occupancy[within(cells, *there)] < FREE).all()
    assert np.isnan(cells.top_m[within(cells, *there)]).all()


def test_what_was_seen_as_often_as_seen_through_is_undecided() -> None:
    """Not unknown: whatever the evidence comes to, something was seen there."""
    there, somebody = (1.5, 1.55), ((1.5, -0.2, 0.0), (1.8, 0.2, 1.7))
    for seen, gone in ((3, 4), (2, 3), (1, 1), (4, 5)):
        layers = Layers(COLUMNS)
        for world in (*[room(somebody)] * seen, *[room()] * gone, *[room(somebody)] * seen):
            layers.add(image(world, BEFORE), BEFORE)
            cells = layers.cells()
            near = within(cells, there, (-0.15, 0.15))
            assert np.count_nonzero(near) == 6
            assert not np.isnan(cells.occupancy[near]).any()


def test_a_stray_pixel_makes_neither_an_obstacle_nor_a_height() -> None:
    """It is far from its neighbours; two that lie together are forgotten once others see through them."""
    layers = Layers(COLUMNS)
    clean = image(room(BOX), BEFORE)
    for pixels in (1, 2, 0, 0, 0):
        depth_m = clean.depth_m.copy()
        depth_m[30 : 30 + pixels, 80 : 80 + pixels] = 1.2
        layers.add(replace(clean, depth_m=depth_m), BEFORE)
        before = within(layers.cells(), (1.0, 1.4), (-0.2, 0.2))
        assert pixels == 2 or not (layers.cells().occupancy[before] > OCCUPIED).any()
    assert (layers.cells().occupancy[before] < FREE).all()


def test_missing_depth_says_nothing() -> None:
    """Zero, NaN, infinite or beyond the reach: no cell at all, neither free nor occupied; nor does it move others."""
    clean = image(room(BOX), BEFORE)
    for value in (0.0, math.nan, math.inf, -1.0, 50.0):
        layers = Layers(COLUMNS)
        assert layers.add(replace(clean, depth_m=np.full_like(clean.depth_m, value)), BEFORE)
        assert not np.count_nonzero(~np.isnan(layers.cells().occupancy)) or value == 50.0
    holes = []
    for value in (0.0, math.nan, math.inf):
        depth_m = clean.depth_m.copy()
        depth_m[::7] = value
        layers = Layers(COLUMNS)
        layers.add(replace(clean, depth_m=depth_m), BEFORE)
        holes.append(layers.cells())
    for other in holes[1:]:
        np.testing.assert_array_equal(other.occupancy, holes[0].occupancy)
        np.testing.assert_array_equal(other.top_m, holes[0].top_m)


def test_pictures_of_any_size() -> None:
    """Four times the pixels say the same but for their edges; a picture of one pixel does no harm."""
    small = image(room(BOX), BEFORE)
    large = DepthImage(
        small.depth_m.repeat(4, 0).repeat(4, 1), small.fx * 4, small.fy * 4, small.cx * 4 + 1.5, small.cy * 4 + 1.5,
        small.robot_from_camera,
    )  # fmt: skip
    both = []
    for picture in (small, large):
        layers = Layers(COLUMNS)
        layers.add(picture, BEFORE)
        cells = layers.cells()
        both.append({(x, y): p for x, y, p in zip(cells.ix, cells.iy, cells.occupancy, strict=True)})
    same = [abs(both[0][place] - both[1].get(place, math.nan)) < 0.01 for place in both[0] if both[0][place] > OCCUPIED]
    assert np.mean(same) > 0.8
    one = DepthImage(np.full((1, 1), 2.0, np.float32), 100.0, 100.0, 0.0, 0.0, small.robot_from_camera)
    assert Layers(COLUMNS).add(one, BEFORE)


def test_the_nearest_depth_of_blocks() -> None:
    """Half of a block without depth is unknown; what is left of a row that fills no block is left out."""
    depth_m = np.array([[1.0, 2.0, 0.0, 3.0, 9.0], [4.0, 0.0, math.nan, 0.0, 9.0]], np.float32)
    np.testing.assert_array_equal(nearest_depth(depth_m, 2), [[1.0, 0.0]])


def test_poses_far_apart_cost_no_memory() -> None:
    """A thousand kilometres between two keyframes; beyond any map, or no number, is refused."""
    picture = image(room(BOX), BEFORE)
    tracemalloc.start()
    layers = Layers(COLUMNS)
    for x_m in (0.0, 1e6, -1e6):
        assert layers.add(picture, SE2(x_m, x_m, 0.0))
    cells = layers.cells()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6
    assert np.ptp(cells.ix) == pytest.approx(2e6 / 0.05, rel=0.01)
    assert occupancy_image(cells, FREE, OCCUPIED, 205) is None
    for pose in (SE2(1e9, 0.0, 0.0), SE2(0.0, math.nan, 0.0), SE2(math.inf, 0.0, 0.0), SE2(0.0, 0.0, math.nan)):
        assert not layers.add(picture, pose)
    assert shown(cells).shape[0] < 2000


def test_a_camera_that_claims_to_see_everything_costs_no_memory() -> None:
    """A focal length of a hundredth of a pixel, from a camera info that nobody filled in, say."""
    tracemalloc.start()
    assert Layers(COLUMNS).add(replace(image(room(BOX), BEFORE), fx=0.01, fy=0.01), BEFORE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 500e6


def test_memory_does_not_grow_with_the_log() -> None:
    """The same place seen a hundred times takes what it took at first."""
    picture, sizes = image(room(BOX), BEFORE), []
    tracemalloc.start()
    layers = Layers(COLUMNS)
    for number in range(101):
        layers.add(picture, BEFORE)
        if number in (1, 100):
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert sizes[1] < 1.05 * sizes[0]


@pytest.mark.parametrize("cell_m", [0.02, 0.05, 0.2])
def test_any_cell(cell_m: float) -> None:
    """The area that is free is about the same; coarse cells leave some out beside the box."""
    cells = layers_of(room(BOX), [BEFORE, BEHIND], replace(COLUMNS, cell_m=cell_m))
    floor = within(cells, (0.8, 1.4), (-0.4, 0.4))
    assert np.count_nonzero(cells.occupancy[floor] < FREE) * cell_m**2 == pytest.approx(0.48, rel=0.2)


def test_no_room_for_obstacles_is_refused() -> None:
    """Both keys are named."""
    with pytest.raises(SemslamError) as caught:
        Columns(0.05, 1.5, 1.5, 6.0)
    assert "`export.min_obstacle_height_m`" in caught.value.text()
    assert "`export.max_obstacle_height_m`" in caught.value.text()


def test_the_map_server_picture() -> None:
    """Above the one threshold occupied, below the other free, between them and without any value unknown."""
    ix, iy = np.array([-3, -2, 0, 1, 2]), np.array([-2, -2, 1, 1, 1])
    occupancy = np.array([0.05, 0.9, 0.5, math.nan, 0.1])
    nothing, count = np.full(5, math.nan), np.ones(5, np.uint32)
    found = occupancy_image(LayerCells(ix, iy, occupancy, nothing, nothing, count, count, COLUMNS, 1), 0.196, 0.65, 205)
    assert found is not None
    picture, corner = found
    assert picture.tolist() == [[205, 205, 205, 205, 205, 254], [205] * 6, [205] * 6, [254, 0, 205, 205, 205, 205]]
    assert corner == pytest.approx((-0.15, -0.1))


def shown(cells: LayerCells) -> NDArray[np.uint8]:
    """The picture, read back."""
    path = Path(np.array([0.0, 1.0]), np.array([0.0, 0.5]))
    data = render_layers(cells, path, "a room", "estimator truth", (FREE, OCCUPIED))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return np.asarray(picture, np.uint8)


def test_the_picture_shows_both_layers() -> None:
    """Two panels beside each other and a legend; ink on the left, the colours of heights on the right."""
    picture = shown(layers_of(room(BOX), [BEFORE, BEHIND]))
    half = (picture.shape[1] - 316) // 2
    colourful = (picture.max(2).astype(int) - picture.min(2)) > 60
    assert np.count_nonzero(colourful[:, half : half * 2]) > np.count_nonzero(colourful[:, :half])
    assert picture.shape[1] > 1100
    empty = shown(Layers(COLUMNS).cells())
    assert empty.shape[1] > 1100


def test_paths_of_two_logs_are_not_joined() -> None:
    """No line leads from where the one ended to where the other began."""
    cells = layers_of(room(BOX), [BEFORE, BEHIND])
    x, y = np.array([-3.0, -3.0, 3.0, 3.0]), np.array([-2.0, 2.0, 2.0, -2.0])
    joined, apart = (
        cv2.imdecode(np.frombuffer(render_layers(cells, path, "two", "", (FREE, OCCUPIED)), np.uint8), 1)
        for path in (Path(x, y), Path(x, y, (2,)))
    )
    ink = [np.count_nonzero(np.abs(one.astype(int) - (106, 0, 214)).max(2) < 30) for one in (joined, apart)]
    assert ink[1] < 0.75 * ink[0]
