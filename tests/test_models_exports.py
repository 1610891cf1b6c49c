"""Exports that are easily misread: each is read right, or refused with a reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from semslam.errors import SemslamError
from semslam.models.detectors import Detector
from semslam.models.segmenters import open_segmenter
from tests.onnx_factory import constant_detector, dense, sam_decoder, sam_encoder, save, value

NAMES = {"names": "{0: 'cup', 1: 'chair'}"}
CELLS = 84
GREY = np.full((64, 64, 3), 90, np.uint8)


def _decoded_yolox(path: Path) -> Path:
    """Same shape as the raw export, but boxes leave in pixels: the graph itself holds Exp."""
    rows = dense(CELLS, 7, {69: [0.5, 0.25, np.log(1.5), np.log(0.5), 0.9, 0.1, 0.8]})
    pixels = dense(CELLS, 7, {69: [24, 20, 24, 8, 0.9, 0.1, 0.8]})
    nodes = [helper.make_node("Exp", ["raw"], ["unused"]), helper.make_node("Identity", ["pixels"], ["output"])]
    outputs = [value("output", (1, CELLS, 7))]
    inputs = [value("images", (1, 3, 64, 64))]
    return save(path, nodes, inputs, outputs, {"raw": rows, "pixels": pixels}, metadata=NAMES)


def test_a_decoded_yolox_export_is_not_read_as_raw(tmp_path: Path) -> None:
    """The box is (12, 16, 36, 24); read as raw offsets it is somewhere else, and nobody is told."""
    found = Detector.open(_decoded_yolox(tmp_path / "m.onnx"))(GREY, 0.3, 0.5)
    np.testing.assert_allclose(found.boxes, [[12, 16, 36, 24]], atol=1e-3)


def test_a_yolox_export_of_open_size_is_not_taken_for_yolov5(tmp_path: Path) -> None:
    """Rows known only at run time: yolox is refused for want of a number, yolov5 accepted for want of one."""
    nodes = [
        helper.make_node("Shape", ["images"], ["batch"], start=0, end=1),
        helper.make_node("Mul", ["batch", "cells"], ["end"]),
        helper.make_node("Slice", ["rows", "zero", "end", "axis"], ["output"]),
    ]
    weights: dict[str, NDArray[Any]] = {
        "rows": dense(CELLS, 7, {}), "cells": np.array([CELLS], np.int64),
        "zero": np.array([0], np.int64), "axis": np.array([1], np.int64),
    }  # fmt: skip
    inputs, outputs = [value("images", ("batch", 3, 64, 64))], [value("output", (1, "rows", 7))]
    path = save(tmp_path / "m.onnx", nodes, inputs, outputs, weights, metadata=NAMES)
    try:
        name = Detector.open(path).name
    except SemslamError:
        return
    assert name == "yolox"


def test_scores_that_are_no_probabilities_are_an_error(tmp_path: Path) -> None:
    """Logits in the place of probabilities would otherwise enter the tables as a confidence of 7.3."""
    columns = dense(CELLS, 6, {7: [32, 32, 20, 8, 7.3, -4]}).transpose(0, 2, 1).copy()
    detector = Detector.open(constant_detector(tmp_path / "m.onnx", {"o": columns}, metadata=NAMES))
    with pytest.raises(SemslamError):
        detector(GREY, 0.3, 0.5)


def test_a_decoder_that_lists_its_iou_first_is_read_by_name(tmp_path: Path) -> None:
    """NanoSAM's export: outputs iou_predictions, low_res_masks, and no masks."""
    encoder = sam_encoder(tmp_path / "e.onnx")
    decoder = sam_decoder(tmp_path / "d.onnx", sized=False, iou_first=True)
    box = np.array([[8, 8, 40, 40]], np.float32)
    mask = open_segmenter("sam", str(encoder), str(decoder))(GREY, np.ones((64, 64), np.float32), box)[0]
    assert 0.9 < mask.sum() / 32**2 < 1.1


def test_mask_input_takes_the_size_the_decoder_declares(tmp_path: Path) -> None:
    """A quarter of the encoder's side is 256 only where that side is 1024."""
    encoder = sam_encoder(tmp_path / "e.onnx")
    decoder = sam_decoder(tmp_path / "d.onnx", low_side=64)
    box = np.array([[8, 8, 40, 40]], np.float32)
    mask = open_segmenter("sam", str(encoder), str(decoder))(GREY, np.ones((64, 64), np.float32), box)[0]
    assert 0.9 < mask.sum() / 32**2 < 1.1


def test_names_with_gaps_are_refused(tmp_path: Path) -> None:
    """{0, 5} are two names, but class 1 is not the second of them."""
    names = {"names": "{0: 'cup', 5: 'chair'}"}
    path = constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, metadata=names)
    with pytest.raises(SemslamError):
        Detector.open(path)


def test_half_precision_models_run(tmp_path: Path) -> None:
    """A float16 input is common in exports for accelerators."""
    path = constant_detector(
        tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, input_kind=TensorProto.FLOAT16, metadata=NAMES
    )
    assert len(Detector.open(path)(GREY, 0.3, 0.5)) == 0


def test_inspect_tells_the_operator_set(tmp_path: Path) -> None:
    """A model that an older onnxruntime refuses is told by its operator set."""
    from semslam.models.inspect import describe

    described = describe(constant_detector(tmp_path / "m.onnx", {"o": dense(CELLS, 7, {})}, metadata=NAMES))
    assert "17" in str(described.as_json().get("opset", described.as_json().get("opsets", "")))


def test_an_error_for_an_unknown_layout_says_how_to_name_one(tmp_path: Path) -> None:
    """Who knows the layout can name it: `--set extract.adapter=NAME`."""
    path = constant_detector(tmp_path / "m.onnx", {"o": np.zeros((1, 5000, 3), np.float32)})
    with pytest.raises(SemslamError) as caught:
        Detector.open(path)
    assert "extract.adapter" in caught.value.text()
