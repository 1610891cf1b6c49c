"""Training and export of DeepVO (nets/deepvo.py): squared errors of the motions between keyframes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from semslam.models.nets.deepvo import DeepVo, DeepVoShape, pose_loss
from semslam.models.small_view import HEIGHT, WIDTH
from semslam.models.training.export import export_onnx
from semslam.models.training.sequences import PictureDrives, motions_of, varied
from semslam.models.training.trainer import Progress, Schedule, fit

DEEPVO = "deepvo.onnx"
LENGTH = 8
"""Keyframes of a training sequence, seven pairs; any number at run time."""
USUAL = Schedule(steps=2000, batch=12, peak_rate=1e-3, warm_up=100, average=0.995)
"""Sequences a step."""


@dataclass(frozen=True, eq=False)
class DeepVoBatch:
    """What a step learns from."""

    pairs: Tensor
    """(B, T, 6, HEIGHT, WIDTH) former and latter picture, 0 to 1."""
    motions: Tensor
    """(B, T, 3) true dx, dy in metres and dheading in radians, in the former's robot frame."""

    def to(self, device: torch.device) -> DeepVoBatch:
        """The batch on a device."""
        return DeepVoBatch(self.pairs.to(device), self.motions.to(device))


@dataclass(eq=False)
class DeepVoBatches:
    """Makes the batch of any step; a pure function of seed and step."""

    drives: PictureDrives
    windows: NDArray[np.int64]
    """(N, 2) drive and first keyframe."""
    schedule: Schedule
    length: int

    @staticmethod
    def of(drives: PictureDrives, schedule: Schedule, length: int = LENGTH) -> DeepVoBatches:
        """Batches of all windows of that many keyframes."""
        return DeepVoBatches(drives, drives.windows(length), schedule, length)

    def __call__(self, step: int) -> DeepVoBatch:
        rng = np.random.default_rng([self.schedule.seed, step])
        chosen = self.windows[rng.integers(len(self.windows), size=self.schedule.batch)]
        clips = [varied(self.drives.clip(drive, start, self.length), rng) for drive, start in chosen.tolist()]
        pairs = np.stack([np.concatenate([clip.pictures[:-1], clip.pictures[1:]], 1) for clip in clips])
        motions = np.stack([motions_of(clip.poses) for clip in clips]).astype(np.float32)
        return DeepVoBatch(torch.from_numpy(pairs), torch.from_numpy(motions))


def motion_loss(network: nn.Module, batch: DeepVoBatch) -> tuple[Tensor, Mapping[str, float]]:
    """The paper's loss; beside it the root mean square errors of translation and heading."""
    deepvo = as_deepvo(network)
    batch = batch.to(deepvo.motion.weight.device)
    value, translation, heading = pose_loss(deepvo.roll(batch.pairs), batch.motions)
    off_m, off_rad = (math.sqrt(float(part.detach())) for part in (translation, heading))
    return value, {"off_m": off_m, "off_deg": math.degrees(off_rad)}


def as_deepvo(network: nn.Module) -> DeepVo:
    """The network, known to be one of ours."""
    if not isinstance(network, DeepVo):
        raise TypeError("not a DeepVO of ours")
    return network


def new_deepvo(shape: DeepVoShape, seed: int) -> DeepVo:
    """A network as initialised from a seed."""
    torch.manual_seed(seed)
    return DeepVo(shape)


def train_deepvo(
    drives: PictureDrives,
    out: Path,
    *,
    schedule: Schedule = USUAL,
    shape: DeepVoShape | None = None,
    length: int = LENGTH,
    device: str = "cpu",
    watch: Callable[[Progress], None] | None = None,
) -> Path:
    """Train a DeepVO and export it as `deepvo.onnx`. A run that was killed goes on where it was.

    Args:
        drives: what to learn from.
        out: folder of the run.
        schedule: how long and how fast; `batch` counts sequences.
        shape: sizes of the network.
        length: keyframes of a sequence.
        device: cpu or cuda. Threads are those of torch (`torch.set_num_threads`).
        watch: hears of the progress.

    Raises:
        SemslamError: no sequence of that length, or the folder holds another run.
    """
    sizes = shape or DeepVoShape()
    network = new_deepvo(sizes, schedule.seed).to(device, memory_format=torch.channels_last)  # a third faster on CPUs
    batches = DeepVoBatches.of(drives, schedule, length)
    facts = {"task": "deepvo", "data": drives.digest, "length": length, **asdict(sizes)}
    trained = fit(network, motion_loss, batches, schedule, out, facts=facts, watch=watch)
    export_deepvo(as_deepvo(trained), out / DEEPVO)
    return out / DEEPVO


def export_deepvo(network: DeepVo, path: Path) -> None:
    """Write one step as ONNX."""
    state = (1, network.shape.memory)
    export_onnx(
        network.cpu().eval(),
        # two tensors for two states: of one tensor given twice the exporter makes one input
        (torch.zeros(1, 6, HEIGHT, WIDTH), torch.zeros(state), torch.zeros(state)),
        path,
        input_names=["pair", "hidden", "cell"],
        output_names=["motion", "new_hidden", "new_cell"],
        metadata={
            "task": "deepvo",
            "input": "former and latter picture, rgb 0..1, and memory",
            "output": "dx, dy in metres and dheading in radians, in the former robot frame",
            "license": "Apache-2.0",
        },
    )
