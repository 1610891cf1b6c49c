"""Detectors: exact boxes from networks with chosen outputs, layouts told apart, class names, and every refusal."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detectors import ADAPTERS, Detector
from tests.onnx_factory import constant_detector, dense

GREY = np.full((64, 128, 3), 90, np.uint8)
"""Half as high as wide: in a 64 x 64 input it takes 64 x 32, scale 0.5; centred it begins at row 16."""
NAMES = {"names": "{0: 'cup', 1: 'chair'}"}
CELLS = 8 * 8 + 4 * 4 + 2 * 2


def _same(found: NDArray[np.float32], expected: list[list[float]]) -> None:
    np.testing.assert_allclose(found, np.array(expected, np.float32).reshape(-1, 4), atol=1e-3)


def test_yolox_boxes_are_decoded_from_their_cells(tmp_path: Path) -> None:
    """Row 64 + 5 is column 1, row 1 of stride 16; offsets, log sizes and the corner letterbox give one exact box."""
    rows = dense(CELLS, 7, {69: [0.5, 0.25, np.log(1.5), np.log(0.5), 0.9, 0.1, 0.8]})
    found = Detector.open(constant_detector(tmp_path / "m.onnx", {"output": rows}, metadata=NAMES))(GREY, 0.3, 0.5)
    # Centre (1.5, 1.25) * 16 = (24, 20), size (24, 8): (12, 16, 36, 24) in the input, twice that in the picture.
    _same(found.boxes, [[24, 32, 72, 48]])
    assert found.scores == pytest.approx([0.72])
    assert found.class_ids.tolist() == [1]


def test_yolov5_boxes_are_centre_and_size_in_a_centred_letterbox(tmp_path: Path) -> None:
    """Three anchors a cell; the 16 rows above the picture are taken off."""
    rows = dense(3 * CELLS, 7, {5: [32, 32, 20, 8, 0.5, 0.9, 0.2]})
    detector = Detector.open(constant_detector(tmp_path / "m.onnx", {"output0": rows}, metadata=NAMES))
    found = detector(GREY, 0.3, 0.5)
    assert detector.name == "yolov5"
    _same(found.boxes, [[44, 24, 84, 40]])
    assert found.scores == pytest.approx([0.45])


def test_yolov8_boxes_are_columns_without_objectness(tmp_path: Path) -> None:
    """(1, 4 + classes, N): the score is the class score itself."""
    columns = dense(CELLS, 6, {7: [32, 32, 20, 8, 0.1, 0.6]}).transpose(0, 2, 1).copy()
    detector = Detector.open(constant_detector(tmp_path / "m.onnx", {"output0": columns}, metadata=NAMES))
    found = detector(GREY, 0.3, 0.5)
    assert detector.name == "yolov8"
    _same(found.boxes, [[44, 24, 84, 40]])
    assert found.scores == pytest.approx([0.6])
    assert found.class_ids.tolist() == [1]


def test_nanodet_distances_are_expectations_in_strides(tmp_path: Path) -> None:
    """A distribution on one bin is that many strides; 0.5 px is the leeway between conventions of a cell's centre."""
    sizes = {8: 64, 16: 16, 32: 4}
    scores = {f"cls_{s}": dense(n, 2, {5: [0.1, 0.7]} if s == 16 else {}) for s, n in sizes.items()}
    bins = np.full((4, 8), -50, np.float32)
    bins[[0, 1, 2, 3], [1, 1, 1, 0]] = 50  # left 1, top 1, right 1, bottom 0 strides
    distances = {f"dis_{s}": dense(n, 32, {5: bins.ravel().tolist()} if s == 16 else {}) for s, n in sizes.items()}
    detector = Detector.open(constant_detector(tmp_path / "m.onnx", {**scores, **distances}, metadata=NAMES))
    found = detector(np.full((64, 64, 3), 90, np.uint8), 0.3, 0.5)
    assert detector.name == "nanodet"
    np.testing.assert_allclose(found.boxes, [[8, 8, 40, 24]], atol=0.51)
    assert found.class_ids.tolist() == [1]


def test_overlapping_boxes_of_one_class_are_one_object_those_of_two_are_two(tmp_path: Path) -> None:
    """Suppression is class by class, and scores fall."""
    rows = dense(3 * CELLS, 7, {
        0: [32, 32, 20, 8, 1, 0.5, 0], 1: [33, 32, 20, 8, 1, 0.9, 0], 2: [32, 32, 20, 8, 1, 0, 0.7],
    })  # fmt: skip
    found = Detector.open(constant_detector(tmp_path / "m.onnx", {"o": rows}, metadata=NAMES))(GREY, 0.3, 0.5)
    assert found.class_ids.tolist() == [0, 1]
    assert found.scores == pytest.approx([0.9, 0.7])


def test_impossible_boxes_are_dropped_and_counted(tmp_path: Path) -> None:
    """Not a number, infinite, and wholly outside the picture: three dropped, the fourth clipped and kept."""
    rows = dense(3 * CELLS, 7, {
        0: [np.nan, 32, 8, 8, 1, 0.9, 0], 1: [32, 32, np.inf, 8, 1, 0.9, 0], 2: [-90, 32, 8, 8, 1, 0.9, 0],
        3: [0, 32, 20, 8, 1, 0.9, 0],
    })  # fmt: skip
    found = Detector.open(constant_detector(tmp_path / "m.onnx", {"o": rows}, metadata=NAMES))(GREY, 0.3, 0.5)
    _same(found.boxes, [[0, 24, 20, 40]])
    assert found.dropped == 3


def test_a_network_that_answers_nothing_but_nan_gives_no_boxes(tmp_path: Path) -> None:
    """As an overflowing network does: empty arrays of the right shape, everything counted."""
    rows = np.full((1, CELLS, 7), np.nan, np.float32)
    found = Detector.open(constant_detector(tmp_path / "m.onnx", {"o": rows}, metadata=NAMES))(GREY, 0.3, 0.5)
    assert (found.boxes.shape, len(found), found.dropped) == ((0, 4), 0, CELLS)


@pytest.mark.parametrize("size", [(480, 640), (333, 517), (20, 900), (1, 1)])
def test_any_picture_size_is_taken(tmp_path: Path, size: tuple[int, int]) -> None:
    """A box over the whole input becomes one over the whole picture."""
    rows = dense(3 * CELLS, 7, {0: [32, 32, 64, 64, 1, 0.9, 0]})
    detector = Detector.open(constant_detector(tmp_path / "m.onnx", {"o": rows}, metadata=NAMES))
    found = detector(np.zeros((*size, 3), np.uint8), 0.3, 0.5)
    if min(size) > 1:
        _same(found.boxes, [[0, 0, size[1], size[0]]])
    else:
        assert (len(found), found.dropped) == (0, 1)  # a box of one pixel is no object


@pytest.mark.parametrize(
    "names", ["{0: 'cup', 1: 'chair'}", '{"1": "chair", "0": "cup"}', '["cup", "chair"]', "['cup', 'chair']"]
)
def test_class_names_come_from_metadata_in_any_usual_form(tmp_path: Path, names: str) -> None:
    """A Python literal as Ultralytics writes it, or JSON."""
    path = constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, metadata={"names": names})
    assert Detector.open(path).class_names == ("cup", "chair")


def test_class_file_may_have_a_byte_order_mark_blank_and_windows_lines(tmp_path: Path) -> None:
    """Files made on Windows are read as meant, and go before the metadata."""
    path = constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, metadata=NAMES)
    (tmp_path / "c.txt").write_bytes(b"\xef\xbb\xbfmug\r\n\r\ndining table \r\n")
    assert Detector.open(path, classes_path=tmp_path / "c.txt").class_names == ("mug", "dining table")


def test_missing_names_say_how_to_give_them(tmp_path: Path) -> None:
    """No metadata, no file."""
    path = constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})})
    with pytest.raises(SemslamError, match="2 classes") as caught:
        Detector.open(path)
    assert "--classes FILE" in caught.value.hint


def test_a_list_of_the_wrong_length_tells_both_numbers(tmp_path: Path) -> None:
    """Three names for two classes."""
    path = constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})})
    (tmp_path / "c.txt").write_text("a\nb\nc\n")
    with pytest.raises(SemslamError, match=r"2 classes.*3"):
        Detector.open(path, classes_path=tmp_path / "c.txt")


def test_an_unknown_layout_shows_what_was_found_and_what_was_tried(tmp_path: Path) -> None:
    """The error names the output, its shape and every adapter."""
    path = constant_detector(tmp_path / "m.onnx", {"strange": np.zeros((1, 5000, 3), np.float32)})
    with pytest.raises(SemslamError) as caught:
        Detector.open(path)
    text = caught.value.text()
    assert all(word in text for word in ("strange", "5000", *(adapter.name for adapter in ADAPTERS)))


def test_an_adapter_that_does_not_fit_is_refused_even_when_named(tmp_path: Path) -> None:
    """So is a name that does not exist."""
    path = constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, metadata=NAMES)
    with pytest.raises(SemslamError, match="yolov5"):
        Detector.open(path, adapter="yolov5")
    with pytest.raises(SemslamError, match="yolov99") as caught:
        Detector.open(path, adapter="yolov99")
    assert "yolox" in caught.value.hint


def test_inspect_tells_adapter_and_reasons_as_text_and_json(tmp_path: Path) -> None:
    """Both forms carry the adapter, and the JSON is plain."""
    from semslam.models.inspect import describe

    described = describe(constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, metadata=NAMES))
    plain = json.loads(json.dumps(described.as_json()))
    assert (plain["adapter"], plain["classes"], plain["class_names"]) == ("yolox", 2, ["cup", "chair"])
    assert "yolox" in described.text()


DATA = os.environ.get("SEMSLAM_TEST_DATA", "")


@pytest.mark.skipif(not DATA, reason="SEMSLAM_TEST_DATA is unset")
@pytest.mark.parametrize(("model", "adapter"), [("yolox_nano", "yolox"), ("nanodet_m_320", "nanodet")])
def test_real_models_find_the_chair_of_a_real_kitchen(model: str, adapter: str) -> None:
    """In the first colour picture a chair stands between table and counter, left of the middle."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with (Path(DATA) / "logs/redkitchen.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        topic = "/camera/color/image_raw/compressed"
        _, _, _, message = next(iter(reader.iter_decoded_messages(topics=[topic])))
    picture = np.asarray(cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)
    folder = Path(DATA) / "models"
    detector = Detector.open(folder / f"{model}.onnx", classes_path=folder / "coco_classes.txt")
    found = detector(picture, 0.5, 0.5)
    chairs = found.boxes[found.class_ids == detector.class_names.index("chair")]
    assert detector.name == adapter
    # The chair behind the table covers about columns 170 to 305, rows 120 to 365 of 640 x 480.
    centres = (chairs[:, :2] + chairs[:, 2:]) / 2
    assert np.any((np.abs(centres - [237, 230]) < [70, 80]).all(axis=1))
