"""YOLOv5: one output (1, N, 5 + classes), decoded: centre and size in pixels of the input, objectness, classes.

Source of the layout: the ONNX export of the YOLOv5 project; three anchors a cell, pictures RGB, 0 to 1, centred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, select
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    best_class,
    centred_picture,
    corners,
    dense_rows,
    input_size,
    likely,
    one_picture,
    single,
)
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

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        return centred_picture(rgb, signature)

    def postprocess(self, outputs: list[Array], look: Look, _signature: Signature) -> Detections:
        """Score = objectness * class probability."""
        rows = single(outputs[0])  # (N, 5 + C)
        rows = rows[likely(rows[:, 4], look.min_score)]  # no class probability can lift a lower objectness
        scores, class_ids = best_class(rows[:, 5:], rows[:, 4])
        return select(
            corners(rows), scores, class_ids, look.box, min_score=look.min_score, max_overlap=look.max_overlap
        )

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (int(signature.outputs[0].shape[2]) - 5,)


ADAPTERS: tuple[Adapter, ...] = (Yolov5(),)
