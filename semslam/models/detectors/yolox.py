"""YOLOX: one output (1, N, 5 + classes), boxes still in units of their grid cell (official export, not decoded).

Source of the layout: the YOLOX paper (Ge et al. 2021) and its ONNX export with `decode_in_inference=False`; pictures
are BGR, 0 to 255, fitted to the upper left corner.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, select
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    PIXELS_BGR,
    best_class,
    dense_rows,
    input_size,
    likely,
    one_picture,
    planes,
    single,
)
from semslam.models.session import Signature

_STRIDES = (8, 16, 32)


@dataclass(frozen=True)
class Yolox:
    """The adapter; `decoded` says that boxes come in pixels already, which the exponential in the graph betrays."""

    name: str = "yolox"
    decoded: bool = False

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature) or dense_rows(signature, 6)
        if problem:
            return problem
        height, width = input_size(signature)
        cells = sum((height // s) * (width // s) for s in _STRIDES)
        rows = signature.outputs[0].shape[1]
        if rows != cells:
            return f"output has {rows} rows, a {width}x{height} input has {cells} cells"
        if signature.operators is not None and ("Exp" in signature.operators) != self.decoded:
            return (
                f"its graph holds {'no ' if self.decoded else ''}Exp: boxes are {'not ' if self.decoded else ''}decoded"
            )
        return ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) BGR."""
        height, width = input_size(signature)
        canvas, box = fit(rgb, width, height, centred=False)
        return {signature.inputs[0].name: planes(canvas, PIXELS_BGR)}, box

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """Boxes from offsets within their cell and log sizes; score = objectness * class probability."""
        rows = single(outputs[0])  # (N, 5 + C)
        chosen = likely(rows[:, 4], look.min_score)  # no class probability can lift a lower objectness
        rows = rows[chosen]
        scores, class_ids = best_class(rows[:, 5:], rows[:, 4])
        centres, sizes = rows[:, :2], rows[:, 2:4]
        if not self.decoded:
            cells, strides = _cells(*input_size(signature))
            with np.errstate(over="ignore"):
                centres = (centres + cells[chosen]) * strides[chosen]
                sizes = np.exp(sizes) * strides[chosen]
        boxes = np.concatenate([centres - sizes / 2, centres + sizes / 2], axis=1)
        return select(boxes, scores, class_ids, look.box, min_score=look.min_score, max_overlap=look.max_overlap)

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (int(signature.outputs[0].shape[2]) - 5,)


@cache
def _cells(height: int, width: int) -> tuple[Floats, Floats]:
    """Column and row of each cell (N, 2), and its stride in pixels (N, 1), level by level."""
    places, strides = [], []
    for stride in _STRIDES:
        rows, columns = np.mgrid[: height // stride, : width // stride]
        places.append(np.stack([columns.ravel(), rows.ravel()], axis=1))
        strides.append(np.full((rows.size, 1), stride))
    return np.concatenate(places).astype(np.float32), np.concatenate(strides).astype(np.float32)


ADAPTERS: tuple[Adapter, ...] = (Yolox(), Yolox("yolox_decoded", decoded=True))
