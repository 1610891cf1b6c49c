"""The paper on one page: equations 2 to 7 and 10 as pure functions, in the paper's order.

    R headings, H rows, W columns, h side of the observation, L classes (the reserved ones first)

    o_t    observation           (L, h, h)     camera at the centre cell, looking along +x
    o'_t   rotated observations  (R, L, h, h)  heading r is 2 pi r / R
    m_t    map                   (L, H, W)
    v, p   pose fields           (R, H, W)     sum to 1

The two big sums (equations 2 and 6) are matrix products of whole numbers: weights are rounded to `WEIGHT_BITS` binary
places, probabilities to `FIELD_BITS`, which keeps every partial sum below 2^53, where float64 is exact. A matrix
library may then add in any order, with any number of threads, on any processor: the result is the same to the last
bit. (The same products in float32 differ between one and two threads.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, wrap_angle, wrap_angles
from semslam.geometry.grid import Planes
from semslam.labels import FIRST_OBJECT, UNOBSERVED
from semslam.slam.estimator import Mode

Field = NDArray[np.float32]
"""(R, H, W) probabilities of pose bins."""
Scores = NDArray[np.float64]
"""(R, H, W) correlations."""
Bin = tuple[int, int, int]
"""(r, iy, ix) of a pose bin."""

WEIGHT_BITS = 20
"""Binary places of observation and map weights, rounding error 5e-7."""
PATCH_BYTES = 64 << 20
"""Neighbourhoods gathered at once for equation 2: memory stays bounded for maps of any size."""
FIELD_BITS = 32
"""Binary places of probabilities in equation 6. Rounding moves no placed weight by more than R H W / 2^33, that is
5e-5 for 360 x 33 x 33 bins; headings and cells without any probability left are skipped."""


@dataclass(frozen=True)
class PoseGrid:
    """The bins of pose space: a square map of odd side about the map frame's origin, and equal headings from 0."""

    headings: int
    side: int
    cell_m: float

    @property
    def origin_m(self) -> float:
        """Map frame x, and y, of the lower corner of cell 0."""
        return -0.5 * self.side * self.cell_m

    def bin_of(self, pose: SE2) -> Bin:
        """The bin that holds the pose; its row or column lies outside 0..side-1 if the pose is off the map."""
        heading = round(pose.heading_rad * self.headings / math.tau) % self.headings
        row, column = (math.floor((v - self.origin_m) / self.cell_m) for v in (pose.y_m, pose.x_m))
        return heading, row, column

    def pose_of(self, place: Bin) -> SE2:
        """The pose at the middle of a bin."""
        heading, row, column = place
        x, y = (self.origin_m + (cell + 0.5) * self.cell_m for cell in (column, row))
        return SE2(x, y, wrap_angle(math.tau * heading / self.headings))

    def holds(self, place: Bin) -> bool:
        """Whether the bin lies on the map."""
        return 0 <= place[1] < self.side and 0 <= place[2] < self.side


def rotate_observation(planes: Planes, headings: int) -> Planes:
    """Section III-B: the observation as seen along the map's axes for headings 2 pi r / R, bilinear, zero padded.

    (L, h, h) -> (R, L, h, h), a view of memory that holds one class after the other. Heading 0 is the observation.
    """
    classes, side, _ = planes.shape
    corners, shares = _sampling(headings, side)  # (4, R, h * h) each
    rotated = np.zeros((classes, headings, side * side), np.float32)
    for index in np.flatnonzero(planes.any((1, 2))):
        padded = np.append(planes[index], np.float32(0.0))
        rotated[index] = (padded[corners] * shares).sum(0)
    return rotated.reshape(classes, headings, side, side).swapaxes(0, 1)


@lru_cache(maxsize=4)
def _sampling(headings: int, side: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Flat source cells (h * h means outside) and bilinear shares of the four corners of every rotated cell."""
    middle = side // 2
    angles = math.tau * np.arange(headings)[:, None] / headings
    y, x = (axis.ravel() - middle for axis in np.mgrid[:side, :side])
    source_x = np.cos(angles) * x + np.sin(angles) * y + middle  # robot_from_map, heading undone
    source_y = np.cos(angles) * y - np.sin(angles) * x + middle
    left, low = np.floor(source_x), np.floor(source_y)
    right_share, high_share = source_x - left, source_y - low
    corners, shares = [], []
    for up, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = (left + right).astype(np.int32), (low + up).astype(np.int32)
        inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
        corners.append(np.where(inside, row * side + column, side * side).astype(np.int32))
        share = (right_share if right else 1 - right_share) * (high_share if up else 1 - high_share)
        shares.append(share.astype(np.float32))
    return np.stack(corners), np.stack(shares)


def correlate(rotated: Planes, world: Planes) -> Scores:
    """Equation 2 before the softmax: how well the observation fits the map at every pose bin.

    Cross-correlation (no flip), zero padded, summed over object classes; classes missing from either side add nothing
    and are skipped. (R, L, h, h), (L, H, W) -> (R, H, W).
    """
    (headings, _, side, _), (_, rows, columns) = rotated.shape, world.shape
    shared = [i for i in range(FIRST_OBJECT, len(world)) if rotated[0, i].any() and world[i].any()]
    bits = _weight_bits(len(shared) * side * side)
    scores = np.zeros((headings, rows * columns), np.float64)
    for class_id in shared:
        kernel = _whole(rotated[:, class_id].reshape(headings, -1), bits)  # (R, h * h)
        for cells, bins, patches in _patches(_whole(world[class_id], bits), side, np.flatnonzero(kernel.any(0))):
            scores[:, bins] += kernel[:, cells] @ patches
    return (scores * 0.25**bits).reshape(headings, rows, columns)


def _weight_bits(terms: int) -> int:
    """Binary places that keep a sum of `terms` products of two weights up to 1 below 2^53."""
    return min(WEIGHT_BITS, (53 - max(1, terms).bit_length()) // 2)


def _whole(values: NDArray[np.float32], bits: int) -> NDArray[np.float64]:
    """Values in units of 2^-bits, rounded to whole numbers."""
    return np.rint(values * np.float64(2**bits))


_Patches = tuple[NDArray[np.int64], slice, NDArray[np.float64]]


def _patches(plane: NDArray[np.float64], side: int, used: NDArray[np.int64]) -> Iterator[_Patches]:
    """The neighbourhood of every cell (H, W), zero beyond the border, in pieces of at most `PATCH_BYTES`.

    Yields K of the `used` of its h * h cells, the map's cells as a slice of H * W, and the values there (K, cells).
    Neighbours that are zero everywhere are left out. A single row of the map is the smallest piece.
    """
    windows = sliding_window_view(np.pad(plane, side // 2), plane.shape)  # (h, h, H, W)
    rows, columns = plane.shape
    at_once = max(1, PATCH_BYTES // (8 * columns))  # rows of the map, of whatever neighbours
    height = min(rows, max(1, at_once // max(1, used.size)))
    for top in range(0, rows, height):
        bottom = min(rows, top + height)
        for first in range(0, used.size, max(1, at_once // height)):
            cells = used[first : first + max(1, at_once // height)]
            values = windows[cells // side, cells % side, top:bottom].reshape(cells.size, -1)
            present = values.any(1)
            yield cells[present], slice(top * columns, bottom * columns), values[present]


def visual_field(scores: Scores, temperature: float) -> tuple[Field, float]:
    """Equation 2: one softmax over all R H W bins; also the field's entropy in nats."""
    raised = ((scores - scores.max()) / temperature).astype(np.float32)
    weights = np.exp(raised)
    total = float(weights.sum(dtype=np.float64))
    entropy = math.log(total) - float((weights * raised).sum(dtype=np.float64)) / total
    return weights / np.float32(total), max(0.0, entropy)


def best_bin(scores: Scores, near: SE2, grid: PoseGrid) -> Bin:
    """The bin of the highest score (v bar of equation 2). Equal scores: the one nearest to `near`, heading second."""
    tied = np.flatnonzero(scores == scores.max())
    heading, row, column = np.unravel_index(tied, scores.shape)
    near_heading, near_row, near_column = grid.bin_of(near)
    distance = (row - near_row) ** 2 + (column - near_column) ** 2
    turn = np.abs(wrap_angles(math.tau * (heading - near_heading) / grid.headings))
    first = np.lexsort((turn, distance))[0]
    return int(heading[first]), int(row[first]), int(column[first])


def field_modes(field: Field, first: Bin, grid: PoseGrid, count: int) -> tuple[Mode, ...]:
    """The best `count` bins, each more than two cells or ten degrees away from all better ones; `first` leads.

    Bins at the field's lowest value are no modes: a flat field has none.
    """
    lowest = float(field.min())
    left = field.copy()
    modes: list[Mode] = []
    place = first
    while len(modes) < count and left[place] > lowest:
        modes.append(Mode(grid.pose_of(place), float(field[place])))
        _suppress(left, place)
        heading, row, column = np.unravel_index(int(left.argmax()), left.shape)
        place = (int(heading), int(row), int(column))
    return tuple(modes)


def _suppress(field: Field, place: Bin) -> None:
    """Set the neighbourhood of a bin to -1: two cells either way, ten degrees either way round the circle."""
    headings = field.shape[0]
    reach = math.ceil(headings / 36)
    turns = np.unique(np.arange(place[0] - reach, place[0] + reach + 1) % headings)
    rows, columns = (slice(max(0, cell - 2), cell + 3) for cell in place[1:])
    field[turns, rows, columns] = -1.0


def step_inertial(previous: SE2, motion: SE2) -> SE2:
    """Equation 3: u bar = T(p bar, u), composition of planar poses in metres and radians, not in bins."""
    return previous @ motion


def cross_check(visual: SE2, inertial: SE2, gate_distance_m: float, gate_heading_rad: float, gate: str) -> bool:
    """Equation 4: whether the visual pose is believed. `all` needs both differences below their gates, `any` one."""
    near = math.hypot(visual.x_m - inertial.x_m, visual.y_m - inertial.y_m) < gate_distance_m
    aligned = abs(wrap_angle(visual.heading_rad - inertial.heading_rad)) < gate_heading_rad
    return (near or aligned) if gate == "any" else (near and aligned)


def pose_field(pose: SE2, grid: PoseGrid) -> Field:
    """Equation 5: E, the one-hot field of a pose; all zero for a pose off the map."""
    field = np.zeros((grid.headings, grid.side, grid.side), np.float32)
    place = grid.bin_of(pose)
    if grid.holds(place):
        field[place] = 1.0
    return field


Window = tuple[slice, slice]
"""Rows and columns of a part of the map."""


def roi_mask(pose: SE2, grid: PoseGrid, side: int) -> Window:
    """Equation 7: where the map may change, floor(h / 2) cells either way about the pose, clipped at the border."""
    _, row, column = grid.bin_of(pose)
    reach = side // 2
    rows, columns = (
        slice(min(max(0, cell - reach), grid.side), min(max(0, cell + reach + 1), grid.side)) for cell in (row, column)
    )
    return rows, columns


def place_observation(rotated: Planes, field: Field, window: Window) -> Planes:
    """Equation 6: the observation on the map, weighted with the pose field, inside a window of the map.

    Transposed convolution of p_t (R, H, W) with o'_t (R, L, h, h), summed over headings -> (L, rows, columns) of the
    window. Row i of the kernels reaches window row y from pose row y - (i - h // 2).
    """
    side, present = rotated.shape[2], np.flatnonzero(rotated[0].any((1, 2)))
    rows, columns = (w.stop - w.start for w in window)
    mass = _whole(_around(field, window, side // 2), FIELD_BITS)  # (R, rows + h - 1, columns + h - 1)
    turns = np.flatnonzero(mass.any((1, 2)))
    result = np.zeros((rotated.shape[1], rows, columns), np.float32)
    if not turns.size or not result.size:
        return result
    mass, kernels = mass[turns], _whole(rotated[np.ix_(turns, present)], WEIGHT_BITS)
    placed = np.zeros((len(present), rows, columns), np.float64)
    for i in range(side):
        pieces = _sum_headings(kernels[:, :, i], mass[:, side - 1 - i : side - 1 - i + rows])
        for j in range(side):
            placed += pieces[:, j, :, side - 1 - j : side - 1 - j + columns]
    result[present] = placed * 0.5 ** (WEIGHT_BITS + FIELD_BITS)
    return result


def _around(field: Field, window: Window, reach: int) -> Field:
    """The field in the window and `reach` cells beyond it; zero off the map."""
    rows, columns = window
    padded = np.pad(field, ((0, 0), (reach, reach), (reach, reach)))
    return padded[:, rows.start : rows.stop + 2 * reach, columns.start : columns.stop + 2 * reach]


def _sum_headings(kernels: NDArray[np.float64], mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """Kernel rows (R, K, h) times masses (R, rows, columns), summed over headings -> (K, h, rows, columns)."""
    headings, spread = len(mass), mass.reshape(len(mass), -1)
    cells = np.flatnonzero(spread.any(0))
    pieces = np.zeros((kernels[0].size, spread.shape[1]), np.float64)
    pieces[:, cells] = kernels.reshape(headings, -1).T @ spread[:, cells]
    return pieces.reshape(*kernels.shape[1:], *mass.shape[1:])


def update_map(world: Planes, placed: Planes, window: Window, leak: float) -> Planes:
    """Equation 10, the leaky average, inside the window; all other cells stay as they are, bit for bit.

    A cell is averaged, all its classes together, if anything but *unobserved* was placed in it (o~(x, y) > 0).
    """
    updated = world.copy()
    part = updated[:, window[0], window[1]]  # (L, rows, columns), a view
    seen = np.delete(placed, UNOBSERVED, axis=0).any(0)
    part[:, seen] = np.float32(1.0 - leak) * part[:, seen] + np.float32(leak) * placed[:, seen]
    return updated
