"""Pieces that are placed together, in a frame of their own, and where the pieces come from."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semslam.sim.home import Array, Piece, turn
from semslam.sim.polygons import rectangle_at

MakePiece = Callable[[str, np.random.Generator, str | None], Piece]
"""Class, randomness, style or None."""
Misfit = Callable[[Piece], float]
"""0 where a piece is what is wanted, else by how much it is not."""


@dataclass(frozen=True, eq=False)
class Spot:
    """A piece and where it stands in some frame."""

    piece: Piece
    x_m: float
    y_m: float
    yaw_rad: float = 0.0
    z_m: float = 0.0
    wall: bool = False
    """True if its back belongs to a wall."""

    @property
    def footprint(self) -> Array:
        return np.asarray(self.piece.footprint @ turn(self.yaw_rad).T + (self.x_m, self.y_m))

    @property
    def top_m(self) -> float:
        return self.z_m + self.piece.height_m


@dataclass(frozen=True)
class Extra:
    """Something of the building that comes with a group: counter, screen wall, rug, mat."""

    kind: str
    x_m: float
    y_m: float
    yaw_rad: float
    depth_m: float
    width_m: float
    height_m: float

    @property
    def outline(self) -> Array:
        return rectangle_at(self.x_m, self.y_m, self.depth_m, self.width_m, self.yaw_rad)

    @property
    def solid(self) -> bool:
        return self.kind not in FLAT_EXTRAS


FLAT_EXTRAS = ("rug", "mat")


@dataclass(frozen=True, eq=False)
class Group:
    """Pieces that are placed together; `anchor` is wall, corner or free."""

    name: str
    anchor: str
    spots: tuple[Spot, ...]
    extras: tuple[Extra, ...] = ()
    clear: tuple[Array, ...] = ()
    """Floor in front of it that must stay empty."""

    def at(self, x_m: float, y_m: float, yaw_rad: float) -> Group:
        """The group with its frame there."""
        rotation = turn(yaw_rad)

        def place(x: float, y: float) -> tuple[float, float]:
            moved = rotation @ (x, y)
            return x_m + float(moved[0]), y_m + float(moved[1])

        spots = [
            replace(s, x_m=place(s.x_m, s.y_m)[0], y_m=place(s.x_m, s.y_m)[1], yaw_rad=s.yaw_rad + yaw_rad)
            for s in self.spots
        ]
        extras = [
            replace(e, x_m=place(e.x_m, e.y_m)[0], y_m=place(e.x_m, e.y_m)[1], yaw_rad=e.yaw_rad + yaw_rad)
            for e in self.extras
        ]
        clear = tuple(np.asarray(area @ rotation.T + (x_m, y_m)) for area in self.clear)
        return Group(self.name, self.anchor, tuple(spots), tuple(extras), clear)

    def mirrored(self) -> Group:
        """The group with left and right exchanged; pieces are turned, not mirrored themselves."""
        spots = tuple(replace(s, y_m=-s.y_m, yaw_rad=-s.yaw_rad) for s in self.spots)
        extras = tuple(replace(e, y_m=-e.y_m, yaw_rad=-e.yaw_rad) for e in self.extras)
        clear = tuple(np.asarray(area[::-1] * (1, -1)) for area in self.clear)
        return Group(self.name, self.anchor, spots, extras, clear)

    @property
    def solids(self) -> list[Array]:
        """Outlines of all that stands on the floor."""
        return [s.footprint for s in self.spots if s.z_m == 0] + [e.outline for e in self.extras if e.solid]


class Shop:
    """The pieces of one home, each made once however often the layout is tried again."""

    def __init__(self, seed: int, make: MakePiece) -> None:
        self._seed, self._make = seed, make
        self._made: dict[str, Piece] = {}

    def get(self, key: str, class_name: str, styles: tuple[str, ...] = (), misfit: Misfit | None = None) -> Piece:
        """The home's piece of that name, in one of some styles; of a few drawn the one that fits best."""
        if key not in self._made:
            self._made[key] = self._best(key, class_name, styles, misfit)
        return self._made[key]

    def _best(self, key: str, class_name: str, styles: tuple[str, ...], misfit: Misfit | None) -> Piece:
        drawn: list[Piece] = []
        for attempt in range(1 if misfit is None else _TRIES):
            rng = np.random.default_rng([self._seed, 0x51E0, zlib.crc32(key.encode()), attempt])
            style = styles[int(rng.integers(len(styles)))] if styles else None
            drawn.append(self._make(class_name, rng, style))
            if misfit is None or misfit(drawn[-1]) <= 0:
                return drawn[-1]
        return min(drawn, key=misfit or (lambda _: 0.0))


_TRIES = 5
