"""Colours and materials of a building that go together: a home takes one palette and looks furnished by someone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semslam.sim.home import Colour, Look


@dataclass(frozen=True)
class Palette:
    """What walls, floor, doors and textiles of one home are made of."""

    name: str
    wall: Colour
    accent_wall: Colour
    """Of one wall that differs, or of wallpaper's pattern."""
    trim: Colour
    """Skirting, door and window frames."""
    door: Colour
    wood: tuple[Colour, Colour]
    """Floor boards and panelling: two shades."""
    tile: tuple[Colour, Colour]
    """Floor tiles and their joints."""
    cloth: tuple[Colour, Colour]
    """Curtains and carpet."""
    bright: tuple[Colour, Colour, Colour, Colour]
    """Rugs, pictures, small things."""


PALETTES: tuple[Palette, ...] = (
    Palette(
        "north",
        wall=(0.86, 0.86, 0.83),
        accent_wall=(0.45, 0.55, 0.60),
        trim=(0.94, 0.94, 0.92),
        door=(0.92, 0.92, 0.90),
        wood=((0.74, 0.60, 0.43), (0.62, 0.48, 0.32)),
        tile=((0.66, 0.67, 0.66), (0.48, 0.48, 0.47)),
        cloth=((0.72, 0.75, 0.76), (0.50, 0.56, 0.60)),
        bright=((0.25, 0.36, 0.45), (0.80, 0.78, 0.72), (0.66, 0.45, 0.32), (0.86, 0.70, 0.36)),
    ),
    Palette(
        "amber",
        wall=(0.88, 0.80, 0.66),
        accent_wall=(0.72, 0.48, 0.28),
        trim=(0.93, 0.90, 0.84),
        door=(0.55, 0.37, 0.22),
        wood=((0.50, 0.33, 0.20), (0.38, 0.24, 0.14)),
        tile=((0.70, 0.50, 0.36), (0.52, 0.40, 0.32)),
        cloth=((0.78, 0.62, 0.40), (0.60, 0.38, 0.24)),
        bright=((0.60, 0.20, 0.14), (0.88, 0.76, 0.52), (0.25, 0.28, 0.34), (0.82, 0.52, 0.20)),
    ),
    Palette(
        "sage",
        wall=(0.74, 0.79, 0.69),
        accent_wall=(0.40, 0.50, 0.38),
        trim=(0.92, 0.92, 0.87),
        door=(0.88, 0.87, 0.80),
        wood=((0.60, 0.46, 0.31), (0.48, 0.35, 0.22)),
        tile=((0.72, 0.70, 0.62), (0.55, 0.53, 0.46)),
        cloth=((0.82, 0.80, 0.70), (0.50, 0.58, 0.44)),
        bright=((0.32, 0.42, 0.30), (0.86, 0.82, 0.70), (0.70, 0.42, 0.30), (0.84, 0.68, 0.38)),
    ),
    Palette(
        "harbour",
        wall=(0.68, 0.76, 0.82),
        accent_wall=(0.24, 0.36, 0.50),
        trim=(0.93, 0.94, 0.95),
        door=(0.90, 0.91, 0.92),
        wood=((0.64, 0.55, 0.45), (0.50, 0.42, 0.34)),
        tile=((0.58, 0.62, 0.66), (0.42, 0.45, 0.48)),
        cloth=((0.84, 0.84, 0.80), (0.34, 0.46, 0.60)),
        bright=((0.16, 0.28, 0.44), (0.88, 0.88, 0.84), (0.72, 0.24, 0.20), (0.46, 0.62, 0.72)),
    ),
    Palette(
        "sand",
        wall=(0.84, 0.79, 0.70),
        accent_wall=(0.58, 0.50, 0.40),
        trim=(0.93, 0.92, 0.88),
        door=(0.68, 0.54, 0.38),
        wood=((0.68, 0.54, 0.38), (0.56, 0.43, 0.29)),
        tile=((0.76, 0.71, 0.62), (0.60, 0.56, 0.49)),
        cloth=((0.88, 0.85, 0.78), (0.66, 0.58, 0.48)),
        bright=((0.44, 0.34, 0.26), (0.90, 0.85, 0.74), (0.36, 0.46, 0.46), (0.78, 0.56, 0.36)),
    ),
    Palette(
        "terracotta",
        wall=(0.85, 0.70, 0.59),
        accent_wall=(0.66, 0.36, 0.25),
        trim=(0.92, 0.88, 0.82),
        door=(0.44, 0.30, 0.20),
        wood=((0.46, 0.31, 0.20), (0.35, 0.23, 0.14)),
        tile=((0.64, 0.40, 0.30), (0.50, 0.36, 0.30)),
        cloth=((0.86, 0.78, 0.66), (0.62, 0.34, 0.26)),
        bright=((0.52, 0.20, 0.14), (0.90, 0.80, 0.64), (0.22, 0.38, 0.40), (0.84, 0.60, 0.28)),
    ),
    Palette(
        "rose",
        wall=(0.84, 0.74, 0.74),
        accent_wall=(0.56, 0.36, 0.42),
        trim=(0.94, 0.92, 0.91),
        door=(0.93, 0.90, 0.89),
        wood=((0.58, 0.42, 0.30), (0.45, 0.31, 0.21)),
        tile=((0.70, 0.66, 0.66), (0.52, 0.48, 0.48)),
        cloth=((0.80, 0.70, 0.70), (0.54, 0.36, 0.42)),
        bright=((0.44, 0.22, 0.30), (0.90, 0.82, 0.80), (0.36, 0.42, 0.50), (0.80, 0.60, 0.46)),
    ),
    Palette(
        "loft",
        wall=(0.70, 0.70, 0.69),
        accent_wall=(0.58, 0.34, 0.26),
        trim=(0.24, 0.24, 0.25),
        door=(0.30, 0.30, 0.31),
        wood=((0.42, 0.33, 0.26), (0.32, 0.25, 0.19)),
        tile=((0.46, 0.46, 0.45), (0.34, 0.34, 0.34)),
        cloth=((0.56, 0.56, 0.57), (0.32, 0.33, 0.36)),
        bright=((0.20, 0.20, 0.22), (0.78, 0.76, 0.72), (0.74, 0.46, 0.18), (0.34, 0.44, 0.48)),
    ),
)

_PAPERS = ("stripes", "damask", "floral", "lattice", "dots")


@dataclass(frozen=True)
class RoomLooks:
    """Surfaces of one room: a look for each of its walls, and what else it is finished with."""

    walls: tuple[Look, Look, Look, Look]
    floor: Look
    ceiling: Look
    trim: Look
    wainscot: Look | None
    """Cladding of the lower walls, None without."""


def draw_palette(seed: int) -> Palette:
    """The palette of a home."""
    rng = np.random.default_rng([seed, 0xC01])
    return PALETTES[int(rng.integers(len(PALETTES)))]


def draw_room(palette: Palette, seed: int, variant: str, room: int, purpose: str) -> RoomLooks:
    """Finish of a room; `plain` homes have one bare colour, `repeating` ones a single paper with a strong repeat."""
    rng = np.random.default_rng([seed, 0xC02, room])
    trim, ceiling = Look("paint", (palette.trim,), 1.5), Look("paint", ((0.93, 0.93, 0.91),), 2.5, glow=0.32)
    if variant == "plain":
        bare, ground = Look("plain", (palette.wall,)), Look("plain", (palette.wood[0],))
        return RoomLooks((bare,) * 4, ground, ceiling, Look("plain", (palette.trim,)), None)
    floor = _floor(palette, rng, purpose)
    if variant == "repeating":
        paper = _repeating(palette, seed)
        return RoomLooks((paper,) * 4, floor, ceiling, trim, None)
    walls = _walls(palette, rng, twins=variant == "symmetric")
    wainscot = _wainscot(palette, rng) if rng.random() < 0.3 else None
    return RoomLooks(walls, floor, ceiling, trim, wainscot)


def mixed(first: Colour, second: Colour, share: float) -> Colour:
    """Between two colours: 0 is the first."""
    red, green, blue = (a + (b - a) * share for a, b in zip(first, second, strict=True))
    return red, green, blue


_DEEPER = 0.12
"""Floors are darker than their material elsewhere: all lamps shine straight on them."""


def _floor(palette: Palette, rng: np.random.Generator, purpose: str) -> Look:
    wet = any(word in purpose for word in ("kitchen", "bath")) and purpose != "home"
    kinds = ("tiles", "checker", "tiles") if wet else ("planks", "planks", "parquet", "tiles", "carpet")
    kind, salt = kinds[int(rng.integers(len(kinds)))], int(rng.integers(1000))
    wood = mixed(palette.wood[0], (0, 0, 0), _DEEPER), mixed(palette.wood[1], (0, 0, 0), _DEEPER)
    if kind == "planks":
        return Look("planks", wood, float(rng.uniform(1.2, 1.7)), shine=0.12, seed=salt)
    if kind == "parquet":
        return Look("parquet", wood, float(rng.uniform(0.9, 1.3)), shine=0.15, seed=salt)
    if kind == "carpet":
        second = mixed(palette.cloth[1], palette.wood[0], 0.35)
        return Look("carpet", (second, mixed(second, (0, 0, 0), 0.2)), 1.0, seed=salt)
    first, second = (mixed(colour, (0, 0, 0), _DEEPER) for colour in palette.tile)
    colours = (first, second) if kind == "tiles" else (first, mixed(first, second, 0.8))
    return Look(kind, colours, float(rng.uniform(1.0, 1.5)), shine=0.2, seed=salt)


def _walls(palette: Palette, rng: np.random.Generator, *, twins: bool) -> tuple[Look, Look, Look, Look]:
    """Mostly one finish all around; one wall (with its opposite, if there are twins) may differ."""
    common = _common(palette, rng)
    walls = [common] * 4
    if rng.random() < 0.65:
        k, accent = int(rng.integers(4)), _accent(palette, rng)
        for each in (k, (k + 2) % 4) if twins else (k,):
            walls[each] = accent
    return walls[0], walls[1], walls[2], walls[3]


def _common(palette: Palette, rng: np.random.Generator) -> Look:
    kind, salt = float(rng.random()), int(rng.integers(1000))
    if kind < 0.45:
        return Look("paint", (palette.wall,), 2.0, seed=salt)
    if kind < 0.75:
        return Look("plaster", (palette.wall,), 1.6, seed=salt)
    return _paper(palette, rng, salt, 0.16)


def _paper(palette: Palette, rng: np.random.Generator, salt: int, contrast: float) -> Look:
    pattern = _PAPERS[int(rng.integers(len(_PAPERS)))]
    second = mixed(palette.wall, palette.accent_wall, contrast + float(rng.uniform(0, 0.15)))
    third = mixed(palette.wall, palette.bright[2], contrast + 0.1)
    return Look(pattern, (palette.wall, second, third), float(rng.uniform(0.5, 0.9)), seed=salt)


def _accent(palette: Palette, rng: np.random.Generator) -> Look:
    kind, salt = int(rng.integers(4)), int(rng.integers(1000))
    if kind == 0:
        return Look("paint", (palette.accent_wall,), 2.0, seed=salt)
    if kind == 1:
        warm = mixed((0.60, 0.36, 0.27), palette.accent_wall, 0.3)
        return Look("brick", (warm, mixed(warm, (0.85, 0.82, 0.78), 0.6)), 1.0, seed=salt)
    if kind == 2:
        return Look("planks", palette.wood, 1.1, shine=0.05, seed=salt)
    return _paper(palette, rng, salt, 0.45)


def _wainscot(palette: Palette, rng: np.random.Generator) -> Look:
    salt = int(rng.integers(1000))
    if rng.random() < 0.5:
        return Look("planks", palette.wood, 0.8, shine=0.08, seed=salt)
    return Look("paint", (mixed(palette.wall, palette.accent_wall, 0.5),), 1.5, seed=salt)


def _repeating(palette: Palette, seed: int) -> Look:
    """A paper or tile so regular that every half metre of wall looks like the next."""
    rng = np.random.default_rng([seed, 0xC03])
    pattern = ("lattice", "dots", "checker", "floral", "damask")[int(rng.integers(5))]
    colours = (palette.wall, mixed(palette.wall, palette.accent_wall, 0.8), palette.bright[2])
    return Look(pattern, colours, 0.6, seed=0)
