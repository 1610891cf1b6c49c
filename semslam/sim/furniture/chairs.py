"""Chairs: with slats or spindles, a moulded shell, upholstered with arms, on castors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from semslam.sim.furniture.common import (
    BLACK_STEEL,
    CHROME,
    DARK,
    Palette,
    chance,
    pick,
    piece,
    plastic,
    tinted,
    uniform,
)
from semslam.sim.furniture.forms import (
    back_pad,
    both_sides,
    curve,
    grained,
    leg,
    pad,
    plate,
    plump,
    post,
    slab,
    superellipse,
    swapped,
    warped,
)
from semslam.sim.furniture.solids import block
from semslam.sim.home import Array, Look, Mesh, Piece
from semslam.sim.shapes import about_x, about_y, about_z, bar, lathe, merge, moved, posed, rod, rounded_rectangle, tube

_SHELLS = (
    (0.93, 0.92, 0.90),
    (0.93, 0.92, 0.90),
    (0.15, 0.15, 0.16),
    (0.62, 0.63, 0.63),
    (0.78, 0.62, 0.24),
    (0.24, 0.42, 0.48),
    (0.62, 0.24, 0.18),
)


class _Frame:
    """The sizes of a wooden chair: a seat between four legs, of which the rear two rise to carry the back."""

    def __init__(self, rng: Generator, top_m: tuple[float, float]) -> None:
        self.seat_m = uniform(rng, 0.44, 0.47)
        self.width_m, self.depth_m = uniform(rng, 0.42, 0.48), uniform(rng, 0.41, 0.46)
        self.top_m = uniform(rng, *top_m)
        self.lean_m, self.sag_m = uniform(rng, 0.06, 0.11), uniform(rng, 0.012, 0.035)
        self.thick_m = uniform(rng, 0.032, 0.04)

    def back_x(self, z_m: Array | float) -> Array:
        """Where the rear legs are at some height."""
        x = -self.depth_m / 2 + 0.02
        heights = (0.0, 0.5 * self.seat_m, self.seat_m, 0.5 * (self.seat_m + self.top_m), self.top_m)
        places = (x - 0.05, x - 0.012, x, x - 0.35 * self.lean_m, x - self.lean_m)
        return np.asarray(np.interp(z_m, heights, places))

    def legs(self) -> Mesh:
        """Two tapered ones in front, two bent ones that go up to the top."""
        y = self.width_m / 2 - 0.5 * self.thick_m
        heights = np.linspace(0, self.top_m, 9)
        path = np.column_stack([self.back_x(heights), np.full(9, y - 0.015), heights])
        rear = post(path, np.interp(heights, (0, self.seat_m, self.top_m), np.multiply((0.8, 1.0, 0.72), self.thick_m)))
        x = self.depth_m / 2 - 0.5 * self.thick_m - 0.005
        front = leg((x, y, self.seat_m - 0.02), (x + 0.008, y, 0.0), self.thick_m, 0.68 * self.thick_m, rounded=False)
        return both_sides(merge([rear, front]))

    def apron(self) -> Mesh:
        """Boards below the seat, rails between the legs."""
        x, y, z = self.depth_m / 2 - 0.028, self.width_m / 2 - 0.03, self.seat_m - 0.025
        side = block((-x, y - 0.01, z - 0.055), (x, y + 0.01, z))
        cross = [block((at - 0.01, -y, z - 0.055), (at + 0.01, y, z)) for at in (-x, x)]
        rail = bar((float(self.back_x(0.2)), y - 0.005, 0.2), (x, y, 0.2), 0.018, 0.024)
        return merge([both_sides(merge([side, rail])), *cross])

    def seat(self) -> Mesh:
        """A board, somewhat narrower behind."""
        outline = rounded_rectangle(self.depth_m + 0.01, self.width_m + 0.02, 0.04, steps=3)
        outline[:, 1] *= 1 + 0.14 * outline[:, 0] / self.depth_m
        return grained(plate(outline, self.seat_m - 0.026, self.seat_m, edge_m=0.009), (1, 0, 0))

    def slat(self, low_m: float, high_m: float, *, arch_m: float = 0.0) -> Mesh:
        """A bent board across the back; its upper edge may arch."""
        y = np.linspace(-1, 1, 9)[:, None] * (self.width_m / 2 - 0.03)
        round_share = 1 - (y / y.max()) ** 2
        z = low_m + (high_m - low_m + arch_m * round_share) * np.linspace(0, 1, 3)[None]
        x = self.back_x(z) - self.sag_m * round_share
        return grained(slab(np.stack([x, np.broadcast_to(y, x.shape), z], -1), 0.016), (0, 1, 0))

    def spindle(self, y_m: float, low_m: float, high_m: float) -> Mesh:
        """A round stick from the seat up to the top rail."""
        sag = self.sag_m * (1 - (y_m / (self.width_m / 2)) ** 2)
        ends = [(float(self.back_x(z)) - share * sag, y_m, z) for z, share in ((low_m, 0.3), (high_m, 1.0))]
        return swapped(rod(ends[0], ends[1], 0.009, 0.007, segments=6))


def _cushion(frame: _Frame) -> Mesh:
    half, wide = frame.depth_m / 2 - 0.015, frame.width_m / 2 - 0.015
    z = frame.seat_m - 0.004
    return pad((-half + 0.015, -wide, z), (half, wide, z + 0.035), edge_m=0.016, crown_m=0.012)


def ladder(rng: Generator, palette: Palette) -> Piece:
    """A wooden dining chair with boards across its back."""
    frame = _Frame(rng, (0.90, 1.04))
    look = tinted(palette.wood, uniform(rng, 0.85, 1.1))
    count = int(rng.integers(3, 5))
    start, step = frame.seat_m + 0.12, (frame.top_m - 0.05 - frame.seat_m - 0.12) / (count - 0.4)
    slats = [frame.slat(start + i * step, start + (i + 0.52) * step, arch_m=0.015) for i in range(count)]
    parts = [(merge([frame.legs(), frame.apron(), frame.seat(), *slats]), look)]
    if chance(rng, 0.6):
        parts.append((_cushion(frame), pick(rng, (palette.fabric, palette.accent))))
    return piece("chair", "ladder", parts)


def spindle(rng: Generator, palette: Palette) -> Piece:
    """A country chair with upright sticks and a broad top rail."""
    frame = _Frame(rng, (0.84, 0.95))
    look = palette.wood if chance(rng, 0.6) else palette.body
    rail = frame.slat(frame.top_m - 0.085, frame.top_m + 0.005, arch_m=0.025)
    places = np.linspace(-1, 1, 7)[1:-1] * (frame.width_m / 2 - 0.03)
    sticks = [frame.spindle(float(y), frame.seat_m - 0.01, frame.top_m - 0.05) for y in places]
    parts = [(merge([frame.legs(), frame.apron(), frame.seat(), rail, *sticks]), look)]
    if chance(rng, 0.25):
        parts.append((_cushion(frame), palette.accent))
    return piece("chair", "spindle", parts)


def shell(rng: Generator, palette: Palette) -> Piece:
    """Seat and back moulded in one curve, on four splayed legs."""
    wide, z = uniform(rng, 0.46, 0.51), uniform(rng, 0.43, 0.455)
    colour = pick(rng, _SHELLS)
    parts = [(_moulded(wide, z, uniform(rng, 0.36, 0.42)), plastic(colour, shine=0.4))]
    wooden = chance(rng, 0.7)
    parts.append((_splayed_legs(z, 0.04 if wooden else 0.02), palette.wood if wooden else CHROME))
    parts.append((_struts(z), BLACK_STEEL if wooden else CHROME))
    if chance(rng, 0.3):
        cushion = plump(superellipse(0.33, 0.33, 4), 0.026, edge_m=0.012, crown_m=0.008)
        parts.append((moved(cushion, (0.02, 0.0, z - 0.006)), palette.fabric))
    return piece("chair", "shell", parts)


def _moulded(wide_m: float, seat_m: float, back_m: float) -> Mesh:
    """(15, 9) grid from the front lip over the seat up the back; its sides curl up and forwards."""
    turn = seat_m - 0.012
    spine = [(0.235, seat_m - 0.03), (0.215, seat_m), (0.11, seat_m + 0.002), (-0.04, turn), (-0.15, turn + 0.008)]
    spine += [(-0.205, turn + 0.07), (-0.23, turn + 0.18), (-0.25, turn + 0.8 * back_m), (-0.27, turn + back_m)]
    line = curve(spine, 15)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    out = np.column_stack([along[:, 1], -along[:, 0]])  # up on the seat, forwards on the back
    t, v = np.linspace(0, 1, 15), np.linspace(-1, 1, 9)
    half = wide_m / 2 * (1 - 0.12 * t) * (1 - 0.45 * np.abs(2 * t - 1) ** 7)
    curl = (0.02 + 0.055 * np.sin(np.pi * t) ** 2)[:, None] * np.abs(v)[None] ** 2.6
    x, z = (line[:, axis, None] + out[:, axis, None] * curl for axis in (0, 1))
    y = half[:, None] * (v[None] - 0.10 * np.sign(v) * np.abs(v) ** 3)
    grid = np.stack([x, y, z], -1)[:, ::-1]  # rows run backwards and up: columns to the right turn the front outwards
    return slab(grid, 0.009)


def _splayed_legs(seat_m: float, thick_m: float) -> Mesh:
    front = leg((0.12, 0.13, seat_m - 0.02), (0.215, 0.225, 0.0), thick_m, 0.6 * thick_m)
    rear = leg((-0.12, 0.12, seat_m - 0.02), (-0.225, 0.215, 0.0), thick_m, 0.6 * thick_m)
    return both_sides(merge([front, rear]))


def _struts(seat_m: float) -> Mesh:
    """Two crosses of wire between the legs, and a plate under the seat."""
    high, low = seat_m - 0.06, seat_m - 0.21
    ends = [((0.128, 0.14, high), (-0.17, 0.165, low)), ((-0.13, 0.13, high), (0.165, 0.17, low))]
    sides = [rod(a, b, 0.005, segments=5) for a, b in ends]
    across = [rod((x, -0.14, high), (x * 1.25, 0.165, low), 0.005, segments=5) for x in (0.13, -0.135)]
    return merge(
        [both_sides(merge(sides + across)), block((-0.14, -0.14, seat_m - 0.03), (0.14, 0.14, seat_m - 0.014))]
    )


def upholstered(rng: Generator, palette: Palette) -> Piece:
    """A padded chair with arm rests, on wooden legs."""
    cover = pick(rng, (palette.fabric, palette.accent, palette.leather))
    wide, deep, z = uniform(rng, 0.50, 0.56), uniform(rng, 0.48, 0.53), uniform(rng, 0.45, 0.48)
    tall, lean = uniform(rng, 0.40, 0.52), uniform(rng, 0.14, 0.22)
    seat = pad((-deep / 2, -wide / 2 + 0.035, z - 0.11), (deep / 2, wide / 2 - 0.035, z - 0.015), edge_m=0.03)
    back = back_pad((-deep / 2 - 0.01, 0.0, z - 0.08), tall + 0.08, wide - 0.07, 0.075, lean)
    legs = merge(
        [
            leg((deep / 2 - 0.05, wide / 2 - 0.05, z - 0.1), (deep / 2 - 0.02, wide / 2 - 0.03, 0), 0.045, 0.026),
            leg((-deep / 2 + 0.05, wide / 2 - 0.06, z - 0.1), (-deep / 2 - 0.04, wide / 2 - 0.03, 0), 0.045, 0.026),
        ]
    )
    wooden = chance(rng, 0.6)
    arms = _wooden_arm(wide, deep, z) if wooden else _padded_arm(wide, deep, z)
    parts = [(merge([seat, back]), cover), (both_sides(legs), palette.wood)]
    return piece("chair", "upholstered", [*parts, (both_sides(arms), palette.wood if wooden else cover)])


def _wooden_arm(wide_m: float, deep_m: float, seat_m: float) -> Mesh:
    """A bent post from the front leg, and a rest that runs back to the back."""
    y, high = wide_m / 2 - 0.02, seat_m + 0.20
    front = [(deep_m / 2 - 0.06, y - 0.02, seat_m - 0.09), (deep_m / 2 - 0.045, y, seat_m + 0.05)]
    upright = post(curve([*front, (deep_m / 2 - 0.075, y, high)], 6), 0.028)
    line = [
        (deep_m / 2 - 0.03, high - 0.004),
        (deep_m / 2 - 0.1, high + 0.008),
        (0.0, high),
        (-deep_m / 2 - 0.035, high + 0.02),
    ]
    path = curve(line, 7)
    rest = tube(np.column_stack([path[:, 0], np.full(7, y), path[:, 1]]), [0.018, *[0.021] * 5, 0.015], segments=8)
    return merge([upright, swapped(rest)])


def _padded_arm(wide_m: float, deep_m: float, seat_m: float) -> Mesh:
    low = (-deep_m / 2, wide_m / 2 - 0.05, seat_m - 0.11)
    return pad(low, (deep_m / 2 - 0.04, wide_m / 2 + 0.01, seat_m + 0.19), edge_m=0.025, crown_m=0.008)


def office(rng: Generator, palette: Palette) -> Piece:
    """A swivel chair: star base on castors, gas lift, padded seat and back, mostly with arms."""
    z, wide = uniform(rng, 0.45, 0.48), uniform(rng, 0.47, 0.51)
    black = Look("fabric", ((0.15, 0.15, 0.16), (0.10, 0.10, 0.11)), tile_m=0.2)
    cover = pick(rng, (black, black, palette.fabric, palette.leather))
    frame = DARK if chance(rng, 0.7) else CHROME
    turn = uniform(rng, 0, 2 * math.pi)
    seat = pad((-0.23, -wide / 2, z - 0.09), (0.26, wide / 2, z - 0.012), edge_m=0.034, crown_m=0.02)
    back = _bent_back(z - 0.07, wide - 0.03, uniform(rng, 0.54, 0.62))
    carrier = tube(
        curve([(-0.08, 0, z - 0.085), (-0.24, 0, z - 0.07), (-0.30, 0, z + 0.04), (-0.285, 0, z + 0.25)], 8), 0.022
    )
    column = merge([rod((0, 0, 0.09), (0, 0, 0.24), 0.028), rod((0, 0, 0.24), (0, 0, z - 0.07), 0.016)])
    mount = block((-0.12, -0.1, z - 0.1), (0.12, 0.1, z - 0.065))
    parts = [(merge([seat, back]), cover), (merge([carrier, mount]), DARK), (column, DARK), (_star(turn), frame)]
    parts.append((_castors(turn), DARK))
    if chance(rng, 0.6):
        parts.append((both_sides(_office_arm(z, wide)), DARK))
    return piece("chair", "office", parts)


def _bent_back(seat_m: float, wide_m: float, tall_m: float) -> Mesh:
    """A padded back that curves around the sitter and comes forward at the small of the back."""
    lying = plump(superellipse(tall_m, wide_m, 4.5, segments=32), 0.06, edge_m=0.026, crown_m=0.014)
    upright = posed(lying, about_y(math.pi / 2), (-0.265, 0.0, seat_m + 0.05 + tall_m / 2))

    def bend(points: Array) -> Array:
        share = (points[:, 2] - seat_m - 0.05) / tall_m
        hollow = 0.028 * np.sin(2 * np.pi * share + 0.4) - 0.05 * share
        x = points[:, 0] + 0.9 * points[:, 1] ** 2 + hollow
        return np.column_stack([x, points[:, 1] * (1.04 - 0.16 * share**2), points[:, 2]])

    return warped(upright, bend)


def _star(turn_rad: float) -> Mesh:
    """Five arms that slope down from the column."""
    arm = merge([bar((0.02, 0, 0.10), (0.29, 0, 0.072), 0.035, 0.03, bevel_m=0.0)])
    return merge([posed(arm, about_z(turn_rad + k * 2 * math.pi / 5)) for k in range(5)])


def _castors(turn_rad: float) -> Mesh:
    """Two wheels under the end of every arm."""
    profile = [(0.0, -0.009), (0.022, -0.009), (0.027, -0.004), (0.027, 0.004), (0.022, 0.009), (0.0, 0.009)]
    wheel = posed(lathe(profile, segments=10), about_x(math.pi / 2))
    pair = merge([moved(wheel, (0.28, y, 0.027)) for y in (-0.014, 0.014)])
    fork = rod((0.28, 0, 0.03), (0.28, 0, 0.075), 0.008, segments=6)
    return merge([posed(merge([pair, fork]), about_z(turn_rad + k * 2 * math.pi / 5)) for k in range(5)])


def _office_arm(seat_m: float, wide_m: float) -> Mesh:
    """A loop from under the seat over the rest to the back."""
    y, high = wide_m / 2 + 0.03, seat_m + 0.2
    rise = [(-0.04, y - 0.14, seat_m - 0.08), (0.02, y - 0.01, seat_m - 0.05), (0.13, y, seat_m + 0.10)]
    loop = curve([*rise, (0.08, y, high), (-0.12, y, high + 0.005), (-0.25, y - 0.05, seat_m + 0.16)], 14)
    rest = pad((-0.15, y - 0.03, high - 0.005), (0.1, y + 0.03, high + 0.024), edge_m=0.012, crown_m=0.004, steps=2)
    return merge([tube(loop, 0.017, segments=6), rest])


CHAIRS: dict[str, Callable[[Generator, Palette], Piece]] = {
    "ladder": ladder,
    "spindle": spindle,
    "shell": shell,
    "upholstered": upholstered,
    "office": office,
}
"""Makers by style."""
