"""Grids: sparse and dense, and coarser observations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from semslam.geometry.grid import Planes, object_planes, pool_observation, to_dense, to_sparse
from semslam.labels import FREE_FLOOR, OBSTACLE, UNOBSERVED

CHAIR = 3
values = st.sampled_from([0.0, 0.0, 0.25, 0.5, 1.0])
planes_of_any_size = st.integers(0, 4).flatmap(
    lambda half: npst.arrays(np.float32, (4, 2 * half + 1, 2 * half + 1), elements=values)
)


def unobserved(side: int) -> Planes:
    planes = np.zeros((4, side, side), np.float32)
    planes[UNOBSERVED] = 1.0
    return planes


def put(planes: Planes, iy: int, ix: int, class_id: int, value: float = 1.0) -> None:
    planes[:, iy, ix] = 0.0
    planes[class_id, iy, ix] = value


@given(planes_of_any_size)
def test_sparse_and_dense_are_the_same(planes: Planes) -> None:
    """Only what is not zero is kept, in rising order."""
    cells, weights = to_sparse(planes)
    assert (cells.dtype.name, weights.dtype.name) == ("uint32", "float32")
    assert len(cells) == np.count_nonzero(planes)
    assert (np.diff(cells.astype(np.int64)) > 0).all()
    shape = (planes.shape[0], planes.shape[1], planes.shape[2])
    assert np.array_equal(to_dense(cells, weights, shape), planes)


def test_the_flat_index_by_hand() -> None:
    """(class * rows + iy) * columns + ix."""
    planes = np.zeros((4, 3, 5), np.float32)
    planes[2, 1, 4] = 0.5
    cells, weights = to_sparse(planes)
    assert cells.tolist() == [(2 * 3 + 1) * 5 + 4]
    assert weights.tolist() == [0.5]


def test_an_index_beyond_the_grid_is_an_error() -> None:
    """Damaged tables do not write anywhere else."""
    with pytest.raises(IndexError):
        to_dense(np.array([36], np.uint32), np.array([1.0], np.float32), (4, 3, 3))


@given(planes_of_any_size)
def test_pooling_by_one_changes_nothing_that_is_consistent(planes: Planes) -> None:
    """Factor 1 keeps the planes, but for floor under an obstacle."""
    side = planes.shape[1]
    pooled = pool_observation(planes, 1, side)
    kept = [UNOBSERVED, OBSTACLE, CHAIR]
    assert np.array_equal(pooled[kept], planes[kept])
    assert np.array_equal(pooled[FREE_FLOOR], np.where(planes[OBSTACLE] > 0, 0.0, planes[FREE_FLOOR]))


def test_pooling_by_three() -> None:
    """Fractions add up, capped; any floor is floor unless an obstacle stands there; unobserved only if all is."""
    fine = unobserved(9)
    put(fine, 3, 3, CHAIR, 0.25)  # the centre block is [3, 6) x [3, 6)
    put(fine, 5, 4, CHAIR, 0.5)
    put(fine, 4, 7, FREE_FLOOR)  # the block ahead
    put(fine, 7, 3, FREE_FLOOR)  # the block to the left, which an obstacle shares
    put(fine, 8, 5, OBSTACLE)
    put(fine, 0, 0, CHAIR, 0.75)  # right behind, where fractions exceed 1
    put(fine, 1, 1, CHAIR, 0.5)
    coarse = pool_observation(fine, 3, 3)
    assert coarse.shape == (4, 3, 3)
    assert coarse[CHAIR].tolist() == [[1.0, 0, 0], [0, 0.75, 0], [0, 0, 0]]
    assert coarse[FREE_FLOOR].tolist() == [[0, 0, 0], [0, 0, 1.0], [0, 0, 0]]
    assert coarse[OBSTACLE].tolist() == [[0, 0, 0], [0, 0, 0], [0, 1.0, 0]]
    assert coarse[UNOBSERVED].tolist() == [[0, 1.0, 1.0], [1.0, 0, 0], [1.0, 0, 1.0]]


def test_pooling_crops_about_the_centre() -> None:
    """A smaller coarse grid looks at the middle."""
    fine = unobserved(9)
    put(fine, 4, 4, CHAIR, 0.5)
    put(fine, 0, 0, CHAIR, 1.0)
    assert pool_observation(fine, 3, 1)[CHAIR].tolist() == [[0.5]]
    assert pool_observation(fine, 1, 5)[CHAIR].sum() == 0.5


def test_pooling_pads_with_unobserved() -> None:
    """Coarse cells that reach beyond the fine grid see nothing there."""
    fine = unobserved(7)
    put(fine, 0, 0, FREE_FLOOR)
    coarse = pool_observation(fine, 3, 3)
    assert coarse[FREE_FLOOR].tolist() == [[1.0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert coarse[UNOBSERVED].sum() == 8.0


@pytest.mark.parametrize(("factor", "side", "fine"), [(2, 3, 9), (3, 2, 9), (3, 3, 8), (3, 5, 9)])
def test_grids_that_do_not_nest_are_refused(factor: int, side: int, fine: int) -> None:
    """Even factors and sides have no centre cell, and a coarse grid must not lie wholly outside."""
    with pytest.raises(ValueError, match=r"odd|need"):
        pool_observation(unobserved(fine), factor, side)


def test_object_planes_leave_the_reserved_ones_out() -> None:
    """A view, not a copy."""
    planes = unobserved(3)
    object_planes(planes)[0, 1, 1] = 0.5
    assert planes[CHAIR, 1, 1] == 0.5
