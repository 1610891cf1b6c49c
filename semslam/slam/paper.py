"""The paper on one page: equations 2 to 7 and 10 as pure functions, in the paper's order.

    R headings, H rows, W columns, h side of the observation, L classes (the reserved ones first)

    o_t    observation           (L, h, h)     camera at the centre cell, looking along +x
    o'_t   rotated observations  (R, L, h, h)  heading r is 2 pi r / R
    m_t    map                   (L, H, W)
    v, p   pose fields           (R, H, W)     sum to 1

The two big sums (equations 2 and 6) are matrix products. Scores (2) are summed in float32, which is fast but not exact:
the last bits depend on the processor, though on no number of threads (models/product.py). Scores are therefore rounded
to steps well above those bits, and `best_bin` takes scores within a step for equal, so that no rounding chooses between
poses that fit equally well. What is placed (6) must be exactly zero where nothing was seen: whole numbers, weights in
units of 2^-`PLACED_BITS` and probabilities of 2^-`FIELD_BITS`, keep every partial sum within 2^53, where float64 is
exact in any order of adding.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from semslam.geometry.frames import SE2, wrap_angle, wrap_angles
from semslam.geometry.grid import Planes
from semslam.labels import FIRST_OBJECT, UNOBSERVED
from semslam.models.product import float_product
from semslam.slam.estimator import Mode
from semslam.slam.quarter_turns import orbits, turned_cells, turned_products, turns_of

Field = NDArray[np.float32]
"""(R, H, W) probabilities of pose bins."""
Scores = NDArray[np.float32]
"""(R, H, W) correlations."""
Window = tuple[slice, slice]
"""Rows and columns of a part of the map."""
Bin = tuple[int, int, int]
"""(r, iy, ix) of a pose bin."""

SCORE_BITS = 17
"""Binary places of scores, counted from the largest; sums in float32 err by some 2^-20 of it."""
LEAST_STEP = 2.0**-26
"""Scores below half of this are none: what is left of an object after a hundred other observations is no match."""
PATCH_BYTES = 64 << 20
"""Neighbourhoods gathered at once for equation 2: memory stays bounded for maps of any size."""
PLACED_BITS = 18
"""Binary places of the weights in equation 6; the centre cell's have two fewer, rounding error 8e-6."""
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

    (L, h, h) -> (R, L, h, h), a view of memory that holds one class after the other. Heading 0 is the observation, and
    headings a quarter turn apart are quarter turns of each other, bit for bit.
    """
    classes, side, _ = planes.shape
    turns = turns_of(headings)
    count = headings // turns
    corners, shares = _sampling(headings, count, side)  # (4, count * h * h) each
    present = np.flatnonzero(planes.any((1, 2)))
    padded = np.pad(planes[present].reshape(len(present), -1), ((0, 0), (0, 1)))
    first = np.einsum("kcn,cn->kn", padded.take(corners, 1), shares).reshape(-1, count, side * side)
    rotated = np.zeros((classes, turns, count, side * side), np.float32)
    for quarters, cells in enumerate(turned_cells(side)[:turns]):
        rotated[present, quarters] = first.take(cells, 2)
    return rotated.reshape(classes, headings, side, side).swapaxes(0, 1)


@lru_cache(maxsize=4)
def _sampling(headings: int, count: int, side: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Source cells (h * h means outside) and bilinear shares of the four corners of every cell, first `count` headings.

    (4, count * h * h) each.
    """
    middle = side // 2
    angles = math.tau * np.arange(count)[:, None] / headings
    y, x = (axis.ravel() - middle for axis in np.mgrid[:side, :side])
    source_x = np.cos(angles) * x + np.sin(angles) * y + middle  # robot_from_map, heading undone
    source_y = np.cos(angles) * y - np.sin(angles) * x + middle
    left, low = np.floor(source_x), np.floor(source_y)
    right_share, high_share = source_x - left, source_y - low
    corners, shares = [], []
    for up, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = (left + right).astype(np.intp), (low + up).astype(np.intp)
        inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
        corners.append(np.where(inside, row * side + column, side * side).ravel())
        share = (right_share if right else 1 - right_share) * (high_share if up else 1 - high_share)
        shares.append(share.astype(np.float32).ravel())
    return np.stack(corners), np.stack(shares)


def correlate(rotated: Planes, world: Planes) -> Scores:
    """Equation 2 before the softmax: how well the observation fits the map at every pose bin.

    Cross-correlation (no flip), zero padded, summed over object classes; classes missing from either side add nothing
    and are skipped. Scores are rounded to `score_step`. (R, L, h, h), (L, H, W) -> (R, H, W); `rotated` must be as
    `rotate_observation` gives it.
    """
    (headings, _, side, _), (_, rows, columns) = rotated.shape, world.shape
    shared = [i for i in range(FIRST_OBJECT, len(world)) if rotated[0, i].any() and world[i].any()]
    kernels = _in_orbits(rotated, shared)  # (turns, n, C, O)
    turns = len(kernels)
    terms = np.argwhere(kernels.any((0, 1)))  # (T, 2): class, orbit
    nearby = around(world[shared], (slice(0, rows), slice(0, columns)), side // 2)
    windows = sliding_window_view(nearby, (rows, columns), (1, 2))  # (C, h, h, H, W)
    scores = np.zeros((turns, headings // turns, rows * columns), np.float32)
    for some, part in _pieces(terms, turns, rows, columns):
        class_id, orbit = some.T
        cells = orbits(side, turns)[0][:, orbit]  # (turns, T)
        values = windows[class_id, cells // side, cells % side, part].reshape(*cells.shape, -1)
        bins = slice(part.start * columns, part.stop * columns)
        scores[:, :, bins] += turned_products(kernels[:, :, class_id, orbit], values, float_product)
    return _rounded(scores).reshape(headings, rows, columns)


def _in_orbits(
    rotated: Planes, classes: Sequence[int] | NDArray[np.intp], some: slice | NDArray[np.intp] = slice(None)
) -> NDArray[np.float32]:
    """Rotated observations of C classes and n (or all) headings of the first quarter, by orbit -> (turns, n, C, O).

    Raises:
        ValueError: headings a quarter turn apart are no quarter turns of each other.
    """
    headings, _, side, _ = rotated.shape
    turns = turns_of(headings)
    if turns > 1 and not np.array_equal(rotated[headings // 4], np.rot90(rotated[0], -1, (1, 2))):
        raise ValueError("headings a quarter turn apart must be quarter turns of each other: use rotate_observation")
    cells, shares = orbits(side, turns)
    first = rotated.swapaxes(0, 1)[classes, : headings // turns][:, some]  # (C, n, h, h)
    return (first.reshape(*first.shape[:2], side * side).take(cells, 2) * shares).transpose(2, 1, 0, 3)


def around(planes: NDArray[np.float32], window: Window, reach: int) -> NDArray[np.float32]:
    """Planes (N, H, W) in the window and `reach` cells beyond it, zero off the map: (N, rows + 2 reach, ...)."""
    cuts, margins = [], [(0, 0)]
    for part, size in zip(window, planes.shape[1:], strict=True):
        start, stop = max(0, part.start - reach), min(size, part.stop + reach)
        cuts.append(slice(start, stop))
        margins.append((start - part.start + reach, part.stop + reach - stop))
    return np.pad(planes[:, *cuts], margins)


def _pieces(terms: NDArray[np.int64], turns: int, rows: int, columns: int) -> Iterator[tuple[NDArray[np.int64], slice]]:
    """Terms of a sum and rows of the map, in pieces whose neighbourhoods take at most `PATCH_BYTES`.

    A single term of a single row of the map is the smallest piece.
    """
    at_once = max(1, PATCH_BYTES // (8 * turns * columns))  # 4 bytes, and as many again for their spectrum
    height = min(rows, max(1, at_once // max(1, len(terms))))
    count = max(1, at_once // height)
    for top in range(0, rows, height):
        for first in range(0, len(terms), count):
            yield terms[first : first + count], slice(top, min(rows, top + height))


def score_step(largest: float) -> float:
    """Scores closer than this are equal: 2^-`SCORE_BITS` of the next power of two above the largest."""
    return max(LEAST_STEP, math.ldexp(1.0, math.frexp(largest)[1] - SCORE_BITS))


def _rounded(scores: Scores) -> Scores:
    """Scores in whole steps, in place: what is zero but for the rounding of sums becomes zero."""
    step = np.float32(score_step(float(scores.max())))
    scores *= 1 / step
    np.rint(scores, out=scores)
    scores *= step
    return scores


def visual_field(scores: Scores, temperature: float) -> tuple[Field, float]:
    """Equation 2: one softmax over all R H W bins; also the field's entropy in nats."""
    raised = np.asarray(scores - scores.max(), np.float32)
    raised *= np.float32(1 / temperature)
    weights = np.exp(raised)
    total = float(weights.sum(dtype=np.float64))
    raised *= weights
    entropy = math.log(total) - float(raised.sum(dtype=np.float64)) / total
    weights /= np.float32(total)
    return weights, max(0.0, entropy)


def best_bin(scores: Scores, near: SE2, grid: PoseGrid) -> Bin:
    """The bin of the highest score (v bar of equation 2). Equal scores: the one nearest to `near`, heading second."""
    largest = float(scores.max())
    tied = np.flatnonzero(scores >= largest - score_step(largest))
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
    (headings, classes, side, _), present = rotated.shape, np.flatnonzero(rotated[0].any((1, 2)))
    result = np.zeros((classes, *(part.stop - part.start for part in window)), np.float32)
    mass = _whole(around(field, window, side // 2), FIELD_BITS)  # (R, rows + h - 1, columns + h - 1)
    box = _filled(np.asarray(mass.any(0)))
    turns = turns_of(headings)
    mass = mass[:, *box].reshape(turns, headings // turns, *(part.stop - part.start for part in box))
    met = np.flatnonzero(mass.any((0, 2, 3)))
    if met.size and result.size:
        kernels = _whole(_in_orbits(rotated, present, met), PLACED_BITS)  # (turns, n, K, O)
        pieces = _spread(kernels, mass[:, met])
        placed = _laid_out(pieces, box[0].start, box[1].start, np.zeros((len(present), *result.shape[1:])), side)
        result[present] = placed * 0.5 ** (PLACED_BITS + FIELD_BITS)
    return result


def _filled(plane: NDArray[np.bool_]) -> Window:
    """The smallest window that holds all that is true; empty if nothing is."""
    rows, columns = np.nonzero(plane)
    if not rows.size:
        return slice(0, 0), slice(0, 0)
    return slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)


def _whole(values: NDArray[np.float32], bits: int) -> NDArray[np.float64]:
    """Values in units of 2^-bits, rounded to whole numbers."""
    scaled = values * np.float64(2**bits)
    return np.rint(scaled, out=scaled)


def _spread(kernels: NDArray[np.float64], mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """Kernels (turns, n, K, O) times masses (turns, n, rows, columns), summed over headings.

    -> (turns, K, O, rows, columns): what every cell of the observation adds, before it is moved to its place.
    """
    turns, headings, *places = mass.shape
    left = kernels.transpose(0, 2, 3, 1).reshape(turns, -1, headings)
    pieces = turned_products(left, mass.reshape(turns, headings, -1), np.matmul)
    return pieces.reshape(turns, *kernels.shape[2:], *places)


def _laid_out(
    pieces: NDArray[np.float64], top: int, left: int, placed: NDArray[np.float64], side: int
) -> NDArray[np.float64]:
    """Pieces of `_spread`, each moved to its place and added to `placed` (K, rows, columns), the window.

    Seen from the window's surroundings, `side // 2` cells wider all round, the pieces' masses begin at row `top` and
    column `left`.
    """
    _, rows, columns = placed.shape
    height, width = pieces.shape[3:]
    cells = orbits(side, len(pieces))[0]  # (turns, O)
    row, column = top + cells // side - side + 1, left + cells % side - side + 1
    start, stop = np.maximum(0, row), np.minimum(rows, row + height)
    begin, end = np.maximum(0, column), np.minimum(columns, column + width)
    hits = np.argwhere((start < stop) & (begin < end))
    spans = np.stack([row, column, start, stop, begin, end], -1)[*hits.T]
    for (turn, orbit), (y, x, y0, y1, x0, x1) in zip(hits.tolist(), spans.tolist(), strict=True):
        placed[:, y0:y1, x0:x1] += pieces[turn, :, orbit, y0 - y : y1 - y, x0 - x : x1 - x]
    return placed


def update_map(world: Planes, placed: Planes, window: Window, leak: float) -> Planes:
    """Equation 10, the leaky average, inside the window; all other cells stay as they are, bit for bit.

    A cell is averaged, all its classes together, if anything but *unobserved* was placed in it (o~(x, y) > 0).
    """
    updated = world.copy()
    part = updated[:, window[0], window[1]]  # (L, rows, columns), a view
    seen = np.delete(placed, UNOBSERVED, axis=0).any(0)
    part[:, seen] = np.float32(1.0 - leak) * part[:, seen] + np.float32(leak) * placed[:, seen]
    return updated
