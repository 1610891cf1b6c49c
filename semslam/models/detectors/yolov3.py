"""YOLOv3 and its tiny sister: raw heads with anchors, two or three of them.

A head is (1, 3 * (5 + classes), h, w), (1, h, w, 3 * (5 + classes)) or (1, 3, h, w, 5 + classes); its stride is read
off its size. Each value is a logit: a box's centre lies at sigmoid within its cell, its sides are anchors times the
exponential, its score is sigmoid(objectness) * sigmoid(class) (Redmon and Farhadi 2018, section 2.1, with their
anchors; tiny: those of the authors' yolov3-tiny.cfg). The metadata may hold other `anchors`: JSON, for each stride from
the finest a list of three [width, height]. Pictures RGB, 0 to 1, centred, grey around them.

YOLOv5's raw heads have the same shapes and decode otherwise: centre 2 * sigmoid - 0.5, sides anchor * (2 * sigmoid)^2.
Nothing in a file tells them apart: name `yolov5_raw` for those.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Indices, Letterbox, fit, select
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import UNIT, corners, input_size, likely, one_picture, planes, sigmoid, single
from semslam.models.session import Signature, Tensor

_ANCHORS = {
    8: ((10, 13), (16, 30), (33, 23)),
    16: ((30, 61), (62, 45), (59, 119)),
    32: ((116, 90), (156, 198), (373, 326)),
}
"""Width and height in pixels of the input."""
_TINY_ANCHORS = {16: ((10, 14), (23, 27), (37, 58)), 32: ((81, 82), (135, 169), (344, 319))}
_AROUND = 128


@dataclass(frozen=True)
class _Head:
    stride: int
    form: str
    """Order of its dimensions: grid, channels first (c), last (l), or anchors apart (a)."""
    values: int
    """5 + classes."""


@dataclass(frozen=True)
class Yolov3:
    """The adapter; `squared` decodes as YOLOv5 does."""

    name: str = "yolov3"
    squared: bool = False

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        problem = one_picture(signature)
        if problem:
            return problem
        if len(signature.outputs) not in (2, 3):
            return f"wants two or three heads, found {len(signature.outputs)} outputs"
        heads = _heads(signature)
        if not heads:
            return "outputs are no grids of strides 8, 16, 32 with three anchors of 5 + classes each"
        if self.squared and signature.operators is not None:
            return "looks the same as yolov3: has to be named"
        return ""

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """(1, 3, h, w) RGB, 0 to 1."""
        height, width = input_size(signature)
        canvas, box = fit(rgb, width, height, fill=_AROUND)
        return {signature.inputs[0].name: planes(canvas, UNIT)}, box

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """Only anchors whose objectness reaches the score are decoded: no class can lift the others."""
        anchors = _anchors(signature)
        parts = [
            self._decoded(_grid(single(output), head), anchors[head.stride], head.stride, look.min_score)
            for output, head in zip(outputs, _heads(signature), strict=True)
        ]
        boxes, scores, class_ids = (np.concatenate(values) for values in zip(*parts, strict=True))
        return select(boxes, scores, class_ids, look.box, min_score=look.min_score, max_overlap=look.max_overlap)

    def _decoded(self, grid: Floats, anchors: Floats, stride: int, min_score: float) -> tuple[Floats, Floats, Indices]:
        """Boxes (n, 4), scores and classes of a grid (3, h, w, 5 + C)."""
        chosen = likely(sigmoid(grid[..., 4].ravel()), min_score)
        anchor, row, column = np.unravel_index(chosen, grid.shape[:3])
        raw = grid[anchor, row, column]  # (n, 5 + C)
        class_ids = raw[:, 5:].argmax(axis=1)
        scores = sigmoid(raw[:, 4]) * sigmoid(raw[np.arange(len(raw)), 5 + class_ids])
        cells = np.stack([column, row], axis=1).astype(np.float32)
        within = sigmoid(raw[:, :4])
        with np.errstate(over="ignore"):
            centres = 2 * within[:, :2] - 0.5 if self.squared else within[:, :2]
            growth = (2 * within[:, 2:]) ** 2 if self.squared else np.exp(raw[:, 2:4])
        boxes = corners(
            np.concatenate([(centres + cells) * stride, growth * anchors[anchor]], axis=1, dtype=np.float32)
        )
        return boxes, scores, class_ids

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (_heads(signature)[0].values - 5,)


def _heads(signature: Signature) -> tuple[_Head, ...]:
    """The heads in the order of the outputs; empty if they are none."""
    size = input_size(signature)
    heads = [_head(tensor, size) for tensor in signature.outputs]
    known = [head for head in heads if head is not None]
    strides = {head.stride for head in known}
    fit_together = len(known) == len(heads) == len(strides) and len({head.values for head in known}) == 1
    return tuple(known) if fit_together and strides >= {16, 32} else ()


def _head(tensor: Tensor, size: tuple[int, int]) -> _Head | None:
    if not all(isinstance(length, int) for length in tensor.shape[1:]):
        return None
    shape = [int(length) for length in tensor.shape[1:]]
    for stride in _ANCHORS:
        grid = [size[0] // stride, size[1] // stride]
        if len(shape) == 4 and shape[:3] == [3, *grid] and shape[3] > 5:
            return _Head(stride, "a", shape[3])
        if len(shape) == 3 and shape[1:] == grid and shape[0] % 3 == 0 and shape[0] > 15:
            return _Head(stride, "c", shape[0] // 3)
        if len(shape) == 3 and shape[:2] == grid and shape[2] % 3 == 0 and shape[2] > 15:
            return _Head(stride, "l", shape[2] // 3)
    return None


def _grid(output: Floats, head: _Head) -> Floats:
    """A head as (3, h, w, 5 + C): a view, nothing is copied."""
    if head.form == "c":
        return output.reshape(3, head.values, *output.shape[1:]).transpose(0, 2, 3, 1)
    if head.form == "l":
        return output.reshape(*output.shape[:2], 3, head.values).transpose(2, 0, 1, 3)
    return output


def _anchors(signature: Signature) -> dict[int, Floats]:
    """Anchors (3, 2) by stride: those of the metadata, else of the paper."""
    strides = sorted(head.stride for head in _heads(signature))
    usual = _ANCHORS if len(strides) == 3 else _TINY_ANCHORS
    try:
        stated = np.array(json.loads(signature.metadata["anchors"]), np.float32).reshape(len(strides), 3, 2)
    except (KeyError, ValueError, TypeError):
        return {stride: np.array(usual[stride], np.float32) for stride in strides}
    return dict(zip(strides, stated, strict=True))


ADAPTERS: tuple[Adapter, ...] = (Yolov3(), Yolov3("yolov5_raw", squared=True))
