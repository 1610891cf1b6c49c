"""The promptable segmenter: what is in a picture is worked out once, then each box is cut out of it as a mask.

    pair = Segmenter()
    features = pair.encoder(images, depth)      # (B, 3, h, w), (B, 1, h, w) metres -> (B, FEATURES, h / 2, w / 2)
    logits = pair.decoder(features, boxes)      # boxes (B, K, 4) in pixels of the input -> (B * K, GRID, GRID)

Shaped like Segment Anything (Kirillov et al. 2023): image encoder, prompt, mask decoder; here both are convolutions.
The decoder sees each box through a window of fixed size, as Mask R-CNN's head does (He et al. 2017), and through a
small U-Net (Ronneberger et al. 2015). Depth goes in twice: into the encoder as inverse depth, and past it into the
window, where it is taken relative to where the content of the box stands: its steps there are the outlines wanted.

Dense 3x3 convolutions with multiples of eight channels: on a CPU they run several times faster for each operation than
depthwise ones.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from torch import Tensor, nn

HEIGHT, WIDTH = 480, 640
"""Of the encoder's input, pixels; any multiple of 16 does."""
STRIDE = 2
"""Pixels of the input in a cell of the features."""
GRID = 64
"""Cells of a mask, across and down."""
MARGIN = 0.125
"""Of the box's size, on each side: how much of its surroundings the window shows. Boxes are imperfect."""
LEARNED, MEASURED = 16, 3
FEATURES = LEARNED + MEASURED
"""Channels of the features: learned ones, then inverse depth of the nearest and of the farthest pixel of the cell (1/m,
0 where missing), and 1 where there is any."""

_NEAREST_M = 0.2
_REACH_M = 2.0
_PROMPTED = 8
"""Channels that the prompt adds to the learned ones."""


class Encoder(nn.Module):
    """Colour and depth to features, with a look at the surroundings of 16 times coarser cells."""

    def __init__(self) -> None:
        super().__init__()
        self.to2 = _conv(5, LEARNED, stride=2)
        self.to4 = nn.Sequential(_conv(LEARNED, 24, stride=2), Residual(24))
        self.to8 = nn.Sequential(_conv(24, 32, stride=2), Residual(32))
        self.to16 = nn.Sequential(_conv(32, 48, stride=2), Residual(48), Residual(48))
        self.from16, self.join8 = _linear(48, 32), _conv(32, 32)
        self.from8, self.join4 = _linear(32, 24), _conv(24, LEARNED)
        self.from4 = _linear(LEARNED, LEARNED)

    def forward(self, images: Tensor, depth: Tensor) -> Tensor:
        """(B, 3, h, w) RGB in 0..1 and (B, 1, h, w) metres, 0 where missing -> (B, FEATURES, h / 2, w / 2)"""
        seen = (depth > 0).to(depth.dtype)
        inverse = seen / depth.clamp(min=_NEAREST_M)
        fine = self.to2(torch.cat([images * 4 - 2, inverse * 2, seen], 1))
        at4 = self.to4(fine)
        at8 = self.to8(at4)
        at8 = self.join8(at8 + _double(self.from16(self.to16(at8))))
        at4 = self.join4(at4 + _double(self.from8(at8)))
        learned = F.relu(fine + _double(self.from4(at4)))
        return torch.cat([learned, _extremes(inverse, seen)], 1)


class Decoder(nn.Module):
    """Features and boxes to masks: a window on each box, then a U-Net of four levels on it."""

    places: Tensor
    """(1, 4, GRID, GRID); what `_places` says."""

    def __init__(self, grid: int = GRID) -> None:
        super().__init__()
        self.grid = grid
        self.register_buffer("places", _places(grid), persistent=False)
        self.level0 = _conv(LEARNED + _PROMPTED, 16)
        self.level1 = nn.Sequential(_conv(16, 32, stride=2), Residual(32))
        self.level2 = nn.Sequential(_conv(32, 48, stride=2), Residual(48))
        self.level3 = nn.Sequential(_conv(48, 64, stride=2), Residual(64))
        self.size = nn.Linear(3, 48)
        self.from3, self.join2 = _linear(64, 48), _conv(48, 48)
        self.from2, self.join1 = _linear(48, 32), _conv(32, 32)
        self.from1, self.join0 = _linear(32, 16), _conv(16, 16)
        self.mask = nn.Conv2d(16, 1, 1)

    def forward(self, features: Tensor, boxes: Tensor) -> Tensor:
        """(B, FEATURES, h, w), (B, K, 4) -> (B * K, GRID, GRID) logits"""
        return self.cut(crop(features, grown(boxes), self.grid), boxes.flatten(0, 1))

    def cut(self, windows: Tensor, boxes: Tensor) -> Tensor:
        """(N, FEATURES, GRID, GRID) windows on boxes (N, 4) -> (N, GRID, GRID) logits"""
        prompted, size = self._prompt(windows, boxes)
        at0 = self.level0(prompted)
        at1 = self.level1(at0)
        at2 = F.relu(self.level2(at1) + self.size(size)[:, :, None, None])
        at2 = self.join2(at2 + _double(self.from3(self.level3(at2))))
        at1 = self.join1(at1 + _double(self.from2(at2)))
        at0 = self.join0(at0 + _double(self.from1(at1)))
        logits: Tensor = self.mask(at0)
        return logits[:, 0]

    def _prompt(self, windows: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
        """The windows with what is measured taken relative to the box, and (N, 3) size and nearness of its content."""
        learned, measured = windows[:, :LEARNED], windows[:, LEARNED:]
        near, far, seen = measured[:, :1], measured[:, 1:2], measured[:, 2:]
        near, far = near / seen.clamp(min=0.1), far / seen.clamp(min=0.1)  # holes pull the mean of neighbours down
        weight = self.places[:, 3:] * seen
        main = _mean(near, weight)
        front = _mean(near, weight * near**4)
        here = 1 / near.clamp(min=0.05)
        relative = [
            seen * (near / main - 1).clamp(-1, 1) * 3,
            seen * _metres(here - 1 / main),
            seen * _metres(here - 1 / front),
            seen * ((near - far) / main).clamp(0, 1) * 3,
            seen,
        ]
        places = self.places[:, :3].expand(windows.shape[0], -1, -1, -1)
        sides = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1)
        size = torch.cat([(sides / 64).log(), main[:, :, 0, 0]], 1)
        return torch.cat([learned, *relative, places], 1), size


class Segmenter(nn.Module):
    """Encoder and decoder, trained together."""

    def __init__(self, grid: int = GRID) -> None:
        super().__init__()
        self.encoder, self.decoder = Encoder(), Decoder(grid)

    def forward(self, images: Tensor, depth: Tensor, boxes: Tensor) -> Tensor:
        """Logits (B * K, GRID, GRID) of boxes (B, K, 4) in pictures (B, 3, h, w) with depth (B, 1, h, w)."""
        logits: Tensor = self.decoder(self.encoder(images, depth), boxes)
        return logits


class Residual(nn.Module):
    """Adds what a convolution makes of its input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = _linear(channels, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.inner(x))


class ExportedDecoder(nn.Module):
    """The decoder for one picture, as a file has it: `features` (1, C, h, w), `boxes` (N, 4) -> `masks` (N, m, m)."""

    def __init__(self, decoder: Decoder) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, features: Tensor, boxes: Tensor) -> Tensor:
        rois = grown(boxes)
        picture = torch.zeros_like(boxes[:, 0], dtype=torch.int64)
        side = self.decoder.grid
        windows = torch.onnx.ops.symbolic(  # four times faster in ONNX Runtime than GridSample, and the same
            "RoiAlign",
            (features, rois, picture),
            {
                "output_height": side,
                "output_width": side,
                "sampling_ratio": 1,
                "spatial_scale": 1 / STRIDE,
                "mode": "avg",
                "coordinate_transformation_mode": "half_pixel",
            },
            dtype=features.dtype,
            shape=(boxes.shape[0], FEATURES, side, side),
            version=16,
        )
        return self.decoder.cut(windows, boxes)


def grown(boxes: Tensor) -> Tensor:
    """Boxes (..., 4) with their margin."""
    sides = boxes[..., 2:] - boxes[..., :2]
    return torch.cat([boxes[..., :2] - MARGIN * sides, boxes[..., 2:] + MARGIN * sides], -1)


def crop(features: Tensor, windows: Tensor, side: int) -> Tensor:
    """(B, C, h, w) seen through windows (B, K, 4) in pixels of the input -> (B * K, C, side, side)

    The values of ONNX's RoiAlign with one sample a cell: linear between cells, the edge goes on for one cell beyond
    the picture, then zeros.
    """
    pictures, channels, height, width = features.shape
    steps = (torch.arange(side, device=windows.device) + 0.5) / side
    across = (windows[..., 0:1] + steps * (windows[..., 2:3] - windows[..., 0:1])) / STRIDE  # (B, K, side)
    down = (windows[..., 1:2] + steps * (windows[..., 3:4] - windows[..., 1:2])) / STRIDE
    inside = ((across > -0.5) & (across < width + 0.5))[..., None, :] & ((down > -0.5) & (down < height + 0.5))[
        ..., None
    ]
    x = (2 * across / width - 1)[..., None, :].expand(inside.shape)
    y = (2 * down / height - 1)[..., None].expand(inside.shape)
    at = torch.stack([x, y], -1).flatten(1, 2)  # (B, K * side, side, 2)
    seen = F.grid_sample(features, at, padding_mode="border", align_corners=False)
    seen = seen.reshape(pictures, channels, -1, side, side) * inside[:, None]
    return seen.transpose(1, 2).flatten(0, 1)


def _extremes(inverse: Tensor, seen: Tensor) -> Tensor:
    """(B, 1, h, w) inverse depth and where there is any -> (B, 3, h / 2, w / 2) nearest, farthest, where."""
    near = F.max_pool2d(inverse, STRIDE)
    far = -F.max_pool2d(inverse.neg() - (1 - seen) * 100, STRIDE)
    return torch.cat([near, torch.minimum(far, near), (near > 0).to(near.dtype)], 1)


def _places(grid: int) -> Tensor:
    """(1, 4, GRID, GRID) of every window: across and down (-1 to 1 between the box's edges), inside the box, nearness
    to its middle."""
    along = ((torch.arange(grid) + 0.5) / grid - 0.5) * (2 + 4 * MARGIN)
    down, across = torch.meshgrid(along, along, indexing="ij")
    inside = ((across.abs() < 1) & (down.abs() < 1)).float()
    return torch.stack([across, down, inside, inside * torch.exp(-1.5 * (across**2 + down**2))])[None]


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """(N, 1, 1, 1) mean of inverse depths; that of 5 m where there are none."""
    return ((values * weight).sum((2, 3), keepdim=True) + 0.2e-4) / (weight.sum((2, 3), keepdim=True) + 1e-4)


def _metres(difference_m: Tensor) -> Tensor:
    return difference_m.clamp(-_REACH_M, _REACH_M)


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Module:
    return nn.Sequential(*_linear(inputs, outputs, 3, stride), nn.ReLU(inplace=True))


def _linear(inputs: int, outputs: int, kernel: int = 1, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs))


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")
