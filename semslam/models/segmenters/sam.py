"""SAM-shaped pair: an image encoder, run once a picture, and a mask decoder prompted by boxes.

Two signatures of the decoder are known: that of the Segment Anything project's ONNX export (a box is two points with
labels 2 and 3; masks come at the picture's size or at a low resolution) and a plain one with an input `boxes` (N, 4).
The encoder takes (1, 3, S, S) normalised by ImageNet's mean and deviation, or (S, S, 3) pixels 0 to 255, the picture's
longest side scaled to S, the rest of the square empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.segmenters.depth_mode import inner
from semslam.models.session import Session, Tensor, open_session

_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_DEVIATION = np.array([58.395, 57.12, 57.375], np.float32)
_LOW_MASK = 256
_POINT_INPUTS = {"image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input"}
_GROWTH = 0.1
"""Of the box's size: a mask may reach so far beyond its box."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class SamSegmenter:
    """The pair of sessions."""

    encoder: Session
    decoder: Session
    side: int
    """S, pixels."""

    @staticmethod
    def open(encoder: Path, decoder: Path, *, threads: int = 1) -> SamSegmenter:
        """Open both files and see that they fit each other.

        Raises:
            SemslamError: a file is no usable model, has other inputs, or the embeddings of the two differ.
        """
        first = open_session(encoder, threads=threads, what="segmenter encoder")
        second = open_session(decoder, threads=threads, what="segmenter decoder")
        side = _encoder_side(first)
        _check_decoder(second)
        _check_pair(first, second)
        return SamSegmenter(first, second, side)

    def __call__(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.float32],  # noqa: ARG002  (the protocol's; this pair sees colour alone)
        boxes: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Masks (N, H, W); a mask keeps to its box, somewhat enlarged. Depth is not used."""
        height, width = rgb.shape[:2]
        masks = np.zeros((len(boxes), height, width), bool)
        if len(boxes) == 0:
            return masks
        scale = self.side / max(height, width)
        embedding = self.encoder.run({self.encoder.signature.inputs[0].name: self._picture(rgb, scale)})[0]
        for mask, box in zip(masks, boxes, strict=True):
            grown = _grown(box)
            left, top, right, bottom = inner(grown[None], width, height)[0].tolist()
            found = self._decode(embedding, box, scale, height, width)
            mask[top:bottom, left:right] = found[top:bottom, left:right]
        return masks

    def _picture(self, rgb: NDArray[np.uint8], scale: float) -> Floats:
        """The encoder's input: (1, 3, S, S) normalised, or (S, S, 3) as it is."""
        height, width = rgb.shape[:2]
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        scaled = cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        tensor = self.encoder.signature.inputs[0]
        channels_first = len(tensor.shape) == 4
        if channels_first:
            scaled = (scaled - _MEAN) / _DEVIATION
        square = np.zeros((self.side, self.side, 3), np.float32)
        square[: size[1], : size[0]] = scaled
        if channels_first:
            return np.ascontiguousarray(square.transpose(2, 0, 1)[None])
        return np.asarray(square.astype(np.uint8) if tensor.type == "tensor(uint8)" else square)

    def _decode(self, embedding: NDArray[Any], box: Floats, scale: float, height: int, width: int) -> NDArray[np.bool_]:
        """The mask (H, W) of one box."""
        names = {tensor.name for tensor in self.decoder.signature.inputs}
        prompt = (box * scale).astype(np.float32)
        feeds: dict[str, NDArray[Any]] = {"image_embeddings": embedding}
        if "boxes" in names:
            feeds["boxes"] = prompt[None]
        else:
            feeds["point_coords"] = prompt.reshape(1, 2, 2)
            feeds["point_labels"] = np.array([[2.0, 3.0]], np.float32)
            feeds["mask_input"] = np.zeros((1, 1, *self._low_size()), np.float32)
            feeds["has_mask_input"] = np.zeros(1, np.float32)
            if "orig_im_size" in names:
                feeds["orig_im_size"] = np.array([height, width], np.float32)
        outputs = dict(zip((t.name for t in self.decoder.signature.outputs), self.decoder.run(feeds), strict=True))
        return self._full_size(_best_mask(outputs), scale, height, width) > 0

    def _low_size(self) -> tuple[int, int]:
        """Height and width of the decoder's mask prompt."""
        shape = next(tensor.shape for tensor in self.decoder.signature.inputs if tensor.name == "mask_input")
        height, width = (size if isinstance(size, int) else _LOW_MASK for size in shape[-2:])
        return height, width

    def _full_size(self, logits: Floats, scale: float, height: int, width: int) -> Floats:
        """Logits (h, w) over the padded square, or over the picture, at the picture's size."""
        if logits.shape == (height, width):
            return logits
        square = cv2.resize(logits, (self.side, self.side), interpolation=cv2.INTER_LINEAR)
        used = square[: max(1, round(height * scale)), : max(1, round(width * scale))]
        return np.asarray(cv2.resize(used, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _best_mask(outputs: dict[str, NDArray[Any]]) -> Floats:
    """Logits (h, w) of the mask the decoder likes best."""
    named = [outputs[name] for name in ("masks", "low_res_masks") if name in outputs]
    masks = np.asarray((named or [value for value in outputs.values() if value.ndim >= 3])[0], np.float32)
    masks = masks.reshape(-1, *masks.shape[-2:])
    liked = outputs.get("iou_predictions")
    best = 0 if liked is None else int(np.nan_to_num(np.asarray(liked, np.float32).ravel()[: len(masks)]).argmax())
    return np.asarray(np.nan_to_num(masks[best], nan=-1.0), np.float32)


def _grown(box: Floats) -> Floats:
    sides = np.tile(box[2:] - box[:2], 2) * np.array([-1, -1, 1, 1], np.float32)
    return np.asarray(box + _GROWTH * sides, np.float32)


def _encoder_side(session: Session) -> int:
    tensors = session.signature.inputs
    shape = tensors[0].shape if len(tensors) == 1 else ()
    picture = shape[2:] if len(shape) == 4 and shape[1] == 3 else shape[:2] if len(shape) == 3 and shape[2] == 3 else ()
    if len(picture) == 2 and isinstance(picture[0], int) and picture[0] == picture[1]:
        return picture[0]
    if len(picture) == 2 and not any(isinstance(size, int) for size in picture):
        return 1024
    raise SemslamError(
        f"Segmenter encoder `{session.path}` does not take a square picture",
        details=session.signature.text(),
        hint="wants one input (1, 3, S, S) or (S, S, 3)",
    )


def _check_decoder(session: Session) -> None:
    names = {tensor.name for tensor in session.signature.inputs}
    plain = names == {"image_embeddings", "boxes"}
    points = _POINT_INPUTS <= names <= _POINT_INPUTS | {"orig_im_size"}
    if not (plain or points):
        raise SemslamError(
            f"Segmenter decoder `{session.path}` has unknown inputs",
            details=session.signature.text(),
            hint=f"wants image_embeddings and boxes, or {', '.join(sorted(_POINT_INPUTS))} (and orig_im_size)",
        )


def _check_pair(encoder: Session, decoder: Session) -> None:
    given = encoder.signature.outputs[0]
    wanted = next(tensor for tensor in decoder.signature.inputs if tensor.name == "image_embeddings")
    if not _compatible(given, wanted):
        raise SemslamError(
            "Segmenter encoder and decoder do not belong together",
            details=f"encoder gives {given}\ndecoder wants {wanted}",
            hint="export both from the same network",
        )


def _compatible(one: Tensor, other: Tensor) -> bool:
    pairs = zip(one.shape, other.shape, strict=False)
    sizes = all(a == b for a, b in pairs if isinstance(a, int) and isinstance(b, int))
    return len(one.shape) == len(other.shape) and sizes
