"""YOLOv3 of the ONNX model zoo: decoded and suppressed in the graph, which is told the picture's size.

Inputs: a picture (N, 3, h, w), and `image_shape` (1, 2) float: height and width of the picture. Outputs by name:
`boxes` (1, N, 4) top, left, bottom, right in pixels of the picture, `scores` (1, classes, N), and `indices` (n, 3) or
(1, n, 3): batch, class and box of what suppression left. Source: the zoo's page of yolov3-10, converted from a Keras
implementation. Pictures RGB, 0 to 1, centred, grey around them; 416 pixels where the size is open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, select
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import UNIT, picture_input, planes
from semslam.models.session import Signature, Tensor

_SIDE = 416
_AROUND = 128


@dataclass(frozen=True)
class Yolov3Zoo:
    """The adapter."""

    name: str = "yolov3_zoo"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        others = [tensor.name for tensor in signature.inputs if tensor != picture_input(signature)]
        if picture_input(signature) is None or others != ["image_shape"]:
            return f"wants a picture and image_shape, found {', '.join(t.name for t in signature.inputs)}"
        found = _outputs(signature)
        if set(found) != {"boxes", "scores", "indices"}:
            return f"wants boxes, scores, indices, found {', '.join(t.name for t in signature.outputs)}"
        classes = found["scores"].shape[1:2]
        return "" if classes and isinstance(classes[0], int) else "does not say how many classes it scores"

    def preprocess(
        self, rgb: NDArray[np.uint8], _depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """The picture (1, 3, h, w) RGB, 0 to 1, and its size."""
        picture = picture_input(signature) or signature.inputs[0]
        height, width = (size if isinstance(size, int) else _SIDE for size in picture.shape[2:])
        canvas, box = fit(rgb, width, height, fill=_AROUND)
        return {picture.name: planes(canvas, UNIT), "image_shape": np.array([rgb.shape[:2]], np.float32)}, box

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature) -> Detections:
        """What the graph's suppression left; indices of -1 fill its list up."""
        order = {tensor.name: output for tensor, output in zip(signature.outputs, outputs, strict=True)}
        found = {role: order[tensor.name] for role, tensor in _outputs(signature).items()}
        triples = found["indices"].reshape(-1, 3).astype(np.int64)
        count, boxes = found["scores"].shape[1], np.asarray(found["boxes"], np.float32)[0]
        inside = (triples >= 0).all(axis=1) & (triples[:, 1] < count) & (triples[:, 2] < len(boxes))
        _, class_ids, rows = triples[inside].T
        return select(
            boxes[rows][:, [1, 0, 3, 2]],
            np.asarray(found["scores"], np.float32)[0, class_ids, rows],
            class_ids,
            Letterbox(1.0, 1.0, 0, 0, look.box.width, look.box.height),
            min_score=look.min_score,
            max_overlap=look.max_overlap,
        )

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (int(_outputs(signature)["scores"].shape[1]),)


def _outputs(signature: Signature) -> dict[str, Tensor]:
    """Outputs by what they are: the zoo's own are called yolonms_layer_1/ExpandDims_1:0, ...:1 and ...:2 or ...:3."""
    found: dict[str, Tensor] = {}
    for tensor in signature.outputs:
        if "int" in tensor.type:
            found["indices"] = tensor
        elif tensor.shape and tensor.shape[-1] == 4:
            found["boxes"] = tensor
        else:
            found["scores"] = tensor
    return found


ADAPTERS: tuple[Adapter, ...] = (Yolov3Zoo(),)
