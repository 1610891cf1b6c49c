"""YOLOv8-seg, YOLO11-seg and YOLO26-seg: boxes with coefficients, and prototypes whose sum they weigh to masks.

Two outputs. `output0` is (1, 4 + classes + K, N) as of YOLOv8 with K coefficients after the class scores, or, from
models that suppress overlaps themselves, (1, N, 6 + K): left, top, right, bottom in pixels of the input, score, class,
coefficients. `output1` is (1, K, h/4, w/4). Source of the layout: the Ultralytics documentation of its export and of
end-to-end detection; pictures RGB, 0 to 1, centred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, select_indices
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    centred_picture,
    corners,
    input_size,
    known_sizes,
    one_picture,
    single,
)
from semslam.models.detectors.yolov8 import best_of_columns
from semslam.models.detectors.yolov10 import read_selected
from semslam.models.mask_grids import combined, masks_from_grids
from semslam.models.session import Signature


@dataclass(frozen=True)
class Yolov8Seg:
    """The adapter; `selected` says that candidates come as rows, without overlaps."""

    name: str = "yolov8_seg"
    selected: bool = False

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature)
        if problem:
            return problem
        if [len(tensor.shape) for tensor in signature.outputs] != [3, 4]:
            return "wants two outputs: candidates of three dimensions, prototypes (1, K, h, w)"
        candidates, prototypes = (known_sizes(tensor) for tensor in signature.outputs)
        if not candidates or not prototypes:
            return "wants outputs of known size"
        (first, second), count = candidates, prototypes[0]
        if self.selected:
            return "" if second == 6 + count else f"rows have {second} values, wants 6 + {count}"
        if first < 5 + count or second <= first:
            return f"wants candidates (1, 4 + classes + {count}, N), found {signature.outputs[0]}"
        return ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        return centred_picture(rgb, signature)

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """Boxes as ever; masks for those that remain."""
        prototypes = single(outputs[1])  # (K, h/4, w/4)
        found, coefficients = (_read_rows if self.selected else _read_columns)(single(outputs[0]), look, prototypes)
        grids = combined(coefficients, prototypes)
        return replace(found, masks=masks_from_grids(grids, found.boxes, look.box, input_size(signature)))

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes; rows of selected candidates do not tell."""
        return () if self.selected else (int(signature.outputs[0].shape[1]) - 4 - int(signature.outputs[1].shape[1]),)


def _read_columns(columns: Floats, look: Look, prototypes: Floats) -> tuple[Detections, Floats]:
    """Detections and their coefficients (n, K) from (4 + C + K, N)."""
    split = len(columns) - len(prototypes)
    scores, class_ids, chosen = best_of_columns(columns[4:split], look.min_score)
    boxes = corners(columns[:4, chosen].T)
    found, kept = select_indices(
        boxes, scores, class_ids, look.box, min_score=look.min_score, max_overlap=look.max_overlap
    )
    return found, columns[split:, chosen[kept]].T


def _read_rows(rows: Floats, look: Look, _prototypes: Floats) -> tuple[Detections, Floats]:
    """Detections and their coefficients (n, K) from (N, 6 + K)."""
    found, kept = read_selected(rows, look)
    return found, rows[kept, 6:]


ADAPTERS: tuple[Adapter, ...] = (Yolov8Seg(), Yolov8Seg("yolo26_seg", selected=True))
