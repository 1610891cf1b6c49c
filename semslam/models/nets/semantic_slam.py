"""SemanticSLAM in torch, one function per equation in the paper's order, for N drives at once.

    N drives, R headings, H rows, W columns (a square map), h side of the observation, L classes (the reserved first)

    o_t    observation            (N, L, h, h)     camera at the centre cell, looking along +x
    o'_t   rotated observations   (N, R, L, h, h)  heading r is 2 pi r / R
    o~_t   placed observation     (N, L, h, h)     on the cells of the region of interest
    v, p   pose fields            (N, R, H, W)     sum to 1
    poses                         (N, 3)           x, y in metres, heading in radians; float64
    bins                          (N, 3)           r, iy, ix of a pose

`semslam/slam/paper.py` says the same in numpy for one drive at run time; a test holds the two together. What is learned
is equation 8 alone: `MapUpdate`, which works on the region of interest and a one-cell halo. Equal to working on the
whole map and masking (a test), and as fast in a map of any size.

A map is kept as raw hidden and cell state, flat, with one more cell at its end: all places off the map, always zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from torch import Tensor, nn

from semslam.labels import FIRST_OBJECT, UNOBSERVED

START = 0.9
"""Hidden state of a cell that nothing updated yet: this for *unobserved*, minus this for all other classes."""
_NOISE, _WHOLE, _OBJECT = 0.3, 4.0, 12.0
"""Share of the usual random weights, and how strongly floor or obstacles and objects are written down at first: an
object's weights are shares of its pixels, most of them below 0.3."""
_KAPPA = 5.0
"""Steepness of the read-out before training: an untouched cell is *unobserved* with 99.8 %."""


@dataclass(frozen=True)
class Grid:
    """The bins of pose space: a square map of odd side about the map frame's origin, and equal headings from 0."""

    headings: int
    side: int
    cell_m: float

    def bins(self, poses: Tensor) -> Tensor:
        """(N, 3) poses -> (N, 3) r, iy, ix; rows and columns of poses off the map lie outside 0..side-1."""
        heading = (poses[:, 2] * (self.headings / math.tau)).round().remainder(self.headings)
        cells = ((poses[:, :2] + 0.5 * self.side * self.cell_m) / self.cell_m).floor()
        return torch.stack([heading, cells[:, 1], cells[:, 0]], 1).long()

    def poses(self, bins: Tensor) -> Tensor:
        """(N, 3) bins -> (N, 3) the poses at their middles."""
        middle = (bins.double() + 0.5 - 0.5 * self.side) * self.cell_m
        return torch.stack([middle[:, 2], middle[:, 1], wrap(self.angles(bins))], 1)

    def angles(self, bins: Tensor) -> Tensor:
        """(N,) heading at the middle of each bin, 0 to 2 pi."""
        return bins[:, 0].double() * (math.tau / self.headings)


@dataclass(frozen=True)
class Matching:
    """How poses are found: equations 2 and 4."""

    temperature: float = 1.0
    gate_distance_m: float = 0.3
    gate_heading_rad: float = 0.1
    gate: str = "all"


@dataclass(frozen=True)
class MapState:
    """What N maps remember."""

    hidden: Tensor
    """(N, L, H * W + 1)"""
    cell: Tensor
    """(N, L, H * W + 1)"""

    def detached(self) -> MapState:
        """The same state, from which no gradient flows back."""
        return MapState(self.hidden.detach(), self.cell.detach())


def wrap(angles_rad: Tensor) -> Tensor:
    """The same directions within half a turn of 0."""
    return angles_rad - math.tau * (angles_rad / math.tau).round()


def rotate_observation(planes: Tensor, headings: int) -> Tensor:
    """Section III-B: the observations as seen along the map's axes, bilinear, zero padded.

    (N, L, h, h) -> (N, R, L, h, h)
    """
    drives, _, side, _ = planes.shape
    corners, shares = (table.repeat(drives, 1, 1) for table in _all_rotations(headings, side))
    return _resampled(planes.repeat_interleave(headings, 0), corners, shares).unflatten(0, (drives, headings))


def rotate_by(planes: Tensor, angles_rad: Tensor) -> Tensor:
    """Each observation rotated by an angle of its own: (N, L, h, h), (N,) -> (N, L, h, h)."""
    return _resampled(planes, *_rotations(angles_rad, planes.shape[-1]))


@lru_cache(maxsize=4)
def _all_rotations(headings: int, side: int) -> tuple[Tensor, Tensor]:
    return _rotations(math.tau * torch.arange(headings, dtype=torch.float64) / headings, side)


def _rotations(angles_rad: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """(N, 4, h * h) flat source cells (h * h means outside) and bilinear shares of the corners of every cell."""
    middle = side // 2
    axis = torch.arange(side, dtype=torch.float64, device=angles_rad.device) - middle
    y, x = axis.repeat_interleave(side), axis.repeat(side)
    cosine, sine = torch.cos(angles_rad.double())[:, None], torch.sin(angles_rad.double())[:, None]
    source_x, source_y = cosine * x + sine * y + middle, cosine * y - sine * x + middle
    left, low = source_x.floor(), source_y.floor()
    corners, shares = [], []
    for up, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = left + right, low + up
        inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
        corners.append(torch.where(inside, row * side + column, side * side).long())
        shares.append((1 - (source_x - column).abs()) * (1 - (source_y - row).abs()))
    return torch.stack(corners, 1), torch.stack(shares, 1).float()


def _resampled(planes: Tensor, corners: Tensor, shares: Tensor) -> Tensor:
    """(N, L, h, h) looked up at (N, 4, h * h) corners, which are blended with their shares."""
    classes = planes.shape[1]
    padded = F.pad(planes.flatten(2), (0, 1))  # (N, L, h * h + 1)
    index = corners.to(planes.device).flatten(1)[:, None].expand(-1, classes, -1)
    found = padded.gather(2, index).unflatten(2, (4, -1))  # (N, L, 4, h * h)
    return (found * shares.to(planes.device)[:, None]).sum(2).view_as(planes)


def correlate(rotated: Tensor, world: Tensor) -> Tensor:
    """Equation 2 before the softmax: how well each observation fits its map at every pose bin.

    Cross-correlation (no flip), zero padded, summed over object classes. (N, R, L, h, h), (N, L, H, W) -> (N, R, H, W)
    """
    reach = rotated.shape[-1] // 2
    scores = world.new_zeros(*rotated.shape[:2], *world.shape[2:])
    for drive, (kernels, planes) in enumerate(zip(rotated[:, :, FIRST_OBJECT:], world[:, FIRST_OBJECT:], strict=True)):
        present = kernels[0].flatten(1).any(1).nonzero()[:, 0]  # a view shows few of the classes
        if len(present):
            scores[drive] = F.conv2d(planes[None, present], kernels[:, present], padding=reach)[0]
    return scores


def visual_field(scores: Tensor, temperature: float) -> Tensor:
    """Equation 2: one softmax over all bins of a drive, (N, R, H, W) -> the same."""
    return torch.softmax(scores.flatten(1) / temperature, 1).view_as(scores)


def best_bins(scores: Tensor) -> Tensor:
    """(N, R, H, W) -> (N, 3) the bin of the highest score, v bar of equation 2; of equal ones the first."""
    _, headings, rows, columns = scores.shape
    first = scores.flatten(1).argmax(1)
    return torch.stack([first // (rows * columns) % headings, first // columns % rows, first % columns], 1)


def step_inertial(previous: Tensor, motion: Tensor) -> Tensor:
    """Equation 3: u bar = T(p bar, u), composition of planar poses (N, 3) in metres and radians."""
    cosine, sine = torch.cos(previous[:, 2]), torch.sin(previous[:, 2])
    x = previous[:, 0] + cosine * motion[:, 0] - sine * motion[:, 1]
    y = previous[:, 1] + sine * motion[:, 0] + cosine * motion[:, 1]
    return torch.stack([x, y, wrap(previous[:, 2] + motion[:, 2])], 1)


def cross_check(visual: Tensor, inertial: Tensor, matching: Matching) -> Tensor:
    """Equation 4: (N,) whether the visual poses are believed; gate `all` needs both differences small, `any` one."""
    difference = visual - inertial
    near = torch.hypot(difference[:, 0], difference[:, 1]) < matching.gate_distance_m
    aligned = wrap(difference[:, 2]).abs() < matching.gate_heading_rad
    return near | aligned if matching.gate == "any" else near & aligned


def pose_field(bins: Tensor, grid: Grid) -> Tensor:
    """Equation 5: E, the one-hot fields (N, R, H, W) of poses; all zero for those off the map."""
    field = torch.zeros(len(bins), grid.headings, grid.side, grid.side, device=bins.device)
    drive = _on_map(bins, grid.side).nonzero()[:, 0]
    heading, row, column = bins[drive].unbind(1)
    field[drive, heading, row, column] = 1.0
    return field


def place_observation(rotated: Tensor, field: Tensor, bins: Tensor) -> Tensor:
    """Equation 6: the observations on the map, weighted with the pose fields, at the cells about `bins`.

    Transposed convolution of p_t (N, R, H, W) with o'_t (N, R, L, h, h), summed over headings -> (N, L, h, h). Cells of
    the result that lie off the map hold what would be there.
    """
    side, map_side = rotated.shape[-1], field.shape[-1]
    cells = roi_cells(bins, 2 * (side // 2), map_side)  # whatever reaches the region of interest
    mass = _looked_up(F.pad(field.flatten(2), (0, 1)), cells)  # (N, R, 2h - 1, 2h - 1)
    kernels = rotated.flip(-2, -1).transpose(1, 2)  # (N, L, R, h, h)
    return torch.stack([F.conv2d(one[None], kernel)[0] for one, kernel in zip(mass, kernels, strict=True)])


def roi_mask(bins: Tensor, side: int, map_side: int) -> Tensor:
    """Equation 7: (N, H, W) where maps may change, floor(h / 2) cells either way about the pose."""
    mask = torch.zeros(len(bins), map_side * map_side + 1, dtype=torch.bool, device=bins.device)
    mask.scatter_(1, roi_cells(bins, side // 2, map_side).flatten(1), value=True)
    return mask[:, :-1].unflatten(1, (map_side, map_side))


def roi_cells(bins: Tensor, reach: int, map_side: int) -> Tensor:
    """(N, 2 reach + 1, 2 reach + 1) flat cells about the poses; `map_side`^2 for those off the map."""
    offsets = torch.arange(-reach, reach + 1, device=bins.device)
    rows, columns = (bins[:, axis, None] + offsets for axis in (1, 2))  # (N, 2 reach + 1)
    inside = _within(rows, map_side)[:, :, None] & _within(columns, map_side)[:, None, :]
    return torch.where(inside, rows[:, :, None] * map_side + columns[:, None, :], map_side * map_side)


def _within(cells: Tensor, side: int) -> Tensor:
    return (cells >= 0) & (cells < side)


def _on_map(bins: Tensor, side: int) -> Tensor:
    return _within(bins[:, 1], side) & _within(bins[:, 2], side)


def _looked_up(flat: Tensor, cells: Tensor) -> Tensor:
    """(N, C, H * W + 1) at (N, r, c) flat cells -> (N, C, r, c)."""
    index = cells.flatten(1)[:, None].expand(-1, flat.shape[1], -1)
    return flat.gather(2, index).unflatten(2, cells.shape[1:])


class MapUpdate(nn.Module):
    """Equation 8: the ConvLSTM of Shi et al. (2015), whose hidden state has one plane a class.

    Peepholes are one number a class, not one a cell, since no place of a map is special. A kernel of 1 makes it an LSTM
    a cell.
    """

    def __init__(self, classes: int, kernel: int = 3) -> None:
        super().__init__()
        self.classes, self.kernel = classes, kernel
        self.gates = nn.Conv2d(2 * classes, 4 * classes, kernel)
        self.peepholes = nn.Parameter(torch.zeros(3, classes, 1, 1))
        self.log_kappa = nn.Parameter(torch.tensor(math.log(_KAPPA)))
        with torch.no_grad():
            self._begin()

    def _begin(self) -> None:
        """Start out writing down what was placed: rare classes would otherwise take long to be noticed at all.

        A cell takes up each class that was placed on it, for it and against all others, and is kept where nothing was
        placed. Around this the weights are random, as usual but smaller.
        """
        strength = torch.full((self.classes,), _OBJECT)
        strength[:FIRST_OBJECT], strength[UNOBSERVED] = _WHOLE, 0.0
        middle = self.kernel // 2
        placed = self.gates.weight.mul_(_NOISE)[:, : self.classes, middle, middle]
        into, keep, candidate, _ = placed.split(self.classes)  # (L, L) each, views
        into += strength
        keep -= strength
        candidate += torch.diag(2 * strength) - strength
        into, keep, _, out = self.gates.bias.mul_(_NOISE).split(self.classes)
        into -= 3.0
        keep += 4.0
        out += 2.0

    @property
    def halo(self) -> int:
        """Cells about the region of interest that its update reads."""
        return self.kernel // 2

    def forward(self, placed: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """(N, L, r, c), hidden with its halo (N, L, r + 2, c + 2), (N, L, r, c) -> new hidden and cell (N, L, r, c)."""
        margin = (self.halo,) * 4
        seen = torch.cat([F.pad(placed, margin), hidden], 1)
        into, keep, candidate, out = self.gates(seen).split(self.classes, 1)
        from_into, from_keep, from_out = self.peepholes
        into, keep = torch.sigmoid(into + from_into * cell), torch.sigmoid(keep + from_keep * cell)
        new_cell = keep * cell + into * torch.tanh(candidate)
        return torch.sigmoid(out + from_out * new_cell) * torch.tanh(new_cell), new_cell

    def start(self, drives: int, map_side: int) -> MapState:
        """Maps that nobody has seen anything of: *unobserved* everywhere."""
        hidden, cell = (state.to(self.gates.weight.device)[None, :, None] for state in start_state(self.classes))
        shape = (drives, self.classes, map_side * map_side)
        return MapState(*(F.pad(state.expand(shape), (0, 1)) for state in (hidden, cell)))

    def logits(self, hidden: Tensor) -> Tensor:
        """Of the read-out m_t = softmax(kappa h_t) over the classes of a cell."""
        return torch.exp(self.log_kappa) * hidden


def start_state(classes: int) -> tuple[Tensor, Tensor]:
    """(L,) hidden and (L,) cell state of a cell that nothing updated yet; h = tanh(c), as behind an open gate."""
    hidden = torch.full((classes,), -START)
    hidden[UNOBSERVED] = START
    return hidden, torch.atanh(hidden)


def update_map(
    network: MapUpdate, placed: Tensor, state: MapState, bins: Tensor, map_side: int, active: Tensor | None = None
) -> MapState:
    """Equation 8 at the regions of interest (equation 7); all other cells stay as they are, bit for bit.

    Args:
        network: the update.
        placed: (N, L, h, h), equation 6 at the cells about `bins`.
        state: of the maps before.
        bins: (N, 3) where the regions of interest lie.
        map_side: cells along a side of the maps.
        active: (N,) whose maps change at all; None for all.
    """
    outside = map_side * map_side
    around = roi_cells(bins, placed.shape[-1] // 2 + network.halo, map_side)
    cells = around[:, network.halo : around.shape[1] - network.halo, network.halo : around.shape[2] - network.halo]
    inside = (cells < outside)[:, None]
    hidden, cell = network(placed * inside, _looked_up(state.hidden, around), _looked_up(state.cell, cells))
    if active is not None:
        inside = inside & active[:, None, None, None]
        cells = torch.where(active[:, None, None], cells, outside)
    index = cells.flatten(1)[:, None].expand(-1, network.classes, -1)
    return MapState(
        state.hidden.scatter(2, index, (hidden * inside).flatten(2)),
        state.cell.scatter(2, index, (cell * inside).flatten(2)),
    )


def map_loss(logits: Tensor, truth: Tensor, counted: Tensor) -> Tensor:
    """Equation 9: KL(truth || map), which for one-hot truth is the cross-entropy, as a mean over cells.

    (..., L, H, W) logits of the read-out, (..., H, W) true class ids, (..., H, W) cells that count -> (...); steps are
    averaged by the caller. 0 where no cell counts.
    """
    lost = -torch.log_softmax(logits, -3).gather(-3, truth.unsqueeze(-3)).squeeze(-3)
    return (lost * counted).sum((-2, -1)) / counted.sum((-2, -1)).clamp(min=1)


def localise(
    planes: Tensor, world: Tensor, previous: Tensor, motion: Tensor, grid: Grid, matching: Matching
) -> tuple[Tensor, Tensor]:
    """Equations 2 to 6, visual-inertial: (N, 3) poses and (N, L, h, h) the observations placed about them.

    An observation without an object in common with the map says nothing, and the inertial pose stands.
    """
    rotated = rotate_observation(planes, grid.headings)
    scores = correlate(rotated, world)
    inertial, visual = step_inertial(previous, motion), grid.poses(best_bins(scores))
    believed = cross_check(visual, inertial, matching) & (scores.flatten(1).amax(1) > 0)
    poses = torch.where(believed[:, None], visual, inertial)
    bins = grid.bins(poses)
    field = torch.where(
        believed[:, None, None, None], visual_field(scores, matching.temperature), pose_field(bins, grid)
    )
    return poses, place_observation(rotated, field, bins)
