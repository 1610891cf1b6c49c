"""What all furniture is made of: palettes of materials, and the assembly of parts into a piece."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from semslam.sim.home import Array, Colour, Look, Mesh, Part, Piece, Top, Vector
from semslam.sim.shapes import merge, moved

T = TypeVar("T")

_VARIANTS = 4
"""Seeds of patterns: few, so that equal looks of different pieces can share a texture."""

WOODS: tuple[tuple[Colour, Colour], ...] = (
    ((0.82, 0.66, 0.46), (0.70, 0.53, 0.34)),  # birch
    ((0.74, 0.56, 0.36), (0.62, 0.44, 0.26)),  # oak
    ((0.63, 0.43, 0.25), (0.49, 0.31, 0.17)),  # cherry
    ((0.52, 0.33, 0.20), (0.38, 0.23, 0.13)),  # teak
    ((0.40, 0.25, 0.16), (0.28, 0.17, 0.11)),  # walnut
    ((0.29, 0.19, 0.14), (0.20, 0.13, 0.10)),  # wenge
)
LACQUERS: tuple[Colour, ...] = (
    (0.90, 0.89, 0.86),
    (0.93, 0.93, 0.92),
    (0.85, 0.82, 0.75),
    (0.60, 0.66, 0.66),
    (0.42, 0.49, 0.54),
    (0.17, 0.17, 0.18),
    (0.50, 0.58, 0.50),
)
FABRICS: tuple[Colour, ...] = (
    (0.55, 0.55, 0.56),
    (0.36, 0.38, 0.41),
    (0.69, 0.63, 0.54),
    (0.80, 0.76, 0.69),
    (0.44, 0.36, 0.30),
    (0.30, 0.38, 0.50),
    (0.24, 0.29, 0.39),
    (0.42, 0.49, 0.42),
    (0.54, 0.42, 0.38),
    (0.58, 0.33, 0.27),
    (0.32, 0.46, 0.48),
)
ACCENTS: tuple[Colour, ...] = (
    (0.78, 0.60, 0.22),
    (0.68, 0.26, 0.20),
    (0.20, 0.38, 0.58),
    (0.20, 0.47, 0.46),
    (0.74, 0.44, 0.28),
    (0.46, 0.55, 0.30),
    (0.52, 0.30, 0.42),
    (0.86, 0.82, 0.74),
)
LEATHERS: tuple[Colour, ...] = (
    (0.45, 0.26, 0.15),
    (0.31, 0.18, 0.12),
    (0.14, 0.13, 0.13),
    (0.62, 0.42, 0.26),
    (0.42, 0.15, 0.13),
    (0.26, 0.32, 0.26),
)
METALS: tuple[Colour, ...] = ((0.62, 0.63, 0.65), (0.75, 0.75, 0.76), (0.16, 0.16, 0.17), (0.70, 0.57, 0.34))
CERAMICS: tuple[Colour, ...] = (
    (0.92, 0.91, 0.88),
    (0.80, 0.78, 0.73),
    (0.30, 0.32, 0.35),
    (0.35, 0.48, 0.55),
    (0.55, 0.60, 0.50),
    (0.72, 0.60, 0.48),
)
LINENS: tuple[Colour, ...] = ((0.92, 0.91, 0.89), (0.86, 0.84, 0.80), (0.80, 0.84, 0.88), (0.88, 0.82, 0.78))
GREENS: tuple[tuple[Colour, Colour], ...] = (
    ((0.20, 0.42, 0.15), (0.12, 0.29, 0.10)),
    ((0.27, 0.47, 0.18), (0.17, 0.34, 0.12)),
    ((0.16, 0.36, 0.18), (0.09, 0.24, 0.12)),
    ((0.36, 0.50, 0.20), (0.22, 0.37, 0.13)),
)
APPLIANCES: tuple[Colour, ...] = (
    (0.93, 0.93, 0.92),
    (0.95, 0.95, 0.94),
    (0.70, 0.71, 0.73),
    (0.66, 0.67, 0.69),
    (0.20, 0.20, 0.22),
    (0.62, 0.74, 0.70),
    (0.66, 0.24, 0.20),
)

DARK = Look("plain", ((0.07, 0.07, 0.075),), shine=0.3)
"""Black plastic, rubber, gaps."""
WHITE = Look("plain", ((0.94, 0.94, 0.93),), shine=0.3)
"""White enamel or plastic."""
CHROME = Look("metal", ((0.78, 0.79, 0.80),), tile_m=0.5, shine=0.9)
STEEL = Look("metal", ((0.62, 0.63, 0.64),), tile_m=0.5, shine=0.6)
BLACK_STEEL = Look("plain", ((0.12, 0.12, 0.125),), shine=0.4)
BRASS = Look("metal", ((0.72, 0.58, 0.32),), tile_m=0.5, shine=0.8)


@dataclass(frozen=True)
class Palette:
    """Materials that go together: what the pieces of one room are made of."""

    wood: Look
    """Frames, tops, legs."""
    body: Look
    """Carcasses and fronts: the wood, another one, or lacquer."""
    fabric: Look
    """Covers, muted."""
    accent: Look
    """Throw pillows and the occasional chair: stronger colour or a pattern."""
    leather: Look
    metal: Look
    ceramic: Look
    linen: Look
    """Sheets and pillows of beds, lamp shades."""


def draw_palette(rng: Generator) -> Palette:
    """Draw materials that go together."""
    timber = wood(rng)
    bodies = (timber, timber, lacquer(rng), wood(rng))
    return Palette(
        wood=timber,
        body=pick(rng, bodies),
        fabric=fabric(rng),
        accent=accent(rng),
        leather=leather(rng),
        metal=metal(rng),
        ceramic=ceramic(rng),
        linen=linen(rng),
    )


def wood(rng: Generator) -> Look:
    """Oiled wood, from birch to wenge; its grain runs along the first texture axis (see `grained`)."""
    return Look("wood", pick(rng, WOODS), tile_m=uniform(rng, 0.35, 0.6), shine=uniform(rng, 0.1, 0.3), seed=_seed(rng))


def lacquer(rng: Generator) -> Look:
    """Painted wood, mostly light."""
    return Look("paint", (pick(rng, LACQUERS),), tile_m=1.0, shine=uniform(rng, 0.15, 0.4), seed=_seed(rng))


def fabric(rng: Generator) -> Look:
    """A muted cover."""
    colour = pick(rng, FABRICS)
    return Look("fabric", (colour, darker(colour, 0.78)), tile_m=0.25, seed=_seed(rng))


def accent(rng: Generator) -> Look:
    """A cover with a strong colour or a pattern."""
    colour = pick(rng, ACCENTS)
    if rng.random() < 0.55:
        return Look("fabric", (colour, darker(colour, 0.78)), tile_m=0.25, seed=_seed(rng))
    other, third = pick(rng, FABRICS), pick(rng, LINENS)
    pattern = pick(rng, ("stripes", "plaid", "dots", "floral", "lattice"))
    return Look(pattern, (colour, third, other), tile_m=uniform(rng, 0.3, 0.45), seed=_seed(rng))


def leather(rng: Generator) -> Look:
    """Hide, brown, black or dark red."""
    return Look("leather", (pick(rng, LEATHERS),), tile_m=0.6, shine=uniform(rng, 0.25, 0.45), seed=_seed(rng))


def metal(rng: Generator) -> Look:
    """Steel, black steel or brass."""
    return Look("metal", (pick(rng, METALS),), tile_m=0.5, shine=uniform(rng, 0.5, 0.8), seed=_seed(rng))


def ceramic(rng: Generator) -> Look:
    """Glazed ware: pots, lamp bases, vases."""
    return Look("paint", (pick(rng, CERAMICS),), tile_m=0.8, shine=uniform(rng, 0.4, 0.7), seed=_seed(rng))


def terracotta(rng: Generator) -> Look:
    """Fired clay."""
    colour = pick(rng, ((0.70, 0.38, 0.25), (0.64, 0.35, 0.24), (0.76, 0.48, 0.34)))
    return Look("plaster", (colour,), tile_m=0.5, seed=_seed(rng))


def wicker(rng: Generator) -> Look:
    """Basket weave, straw to brown."""
    colour = pick(rng, ((0.76, 0.60, 0.40), (0.62, 0.45, 0.28), (0.45, 0.31, 0.20), (0.80, 0.74, 0.64)))
    return Look("wicker", (colour, darker(colour, 0.6)), tile_m=uniform(rng, 0.3, 0.45), seed=_seed(rng))


def linen(rng: Generator) -> Look:
    """Light cloth for beds and lamp shades."""
    colour = pick(rng, LINENS)
    return Look("fabric", (colour, darker(colour, 0.9)), tile_m=0.3, seed=_seed(rng))


def foliage(rng: Generator) -> Look:
    """Leaves of some green."""
    return Look("foliage", pick(rng, GREENS), tile_m=uniform(rng, 0.25, 0.5), shine=0.2, seed=_seed(rng))


def appliance(rng: Generator) -> Look:
    """Enamel or steel of kitchen machines: mostly white and grey, now and then a colour."""
    chances = np.array([4.0, 4, 3, 3, 1, 1, 1])
    colour = APPLIANCES[int(rng.choice(len(APPLIANCES), p=chances / chances.sum()))]
    grey = max(colour) - min(colour) < 0.05 and 0.5 < colour[0] < 0.8
    if grey:
        return Look("metal", (colour,), tile_m=0.8, shine=0.6, seed=_seed(rng))
    return Look("paint", (colour,), tile_m=1.0, shine=0.5, seed=_seed(rng))


def plastic(colour: Colour, *, shine: float = 0.35) -> Look:
    """Moulded plastic of one colour."""
    return Look("plain", (colour,), shine=shine)


def darker(colour: Colour, factor: float) -> Colour:
    """A shade of a colour; a factor above 1 makes it lighter."""
    red, green, blue = (min(1.0, channel * factor) for channel in colour)
    return red, green, blue


def tinted(look: Look, factor: float) -> Look:
    """The same material in a darker or lighter shade."""
    return dataclasses.replace(look, colours=tuple(darker(colour, factor) for colour in look.colours))


def pick(rng: Generator, choices: Sequence[T]) -> T:
    """One of some things, each as likely."""
    return choices[int(rng.integers(len(choices)))]


def uniform(rng: Generator, low: float, high: float) -> float:
    """A number between two others, rounded to a tenth of a millimetre."""
    return round(float(rng.uniform(low, high)), 4)


def chance(rng: Generator, share: float) -> bool:
    """True in this share of cases."""
    return bool(rng.random() < share)


def _seed(rng: Generator) -> int:
    return int(rng.integers(_VARIANTS))


def piece(
    class_name: str,
    style: str,
    parts: Iterable[tuple[Mesh, Look]],
    *,
    tops: Sequence[Top] = (),
    footprint: ArrayLike | None = None,
) -> Piece:
    """Assemble a piece: parts of the same look become one, the middle of its extent comes to the origin.

    Args:
        class_name: as in `home.CLASSES`, or `person`.
        style: name of the style.
        parts: meshes and their looks, floor at z = 0, front towards +x.
        tops: level surfaces to stand things on, in the frame of the parts.
        footprint: outline (N, 2) of the projection on the floor, counter-clockwise, in the frame of the parts; None
            takes the convex hull.
    """
    by_look: dict[Look, list[Mesh]] = {}
    for mesh, look in parts:
        by_look.setdefault(look, []).append(mesh)
    joined = [(merge(meshes), look) for look, meshes in by_look.items()]
    points = np.concatenate([mesh.vertices[:, :2] for mesh, _ in joined]).astype(np.float64)
    outline = hull(points) if footprint is None else np.asarray(footprint, np.float64)
    middle = (outline.min(0) + outline.max(0)) / 2
    shift = (-middle[0], -middle[1], 0.0)
    height = max(float(mesh.vertices[:, 2].max()) for mesh, _ in joined)
    return Piece(
        class_name=class_name,
        style=style,
        parts=tuple(Part(moved(mesh, shift), look) for mesh, look in joined),
        footprint=outline - middle,
        height_m=height,
        tops=tuple(Top(top.z_m, _plus(top.low, shift), _plus(top.high, shift)) for top in tops),
    )


def _plus(place: tuple[float, float], shift: Vector) -> tuple[float, float]:
    return float(place[0] + shift[0]), float(place[1] + shift[1])


def hull(points: ArrayLike) -> Array:
    """(N, 2) convex hull of points, counter-clockwise, without corners that stand out by less than a millimetre."""
    ordered: Array = np.unique(np.round(np.asarray(points, np.float64), 4), axis=0)
    lower, upper = _chain(ordered), _chain(ordered[::-1])
    return np.array(lower[:-1] + upper[:-1])


def _chain(ordered: Array) -> list[Array]:
    """Half of a convex hull, over points in order of x."""
    line: list[Array] = []
    for point in ordered:
        while len(line) >= 2 and _stands_out(line[-2], line[-1], point) < 0.0:
            line.pop()
        line.append(point)
    return _thinned(line)


def _stands_out(before: Array, corner: Array, after: Array) -> float:
    """Distance of a corner to the right of the line from the point before to the one after; metres."""
    way, aside = after - before, corner - before
    return float((way[1] * aside[0] - way[0] * aside[1]) / max(float(np.hypot(*way)), 1e-9))


def _thinned(line: list[Array]) -> list[Array]:
    kept = line[:1]
    for corner, after in itertools.pairwise(line[1:]):
        if _stands_out(kept[-1], corner, after) > 0.001:
            kept.append(corner)
    return kept + line[-1:]
