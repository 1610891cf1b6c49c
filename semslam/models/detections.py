"""What every detector gives, and the steps all of them share: fitting a picture, clipping, non-maximum suppression."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

MOST_OBJECTS = 300
"""In one picture; the best ones are kept."""
_MOST_CANDIDATES = 1000
"""That enter suppression, whose time grows with their square; the best ones are kept."""
_MAX_SCORE = 1.001
"""Rounding may carry a probability a little beyond 1."""


@dataclass(frozen=True)
class Detections:
    """Objects in one picture, by falling score."""

    boxes: Floats
    """(N, 4) left, top, right, bottom in pixels of the picture; right and bottom exclusive."""
    scores: Floats
    """(N,), 0 to 1."""
    class_ids: Indices
    """(N,) indices into the detector's own class names."""
    dropped: int = 0
    """Candidates with impossible values (not finite, no area inside the picture, a class without a name)."""
    masks: NDArray[np.bool_] | None = None
    """(N, H, W) pixels of the picture that belong to each object; None if the model does not tell."""

    def __len__(self) -> int:
        return len(self.scores)

    def of_classes(self, count: int) -> Detections:
        """Those whose class is one of the first `count`; the others are counted as dropped."""
        known = (self.class_ids >= 0) & (self.class_ids < count)
        if known.all():
            return self
        masks = None if self.masks is None else self.masks[known]
        lost = int(np.count_nonzero(~known))
        return Detections(self.boxes[known], self.scores[known], self.class_ids[known], self.dropped + lost, masks)


@dataclass(frozen=True)
class Letterbox:
    """How a picture was fitted into a model's input: scaled, then shifted."""

    scale_x: float
    """Pixels of the input a pixel of the picture."""
    scale_y: float
    left: int
    """Where the picture begins in the input."""
    top: int
    width: int
    """Of the picture, pixels."""
    height: int

    @property
    def inner(self) -> tuple[int, int]:
        """Width and height that the picture takes in the input, pixels."""
        return max(1, round(self.width * self.scale_x)), max(1, round(self.height * self.scale_y))

    def to_picture(self, boxes: Floats) -> Floats:
        """Boxes (N, 4) of the model's input in pixels of the picture, not clipped."""
        shift = np.array([self.left, self.top, self.left, self.top], np.float32)
        scale = np.array([self.scale_x, self.scale_y, self.scale_x, self.scale_y], np.float32)
        with np.errstate(over="ignore"):  # what becomes infinite is clipped
            return np.asarray((boxes - shift) / scale, np.float32)


def letterbox(picture: tuple[int, int], width: int, height: int, *, centred: bool = True) -> Letterbox:
    """A picture of (height, width) as large as fits into the input, in its middle or in its upper left corner."""
    rows, columns = picture
    scale = min(width / columns, height / rows)
    box = Letterbox(scale, scale, 0, 0, columns, rows)
    inner_width, inner_height = box.inner
    left, top = (width - inner_width) // 2, (height - inner_height) // 2
    return Letterbox(scale, scale, left, top, columns, rows) if centred else box


def stretched(picture: tuple[int, int], width: int, height: int) -> Letterbox:
    """A picture of (height, width) that fills the input, whatever becomes of its aspect."""
    rows, columns = picture
    return Letterbox(width / columns, height / rows, 0, 0, columns, rows)


def fitted(rgb: NDArray[np.uint8], box: Letterbox, width: int, height: int, *, fill: int = 114) -> NDArray[np.uint8]:
    """The picture (H, W, 3) as `box` says in (height, width, 3), the rest filled."""
    inner_width, inner_height = box.inner
    interpolation = shrinking(min(box.scale_x, box.scale_y))
    if (inner_width, inner_height) == (width, height):
        return np.asarray(cv2.resize(rgb, (width, height), interpolation=interpolation), np.uint8)
    canvas = np.full((height, width, 3), fill, np.uint8)
    inner = canvas[box.top : box.top + inner_height, box.left : box.left + inner_width]
    cv2.resize(rgb, (inner_width, inner_height), dst=inner, interpolation=interpolation)
    return canvas


def shrinking(scale: float) -> int:
    """How OpenCV is to resample colour: by means of pixels below half the size, else linearly, which is much faster."""
    return int(cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR)


def fit(
    rgb: NDArray[np.uint8], width: int, height: int, *, fill: int = 114, centred: bool = True
) -> tuple[NDArray[np.uint8], Letterbox]:
    """The picture (H, W, 3) scaled into (height, width, 3), the rest filled; scaling keeps the aspect."""
    box = letterbox((rgb.shape[0], rgb.shape[1]), width, height, centred=centred)
    return fitted(rgb, box, width, height, fill=fill), box


def fit_depth(depth_m: Floats, box: Letterbox, width: int, height: int) -> Floats:
    """Depth (H, W) placed as `box` says in (height, width), the rest 0; nearest, so that no depth is made up.

    What is not finite or negative is missing, too.
    """
    canvas = np.zeros((height, width), np.float32)
    inner_width, inner_height = box.inner
    inner = canvas[box.top : box.top + inner_height, box.left : box.left + inner_width]
    cv2.resize(depth_m, (inner_width, inner_height), dst=inner, interpolation=cv2.INTER_NEAREST_EXACT)
    inner[~((inner > 0) & (inner < np.inf))] = 0  # after resampling there are fewer to look at
    return canvas


def select(
    boxes: Floats, scores: Floats, class_ids: Indices, box: Letterbox, *, min_score: float, max_overlap: float
) -> Detections:
    """Candidates of a model as detections of the picture; `select_indices` tells how."""
    return select_indices(boxes, scores, class_ids, box, min_score=min_score, max_overlap=max_overlap)[0]


def select_indices(
    boxes: Floats, scores: Floats, class_ids: Indices, box: Letterbox, *, min_score: float, max_overlap: float
) -> tuple[Detections, Indices]:
    """Candidates of a model as detections of the picture, and which candidates they were.

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
    finite = np.isfinite(scores) & np.isfinite(boxes).all(axis=1)
    _refuse_logits(scores[finite])
    chosen = np.flatnonzero(finite & (scores >= min_score))
    chosen = chosen[np.argsort(-scores[chosen], kind="stable")][:_MOST_CANDIDATES]
    limits = np.array([box.width, box.height, box.width, box.height], np.float32)
    inside = np.clip(box.to_picture(boxes[chosen]), 0, limits)
    real = (inside[:, 2:] - inside[:, :2] > 1).all(axis=1)
    dropped = int(np.count_nonzero(~finite) + np.count_nonzero(~real))
    inside, chosen = inside[real], chosen[real]
    kept = _suppress(inside, scores[chosen], class_ids[chosen], max_overlap)
    chosen = chosen[kept]
    return Detections(inside[kept], scores[chosen], class_ids[chosen], dropped), chosen


def _refuse_logits(scores: Floats) -> None:
    if np.any(scores > _MAX_SCORE):
        raise SemslamError(
            f"Detector gives scores up to {float(scores.max()):.1f}, which are no probabilities",
            hint="it is not of the layout it is taken for: name that with `--set extract.adapter=NAME`",
        )


def _suppress(boxes: Floats, scores: Floats, class_ids: Indices, max_overlap: float) -> Indices:
    """Which of the boxes (by falling score) survive, in that order."""
    if len(boxes) == 0:
        return np.zeros(0, np.int64)
    rectangles = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(rectangles.tolist(), scores.tolist(), class_ids.tolist(), 0.0, max_overlap)
    return np.sort(np.asarray(kept, np.int64).ravel())[:MOST_OBJECTS]
