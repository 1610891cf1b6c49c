"""Walls, floors, ceilings, doors and windows, as fixtures in the world frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semslam.sim.hangings import METAL, Style, hang, on_side
from semslam.sim.home import Array, Fixture, Look, Mesh, Part, Placed
from semslam.sim.palettes import RoomLooks, mixed
from semslam.sim.shapes import box, merge, moved, picture_plane, rod, transformed
from semslam.sim.shell import Opening, Shell, Side, wall_pieces

SKIRTING_M = (0.012, 0.08)
"""Thickness and height of skirting boards; furniture keeps farther from walls than the former."""
_WAINSCOT_M = (0.007, 0.92)
_PANE_M = 0.09
"""How far glass lies behind the inner face of its wall."""


def build(shell: Shell, style: Style, objects: Sequence[Placed], standing: Sequence[Array]) -> list[Fixture]:
    """The building, finished.

    Args:
        standing: outlines of other things that stand on the floor.
    """
    fixtures = [_floor(shell, style, k) for k in range(len(shell.rooms))]
    fixtures += [_threshold(gap, style) for gap in shell.gaps]
    fixtures += [_ceiling(shell, style)]
    for side in shell.sides:
        looks = style.rooms[side.room]
        fixtures += _wall(side, shell.height_m, looks.walls[side.index])
        fixtures += _trim(side, looks)
        fixtures += [_door(side, o, style) for o in side.openings if o.kind == "door"]
        fixtures += [_doorway(side, o, looks.trim) for o in side.openings if o.kind == "doorway"]
        fixtures += [_window(side, o, style, k) for k, o in enumerate(side.openings) if o.kind == "window"]
    for partition in shell.partitions:
        outline = shell.partition_outline(partition)
        look = style.rooms[partition.room].walls[(partition.side + 1) % 4]
        side = shell.side(partition.room, partition.side)
        half = partition.thick_m / 2
        stub = _slab(
            (0.0, partition.along_m - half, 0.0), (partition.reach_m, partition.along_m + half, shell.height_m)
        )
        fixtures.append(Fixture("wall", on_side(side, [(stub, look)]), outline))
    return fixtures + hang(shell, style, objects, standing)


def _slab(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """A box whose texture hangs on the frame, not on the box, so that patterns run on from one box to the next."""
    mesh = box(low, high)
    axis = np.abs(mesh.normals).argmax(1)
    first, second = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]  # texture axes of faces along x, y, z
    rows = np.arange(len(axis))
    return replace(mesh, uv=np.column_stack([mesh.vertices[rows, first], mesh.vertices[rows, second]]))


def _floor(shell: Shell, style: Style, room: int) -> Fixture:
    low, high = shell.rooms[room].low, shell.rooms[room].high
    return Fixture("floor", _level(low, high, -0.05, 0.0, style.rooms[room].floor, style.variant == "symmetric"))


def _level(
    low: tuple[float, float], high: tuple[float, float], bottom_m: float, top_m: float, look: Look, twins: bool
) -> tuple[Part, ...]:
    """A horizontal slab; of twin halves the second is the first after half a turn, texture included."""
    if not twins:
        return (Part(_slab((*low, bottom_m), (*high, top_m)), look),)
    half = _slab((low[0], low[1], bottom_m), (0.0, high[1], top_m))
    return Part(half, look), Part(transformed(half, (0.0, 0.0, 0.0), math.pi), look)


def _threshold(gap: tuple[tuple[float, float], tuple[float, float]], style: Style) -> Fixture:
    look = Look("wood" if style.variant != "plain" else "plain", style.palette.wood, 0.8)
    return Fixture("floor", (Part(_slab((*gap[0], -0.05), (*gap[1], 0.0)), look),))


def _ceiling(shell: Shell, style: Style) -> Fixture:
    bounds = np.array([(*room.low, *room.high) for room in shell.rooms])
    low, high = bounds[:, :2].min(0) - 0.2, bounds[:, 2:].max(0) + 0.2
    corner = (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))
    top = shell.height_m
    return Fixture("ceiling", _level(*corner, top, top + 0.05, style.rooms[0].ceiling, style.variant == "symmetric"))


def _wall(side: Side, height_m: float, look: Look) -> list[Fixture]:
    """A side's wall, one fixture for every stretch between doorways, with what is above windows and doorways."""
    doorways = sorted((o.ends_m for o in side.openings if o.kind == "doorway"), key=lambda ends: ends[0])
    pieces = wall_pieces(side, height_m)
    edges = [pieces[0][0], *(end for ends in doorways for end in ends), max(piece[1] for piece in pieces)]
    fixtures = []
    for low, high in zip(edges[::2], edges[1::2], strict=True):
        mine = [p for p in pieces if p[0] >= low - 1e-9 and p[1] <= high + 1e-9]
        mesh = merge(_slab((-side.thick_m, a, z), (0.0, b, top)) for a, b, z, top in mine)
        fixtures.append(Fixture("wall", on_side(side, [(mesh, look)]), side.strip(low, high, -side.thick_m, 0.0)))
    over = [p for p in pieces if p[2] > 0 and any(abs(p[0] - ends[0]) < 1e-9 for ends in doorways)]
    for a, b, z, top in over:
        fixtures.append(Fixture("wall", on_side(side, [(_slab((-side.thick_m, a, z), (0.0, b, top)), look)])))
    return fixtures


def _stretches(side: Side, kinds: Sequence[str], margin_m: float, below_m: float = 9.0) -> list[tuple[float, float]]:
    """What remains of a side's length between openings of some kinds that begin below a height."""
    ends = sorted(o.ends_m for o in side.openings if o.kind in kinds and o.low_m < below_m)
    half = side.length_m / 2
    edges = [-half, *(value for low, high in ends for value in (low - margin_m, high + margin_m)), half]
    return [(low, high) for low, high in zip(edges[::2], edges[1::2], strict=True) if high - low > 0.02]


def _trim(side: Side, looks: RoomLooks) -> list[Fixture]:
    """Skirting board, and cladding of the lower wall where the room has it."""
    thick, high = SKIRTING_M
    runs = _stretches(side, ("door", "doorway"), 0.07)
    boards = [box((0.0, a, 0.0), (thick, b, high)) for a, b in runs]
    fixtures = [Fixture("skirting", on_side(side, [(merge(boards), looks.trim)]))] if boards else []
    if looks.wainscot is None:
        return fixtures
    thick, high = _WAINSCOT_M
    clad = [_slab((0.0, a, 0.0), (thick, b, high)) for a, b in runs]
    rail = [box((0.0, a, high), (0.02, b, high + 0.035)) for a, b in _stretches(side, _ALL_KINDS, 0.07, high + 0.1)]
    parts = [(merge(clad), looks.wainscot)] if clad else []
    return [*fixtures, Fixture("panelling", on_side(side, [*parts, (merge(rail), looks.trim)] if rail else parts))]


_ALL_KINDS = ("door", "doorway", "window")


def _frame(opening: Opening, width_m: float, thick_m: float, *, sill: bool) -> list[Mesh]:
    """Boards around an opening on the inner face of the wall."""
    (low, high), top = opening.ends_m, opening.high_m
    boards = [
        box((0.0, low - width_m, opening.low_m), (thick_m, low, top + width_m)),
        box((0.0, high, opening.low_m), (thick_m, high + width_m, top + width_m)),
        box((0.0, low, top), (thick_m, high, top + width_m)),
    ]
    if sill:
        boards.append(box((-_PANE_M, low - 0.05, opening.low_m - 0.03), (0.05, high + 0.05, opening.low_m)))
    return boards


def _door(side: Side, opening: Opening, style: Style) -> Fixture:
    """A closed door: leaf with raised panels, frame, handle."""
    (low, high), top = opening.ends_m, opening.high_m
    rng = style.rng(1, side.room, style.side_index(side))
    kind, look = int(rng.integers(3)), _door_look(style)
    leaf = [box((0.0, low, 0.005), (0.018, high, top))]
    for bottom, end in ((0.25, 0.95), (1.1, top - 0.15)) if kind == 0 else ((0.3, top - 0.3),) if kind == 1 else ():
        leaf.append(box((0.018, low + 0.13, bottom), (0.028, high - 0.13, end), bevel_m=0.006))
    grip = high - 0.08
    handle = [rod((0.018, grip, 1.02), (0.06, grip, 1.02), 0.01)]
    handle.append(rod((0.055, grip + 0.01, 1.02), (0.055, grip - 0.12, 1.02), 0.009))
    trim = style.rooms[side.room].trim
    parts = [(merge(leaf), look), (merge(_frame(opening, 0.07, 0.03, sill=False)), trim), (merge(handle), METAL)]
    return Fixture("door", on_side(side, parts), side.strip(low - 0.07, high + 0.07, 0.0, 0.065))


def _door_look(style: Style) -> Look:
    colour = style.palette.door
    if style.variant == "plain":
        return Look("plain", (colour,))
    bright = max(colour) > 0.75 or max(colour) - min(colour) < 0.05
    grain = (colour, mixed(colour, (0, 0, 0), 0.25))
    return Look("paint", (colour,), 1.5, shine=0.2) if bright else Look("wood", grain, 0.6)


def _doorway(side: Side, opening: Opening, trim: Look) -> Fixture:
    return Fixture("door", on_side(side, [(merge(_frame(opening, 0.07, 0.02, sill=False)), trim)]))


def _window(side: Side, opening: Opening, style: Style, index: int) -> Fixture:
    """Glass with the view, sash bars, frame and sill."""
    (low, high), bottom, top = opening.ends_m, opening.low_m, opening.high_m
    rng = style.rng(2, side.room, style.side_index(side), index)
    view = Look("outdoors", ((0.6, 0.75, 0.9),), 1.0, glow=0.55, seed=int(rng.integers(8)))
    glass = moved(picture_plane(high - low, top - bottom), (-_PANE_M, (low + high) / 2, (bottom + top) / 2))
    bars = _sash(low, high, bottom, top, int(rng.integers(1, 3)), bool(rng.random() < 0.4))
    trim = style.rooms[side.room].trim
    boards = _frame(opening, 0.05, 0.015, sill=True)
    return Fixture("window", on_side(side, [(glass, view), (merge([*bars, *boards]), trim)]))


def _sash(low: float, high: float, bottom: float, top: float, wings: int, crossbar: bool) -> list[Mesh]:
    near, far, wide = -_PANE_M, -_PANE_M + 0.04, 0.045
    bars = [box((near, low, z), (far, high, z + wide)) for z in (bottom, top - wide)]
    for y in np.linspace(low, high - wide, wings + 1):
        bars.append(box((near, float(y), bottom), (far, float(y) + wide, top)))
    if crossbar:
        z = bottom + 0.68 * (top - bottom)
        bars.append(box((near, low, z), (far - 0.01, high, z + 0.03)))
    return bars
