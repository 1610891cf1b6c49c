"""Rigid transforms: composition, inverses, quaternions and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semslam.errors import SemslamError
from semslam.geometry.frames import (
    FLU_FROM_OPTICAL,
    SE2,
    Matrix,
    interpolate,
    invert,
    matrix_from_pose,
    planar,
    quaternion_from_matrix,
    rotation_from_vector,
    wrap_angle,
    wrap_angles,
)

metres = st.floats(-100, 100)
radians = st.floats(-20, 20)
planar_poses = st.builds(SE2, metres, metres, radians)
vectors = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))


def pose(position: tuple[float, float, float], rotation_vector: tuple[float, float, float]) -> Matrix:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_vector(rotation_vector)
    matrix[:3, 3] = position
    return matrix


poses = st.builds(pose, vectors, vectors)


def assert_same(a: SE2, b: SE2) -> None:
    assert a.x_m == pytest.approx(b.x_m, abs=1e-9)
    assert a.y_m == pytest.approx(b.y_m, abs=1e-9)
    assert wrap_angle(a.heading_rad - b.heading_rad) == pytest.approx(0.0, abs=1e-9)


@given(radians)
def test_a_wrapped_angle_is_the_same_direction_in_range(angle: float) -> None:
    """The result lies in (-pi, pi] and differs by whole turns."""
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)
    assert wrap_angles([angle])[0] == pytest.approx(wrapped) or abs(abs(wrapped) - math.pi) < 1e-9


@pytest.mark.parametrize(("angle", "wrapped"), [(math.pi, math.pi), (-math.pi, math.pi), (3 * math.pi, math.pi)])
def test_half_a_turn_is_plus_pi(angle: float, wrapped: float) -> None:
    """The open end of the range is -pi."""
    assert wrap_angle(angle) == wrapped
    assert wrap_angles([angle]).tolist() == [wrapped]


def test_a_quarter_turn_left_then_ahead_goes_left() -> None:
    """Composition by hand: at (1, 2) looking along y, one metre ahead and half a metre left."""
    after = SE2(1.0, 2.0, math.pi / 2) @ SE2(1.0, 0.5, math.pi / 2)
    assert_same(after, SE2(0.5, 3.0, math.pi))
    assert SE2(1.0, 2.0, math.pi / 2).apply([[1.0, 0.5], [0.0, 0.0]]) == pytest.approx(np.array([[0.5, 3.0], [1, 2]]))


@given(planar_poses, planar_poses, planar_poses)
def test_planar_composition_is_a_group(a: SE2, b: SE2, c: SE2) -> None:
    """Inverse, association, and the motion between two poses."""
    assert_same(a @ a.inverse(), SE2(0.0, 0.0, 0.0))
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ a.between(b), b)


@given(planar_poses, planar_poses)
def test_planar_matches_matrices(a: SE2, b: SE2) -> None:
    """SE(2) is what the 4x4 matrices do on the ground."""
    lifted = [pose((p.x_m, p.y_m, 0.0), (0.0, 0.0, wrap_angle(p.heading_rad))) for p in (a, b)]
    assert_same(planar(lifted[0] @ lifted[1]), a @ b)


@given(poses)
def test_quaternions_round_trip(matrix: Matrix) -> None:
    """Matrix to quaternion and back, with w never negative."""
    quaternion = quaternion_from_matrix(matrix)
    assert quaternion[3] >= 0
    assert matrix_from_pose(matrix[:3, 3], quaternion) == pytest.approx(matrix, abs=1e-9)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_survive(axis: int) -> None:
    """Rotations by pi have w = 0, where the usual formula divides by zero."""
    vector = [0.0, 0.0, 0.0]
    vector[axis] = math.pi
    rotation = rotation_from_vector(vector)
    back = matrix_from_pose((0, 0, 0), quaternion_from_matrix(rotation))
    assert back[:3, :3] == pytest.approx(rotation, abs=1e-9)


def test_a_quarter_turn_about_z_by_hand() -> None:
    """x goes to y."""
    half = math.sqrt(0.5)
    matrix = matrix_from_pose((1.0, 2.0, 3.0), (0.0, 0.0, half, half))
    assert matrix == pytest.approx(np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]), abs=1e-12)


@given(poses)
def test_inverting_undoes(matrix: Matrix) -> None:
    """A transform and its inverse cancel."""
    assert invert(matrix) @ matrix == pytest.approx(np.eye(4), abs=1e-9)


@given(poses, poses)
def test_interpolation_starts_at_a_and_ends_at_b(a: Matrix, b: Matrix) -> None:
    """The ends are exact, and the result is rigid in between."""
    assert interpolate(a, b, 0.0) == pytest.approx(a, abs=1e-7)
    assert interpolate(a, b, 1.0) == pytest.approx(b, abs=1e-7)
    middle = interpolate(a, b, 0.5)[:3, :3]
    assert middle @ middle.T == pytest.approx(np.eye(3), abs=1e-9)


def test_interpolation_turns_evenly() -> None:
    """A third of the way is a third of the turn and of the path."""
    a, b = pose((0, 0, 0), (0, 0, 0.2)), pose((3, 0, 6), (0, 0, 1.4))
    assert interpolate(a, b, 1 / 3) == pytest.approx(pose((1, 0, 2), (0, 0, 0.6)), abs=1e-9)


def test_optical_axes_become_forward_left_up() -> None:
    """What lies 5 m ahead, 1 m right and 2 m below an optical camera."""
    assert (FLU_FROM_OPTICAL @ [1.0, 2.0, 5.0, 1.0]).tolist() == [5.0, -1.0, -2.0, 1.0]


def test_pitch_and_roll_do_not_turn_the_heading() -> None:
    """The ground heading is that of the projected x axis."""
    tilted = pose((0, 0, 0), (0, 0, 0.7)) @ pose((0, 0, 0), (0, 0.6, 0)) @ pose((1, 0, 0), (0.3, 0, 0))
    assert planar(tilted).heading_rad == pytest.approx(0.7)


def test_looking_straight_down_still_has_a_heading() -> None:
    """With x vertical the y axis tells the direction."""
    down = pose((0, 0, 0), (0, 0, 0.7)) @ pose((0, 0, 0), (0, math.pi / 2, 0))
    assert planar(down).heading_rad == pytest.approx(0.7)


@pytest.mark.parametrize(
    "quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), (math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0)]
)
def test_what_is_no_rotation_is_refused(quaternion: tuple[float, ...]) -> None:
    """Zero, NaN, a wrong norm or a wrong length."""
    with pytest.raises(SemslamError, match="Orientation"):
        matrix_from_pose((0.0, 0.0, 0.0), quaternion)


def test_an_infinite_position_is_refused() -> None:
    """Nothing infinite gets into a pose."""
    with pytest.raises(SemslamError, match="Position"):
        matrix_from_pose((math.inf, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def test_a_rounded_quaternion_is_normalised() -> None:
    """Single precision of the sender does not stretch space."""
    matrix = matrix_from_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.703, 0.703))
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
