"""semslam's own detector: colour and depth in, the answer of YOLOv8 out.

Inputs `images` (N, 3, h, w) RGB 0 to 1, and `depth` (N, 1, h, w) metres, 0 where missing; the picture is centred in
both, grey 114 and depth 0 around it. One output (N, 4 + classes, cells) in pixels of the input.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox, fit, fit_depth
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import DEFAULT_SIDE, UNIT, known_sizes, planes
from semslam.models.detectors.yolov8 import candidate_columns, read_columns
from semslam.models.session import Signature


@dataclass(frozen=True)
class Rgbd:
    """The adapter."""

    name: str = "semslam"

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""
        names = [tensor.name for tensor in signature.inputs]
        if sorted(names) != ["depth", "images"]:
            return f"wants inputs images and depth, found {', '.join(names)}"
        for tensor in signature.inputs:
            channels = 3 if tensor.name == "images" else 1
            if len(tensor.shape) != 4 or tensor.shape[1] != channels or _size(signature) is None:
                return f"wants {tensor.name} (N, {channels}, height, width) of known size, found {tensor}"
        return candidate_columns(signature)

    def preprocess(
        self, rgb: NDArray[np.uint8], depth_m: Floats | None, signature: Signature
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """Colour and depth in the same place; without depth, all of it is missing."""
        height, width = _size(signature) or (DEFAULT_SIDE, DEFAULT_SIDE)
        canvas, box = fit(rgb, width, height)
        depth = np.zeros((height, width), np.float32) if depth_m is None else fit_depth(depth_m, box, width, height)
        return {"images": planes(canvas, UNIT), "depth": depth[None, None]}, box

    def postprocess(self, outputs: list[Array], look: Look, _signature: Signature) -> Detections:
        """As YOLOv8 is read."""
        return read_columns(outputs[0], look)

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """Number of classes."""
        return (int(signature.outputs[0].shape[1]) - 4,)


def _size(signature: Signature) -> tuple[int, int] | None:
    """Height and width of both inputs; None if they differ or are open."""
    sizes = {known_sizes(tensor)[1:] for tensor in signature.inputs}
    height_width = sizes.pop()
    return (height_width[0], height_width[1]) if not sizes and len(height_width) == 2 else None


ADAPTERS: tuple[Adapter, ...] = (Rgbd(),)
