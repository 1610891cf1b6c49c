"""MapNet (Henriques and Vedaldi, CVPR 2018): a map of image features, found again by matching and written by an LSTM.

    R headings, H rows, W columns, h side of the observation, C channels

    x_t    features of the picture   (C, parts)      a small convolutional network
    o_t    observation               (C, h, h)       their maximum a cell, by depth; zero where nothing fell
    o'_t   turned observations       (R, C, h, h)    heading r is 2 pi r / R
    p_t    pose field                (R, H, W)       softmax of the correlation of o'_t with the map
    m_t    map                       (C, H, W)       hidden state of one LSTM for all cells, fed with o'_t placed by p_t

One function an operation, in the order of a step. What is ours and not theirs: sizes (a 21-cell window of 0.3 m, 36
headings unless told otherwise) and a learned sharpness in the softmax. Grids lie as everywhere in semslam: [iy, ix],
the robot in the centre cell, looking along +x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from torch import Tensor, nn

from semslam.models.nets.detector import conv

_NOTHING = -1e4
"""Below every feature."""


@dataclass(frozen=True)
class MapNetShape:
    """Sizes of the network and of its grids. No weight depends on a grid, so `headings` and `map_side` may change
    between training and export; `side` and `cell_m` shape what the features mean."""

    channels: int = 16
    """Of features and map. C."""
    width: int = 32
    """Channels within the extractor."""
    cell_m: float = 0.3
    """Cell of map and observation, metres."""
    side: int = 21
    """Cells along a side of the observation, odd: 3.15 m ahead. h."""
    headings: int = 36
    """Heading bins; training at 36 is what two processor cores can do. R."""
    map_side: int = 33
    """Cells along a side of the map, odd. H = W."""


class MapNet(nn.Module):
    """The weights: extractor, memory, sharpness. `step` is one keyframe; training and export both go through it."""

    def __init__(self, shape: MapNetShape) -> None:
        super().__init__()
        self.shape = shape
        self.extract = extractor(shape.width, shape.channels)
        self.gates = nn.Conv2d(2 * shape.channels, 4 * shape.channels, 1)
        with torch.no_grad():
            # A map starts by keeping: a cell seen once loses a twentieth a keyframe, in place of half.
            self.gates.bias[shape.channels : 2 * shape.channels] = 3.0
        self.log_sharpness = nn.Parameter(torch.tensor(-2.0))  # of a field that is nearly flat to begin with

    def observe(self, pictures: Tensor, cells: Tensor) -> Tensor:
        """Thumbnails (B, 3, y, x) in 0..1 and the flat cell of each of their parts (B, N) -> (B, C, h, h)."""
        return project(self.extract(pictures * 2 - 1).flatten(2), cells, self.shape.side)

    def look(self, turned: Tensor, hidden: Tensor) -> Tensor:
        """(R, C, h, h) and the map (C, H, W) -> logarithm of the pose field (R, H, W)."""
        scores = correlate(turned, hidden) * self.log_sharpness.exp()
        return scores.flatten().log_softmax(0).view_as(scores)

    def remember(self, placed: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """The LSTM of every cell: input, hidden and cell state, each (C, H, W) -> new hidden and cell state."""
        gates = self.gates(torch.cat([placed, hidden])[None])[0]
        put, keep, show, new = gates.chunk(4)
        cell = keep.sigmoid() * cell + put.sigmoid() * new.tanh()
        return show.sigmoid() * cell.tanh(), cell

    def blank(self) -> tuple[Tensor, Tensor]:
        """Hidden and cell state of an empty map."""
        shape = (self.shape.channels, self.shape.map_side, self.shape.map_side)
        return self.log_sharpness.new_zeros(shape), self.log_sharpness.new_zeros(shape)


class MapNetStep(nn.Module):
    """One keyframe as it is exported, with a batch axis of 1 on everything but the given field.

    `given` (R, H, W) is the pose field if the pose is known, as at the start, and zero everywhere to look for it.
    """

    def __init__(self, network: MapNet) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, picture: Tensor, cells: Tensor, given: Tensor, hidden: Tensor, cell: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        observation = self.network.observe(picture, cells)
        turned = turn(observation, self.network.shape.headings)[0]  # (R, C, h, h)
        found = self.network.look(turned, hidden[0]).exp()
        field = given + (1 - given.sum()) * found
        new_hidden, new_cell = self.network.remember(place(turned, field), hidden[0], cell[0])
        return field, new_hidden[None], new_cell[None]


def extractor(width: int, channels: int) -> nn.Sequential:
    """(B, 3, y, x) -> (B, channels, y / 4, x / 4); each feature sees 65 x 65 pixels of the thumbnail."""
    blocks = [Context(width, dilation) for dilation in (1, 2, 4)]
    first, second = conv(3, width // 2, 5, stride=2), conv(width // 2, width, stride=2)
    return nn.Sequential(first, second, *blocks, nn.Conv2d(width, channels, 1))


class Context(nn.Module):
    """x + a convolution that reaches `dilation` parts far."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation, bias=False),
            nn.BatchNorm2d(channels),
            nn.SiLU(inplace=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


def project(features: Tensor, cells: Tensor, side: int) -> Tensor:
    """The ground projection: the maximum, channel by channel, of the features that fall into a cell; else zero.

    Features (B, C, N), cells (B, N) with side * side for those that fall nowhere -> (B, C, h, h).
    """
    batch, channels, _ = features.shape
    empty = features.new_full((batch, channels, side * side + 1), _NOTHING)
    index = cells[:, None].expand(-1, channels, -1)
    highest = empty.scatter_reduce(2, index, features, "amax", include_self=True)[..., :-1]
    return torch.where(highest > _NOTHING / 2, highest, 0.0).view(batch, channels, side, side)


def turn(observations: Tensor, headings: int) -> Tensor:
    """The observation as seen along the map's axes for headings 2 pi r / R, bilinear, zero padded.

    (B, C, h, h) -> (B, R, C, h, h). All of a batch turn as channels of one picture.
    """
    batch, channels, side, _ = observations.shape
    quarters = 4 if headings % 4 == 0 else 1  # quarter turns only move cells: a fourth of the sampling, or all of it
    sampled = _turned_cells(headings, headings // quarters, side, observations)
    pictures = observations.view(1, batch * channels, side, side).expand(len(sampled), -1, -1, -1)
    part = F.grid_sample(pictures, sampled, align_corners=True)
    turned = torch.cat([part.rot90(quarter, (3, 2)) for quarter in range(quarters)])
    return turned.view(headings, batch, channels, side, side).transpose(0, 1)


def _turned_cells(headings: int, first: int, side: int, like: Tensor) -> Tensor:
    """Where each cell of an observation at the first of R headings comes from, in units of half its side:
    (first, h, h, 2), x and y."""
    angle = torch.arange(first, dtype=like.dtype, device=like.device).mul(math.tau / headings)[:, None, None]
    offset = torch.linspace(-1, 1, side, dtype=like.dtype, device=like.device)
    x, y = offset[None, None, :], offset[None, :, None]
    cosine, sine = angle.cos(), angle.sin()
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x], -1)


def correlate(turned: Tensor, world: Tensor) -> Tensor:
    """How well each turned observation fits at each cell: (R, C, h, h), (C, H, W) -> (R, H, W), zero padded."""
    return F.conv2d(world[None], turned, padding=turned.shape[-1] // 2)[0]


def place(turned: Tensor, field: Tensor) -> Tensor:
    """The observation on the map, weighted with a pose field: (R, C, h, h), (R, H, W) -> (C, H, W).

    The transpose of `correlate`.
    """
    return F.conv_transpose2d(field[None], turned, padding=turned.shape[-1] // 2)[0]


def place_at(turned: Tensor, place_bin: int, map_side: int) -> Tensor:
    """`place` with the field that is one at a flat bin, and nowhere if that is -1, without its sums."""
    _, channels, side, _ = turned.shape
    if place_bin < 0:
        return turned.new_zeros(channels, map_side, map_side)
    heading, cell = divmod(place_bin, map_side**2)
    row, column = divmod(cell, map_side)
    before, after = (row - side // 2, column - side // 2), (row + side // 2 + 1, column + side // 2 + 1)
    margins = before[1], map_side - after[1], before[0], map_side - after[0]
    return F.pad(turned[heading], margins)  # negative margins cut


def bins_of(poses: Tensor, shape: MapNetShape) -> Tensor:
    """Flat bin (r * H + iy) * W + ix of poses (..., 3), x, y, heading in the map frame; -1 off the map."""
    heading = torch.round(poses[..., 2] * shape.headings / math.tau).long() % shape.headings
    column, row = (torch.floor(poses[..., axis] / shape.cell_m + shape.map_side / 2).long() for axis in (0, 1))
    inside = (column >= 0) & (column < shape.map_side) & (row >= 0) & (row < shape.map_side)
    return torch.where(inside, (heading * shape.map_side + row) * shape.map_side + column, -1)


def poses_of(bins: Tensor, shape: MapNetShape) -> Tensor:
    """The poses (..., 3) in the middle of flat bins."""
    heading, cell = bins // shape.map_side**2, bins % shape.map_side**2
    offset = (shape.map_side - 1) / 2
    x = (cell % shape.map_side - offset) * shape.cell_m
    y = (cell // shape.map_side - offset) * shape.cell_m
    return torch.stack([x, y, heading * (math.tau / shape.headings)], -1)
