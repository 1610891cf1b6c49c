"""YOLOv3 as its paper has it: Darknet-53, three levels, three anchors each (Redmon and Farhadi 2018); and tiny."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from architectures.made import Answer, Feeds, Made, enliven, export, parameters, thing_names

CLASSES = 80
SIDE = 256
ANCHORS = {
    8: [(10, 13), (16, 30), (33, 23)],
    16: [(30, 61), (62, 45), (59, 119)],
    32: [(116, 90), (156, 198), (373, 326)],
}
TINY = {16: [(10, 14), (23, 27), (37, 58)], 32: [(81, 82), (135, 169), (344, 319)]}


def conv(before: int, after: int, side: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, normalisation, leaky rectifier."""
    layers = nn.Conv2d(before, after, side, stride, side // 2, bias=False), nn.BatchNorm2d(after), nn.LeakyReLU(0.1)
    return nn.Sequential(*layers)


class Residual(nn.Module):
    """1x1 to half the channels, 3x3 back, added."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(conv(channels, channels // 2, 1), conv(channels // 2, channels))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class Yolov3(nn.Module):
    """Pictures (B, 3, H, W) -> three heads (B, 3 * (5 + classes), h, w), strides 32, 16, 8."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        w = width
        self.stem = nn.Sequential(conv(3, w), self._stage(w, 1), self._stage(2 * w, 2), self._stage(4 * w, 8))
        self.to16, self.to32 = self._stage(8 * w, 8), self._stage(16 * w, 4)
        self.necks = nn.ModuleList([self._neck(32 * w, 16 * w), self._neck(24 * w, 8 * w), self._neck(12 * w, 4 * w)])
        self.narrow = nn.ModuleList([conv(16 * w, 8 * w, 1), conv(8 * w, 4 * w, 1)])
        self.heads = nn.ModuleList(
            nn.Sequential(conv(c, 2 * c), nn.Conv2d(2 * c, 3 * (5 + CLASSES), 1)) for c in (16 * w, 8 * w, 4 * w)
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        at8 = self.stem(x)
        at16 = self.to16(at8)
        top = self.necks[0](self.to32(at16))
        middle = self.necks[1](torch.cat([nn.functional.interpolate(self.narrow[0](top), scale_factor=2.0), at16], 1))
        fine = self.necks[2](torch.cat([nn.functional.interpolate(self.narrow[1](middle), scale_factor=2.0), at8], 1))
        return self.heads[0](top), self.heads[1](middle), self.heads[2](fine)

    @staticmethod
    def _stage(before: int, repeats: int) -> nn.Sequential:
        return nn.Sequential(conv(before, 2 * before, 3, 2), *(Residual(2 * before) for _ in range(repeats)))

    @staticmethod
    def _neck(before: int, after: int) -> nn.Sequential:
        squeeze = [conv(before, after, 1)]
        return nn.Sequential(*squeeze, *(conv(*pair) for pair in ((after, 2 * after), (2 * after, after, 1)) * 2))


class Yolov3Tiny(nn.Module):
    """The tiny one: two heads, strides 32 and 16."""

    def __init__(self) -> None:
        super().__init__()
        channels = [3, 16, 32, 64, 128, 256]
        blocks: list[nn.Module] = []
        for before, after in itertools.pairwise(channels):
            blocks += [conv(before, after), nn.MaxPool2d(2)] if after < 256 else [conv(before, after)]
        self.to16 = nn.Sequential(*blocks)
        self.to32 = nn.Sequential(nn.MaxPool2d(2), conv(256, 512), conv(512, 1024), conv(1024, 256, 1))
        self.narrow = conv(256, 128, 1)
        self.head32 = nn.Sequential(conv(256, 512), nn.Conv2d(512, 3 * (5 + CLASSES), 1))
        self.head16 = nn.Sequential(conv(384, 256), nn.Conv2d(256, 3 * (5 + CLASSES), 1))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        at16 = self.to16(x)
        at32 = self.to32(at16)
        wide = nn.functional.interpolate(self.narrow(at32), scale_factor=2.0)
        return self.head32(at32), self.head16(torch.cat([wide, at16], 1))


def yolov3(folder: Path) -> Made:
    """Darknet-53 at half its width."""
    return _made(Yolov3(16), folder / "yolov3.onnx", ["stride32", "stride16", "stride8"], ANCHORS)


def yolov3_tiny(folder: Path) -> Made:
    """At full width."""
    return _made(Yolov3Tiny(), folder / "yolov3_tiny.onnx", ["stride32", "stride16"], TINY)


def _made(network: nn.Module, path: Path, outputs: list[str], anchors: dict[int, list[tuple[int, int]]]) -> Made:
    enliven(network, SIDE)
    how = export(network, [torch.zeros(1, 3, SIDE, SIDE)], path, ["images"], outputs)

    def read(feeds: Feeds, size: tuple[int, int]) -> Answer:
        with torch.no_grad():
            heads = network(torch.from_numpy(feeds["images"]))
        parts = [_decode(head[0].double().numpy(), SIDE // head.shape[2], anchors) for head in heads]
        boxes, scores, class_ids = (np.concatenate(values) for values in zip(*parts, strict=True))
        scale = SIDE / max(size)
        shift = [(SIDE - size[1] * scale) / 2, (SIDE - size[0] * scale) / 2] * 2
        return Answer(((boxes - shift) / scale).astype(np.float32), scores.astype(np.float32), class_ids)

    return Made(path, how, parameters(network), thing_names(CLASSES), read)


def _decode(
    head: NDArray[np.float64], stride: int, anchors: dict[int, list[tuple[int, int]]]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Section 2.1 of the paper, one cell and one anchor at a time."""
    boxes, scores, class_ids = [], [], []
    for a, (width, height) in enumerate(anchors[stride]):
        part = head[a * (5 + CLASSES) : (a + 1) * (5 + CLASSES)]
        for row, column in np.ndindex(*part.shape[1:]):
            tx, ty, tw, th, to, *tc = part[:, row, column]
            x, y = (1 / (1 + np.exp(-tx)) + column) * stride, (1 / (1 + np.exp(-ty)) + row) * stride
            w, h = width * np.exp(tw), height * np.exp(th)
            boxes.append([x - w / 2, y - h / 2, x + w / 2, y + h / 2])
            class_ids.append(int(np.argmax(tc)))
            scores.append(1 / (1 + np.exp(-to)) / (1 + np.exp(-max(tc))))
    return np.array(boxes), np.array(scores), np.array(class_ids)
