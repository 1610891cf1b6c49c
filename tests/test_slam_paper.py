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
from semslam.slam import paper
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


@pytest.mark.parametrize("density", [1.0, 0.15])
def test_correlation_equals_the_sum_over_everything(density: float) -> None:
    """Equation 2: no flip, zero padding, object classes only; sparse and dense."""
    rotated = paper.rotate_observation(random_planes((6, 5, 5), 1, density), 8)
    world = random_planes((6, 9, 9), 2, density)
    np.testing.assert_allclose(paper.correlate(rotated, world), slow_scores(rotated, world), atol=2e-5)


@pytest.mark.parametrize("patch_bytes", [0, 5_000, 30_000])
def test_correlation_in_pieces_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch, patch_bytes: int) -> None:
    """A limit of memory changes no score: single rows and neighbours, a few, or all at once."""
    rotated = rotate_observation(random_planes((6, 7, 7), 1, 0.4), 12)
    world = random_planes((6, 19, 23), 2, 0.3)
    whole = paper.correlate(rotated, world)
    monkeypatch.setattr(paper, "PATCH_BYTES", patch_bytes)
    assert np.array_equal(paper.correlate(rotated, world), whole)


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
    np.testing.assert_allclose(paper.correlate(rotated, world), expected, atol=1e-4)


def test_reserved_classes_do_not_count() -> None:
    """Unobserved, free floor and obstacle say nothing about the pose in the paper."""
    rotated = paper.rotate_observation(random_planes((4, 5, 5), 5), 8)
    world = random_planes((4, 9, 9), 6)
    world[FIRST_OBJECT:] = 0.0
    assert not paper.correlate(rotated, world).any()


@pytest.mark.parametrize("classes", [1, 12, 80, 5000])
def test_partial_sums_stay_exact_for_any_number_of_classes(classes: int) -> None:
    """Whole numbers below 2^53, whatever the order of adding."""
    terms = classes * 33 * 33
    bits = paper._weight_bits(terms)
    assert terms * 2 ** (2 * bits) < 2**53
    assert bits >= 14


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
def test_placing_equals_the_sum_over_everything(window: paper.Window, density: float) -> None:
    """Equation 6 inside any window, for flat and for sharp fields."""
    rotated = paper.rotate_observation(random_planes((5, 5, 5), 7, 0.5), 8)
    field = random_planes((8, 9, 9), 8, density)
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
    np.testing.assert_allclose(placed, rotated[1], atol=2.0**-paper.WEIGHT_BITS)


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
