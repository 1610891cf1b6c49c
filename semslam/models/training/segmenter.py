"""Training of the segmenter: boxes as a detector might give them, and the pixels that belong to what is in them.

Boxes are shifted and scaled at random, pictures changed in every way that must not matter. Cross-entropy asks for every
cell of a mask, Dice (Milletari et al. 2016) for the overlap; both are means over objects, so that small ones weigh as
much as large ones. Small pictures first, the full size last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from numpy.typing import NDArray
from torch import Tensor, nn

from semslam.models.nets.segmenter import (
    FEATURES,
    GRID,
    HEIGHT,
    MARGIN,
    STRIDE,
    WIDTH,
    ExportedDecoder,
    Segmenter,
)
from semslam.models.training.augment import Strength, randomised
from semslam.models.training.curriculum import CALM_FROM, odds, size_at
from semslam.models.training.export import export_onnx
from semslam.models.training.pictures import Picture, PictureSet, SeenObject, resized

ENCODER, DECODER = "segmenter_encoder.onnx", "segmenter_decoder.onnx"
TASK = "prompted-segmentation"
"""In the metadata of both files."""
BOXES = 6
"""Boxes in a picture; views show about seven objects that count."""
SIZES = ((0.35, 320, 240), (0.65, 448, 336), (1.0, WIDTH, HEIGHT))
"""Until which share of the steps, and the width and height of the pictures until then."""
USUAL = Strength(paste=0.3, no_depth=0.1)
CALM = Strength(0.5, 0.3, 0.5, 0.1, 0.05)
"""At the end pictures are changed but little: they end up as cameras give them."""
_JITTER, _MOST_JITTER, _EXACT = 0.045, 0.12, 0.25
"""Of a box's sides: deviation of its edges, its limit, and the share of boxes left as they are."""
_FINEST = 4
"""Samples across a cell of the wanted mask, at most."""
_MOST_BOXES = 4096

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Prompts:
    """What a step learns from: B pictures with K boxes each."""

    images: Tensor
    """(B, 3, H, W), 0 to 1."""
    depth_m: Tensor
    """(B, 1, H, W)"""
    boxes: Tensor
    """(B, K, 4) left, top, right, bottom in pixels."""
    masks: Tensor
    """(B * K, GRID, GRID) share of each cell that belongs to the object."""
    weights: Tensor
    """(B * K,) 0 for the boxes of pictures without objects."""

    def to(self, device: torch.device) -> Prompts:
        """The batch on a device."""
        parts = (self.images, self.depth_m, self.boxes, self.masks, self.weights)
        return Prompts(*(part.to(device) for part in parts))


@dataclass(eq=False)
class PromptBatches:
    """Makes the batch of any step; a pure function of seed and step."""

    pictures: PictureSet
    odds: NDArray[np.float64]
    """(N,) how likely each picture is drawn; sums to 1."""
    steps: int
    batch: int
    seed: int
    strength: Strength

    @staticmethod
    def of(
        pictures: PictureSet, *, steps: int, batch: int, seed: int, strength: Strength | None = None
    ) -> PromptBatches:
        """Pictures stay as the files hold them, decoded step by step: at full size they would fill the memory."""
        return PromptBatches(pictures, odds(pictures), steps, batch, seed, strength or USUAL)

    def __call__(self, step: int) -> Prompts:
        rng = np.random.default_rng([self.seed, 0x5E6, step])
        done = step / self.steps
        width, height = size_at(SIZES, done)
        strength = CALM if done >= CALM_FROM else self.strength
        chosen = rng.choice(len(self.pictures), (self.batch, 2), p=self.odds).tolist()
        made = [self._randomised(first, second, (width, height), rng, strength) for first, second in chosen]
        return collated(made, rng)

    def _randomised(
        self, first: int, second: int, size: tuple[int, int], rng: np.random.Generator, strength: Strength
    ) -> Picture:
        pastes = rng.random() < strength.paste
        picture = resized(self.pictures[first], *size)
        other = resized(self.pictures[second], *size) if pastes else None
        return randomised(picture, other, rng, replace(strength, paste=1.0))


def collated(pictures: Sequence[Picture], rng: np.random.Generator) -> Prompts:
    """Pictures of one size as tensors, with boxes drawn from their objects."""
    images = np.stack([picture.rgb for picture in pictures]).astype(np.float32) * np.float32(1 / 255)
    depth = np.stack([picture.depth_m for picture in pictures])[:, None]
    prompted = [_prompted(picture, rng) for picture in pictures]
    boxes, masks, weights = (np.stack([part[index] for part in prompted]) for index in range(3))
    return Prompts(
        torch.from_numpy(images).permute(0, 3, 1, 2),  # channels last in memory, as the network wants them
        torch.from_numpy(depth),
        torch.from_numpy(boxes),
        torch.from_numpy(masks).flatten(0, 1),
        torch.from_numpy(weights).flatten(),
    )


def _prompted(picture: Picture, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """(K, 4) boxes, (K, GRID, GRID) masks and (K,) weights; with few objects some come twice, with other boxes."""
    height, width = picture.instances.shape
    found = picture.counting
    if not found:
        whole = np.array([[0, 0, width, height]], np.float32).repeat(BOXES, 0)
        return whole, np.zeros((BOXES, GRID, GRID), np.float32), np.zeros(BOXES, np.float32)
    order = np.concatenate([rng.permutation(len(found)) for _ in range(-(-BOXES // len(found)))])
    chosen = [found[int(index)] for index in order[:BOXES]]
    boxes = np.stack([jittered(item, width, height, rng) for item in chosen])
    masks = np.stack(
        [wanted_mask(picture.instances, item.instance, box) for item, box in zip(chosen, boxes, strict=True)]
    )
    return boxes, masks, np.ones(BOXES, np.float32)


def jittered(item: SeenObject, width: int, height: int, rng: np.random.Generator) -> Floats:
    """(4,) the box of an object as a detector might give it, inside the picture."""
    box = np.array([item.left, item.top, item.right, item.bottom], np.float32)
    shift = np.clip(rng.normal(0, _JITTER, 4), -_MOST_JITTER, _MOST_JITTER)
    if rng.random() >= _EXACT:
        box += (shift * np.tile(box[2:] - box[:2], 2)).astype(np.float32)
    return np.clip(box, 0, np.array([width, height, width, height], np.float32))


def wanted_mask(instances: NDArray[np.uint16], instance: int, box: Floats, grid: int = GRID) -> Floats:
    """(grid, grid) share of every cell of the box's window that is the object; a picture's edge goes on beyond it."""
    low, sides = box[:2] - MARGIN * (box[2:] - box[:2]), (1 + 2 * MARGIN) * np.maximum(box[2:] - box[:2], 1)
    samples = int(np.clip(np.ceil(sides.max() / grid), 1, _FINEST))
    step = sides / (grid * samples)
    matrix = np.array([[step[0], 0, low[0] + step[0] / 2 - 0.5], [0, step[1], low[1] + step[1] / 2 - 0.5]], np.float64)
    mask = (instances == instance).astype(np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    fine = cv2.warpAffine(mask, matrix, (grid * samples,) * 2, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(fine.reshape(grid, samples, grid, samples).mean((1, 3)), np.float32)


def mask_loss(network: nn.Module, batch: Prompts) -> tuple[Tensor, Mapping[str, float]]:
    """Cross-entropy and Dice of the masks; told besides: their intersection over union on the grid."""
    batch = batch.to(next(network.parameters()).device)
    logits = network(batch.images, batch.depth_m, batch.boxes)
    entropy = F.binary_cross_entropy_with_logits(logits, batch.masks, reduction="none").mean((1, 2))
    given, wanted = logits.sigmoid(), batch.masks
    dice = 1 - (2 * (given * wanted).sum((1, 2)) + 1) / ((given + wanted).sum((1, 2)) + 1)
    total = batch.weights.sum().clamp(min=1)
    entropy, dice = (entropy * batch.weights).sum() / total, (dice * batch.weights).sum() / total
    overlap = (mask_overlap(logits.detach(), wanted) * batch.weights).sum() / total
    parts = {"entropy": float(entropy.detach()), "dice": float(dice.detach()), "iou": float(overlap)}
    return 2 * entropy + dice, parts


def mask_overlap(logits: Tensor, masks: Tensor) -> Tensor:
    """(N,) intersection over union of masks (N, m, m) on the grid."""
    given, wanted = logits > 0, masks > 0.5
    union = (given | wanted).sum((1, 2))
    return (given & wanted).sum((1, 2)) / union.clamp(min=1)


def new_segmenter(seed: int) -> Segmenter:
    """A segmenter as initialised from a seed."""
    torch.manual_seed(seed)
    return Segmenter()


def export_segmenter(network: Segmenter, folder: Path) -> list[Path]:
    """Write encoder and decoder as ONNX; any number of boxes at once."""
    plain = Segmenter()  # on the CPU, with weights as they lie by default: neither may show in the bytes
    plain.load_state_dict(network.state_dict())
    metadata = {"task": TASK, "input": "rgb 0..1, depth metres", "box_margin": str(MARGIN), "license": "Apache-2.0"}
    picture = (torch.zeros(1, 3, HEIGHT, WIDTH), torch.zeros(1, 1, HEIGHT, WIDTH))
    names = ["images", "depth"]
    export_onnx(
        plain.encoder, picture, folder / ENCODER, input_names=names, output_names=["features"], metadata=metadata
    )
    number = torch.export.Dim("boxes", min=1, max=_MOST_BOXES)
    export_onnx(
        ExportedDecoder(plain.decoder),
        (torch.zeros(1, FEATURES, HEIGHT // STRIDE, WIDTH // STRIDE), torch.tensor([[0.0, 0, 64, 64]]).repeat(3, 1)),
        folder / DECODER,
        input_names=["features", "boxes"],
        output_names=["masks"],
        dynamic_shapes={"features": None, "boxes": {0: number}},
        metadata=metadata,
    )
    return [folder / ENCODER, folder / DECODER]
