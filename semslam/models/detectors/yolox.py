"""YOLOX: one output (1, N, 5 + classes), boxes still in units of their grid cell (official export, not decoded).

Source of the layout: the YOLOX paper (Ge et al. 2021) and its ONNX export with `decode_in_inference=False`; pictures
are BGR, 0 to 255, fitted to the upper left corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, select
from semslam.models.detectors.layout import Array, best_class, dense_rows, input_size, one_picture
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

    def preprocess(self, rgb: NDArray[np.uint8], signature: Signature) -> tuple[Floats, Letterbox]:
        """(1, 3, h, w) BGR."""
        height, width = input_size(signature)
        canvas, box = fit(rgb, width, height, centred=False)
        return np.ascontiguousarray(canvas[..., ::-1].transpose(2, 0, 1)[None], np.float32), box

    def postprocess(
        self, outputs: list[Array], box: Letterbox, signature: Signature, min_score: float, max_overlap: float
    ) -> Detections:
        """Boxes from offsets within their cell and log sizes; score = objectness * class probability."""
        rows = np.asarray(outputs[0], np.float32)[0]  # (N, 5 + C)
        scores, class_ids = best_class(rows[:, 5:], rows[:, 4])
        centres, sizes = rows[:, :2], rows[:, 2:4]
        if not self.decoded:
            cells, strides = _cells(*input_size(signature))
            with np.errstate(over="ignore"):
                centres, sizes = (centres + cells) * strides, np.exp(sizes) * strides
        boxes = np.concatenate([centres - sizes / 2, centres + sizes / 2], axis=1)
        return select(boxes, scores, class_ids, box, min_score=min_score, max_overlap=max_overlap)

    def classes(self, signature: Signature) -> int:
        """Number of classes."""
        last = signature.outputs[0].shape[2]
        return int(last) - 5


@cache
def _cells(height: int, width: int) -> tuple[Floats, Floats]:
    """Column and row of each cell (N, 2), and its stride in pixels (N, 1), level by level."""
    places, strides = [], []
    for stride in _STRIDES:
        rows, columns = np.mgrid[: height // stride, : width // stride]
        places.append(np.stack([columns.ravel(), rows.ravel()], axis=1))
        strides.append(np.full((rows.size, 1), stride))
    return np.concatenate(places).astype(np.float32), np.concatenate(strides).astype(np.float32)
