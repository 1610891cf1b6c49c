"""YOLOv8 and later: one output (1, 4 + classes, N), decoded: centre and size in pixels of the input, class scores.

Source of the layout: the ONNX export of the Ultralytics project; no objectness, pictures RGB, 0 to 1, centred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Indices, Letterbox, select
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    centred_picture,
    corners,
    likely,
    names_stated,
    one_picture,
    one_table,
    single,
)
from semslam.models.session import Signature


@dataclass(frozen=True)
class Yolov8:
    """The adapter."""

    name: str = "yolov8"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        return one_picture(signature) or candidate_columns(signature)

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        return centred_picture(rgb, signature)

    def postprocess(self, outputs: list[Array], look: Look, _signature: Signature) -> Detections:
        """The best class of each candidate."""
        return read_columns(outputs[0], look)

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (int(signature.outputs[0].shape[1]) - 4,)


def candidate_columns(signature: Signature) -> str:
    """Why the output is not one of (N, 4 + classes, candidates); empty if it is."""
    problem = one_table(signature)
    if problem:
        return problem
    _, channels, rows = signature.outputs[0].shape
    if not isinstance(channels, int) or channels < 5:
        return f"second dimension of the output is {channels}, wants 4 + classes"
    if isinstance(rows, int) and rows <= channels:
        return f"output has {rows} candidates of {channels} values: more candidates than values expected"
    if isinstance(rows, int) and names_stated(signature) == rows - 4 != channels - 4:
        return f"its metadata names {rows - 4} classes: rows of {rows} values"
    return ""


def read_columns(output: Array, look: Look) -> Detections:
    """Detections from (1, 4 + C, N)."""
    columns = single(output)
    scores, class_ids, chosen = best_of_columns(columns[4:], look.min_score)
    boxes = corners(columns[:4, chosen].T)
    return select(boxes, scores, class_ids, look.box, min_score=look.min_score, max_overlap=look.max_overlap)


def best_of_columns(class_scores: Floats, min_score: float) -> tuple[Floats, Indices, Indices]:
    """Scores and classes of the candidates of (C, N) worth decoding, and which they are.

    The maximum goes along the rows as they lie in memory; only the few candidates above the score are turned.
    """
    chosen = likely(class_scores.max(axis=0), min_score)
    few = class_scores[:, chosen]  # (C, n)
    class_ids = few.argmax(axis=0)
    return few[class_ids, np.arange(len(chosen))], class_ids, chosen


ADAPTERS: tuple[Adapter, ...] = (Yolov8(),)
