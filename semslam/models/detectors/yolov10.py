"""YOLOv10, YOLO26 and exports with suppression inside: one output (1, N, 6), at most a few hundred rows.

A row is left, top, right, bottom in pixels of the input, score, class number. How many classes there are it does not
say. Source of the layout: the Ultralytics documentation of end-to-end detection; pictures RGB, 0 to 1, centred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import Detections, Floats, Indices, Letterbox, select_indices
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    centred_picture,
    class_numbers,
    head_is_rtdetr,
    likely,
    names_stated,
    one_picture,
    query_rows,
    single,
)
from semslam.models.session import Signature

_LARGEST_SHARE = 1.5


@dataclass(frozen=True)
class Yolov10:
    """The adapter."""

    name: str = "yolov10"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature) or query_rows(signature)
        if problem:
            return problem
        values = signature.outputs[0].shape[2]
        if values != 6:
            return f"rows have {values} values, wants 6"
        if signature.operators is not None and (head_is_rtdetr(signature) or names_stated(signature) == 2):
            return "its metadata speak of a transformer, or of 2 classes"
        return ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        return centred_picture(rgb, signature)

    def postprocess(self, outputs: list[Array], look: Look, _signature: Signature) -> Detections:
        """Rows as they are."""
        return read_selected(single(outputs[0]), look)[0]

    def classes(self, _signature: Signature) -> tuple[int, ...]:
        """Its outputs do not tell."""
        return ()


def read_selected(rows: Floats, look: Look) -> tuple[Detections, Indices]:
    """Detections from rows (N, 6 or more), and which rows they are."""
    chosen = likely(rows[:, 4], look.min_score)
    few = rows[chosen]
    if len(few) and np.all(np.abs(few[:, :4]) <= _LARGEST_SHARE):
        raise SemslamError(
            "Detector gives boxes as shares of its input where pixels are expected",
            hint="a transformer's, perhaps: try `--set extract.adapter=rtdetr_rows`",
        )
    found, kept = select_indices(
        few[:, :4],
        few[:, 4],
        class_numbers(few[:, 5]),
        look.box,
        min_score=look.min_score,
        max_overlap=look.max_overlap,
    )
    return found, chosen[kept]


ADAPTERS: tuple[Adapter, ...] = (Yolov10(),)
