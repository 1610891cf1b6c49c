"""Homes make sense: furniture stands where furniture stands, nothing overlaps, and a robot gets about."""

from __future__ import annotations

import math
from functools import cache
from itertools import combinations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.sim.home import CLASSES, LIGHTS, Array, Fixture, Home, Look, Part, Piece, Placed, Top
from semslam.sim.layout import VARIANTS, blocked_polygons, free_raster, make_home
from semslam.sim.plan import CLASS_COLOURS, draw_plan
from semslam.sim.polygons import distances_m, gap_m, inside
from semslam.sim.shapes import box, ellipse, rectangle

SIZES: dict[str, tuple[float, float, float]] = {
    "chair": (0.54, 0.50, 0.92),
    "office": (0.62, 0.60, 1.02),
    "sofa": (0.95, 1.95, 0.88),
    "corner": (1.65, 2.3, 0.88),
    "armchair": (0.95, 0.90, 0.88),
    "bed": (2.2, 1.75, 1.05),
    "bookshelf": (0.32, 0.85, 1.8),
    "dresser": (0.48, 0.90, 1.0),
    "bench": (0.44, 1.40, 0.5),
    "sideboard": (0.48, 1.40, 0.8),
    "nightstand": (0.43, 0.47, 0.55),
    "wardrobe": (0.62, 1.2, 1.95),
    "plant": (0.7, 0.66, 1.2),
    "snake": (0.4, 0.4, 0.8),
    "lamp": (0.45, 0.45, 1.45),
    "tv": (0.25, 0.9, 0.55),
    "wall": (0.05, 0.9, 0.5),
    "bin": (0.3, 0.3, 0.45),
    "refrigerator": (0.66, 0.6, 1.75),
    "toilet": (0.7, 0.42, 0.8),
    "table": (0.8, 1.5, 0.75),
    "desk": (0.62, 1.3, 0.75),
    "pedestal": (0.95, 0.95, 0.74),
    "coffee": (0.6, 0.9, 0.42),
    "side": (0.42, 0.46, 0.48),
}
"""Depth, width, height of stand-ins by style, else by class."""


def stand_in(class_name: str, rng: np.random.Generator, style: str | None = None) -> Piece:
    """A box, or a round or L-shaped solid, in about the size of real furniture: layouts without costly meshes."""
    style = style or ("wall" if class_name == "tv" and rng.random() < 0.4 else "any")
    depth, width, height = np.array(SIZES.get(style, SIZES[class_name])) * rng.uniform(0.92, 1.08, 3)
    outline = rectangle(depth, width)
    if style in ("pedestal",) or class_name in ("plant", "bin", "lamp"):
        outline = ellipse(depth, width)
    if style == "corner":
        d, w = depth / 2, width / 2
        outline = np.array([[d, -w], [d, -w / 4], [-0.1, -w / 4], [-0.1, w], [-d, w], [-d, -w]])
    solid = box((-depth / 2, -width / 2, 0.0), (depth / 2, width / 2, height))
    reach = (0.34 * depth, 0.34 * width)
    tops = (Top(height, (-reach[0], -reach[1]), reach),) if class_name in ("table", "dresser") else ()
    return Piece(class_name, style, (Part(solid, Look("plain", ((0.5, 0.4, 0.3),))),), outline, height, tops)


@cache
def home_of(variant: str, seed: int, day: int = 0) -> Home:
    return make_home(seed, variant, day, make=stand_in)


HOMES = [(variant, 1) for variant in VARIANTS] + [("standard", 7), ("symmetric", 2)]
each_home = pytest.mark.parametrize(("variant", "seed"), HOMES)
LATER = [("standard", 1), ("rooms", 1), ("person", 1)]


def standing(home: Home) -> list[Placed]:
    return [item for item in home.objects if item.z_m == 0]


def obstacles(home: Home) -> list[Fixture]:
    """Fixtures that stand on the floor, walls left out."""
    return [f for f in home.fixtures if f.footprint is not None and f.kind not in ("wall", "floor", "rug", "ceiling")]


def tucked_m(chair: Array, table: Array) -> float:
    """How deep two convex outlines overlap along the direction in which they do least (separating axis)."""
    depth = math.inf
    for outline in (chair, table):
        edges = np.roll(outline, -1, 0) - outline
        for normal in np.column_stack([edges[:, 1], -edges[:, 0]]) / np.hypot(*edges.T)[:, None]:
            a, b = chair @ normal, table @ normal
            depth = min(depth, float(a.max() - b.min()), float(b.max() - a.min()))
    return depth


def may_reach_under(first: Placed, second: Placed) -> bool:
    names = {first.class_name, second.class_name}
    table = first if first.class_name == "table" else second
    return names == {"chair", "table"} and table.piece.height_m > 0.6


@each_home
def test_a_home_is_furnished(variant: str, seed: int) -> None:
    """15 to 40 objects (60 in several rooms) of at least 10 classes, numbered from 1, under four lights."""
    home = home_of(variant, seed)
    assert 15 <= len(home.objects) <= (60 if variant == "rooms" else 40)
    assert len({item.class_name for item in home.objects}) >= 10
    assert [item.instance for item in home.objects] == list(range(1, len(home.objects) + 1))
    assert {item.class_name for item in home.objects} <= set(CLASSES)
    assert len(home.lights) == LIGHTS
    assert 2.5 <= home.height_m <= 2.8


@each_home
def test_furniture_does_not_overlap(variant: str, seed: int) -> None:
    """No two pieces touch, but chairs may reach up to 0.15 m under a table that is high enough."""
    for first, second in combinations(standing(home_of(variant, seed)), 2):
        if gap_m(first.footprint, second.footprint) == 0:
            assert may_reach_under(first, second), (first.class_name, second.class_name)
            assert tucked_m(first.footprint, second.footprint) <= 0.15


@each_home
def test_pixels_agree_that_nothing_overlaps(variant: str, seed: int) -> None:
    """Drawn on a 5 mm raster, no cell belongs to two pieces, or to a piece and a wall or loose thing."""
    home = home_of(variant, seed)
    x0, y0, x1, y1 = home.bounds
    count = np.zeros((round((y1 - y0) / 0.005) + 200, round((x1 - x0) / 0.005) + 200), np.int8)
    outlines = [item.footprint for item in standing(home) if item.class_name != "chair"]
    outlines += [f.footprint for f in home.fixtures if f.footprint is not None and f.kind not in ("door", "wall")]
    for outline in outlines:
        pixels = np.round((outline - (x0 - 0.5, y0 - 0.5)) / 0.005).astype(np.int32)
        low, size = pixels.min(0), np.ptp(pixels, axis=0) + 1
        layer = np.zeros(size[::-1], np.uint8)
        cv2.fillPoly(layer, [pixels - low], 1)
        count[low[1] : low[1] + size[1], low[0] : low[0] + size[0]] += layer.astype(np.int8)
    assert count.max() == 1


@each_home
def test_furniture_stays_clear_of_the_building(variant: str, seed: int) -> None:
    """Every piece lies within a room, off walls, partitions, doors, counters and loose things."""
    home = home_of(variant, seed)
    walls = [f.footprint for f in home.fixtures if f.kind == "wall" and f.footprint is not None]
    solid = [f.footprint for f in obstacles(home) if f.footprint is not None]
    for item in standing(home):
        low, high = item.footprint.min(0), item.footprint.max(0)
        assert any(np.all(low > room.low) and np.all(high < room.high) for room in home.rooms), item.class_name
        assert min(gap_m(item.footprint, wall) for wall in walls) > 0.012, item.class_name  # thicker than skirting
        assert min(gap_m(item.footprint, other) for other in solid) > 0, item.class_name


@each_home
def test_wall_furniture_stands_at_walls_and_faces_in(variant: str, seed: int) -> None:
    """Beds, shelves, dressers, refrigerators and toilets have their back within 4 cm of a wall, their front free."""
    home = home_of(variant, seed)
    for item in home.objects:
        if item.class_name not in ("bed", "bookshelf", "dresser", "refrigerator", "toilet"):
            continue
        forward = np.array([math.cos(item.yaw_rad), math.sin(item.yaw_rad)])
        back = (item.x_m, item.y_m) - forward * item.piece.depth_m / 2
        room = next(r for r in home.rooms if np.all(np.array(r.low) < back) and np.all(back < r.high))
        gaps = {(1, 0): back[0] - room.low[0], (-1, 0): room.high[0] - back[0]}
        gaps |= {(0, 1): back[1] - room.low[1], (0, -1): room.high[1] - back[1]}
        wall = (round(forward[0]), round(forward[1]))
        assert 0.012 < gaps[wall] <= 0.041, item.class_name
        assert np.allclose(forward, wall, atol=1e-9)


@each_home
def test_chairs_at_a_table_face_it(variant: str, seed: int) -> None:
    """A chair that reaches under a table looks at it."""
    home = home_of(variant, seed)
    pairs = [
        (c, t) for c in standing(home) for t in standing(home) if (c.class_name, t.class_name) == ("chair", "table")
    ]
    reached = [(chair, table) for chair, table in pairs if gap_m(chair.footprint, table.footprint) == 0]
    assert reached
    for chair, table in reached:
        ahead = np.array([chair.x_m + 0.5 * math.cos(chair.yaw_rad), chair.y_m + 0.5 * math.sin(chair.yaw_rad)])
        assert inside(ahead[None], table.footprint)[0] or distances_m(ahead[None], table.footprint)[0] < 0.15


@each_home
def test_a_tv_stands_on_something_and_the_sofa_faces_it(variant: str, seed: int) -> None:
    """Every tv is above a dresser, on its top or on the wall over it, and a sofa looks at it from 1.5 to 5 m."""
    home = home_of(variant, seed)
    tvs = [item for item in home.objects if item.class_name == "tv"]
    assert tvs
    for tv in tvs:
        bench = next(
            o
            for o in standing(home)
            if inside(np.array([[tv.x_m, tv.y_m]]), o.footprint)[0] or gap_m(tv.footprint, o.footprint) == 0
        )
        assert bench.class_name == "dresser"
        over = tv.z_m - bench.piece.height_m
        assert over == pytest.approx(0, abs=1e-9) if tv.piece.style != "wall" else 0.1 < over < 0.5
        watchers = []
        for sofa in (item for item in home.objects if item.class_name == "sofa"):
            away = np.array([tv.x_m - sofa.x_m, tv.y_m - sofa.y_m])
            ahead = away @ (math.cos(sofa.yaw_rad), math.sin(sofa.yaw_rad)) / np.hypot(*away)
            watchers.append(ahead > 0.95 and 1.5 < np.hypot(*away) < 5)
        assert any(watchers)


@each_home
def test_nothing_else_floats(variant: str, seed: int) -> None:
    """All that is no tv stands on the floor, and clutter without a footprint lies on some piece's top."""
    home = home_of(variant, seed)
    assert all(item.z_m == 0 for item in home.objects if item.class_name != "tv")
    for fixture in home.fixtures:
        if fixture.kind != "clutter":
            continue
        points = np.concatenate([part.mesh.vertices for part in fixture.parts])
        middle = (points[:, :2].min(0) + points[:, :2].max(0)) / 2
        below = 0.0
        if fixture.footprint is None:
            bearers = [o for o in standing(home) if o.piece.tops and inside(middle[None], o.footprint)[0]]
            below = bearers[0].piece.height_m
        assert points[:, 2].min() == pytest.approx(below, abs=0.021)


@each_home
def test_a_robot_gets_about(variant: str, seed: int) -> None:
    """A corridor 0.5 m wide leads from the start over 20 m2 and a quarter of the floor, and into every room."""
    home = home_of(variant, seed)
    reached, origin = region(home, 0.25)
    floor = sum(float(np.prod(np.subtract(room.high, room.low))) for room in home.rooms)
    assert reached.sum() * 0.05**2 >= max(20.0, 0.25 * floor)
    for room in home.rooms:
        (c0, r0), (c1, r1) = (np.floor(np.subtract(p, origin) / 0.05).astype(int) for p in (room.low, room.high))
        assert reached[r0:r1, c0:c1].sum() * 0.05**2 > 2.0


@each_home
def test_the_start_is_near_the_middle_and_clear(variant: str, seed: int) -> None:
    """Within 1.5 m of the origin, and 0.45 m from everything."""
    home = home_of(variant, seed)
    assert math.hypot(*home.start) <= 1.5
    point = np.array([home.start])
    assert not any(inside(point, outline)[0] for outline in blocked_polygons(home))
    assert min(distances_m(point, outline)[0] for outline in blocked_polygons(home)) >= 0.45
    assert any(inside(point, outline)[0] for outline in home.outline)


def region(home: Home, radius_m: float) -> tuple[NDArray[np.bool_], tuple[float, float]]:
    """Cells of 5 cm that a disc's middle can reach from the start."""
    free, origin = free_raster(home, 0.05)
    size = 2 * math.ceil(radius_m / 0.05) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    wide = cv2.erode(np.pad(free, 20).astype(np.uint8), disc)[20:-20, 20:-20]
    _, labels = cv2.connectedComponents(wide, connectivity=4)
    column, row = np.floor(np.subtract(home.start, origin) / 0.05).astype(int)
    assert wide[row, column]
    return labels == labels[row, column], origin


@each_home
def test_doors_can_be_opened(variant: str, seed: int) -> None:
    """Nothing stands within 0.8 m before a door."""
    home = home_of(variant, seed)
    doors = [f for f in home.fixtures if f.kind == "door" and f.footprint is not None]
    assert doors
    for door in doors:
        assert door.footprint is not None
        for item in standing(home):
            assert gap_m(door.footprint, item.footprint) > 0.04
            away = np.subtract((item.x_m, item.y_m), door.footprint.mean(0))
            assert np.hypot(*away) > 0.55


@each_home
def test_the_raster_shows_what_is_free(variant: str, seed: int) -> None:
    """Rows run along y and columns along x: middles of objects and places outside are taken, the start is free."""
    home = home_of(variant, seed)
    free, origin = free_raster(home, 0.1)
    assert origin == pytest.approx(home.bounds[:2])

    def at(x: float, y: float) -> bool:
        return bool(free[math.floor((y - origin[1]) / 0.1), math.floor((x - origin[0]) / 0.1)])

    assert at(*home.start)
    for item in standing(home):
        middle = item.footprint.mean(0)
        if inside(middle[None], item.footprint)[0]:
            assert not at(float(middle[0]), float(middle[1])), item.class_name
    rows, columns = np.nonzero(free)
    points = np.asarray(np.column_stack([columns, rows]) * 0.1 + 0.05 + origin, np.float64)
    within = np.any([inside(points, outline) for outline in home.outline], axis=0)
    assert within.mean() > 0.995  # but for cells that the edge of a doorway cuts


def flat(home: Home) -> list[bytes]:
    """Everything of a home as bytes, to compare."""
    parts = [part for fixture in home.fixtures for part in fixture.parts]
    parts += [part for item in home.objects for part in item.piece.parts]
    content = [a.tobytes() for p in parts for a in (p.mesh.vertices, p.mesh.normals, p.mesh.uv, p.mesh.faces)]
    looks = repr([part.look for part in parts]) + repr([(f.kind, len(f.parts)) for f in home.fixtures])
    poses = repr([(o.instance, o.class_name, o.x_m, o.y_m, o.z_m, o.yaw_rad) for o in home.objects])
    rest = repr((home.rooms, home.height_m, home.lights, home.start, home.seed, home.variant, home.day))
    return [*content, looks.encode(), poses.encode(), rest.encode()]


@pytest.mark.parametrize("variant", ["standard", "symmetric", "rooms"])
def test_the_same_seed_gives_the_same_home(variant: str) -> None:
    """To the last bit, on both days; another seed gives another."""
    assert flat(make_home(1, variant, make=stand_in)) == flat(home_of(variant, 1))
    assert flat(home_of(variant, 1)) != flat(home_of(variant, 2))


def test_the_same_seed_gives_the_same_next_day() -> None:
    """To the last bit."""
    assert flat(make_home(1, "standard", 1, make=stand_in)) == flat(home_of("standard", 1, 1))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_symmetric_home_looks_the_same_after_half_a_turn(seed: int) -> None:
    """Every object, part of the building and light has a twin at the opposite place, texture included."""
    home = home_of("symmetric", seed)
    for item in home.objects:
        twins = [o for o in home.objects if math.hypot(o.x_m + item.x_m, o.y_m + item.y_m) < 1e-9 and o.z_m == item.z_m]
        assert [twin.piece is item.piece for twin in twins] == [True]
        assert abs(math.remainder(twins[0].yaw_rad - item.yaw_rad, 2 * math.pi)) == pytest.approx(math.pi)
    parts = [part for fixture in home.fixtures for part in fixture.parts]
    here = sorted(_fingerprint(part, 1.0) for part in parts)
    there = sorted(_fingerprint(part, -1.0) for part in parts)
    assert len(here) > 40
    for (kind, shape), (other_kind, other_shape) in zip(here, there, strict=True):
        assert kind == other_kind
        np.testing.assert_allclose(shape, other_shape, atol=1e-3)
    lights = sorted((light.kind, *np.round(light.position, 9), *light.colour) for light in home.lights)
    turned = sorted(
        (o.kind, *np.round((-o.position[0], -o.position[1], o.position[2]), 9), *o.colour) for o in home.lights
    )
    np.testing.assert_allclose([n[1:] for n in lights], [n[1:] for n in turned], atol=1e-9)
    assert all(light.direction[:2] == (0, 0) for light in home.lights)


def _fingerprint(part: Part, sign: float) -> tuple[str, tuple[float, ...]]:
    """Look, and place, spread and texture of a part seen from the middle, or from there after half a turn."""
    points = part.mesh.vertices.astype(np.float64) * (sign, sign, 1)
    uv = part.mesh.uv.astype(np.float64)
    product = np.einsum("ij,ik->jk", points, uv) / len(points)  # where on the texture which corner lies
    values = np.concatenate([points.mean(0), points.std(0), uv.mean(0), product.ravel()])
    return repr(part.look), tuple(np.round(values, 2) + 0.0)


@pytest.mark.parametrize(("variant", "seed"), LATER)
def test_the_next_day_some_furniture_has_moved(variant: str, seed: int) -> None:
    """Building and most furniture are as before, movable things changed, something is new; nothing overlaps."""
    before, after = home_of(variant, seed), home_of(variant, seed, 1)
    old, new = ({item.instance: item for item in home.objects} for home in (before, after))
    kept = [i for i in old if i in new and _pose(old[i]) == _pose(new[i])]
    moved = [i for i in old if i in new and _pose(old[i]) != _pose(new[i])]
    movable = [i for i in old if old[i].class_name in ("chair", "bin", "plant", "lamp", "table", "dresser")]
    assert 0.15 <= len(set(old) - set(kept)) / len(movable) <= 0.45
    assert {old[i].class_name for i in set(old) - set(kept)} <= {old[i].class_name for i in movable}
    assert moved
    assert set(new) - set(old)
    assert all(new[i].piece is old[i].piece or new[i].piece.height_m == old[i].piece.height_m for i in kept + moved)
    building = [[f for f in home.fixtures if f.kind != "clutter"] for home in (before, after)]
    assert [_bytes(f) for f in building[0]] == [_bytes(f) for f in building[1]]
    assert (after.day, after.start, after.lights) == (1, before.start, before.lights)


def _pose(item: Placed) -> tuple[float, float, float, float]:
    return item.x_m, item.y_m, item.z_m, item.yaw_rad


def _bytes(fixture: Fixture) -> bytes:
    return b"".join(part.mesh.vertices.tobytes() + repr(part.look).encode() for part in fixture.parts)


@pytest.mark.parametrize(("variant", "seed"), LATER)
def test_the_next_day_is_as_orderly_as_the_first(variant: str, seed: int) -> None:
    """Nothing overlaps but chairs and tables, nothing stands in walls, and the robot still gets about."""
    home = home_of(variant, seed, 1)
    for first, second in combinations(standing(home), 2):
        if not may_reach_under(first, second):
            assert gap_m(first.footprint, second.footprint) > 0, (first.class_name, second.class_name)
    others = [f.footprint for f in home.fixtures if f.footprint is not None and f.kind not in ("floor", "rug")]
    for item in standing(home):
        assert min(gap_m(item.footprint, other) for other in others) > 0, item.class_name
    assert region(home, 0.25)[0].sum() * 0.05**2 >= 20


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_rooms_are_joined_by_doorways(seed: int) -> None:
    """Two to four rooms of 5 to 10 m, at most 30 m in all, joined by gaps 0.95 to 1.3 m wide through their walls."""
    home = home_of("rooms", seed)
    assert 2 <= len(home.rooms) <= 4
    for room in home.rooms:
        assert np.all(np.subtract(room.high, room.low) >= 5)
        assert np.all(np.subtract(room.high, room.low) <= 10)
    assert home.bounds[2] - home.bounds[0] <= 30
    for first, second in combinations(home.rooms, 2):
        assert np.any(np.array(first.high) <= second.low) or np.any(np.array(second.high) <= first.low)
    gaps = home.outline[len(home.rooms) :]
    assert len(gaps) >= len(home.rooms) - 1
    for gap in gaps:
        assert 0.95 <= np.ptp(gap, axis=0).max() <= 1.3
        assert sum(gap_m(gap, outline) < 1e-6 for outline in home.outline[: len(home.rooms)]) == 2


@pytest.mark.parametrize("seed", [1])
def test_somebody_walks_where_nothing_is_in_the_way(seed: int) -> None:
    """Their whole body keeps 0.35 m from everything, and the strip they need is no free floor."""
    home = home_of("person", seed)
    assert home.walker is not None
    assert home.walker.instance == len(home.objects) + 1
    free, origin = free_raster(home, 0.05)
    for time_s in np.linspace(0, 20, 41):
        x, y, _ = home.walker.pose(float(time_s))
        reach = min(distances_m(np.array([[x, y]]), outline)[0] for outline in blocked_polygons(home))
        assert reach >= 0.35 + 0.25
        assert not free[math.floor((y - origin[1]) / 0.05), math.floor((x - origin[0]) / 0.05)]


def test_plain_homes_are_bare() -> None:
    """One flat colour on all walls and one on the floor; no windows, pictures, curtains or rugs."""
    home = home_of("plain", 1)
    assert not {f.kind for f in home.fixtures} & {"window", "picture", "curtain", "rug"}
    walls = {part.look for f in home.fixtures if f.kind == "wall" and len(f.parts) == 1 for part in f.parts}
    floor = {part.look for f in home.fixtures if f.kind == "floor" for part in f.parts}
    assert [look.pattern for look in walls | floor] == ["plain", "plain"]
    assert len(walls) == len(floor) == 1


def test_repeating_homes_repeat() -> None:
    """One paper with a short repeat on all walls, and many equal pictures 1.25 m apart."""
    home = home_of("repeating", 1)
    sides = [part.look for f in home.fixtures if f.kind == "wall" for part in f.parts if part.look.pattern != "wood"]
    assert len(set(sides)) == 1
    assert sides[0].pattern not in ("plain", "paint", "plaster")
    assert sides[0].tile_m <= 0.6
    pictures = [f for f in home.fixtures if f.kind == "picture"]
    assert len(pictures) >= 8
    assert len({tuple(part.look for part in f.parts) for f in pictures}) == 1
    assert len({np.ptp(f.parts[0].mesh.vertices, axis=0).max().round(3) for f in pictures}) == 1


def test_variants_of_a_seed_share_their_furniture() -> None:
    """Plain, repeating and standard homes of one seed differ in their surfaces only."""
    poses = [[_pose(item) for item in home_of(variant, 1).objects] for variant in ("standard", "plain", "repeating")]
    assert poses[0] == poses[1] == poses[2]


def test_standard_homes_are_finished() -> None:
    """Among a few homes there are doors, windows, pictures, curtains, rugs, skirting, and a variety of surfaces."""
    homes = [home_of("standard", seed) for seed in (1, 2, 7)]
    kinds = {fixture.kind for home in homes for fixture in home.fixtures}
    assert kinds >= {"floor", "ceiling", "wall", "door", "window", "picture", "curtain", "rug", "skirting", "clutter"}
    walls = {part.look for home in homes for f in home.fixtures if f.kind == "wall" for part in f.parts}
    assert len({look.pattern for look in walls}) >= 3


def test_real_furniture_fits_too() -> None:
    """With the pieces of `furniture` a home obeys the same rules, whatever their true outlines are."""
    home = make_home(11)
    assert 15 <= len(home.objects) <= 40
    for first, second in combinations(standing(home), 2):
        if gap_m(first.footprint, second.footprint) == 0:
            assert may_reach_under(first, second), (first.class_name, second.class_name)
            assert tucked_m(first.footprint, second.footprint) <= 0.15


@pytest.mark.parametrize(
    ("seed", "variant", "day", "words"),
    [(1, "castle", 0, "`castle`"), (1, "standard", 2, "`2`"), (-1, "standard", 0, "`-1`")],
)
def test_what_cannot_be_built_is_refused(seed: int, variant: str, day: int, words: str) -> None:
    """Unknown variants and days and negative seeds are named, with what to give instead."""
    with pytest.raises(SemslamError, match=words) as error:
        make_home(seed, variant, day, make=stand_in)
    assert error.value.hint


def test_a_plan_shows_objects_in_their_colours() -> None:
    """The plan has 60 pixels a metre, and somewhere inside the outline of every object its class's colour."""
    home = home_of("standard", 1)
    picture = draw_plan(home)
    x0, _, x1, y1 = home.bounds
    assert picture.shape[1] == pytest.approx((x1 - x0 + 0.9) * 60, abs=2)
    for item in home.objects:
        points = item.footprint.mean(0) + 0.8 * (item.footprint - item.footprint.mean(0))
        columns, rows = np.round((points - (x0 - 0.45, y1 + 0.45)) * (60, -60)).astype(int).T
        wanted = np.array(CLASS_COLOURS[item.class_name])
        assert np.abs(picture[rows, columns].astype(int) - wanted).max(1).min() < 40, item.class_name


def test_the_plan_has_a_colour_for_every_class() -> None:
    """And for nothing else."""
    assert set(CLASS_COLOURS) == set(CLASSES)


@pytest.mark.parametrize(("seed", "variant"), [(1007, "standard"), (1011, "rooms"), (1002, "symmetric")])
def test_a_robot_drives_through_real_homes_without_touching_anything(seed: int, variant: str) -> None:
    """With physics, real furniture and solid walls, for twenty seconds; and it gets somewhere."""
    pytest.importorskip("mujoco", reason="needs the simulator: pip install '.[sim]'")
    from semslam.sim.vehicle import draw_robot, drive

    home = make_home(seed, variant)
    motion = drive(home, free_raster(home), draw_robot(seed), seed, steps=18)
    assert motion.contacts == 0
    assert np.hypot(*np.diff(motion.positions[::20, :2], axis=0).T).sum() > 2.0
