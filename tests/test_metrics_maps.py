"""Scores of maps against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.labels import FIRST_OBJECT, FREE_FLOOR, UNOBSERVED
from semslam.map_metrics import (
    as_probabilities,
    boundary_f1,
    brier_score,
    calibration_error,
    class_boundaries,
    class_overlaps,
    labels_of,
    map_mse,
    reliability,
    score_map,
)

CHAIR, TABLE, CLASSES = FIRST_OBJECT, FIRST_OBJECT + 1, FIRST_OBJECT + 2


def one_hot(ids: NDArray[np.int64]) -> NDArray[np.float32]:
    return (np.arange(CLASSES)[:, None, None] == ids).astype(np.float32)


def room() -> NDArray[np.int64]:
    """Floor with a chair of 3 x 3 cells and a table of 2 x 4; the last column unseen."""
    ids = np.full((12, 12), FREE_FLOOR, np.int64)
    ids[1:4, 1:4], ids[6:8, 5:9], ids[:, 11] = CHAIR, TABLE, UNOBSERVED
    return ids


def test_the_truth_itself_is_perfect() -> None:
    """Errors zero, overlaps one."""
    score = score_map(one_hot(room()), room())
    assert (score.mse, score.brier, score.ece) == (0.0, 0.0, 0.0)
    assert (score.object_iou, score.boundary_f1) == (1.0, 1.0)


def test_mse_by_hand() -> None:
    """One sure cell of four is wrong (2 / L a cell); half a doubt costs a quarter as much as the whole error."""
    truth = np.array([[FREE_FLOOR, FREE_FLOOR], [CHAIR, CHAIR]], np.int64)
    wrong = truth.copy()
    wrong[0, 0] = TABLE
    assert map_mse(one_hot(wrong), truth) == pytest.approx(2 / CLASSES / 4)
    doubt = (one_hot(truth) + one_hot(wrong)) / 2
    assert map_mse(doubt, truth) == pytest.approx(0.5 / CLASSES / 4)
    assert brier_score(one_hot(wrong), truth) == pytest.approx(2 / 4)


def test_only_cells_of_the_mask_count() -> None:
    """A wrong cell outside changes nothing; nothing inside has no score."""
    truth, wrong = room(), room()
    wrong[0, 0] = TABLE
    mask = np.ones(truth.shape, np.bool_)
    mask[0, 0] = False
    assert score_map(one_hot(wrong), truth, mask) == score_map(one_hot(truth), truth, mask)
    assert math.isnan(map_mse(one_hot(truth), truth, np.zeros_like(mask)))


def test_weights_become_probabilities() -> None:
    """Pixel shares of 0.2 and 0.6 are 1/4 and 3/4; a cell without any weight was not observed."""
    belief = np.zeros((CLASSES, 1, 2), np.float32)
    belief[[CHAIR, TABLE], 0, 0] = 0.2, 0.6
    probabilities = as_probabilities(belief)
    assert probabilities[:, 0, 0].tolist() == pytest.approx([0, 0, 0, 0.25, 0.75])
    assert labels_of(belief).tolist() == [[TABLE, UNOBSERVED]]
    assert probabilities[UNOBSERVED, 0, 1] == 1.0


def test_calibration_by_hand() -> None:
    """Ten cells held for 0.8 sure, eight of them right, are calibrated; five of them right, they are 0.3 off."""
    belief = np.zeros((CLASSES, 1, 10), np.float32)
    belief[CHAIR], belief[TABLE] = 0.8, 0.2
    truth = np.full((1, 10), CHAIR, np.int64)
    truth[0, :2] = TABLE
    assert calibration_error(belief, truth) == pytest.approx(0.0, abs=1e-6)
    truth[0, :5] = TABLE
    assert calibration_error(belief, truth) == pytest.approx(0.3, abs=1e-6)


def test_doubts_and_excess_of_confidence_do_not_cancel() -> None:
    """Cells 0.9 sure and wrong, others 0.4 sure and right: both gaps count."""
    belief = np.zeros((CLASSES, 1, 2), np.float32)
    belief[:, 0, 0] = [0, 0, 0, 0.9, 0.1]
    belief[:, 0, 1] = [0.2, 0.2, 0.1, 0.4, 0.1]
    truth = np.array([[TABLE, CHAIR]], np.int64)
    assert calibration_error(belief, truth) == pytest.approx((0.9 + 0.6) / 2, abs=1e-6)


def test_overlap_by_hand() -> None:
    """A chair of nine cells found one cell to the side: six shared, twelve in either; maps add up before dividing."""
    truth, found = room(), room()
    found[1:4, 1], found[1:4, 4] = FREE_FLOOR, CHAIR
    overlaps = class_overlaps(found, truth, CLASSES)
    assert overlaps.iou[CHAIR] == pytest.approx(6 / 12)
    assert overlaps.mean_objects == pytest.approx((0.5 + 1.0) / 2)
    assert (overlaps + class_overlaps(truth, truth, CLASSES)).iou[CHAIR] == pytest.approx(15 / 21)


def test_a_class_in_neither_map_has_no_overlap() -> None:
    """It does not count as 0 or 1."""
    floor = np.full((3, 3), FREE_FLOOR, np.int64)
    assert math.isnan(class_overlaps(floor, floor, CLASSES).mean_objects)
    assert math.isnan(boundary_f1(floor, floor, CLASSES))


def test_boundaries_one_cell_off_are_found_and_farther_ones_are_not() -> None:
    """The table two cells off loses those ends of its boundary that have nothing within a cell."""
    truth = room()
    near, far = room(), room()
    near[6:8, 5], near[6:8, 9] = FREE_FLOOR, TABLE
    far[6:8, 5:7], far[6:8, 9:11] = FREE_FLOOR, TABLE
    assert boundary_f1(near, truth, CLASSES) == 1.0
    assert boundary_f1(far, truth, CLASSES) == pytest.approx((1.0 + 0.75) / 2)


def test_a_missed_object_has_no_boundary() -> None:
    """F1 zero for it, whatever the others score."""
    missed = room()
    missed[missed == TABLE] = FREE_FLOOR
    assert boundary_f1(missed, room(), CLASSES) == pytest.approx(0.5)


def test_boundaries_of_every_class_add_up_before_dividing() -> None:
    """A table half as long in one of two maps: its boundary is right as far as it goes, and the far end is missed."""
    truth, short = room(), room()
    short[6:8, 7:9] = FREE_FLOOR
    one = class_boundaries(short, truth, CLASSES)
    counts = [counts[TABLE] for counts in (one.found, one.found_near, one.true, one.true_near)]
    assert counts == [4, 4, 8, 6]
    assert one.f1[TABLE] == pytest.approx(2 * 1.0 * 0.75 / 1.75)
    both = one + class_boundaries(truth, truth, CLASSES)
    assert both.f1[TABLE] == pytest.approx(2 * 1.0 * (14 / 16) / (1 + 14 / 16))
    assert class_boundaries(short, truth, CLASSES, tolerance_cells=2).f1[TABLE] == 1.0


def test_a_class_of_one_map_alone_has_a_boundary_score_of_zero() -> None:
    """And one of neither has none."""
    floor = np.full((12, 12), FREE_FLOOR, np.int64)
    f1 = class_boundaries(floor, room(), CLASSES).f1
    assert f1[CHAIR] == 0.0
    assert math.isnan(class_boundaries(floor, floor, CLASSES).f1[CHAIR])


def test_reliability_by_hand() -> None:
    """Two cells 0.85 sure and right, one 0.75 sure and wrong, one masked out; a second map doubles everything."""
    found, truth = np.full((1, 4), CHAIR, np.int64), np.array([[CHAIR, CHAIR, TABLE, TABLE]], np.int64)
    probability, mask = np.array([[0.85, 0.85, 0.75, 1.0]]), np.array([[True, True, True, False]])
    one = reliability(found, probability, truth, mask, bins=10)
    assert one.cells.tolist() == [0] * 7 + [1, 2, 0]
    assert one.right.tolist() == [0] * 8 + [2, 0]
    assert one.error == pytest.approx((0.75 + 0.3) / 3)
    assert one.brier == pytest.approx((0.75**2 + 2 * 0.15**2) / 3)
    assert (one + one).error == pytest.approx(one.error)
    assert math.isnan(reliability(found, probability, truth, np.zeros_like(mask)).error)
