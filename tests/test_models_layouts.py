"""Layouts with anchors, masks, queries, class maps and depth: exact answers from networks with chosen outputs."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto

from semslam.errors import SemslamError
from semslam.models import detectors
from semslam.models.detectors import Detections, Detector, detector, table
from tests.onnx_factory import constant_detector, dense, rgbd_detector

GREY = np.full((64, 128, 3), 90, np.uint8)
"""Half as high as wide. In a 64 x 64 input: centred 64 x 32 from row 16, scale 0.5; stretched 0.5 across, 1 down."""
NAMES = {"names": "{0: 'cup', 1: 'chair'}"}
CELLS = 8 * 8 + 4 * 4 + 2 * 2
Outputs = dict[str, NDArray[np.generic]]


def _detector(tmp_path: Path, outputs: Outputs, **options: object) -> Detector:
    options = {"metadata": NAMES, **options}
    return Detector.open(constant_detector(tmp_path / "m.onnx", outputs, **options))


def _boxes(found: Detections, expected: list[list[float]]) -> None:
    np.testing.assert_allclose(found.boxes, np.array(expected, np.float32).reshape(-1, 4), atol=0.02)


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))


# ---------------------------------------------------------------------------------------------------- depth and batches


def test_our_own_layout_takes_depth_and_is_named_for_it(tmp_path: Path) -> None:
    """The network answers with the mean depth as a score: it must see the metres, and nothing around the picture."""
    detector = Detector.open(rgbd_detector(tmp_path / "m.onnx", metadata=NAMES))
    depth = np.full((64, 128), 0.8, np.float32)
    found = detector(GREY, 0.1, 0.5, depth)
    assert detector.name == "semslam"
    assert found.scores == pytest.approx([0.4], abs=1e-3)  # half of the square input is picture
    assert len(detector(GREY, 0.1, 0.5)) == 0  # nobody measured depth


def test_many_pictures_in_one_run_are_as_one_by_one(tmp_path: Path) -> None:
    """Sizes differ, depths differ; the session is asked once."""
    detector = Detector.open(rgbd_detector(tmp_path / "m.onnx", metadata=NAMES))
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (60 + 9 * i, 80, 3), np.uint8) for i in range(3)]
    depths = [np.full(picture.shape[:2], 0.3 + 0.2 * i, np.float32) for i, picture in enumerate(pictures)]
    runs = _counting(detector)
    together = detector.look(pictures, depths, 0.1, 0.5)
    assert runs == [3]
    for found, picture, depth in zip(together, pictures, depths, strict=True):
        alone = detector(picture, 0.1, 0.5, depth)
        np.testing.assert_array_equal(found.boxes, alone.boxes)
        np.testing.assert_array_equal(found.scores, alone.scores)


def test_a_model_of_fixed_batch_is_asked_one_by_one(tmp_path: Path) -> None:
    """And one that promises an open batch but answers once for all of them, too."""
    rows = dense(CELLS, 6, {7: [32, 32, 20, 8, 0.1, 0.6]}).transpose(0, 2, 1).copy()
    for shape in ((1, 3, 64, 64), ("batch", 3, 64, 64)):
        declared = {"output0": ("batch", 6, CELLS)} if shape[0] == "batch" else None
        detector = _detector(tmp_path, {"output0": rows}, input_shape=shape, declared=declared)
        found = detector.look([GREY, GREY], [np.zeros((64, 128), np.float32)] * 2, 0.3, 0.5)
        assert [len(one) for one in found] == [1, 1]


def _counting(detector: Detector) -> list[int]:
    """Number of pictures of each run from now on."""
    sizes: list[int] = []
    session = detector.session
    inner = session._ort

    class Counting:
        def run(self, names: object, feeds: dict[str, NDArray[np.float32]]) -> object:
            sizes.append(len(feeds["images"]))
            return inner.run(names, feeds)

    object.__setattr__(session, "_ort", Counting())
    return sizes


# ------------------------------------------------------------------------------------------------------------- anchors


def _heads(form: str, raw: list[float], *, stride: int = 16, row: int = 1, column: int = 2, anchor: int = 1) -> Outputs:
    """Three heads of two classes with one raw prediction; all other objectness is far below zero."""
    outputs: Outputs = {}
    for index, step in enumerate((32, 16, 8)):
        side = 64 // step
        grid = np.full((3, side, side, 7), -20, np.float32)
        if step == stride:
            grid[anchor, row, column] = raw
        if form == "channels_first":
            grid = grid.transpose(0, 3, 1, 2).reshape(1, 21, side, side)
        elif form == "channels_last":
            grid = grid.transpose(1, 2, 0, 3).reshape(1, side, side, 21)
        else:
            grid = grid[None]
        outputs[f"head{index}"] = np.ascontiguousarray(grid)
    return outputs


@pytest.mark.parametrize("form", ["channels_first", "channels_last", "anchors_apart"])
def test_yolov3_heads_are_decoded_with_their_anchors(tmp_path: Path, form: str) -> None:
    """Cell (2, 1) of stride 16, anchor 62 x 45: the order of heads is read off their sizes."""
    raw = [_logit(0.25), _logit(0.5), math.log(0.5), math.log(0.4), _logit(0.9), -20, _logit(0.8)]
    detector = _detector(tmp_path, _heads(form, raw))
    found = detector(GREY, 0.3, 0.5)
    # Centre (2.25, 1.5) * 16 = (36, 24), size (31, 18): rows 16 of the letterbox taken off, then twice as large.
    _boxes(found, [[41, 0, 103, 34]])
    assert (detector.name, found.class_ids.tolist()) == ("yolov3", [1])
    assert found.scores == pytest.approx([0.72], abs=1e-3)


def test_yolov3_takes_anchors_of_its_own_from_metadata(tmp_path: Path) -> None:
    """Trained on other boxes: anchor 20 x 10 in place of 62 x 45."""
    raw = [0, _logit(0.5), 0, 0, _logit(0.9), _logit(0.8), -20]
    anchors = [[[1, 1]] * 3, [[1, 1], [20, 10], [1, 1]], [[1, 1]] * 3]
    outputs = _heads("channels_first", raw, column=1)
    found = _detector(tmp_path, outputs, metadata={**NAMES, "anchors": str(anchors)})(GREY, 0.3, 0.5)
    _boxes(found, [[28, 6, 68, 26]])


def test_yolov5_raw_heads_are_read_when_named(tmp_path: Path) -> None:
    """Same shapes, other formulas: centre 2s - 0.5, size (2s)^2."""
    raw = [_logit(0.5), _logit(0.5), _logit(0.25), _logit(0.25), _logit(0.9), -20, _logit(0.8)]
    path = constant_detector(tmp_path / "m.onnx", _heads("anchors_apart", raw), metadata=NAMES)
    found = Detector.open(path, adapter="yolov5_raw")(GREY, 0.3, 0.5)
    # Centre (2.5, 1.5) * 16 = (40, 24), size (62, 45) / 4.
    _boxes(found, [[64.5, 4.75, 95.5, 27.25]])
    assert Detector.open(path).name == "yolov3"


def test_the_model_zoos_yolov3_is_told_the_pictures_size(tmp_path: Path) -> None:
    """Boxes come as top, left, bottom, right of the picture; an index beyond the boxes is no object."""
    boxes = np.array([[[0, 0, 1, 1], [10, 20, 30, 60]]], np.float32)
    scores = np.zeros((1, 2, 2), np.float32)
    scores[0, 1, 1] = 0.8
    indices = np.array([[[0, 1, 1], [0, 1, 77], [-1, -1, -1]]], np.int32)
    detector = _detector(
        tmp_path,
        {"yolonms_layer_1/ExpandDims_1:0": boxes, "yolonms_layer_1/ExpandDims_3:0": scores, "nms": indices},
        input_shape=("N", 3, "h", "w"),
        other_inputs={"image_shape": (1, 2)},
    )
    found = detector(GREY, 0.3, 0.5)
    assert detector.name == "yolov3_zoo"
    _boxes(found, [[20, 10, 60, 30]])
    assert found.class_ids.tolist() == [1]


# --------------------------------------------------------------------------------------------------------------- masks


def _prototypes(side: int) -> NDArray[np.float32]:
    """Two grids over the input: the first is positive on its left half, the second on its upper half."""
    grids = np.full((1, 2, side, side), -1, np.float32)
    grids[0, 0, :, : side // 2] = 1
    grids[0, 1, : side // 2] = 1
    return grids


@pytest.mark.parametrize("side", [16, 32, 64])
def test_yolov8_seg_masks_are_prototypes_cut_to_the_box(tmp_path: Path, side: int) -> None:
    """The left half of the input is columns 0 to 64 of the picture; prototypes may have any size."""
    columns = dense(CELLS, 8, {7: [32, 32, 40, 16, 0.1, 0.6, 1.0, 0.0]}).transpose(0, 2, 1).copy()
    detector = _detector(tmp_path, {"output0": columns, "output1": _prototypes(side)})
    found = detector(GREY, 0.3, 0.5)
    assert detector.name == "yolov8_seg"
    _boxes(found, [[24, 16, 104, 48]])
    assert found.masks is not None
    assert found.masks.shape == (1, 64, 128)
    expected = np.zeros((64, 128), bool)
    expected[16:48, 24:64] = True
    difference = np.flatnonzero((found.masks[0] != expected).any(axis=0))
    assert set(difference) <= set(range(62, 67))  # interpolation at the edge of the prototype, nowhere else


def test_masks_undo_the_letterbox_down_too(tmp_path: Path) -> None:
    """The upper half of the input ends at row 32, which is row 32 of the picture."""
    columns = dense(CELLS, 8, {7: [32, 32, 60, 30, 0.1, 0.6, 0.0, 1.0]}).transpose(0, 2, 1).copy()
    found = _detector(tmp_path, {"output0": columns, "output1": _prototypes(64)})(GREY, 0.3, 0.5)
    assert found.masks is not None
    rows = np.flatnonzero(found.masks[0, :, 64])
    assert (rows[0], rows[-1]) == (2, pytest.approx(31, abs=1))


def test_selected_candidates_with_coefficients_give_masks(tmp_path: Path) -> None:
    """YOLO26-seg: rows of box, score, class, coefficients; a class number without a name is dropped and counted."""
    rows = dense(30, 8, {0: [12, 24, 52, 40, 0.9, 1, 1.0, 0.0], 1: [0, 16, 20, 40, 0.8, 7, 1.0, 0.0]})
    detector = _detector(tmp_path, {"output0": rows, "output1": _prototypes(16)})
    found = detector(GREY, 0.3, 0.5)
    assert (detector.name, found.class_ids.tolist(), found.dropped) == ("yolo26_seg", [1], 1)
    _boxes(found, [[24, 16, 104, 48]])
    assert found.masks is not None
    assert found.masks[0, 20, 30]
    assert not found.masks[0, 20, 90]


def test_coefficients_that_are_no_numbers_give_an_empty_mask(tmp_path: Path) -> None:
    """And neither a warning nor a traceback."""
    columns = dense(CELLS, 8, {7: [32, 32, 40, 16, 0.1, 0.6, np.nan, np.inf]}).transpose(0, 2, 1).copy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = _detector(tmp_path, {"output0": columns, "output1": _prototypes(16)})(GREY, 0.3, 0.5)
    assert found.masks is not None
    assert not found.masks.any()


# ------------------------------------------------------------------------------------------------------------- queries


def test_rows_of_six_are_box_score_and_class(tmp_path: Path) -> None:
    """YOLOv10, YOLO26, and exports with suppression inside; a class that is no number is counted."""
    rows = dense(300, 6, {0: [22, 28, 42, 36, 0.6, 1], 5: [0, 16, 9, 30, 0.9, np.nan]})
    detector = _detector(tmp_path, {"output0": rows}, metadata={"names": str(list("abc"))})
    found = detector(GREY, 0.3, 0.5)
    assert (detector.name, found.class_ids.tolist(), found.dropped) == ("yolov10", [1], 1)
    _boxes(found, [[44, 24, 84, 40]])


def test_transformer_rows_are_shares_of_a_stretched_picture(tmp_path: Path) -> None:
    """Two classes named make rows of six values a transformer's."""
    rows = dense(300, 6, {3: [0.5, 0.5, 0.25, 0.5, 0.1, 0.7]})
    detector = _detector(tmp_path, {"output0": rows})
    found = detector(GREY, 0.3, 0.5)
    assert (detector.name, found.class_ids.tolist()) == ("rtdetr", [1])
    _boxes(found, [[48, 16, 80, 48]])


def test_rows_of_six_may_be_a_transformers(tmp_path: Path) -> None:
    """Later exports of RT-DETR: told by their metadata, and without those by shares where pixels are expected."""
    rows = dense(300, 6, {3: [0.5, 0.5, 0.25, 0.5, 0.7, 2]})
    names = {"names": "['a', 'b', 'c']"}
    found = _detector(tmp_path, {"output0": rows}, metadata={**names, "head": "RTDETRDecoder"})(GREY, 0.3, 0.5)
    _boxes(found, [[48, 16, 80, 48]])
    assert found.class_ids.tolist() == [2]
    with pytest.raises(SemslamError, match="shares") as caught:
        _detector(tmp_path, {"output0": rows}, metadata=names)(GREY, 0.3, 0.5)
    assert "rtdetr_rows" in caught.value.hint
    path = constant_detector(tmp_path / "n.onnx", {"output0": rows}, metadata=names)
    _boxes(Detector.open(path, adapter="rtdetr_rows")(GREY, 0.3, 0.5), [[48, 16, 80, 48]])


def test_a_transformer_of_many_classes_is_not_taken_for_yolov8(tmp_path: Path) -> None:
    """More classes than queries: only the names tell rows from columns."""
    rows = dense(100, 104, {3: [0.5, 0.5, 0.25, 0.5, *([0.0] * 99), 0.7]})
    names = {"names": str([f"thing {i}" for i in range(100)])}
    assert _detector(tmp_path, {"output0": rows}, metadata=names).name == "rtdetr"


def test_boxes_in_pixels_are_refused_where_shares_are_expected(tmp_path: Path) -> None:
    """They would lie far outside, be clipped, and nobody be told."""
    rows = dense(300, 84, {3: [320, 320, 100, 50, *([0.0] * 79), 0.7]})
    detector = _detector(tmp_path, {"output0": rows}, metadata={"names": str([f"thing {i}" for i in range(80)])})
    with pytest.raises(SemslamError, match="pixels"):
        detector(GREY, 0.3, 0.5)


def test_the_authors_rtdetr_answers_in_pixels_of_the_picture(tmp_path: Path) -> None:
    """It is told width and height, in this order, and says no number of classes."""
    boxes = dense(9, 4, {2: [30, 20, 60, 50], 3: [-40, -40, -10, -10]})
    scores, labels = np.zeros((1, 9), np.float32), np.zeros((1, 9), np.int64)
    scores[0, [2, 3]], labels[0, 2] = 0.8, 1
    outputs: Outputs = {"labels": labels, "boxes": boxes, "scores": scores}
    detector = _detector(tmp_path, outputs, other_inputs={"orig_target_sizes": ((1, 2), TensorProto.INT64)})
    found = detector(GREY, 0.3, 0.5)
    assert (detector.name, found.class_ids.tolist(), found.dropped) == ("rtdetr_sized", [1], 1)
    _boxes(found, [[30, 20, 60, 50]])


def _logits(rows: int, columns: int, filled: dict[int, list[float]]) -> NDArray[np.float32]:
    """(1, rows, columns), -9 where nothing is filled in."""
    return np.where(dense(rows, columns, {k: [1.0] * columns for k in filled}) > 0, dense(rows, columns, filled), -9)  # type: ignore[return-value]


def _queries(names: tuple[str, str], columns: int, logits: list[float]) -> Outputs:
    boxes = dense(20, 4, {4: [0.5, 0.5, 0.25, 0.5]})
    return {names[0]: _logits(20, columns, {4: logits}).astype(np.float32), names[1]: boxes}


def test_as_many_logits_as_names_are_sigmoids(tmp_path: Path) -> None:
    """RT-DETR as Transformers exports it; the square takes the picture stretched."""
    detector = _detector(tmp_path, _queries(("logits", "pred_boxes"), 2, [-3, _logit(0.7)]))
    found = detector(GREY, 0.3, 0.5)
    assert detector.name == "rtdetr_logits"
    assert found.scores == pytest.approx([0.7], abs=1e-3)
    _boxes(found, [[48, 16, 80, 48]])


def test_one_logit_more_than_names_is_no_object(tmp_path: Path) -> None:
    """DETR: a query that prefers `no object` is none, whatever its second choice."""
    outputs = _queries(("logits", "pred_boxes"), 3, [0, 2, 1])
    outputs["logits"][0, 7] = [0, 2, 5]
    outputs["pred_boxes"][0, 7] = [0.2, 0.2, 0.1, 0.1]
    detector = _detector(tmp_path, outputs)
    found = detector(GREY, 0.3, 0.5)
    assert (detector.name, found.class_ids.tolist()) == ("detr", [1])
    assert found.scores == pytest.approx([np.exp(2) / (1 + np.exp(2) + np.exp(1))], abs=1e-3)


def test_as_many_queries_as_cells_of_a_stride_are_still_queries(tmp_path: Path) -> None:
    """Sixteen queries, and sixteen cells of stride 16: NanoDet has more than one stride."""
    outputs: Outputs = {"logits": np.zeros((1, 16, 3), np.float32), "pred_boxes": np.zeros((1, 16, 4), np.float32)}
    assert _detector(tmp_path, outputs).name == "detr"


@pytest.mark.parametrize("columns", [2, 3])
def test_rfdetr_boxes_and_logits_are_told_by_name_and_its_masks_read(tmp_path: Path, columns: int) -> None:
    """Its last column may mean no object; its masks are grids over the stretched picture."""
    outputs = _queries(("labels", "dets"), columns, [-3, _logit(0.7), 9][:columns])
    outputs["masks"] = np.full((1, 20, 16, 16), -1, np.float32)
    outputs["masks"][0, 4, :, :8] = 1  # type: ignore[call-overload]
    detector = _detector(tmp_path, outputs)
    found = detector(GREY, 0.3, 0.5)
    assert detector.name == "rfdetr"
    assert found.scores == pytest.approx([0.7], abs=1e-3)
    assert found.masks is not None
    assert found.masks[0, 30, 50]
    assert not found.masks[0, 30, 75]


def test_queries_that_are_no_numbers_are_dropped_and_counted(tmp_path: Path) -> None:
    """Twenty queries, nothing but NaN."""
    outputs: Outputs = {"logits": np.full((1, 20, 2), np.nan, np.float32), "pred_boxes": dense(20, 4, {})}
    found = _detector(tmp_path, outputs)(GREY, 0.3, 0.5)
    assert (len(found), found.dropped) == (0, 20)


def test_double_queries_are_one_object(tmp_path: Path) -> None:
    """Every query at the same place: one remains."""
    outputs: Outputs = {
        "logits": np.full((1, 20, 2), 2, np.float32),
        "pred_boxes": np.full((1, 20, 4), 0.5, np.float32),
    }
    assert len(_detector(tmp_path, outputs)(GREY, 0.3, 0.5)) == 1


# ---------------------------------------------------------------------------------------------------------- class maps

ROOM = {"names": "['wall', 'chair', 'floor;flooring', 'table']"}


def _room() -> NDArray[np.int64]:
    """Wall above, floor below, a wide chair, a small table, and a speck."""
    room = np.zeros((64, 64), np.int64)
    room[40:] = 2
    room[20:40, 10:40] = 1
    room[30:44, 50:60] = 3
    room[2:4, 2:3] = 3
    return room


@pytest.mark.parametrize("shape", [(1, 64, 64), (1, 1, 64, 64)])
def test_pieces_of_a_class_map_are_objects_and_walls_are_not(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """Numbers alone are certain; boxes are those of the pieces, in the picture."""
    detector = _detector(tmp_path, {"out": _room().reshape(shape)}, metadata=ROOM)
    found = detector(GREY, 0.3, 0.5)
    assert (detector.name, sorted(found.class_ids.tolist())) == ("class_map", [1, 3])
    order = np.argsort(found.class_ids)
    np.testing.assert_allclose(found.boxes[order], [[20, 20, 80, 40], [100, 30, 120, 44]], atol=1)
    assert found.masks is not None
    assert found.masks[order[0]].sum() == pytest.approx(60 * 20, rel=0.1)
    assert found.scores.tolist() == [1.0, 1.0]


def test_a_step_of_depth_parts_two_chairs_that_touch(tmp_path: Path) -> None:
    """One at 1 m, one at 2 m; without depth, or on a slope, they are one."""
    detector = _detector(tmp_path, {"out": _room()[None]}, metadata={"names": "['wall', 'chair', 'floor', 'ceiling']"})
    depth = np.full((64, 128), 1.0, np.float32)
    depth[:, 50:] = 2.0
    found = detector(GREY, 0.3, 0.5, depth)
    assert len(found) == 2
    assert found.masks is not None
    assert (found.masks.sum(axis=0) <= 1).all()
    assert found.masks.sum() == pytest.approx(60 * 20, rel=0.1)
    slope = np.broadcast_to(np.linspace(1, 2, 128, dtype=np.float32), (64, 128)).copy()
    for whole in (None, slope, np.zeros((64, 128), np.float32)):
        assert len(detector(GREY, 0.3, 0.5, whole)) == 1


def test_logits_of_a_class_map_give_their_certainty(tmp_path: Path) -> None:
    """Half the size of the input; odds of e to 1 against each of three others."""
    room = _room()[::2, ::2]
    logits = (np.arange(4)[:, None, None] == room).astype(np.float32)[None] * 1.0
    found = _detector(tmp_path, {"logits": logits}, metadata=ROOM)(GREY, 0.3, 0.5)
    assert sorted(found.class_ids.tolist()) == [1, 3]
    assert found.scores == pytest.approx([np.e / (np.e + 3)] * 2, abs=0.02)
    assert len(_detector(tmp_path, {"logits": logits}, metadata=ROOM)(GREY, 0.6, 0.5)) == 0


def test_coarse_logits_are_enlarged_before_they_are_compared(tmp_path: Path) -> None:
    """Sixteen times smaller, 150 classes: an outline between two cells, not on their edges."""
    logits = np.full((1, 150, 4, 4), -3, np.float32)
    logits[0, 0], logits[0, 1], logits[0, 1, 1:3, 1:3] = 0, -1.5, 6
    names = {"names": str(["wall", *(f"thing {i}" for i in range(149))])}
    found = _detector(tmp_path, {"logits": logits}, metadata=names)(GREY, 0.3, 0.5)
    assert found.class_ids.tolist() == [1]
    left, top, right, bottom = found.boxes[0]
    assert 16 < left < 32
    assert 96 < right < 112
    assert 8 < top < 16
    assert 48 < bottom < 56


def test_a_class_map_of_nan_shows_nothing_and_says_so(tmp_path: Path) -> None:
    """Pixels that are no numbers are no object; the rest is read."""
    logits = (np.arange(4)[:, None, None] == _room()).astype(np.float32)[None] * 5
    logits[:, :, 28:] = np.nan
    found = _detector(tmp_path, {"logits": logits}, metadata=ROOM)(GREY, 0.3, 0.5)
    assert found.class_ids.tolist() == [1]
    assert found.boxes[0, 3] <= 29
    assert found.dropped == 1  # the picture, not each of its pixels


def test_a_class_map_may_take_pixels_and_answer_numbers(tmp_path: Path) -> None:
    """DeepLab's own export: (1, h, w, 3) bytes in."""
    detector = _detector(
        tmp_path,
        {"SemanticPredictions:0": _room()[None]},
        input_shape=(1, 64, 64, 3),
        input_kind=TensorProto.UINT8,
        metadata=ROOM,
    )
    assert detector.name == "class_map"
    assert len(detector(GREY, 0.3, 0.5)) == 2


def test_an_embedding_is_no_class_map(tmp_path: Path) -> None:
    """The image encoder of a segmenter has the shape of logits, and must not be read as 256 classes."""
    features = np.zeros((1, 16, 16, 16), np.float32)
    path = constant_detector(tmp_path / "m.onnx", {"image_embeddings": features})
    with pytest.raises(SemslamError, match="No adapter fits"):
        Detector.open(path)


# ------------------------------------------------------------------------------------------------------------ all alike

LAYOUTS: dict[str, Outputs] = {
    "yolov3": _heads("channels_first", [30.0] * 7),
    "yolov8_seg": {"output0": np.full((1, 8, CELLS), 0.99, np.float32), "output1": _prototypes(16)},
    "yolov10": {"output0": np.tile(np.array([10, 20, 30, 40, 0.9, 1], np.float32), (1, 300, 1))},
    "rtdetr": {"output0": np.full((1, 300, 6), 0.99, np.float32)},
    "rtdetr_logits": {"logits": np.ones((1, 20, 2), np.float32), "pred_boxes": np.ones((1, 20, 4), np.float32)},
    "detr": {"logits": np.ones((1, 20, 3), np.float32), "pred_boxes": np.ones((1, 20, 4), np.float32)},
    "rfdetr": {"labels": np.ones((1, 20, 2), np.float32), "dets": np.ones((1, 20, 4), np.float32)},
    "class_map": {"logits": np.ones((1, 2, 16, 16), np.float32)},
}


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("name", LAYOUTS)
def test_impossible_values_end_as_detections_or_as_a_sentence(tmp_path: Path, name: str, spoilt: float) -> None:
    """Whatever half of the values become: boxes lie inside, masks have the picture's size, scores are probabilities."""
    rng = np.random.default_rng(3)
    outputs = {key: np.where(rng.random(array.shape) < 0.5, spoilt, array) for key, array in LAYOUTS[name].items()}
    names = {"names": "['a', 'b', 'c']"} if name == "yolov10" else NAMES
    detector = _detector(tmp_path, {key: array.astype(np.float32) for key, array in outputs.items()}, metadata=names)
    assert detector.name == name
    try:
        found = detector(GREY, 0.3, 0.5)
    except SemslamError:
        return
    assert np.isfinite(found.boxes).all()
    assert ((found.boxes >= 0) & (found.boxes <= [128, 64, 128, 64])).all()
    assert ((found.scores >= 0.3) & (found.scores <= 1.001)).all()
    assert found.masks is None or found.masks.shape == (len(found), 64, 128)


@pytest.mark.parametrize("size", [(480, 640), (33, 517), (1, 1)])
@pytest.mark.parametrize("name", LAYOUTS)
def test_any_picture_size_is_taken_by_every_layout(tmp_path: Path, name: str, size: tuple[int, int]) -> None:
    """Depth of the same size comes along."""
    names = {"names": "['a', 'b', 'c']"} if name == "yolov10" else NAMES
    detector = _detector(tmp_path, LAYOUTS[name], metadata=names)
    found = detector(np.zeros((*size, 3), np.uint8), 0.3, 0.5, np.ones(size, np.float32))
    assert found.masks is None or found.masks.shape == (len(found), *size)


# ------------------------------------------------------------------------------------------------------------ the page

PAGE = Path(__file__).parent.parent / "docs/models.md"


def test_the_pages_adapter_is_one_file_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of docs/models.md, as it stands, reads a network of its layout once its name is in the table."""
    code = re.search(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert code is not None
    (tmp_path / "corners.py").write_text(code.group(1))
    monkeypatch.setattr(detectors, "__path__", [*detectors.__path__, str(tmp_path)])
    monkeypatch.setattr(table, "LAYOUTS", (*table.LAYOUTS, "corners"))
    monkeypatch.setattr(detector, "ADAPTERS", table.adapters(table.LAYOUTS))
    outputs: Outputs = {"corners": dense(3, 4, {1: [22, 28, 42, 36]}), "scores": dense(3, 2, {1: [0.1, 0.6]})}
    found = _detector(tmp_path, outputs)
    assert found.name == "corners"
    _boxes(found(GREY, 0.3, 0.5), [[44, 24, 84, 40]])


def test_the_page_lists_every_adapter() -> None:
    """By the name that `extract.adapter` takes, and none that does not exist."""
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", PAGE.read_text().split("## Segmenters")[0], re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == {a.name for a in detectors.ADAPTERS}


def test_every_adapter_is_refused_by_name_where_it_does_not_fit(tmp_path: Path) -> None:
    """With a sentence about what it wants; none of them falls over a strange signature."""
    strange: dict[str, Outputs] = {
        "numbers": {"a": np.zeros((1, 1, 1), np.int64), "b": np.zeros(3, np.float32)},
        "scalar": {"a": np.zeros((), np.float32)},
        "flat": {"a": np.zeros((1, 1000), np.float32)},
    }
    for name, outputs in strange.items():
        path = constant_detector(tmp_path / f"{name}.onnx", outputs, metadata=NAMES)
        for adapter in ("auto", *(a.name for a in detectors.ADAPTERS)):
            with pytest.raises(SemslamError, match=r"m\.onnx|onnx"):
                Detector.open(path, adapter=adapter)
