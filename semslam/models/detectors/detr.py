"""Transformers with raw answers: class logits (1, queries, C) and boxes (1, queries, 4), centre and size as shares.

Three families, whose logits read differently:
- `rfdetr`: outputs `dets` and `labels`, and `masks` (1, queries, h, w) of the segmenting models; sigmoid, the last
  column means no object. Source: RF-DETR's documentation of its export. ImageNet's normalisation, stretched.
- `rtdetr_logits`: RT-DETR, Deformable DETR and others as Hugging Face's Transformers export them (`logits`,
  `pred_boxes`); sigmoid, a column a class. Told by the GridSample of deformable attention, or by as many names as
  columns. Pictures 0 to 1, stretched to a square.
- `detr`: the first DETR (Carion et al. 2020) and YOLOS, softmax, the last column means no object. ImageNet's
  normalisation; where the size is open the shorter side is 800 pixels, the longer at most 1333, as it was trained.

Queries compete for objects during training, so hardly any are double; those that are go as everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fitted, select_indices, stretched
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    IMAGENET,
    UNIT,
    input_size,
    likely,
    names_stated,
    picture_input,
    planes,
    sigmoid,
    single,
    stated_scaling,
)
from semslam.models.detectors.rtdetr import shares_to_pixels
from semslam.models.mask_grids import masks_from_grids
from semslam.models.session import Signature, Tensor

_SHORT_SIDE, _LONG_SIDE = 800, 1333


@dataclass(frozen=True)
class Detr:
    """The adapter of all three."""

    name: str

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        picture = picture_input(signature)
        if picture is None or any(len(t.shape) != 3 for t in signature.inputs if t is not picture):
            return f"wants a picture (and perhaps its mask), found {', '.join(map(str, signature.inputs))}"
        pair = _logits_and_boxes(signature)
        if len(pair) != 2:
            return "wants logits (1, queries, classes) and boxes (1, queries, 4), told by their names"
        logits, boxes = pair
        if boxes.shape[2] != 4 or logits.shape[1] != boxes.shape[1] or not isinstance(logits.shape[2], int):
            return f"{logits} and {boxes} are no logits and boxes of the same queries"
        return self._other_family(signature, logits, boxes)

    def _other_family(self, signature: Signature, logits: Tensor, boxes: Tensor) -> str:
        is_rfdetr = (boxes.name, logits.name) == ("dets", "labels")
        if (self.name == "rfdetr") != is_rfdetr:
            return "dets and labels are RF-DETR's" if is_rfdetr else "wants dets and labels"
        if is_rfdetr or signature.operators is None:  # who names a layout knows the graph
            return ""
        columns, names = int(logits.shape[2]), names_stated(signature)
        sigmoid_family = names == columns if names in (columns, columns - 1) else "GridSample" in signature.operators
        if (self.name == "rtdetr_logits") != sigmoid_family:
            return f"its logits look like those of a {'sigmoid' if sigmoid_family else 'softmax with no-object'}"
        return ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w), and a mask of ones where one is wanted."""
        height, width = self._size(rgb, signature)
        box = stretched((rgb.shape[0], rgb.shape[1]), width, height)
        scaling = stated_scaling(signature, UNIT if self.name == "rtdetr_logits" else IMAGENET)
        tensor = planes(fitted(rgb, box, width, height), scaling)
        feeds: dict[str, Array] = {}
        for wanted in signature.inputs:
            kind = np.int64 if wanted.type == "tensor(int64)" else np.bool_ if "bool" in wanted.type else np.float32
            feeds[wanted.name] = tensor if len(wanted.shape) == 4 else np.ones((1, height, width), kind)
        return feeds, box

    def _size(self, rgb: NDArray[np.uint8], signature: Signature) -> tuple[int, int]:
        """Height and width of the input for a picture."""
        picture = picture_input(signature)
        if self.name != "detr" or picture is None or all(isinstance(size, int) for size in picture.shape[2:]):
            return input_size(signature)
        rows, columns = rgb.shape[:2]
        scale = min(_SHORT_SIDE / min(rows, columns), _LONG_SIDE / max(rows, columns))
        return max(1, round(rows * scale)), max(1, round(columns * scale))

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """The best class of each query."""
        named = {tensor.name: output for tensor, output in zip(signature.outputs, outputs, strict=True)}
        logits, shares = (single(named[tensor.name]) for tensor in _logits_and_boxes(signature))
        scores, class_ids = self._scores(logits, len(look.class_names))
        chosen = likely(scores, look.min_score)
        found, kept = select_indices(
            shares_to_pixels(shares[chosen], _input(look.box)),
            scores[chosen],
            class_ids[chosen],
            look.box,
            min_score=look.min_score,
            max_overlap=look.max_overlap,
        )
        grids = named.get("masks")
        if grids is None or grids.ndim != 4:
            return found
        chosen_grids = single(grids)[chosen[kept]]
        return replace(found, masks=masks_from_grids(chosen_grids, found.boxes, look.box, _input(look.box)))

    def _scores(self, logits: Floats, names: int) -> tuple[Floats, NDArray[np.int64]]:
        """Score and class of each query's best class (Q,); columns beyond the names mean no object."""
        classes = logits[:, : min(names, logits.shape[1])] if names else logits
        class_ids = classes.argmax(axis=1)
        best = classes[np.arange(len(classes)), class_ids]
        if self.name != "detr":
            return sigmoid(best), class_ids
        with np.errstate(invalid="ignore", over="ignore"):
            top = logits.max(axis=1)
            return np.asarray(np.exp(best - top) / np.exp(logits - top[:, None]).sum(axis=1), np.float32), class_ids

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Numbers of classes it may have: with or without the column that means no object."""
        columns = int(_logits_and_boxes(signature)[0].shape[2])
        return {"detr": (columns - 1,), "rfdetr": (columns - 1, columns)}.get(self.name, (columns,))


def _logits_and_boxes(signature: Signature) -> list[Tensor]:
    """The two outputs by their names; fewer or more if names do not tell.

    Shapes would not do: with four columns of logits the two look alike.
    """
    dense = [tensor for tensor in signature.outputs if len(tensor.shape) == 3]
    roles = (("logit", "label", "class", "score"), ("box", "det"))
    return [tensor for words in roles for tensor in dense if any(word in tensor.name.lower() for word in words)]


def _input(box: Letterbox) -> tuple[int, int]:
    """Height and width of the input that a stretched picture filled."""
    width, height = box.inner
    return height, width


ADAPTERS: tuple[Adapter, ...] = (Detr("rfdetr"), Detr("rtdetr_logits"), Detr("detr"))
