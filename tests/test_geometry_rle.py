"""Masks as run lengths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry import rle


@given(npst.arrays(bool, st.tuples(st.integers(0, 12), st.integers(0, 12))))
def test_masks_round_trip(mask: NDArray[np.bool_]) -> None:
    """Every mask comes back, and no run but the first is empty."""
    runs = rle.encode(mask)
    assert runs.dtype == np.uint32
    assert int(runs.sum()) == mask.size
    assert (runs[1:] > 0).all()
    assert np.array_equal(rle.decode(runs.tolist(), *mask.shape), mask)


def test_runs_by_hand() -> None:
    """Row by row, background first; a mask that begins with foreground has a first run of 0."""
    assert rle.encode(np.array([[0, 1, 1], [1, 0, 0]], bool)).tolist() == [1, 3, 2]
    assert rle.encode(np.array([[1, 0], [0, 1]], bool)).tolist() == [0, 1, 2, 1]
    assert rle.encode(np.ones((2, 2), bool)).tolist() == [0, 4]
    assert rle.encode(np.zeros((2, 2), bool)).tolist() == [4]


def test_runs_of_another_image_are_refused() -> None:
    """The message tells both sizes."""
    with pytest.raises(SemslamError, match=r"add up to 5 pixels, the image has 3 x 2 = 6"):
        rle.decode([2, 3], 2, 3)
