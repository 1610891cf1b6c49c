"""RT-DETR and its kin with answers already decoded: Ultralytics' export, and the authors' own (also D-FINE, DEIM).

Ultralytics: one output (1, queries, 4 + classes): centre and size as shares of the input, class probabilities; or, of
later versions, whose metadata call their head `RTDETRDecoder`, (1, queries, 6): centre and size, score, class number;
source: files exported by the project's releases. The authors': a second input `orig_target_sizes` (N, 2) int64, width
and height of the picture; outputs `labels` (N, queries), `boxes` (N, queries, 4) left, top, right, bottom in pixels of
the picture, `scores` (N, queries); source: RT-DETR's and D-FINE's export scripts. All: pictures RGB, 0 to 1, stretched
to a square.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import Detections, Floats, Letterbox, fitted, select, stretched
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import (
    UNIT,
    best_class,
    class_numbers,
    corners,
    head_is_rtdetr,
    input_size,
    known_sizes,
    likely,
    names_stated,
    one_picture,
    picture_input,
    planes,
    query_rows,
    single,
    stated_scaling,
)
from semslam.models.session import Signature


@dataclass(frozen=True)
class RtdetrRows:
    """The adapter of Ultralytics' export; `selected` says that a row holds one score and a class number."""

    name: str = "rtdetr"
    selected: bool = False

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature) or query_rows(signature)
        if problem:
            return problem
        _, values = known_sizes(signature.outputs[0])
        if values < 5 or (self.selected and values != 6):
            return f"rows have {values} values, wants {'6' if self.selected else '4 + classes'}"
        if signature.operators is None or values != 6:  # who names a layout knows the graph
            return ""
        if self.selected:
            return "" if head_is_rtdetr(signature) else "its metadata do not say that its head is an RTDETRDecoder"
        if head_is_rtdetr(signature) or names_stated(signature) != 2:
            return "rows of 6 values are a box, a score and a class, unless the metadata names 2 classes"
        return ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1, stretched."""
        return stretched_picture(rgb, signature)

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """The best class of each query."""
        rows = single(outputs[0])  # (Q, 4 + C), or (Q, 6)
        scores, class_ids = (rows[:, 4], class_numbers(rows[:, 5])) if self.selected else best_class(rows[:, 4:])
        chosen = likely(scores, look.min_score)
        boxes = shares_to_pixels(rows[chosen, :4], input_size(signature))
        return select(
            boxes,
            scores[chosen],
            class_ids[chosen],
            look.box,
            min_score=look.min_score,
            max_overlap=look.max_overlap,
        )

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return () if self.selected else (int(signature.outputs[0].shape[2]) - 4,)


@dataclass(frozen=True)
class RtdetrSized:
    """The adapter of the authors' export."""

    name: str = "rtdetr_sized"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        names = {tensor.name for tensor in signature.inputs}
        if len(names) != 2 or "orig_target_sizes" not in names or picture_input(signature) is None:
            return f"wants a picture and orig_target_sizes, found {', '.join(sorted(names))}"
        found = {tensor.name for tensor in signature.outputs}
        return (
            "" if {"labels", "boxes", "scores"} <= found else f"wants labels, boxes, scores, found {', '.join(found)}"
        )

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """The picture, and its width and height."""
        feeds, box = stretched_picture(rgb, signature)
        return {**feeds, "orig_target_sizes": np.array([[box.width, box.height]], np.int64)}, box

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """Boxes come in pixels of the picture."""
        named = {tensor.name: output[0] for tensor, output in zip(signature.outputs, outputs, strict=True)}
        scores = np.asarray(named["scores"], np.float32)
        chosen = likely(scores, look.min_score)
        return select(
            np.asarray(named["boxes"], np.float32)[chosen],
            scores[chosen],
            class_numbers(np.asarray(named["labels"], np.float32)[chosen]),
            Letterbox(1.0, 1.0, 0, 0, look.box.width, look.box.height),
            min_score=look.min_score,
            max_overlap=look.max_overlap,
        )

    def classes(self, _signature: Signature) -> tuple[int, ...]:
        """Its outputs do not tell."""
        return ()


def stretched_picture(rgb: NDArray[np.uint8], signature: Signature) -> tuple[dict[str, Array], Letterbox]:
    """The picture stretched to the whole input, 0 to 1 unless the metadata says otherwise."""
    height, width = input_size(signature)
    box = stretched((rgb.shape[0], rgb.shape[1]), width, height)
    tensor = picture_input(signature) or signature.inputs[0]
    return {tensor.name: planes(fitted(rgb, box, width, height), stated_scaling(signature, UNIT))}, box


def shares_to_pixels(shares: Floats, size: tuple[int, int]) -> Floats:
    """Centre and size as shares of an input (n, 4) of some height and width to left, top, right, bottom in its pixels.

    Raises:
        SemslamError: they are no shares.
    """
    if np.any(np.abs(shares[np.isfinite(shares)]) > 4):
        raise SemslamError(
            "Detector gives boxes in pixels where shares of its input are expected",
            hint="it is not of the layout it is taken for: name that with `--set extract.adapter=NAME`",
        )
    height, width = size
    return corners(shares) * np.array([width, height, width, height], np.float32)


ADAPTERS: tuple[Adapter, ...] = (RtdetrSized(), RtdetrRows("rtdetr_rows", selected=True), RtdetrRows())
