"""SAM-shaped pair: an image encoder, run once a picture, and a mask decoder prompted by boxes.

Segment Anything, MobileSAM and their exporters agree on the decoder and differ on the encoder.

- Decoder (`scripts/export_onnx_model.py` of either project; samexporter): `image_embeddings`, `point_coords` and
  `point_labels` (a box is two points with labels 2 and 3), `mask_input`, `has_mask_input`, and `orig_im_size`. Of its
  outputs `low_res_masks` is read, a grid over the encoder's square: `masks` is the same at the picture's size, but was
  cropped to the aspect of the picture the export was traced with. Without it `masks` is read, at whatever size.
  A plain decoder with `boxes` (N, 4) in place of points is known too. All boxes go in one run where the first
  dimension of the prompt is open, as in exports with `dynamic_axes` for it; the official ones take one box.
- Encoder: (1, 3, S, S) normalised by ImageNet's mean and deviation, the rest of the square 0; or (H, W, 3) pixels 0 to
  255 that the graph itself normalises and, where its size is open, fills up (samexporter's `--use-preprocess`).

The picture's longest side is scaled to S.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.detections import Letterbox
from semslam.models.detectors.layout import IMAGENET, planes
from semslam.models.mask_grids import masks_from_grids
from semslam.models.segmenters.depth_mode import inner
from semslam.models.session import Session, Tensor, open_session

_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_AT_ONCE = 32
"""Boxes a run: bounds the memory their masks take."""
_LOW_MASK = 256
_USUAL_SIDE = 1024
_POINT_INPUTS = {"image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input"}
_GROWTH = 0.1
"""Of the box's size: a mask may reach so far beyond its box."""

Floats = NDArray[np.float32]
Array = NDArray[Any]


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
        if len(boxes) == 0:
            return np.zeros((0, height, width), bool)
        inner_width, inner_height = _scaled(width, height, self.side)
        box = Letterbox(inner_width / width, inner_height / height, 0, 0, width, height)
        outputs = self.encoder.run({self.encoder.signature.inputs[0].name: self._picture(rgb, box)})
        embedding = outputs[_embedding_index(self.encoder)]
        grids = [
            grid
            for start in range(0, len(boxes), _AT_ONCE)
            for grid in self._decode(embedding, boxes[start : start + _AT_ONCE], box)
        ]
        within = _reach(boxes, height, width)
        over_picture = grids[0].shape == (height, width) and "low_res_masks" not in self._output_names()
        if over_picture:
            return masks_from_grids(grids, within, Letterbox(1.0, 1.0, 0, 0, width, height), (height, width))
        return masks_from_grids(grids, within, box, (self.side, self.side))

    @staticmethod
    def within(boxes: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
        """Where in a picture of some height and width the masks of boxes may lie (N, H, W)."""
        masks = np.zeros((len(boxes), *size), bool)
        for mask, (left, top, right, bottom) in zip(masks, _reach(boxes, *size).astype(int), strict=True):
            mask[top:bottom, left:right] = True
        return masks

    def _picture(self, rgb: NDArray[np.uint8], box: Letterbox) -> Array:
        """The encoder's input: (1, 3, S, S) normalised, or (H, W, 3) as it is."""
        size = box.inner
        interpolation = cv2.INTER_AREA if box.scale_x < 0.5 else cv2.INTER_LINEAR
        scaled = np.asarray(cv2.resize(rgb, size, interpolation=interpolation), np.uint8)
        tensor = self.encoder.signature.inputs[0]
        if len(tensor.shape) == 4:
            square = np.zeros((1, 3, self.side, self.side), np.float32)
            square[:, :, : size[1], : size[0]] = planes(scaled, IMAGENET)
            return square
        kind = np.uint8 if tensor.type == "tensor(uint8)" else np.float32
        if not isinstance(tensor.shape[0], int):
            return scaled.astype(kind)
        whole = np.empty((self.side, self.side, 3), kind)
        whole[:] = _MEAN if kind is np.float32 else np.round(_MEAN)  # what normalising makes 0
        whole[: size[1], : size[0]] = scaled
        return whole

    def _decode(self, embedding: Array, boxes: Floats, box: Letterbox) -> list[Floats]:
        """The mask logits (h, w) of each box: in one run where the decoder takes many."""
        scale = np.array([box.scale_x, box.scale_y] * 2, np.float32)
        prompts = np.asarray(np.nan_to_num(boxes) * scale, np.float32)
        if len(prompts) > 1 and self._takes_many():
            found = self._answer(embedding, prompts, box)
            if len(found) == len(prompts):
                return found
        return [self._answer(embedding, prompt[None], box)[0] for prompt in prompts]

    def _takes_many(self) -> bool:
        prompt = next(t for t in self.decoder.signature.inputs if t.name in ("boxes", "point_coords"))
        return isinstance(prompt.shape[0], str)

    def _answer(self, embedding: Array, prompts: Floats, box: Letterbox) -> list[Floats]:
        """One run for prompts (n, 4)."""
        names = {tensor.name for tensor in self.decoder.signature.inputs}
        feeds: dict[str, Array] = {"image_embeddings": embedding}
        if "boxes" in names:
            feeds["boxes"] = prompts
        else:
            feeds["point_coords"] = prompts.reshape(-1, 2, 2)
            feeds["point_labels"] = np.tile(np.array([[2.0, 3.0]], np.float32), (len(prompts), 1))
            feeds["mask_input"] = np.zeros((1, 1, *self._low_size()), np.float32)
            feeds["has_mask_input"] = np.zeros(1, np.float32)
            if "orig_im_size" in names:
                feeds["orig_im_size"] = self._wanted_size(box)
        return _best_masks(dict(zip(self._output_names(), self.decoder.run(feeds), strict=True)))

    def _wanted_size(self, box: Letterbox) -> Floats:
        """Height and width for the decoder's own enlargement: the least it can do where its result is not read."""
        height, width = box.height, box.width
        if "low_res_masks" in self._output_names():
            width, height = _scaled(width, height, self.side // 16)
        return np.array([height, width], np.float32)

    def _output_names(self) -> list[str]:
        return [tensor.name for tensor in self.decoder.signature.outputs]

    def _low_size(self) -> tuple[int, int]:
        """Height and width of the decoder's mask prompt."""
        shape = next(tensor.shape for tensor in self.decoder.signature.inputs if tensor.name == "mask_input")
        height, width = (size if isinstance(size, int) else _LOW_MASK for size in shape[-2:])
        return height, width


def _scaled(width: int, height: int, longest: int) -> tuple[int, int]:
    """Width and height with a longest side of so much, rounded as Segment Anything does."""
    scale = longest / max(width, height)
    return max(1, int(width * scale + 0.5)), max(1, int(height * scale + 0.5))


def _embedding_index(encoder: Session) -> int:
    """Which output of the encoder is the embedding: by name, else the first."""
    names = [tensor.name for tensor in encoder.signature.outputs]
    return names.index("image_embeddings") if "image_embeddings" in names else 0


def _best_masks(outputs: dict[str, Array]) -> list[Floats]:
    """For each box the logits (h, w) that the decoder likes best."""
    named = [outputs[name] for name in ("low_res_masks", "masks") if name in outputs]
    masks = np.asarray((named or [value for value in outputs.values() if value.ndim >= 3])[0], np.float32)
    masks = masks.reshape(len(masks) if masks.ndim == 4 else 1, -1, *masks.shape[-2:])  # (n, choices, h, w)
    liked = outputs.get("iou_predictions")
    if liked is None or liked.size < masks.shape[0] * masks.shape[1]:
        return list(masks[:, 0])
    scores = np.nan_to_num(np.asarray(liked, np.float32).reshape(len(masks), -1)[:, : masks.shape[1]])
    return list(masks[np.arange(len(masks)), scores.argmax(axis=1)])


def _reach(boxes: Floats, height: int, width: int) -> Floats:
    """How far the masks of boxes may reach: (n, 4) whole pixels inside the picture."""
    limits = np.array([width, height, width, height], np.float32)
    return inner(np.clip(np.nan_to_num(_grown(boxes)), 0, limits), width, height).astype(np.float32)


def _grown(boxes: Floats) -> Floats:
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2) * np.array([-1, -1, 1, 1], np.float32)
    return np.asarray(boxes + _GROWTH * sides, np.float32)


def _encoder_side(session: Session) -> int:
    tensors = session.signature.inputs
    shape = tensors[0].shape if len(tensors) == 1 else ()
    picture = shape[2:] if len(shape) == 4 and shape[1] == 3 else shape[:2] if len(shape) == 3 and shape[2] == 3 else ()
    if len(picture) == 2 and isinstance(picture[0], int) and picture[0] == picture[1]:
        return picture[0]
    if len(picture) == 2 and not any(isinstance(size, int) for size in picture):
        return _USUAL_SIDE
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
    given = encoder.signature.outputs[_embedding_index(encoder)]
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
