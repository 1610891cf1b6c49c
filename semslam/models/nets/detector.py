"""The detector: anchor-free, three levels, from colour and depth.

A YOLO-like network of about a million parameters: a residual backbone, features passed down and up again between its
levels (Liu et al. 2018, PANet), and for every cell of strides 8, 16 and 32 the distances from its centre to the four
sides of a box and a probability a class, without anchors or objectness (Tian et al. 2019, FCOS). Dense 3x3
convolutions throughout: on a processor they do more work a second than depthwise ones.

Depth enters as inverse depth, in which a step between object and background counts the more the nearer it is, with a
channel that says where it is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from torch import Tensor, nn

STRIDES = (8, 16, 32)
INPUT_WIDTH, INPUT_HEIGHT = 384, 288
NEAREST_M = 0.3
"""Inverse depth is capped here."""
_RARE = -4.6
"""Logit of 1 %: before training, hardly any cell holds an object of any one class."""
_LOG_REACH = 4.0
"""Distances are at most exp(4) strides."""


@dataclass(frozen=True)
class DetectorShape:
    """Sizes of the network: channels of the strides 2, 4, 8, 16 and 32, and residual blocks of the last four."""

    classes: int
    channels: tuple[int, int, int, int, int] = (16, 32, 64, 96, 128)
    blocks: tuple[int, int, int, int] = (1, 2, 3, 2)
    head: int = 64
    """Channels of the heads."""


class Detector(nn.Module):
    """Pictures (B, 3, H, W) in 0..1 and depth (B, 1, H, W) in metres -> raw (B, 4 + classes, cells).

    The first four rows are logarithms of distances in strides: left, top, right, bottom; the others class logits.
    Sides may be any multiple of 16.
    """

    def __init__(self, shape: DetectorShape) -> None:
        super().__init__()
        self.shape = shape
        c2, c4, c8, c16, c32 = shape.channels
        self.to2 = conv(5, c2, stride=2)
        self.to4 = stage(c2, c4, shape.blocks[0])
        self.to8 = stage(c4, c8, shape.blocks[1])
        self.to16 = stage(c8, c16, shape.blocks[2])
        self.to32 = nn.Sequential(stage(c16, c32, shape.blocks[3]), WideView(c32))
        self.lower16, self.lower8 = conv(c32, c16, 1), conv(c16, c8, 1)
        self.join16, self.join8 = Residual(c16), Residual(c8)
        self.rise16, self.rise32 = conv(c8, c16, stride=2), conv(c16, c32, stride=2)
        self.heads = nn.ModuleList(Head(width, shape.head, shape.classes) for width in (c8, c16, c32))

    def forward(self, images: Tensor, depth_m: Tensor) -> Tensor:
        p8 = self.to8(self.to4(self.to2(five_channels(images, depth_m))))
        p16 = self.to16(p8)
        p32 = self.to32(p16)
        p16 = self.join16(p16 + enlarged(self.lower16(p32), p16))
        p8 = self.join8(p8 + enlarged(self.lower8(p16), p8))
        p16 = p16 + self.rise16(p8)
        p32 = p32 + self.rise32(p16)
        return torch.cat([head(level) for head, level in zip(self.heads, (p8, p16, p32), strict=True)], 2)


class Exported(nn.Module):
    """The network as it is exported: boxes in pixels of the input, class probabilities, YOLOv8's layout.

    (B, 3, H, W) and (B, 1, H, W) -> (B, 4 + classes, cells): centre x, centre y, width, height, probabilities.
    """

    centres: Tensor
    strides: Tensor

    def __init__(self, network: Detector, width: int = INPUT_WIDTH, height: int = INPUT_HEIGHT) -> None:
        super().__init__()
        self.network = network
        centres, strides = cells(width, height)
        self.register_buffer("centres", centres)
        self.register_buffer("strides", strides)

    def forward(self, images: Tensor, depth_m: Tensor) -> Tensor:
        raw = self.network(images, depth_m)
        boxes = boxes_of(raw, self.centres, self.strides)  # (B, cells, 4)
        low, high = boxes[..., :2], boxes[..., 2:]
        placed = torch.cat([(low + high) / 2, high - low], -1).transpose(1, 2)
        return torch.cat([placed, raw[:, 4:].sigmoid()], 1)


class Head(nn.Module):
    """Distances and class logits of one level: (B, C, h, w) -> (B, 4 + classes, h * w)."""

    def __init__(self, inputs: int, width: int, classes: int) -> None:
        super().__init__()
        self.shared = conv(inputs, width)
        self.boxes, self.classes = nn.Conv2d(width, 4, 1), nn.Conv2d(width, classes, 1)
        nn.init.constant_(self.boxes.bias, 0.7)  # about two strides a side
        nn.init.constant_(self.classes.bias, _RARE)

    def forward(self, level: Tensor) -> Tensor:
        shared = self.shared(level)
        return torch.cat([self.boxes(shared), self.classes(shared)], 1).flatten(2)


class Residual(nn.Module):
    """x + conv3(conv1(x)), half as wide in between."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(conv(channels, channels // 2, 1), conv(channels // 2, channels))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class WideView(nn.Module):
    """Lets every cell of the coarsest level see its surroundings: maxima over growing windows (He et al. 2015)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.narrow, self.join = conv(channels, channels // 2, 1), conv(channels * 2, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        narrow = self.narrow(x)
        five = F.max_pool2d(narrow, 5, 1, 2)
        nine = F.max_pool2d(five, 5, 1, 2)
        return self.join(torch.cat([narrow, five, nine, F.max_pool2d(nine, 5, 1, 2)], 1))


def conv(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, SiLU."""
    convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.SiLU(inplace=True))


def stage(inputs: int, outputs: int, blocks: int) -> nn.Sequential:
    """Half the size, then residual blocks."""
    return nn.Sequential(conv(inputs, outputs, stride=2), *(Residual(outputs) for _ in range(blocks)))


def five_channels(images: Tensor, depth_m: Tensor) -> Tensor:
    """Colour -1..1, inverse depth 0..1 (1 at `NEAREST_M`), and 1 where depth is missing: (B, 5, H, W)."""
    known = (depth_m > 0).to(images.dtype)
    near = known * NEAREST_M / depth_m.clamp(min=NEAREST_M)
    return torch.cat([images * 2 - 1, near, 1 - known], 1)


def enlarged(coarse: Tensor, like: Tensor) -> Tensor:
    """Twice the size, cut to that of the finer level."""
    return F.interpolate(coarse, scale_factor=2.0, mode="nearest")[:, :, : like.shape[2], : like.shape[3]]


def cells(width: int, height: int) -> tuple[Tensor, Tensor]:
    """(cells, 2) centres in pixels and (cells,) strides, in the order of the network's output."""
    centres, strides = [], []
    for stride in STRIDES:
        y, x = torch.meshgrid(torch.arange(-(-height // stride)), torch.arange(-(-width // stride)), indexing="ij")
        centres.append((torch.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride)
        strides.append(torch.full((x.numel(),), float(stride)))
    return torch.cat(centres), torch.cat(strides)


def boxes_of(raw: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """(B, 4 + classes, cells) -> (B, cells, 4) left, top, right, bottom in pixels."""
    distances = raw[:, :4].clamp(-_LOG_REACH, _LOG_REACH).exp().transpose(1, 2) * strides[:, None]
    return torch.cat([centres - distances[..., :2], centres + distances[..., 2:]], -1)
