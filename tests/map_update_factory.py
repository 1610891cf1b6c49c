"""Hand-made networks in the place of a trained map update, and the same update written as loops."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import helper

from tests.onnx_factory import save, value

KAPPA = 4.0
Array = NDArray[np.float32]


def random_kernels(classes: int, kernel: int, seed: int = 0) -> Array:
    """(L, L, kernel, kernel), small enough that states stay small."""
    spread = 0.5 / (classes * kernel)
    return np.random.default_rng(seed).normal(0.0, spread, (classes, classes, kernel, kernel)).astype(np.float32)


def make_map_update(path: Path, classes: Sequence[str], /, *, kernel: int = 3, **changes: Any) -> Path:
    """new_cell = 0.5 cell + placed; new_hidden = tanh(new_cell) + kernels over hidden, for observations of 11 cells.

    `changes` replaces metadata, or with None leaves it out.
    """
    weights: dict[str, NDArray[Any]] = {
        "kernels": random_kernels(len(classes), kernel),
        "half": np.array(0.5, np.float32),
    }
    nodes = [
        helper.make_node("Mul", ["cell", "half"], ["kept"]),
        helper.make_node("Add", ["kept", "placed"], ["new_cell"]),
        helper.make_node("Conv", ["hidden", "kernels"], ["nearby"]),
        helper.make_node("Tanh", ["new_cell"], ["bounded"]),
        helper.make_node("Add", ["bounded", "nearby"], ["new_hidden"]),
    ]
    count = len(classes)
    window, halo = (1, count, "rows", "columns"), (1, count, "halo_rows", "halo_columns")
    metadata = {"classes": json.dumps(list(classes)), "kappa": KAPPA, "cell_m": 0.3, "side": 11, "kernel": kernel}
    metadata |= changes
    return save(
        path,
        nodes,
        [value("placed", window), value("hidden", halo), value("cell", window)],
        [value("new_hidden", window), value("new_cell", window)],
        weights,
        metadata={key: str(text) for key, text in metadata.items() if text is not None},
    )


def slow_update(hidden: Array, cell: Array, placed: Array, kernel: int) -> tuple[Array, Array]:
    """The same over a whole map (L, H, W), zero beyond its border, cell by cell."""
    kernels, reach = random_kernels(len(hidden), kernel), kernel // 2
    padded = np.pad(hidden, ((0, 0), (reach, reach), (reach, reach)))
    new_cell = np.float32(0.5) * cell + placed
    nearby = np.zeros_like(hidden)
    for y, x in np.ndindex(*hidden.shape[1:]):
        nearby[:, y, x] = np.einsum("oijk,ijk->o", kernels, padded[:, y : y + kernel, x : x + kernel])
    return np.tanh(new_cell) + nearby, new_cell
