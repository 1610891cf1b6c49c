"""What hangs on walls: pictures, curtains, radiators.

Everything on a wall is built in the frame of its side (x into the room, y along the wall, z up) and then turned.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from semslam.sim.home import Array, Colour, Fixture, Look, Mesh, Part, Placed
from semslam.sim.palettes import Palette, RoomLooks, mixed
from semslam.sim.polygons import closer
from semslam.sim.shapes import box, merge, moved, picture_plane, rod, sheet, transformed
from semslam.sim.shell import Opening, Shell, Side

METAL = Look("metal", ((0.62, 0.62, 0.63),), 0.5, shine=0.6)
_CURTAIN_M = 0.13


@dataclass(frozen=True)
class Style:
    """What decides how a building is finished."""

    palette: Palette
    rooms: tuple[RoomLooks, ...]
    seed: int
    variant: str

    def rng(self, concern: int, *more: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, 0xB17D, concern, *more])

    def side_index(self, side: Side) -> int:
        """Number of a side's stream of randomness: opposite walls share one where the home is symmetric."""
        return side.index % 2 if self.variant == "symmetric" else side.index


def on_side(side: Side, parts: Iterable[tuple[Mesh, Look]]) -> tuple[Part, ...]:
    """Parts given in the frame of a side, in the world."""
    where = (side.x_m, side.y_m, 0.0)
    return tuple(Part(transformed(mesh, where, side.yaw_rad), look) for mesh, look in parts)


def hang(shell: Shell, style: Style, objects: Sequence[Placed], standing: Sequence[Array]) -> list[Fixture]:
    """Curtains, radiators and pictures, which leave out places where something stands before them.

    Args:
        standing: outlines of things that stand on the floor and are no objects.
    """
    if style.variant == "plain":
        return []
    fixtures: list[Fixture] = []
    for side in shell.sides:
        outlines = [item.footprint for item in objects] + list(standing)
        outlines += [shell.partition_outline(partition) for partition in shell.partitions]
        for k, opening in enumerate(side.openings):
            if opening.kind == "window":
                made = _curtains(side, opening, style, k, outlines)
                outlines += [fixture.footprint for fixture in made if fixture.footprint is not None]
                fixtures += made + _radiator(side, opening, style, k, outlines)
        fixtures += _pictures(side, shell, style, objects, standing)
    return fixtures


def _free(side: Side, low: float, high: float, depth_m: float, outlines: Sequence[Array]) -> bool:
    """True if nothing stands within a strip along the wall, which itself stays between the corners."""
    if max(-low, high) > side.length_m / 2 - 0.02:
        return False
    strip = side.strip(low, high, 0.0, depth_m)
    return not any(closer(strip, outline, 0.02) for outline in outlines)


def _curtains(side: Side, opening: Opening, style: Style, index: int, outlines: Sequence[Array]) -> list[Fixture]:
    """A pair of curtains to the floor, drawn open, on a rail."""
    rng = style.rng(3, side.room, style.side_index(side), index)
    (low, high), width = opening.ends_m, float(rng.uniform(0.28, 0.42))
    if rng.random() < 0.3 or not _doors_clear(side, low - width - 0.1, high + width + 0.1):
        return []
    stretches = [(low - width, low + 0.06), (high - 0.06, high + width)]
    if not all(_free(side, a, b, _CURTAIN_M, outlines) for a, b in stretches):
        return []
    cloth, top = _cloth(style, rng), opening.high_m + 0.14
    rail = rod((0.075, low - width - 0.05, top + 0.02), (0.075, high + width + 0.05, top + 0.02), 0.012)
    fixtures = [Fixture("curtain", on_side(side, [(rail, METAL)]))]
    for a, b in stretches:
        parts = [(_drape(a, b, 0.02, top, rng), cloth)]
        fixtures.append(Fixture("curtain", on_side(side, parts), side.strip(a, b, 0.0, _CURTAIN_M)))
    return fixtures


def _doors_clear(side: Side, low: float, high: float) -> bool:
    doors = [o for o in side.openings if o.kind != "window"]
    return all(high < o.ends_m[0] - 0.08 or low > o.ends_m[1] + 0.08 for o in doors)


def _cloth(style: Style, rng: np.random.Generator) -> Look:
    first, second = style.palette.cloth
    colour = (first, second)[int(rng.integers(2))]
    pattern = ("fabric", "fabric", "stripes", "floral")[int(rng.integers(4))]
    other = mixed(colour, style.palette.bright[2], 0.25) if pattern == "floral" else mixed(colour, (0, 0, 0), 0.18)
    return Look(pattern, (colour, other, mixed(colour, (1, 1, 1), 0.3)), 0.5, seed=int(rng.integers(50)))


def _drape(low: float, high: float, bottom: float, top: float, rng: np.random.Generator) -> Mesh:
    y = np.linspace(low, high, 33)
    fold = 0.030 * np.sin((y - low) / (high - low) * 2 * np.pi * float(rng.integers(4, 6)) + rng.uniform(0, 6))
    z = np.array([top, (top + bottom) / 2, bottom])
    x = 0.072 + fold[None] * np.array([0.8, 0.95, 1.15])[:, None]
    return sheet(np.stack([x, np.broadcast_to(y, x.shape), np.broadcast_to(z[:, None], x.shape)], -1))


def _radiator(side: Side, opening: Opening, style: Style, index: int, outlines: Sequence[Array]) -> list[Fixture]:
    """A ribbed radiator below a window."""
    rng = style.rng(4, side.room, style.side_index(side), index)
    half = min(opening.width_m / 2 - 0.1, 0.6)
    low, high = opening.along_m - half, opening.along_m + half
    if rng.random() < 0.35 or not _free(side, low, high, 0.14, outlines):
        return []
    places = [float(y) for y in np.arange(low, high - 0.05, 0.07)]
    ribs = [box((0.03, y, 0.14), (0.11, y + 0.055, 0.70), bevel_m=0.012) for y in places]
    foot = [box((0.05, y, 0.0), (0.09, y + 0.03, 0.15)) for y in (low + 0.1, high - 0.2)]
    look = Look("paint", ((0.90, 0.90, 0.88),), 1.0, shine=0.3)
    return [Fixture("radiator", on_side(side, [(merge([*ribs, *foot]), look)]), side.strip(low, high, 0.0, 0.12))]


def _pictures(
    side: Side, shell: Shell, style: Style, objects: Sequence[Placed], standing: Sequence[Array]
) -> list[Fixture]:
    """Framed pictures where the wall is free; in `repeating` homes the same one again and again."""
    rng = style.rng(5, side.room, style.side_index(side))
    same = style.variant == "repeating"
    if not same and rng.random() < 0.15:
        return []
    places = np.arange(-side.length_m / 2 + 0.75, side.length_m / 2 - 0.5, 1.25)
    size = (0.55, 0.7) if same else None
    fixtures: list[Fixture] = []
    wanted = len(places) if same else int(rng.integers(1, 4))
    taken: list[tuple[float, float]] = []
    for k in range(12 if not same else len(places)):
        width, height = size or (float(rng.uniform(0.35, 1.1)), float(rng.uniform(0.35, 0.75)))
        y = float(places[k]) if same else float(rng.uniform(-0.5, 0.5) * (side.length_m - width - 0.5))
        middle = 1.5 if same else 1.35 + height / 4 + float(rng.uniform(0, 0.12))
        ends = (y - width / 2 - 0.08, y + width / 2 + 0.08)
        if len(fixtures) >= wanted or any(ends[0] < b and ends[1] > a for a, b in taken):
            continue
        if not _bare_wall(side, shell, ends, middle - height / 2, objects, standing):
            continue
        taken.append(ends)
        fixtures.append(_picture(side, style, rng, (y, middle), (width, height), 0 if same else int(rng.integers(60))))
    return fixtures


def _bare_wall(
    side: Side,
    shell: Shell,
    ends: tuple[float, float],
    bottom_m: float,
    objects: Sequence[Placed],
    standing: Sequence[Array],
) -> bool:
    """True if a picture there is beside openings and curtains, and no tall thing stands right before it."""
    for opening in side.openings:
        margin = 0.5 if opening.kind == "window" else 0.1
        if ends[0] < opening.ends_m[1] + margin and ends[1] > opening.ends_m[0] - margin:
            return False
    strip = side.strip(*ends, 0.0, 0.12)
    tall = [item.footprint for item in objects if item.z_m + item.piece.height_m > bottom_m - 0.03] + list(standing)
    tall += [shell.partition_outline(partition) for partition in shell.partitions]
    return not any(closer(strip, outline, 0.0) for outline in tall)


def _picture(
    side: Side,
    style: Style,
    rng: np.random.Generator,
    place: tuple[float, float],
    size: tuple[float, float],
    seed: int,
) -> Fixture:
    (y, z), (width, height) = place, size
    edge, thick = 0.03, 0.024
    bars = [
        box((0.0, y - width / 2, z - height / 2), (thick, y - width / 2 + edge, z + height / 2)),
        box((0.0, y + width / 2 - edge, z - height / 2), (thick, y + width / 2, z + height / 2)),
        box((0.0, y - width / 2, z - height / 2), (thick, y + width / 2, z - height / 2 + edge)),
        box((0.0, y - width / 2, z + height / 2 - edge), (thick, y + width / 2, z + height / 2)),
    ]
    canvas = moved(picture_plane(width - edge, height - edge), (thick - 0.008, y, z))
    look = Look("painting", style.palette.bright, 1.0, seed=seed)
    frames: tuple[Colour, ...] = ((0.12, 0.11, 0.11), (0.93, 0.92, 0.90), style.palette.wood[1], (0.62, 0.48, 0.24))
    frame = Look("paint", (frames[0 if style.variant == "repeating" else int(rng.integers(4))],), 1.0, shine=0.2)
    return Fixture("picture", on_side(side, [(canvas, look), (merge(bars), frame)]))
