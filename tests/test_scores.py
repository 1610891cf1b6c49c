"""Scores of boxes and masks against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from semslam.models.detections import Detections
from semslam.models.training.pictures import Picture, SeenObject
from semslam.models.training.scores import (
    Hits,
    Wanted,
    average_precision,
    box_overlaps,
    hits,
    in_classes,
    mask_overlap,
    mask_scores,
    mean,
    of_class_names,
    paired,
    total_hits,
    wanted_of,
)

NAMES = ("chair", "table", "sofa")
LEFT, RIGHT = (0.0, 0.0, 10.0, 10.0), (20.0, 0.0, 30.0, 10.0)


def seen(*rows: tuple[tuple[float, float, float, float], int, float]) -> Detections:
    """Detections of box, class and score."""
    boxes = np.array([row[0] for row in rows], np.float32).reshape(-1, 4)
    return Detections(
        boxes, np.array([row[2] for row in rows], np.float32), np.array([row[1] for row in rows], np.int64)
    )


def needs_coco() -> None:
    pytest.importorskip("pycocotools", reason="average precision needs pycocotools: pip install '.[train]'")


def test_perfect_detections_score_one_and_absent_classes_do_not_count() -> None:
    """Two of three classes occur; the mean is theirs."""
    needs_coco()
    truth = [[Wanted(LEFT, 0), Wanted(RIGHT, 1)], [Wanted(LEFT, 0)]]
    found = [seen((LEFT, 0, 0.9), (RIGHT, 1, 0.8)), seen((LEFT, 0, 0.7))]
    scores = average_precision(truth, found, NAMES)
    assert scores.ap50 == pytest.approx((1.0, 1.0, None))
    assert [scores.map50, scores.map50_95] == pytest.approx([1.0, 1.0])
    assert scores.objects == (2, 1, 0)


def test_a_false_detection_above_a_right_one_costs_half() -> None:
    """Precision is 1/2 at every recall: one object, found second."""
    needs_coco()
    scores = average_precision([[Wanted(LEFT, 0)]], [seen((RIGHT, 0, 0.9), (LEFT, 0, 0.5))], NAMES)
    assert scores.ap50[0] == pytest.approx(0.5)


def test_overlap_decides_at_which_thresholds_a_box_counts() -> None:
    """A box of 10 x 10 against one of 10 x 8 overlaps by 0.8: right at 0.5 to 0.8, wrong at 0.85 to 0.95."""
    needs_coco()
    scores = average_precision([[Wanted(LEFT, 0)]], [seen(((0, 0, 10, 8.001), 0, 0.9))], NAMES)
    assert scores.ap50[0] == pytest.approx(1.0)
    assert scores.ap50_95[0] == pytest.approx(0.7)


def test_glimpses_are_neither_wanted_nor_punished() -> None:
    """The same detection costs half without the ignore region, and another class in the region is still wrong."""
    needs_coco()
    inside = (21.0, 1.0, 25.0, 9.0)
    found = [seen((inside, 0, 0.9), (LEFT, 0, 0.5))]
    ignored, other = Wanted(RIGHT, 0, counts=False), Wanted(RIGHT, 1, counts=False)
    assert average_precision([[Wanted(LEFT, 0), ignored]], found, NAMES).ap50[0] == pytest.approx(1.0)
    assert average_precision([[Wanted(LEFT, 0), other]], found, NAMES).ap50[0] == pytest.approx(0.5)
    assert average_precision([[ignored]], found, NAMES).map50 is None


def test_nothing_found_scores_zero_and_nothing_wanted_scores_none() -> None:
    """Empty pictures do not break anything."""
    needs_coco()
    assert average_precision([[Wanted(LEFT, 2)], []], [seen(), seen()], NAMES).ap50 == (None, None, 0.0)
    assert average_precision([[]], [seen((LEFT, 0, 0.9))], NAMES).map50 is None


def test_boxes_of_another_picture_are_no_use() -> None:
    """Detections belong to their picture."""
    needs_coco()
    assert average_precision([[Wanted(LEFT, 0)], []], [seen(), seen((LEFT, 0, 0.9))], NAMES).ap50[0] == 0.0


def test_misuse_is_told() -> None:
    """Lists of different length and class ids beyond the names."""
    needs_coco()
    with pytest.raises(ValueError, match="2 pictures and detections of 1"):
        average_precision([[], []], [seen()], NAMES)
    with pytest.raises(ValueError, match="beyond the 3"):
        average_precision([[]], [seen((LEFT, 3, 0.9))], NAMES)


def test_hits_count_each_object_once() -> None:
    """A second box on an object is false, one in an ignore region is nothing, one below the score is not there."""
    truth = [[Wanted(LEFT, 0), Wanted(RIGHT, 0), Wanted((40, 0, 50, 10), 0, counts=False)]]
    found = [seen((LEFT, 0, 0.9), ((1, 0, 10, 10), 0, 0.8), ((41, 1, 49, 9), 0, 0.7), (RIGHT, 0, 0.2))]
    chair, *others = hits(truth, found, 3, min_score=0.3)
    assert chair == Hits(wanted=2, found=1, false=1)
    assert (chair.recall, chair.precision) == (0.5, 0.5)
    assert others == [Hits(0, 0, 0)] * 2
    assert (others[0].recall, others[0].precision) == (None, None)
    assert hits(truth, found, 3, min_score=0.1)[0] == Hits(2, 2, 1)
    assert total_hits([chair, Hits(1, 1, 0)]) == Hits(3, 2, 1)


def test_a_detection_of_the_wrong_class_is_false_and_the_object_missed() -> None:
    """Both classes pay."""
    assert hits([[Wanted(LEFT, 0)]], [seen((LEFT, 1, 0.9))], 2, 0.3) == (Hits(1, 0, 0), Hits(0, 0, 1))


def test_box_overlaps_are_symmetric_and_safe() -> None:
    """Quarter overlap of two squares; boxes without area overlap nothing."""
    first = np.array([[0, 0, 2, 2], [5, 5, 5, 5]], np.float32)
    second = np.array([[1, 1, 3, 3], [0, 0, 2, 2], [5, 5, 5, 5]], np.float32)
    assert box_overlaps(first, second) == pytest.approx(np.array([[1 / 7, 1, 0], [0, 0, 0]]))
    assert box_overlaps(first, np.zeros((0, 4), np.float32)).shape == (2, 0)


def test_objects_are_paired_with_the_box_of_their_class_that_fits_best() -> None:
    """Not with a better scored one, not with another class's, and glimpses with none."""
    objects = [Wanted(LEFT, 0), Wanted(RIGHT, 1), Wanted((40, 0, 50, 10), 0, counts=False)]
    found = seen(((0, 0, 10, 7), 0, 0.9), ((0, 0, 10, 9), 0, 0.4), (RIGHT, 0, 0.8), ((40, 0, 50, 10), 0, 0.8))
    assert paired(objects, found) == [1, None, None]
    assert paired(objects, seen()) == [None, None, None]
    assert paired([], found) == []


def test_mask_scores_are_told_with_and_without_missed_objects() -> None:
    """Three chairs (0.8, 0.6, missed) and a table: means by object and by class."""
    scores = mask_scores([0.8, 0.6, None, 1.0], [0, 0, 0, 1], NAMES)
    assert scores.by_class == pytest.approx((0.7, 1.0, None))
    assert scores.by_class_missed_0 == pytest.approx((1.4 / 3, 1.0, None))
    assert [scores.by_object, scores.by_object_missed_0] == pytest.approx([0.8, 0.6])
    assert (scores.objects, scores.missed) == (4, 1)
    assert scores.by_classes == pytest.approx(0.85)
    assert mask_scores([], [], NAMES).by_object is None


def test_mask_overlap_is_intersection_over_union() -> None:
    """And 0 for two empty masks; other sizes are refused."""
    first, second = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert mask_overlap(first, second) == 0.0
    first[:2], second[1:3] = True, True
    assert mask_overlap(first, second) == pytest.approx(1 / 3)
    with pytest.raises(ValueError, match="mask"):
        mask_overlap(first, np.zeros((5, 4), bool))


def test_objects_that_show_too_little_become_ignore_regions() -> None:
    """By share, pixels and short side, scaled with the picture."""
    counting = SeenObject(1, 2, 0, 0, 60, 60, 3000, 0.9, False)
    hidden = SeenObject(2, 0, 0, 0, 60, 60, 3000, 0.2, False)
    blank = np.zeros((480, 640), np.uint16)
    picture = Picture(np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32), blank, (counting, hidden))
    assert wanted_of(picture) == [Wanted((0, 0, 60, 60), 2, True), Wanted((0, 0, 60, 60), 0, False)]


def test_foreign_class_names_are_translated_and_the_rest_left_out() -> None:
    """A COCO couch is a sofa, a person is nothing; scores and masks stay with their boxes."""
    class_of = of_class_names(("person", "couch", "chair"), NAMES, {"couch": "sofa"})
    assert class_of == {1: 2, 2: 0}
    found = seen((LEFT, 0, 0.9), (RIGHT, 1, 0.8), (LEFT, 2, 0.7))
    masked = Detections(found.boxes, found.scores, found.class_ids, 4, np.eye(3, dtype=bool)[:, None])
    kept = in_classes(masked, class_of)
    assert kept.class_ids.tolist() == [2, 0]
    assert kept.scores == pytest.approx([0.8, 0.7])
    assert kept.boxes.tolist() == [list(RIGHT), list(LEFT)]
    assert kept.masks is not None
    assert kept.masks[:, 0].argmax(1).tolist() == [1, 2]
    assert kept.dropped == 4
    assert len(in_classes(seen((LEFT, 0, 0.9)), class_of)) == 0


def test_the_mean_leaves_out_what_is_not_there() -> None:
    """And is None without anything."""
    assert mean([0.5, None, 1.0]) == pytest.approx(0.75)
    assert mean([None]) is None
