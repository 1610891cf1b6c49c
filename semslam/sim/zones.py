"""Furniture that belongs together: a sofa that faces its tv, a table with chairs, a bed with its tables.

A group stands in a frame of its own: at the foot of a wall (x into the room, y along the wall), in a corner (the same,
the corner at y = 0), or about its own middle. Where it goes is decided in `furnish.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from semslam.sim.groups import Extra, Group, Shop, Spot
from semslam.sim.home import Piece, turn
from semslam.sim.polygons import area_m2, closer, gap_m, rectangle_at

TUCK_M = 0.12
"""How far a chair at most reaches under its table."""

CHAIRS = ("ladder", "spindle", "shell", "upholstered")
SOFAS = ("classic", "modern", "corner", "chesterfield")
LAMPS = ("drum", "turned", "tripod", "globe", "reading")
SLIM_PLANTS = ("snake", "rubber", "bush", "dragon_tree")


def between(value: float, low: float, high: float) -> float:
    """How far a value is outside a range."""
    return max(low - value, value - high, 0.0)


def oblong(piece: Piece) -> bool:
    """True if the footprint fills its bounding rectangle: not round, not L-shaped."""
    return area_m2(piece.footprint) > 0.9 * piece.depth_m * piece.width_m


def living(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """A tv on its bench at the wall, a sofa that faces it, a table between them on a rug, a lamp at the sofa's side."""
    bench = shop.get(key + "bench", "dresser", ("bench", "bench", "sideboard"))
    tv = shop.get(key + "tv", "tv", (), lambda piece: between(piece.width_m, 0.4, bench.width_m + 0.1))
    sofa = shop.get(key + "sofa", "sofa", SOFAS)
    table = shop.get(key + "coffee", "table", ("coffee",))
    lamp = shop.get(key + "lamp", "lamp", LAMPS)
    plant = shop.get(key + "plant", "plant", SLIM_PLANTS)
    view_m = float(rng.uniform(1.7, 1.9)) if compact else float(rng.uniform(2.0, 2.7))
    away = bench.depth_m + view_m + sofa.depth_m / 2
    stand = _at_wall(bench, rng)
    spots = [stand, _tv_at(tv, stand, rng), Spot(sofa, away, 0.0, math.pi)]
    table_x = _nearest_free(table, spots[2], -1.0, 0.32)
    spots.append(Spot(table, table_x, float(rng.uniform(-0.08, 0.08)), _quarter(table)))
    hand = float(rng.choice([-1, 1]))
    spots.append(Spot(lamp, away + 0.1, hand * (sofa.width_m / 2 + lamp.width_m / 2 + 0.12), math.pi))
    if not compact:
        spots.append(_at_wall(plant, rng, hand * (bench.width_m / 2 + plant.width_m / 2 + 0.2)))
        spots += _armchair(shop, key, rng, table_x, -hand, table)
    rug_x = (table_x + away - sofa.depth_m / 2) / 2 - 0.15
    rug = Extra("rug", rug_x, 0.0, 0.0, 1.7, min(sofa.width_m + 0.4, 2.6), 0.007)
    view = rectangle_at((bench.depth_m + table_x - 0.5) / 2 + 0.1, 0.0, max(table_x - 0.5 - bench.depth_m, 0.4), 1.0)
    return Group("living", "wall", _settled(spots), (rug,), (view,))


def _tv_at(tv: Piece, bench: Spot, rng: np.random.Generator) -> Spot:
    """On the bench, or, if it is made for that, on the wall above."""
    if tv.style != "wall":
        return _on_top(tv, bench)
    over = bench.top_m + float(rng.uniform(0.2, 0.4))
    return Spot(tv, tv.depth_m / 2 + 0.025, 0.0, 0.0, over, wall=True)


def _armchair(shop: Shop, key: str, rng: np.random.Generator, table_x: float, hand: float, table: Piece) -> list[Spot]:
    """Sometimes a seat at the side of the coffee table, turned half towards the tv."""
    if rng.random() < 0.4:
        return []
    seat = shop.get(key + "armchair", "sofa", ("armchair",))
    y = hand * (table.width_m / 2 + seat.depth_m / 2 + 0.4)
    return [Spot(seat, table_x - 0.1, y, -hand * math.pi / 2 - hand * float(rng.uniform(0.1, 0.5)))]


def dining(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """A table with equal chairs pushed towards it, one of them sometimes pulled out."""
    table = shop.get(key + "table", "table", ("dining", "pedestal", "trestle"))
    chair = shop.get(key + "chair", "chair", CHAIRS)
    count = int(rng.integers(2, 4 if compact else 7))
    places = _seats_long(table, chair) if oblong(table) else _seats_round(table, chair, count)
    order = rng.permutation(len(places))[:count] if len(places) > 4 or count < 4 else range(min(count, len(places)))
    spots = [Spot(table, 0.0, 0.0)]
    pulled = int(rng.integers(0, 2 * len(places)))
    for index in sorted(int(k) for k in order):
        angle, along, reach = places[index]
        gap = float(rng.uniform(0.25, 0.4)) if index == pulled else -float(rng.uniform(0.03, TUCK_M))
        x, y = turn(angle) @ (reach + chair.depth_m / 2 + gap, along)
        swing = float(rng.uniform(-0.12, 0.12)) * (3 if index == pulled else 0.4)
        spots.append(Spot(chair, float(x), float(y), angle + math.pi + swing))
    return Group("dining", "free", _settled(spots))


def _seats_long(table: Piece, chair: Piece) -> list[tuple[float, float, float]]:
    """Places at an oblong table: (direction from its middle, offset to the left, distance of the edge)."""
    per_side = max(1, min(3, int(table.width_m // (chair.width_m + 0.18))))
    offsets = (np.arange(per_side) - (per_side - 1) / 2) * (table.width_m / per_side)
    places = [(angle, float(y), table.depth_m / 2) for y in offsets for angle in (0.0, math.pi)]
    if table.depth_m > chair.width_m + 0.25:
        places += [(angle, 0.0, table.width_m / 2) for angle in (math.pi / 2, -math.pi / 2)]
    return places


def _seats_round(table: Piece, chair: Piece, count: int) -> list[tuple[float, float, float]]:
    reach = min(table.depth_m, table.width_m) / 2
    room = int(2 * math.pi * (reach + chair.depth_m / 2) // (chair.width_m + 0.25))
    seats = max(2, min(count, room))
    angles = [2 * math.pi * k / seats for k in range(seats)]
    edges = [float((table.footprint @ (math.cos(angle), math.sin(angle))).max()) for angle in angles]
    return [(angle, 0.0, edge) for angle, edge in zip(angles, edges, strict=True)]


def sleeping(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """A bed with its head at the wall, small tables beside it, a lamp next to one of them, a rug at its foot."""
    bed = shop.get(key + "bed", "bed")
    kind = ("table", "side") if rng.random() < 0.4 else ("dresser", "nightstand")
    stand = shop.get(key + "bedside", kind[0], kind[1:])
    lamp = shop.get(key + "bedlamp", "lamp", LAMPS)
    spots = [_at_wall(bed, rng)]
    hand = float(rng.choice([-1, 1]))
    side = bed.width_m / 2 + stand.width_m / 2 + 0.08
    spots += [
        _at_wall(stand, rng, each * side) for each in ((hand,) if compact or rng.random() < 0.4 else (hand, -hand))
    ]
    spots.append(_at_wall(lamp, rng, hand * (side + stand.width_m / 2 + lamp.width_m / 2 + 0.06)))
    rug = Extra("rug", bed.depth_m * 0.75, 0.0, 0.0, 1.4, bed.width_m + 1.1, 0.007)
    beside = [rectangle_at(bed.depth_m * 0.6, h * (bed.width_m / 2 + 0.35), bed.depth_m * 0.6, 0.6) for h in (1, -1)]
    foot = rectangle_at(bed.depth_m + 0.35, 0.0, 0.6, bed.width_m)
    return Group("sleeping", "wall", _settled(spots), (rug,) if rng.random() < 0.7 else (), (*beside[:1], foot))


def kitchen(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """In a corner: refrigerator, a counter beside it, a bin at its end."""
    fridge = shop.get(key + "fridge", "refrigerator")
    bin_ = shop.get(key + "bin", "bin", ("pedal", "swing"))
    length = float(rng.uniform(0.9, 1.2)) if compact else float(rng.uniform(1.5, 2.4))
    depth = 0.6
    fridge_y = fridge.width_m / 2 + float(rng.uniform(0.03, 0.08))
    counter_y = fridge_y + fridge.width_m / 2 + 0.03 + length / 2
    spots = [_at_wall(fridge, rng, fridge_y)]
    spots.append(_at_wall(bin_, rng, counter_y + length / 2 + bin_.width_m / 2 + 0.08))
    counter = Extra("counter", depth / 2 + 0.001, counter_y, 0.0, depth, length, 0.9)
    end = counter_y + length / 2
    reach = max(fridge.depth_m, depth)
    front = rectangle_at(reach + 0.45, end / 2 + 0.05, 0.8, end - 0.1)
    return Group("kitchen", "corner", _settled(spots), (counter,), (front,))


def study(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """A desk at the wall with its chair, a bin and bookshelves beside it."""
    table = shop.get(key + "desk", "table", ("desk",))
    chair = shop.get(key + "deskchair", "chair", ("office", "office", "shell"))
    bin_ = shop.get(key + "paperbin", "bin", ("basket", "wire", "wicker"))
    hand = float(rng.choice([-1, 1]))
    board = _at_wall(table, rng)
    out = board.x_m + table.depth_m / 2 + chair.depth_m / 2 - float(rng.uniform(0.03, TUCK_M))
    y = float(rng.uniform(-0.12, 0.12))
    spots = [board, Spot(chair, out, y, math.pi + float(rng.uniform(-0.05, 0.05)))]
    spots.append(_at_wall(bin_, rng, hand * (table.width_m / 2 + bin_.width_m / 2 + 0.08)))
    edge = table.width_m / 2 + 0.12
    for k in range(0 if compact else int(rng.integers(1, 3))):
        shelf = shop.get(f"{key}shelf{k}", "bookshelf")
        spots.append(_at_wall(shelf, rng, -hand * (edge + shelf.width_m / 2)))
        edge += shelf.width_m + 0.04
    front = rectangle_at(out + chair.depth_m / 2 + 0.2, 0.0, 0.4, 0.8)
    return Group("study", "wall", _settled(spots), (), (front,))


def bath(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """In a corner: a toilet behind a low screen wall, a washstand, a bin and a mat."""
    toilet = shop.get(key + "toilet", "toilet")
    bin_ = shop.get(key + "bathbin", "bin", ("pedal", "wicker", "basket"))
    y = float(rng.uniform(0.2, 0.3)) + toilet.width_m / 2
    spots = [_at_wall(toilet, rng, y)]
    side = y + toilet.width_m / 2 + float(rng.uniform(0.15, 0.25))
    spots.append(_at_wall(bin_, rng, side + bin_.width_m / 2 - 0.05))
    side += bin_.width_m + 0.1
    extras = [] if compact else [Extra("washstand", 0.24, side + 0.35, 0.0, 0.46, 0.6, 0.86)]
    side += 0.1 if compact else 0.85
    if rng.random() < 0.75:
        extras.append(Extra("screen", 0.75, side + 0.04, 0.0, 1.5, 0.08, float(rng.uniform(1.0, 1.5))))
    extras.append(Extra("mat", toilet.depth_m + 0.4, y, 0.0, 0.5, 0.75, 0.006))
    front = rectangle_at(toilet.depth_m + 0.45, side / 2, 0.8, side - 0.15)
    return Group("bath", "corner", _settled(spots), tuple(extras), (front,))


def reading_corner(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """An armchair turned out of a corner, with a floor lamp beside it."""
    seat = shop.get(key + "seat", "sofa", ("armchair",))
    lamp = shop.get(key + "cornerlamp", "lamp", LAMPS)
    yaw = math.pi / 4 + float(rng.uniform(-0.2, 0.2))
    reach = math.hypot(seat.depth_m, seat.width_m) / 2
    spots = [Spot(seat, reach + 0.15, reach + 0.15, yaw)]
    if not compact:
        along = 2 * reach + 0.3 + lamp.width_m / 2
        spots.append(Spot(lamp, lamp.depth_m / 2 + 0.05, along, 0.0, wall=True))
    return Group("reading", "corner", _settled(spots))


def lounge(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """Two seats that face each other over a low table on a rug, in the open."""
    table = shop.get(key + "lounge", "table", ("coffee", "side"))
    seat = shop.get(key + "loungeseat", "sofa", ("armchair",))
    out = table.depth_m / 2 + seat.depth_m / 2 + float(rng.uniform(0.3, 0.4))
    spots = [Spot(table, 0.0, 0.0)]
    for angle in (0.0,) if compact else (0.0, math.pi) if rng.random() < 0.7 else (0.0, math.pi / 2):
        reach = out if angle in (0.0, math.pi) else out + (table.width_m - table.depth_m) / 2
        x, y = turn(angle) @ (reach, float(rng.uniform(-0.1, 0.1)))
        spots.append(Spot(seat, float(x), float(y), angle + math.pi + float(rng.uniform(-0.2, 0.2))))
    rug = Extra("rug", 0.0, 0.0, 0.0, 2 * out - 0.2, max(table.width_m + 0.5, 1.3), 0.007)
    return Group("lounge", "free", tuple(spots), (rug,))


def single(shop: Shop, key: str, class_name: str, rng: np.random.Generator, styles: tuple[str, ...] = ()) -> Group:
    """One piece with its back to the wall, and room in front of it where it has doors or drawers."""
    piece = shop.get(key, class_name, styles)
    spot = _at_wall(piece, rng)
    opens = class_name in ("dresser", "bookshelf", "refrigerator", "chair")
    front = rectangle_at(piece.depth_m + 0.35, 0.0, 0.6, piece.width_m)
    return Group(class_name, "wall", (spot,), (), (front,) if opens else ())


def in_corner(shop: Shop, key: str, class_name: str, rng: np.random.Generator, styles: tuple[str, ...] = ()) -> Group:
    """One small thing in a corner."""
    piece = shop.get(key, class_name, styles)
    gap = float(rng.uniform(0.03, 0.12))
    spot = Spot(piece, piece.depth_m / 2 + gap, piece.width_m / 2 + gap + 0.03, 0.0, wall=True)
    return Group(class_name, "corner", (spot,))


def chest(shop: Shop, key: str, rng: np.random.Generator, compact: bool) -> Group:
    """A chest of drawers or a wardrobe at the wall."""
    styles = ("chest",) if compact else ("chest", "wardrobe", "sideboard")
    dresser = shop.get(key + "chest" * compact + "dresser", "dresser", styles)
    spots = [_at_wall(dresser, rng)]
    front = rectangle_at(dresser.depth_m + 0.4, 0.0, 0.7, dresser.width_m)
    return Group("chest", "wall", tuple(spots), (), (front,))


MakeGroup = Callable[[Shop, str, np.random.Generator, bool], Group]
"""Pieces, prefix of their names, randomness, whether to be small."""

GROUPS: dict[str, MakeGroup] = {
    "living": living,
    "sleeping": sleeping,
    "kitchen": kitchen,
    "bath": bath,
    "study": study,
    "dining": dining,
    "chest": chest,
    "lounge": lounge,
    "reading": reading_corner,
}
"""Groups by name."""


def _at_wall(piece: Piece, rng: np.random.Generator, along_m: float = 0.0) -> Spot:
    """With its back to the wall, clear of the skirting board."""
    return Spot(piece, piece.depth_m / 2 + float(rng.uniform(0.016, 0.04)), along_m, 0.0, wall=True)


def _on_top(piece: Piece, below: Spot, forward: float = 0.0, left: float = 0.0) -> Spot:
    """A piece on the highest top of another; `forward` and `left` are shares of the space left there, -1 to 1."""
    top = max(below.piece.tops, key=lambda top: top.z_m)
    middle = (np.array(top.low) + top.high) / 2
    spare = np.maximum((np.subtract(top.high, top.low) - (piece.depth_m, piece.width_m)) / 2 - 0.01, 0)
    x, y = turn(below.yaw_rad) @ (middle + spare * (forward, left))
    return Spot(piece, below.x_m + float(x), below.y_m + float(y), below.yaw_rad, below.z_m + top.z_m, below.wall)


def _nearest_free(piece: Piece, seat: Spot, direction: float, gap: float) -> float:
    """Where along x, from a seat in that direction, a piece first is `gap` away from it."""
    x = seat.x_m
    for _ in range(60):
        x += direction * 0.05
        outline = Spot(piece, x, 0.0, _quarter(piece)).footprint
        if not closer(outline, seat.footprint, gap):
            break
    return x


def _quarter(piece: Piece) -> float:
    """The yaw that lays the longer side of a table along y."""
    return math.pi / 2 if piece.depth_m > piece.width_m else 0.0


def _settled(spots: list[Spot]) -> tuple[Spot, ...]:
    """The spots without those that would stand in an earlier one; what stands on tops goes with what is below."""
    kept: list[Spot] = []
    for spot in spots:
        if spot.z_m > 0 or all(_side_by_side(spot, other) for other in kept if other.z_m == 0):
            kept.append(spot)
    return tuple(kept)


def _side_by_side(first: Spot, second: Spot) -> bool:
    names = {first.piece.class_name, second.piece.class_name}
    if names == {"chair", "table"} and first.piece.height_m > 0.5:
        return True  # pushed under it, by construction no further than TUCK_M
    return gap_m(first.footprint, second.footprint) > 0.025
