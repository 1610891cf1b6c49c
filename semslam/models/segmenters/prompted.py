"""semslam's own pair: an RGB-D encoder, run once a picture, and a decoder that answers all boxes in one run.

Encoder: `images` (1, 3, h, w) RGB in 0..1 and `depth` (1, 1, h, w) metres, 0 where missing, to `features`. Decoder:
`features` and `boxes` (N, 4) left, top, right, bottom in pixels of the encoder's input, to `masks` (N, m, m): logits on
a grid over each box and its margin, which the metadata's `box_margin` states as a share of the box's sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import fit, fit_depth
from semslam.models.detectors.layout import UNIT, planes
from semslam.models.onnxfile import read_onnx
from semslam.models.segmenters.depth_mode import inner
from semslam.models.session import Session, Signature, open_session

TASK = "prompted-segmentation"
"""What the metadata's `task` says of both files."""
_AT_ONCE = 32
"""Boxes in one run of the decoder, which bounds its memory."""
_NO_LOGIT = -1.0
"""In the place of logits that are no numbers: not the object."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class PromptedSegmenter:
    """The pair of sessions."""

    encoder: Session
    decoder: Session
    width: int
    """Of the encoder's input, pixels."""
    height: int
    margin: float
    """Of a box's sides, on each side: what a mask shows beyond its box."""

    @staticmethod
    def open(encoder: Path, decoder: Path, *, threads: int = 1) -> PromptedSegmenter:
        """Open both files and see that they fit each other.

        Raises:
            SemslamError: a file is no usable model, has other inputs, or the features of the two differ.
        """
        first = open_session(encoder, threads=threads, what="segmenter encoder")
        second = open_session(decoder, threads=threads, what="segmenter decoder")
        height, width = _input_size(first)
        _check_decoder(second)
        _check_pair(first, second)
        return PromptedSegmenter(first, second, width, height, _margin(second))

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], boxes: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Masks (N, H, W); a mask keeps to its box and margin, and is empty where the box is not finite or outside."""
        height, width = rgb.shape[:2]
        masks = np.zeros((len(boxes), height, width), bool)
        clipped = _clipped(boxes, width, height)
        usable = np.flatnonzero((clipped[:, 2:] > clipped[:, :2]).all(axis=1))
        if len(usable) == 0:
            return masks
        logits = self._logits(rgb, depth_m, clipped[usable])
        for index, answer in zip(usable.tolist(), logits, strict=True):
            _paste(masks[index], answer, _grown(clipped[index], self.margin))
        return masks

    def _logits(self, rgb: NDArray[np.uint8], depth_m: Floats, boxes: Floats) -> Floats:
        """(N, m, m) of boxes (N, 4) in pixels of the picture."""
        canvas, box = fit(rgb, self.width, self.height)
        depth = fit_depth(depth_m, box, self.width, self.height)
        features = self.encoder.run({"images": planes(canvas, UNIT), "depth": depth[None, None]})[0]
        scale = np.array([box.scale_x, box.scale_y] * 2, np.float32)
        prompts = boxes * scale + np.array([box.left, box.top] * 2, np.float32)
        groups = [prompts[start : start + _AT_ONCE] for start in range(0, len(prompts), _AT_ONCE)]
        logits = np.concatenate([self._answers(features, group) for group in groups])
        return np.asarray(np.nan_to_num(logits, nan=_NO_LOGIT), np.float32)

    def _answers(self, features: NDArray[Any], boxes: Floats) -> Floats:
        """(N, m, m) of some boxes (N, 4) in pixels of the encoder's input."""
        logits = self.decoder.run({"features": features, "boxes": boxes})[0]
        if logits.ndim != 3 or len(logits) != len(boxes):
            raise SemslamError(
                f"Segmenter decoder `{self.decoder.path}` answers {len(boxes)} boxes with {list(logits.shape)}",
                hint="wants masks (N, m, m), one a box",
            )
        return np.asarray(logits, np.float32)


def is_prompted(encoder: Path) -> bool:
    """If an encoder says that it is one of this kind.

    Raises:
        SemslamError: the file is no ONNX model.
    """
    return read_onnx(encoder, "segmenter encoder").metadata.get("task") == TASK


def _clipped(boxes: NDArray[np.float32], width: int, height: int) -> Floats:
    """Boxes inside the picture, grown to a pixel where thinner; those of no use become zero."""
    wanted = np.asarray(boxes, np.float64).reshape(-1, 4)
    finite = np.asarray(np.isfinite(wanted).all(axis=1))
    wanted = np.where(finite[:, None], wanted, 0.0)
    outside = (wanted[:, 2:] <= 0).any(axis=1) | (wanted[:, :2] >= (width, height)).any(axis=1)
    turned = (wanted[:, 2:] < wanted[:, :2]).any(axis=1)
    limits = np.array([width, height], np.float64)
    low = np.clip(wanted[:, :2], 0, limits - 1)
    high = np.clip(wanted[:, 2:], low + 1, limits)
    useless = np.asarray(~finite | outside | turned)
    return np.where(useless[:, None], 0.0, np.concatenate([low, high], axis=1)).astype(np.float32)


def _paste(mask: NDArray[np.bool_], logits: Floats, window: Floats) -> None:
    """Set the pixels of a mask (H, W) where the logits (m, m) over a window of the picture are positive."""
    height, width = mask.shape
    left, top, right, bottom = inner(window[None], width, height)[0].tolist()
    rows, columns = logits.shape
    across, down = columns / float(window[2] - window[0]), rows / float(window[3] - window[1])
    matrix = np.array(
        [
            [across, 0, (left + 0.5 - float(window[0])) * across - 0.5],
            [0, down, (top + 0.5 - float(window[1])) * down - 0.5],
        ]
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (right - left, bottom - top)
    mask[top:bottom, left:right] = (
        cv2.warpAffine(logits, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE) > 0
    )


def _grown(box: Floats, margin: float) -> Floats:
    sides = np.tile(box[2:] - box[:2], 2) * np.array([-1, -1, 1, 1], np.float32)
    return np.asarray(box + np.float32(margin) * sides, np.float32)


def _input_size(session: Session) -> tuple[int, int]:
    """Height and width of the encoder's input."""
    inputs = {tensor.name: tensor.shape for tensor in session.signature.inputs}
    images = inputs.get("images", ())
    if set(inputs) != {"images", "depth"} or len(images) != 4 or not all(isinstance(n, int) for n in images[2:]):
        raise SemslamError(
            f"Segmenter encoder `{session.path}` does not take colour and depth",
            details=session.signature.text(),
            hint="wants images (1, 3, h, w) and depth (1, 1, h, w) of a fixed size",
        )
    return int(images[2]), int(images[3])


def _check_decoder(session: Session) -> None:
    if {tensor.name for tensor in session.signature.inputs} != {"features", "boxes"}:
        raise SemslamError(
            f"Segmenter decoder `{session.path}` has unknown inputs",
            details=session.signature.text(),
            hint="wants features and boxes",
        )


def _check_pair(encoder: Session, decoder: Session) -> None:
    given, wanted = encoder.signature.outputs[0], _tensor_shape(decoder.signature, "features")
    pairs = [(a, b) for a, b in zip(given.shape, wanted, strict=False) if isinstance(a, int) and isinstance(b, int)]
    if len(given.shape) != len(wanted) or any(a != b for a, b in pairs):
        raise SemslamError(
            "Segmenter encoder and decoder do not belong together",
            details=f"encoder gives {list(given.shape)}\ndecoder wants {list(wanted)}",
            hint="export both from the same network",
        )


def _tensor_shape(signature: Signature, name: str) -> tuple[int | str, ...]:
    return next(tensor.shape for tensor in signature.inputs if tensor.name == name)


def _margin(decoder: Session) -> float:
    text = decoder.signature.metadata.get("box_margin", "")
    try:
        margin = float(text)
    except ValueError:
        margin = -1.0
    if not 0 <= margin <= 1:
        raise SemslamError(
            f"Segmenter decoder `{decoder.path}` does not say how far beyond its box a mask reaches: `{text}`",
            hint="its metadata wants `box_margin`, 0 to 1; export it again",
        )
    return margin
