"""Training of the detector: batches of randomised pictures, task-aligned assignment, boxes by generalised IoU.

Assignment after Feng et al. 2021 (TOOD), as YOLOv8 does it; boxes after Rezatofighi et al. 2019 (GIoU). Small pictures
first, the full size last: most of what there is to learn does not need every pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from numpy.typing import NDArray
from torch import Tensor, nn

from semslam.models.nets.detector import INPUT_HEIGHT, INPUT_WIDTH, STRIDES, boxes_of, cells
from semslam.models.training.augment import Strength, randomised
from semslam.models.training.curriculum import CALM_FROM, odds, size_at
from semslam.models.training.pictures import Picture, PictureSet, SeenObject, resized

SIZES = ((0.45, 256, 192), (0.8, 320, 240), (1.0, INPUT_WIDTH, INPUT_HEIGHT))
"""Until which share of the steps, and the width and height of the pictures until then."""
CALM = Strength(0.5, 0.3, 0.5, 0.0, 0.05)
"""At the end."""
_CANDIDATES = 10
_BOX_WEIGHT = 5.0


@dataclass(frozen=True, eq=False)
class Examples:
    """Truth of one picture: boxes (N, 4) left, top, right, bottom in pixels, class ids (N,); and what to ignore."""

    boxes: Tensor
    classes: Tensor
    ignored: Tensor
    """(M, 4)"""
    ignored_classes: Tensor
    """(M,)"""

    def to(self, device: torch.device) -> Examples:
        """The same on a device."""
        parts = (self.boxes, self.classes, self.ignored, self.ignored_classes)
        return Examples(*(part.to(device) for part in parts))


@dataclass(frozen=True, eq=False)
class Batch:
    """What a step learns from."""

    images: Tensor
    """(B, 3, H, W), 0 to 1."""
    depth_m: Tensor
    """(B, 1, H, W)"""
    truth: Sequence[Examples]

    def to(self, device: torch.device) -> Batch:
        """The batch on a device."""
        return Batch(self.images.to(device), self.depth_m.to(device), [one.to(device) for one in self.truth])


@dataclass(eq=False)
class Batches:
    """Makes the batch of any step; a pure function of seed and step."""

    pictures: Sequence[Picture]
    """At `INPUT_WIDTH` x `INPUT_HEIGHT`."""
    weights: NDArray[np.float64]
    """(N,) how likely each is drawn; sums to 1."""
    steps: int
    batch: int
    seed: int
    strength: Strength

    @staticmethod
    def of(pictures: PictureSet, *, steps: int, batch: int, seed: int, strength: Strength | None = None) -> Batches:
        """Decode all pictures, small enough to keep."""
        size = INPUT_WIDTH, INPUT_HEIGHT
        kept = [_compact(resized(pictures[index], *size)) for index in range(len(pictures))]
        return Batches(kept, odds(pictures), steps, batch, seed, strength or Strength())

    def __call__(self, step: int) -> Batch:
        rng = np.random.default_rng([self.seed, step])
        width, height = size_at(SIZES, step / self.steps)
        calm = step >= CALM_FROM * self.steps
        strength = CALM if calm else self.strength
        chosen = rng.choice(len(self.pictures), (self.batch, 2), p=self.weights)
        made = []
        for first, second in chosen.tolist():
            # the smaller size first: what follows costs by the pixel
            picture, other = (resized(_plain(self.pictures[i]), width, height) for i in (first, second))
            made.append(randomised(picture, other, rng, strength))
        return collated(made)


def collated(pictures: Sequence[Picture]) -> Batch:
    """Pictures of one size as tensors."""
    images = np.stack([picture.rgb for picture in pictures]).astype(np.float32) * np.float32(1 / 255)
    depth = np.stack([picture.depth_m for picture in pictures])[:, None]
    tensor = torch.from_numpy(images).permute(0, 3, 1, 2)  # channels last in memory, as the network wants them
    truth = [
        Examples(_boxes(p.counting), _classes(p.counting), _boxes(p.glimpses), _classes(p.glimpses)) for p in pictures
    ]
    return Batch(tensor, torch.from_numpy(depth), truth)


def _boxes(objects: Sequence[SeenObject]) -> Tensor:
    rows = [(item.left, item.top, item.right, item.bottom) for item in objects]
    return torch.tensor(rows, dtype=torch.float32).reshape(-1, 4)


def _classes(objects: Sequence[SeenObject]) -> Tensor:
    return torch.tensor([item.class_id for item in objects], dtype=torch.int64)


def _compact(picture: Picture) -> Picture:
    """With depth as halves, in steps of 2 mm at 2 to 4 m, for half the memory."""
    return Picture(picture.rgb, picture.depth_m.astype(np.float16), picture.instances, picture.objects)


def _plain(picture: Picture) -> Picture:
    return Picture(picture.rgb, picture.depth_m.astype(np.float32), picture.instances, picture.objects)


def detection_loss(network: nn.Module, batch: Batch) -> tuple[Tensor, Mapping[str, float]]:
    """Binary cross-entropy of the classes against soft targets, and 1 - GIoU of the cells that answer."""
    device = next(network.parameters()).device
    batch = batch.to(device)
    raw = network(batch.images, batch.depth_m)
    centres, strides = (part.to(device) for part in _cells(batch.images.shape[3], batch.images.shape[2]))
    boxes, logits = boxes_of(raw, centres, strides), raw[:, 4:].transpose(1, 2)
    with torch.no_grad():
        scores = logits.sigmoid()
        targets = [assign(boxes[i], scores[i], centres, strides, truth) for i, truth in enumerate(batch.truth)]
    wanted, goal, used = (torch.stack([target[part] for target in targets]) for part in range(3))
    weight = wanted.sum(-1)  # (B, cells)
    total = weight.sum().clamp(min=1)
    entropy = F.binary_cross_entropy_with_logits(logits, wanted, reduction="none") * used
    classification = entropy.sum() / total
    chosen = weight > 0
    regression = ((1 - generalised_iou(boxes[chosen], goal[chosen])) * weight[chosen]).sum() / total
    parts = {"classes": float(classification.detach()), "boxes": float(regression.detach())}
    return classification + _BOX_WEIGHT * regression, parts


@cache
def _cells(width: int, height: int) -> tuple[Tensor, Tensor]:
    return cells(width, height)


def assign(
    boxes: Tensor, scores: Tensor, centres: Tensor, strides: Tensor, truth: Examples
) -> tuple[Tensor, Tensor, Tensor]:
    """Which cell answers for which object: targets (cells, classes), boxes (cells, 4), what counts (cells, classes).

    Each object takes the ten cells inside it whose answer is best, score^0.5 * IoU^4; a cell wanted by several goes
    to the one it overlaps most. On objects too small or hidden to count, their own class is left out of the loss.
    """
    wanted, goal, used = torch.zeros_like(scores), torch.zeros_like(boxes), torch.ones_like(scores)
    for inside, class_id in zip(inside_boxes(centres, truth.ignored), truth.ignored_classes.tolist(), strict=True):
        used[inside, class_id] = 0
    if not len(truth.boxes):
        return wanted, goal, used
    overlap = pairwise_iou(truth.boxes, boxes).clamp(min=1e-6)  # (G, cells)
    quality = scores[:, truth.classes].T.clamp(min=1e-6).sqrt() * overlap**4
    quality = quality * _eligible(centres, strides, truth.boxes)
    best = quality.topk(_CANDIDATES, dim=1)
    mine = torch.zeros_like(quality).scatter_(1, best.indices, 1.0) * (quality > 0)
    owner = (mine * overlap).argmax(0)
    mine = mine * F.one_hot(owner, len(truth.boxes)).T
    quality = quality * mine
    strength = quality / quality.amax(1, keepdim=True).clamp(min=1e-12) * (overlap * mine).amax(1, keepdim=True)
    taken = torch.nonzero(mine.amax(0) > 0).squeeze(1)
    wanted[taken, truth.classes[owner[taken]]] = strength.amax(0)[taken].clamp(min=0.05)
    goal[taken] = truth.boxes[owner[taken]]
    used[taken] = 1
    return wanted, goal, used


def _eligible(centres: Tensor, strides: Tensor, boxes: Tensor) -> Tensor:
    """(G, cells) True where a centre lies in the box; of tiny boxes, where it lies within a stride of its middle."""
    inside = inside_boxes(centres, boxes)
    middles = (boxes[:, None, :2] + boxes[:, None, 2:]) / 2  # (G, 1, 2)
    near = ((centres[None] - middles).abs().amax(-1) < strides[None]) & (strides == STRIDES[0])
    return inside | (near & (inside.sum(1, keepdim=True) < _CANDIDATES // 2))


def inside_boxes(centres: Tensor, boxes: Tensor) -> Tensor:
    """(G, cells) True where the centre lies in the box."""
    low, high = centres[None] - boxes[:, None, :2], boxes[:, None, 2:] - centres[None]
    return torch.cat([low, high], -1).amin(-1) > 0


def pairwise_iou(first: Tensor, second: Tensor) -> Tensor:
    """(G, 4), (N, 4) -> (G, N)"""
    low = torch.maximum(first[:, None, :2], second[None, :, :2])
    high = torch.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    areas = [(b[:, 2:] - b[:, :2]).prod(-1) for b in (first, second)]
    return shared / (areas[0][:, None] + areas[1][None] - shared)


def generalised_iou(first: Tensor, second: Tensor) -> Tensor:
    """(N, 4), (N, 4) -> (N,)"""
    low, high = torch.maximum(first[:, :2], second[:, :2]), torch.minimum(first[:, 2:], second[:, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    union = sum((b[:, 2:] - b[:, :2]).prod(-1) for b in (first, second)) - shared
    hull = (torch.maximum(first[:, 2:], second[:, 2:]) - torch.minimum(first[:, :2], second[:, :2])).prod(-1)
    return shared / union - (hull - union) / hull
