"""What a maker of a network hands over, and how answers of its project are written down."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

Feeds = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Answer:
    """What the network's own project reads from a picture, before suppression, in pixels of the picture."""

    boxes: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    scores: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    class_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    masks: Callable[[NDArray[np.int64]], NDArray[np.bool_]] | None = None
    """Masks (n, H, W) of the candidates asked for."""
    class_map: NDArray[np.int64] | None = None
    """(H, W), of a segmentation."""


@dataclass(frozen=True)
class Made:
    """A network as an ONNX file."""

    path: Path
    exported: str
    """How, in few words."""
    parameters: int
    names: Sequence[str]
    read: Callable[[Feeds, tuple[int, int]], Answer]
    """The project's reading of the tensors that semslam feeds, for a picture of some height and width."""


def enliven(network: nn.Module, side: int, seed: int = 0) -> nn.Module:
    """Random weights that carry a signal through; the network is left in evaluation mode.

    Fresh weights of most projects are so small that every place of every picture gets the same answer: nothing could be
    compared. Here weights keep the variance of what they are given, batch normalisation knows the statistics of a
    picture of large patches, and learned queries and tokens differ.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module in network.modules():
            for name, weight in module.named_parameters(recurse=False):
                if weight.requires_grad:  # the others are constants of the architecture
                    _draw(module, name, weight, generator)
        coarse = torch.rand(2, 3, 8, 8, generator=generator)
        _calibrate(network, nn.functional.interpolate(coarse, size=(side, side)))
    return network.eval()


def _draw(module: nn.Module, name: str, weight: torch.Tensor, generator: torch.Generator) -> None:
    noise = torch.randn(weight.shape, generator=generator)
    if isinstance(module, nn.Conv2d | nn.Linear) and name == "weight" and weight.shape[1:].numel() > 1:
        weight.copy_(noise * _gain(module) * weight.shape[1:].numel() ** -0.5)
    elif isinstance(module, nn.Conv2d | nn.Linear):
        weight.add_(noise * 0.1)
    elif not isinstance(module, nn.modules.batchnorm._NormBase | nn.LayerNorm | nn.GroupNorm) and weight.ndim > 1:
        weight.copy_(noise)


def _gain(module: nn.Module) -> float:
    """Less for convolutions that predict: their logits must not saturate, or all classes tie at 1."""
    predicts = isinstance(module, nn.Conv2d) and module.kernel_size == (1, 1) and module.bias is not None
    return 0.3 if predicts else 1.0


def _calibrate(network: nn.Module, pictures: torch.Tensor) -> None:
    network.eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.train()
            module.momentum = 1.0
    network(pictures)


def parameters(network: nn.Module) -> int:
    """Number of weights."""
    return sum(weight.numel() for weight in network.parameters())


def export(
    network: nn.Module,
    examples: Sequence[torch.Tensor],
    path: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    traced: bool = False,
    dynamic_axes: Mapping[str, Mapping[int, str]] | None = None,
    opset: int = 18,
) -> str:
    """Write an ONNX file; says how."""
    extra: dict[str, Any] = {} if traced else {"external_data": False}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(examples),
            str(path),
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes=dynamic_axes,
            opset_version=opset,
            dynamo=not traced,
            verbose=False,
            **extra,
        )
    return f"torch.onnx.export, {'traced' if traced else 'dynamo'}, opset {opset}"


def thing_names(count: int) -> list[str]:
    """Class names that mean nothing."""
    return [f"thing {index}" for index in range(count)]


def array(tensor: torch.Tensor) -> NDArray[Any]:
    """As numpy."""
    return np.asarray(tensor.detach().cpu().numpy())
