"""DeepVO after Wang et al. (ICRA 2017): motion from pairs of pictures, by a convolutional encoder and an LSTM.

Two pictures, one upon the other, make six channels; an encoder of strided convolutions describes what moved between
them, an LSTM carries on what came before, and a linear layer gives the motion (dx, dy, dheading) of the robot.
(The paper that we reproduce cites Mohanty et al. 2016 under this name, two picture streams without memory; Wang's is
the one that everybody calls DeepVO.) Theirs has two LSTMs of 1000 cells, sees large pictures and starts from FlowNet;
this one has one of 96, sees thumbnails and starts from nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from semslam.models.nets.detector import conv
from semslam.models.small_view import HEIGHT, WIDTH


@dataclass(frozen=True)
class DeepVoShape:
    """Sizes of the network."""

    channels: tuple[int, int, int, int, int] = (16, 32, 64, 96, 96)
    """Of the encoder at strides 2, 4, 8, 16 and 32."""
    memory: int = 96
    """Cells of the LSTM."""


class DeepVo(nn.Module):
    """Pairs (B, 6, y, x) in 0..1 and state (B, memory) twice -> motions (B, 3) in metres and radians, new state."""

    def __init__(self, shape: DeepVoShape) -> None:
        super().__init__()
        self.shape = shape
        self.encoder = encoder(shape.channels)
        parts = (WIDTH // 32) * (HEIGHT // 32)
        self.describe = nn.Sequential(nn.Linear(parts * shape.channels[-1], shape.memory), nn.SiLU())
        self.gates = nn.Linear(2 * shape.memory, 4 * shape.memory)
        self.motion = nn.Linear(shape.memory, 3)
        with torch.no_grad():
            self.gates.bias[shape.memory : 2 * shape.memory] = 1.0  # a memory starts by keeping (Jozefowicz 2015)

    def forward(self, pairs: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.recall(self.see(pairs), hidden, cell)

    def see(self, pairs: Tensor) -> Tensor:
        """What moved between the pictures of each pair: (B, 6, y, x) -> (B, memory)."""
        return self.describe(self.encoder(pairs * 2 - 1).flatten(1))

    def recall(self, seen: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of the LSTM: (B, memory) three times -> motion (B, 3), new hidden and cell state."""
        put, keep, show, new = self.gates(torch.cat([seen, hidden], 1)).chunk(4, 1)
        cell = keep.sigmoid() * cell + put.sigmoid() * new.tanh()
        hidden = show.sigmoid() * cell.tanh()
        return self.motion(hidden), hidden, cell

    def roll(self, pairs: Tensor) -> Tensor:
        """All motions of sequences of pairs (B, T, 6, y, x), from an empty memory -> (B, T, 3)."""
        batch, steps = pairs.shape[:2]
        seen = self.see(pairs.flatten(0, 1)).view(batch, steps, -1)
        hidden = cell = seen.new_zeros(batch, self.shape.memory)
        motions = []
        for step in range(steps):
            motion, hidden, cell = self.recall(seen[:, step], hidden, cell)
            motions.append(motion)
        return torch.stack(motions, 1)


def encoder(channels: tuple[int, ...]) -> nn.Sequential:
    """Strided convolutions, the first ones wide, as large motions need: (B, 6, y, x) -> (B, last, y / 32, x / 32)."""
    sizes = (7, 5, 3, 3, 3)
    inputs = (6, *channels[:-1])
    return nn.Sequential(*(conv(i, o, s, stride=2) for i, o, s in zip(inputs, channels, sizes, strict=True)))


def pose_loss(found: Tensor, true: Tensor, heading_weight: float = 100.0) -> tuple[Tensor, Tensor, Tensor]:
    """Squared errors of motions (..., 3): translation + weight * heading; then both parts by themselves.

    Sums over coordinates, means over steps, as the paper has it (kappa = 100).
    """
    squares = (found - true) ** 2
    translation, heading = squares[..., :2].sum(-1).mean(), squares[..., 2].mean()
    return translation + heading_weight * heading, translation, heading
