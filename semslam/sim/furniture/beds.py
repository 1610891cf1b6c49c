"""Beds: with a panelled, slatted, padded or barred head, a mattress, a quilt that hangs over, pillows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import (
    BLACK_STEEL,
    BRASS,
    LINENS,
    WHITE,
    Palette,
    accent,
    chance,
    darker,
    fabric,
    linen,
    pick,
    piece,
    tinted,
    uniform,
)
from semslam.sim.furniture.forms import (
    back_pad,
    both_sides,
    draped,
    leg,
    loft,
    pad,
    pillow,
    post,
    resampled,
    rounded_ring,
)
from semslam.sim.furniture.solids import block
from semslam.sim.home import Array, Look, Mesh, Piece
from semslam.sim.shapes import about_y, ball, merge, moved, posed, rod, tube

_Part = tuple[Mesh, Look]


@dataclass(frozen=True)
class _Size:
    """A mattress: its foot end is at x = `length_m` / 2."""

    length_m: float
    width_m: float
    base_m: float
    """Height of its underside."""
    top_m: float
    double: bool

    @property
    def half(self) -> tuple[float, float]:
        return self.length_m / 2, self.width_m / 2


def _draw_size(rng: Generator) -> _Size:
    double = chance(rng, 0.6)
    width = uniform(rng, 1.4, 1.8) if double else uniform(rng, 0.9, 1.1)
    base = uniform(rng, 0.24, 0.30)
    return _Size(uniform(rng, 1.96, 2.06), width, base, base + uniform(rng, 0.19, 0.25), double)


def _bedding(rng: Generator, palette: Palette, size: _Size, hem_m: float) -> list[_Part]:
    """Mattress, quilt with its upper edge turned back, pillows, often a throw at the foot."""
    x, y = size.half
    sheet = palette.linen
    mattress = pad((-x, -y, size.base_m), (x, y, size.top_m), edge_m=0.05, crown_m=0.008)
    cover = _quilt(rng, palette)
    start, top = -x + uniform(rng, 0.58, 0.7), size.top_m + 0.025
    parts: list[_Part] = [(mattress, tinted(sheet, 0.97))]
    parts.append((_cover(start, x + 0.035, y + 0.035, hem_m, top, 0.0, 56), cover))
    parts.append(
        (
            _cover(start - 0.02, start + 0.24, y + 0.035, hem_m + 0.04, top, 0.008, 32),
            pick(rng, (sheet, tinted(cover, 1.2))),
        )
    )
    if chance(rng, 0.45):
        low = x - uniform(rng, 0.5, 0.62)
        parts.append((_cover(low, low + 0.4, y + 0.035, hem_m + 0.03, top, 0.009, 36), palette.accent))
    return parts + _pillows(rng, palette, size)


def _quilt(rng: Generator, palette: Palette) -> Look:
    """What the quilt looks like: stitched, plain, striped or checked."""
    colour = pick(rng, (*LINENS, palette.fabric.colours[0], palette.accent.colours[0]))
    stitched = Look("quilt", (colour, darker(colour, 0.8)), tile_m=uniform(rng, 0.6, 0.9), seed=palette.linen.seed)
    striped = Look(
        pick(rng, ("stripes", "plaid")),
        (colour, palette.linen.colours[0], darker(colour, 0.7)),
        tile_m=uniform(rng, 0.5, 0.8),
    )
    return pick(rng, (stitched, stitched, fabric(rng), linen(rng), accent(rng), striped))


def _cover(start_m: float, end_m: float, half_m: float, hem_m: float, top_m: float, grow_m: float, count: int) -> Mesh:
    """A cloth over the bed from `start_m` to `end_m` along x that hangs down to its hem in waves.

    Args:
        half_m: from the middle to where it hangs.
        grow_m: how far it lies over a cloth below it.
        count: points around it.
    """
    deep, wide, drop = end_m - start_m + 2 * grow_m, 2 * (half_m + grow_m), top_m - hem_m
    top = top_m + grow_m
    reach = min(deep, wide) / 2
    profile = [
        (-0.028, hem_m),
        (-0.018, hem_m + 0.4 * drop),
        (-0.002, top - 0.06),
        (0.008, top - 0.025),
        (0.03, top - 0.004),
    ]
    profile += [(0.09, top + 0.006), (0.85 * reach, top + 0.014)]
    rings = [resampled(rounded_ring(deep - 2 * inset, wide - 2 * inset, 0.09, z), count) for inset, z in profile]
    middle = ((start_m + end_m) / 2, 0.0, 0.0)
    waved = [_waved(ring + middle, 0.016 * max(0.0, 1 - (ring[0, 2] - hem_m) / drop)) for ring in rings]
    return draped(loft(waved), rings, profile)


def _waved(ring: Array, height_m: float) -> Array:
    """The ring pushed in and out in waves that depend on the place alone, so that cloths on top of each other agree."""
    along = np.roll(ring, -1, 0) - np.roll(ring, 1, 0)
    out = np.column_stack([along[:, 1], -along[:, 0], 0 * along[:, 0]])
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    phase = 2 * np.pi * (ring[:, 0] / 0.37 + ring[:, 1] / 0.41)
    return np.asarray(ring + out * (height_m * (np.sin(phase) + 0.4 * np.sin(2.3 * phase)))[:, None])


def _pillows(rng: Generator, palette: Palette, size: _Size) -> list[_Part]:
    """One or two that lie, or lean against the head; now and then small ones before them."""
    x, y = size.half
    places = [-y / 2, y / 2] if size.double else [0.0]
    wide = min(0.72, size.width_m / len(places) - 0.1)
    lean = pick(rng, (0.2, 0.25, 0.8))
    case = palette.linen if chance(rng, 0.7) else linen(rng)
    parts: list[_Part] = []
    for place in places:
        shape = moved(pillow(0.46, wide, 0.20, count=7), (0.23, 0, 0))
        turned = posed(
            shape,
            about_y(-lean),
            (-x + 0.04 + 0.17 * math.sin(lean), place + uniform(rng, -0.03, 0.03), size.top_m - 0.012),
        )
        parts.append((turned, case))
    if chance(rng, 0.4):
        small = moved(pillow(0.36, 0.4, 0.13, count=7), (0.18, 0, 0))
        parts.append(
            (posed(small, about_y(-0.95), (-x + 0.48, uniform(rng, -0.1, 0.1), size.top_m - 0.005)), palette.accent)
        )
    return parts


def panel(rng: Generator, palette: Palette) -> Piece:
    """A wooden bed: framed panels at the head, a low board at the foot."""
    size, look = _draw_size(rng), palette.wood if chance(rng, 0.7) else palette.body
    x, y = size.half
    high, low = size.top_m + uniform(rng, 0.42, 0.6), size.top_m + uniform(rng, -0.12, 0.06)
    frame = [
        _rails(x, y, size.base_m),
        _framed(-x - 0.04, y + 0.035, 0.24, high),
        _framed(x + 0.115, y + 0.035, 0.2, low),
    ]
    return piece("bed", "panel", [(merge(frame), look), *_bedding(rng, palette, size, size.base_m - 0.03)])


def _rails(half_x: float, half_y: float, base_m: float, *, beyond_m: float = 0.1) -> Mesh:
    """The boards along the sides that carry the mattress; they reach beyond its foot end to the foot board."""
    side = block((-half_x - 0.03, half_y - 0.01, base_m - 0.14), (half_x + beyond_m, half_y + 0.02, base_m + 0.04))
    floor = block((-half_x, -half_y + 0.02, base_m - 0.05), (half_x, half_y - 0.02, base_m + 0.005))
    return merge([both_sides(side), floor])


def _framed(x_m: float, half_m: float, low_m: float, high_m: float) -> Mesh:
    """Two posts to the floor with rails and a panel between them."""
    posts = both_sides(block((x_m - 0.03, half_m - 0.035, 0.0), (x_m + 0.03, half_m + 0.035, high_m + 0.03), 0.008))
    rails = [
        block((x_m - 0.02, -half_m, z - 0.045), (x_m + 0.02, half_m, z + 0.045), 0.006)
        for z in (low_m + 0.045, high_m - 0.045)
    ]
    return merge([posts, *rails, block((x_m - 0.008, -half_m, low_m), (x_m + 0.008, half_m, high_m))])


def slatted(rng: Generator, palette: Palette) -> Piece:
    """A wooden bed with upright slats at the head, open at the foot."""
    size, look = _draw_size(rng), palette.wood if chance(rng, 0.6) else palette.body
    x, y = size.half
    high = size.top_m + uniform(rng, 0.4, 0.58)
    frame = [
        _rails(x, y, size.base_m),
        both_sides(block((-x - 0.07, y - 0.03, 0), (-x - 0.015, y + 0.03, high - 0.02), 0.006)),
    ]
    arch = np.linspace(-y - 0.02, y + 0.02, 9)
    crest = 0.05 * (1 - (arch / y) ** 2)
    frame.append(_rail_across(np.column_stack([np.full(9, -x - 0.042), arch, high + crest - 0.02]), 0.055))
    frame.append(block((-x - 0.06, -y, size.top_m - 0.08), (-x - 0.025, y, size.top_m)))
    count = int(size.width_m / 0.13)
    for place in np.linspace(-y, y, count + 2)[1:-1]:
        top = high - 0.02 + 0.05 * (1 - (place / y) ** 2)
        frame.append(
            block((-x - 0.05, float(place) - 0.03, size.top_m - 0.02), (-x - 0.032, float(place) + 0.03, float(top)))
        )
    frame.append(block((x - 0.005, -y - 0.018, size.base_m - 0.14), (x + 0.022, y + 0.018, size.base_m + 0.04)))
    frame.append(
        both_sides(leg((x - 0.02, y - 0.04, size.base_m - 0.1), (x - 0.02, y - 0.04, 0), 0.065, 0.045, rounded=False))
    )
    return piece("bed", "slatted", [(merge(frame), look), *_bedding(rng, palette, size, size.base_m - 0.03)])


def _rail_across(path: Array, thick_m: float) -> Mesh:
    """A bent rail across the bed: a bar of square section along y."""
    turned = post(np.column_stack([path[:, 2], path[:, 0], path[:, 1]]), thick_m)
    return posed(turned, np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]))


def padded(rng: Generator, palette: Palette) -> Piece:
    """An upholstered bed: a covered box on short feet, a tall padded head in one, two or many fields."""
    size, cover = _draw_size(rng), pick(rng, (palette.fabric, palette.fabric, palette.leather))
    x, y = size.half
    high, foot = size.top_m + uniform(rng, 0.5, 0.72), 0.07
    box = pad((-x - 0.02, -y - 0.03, foot), (x + 0.03, y + 0.03, size.base_m + 0.04), edge_m=0.025, crown_m=0.0)
    board = block((-x - 0.10, -y - 0.05, 0.02), (-x - 0.03, y + 0.05, high - 0.02), 0.02)
    fields = pick(rng, (1, 2, 5, 7)) if size.double else pick(rng, (1, 3, 5))
    edges = np.linspace(-y - 0.04, y + 0.04, fields + 1).tolist()
    tall = high - size.base_m - 0.05
    heads = [
        back_pad(
            (-x - 0.06, (a + b) / 2, size.base_m + 0.05),
            tall,
            b - a,
            0.075,
            0.0,
            crown_m=0.02,
            steps=2 if fields < 4 else 1,
        )
        for a, b in itertools.pairwise(edges)
    ]
    feet = both_sides(
        merge([leg((at, y - 0.1, foot + 0.02), (at, y - 0.1, 0), 0.06, 0.045) for at in (x - 0.1, -x + 0.1)])
    )
    parts: list[_Part] = [(merge([box, board, *heads]), cover), (feet, tinted(palette.wood, 0.8))]
    return piece("bed", "padded", parts + _bedding(rng, palette, size, size.base_m - 0.02))


def metal(rng: Generator, palette: Palette) -> Piece:
    """A bed of steel tubes with bars at head and foot and balls on its posts."""
    size, look = _draw_size(rng), pick(rng, (BLACK_STEEL, BLACK_STEEL, WHITE, BRASS))
    x, y = size.half
    ends = [_bars(-x - 0.03, y + 0.02, size.top_m + uniform(rng, 0.4, 0.52), size.top_m - 0.12)]
    ends.append(_bars(x + 0.105, y + 0.02, size.top_m + uniform(rng, -0.08, 0.02), size.base_m - 0.06))
    rails = both_sides(block((-x - 0.03, y - 0.01, size.base_m - 0.05), (x + 0.10, y + 0.02, size.base_m)))
    floor = block((-x, -y + 0.02, size.base_m - 0.03), (x, y - 0.02, size.base_m + 0.005))
    parts: list[_Part] = [(merge([*ends, rails, floor]), look)]
    return piece("bed", "metal", parts + _bedding(rng, palette, size, size.base_m - 0.03))


def _bars(x_m: float, half_m: float, high_m: float, low_m: float) -> Mesh:
    """Two posts, a bow between their tops, upright bars from a lower rail."""
    posts = [rod((x_m, s * half_m, 0), (x_m, s * half_m, high_m), 0.02, segments=8) for s in (-1, 1)]
    knobs = [ball((x_m, s * half_m, high_m + 0.015), 0.032, segments=8) for s in (-1, 1)]
    y = np.linspace(-half_m, half_m, 11)
    crest = high_m - 0.04 + 0.1 * (1 - (y / half_m) ** 2)
    bow = tube(np.column_stack([np.full(11, x_m), y, crest]), 0.016, segments=6)
    rail = rod((x_m, -half_m, low_m), (x_m, half_m, low_m), 0.014, segments=6)
    places = np.linspace(-half_m, half_m, max(6, int(half_m / 0.085)) + 2)[1:-1].tolist()
    tops = np.interp(places, y, crest).tolist()
    bars = [rod((x_m, at, low_m), (x_m, at, top), 0.008, segments=5) for at, top in zip(places, tops, strict=True)]
    return merge([*posts, *knobs, bow, rail, *bars])


BEDS: dict[str, Callable[[Generator, Palette], Piece]] = {
    "panel": panel,
    "slatted": slatted,
    "padded": padded,
    "metal": metal,
}
"""Makers by style."""
