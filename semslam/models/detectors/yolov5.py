"""YOLOv5: one output (1, N, 5 + classes), decoded: centre and size in pixels of the input, objectness, classes.

Source of the layout: the ONNX export of the YOLOv5 project; three anchors a cell, pictures RGB, 0 to 1, centred.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, select
from semslam.models.detectors.layout import Array, best_class, corners, dense_rows, input_size, one_picture, unit_tensor
from semslam.models.session import Signature


@dataclass(frozen=True)
class Yolov5:
    """The adapter."""

    name: str = "yolov5"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature) or dense_rows(signature, 6)
        if problem:
            return problem
        height, width = input_size(signature)
        anchors = 3 * sum((height // s) * (width // s) for s in (8, 16, 32))
        rows = signature.outputs[0].shape[1]
        if isinstance(rows, int) and rows != anchors:
            return f"output has {rows} rows, a {width}x{height} input has {anchors} anchors"
        return ""

    def preprocess(self, rgb: NDArray[np.uint8], signature: Signature) -> tuple[Floats, Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        height, width = input_size(signature)
        canvas, box = fit(rgb, width, height)
        return unit_tensor(canvas), box

    def postprocess(
        self, outputs: list[Array], box: Letterbox, _signature: Signature, min_score: float, max_overlap: float
    ) -> Detections:
        """Score = objectness * class probability."""
        rows = np.asarray(outputs[0], np.float32)[0]  # (N, 5 + C)
        scores, class_ids = best_class(rows[:, 5:], rows[:, 4])
        return select(corners(rows[:, :4]), scores, class_ids, box, min_score=min_score, max_overlap=max_overlap)

    def classes(self, signature: Signature) -> int:
        """Number of classes."""
        return int(signature.outputs[0].shape[2]) - 5
