"""The equations of the paper, each against a slow loop written from the text, and against ONNX Runtime."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tracemalloc

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from semslam.geometry.frames import SE2
from semslam.labels import FIRST_OBJECT
from semslam.models import product
from semslam.slam import paper, quarter_turns
from semslam.slam.paper import PoseGrid, rotate_observation

GRID = PoseGrid(headings=8, side=9, cell_m=0.3)
ANGLES = st.floats(-math.pi + 1e-6, math.pi)


def random_planes(shape: tuple[int, ...], seed: int = 0, density: float = 1.0) -> NDArray[np.float32]:
    random = np.random.default_rng(seed)
    return (random.random(shape) * (random.random(shape) < density)).astype(np.float32)


def slow_rotation(plane: NDArray[np.float32], angle: float) -> NDArray[np.float64]:
    """Bilinear look-up, cell by cell: the rotated view at p shows what the robot sees at R(-angle) p."""
    side = len(plane)
    middle, result = side // 2, np.zeros((side, side))
    for y in range(side):
        for x in range(side):
            dx, dy = x - middle, y - middle
            u = math.cos(angle) * dx + math.sin(angle) * dy + middle
            v = -math.sin(angle) * dx + math.cos(angle) * dy + middle
            for j in (math.floor(v), math.floor(v) + 1):
                for i in (math.floor(u), math.floor(u) + 1):
                    if 0 <= i < side and 0 <= j < side:
                        result[y, x] += plane[j, i] * (1 - abs(u - i)) * (1 - abs(v - j))
    return result


def slow_scores(rotated: NDArray[np.float32], world: NDArray[np.float32]) -> NDArray[np.float64]:
    """Equation 2 as a sum over everything, object classes only."""
    headings, _, side, _ = rotated.shape
    _, rows, columns = world.shape
    reach, scores = side // 2, np.zeros((headings, rows, columns))
    for y in range(rows):
        for x in range(columns):
            for i in range(side):
                for j in range(side):
                    v, u = y + i - reach, x + j - reach
                    if 0 <= v < rows and 0 <= u < columns:
                        scores[:, y, x] += rotated[:, FIRST_OBJECT:, i, j] @ world[FIRST_OBJECT:, v, u]
    return scores


def slow_placing(rotated: NDArray[np.float32], field: NDArray[np.float32]) -> NDArray[np.float64]:
    """Equation 6 as a sum over everything: every pose bin stamps its rotated observation, weighted."""
    headings, classes, side, _ = rotated.shape
    _, rows, columns = field.shape
    reach, placed = side // 2, np.zeros((classes, rows, columns))
    for r in range(headings):
        for y in range(rows):
            for x in range(columns):
                for i in range(side):
                    for j in range(side):
                        v, u = y + i - reach, x + j - reach
                        if 0 <= v < rows and 0 <= u < columns:
                            placed[:, v, u] += field[r, y, x] * rotated[r, :, i, j]
    return placed


def test_rotation_equals_cell_by_cell_interpolation() -> None:
    """Every heading, every class."""
    planes = random_planes((4, 7, 7))
    rotated = paper.rotate_observation(planes, 12)
    for r in range(12):
        for index in range(4):
            np.testing.assert_allclose(rotated[r, index], slow_rotation(planes[index], math.tau * r / 12), atol=1e-6)


def test_what_is_ahead_lies_left_on_the_map_after_a_quarter_turn() -> None:
    """Heading +90 degrees looks along +y, that is to higher rows."""
    planes = np.zeros((4, 7, 7), np.float32)
    planes[3, 3, 5] = 1.0  # two cells ahead
    rotated = paper.rotate_observation(planes, 4)
    assert rotated[1, 3, 5, 3] == pytest.approx(1.0)
    assert rotated[1].sum() == pytest.approx(1.0)


def test_heading_zero_is_the_observation_itself() -> None:
    """Bit for bit, because the code tells absent classes by it."""
    planes = random_planes((5, 9, 9), density=0.3)
    np.testing.assert_array_equal(paper.rotate_observation(planes, 10)[0], planes)


@pytest.mark.parametrize("headings", [1, 4, 6, 8, 12])
def test_headings_a_quarter_turn_apart_are_quarter_turns(headings: int) -> None:
    """Bit for bit, because correlating and placing rely on it; other numbers of headings work as well."""
    rotated = paper.rotate_observation(random_planes((4, 7, 7), density=0.4), headings)
    if headings % 4 == 0:
        turned = np.rot90(rotated, -1, (2, 3))
        np.testing.assert_array_equal(np.roll(rotated, -headings // 4, 0), turned)
    assert rotated.shape == (headings, 4, 7, 7)


@pytest.mark.parametrize("side", [1, 3, 7])
def test_orbits_hold_every_cell_once(side: int) -> None:
    """Places in a circle, a quarter turn apart; the centre's four places share its value."""
    cells, shares = quarter_turns.orbits(side, 4)
    weights = np.zeros(side * side)
    for place in cells:
        np.add.at(weights, place, shares)
    np.testing.assert_array_equal(weights, np.ones(side * side))
    np.testing.assert_array_equal(quarter_turns.turned_cells(side)[1][cells[:3]], cells[1:])


@pytest.mark.parametrize("turns", [1, 4])
def test_products_in_orbits_are_a_cyclic_correlation(turns: int) -> None:
    """Exactly, for whole numbers, and with fewer products than the definition."""
    random = np.random.default_rng(0)
    left, right = (random.integers(-99, 99, shape).astype(np.float64) for shape in ((turns, 5, 6), (turns, 6, 7)))
    expected = [sum(left[(j + q) % turns] @ right[j] for j in range(turns)) for q in range(turns)]
    calls: list[int] = []

    def counted(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
        calls.append(1)
        return one @ other

    np.testing.assert_array_equal(quarter_turns.turned_products(left, right, counted), expected)
    assert len(calls) == {1: 1, 4: 5}[turns]


def test_the_product_of_matrices_is_that() -> None:
    """Any sizes and layouts; the network that computes it is a sound ONNX file."""
    onnx.checker.check_model(onnx.load_from_string(product._model()), full_check=True)
    left, right = random_planes((3, 4, 5))[:, :, 2], random_planes((7, 4)).T
    np.testing.assert_allclose(product.float_product(left, right), left @ right, rtol=1e-6)


def close_to(scores: NDArray[np.float32], expected: NDArray[np.floating]) -> None:
    """Equal to a step of the scores."""
    np.testing.assert_allclose(scores, expected, atol=paper.score_step(float(expected.max())))


@pytest.mark.parametrize("headings", [1, 6, 8])
@pytest.mark.parametrize("density", [1.0, 0.15])
def test_correlation_equals_the_sum_over_everything(density: float, headings: int) -> None:
    """Equation 2: no flip, zero padding, object classes only; sparse and dense, with and without quarter turns."""
    rotated = paper.rotate_observation(random_planes((6, 5, 5), 1, density), headings)
    world = random_planes((6, 9, 11), 2, density)
    close_to(paper.correlate(rotated, world), slow_scores(rotated, world))


def test_what_was_not_rotated_is_refused() -> None:
    """Anything else would get wrong scores without a word."""
    planes, world, field = random_planes((8, 4, 5, 5)), random_planes((4, 9, 9)), random_planes((8, 9, 9))
    with pytest.raises(ValueError, match="rotate_observation"):
        paper.correlate(planes, world)
    with pytest.raises(ValueError, match="rotate_observation"):
        paper.place_observation(planes, field, (slice(0, 9), slice(0, 9)))


def test_scores_are_zero_where_nothing_meets() -> None:
    """Exactly, whatever the other headings find there: a flat field must be flat."""
    planes, world = np.zeros((4, 11, 11), np.float32), np.zeros((4, 21, 21), np.float32)
    planes[3, 5, 8:], world[3, 2:4, 2:9] = 0.3, 0.7
    rotated = paper.rotate_observation(planes, 36)
    scores, expected = paper.correlate(rotated, world), slow_scores(rotated, world)
    assert not scores[expected < 1e-12].any()
    assert (scores[expected > 1e-3] > 0).all()


@pytest.mark.parametrize("weight", [1e-9, 1e-25, 1e-38])
def test_traces_are_no_match(weight: float) -> None:
    """What the leaky average leaves of an object seen long ago counts for nothing, and breaks nothing."""
    planes, world = np.zeros((4, 5, 5), np.float32), np.zeros((4, 9, 9), np.float32)
    planes[3, 2, 2], world[3, 4, 4] = 0.02, weight
    assert not paper.correlate(paper.rotate_observation(planes, 8), world).any()


def test_rounding_does_not_choose_between_equal_poses() -> None:
    """A map that looks the same from four sides: whichever of the four poses is near is the best one, with its mode."""
    world = random_planes((13, 21, 21), 5, 0.3)
    world = np.sum([np.rot90(world, k, (1, 2)) for k in range(4)], axis=0, dtype=np.float32) / 4
    planes = world[:, 5:16, 5:16].copy()
    scores = paper.correlate(paper.rotate_observation(planes, 72), world)
    grid = PoseGrid(72, 21, 0.3)
    for quarters in range(4):
        near = SE2(0.1, -0.1, math.tau * quarters / 4 + 0.05)
        assert paper.best_bin(scores, near, grid) == (18 * quarters, 10, 10)


@pytest.mark.parametrize("patch_bytes", [0, 5_000, 30_000])
def test_correlation_in_pieces_gives_the_same_scores(monkeypatch: pytest.MonkeyPatch, patch_bytes: int) -> None:
    """A limit of memory changes no score by more than a step: single rows and neighbours, a few, or all at once."""
    rotated = rotate_observation(random_planes((6, 7, 7), 1, 0.4), 12)
    world = random_planes((6, 19, 23), 2, 0.3)
    whole = paper.correlate(rotated, world)
    monkeypatch.setattr(paper, "PATCH_BYTES", patch_bytes)
    close_to(paper.correlate(rotated, world), whole)


def test_a_large_map_is_correlated_in_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """The neighbourhoods of a map of 301 x 301 cells, 700 MB together, are never gathered at once."""
    rotated, world = random_planes((2, 4, 31, 31), 1), random_planes((4, 301, 301), 2, 0.1)
    monkeypatch.setattr(paper, "PATCH_BYTES", 4 << 20)
    tracemalloc.start()
    paper.correlate(rotated, world)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 << 20


def onnx_convolution(image: NDArray[np.float32], kernels: NDArray[np.float32], pad: int) -> NDArray[np.float32]:
    """ONNX Runtime's Conv, which is a cross-correlation, with run-time weights."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    node = helper.make_node("Conv", ["x", "w"], ["y"], pads=[pad] * 4)
    inputs = [helper.make_tensor_value_info(name, kind, [None] * 4) for name in "xw"]
    graph = helper.make_graph([node], "conv", inputs, [helper.make_tensor_value_info("y", kind, [None] * 4)])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    result: NDArray[np.float32] = session.run(None, {"x": image, "w": kernels})[0]
    return result


def test_correlation_equals_onnx_runtime() -> None:
    """A second witness, at the paper's sizes."""
    rotated = paper.rotate_observation(random_planes((12, 11, 11), 3, 0.3), 36)
    world = random_planes((12, 33, 33), 4, 0.3)
    expected = onnx_convolution(world[None, FIRST_OBJECT:], np.ascontiguousarray(rotated[:, FIRST_OBJECT:]), 5)[0]
    close_to(paper.correlate(rotated, world), expected)


def test_reserved_classes_do_not_count() -> None:
    """Unobserved, free floor and obstacle say nothing about the pose in the paper."""
    rotated = paper.rotate_observation(random_planes((4, 5, 5), 5), 8)
    world = random_planes((4, 9, 9), 6)
    world[FIRST_OBJECT:] = 0.0
    assert not paper.correlate(rotated, world).any()


def test_softmax_is_joint_and_knows_its_entropy() -> None:
    """One distribution over all R H W bins; flat scores give log(R H W) nats."""
    scores = np.random.default_rng(0).normal(size=(4, 5, 6)) * 3
    field, entropy = paper.visual_field(scores, 0.7)
    expected = np.exp(scores / 0.7) / np.exp(scores / 0.7).sum()
    np.testing.assert_allclose(field, expected, rtol=1e-5)
    assert entropy == pytest.approx(-(expected * np.log(expected)).sum(), rel=1e-5)
    flat, flat_entropy = paper.visual_field(np.zeros((4, 5, 6)), 1.0)
    assert flat_entropy == pytest.approx(math.log(120))
    assert np.unique(flat).size == 1


def test_equal_scores_go_to_the_nearest_bin() -> None:
    """Position first, heading second; the highest score wins whatever its distance."""
    scores = np.zeros((8, 9, 9))
    near = SE2(0.61, -0.29, math.pi / 2)
    assert paper.best_bin(scores, near, GRID) == GRID.bin_of(near)
    scores[3, 0, 0] = 1.0
    assert paper.best_bin(scores, near, GRID) == (3, 0, 0)


@given(st.integers(0, 359), st.integers(0, 32), st.integers(0, 32))
def test_bin_and_pose_are_inverse(heading: int, row: int, column: int) -> None:
    """The pose of a bin lies in that bin."""
    grid = PoseGrid(360, 33, 0.3)
    assert grid.bin_of(grid.pose_of((heading, row, column))) == (heading, row, column)


@given(st.floats(-4.9, 4.9), st.floats(-4.9, 4.9), ANGLES)
def test_quantising_moves_a_pose_by_half_a_bin_at_most(x: float, y: float, heading: float) -> None:
    """Half a cell along each axis, half a heading step."""
    grid = PoseGrid(360, 33, 0.3)
    pose = grid.pose_of(grid.bin_of(SE2(x, y, heading)))
    assert abs(pose.x_m - x) <= 0.15 + 1e-9
    assert abs(pose.y_m - y) <= 0.15 + 1e-9
    assert abs(math.remainder(pose.heading_rad - heading, math.tau)) <= math.pi / 360 + 1e-9


def test_the_start_stands_in_the_middle_of_the_middle_cell() -> None:
    """p_0 is the centre of the map, exactly."""
    assert GRID.pose_of((0, 4, 4)) == SE2(pytest.approx(0.0), pytest.approx(0.0), 0.0)


def test_modes_are_apart_and_fall() -> None:
    """Neighbours of a mode are part of it, across the seam of the circle too."""
    grid = PoseGrid(72, 21, 0.3)
    field = np.full((72, 21, 21), 1e-6, np.float32)
    field[0, 10, 10], field[71, 10, 11], field[1, 9, 10] = 0.5, 0.2, 0.1
    field[36, 10, 10], field[0, 16, 3] = 0.05, 0.03
    modes = paper.field_modes(field, (0, 10, 10), grid, 5)
    assert [round(mode.probability, 3) for mode in modes] == [0.5, 0.05, 0.03]
    assert modes[1].map_from_robot.heading_rad == pytest.approx(math.pi)


def test_a_flat_field_has_no_modes() -> None:
    """It says nothing, and five arbitrary corners would look like something."""
    field = np.full((8, 9, 9), 1 / 648, np.float32)
    assert paper.field_modes(field, (0, 4, 4), GRID, 5) == ()


def test_inertial_pose_turns_the_motion_into_the_map() -> None:
    """Equation 3 in continuous units: one metre ahead of a robot that looks left."""
    pose = paper.step_inertial(SE2(1.0, 2.0, math.pi / 2), SE2(1.0, 0.0, 0.1))
    assert (pose.x_m, pose.y_m) == (pytest.approx(1.0), pytest.approx(3.0))
    assert pose.heading_rad == pytest.approx(math.pi / 2 + 0.1)


@pytest.mark.parametrize(
    ("visual", "by_all", "by_any"),
    [
        (SE2(0.3, 0.4, 0.0), True, True),
        (SE2(0.5, 0.4, 0.0), False, True),  # too far
        (SE2(0.3, 0.4, 0.5), False, True),  # turned too much
        (SE2(0.5, 0.4, 0.5), False, False),
        (SE2(0.6, 0.0, 0.0), False, True),  # the gate itself is outside
        (SE2(0.0, 0.0, -math.tau + 0.1), True, True),  # differences wrap
    ],
)
def test_cross_check(visual: SE2, by_all: bool, by_any: bool) -> None:
    """Equation 4 with its `and`, and with the other connective."""
    inertial = SE2(0.0, 0.0, 0.0)
    assert paper.cross_check(visual, inertial, 0.6, 0.3, "all") is by_all
    assert paper.cross_check(visual, inertial, 0.6, 0.3, "any") is by_any


def test_inertial_field_is_one_hot_and_empty_off_the_map() -> None:
    """Equation 5."""
    pose = SE2(0.3, -0.6, math.pi)
    field = paper.pose_field(pose, GRID)
    assert field.sum() == 1.0
    assert field[GRID.bin_of(pose)] == 1.0
    assert not paper.pose_field(SE2(1.36, 0.0, 0.0), GRID).any()


@pytest.mark.parametrize("window", [(slice(0, 9), slice(0, 9)), (slice(2, 7), slice(0, 4)), (slice(8, 9), slice(5, 9))])
@pytest.mark.parametrize("density", [1.0, 0.05])
@pytest.mark.parametrize("headings", [6, 8])
def test_placing_equals_the_sum_over_everything(window: paper.Window, density: float, headings: int) -> None:
    """Equation 6 inside any window, for flat and for sharp fields, with and without quarter turns."""
    rotated = paper.rotate_observation(random_planes((5, 5, 5), 7, 0.5), headings)
    field = random_planes((headings, 9, 9), 8, density)
    field /= field.sum()
    placed = paper.place_observation(rotated, field, window)
    np.testing.assert_allclose(placed, slow_placing(rotated, field)[:, window[0], window[1]], atol=1e-6)


def test_a_pose_off_the_map_places_nothing() -> None:
    """The region of interest may still reach the map."""
    pose = SE2(1.6, 0.0, 0.0)
    window = paper.roi_mask(pose, GRID, 5)
    placed = paper.place_observation(random_planes((8, 4, 5, 5)), paper.pose_field(pose, GRID), window)
    assert placed.shape == (4, 5, 2)
    assert not placed.any()


def test_placing_equals_onnx_runtime_at_full_size() -> None:
    """A transposed convolution is the correlation with the flipped kernels."""
    rotated = paper.rotate_observation(random_planes((4, 11, 11), 9), 36)
    field = random_planes((36, 33, 33), 10)
    field /= field.sum()
    flipped = np.ascontiguousarray(rotated[:, :, ::-1, ::-1].swapaxes(0, 1))  # (L, R, h, h)
    expected = onnx_convolution(field[None], flipped, 5)[0]
    placed = paper.place_observation(rotated, field, (slice(0, 33), slice(0, 33)))
    np.testing.assert_allclose(placed, expected, atol=2e-6)


def test_a_certain_pose_places_the_rotated_observation_unchanged() -> None:
    """One-hot field, kernel h x h about the pose, to the rounding of weights."""
    planes = random_planes((5, 5, 5), 11)
    rotated = paper.rotate_observation(planes, 8)
    pose = SE2(0.3, 0.6, math.pi / 4)
    placed = paper.place_observation(rotated, paper.pose_field(pose, GRID), paper.roi_mask(pose, GRID, 5))
    np.testing.assert_allclose(placed, rotated[1], atol=2.0 ** (1 - paper.PLACED_BITS))


def test_nothing_is_placed_where_nothing_was_seen() -> None:
    """Exactly, for any field and in any order of adding: what was placed decides which cells the map updates."""
    planes = np.zeros((5, 7, 7), np.float32)
    planes[3, 3, 5], planes[4, 2, 6] = 0.3, 1.0
    rotated = paper.rotate_observation(planes, 12)
    field = random_planes((12, 11, 11), 3, 0.02)
    field /= field.sum()
    window = (slice(0, 11), slice(0, 11))
    placed = paper.place_observation(rotated, field, window)
    expected = slow_placing(rotated, field)
    assert not placed[expected < 1e-12].any()
    shuffled = np.random.default_rng(0).permutation(5)
    again = paper.place_observation(rotated[:, shuffled], field, window)
    np.testing.assert_array_equal(again, placed[shuffled])


@pytest.mark.parametrize("sharpness", [0.0, 40.0])
def test_placing_is_exact_in_whole_numbers(sharpness: float) -> None:
    """At the paper's sizes, with all the weight that there can be: no partial sum leaves the exact range of float64."""
    rotated = paper.rotate_observation(np.ones((1, 11, 11), np.float32), 360)
    field, _ = paper.visual_field(sharpness * random_planes((360, 21, 21), 4), 1.0)
    placed = paper.place_observation(rotated, field, (slice(5, 16), slice(5, 16)))
    weights = np.rint(rotated[:, 0] * np.float64(2**paper.PLACED_BITS)).astype(np.int64)
    weights[:, 5, 5] = 4 * np.rint(rotated[:, 0, 5, 5] * np.float64(2**paper.PLACED_BITS / 4)).astype(np.int64)
    mass = np.rint(field * np.float64(2**paper.FIELD_BITS)).astype(np.int64)
    whole = np.zeros((11, 11), np.int64)
    for i, j in np.ndindex(11, 11):
        part = mass[:, 10 - i : 21 - i, 10 - j : 21 - j]
        whole += np.einsum("r,ryx->yx", weights[:, i, j], part)
    np.testing.assert_array_equal(placed[0], (whole * 0.5 ** (paper.PLACED_BITS + paper.FIELD_BITS)).astype(np.float32))


def test_region_of_interest_is_a_square_clipped_at_the_border() -> None:
    """Equation 7: h x h cells about the pose; nothing for a pose far off the map."""
    assert paper.roi_mask(SE2(0.0, 0.0, 0.0), GRID, 5) == (slice(2, 7), slice(2, 7))
    assert paper.roi_mask(SE2(1.2, -1.2, 0.0), GRID, 5) == (slice(0, 3), slice(6, 9))
    rows, columns = paper.roi_mask(SE2(9.0, 0.0, 0.0), GRID, 5)
    assert columns.start == columns.stop
    placed = paper.place_observation(random_planes((8, 4, 5, 5)), random_planes((8, 9, 9)), (rows, columns))
    assert placed.shape == (4, 5, 0)


def test_update_is_the_leaky_average_where_something_was_seen() -> None:
    """Equation 10; *unobserved* alone is no observation."""
    world, placed = random_planes((4, 9, 9), 12), np.zeros((4, 5, 5), np.float32)
    placed[0] = 1.0
    placed[3, 2, 2] = 0.5
    window = (slice(2, 7), slice(3, 8))
    updated = paper.update_map(world, placed, window, 0.3)
    np.testing.assert_allclose(updated[:, 4, 5], 0.7 * world[:, 4, 5] + 0.3 * np.array([1, 0, 0, 0.5]), rtol=1e-6)
    updated[:, 4, 5] = world[:, 4, 5]
    np.testing.assert_array_equal(updated, world)


def test_cells_outside_the_region_keep_every_bit() -> None:
    """Equation 7 and 10 together."""
    world = random_planes((4, 9, 9), 13)
    window = (slice(0, 4), slice(5, 9))
    updated = paper.update_map(world, random_planes((4, 4, 4), 14), window, 1.0)
    outside = np.ones((9, 9), bool)
    outside[window] = False
    assert updated[:, outside].tobytes() == world[:, outside].tobytes()
    assert not np.array_equal(updated, world)


_DIGEST = """
import hashlib, numpy as np
from semslam.slam import paper
random = np.random.default_rng(0)
rotated = paper.rotate_observation(random.random((6, 11, 11), np.float32), 120)
scores = paper.correlate(rotated, random.random((6, 33, 33), np.float32))
field, _ = paper.visual_field(scores, 0.5)
placed = paper.place_observation(rotated, field, (slice(3, 14), slice(20, 31)))
print(hashlib.sha256(scores.tobytes() + field.tobytes() + placed.tobytes()).hexdigest())
"""


def test_the_same_bits_for_any_number_of_threads() -> None:
    """Matrix libraries add in an order that depends on their threads; the results must not."""
    digests = set()
    for threads in ("1", "2", "3"):
        setting = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), threads)
        done = subprocess.run(
            [sys.executable, "-c", _DIGEST], env={**os.environ, **setting}, capture_output=True, text=True, check=True
        )
        digests.add(done.stdout)
    assert len(digests) == 1
