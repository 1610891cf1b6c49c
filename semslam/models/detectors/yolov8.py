"""YOLOv8 and later: one output (1, 4 + classes, N), decoded: centre and size in pixels of the input, class scores.

Source of the layout: the ONNX export of the Ultralytics project; no objectness, pictures RGB, 0 to 1, centred.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, select
from semslam.models.detectors.layout import Array, best_class, corners, input_size, one_picture, unit_tensor
from semslam.models.session import Signature


@dataclass(frozen=True)
class Yolov8:
    """The adapter."""

    name: str = "yolov8"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature)
        if problem:
            return problem
        if len(signature.outputs) != 1 or len(signature.outputs[0].shape) != 3:
            return f"wants one output of three dimensions, found {len(signature.outputs)} outputs"
        _, channels, rows = signature.outputs[0].shape
        if not isinstance(channels, int) or channels < 5:
            return f"second dimension of the output is {channels}, wants 4 + classes"
        if isinstance(rows, int) and rows <= channels:
            return f"output has {rows} candidates of {channels} values: more candidates than values expected"
        return ""

    def preprocess(self, rgb: NDArray[np.uint8], signature: Signature) -> tuple[Floats, Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        height, width = input_size(signature)
        canvas, box = fit(rgb, width, height)
        return unit_tensor(canvas), box

    def postprocess(
        self, outputs: list[Array], box: Letterbox, _signature: Signature, min_score: float, max_overlap: float
    ) -> Detections:
        """The best class of each candidate."""
        columns = np.asarray(outputs[0], np.float32)[0]  # (4 + C, N)
        scores, class_ids = best_class(columns[4:].T)
        boxes = corners(np.ascontiguousarray(columns[:4].T))
        return select(boxes, scores, class_ids, box, min_score=min_score, max_overlap=max_overlap)

    def classes(self, signature: Signature) -> int:
        """Number of classes."""
        return int(signature.outputs[0].shape[1]) - 4
