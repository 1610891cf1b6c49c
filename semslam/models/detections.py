"""What every detector gives, and the steps all of them share: letterbox, clipping, non-maximum suppression."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError

Floats = NDArray[np.float32]

_MAX_SCORE = 1.001
"""Rounding may carry a probability a little beyond 1."""


@dataclass(frozen=True)
class Detections:
    """Objects in one picture, by falling score."""

    boxes: Floats
    """(N, 4) left, top, right, bottom in pixels of the picture; right and bottom exclusive."""
    scores: Floats
    """(N,), 0 to 1."""
    class_ids: NDArray[np.int64]
    """(N,) indices into the detector's own class names."""
    dropped: int = 0
    """Candidates with impossible values (not finite, no area inside the picture)."""

    def __len__(self) -> int:
        return len(self.scores)


@dataclass(frozen=True)
class Letterbox:
    """How a picture was fitted into a model's input: scaled, then shifted."""

    scale: float
    left: float
    top: float
    width: int
    """Of the picture, pixels."""
    height: int

    def to_picture(self, boxes: Floats) -> Floats:
        """Boxes (N, 4) of the model's input in pixels of the picture, not clipped."""
        shift = np.array([self.left, self.top, self.left, self.top], np.float32)
        return np.asarray((boxes - shift) / np.float32(self.scale), np.float32)


def fit(
    rgb: NDArray[np.uint8], width: int, height: int, *, fill: int = 114, centred: bool = True
) -> tuple[NDArray[np.uint8], Letterbox]:
    """The picture (H, W, 3) scaled into (height, width, 3), the rest filled; scaling keeps the aspect."""
    rows, columns = rgb.shape[:2]
    scale = min(width / columns, height / rows)
    inner_width, inner_height = max(1, round(columns * scale)), max(1, round(rows * scale))
    left = (width - inner_width) // 2 if centred else 0
    top = (height - inner_height) // 2 if centred else 0
    canvas = np.full((height, width, 3), fill, np.uint8)
    inner = canvas[top : top + inner_height, left : left + inner_width]
    interpolation = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR
    cv2.resize(rgb, (inner_width, inner_height), dst=inner, interpolation=interpolation)
    return canvas, Letterbox(scale, left, top, columns, rows)


def select(
    boxes: Floats, scores: Floats, class_ids: NDArray[np.int64], box: Letterbox, *, min_score: float, max_overlap: float
) -> Detections:
    """Candidates of a model as detections of the picture.

    Drops what is not finite or has no area inside the picture (and counts it), clips the rest, and of boxes of one
    class that overlap by more than `max_overlap` (intersection over union) keeps the best.

    Args:
        boxes: (N, 4) left, top, right, bottom in pixels of the model's input.
        scores: (N,) confidence.
        class_ids: (N,).
        box: how the picture was fitted.
        min_score: lower ones are no candidates.
        max_overlap: 0 to 1.

    Raises:
        SemslamError: scores are no probabilities.
    """
    good = np.isfinite(scores) & np.isfinite(boxes).all(axis=1)
    dropped = int(np.count_nonzero(~good))
    if np.any(scores[good] > _MAX_SCORE):
        raise SemslamError(
            f"Detector gives scores up to {float(scores[good].max()):.1f}, which are no probabilities",
            hint="it is not of the layout it is taken for: name that with `--set extract.adapter=NAME`",
        )
    good &= scores >= min_score
    boxes, scores, class_ids = boxes[good], scores[good], class_ids[good]
    limits = np.array([box.width, box.height, box.width, box.height], np.float32)
    boxes = np.clip(box.to_picture(boxes), 0, limits)
    sides = boxes[:, 2:] - boxes[:, :2]
    real = (sides > 1).all(axis=1)
    dropped += int(np.count_nonzero(~real))
    kept = _suppress(boxes[real], scores[real], class_ids[real], max_overlap)
    return Detections(boxes[real][kept], scores[real][kept], class_ids[real][kept], dropped)


def _suppress(boxes: Floats, scores: Floats, class_ids: NDArray[np.int64], max_overlap: float) -> NDArray[np.int64]:
    """Indices that survive, by falling score; equal scores keep their order."""
    if len(boxes) == 0:
        return np.zeros(0, np.int64)
    order = np.argsort(-scores, kind="stable")
    boxes, scores, class_ids = boxes[order], scores[order], class_ids[order]
    rectangles = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(rectangles.tolist(), scores.tolist(), class_ids.tolist(), 0.0, max_overlap)
    return np.asarray(order[np.sort(np.asarray(kept, np.int64).ravel())], np.int64)
