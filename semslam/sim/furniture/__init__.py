"""Parametric furniture: pieces of every class in several styles, drawn from a random generator.

Sizes, materials and details differ from draw to draw; the same generator state gives the same piece.
"""

from __future__ import annotations

from collections.abc import Callable

from numpy.random import Generator

from semslam.errors import SemslamError
from semslam.sim.furniture import appliances, beds, chairs, lamps, person, plants, sofas, storage, tables
from semslam.sim.furniture.common import Palette, draw_palette
from semslam.sim.home import Piece

Maker = Callable[[Generator, Palette], Piece]

MAKERS: dict[str, dict[str, Maker]] = {
    "chair": chairs.CHAIRS,
    "table": tables.TABLES,
    "sofa": sofas.SOFAS,
    "bed": beds.BEDS,
    "bookshelf": storage.BOOKSHELVES,
    "dresser": storage.DRESSERS,
    "plant": plants.PLANTS,
    "lamp": lamps.LAMPS,
    "tv": appliances.TVS,
    "bin": appliances.BINS,
    "refrigerator": appliances.REFRIGERATORS,
    "toilet": appliances.TOILETS,
}
"""Makers by class and style."""

STYLES: dict[str, tuple[str, ...]] = {name: tuple(makers) for name, makers in MAKERS.items()}
"""Styles by class."""


def make_piece(class_name: str, rng: Generator, style: str | None = None, *, palette: Palette | None = None) -> Piece:
    """Draw a piece of furniture.

    Args:
        class_name: one of `home.CLASSES`.
        rng: source of style, sizes, materials and details.
        style: one of the class's STYLES; None draws one.
        palette: materials of the room; None draws some.

    Raises:
        SemslamError: no such class or style.
    """
    makers = MAKERS.get(class_name)
    if makers is None:
        raise SemslamError(f"No furniture of class `{class_name}`", hint=f"Take one of {', '.join(MAKERS)}")
    if style is None:
        style = tuple(makers)[int(rng.integers(len(makers)))]
    if style not in makers:
        raise SemslamError(f"No style `{style}` of class `{class_name}`", hint=f"Take one of {', '.join(makers)}")
    return makers[style](rng, draw_palette(rng) if palette is None else palette)


def make_person(rng: Generator) -> Piece:
    """Draw a standing or walking adult; its class is `person`."""
    return person.make_person(rng)


__all__ = ["MAKERS", "STYLES", "Maker", "Palette", "draw_palette", "make_person", "make_piece"]
