"""Training and export of MapNet (nets/mapnet.py).

Loss: cross-entropy of the pose field on the true pose bin, mean over keyframes after the first, whose pose is known.
In the first part of the training every keyframe is placed by its true pose; after that by the network's own field, as
at run time and in the paper. (With fields that are still flat the map is a smear that nothing can be found in, and the
beginning takes long.) Sequences start in the middle of the map with heading 0, as a log does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from numpy.typing import NDArray
from torch import Tensor, nn

from semslam.models.nets.mapnet import MapNet, MapNetShape, MapNetStep, bins_of, place, place_at, poses_of, turn
from semslam.models.small_view import HEIGHT, PARTS, WIDTH, cells_of
from semslam.models.training.export import export_onnx
from semslam.models.training.sequences import PictureDrives, varied
from semslam.models.training.trainer import Progress, Schedule, fit

MAPNET = "mapnet.onnx"
LENGTH = 6
"""Keyframes of a training sequence; any number at run time."""
TRAINING_MAP_SIDE = 21
"""Cells along a side of the map in training. Six keyframes at 1 Hz lead 2.5 m away, matching costs by the cell, and no
weight depends on the size; the export has the whole map."""
GIVEN_UNTIL = 0.4
"""Share of the steps in which keyframes are placed by their true poses."""
USUAL = Schedule(steps=800, batch=4, warm_up=50, average=0.99)
"""Sequences a step."""


@dataclass(frozen=True, eq=False)
class MapNetBatch:
    """What a step learns from."""

    pictures: Tensor
    """(B, T, 3, HEIGHT, WIDTH), 0 to 1."""
    cells: Tensor
    """(B, T, PARTS) flat cells of the observation."""
    bins: Tensor
    """(B, T) flat true pose bins; -1 off the map."""
    given: bool
    """Keyframes are placed by their true bins."""

    def to(self, device: torch.device) -> MapNetBatch:
        """The batch on a device."""
        return MapNetBatch(self.pictures.to(device), self.cells.to(device), self.bins.to(device), self.given)


@dataclass(eq=False)
class MapNetBatches:
    """Makes the batch of any step; a pure function of seed and step."""

    drives: PictureDrives
    windows: NDArray[np.int64]
    """(N, 2) drive and first keyframe."""
    shape: MapNetShape
    schedule: Schedule
    length: int

    @staticmethod
    def of(drives: PictureDrives, shape: MapNetShape, schedule: Schedule, length: int = LENGTH) -> MapNetBatches:
        """Batches of all windows of that many keyframes."""
        return MapNetBatches(drives, drives.windows(length), shape, schedule, length)

    def __call__(self, step: int) -> MapNetBatch:
        rng = np.random.default_rng([self.schedule.seed, step])
        chosen = self.windows[rng.integers(len(self.windows), size=self.schedule.batch)]
        clips = [varied(self.drives.clip(drive, start, self.length), rng) for drive, start in chosen.tolist()]
        cells = np.stack([cells_of(clip.ground_m, self.shape.cell_m, self.shape.side) for clip in clips])
        poses = torch.from_numpy(np.stack([clip.poses for clip in clips]))
        given = step < GIVEN_UNTIL * self.schedule.steps
        pictures = torch.from_numpy(np.stack([clip.pictures for clip in clips]))
        return MapNetBatch(pictures, torch.from_numpy(cells), bins_of(poses, self.shape), given)


def roll(network: MapNet, batch: MapNetBatch) -> Tensor:
    """Logarithms of the pose fields of all keyframes but the first: (B, T - 1, R * H * W)."""
    sequences, steps = batch.cells.shape[:2]
    observations = network.observe(batch.pictures.flatten(0, 1), batch.cells.flatten(0, 1))
    turned = turn(observations, network.shape.headings)
    turned = turned.view(sequences, steps, *turned.shape[1:])  # (B, T, R, C, h, h)
    fields = [_roll_one(network, turned[i], batch.bins[i], batch.given) for i in range(sequences)]
    return torch.stack(fields)  # sequence by sequence: convolutions with kernels of their own gain nothing from a batch


def _roll_one(network: MapNet, turned: Tensor, bins: Tensor, given: bool) -> Tensor:
    """The keyframes of one sequence, turned (T, R, C, h, h), with true bins (T,) -> (T - 1, R * H * W)."""
    side, places = network.shape.map_side, bins.tolist()
    state = network.remember(place_at(turned[0], places[0], side), *network.blank())
    found = [network.look(turned[1], state[0])]
    for now in range(1, len(turned) - 1):
        placed = place_at(turned[now], places[now], side) if given else place(turned[now], found[-1].exp())
        state = network.remember(placed, *state)
        found.append(network.look(turned[now + 1], state[0]))
    return torch.stack(found).flatten(1)


def field_loss(network: nn.Module, batch: MapNetBatch) -> tuple[Tensor, Mapping[str, float]]:
    """Cross-entropy on the true bins; beside it how far the best bin is from the true one."""
    mapnet = as_mapnet(network)
    batch = batch.to(mapnet.log_sharpness.device)
    fields, bins = roll(mapnet, batch).flatten(0, 1), batch.bins[:, 1:].flatten()
    on_map = (bins >= 0).sum().clamp(min=1)
    value = F.nll_loss(fields, bins, ignore_index=-1, reduction="sum") / on_map
    off_m, off_deg = misses(fields.detach(), bins, mapnet.shape)
    return value, {"off_m": off_m, "off_deg": off_deg}


def misses(fields: Tensor, bins: Tensor, shape: MapNetShape) -> tuple[float, float]:
    """Mean distance and mean absolute angle between best bins (of fields (N, bins)) and true bins (N,)."""
    known = bins >= 0
    apart = poses_of(fields.argmax(1), shape)[known] - poses_of(bins, shape)[known]
    turned = torch.remainder(apart[:, 2] + math.pi, math.tau) - math.pi
    count = max(1, len(apart))
    return float(apart[:, :2].norm(dim=1).sum()) / count, math.degrees(float(turned.abs().sum())) / count


def as_mapnet(network: nn.Module) -> MapNet:
    """The network, known to be one of ours."""
    if not isinstance(network, MapNet):
        raise TypeError("not a MapNet of ours")
    return network


def new_mapnet(shape: MapNetShape, seed: int) -> MapNet:
    """A network as initialised from a seed."""
    torch.manual_seed(seed)
    return MapNet(shape)


def train_mapnet(
    drives: PictureDrives,
    out: Path,
    *,
    schedule: Schedule = USUAL,
    shape: MapNetShape | None = None,
    length: int = LENGTH,
    device: str = "cpu",
    watch: Callable[[Progress], None] | None = None,
) -> Path:
    """Train a MapNet on small maps and export it as `mapnet.onnx`. A run that was killed goes on where it was.

    Args:
        drives: what to learn from.
        out: folder of the run.
        schedule: how long and how fast; `batch` counts sequences.
        shape: sizes of the network that is exported; in training the map is `TRAINING_MAP_SIDE` cells wide at most.
        length: keyframes of a sequence.
        device: cpu or cuda. Threads are those of torch (`torch.set_num_threads`).
        watch: hears of the progress.

    Raises:
        SemslamError: no sequence of that length, or the folder holds another run.
    """
    sizes = shape or MapNetShape()
    small = replace(sizes, map_side=min(sizes.map_side, TRAINING_MAP_SIDE))
    network = new_mapnet(small, schedule.seed).to(device)
    batches = MapNetBatches.of(drives, small, schedule, length)
    facts = {"task": "mapnet", "data": drives.digest, "length": length, **asdict(small)}
    trained = fit(network, field_loss, batches, schedule, out, facts=facts, watch=watch)
    export_mapnet(as_mapnet(trained), out / MAPNET, sizes)
    return out / MAPNET


def export_mapnet(network: MapNet, path: Path, shape: MapNetShape | None = None) -> None:
    """Write one step as ONNX: extractor, matching and memory in a single graph.

    Args:
        network: what to export.
        path: file to write.
        shape: of a map of another side or with other headings; None takes the network's own.
    """
    shape = shape or network.shape
    whole = MapNet(shape)
    whole.load_state_dict(network.state_dict())
    step = MapNetStep(whole).eval()
    grid = (shape.headings, shape.map_side, shape.map_side)
    state = (1, shape.channels, shape.map_side, shape.map_side)
    cells = torch.zeros(1, PARTS, dtype=torch.int64)
    grids = ("cell_m", "side", "headings", "map_side")
    export_onnx(
        step,
        # two tensors for two states: of one tensor given twice the exporter makes one input
        (torch.zeros(1, 3, HEIGHT, WIDTH), cells, torch.zeros(grid), torch.zeros(state), torch.zeros(state)),
        path,
        input_names=["picture", "cells", "given", "hidden", "cell"],
        output_names=["field", "new_hidden", "new_cell"],
        metadata={
            "task": "mapnet",
            **{name: str(getattr(shape, name)) for name in grids},
            "input": "rgb 0..1, flat cell of each part, known pose field or zeros, map",
            "license": "Apache-2.0",
        },
    )
