"""Furniture of every class and style: on the floor, within its footprint, sized and faced like the real thing."""

from __future__ import annotations

import numpy as np
import pytest

from semslam.errors import SemslamError
from semslam.sim.furniture import STYLES, draw_palette, make_person, make_piece
from semslam.sim.furniture.common import hull
from semslam.sim.home import CLASSES, Array, Mesh, Piece
from semslam.sim.textures import PATTERNS

SEEDS = (1, 2)
ALL = [(name, style) for name in CLASSES for style in STYLES[name]]
MOST_TRIANGLES = 4000

DEPTHS_M = {
    "chair": (0.42, 0.80),
    "table": (0.35, 1.30),
    "sofa": (0.75, 1.90),
    "bed": (1.90, 2.45),
    "bookshelf": (0.18, 0.60),
    "dresser": (0.30, 0.75),
    "plant": (0.10, 1.60),
    "lamp": (0.20, 1.60),
    "tv": (0.02, 0.45),
    "bin": (0.15, 0.55),
    "refrigerator": (0.50, 0.90),
    "toilet": (0.45, 0.80),
}
WIDTHS_M = {
    "chair": (0.40, 0.80),
    "table": (0.35, 2.10),
    "sofa": (0.75, 2.90),
    "bed": (0.90, 2.10),
    "bookshelf": (0.35, 2.00),
    "dresser": (0.35, 2.10),
    "plant": (0.10, 1.60),
    "lamp": (0.20, 1.60),
    "tv": (0.60, 1.50),
    "bin": (0.15, 0.55),
    "refrigerator": (0.50, 1.00),
    "toilet": (0.30, 1.00),
}
HEIGHTS_M = {
    "chair": (0.78, 1.15),
    "table": (0.40, 0.77),
    "sofa": (0.70, 1.05),
    "bed": (0.75, 1.35),
    "bookshelf": (0.75, 2.30),
    "dresser": (0.38, 2.20),
    "plant": (0.20, 2.00),
    "lamp": (1.20, 1.95),
    "tv": (0.35, 1.00),
    "bin": (0.22, 0.75),
    "refrigerator": (1.30, 2.00),
    "toilet": (0.35, 1.30),
}


def draw(class_name: str, style: str, seed: int) -> Piece:
    return make_piece(class_name, np.random.default_rng([seed, 5]), style)


@pytest.fixture(scope="module", params=ALL, ids=lambda pair: "-".join(pair))
def pieces(request: pytest.FixtureRequest) -> list[Piece]:
    """A few draws of one style."""
    return [draw(*request.param, seed) for seed in SEEDS]


def vertices(piece: Piece) -> Array:
    return np.concatenate([part.mesh.vertices for part in piece.parts]).astype(np.float64)


def test_pieces_stand_on_the_floor_and_are_as_high_as_they_say(pieces: list[Piece]) -> None:
    """Nothing floats or sinks; what hangs on a wall says so by its style."""
    for piece in pieces:
        heights = vertices(piece)[:, 2]
        if "wall" not in piece.style:
            assert heights.min() == pytest.approx(0.0, abs=0.005)
        assert heights.min() > -0.005
        assert piece.height_m == pytest.approx(heights.max(), abs=0.002)


def test_footprints_hold_the_whole_piece_about_the_origin(pieces: list[Piece]) -> None:
    """A robot that stays outside touches nothing; the outline is counter-clockwise and no larger than its box."""
    for piece in pieces:
        points = vertices(piece)[:, :2]
        assert outside_m(points, piece.footprint).max() < 0.01
        assert area(piece.footprint) > 0
        assert piece.footprint.min(0) + piece.footprint.max(0) == pytest.approx([0, 0], abs=1e-6)
        assert np.ptp(piece.footprint, axis=0) == pytest.approx(np.ptp(points, axis=0), abs=0.02)


def test_sizes_are_those_of_real_furniture(pieces: list[Piece]) -> None:
    """Depth, width and height lie within what shops sell."""
    for piece in pieces:
        for size, ranges in ((piece.depth_m, DEPTHS_M), (piece.width_m, WIDTHS_M), (piece.height_m, HEIGHTS_M)):
            low, high = ranges[piece.class_name]
            assert low <= size <= high, f"{piece.class_name} {piece.style}"


def test_normals_have_unit_length_and_look_where_the_faces_look(pieces: list[Piece]) -> None:
    """A face whose normals point the other way would be black or invisible."""
    for piece in pieces:
        for part in piece.parts:
            lengths = np.linalg.norm(part.mesh.normals, axis=1)
            assert lengths == pytest.approx(np.ones(len(lengths)), abs=1e-4)
            assert wrong_area(part.mesh) < 0.005


def test_meshes_are_light_and_finite(pieces: list[Piece]) -> None:
    """Thirty pieces must fit into a picture's budget."""
    for piece in pieces:
        assert 40 < sum(len(part.mesh.faces) for part in piece.parts) < MOST_TRIANGLES
        for part in piece.parts:
            assert all(np.isfinite(array).all() for array in (part.mesh.vertices, part.mesh.normals, part.mesh.uv))
            assert set(np.unique(part.mesh.faces)) <= set(range(len(part.mesh.vertices)))


def test_looks_use_known_patterns_and_colours_that_can_be_shown(pieces: list[Piece]) -> None:
    """A pattern that does not exist would only be noticed when a picture is drawn."""
    for piece in pieces:
        for part in piece.parts:
            assert part.look.pattern in PATTERNS
            assert part.look.colours
            assert np.min(part.look.colours) >= 0
            assert np.max(part.look.colours) <= 1
            assert part.look.tile_m > 0


def test_tops_lie_on_real_surfaces(pieces: list[Piece]) -> None:
    """What is put on the corners of a top or its middle stands on the piece and not in the air."""
    for piece in pieces:
        for top in piece.tops:
            (x0, y0), (x1, y1) = top.low, top.high
            assert x0 < x1
            assert y0 < y1
            corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), ((x0 + x1) / 2, (y0 + y1) / 2)])
            assert outside_m(corners, piece.footprint).max() < 1e-6
            assert all(carried(piece, corner, top.z_m) for corner in corners), f"{piece.class_name} {piece.style}"


@pytest.mark.parametrize("class_name", ["table", "dresser"])
def test_tables_and_dressers_have_a_top(class_name: str) -> None:
    """Small things and televisions need a place to stand."""
    for style in STYLES[class_name]:
        piece = draw(class_name, style, 1)
        assert piece.tops or piece.height_m > 1.5, style


def test_the_same_generator_gives_the_same_piece(pieces: list[Piece]) -> None:
    """Bytes, not only shapes: logs are regenerated bit for bit."""
    first = pieces[0]
    second = draw(first.class_name, first.style, SEEDS[0])
    assert same(first, second)
    assert first.footprint.tobytes() == second.footprint.tobytes()
    assert (first.height_m, first.tops) == (second.height_m, second.tops)


def test_draws_of_a_style_differ(pieces: list[Piece]) -> None:
    """Two homes do not hold the same chair."""
    assert not same(pieces[0], pieces[1])


@pytest.mark.parametrize("class_name", CLASSES)
def test_every_class_has_several_styles_that_differ(class_name: str) -> None:
    """At least three, each with a mesh of its own."""
    made = [draw(class_name, style, 1) for style in STYLES[class_name]]
    assert len(made) >= 3
    assert len({(len(vertices(piece)), round(float(vertices(piece).sum()), 3)) for piece in made}) == len(made)
    assert {piece.class_name for piece in made} == {class_name}
    assert [piece.style for piece in made] == list(STYLES[class_name])


@pytest.mark.parametrize("class_name", ["chair", "sofa", "bed"])
def test_backs_and_heads_are_behind(class_name: str) -> None:
    """The front looks along +x, so what stands highest is at the rear."""
    for style in STYLES[class_name]:
        points = vertices(draw(class_name, style, 2))
        highest = points[points[:, 2] > 0.9 * points[:, 2].max()]
        assert highest[:, 0].mean() < -0.08, style


def test_the_corner_sofa_leaves_its_corner_free() -> None:
    """Its footprint is an L, on either hand: a robot may drive into the bay."""
    hands = set()
    for seed in range(6):
        piece = draw("sofa", "corner", seed)
        assert area(piece.footprint) < 0.9 * area(hull(piece.footprint))
        hands.add(bool(piece.footprint[piece.footprint[:, 0].argmax(), 1] > 0))
    assert hands == {True, False}


def test_a_given_palette_is_what_the_pieces_are_made_of() -> None:
    """Chairs and tables of one room share their wood."""
    palette = draw_palette(np.random.default_rng(4))
    table = make_piece("table", np.random.default_rng(1), "trestle", palette=palette)
    assert palette.wood in [part.look for part in table.parts]


def test_people_have_human_measures_and_stand_on_the_floor() -> None:
    """Walking or standing, facing +x, of different size and dress."""
    people = [make_person(np.random.default_rng(seed)) for seed in range(8)]
    for person in people:
        points = vertices(person)
        assert person.class_name == "person"
        assert 1.55 < person.height_m < 1.95
        assert points[:, 2].min() == pytest.approx(0.0, abs=0.005)
        assert outside_m(points[:, :2], person.footprint).max() < 0.01
        assert 0.4 < person.width_m < 0.75
        assert 0.25 < person.depth_m < 1.0
        assert sum(len(part.mesh.faces) for part in person.parts) < MOST_TRIANGLES
    assert {person.style for person in people} == {"walking", "standing"}
    assert len({person.height_m for person in people}) > 5


def test_without_a_style_all_of_them_come_up() -> None:
    """The generator chooses among the styles."""
    rng = np.random.default_rng(0)
    assert {make_piece("chair", rng).style for _ in range(60)} == set(STYLES["chair"])


def test_unknown_classes_and_styles_are_refused_with_the_known_ones() -> None:
    """The message names what was asked for, the hint what there is."""
    with pytest.raises(SemslamError, match="`piano`") as unknown_class:
        make_piece("piano", np.random.default_rng(0))
    assert "chair" in unknown_class.value.hint
    with pytest.raises(SemslamError, match="`rococo`") as unknown_style:
        make_piece("chair", np.random.default_rng(0), "rococo")
    assert "ladder" in unknown_style.value.hint


def area(outline: Array) -> float:
    """Of a polygon (N, 2), positive if counter-clockwise."""
    x, y = outline.T
    return float(x @ np.roll(y, -1) - np.roll(x, -1) @ y) / 2


def outside_m(points: Array, outline: Array) -> Array:
    """(P,) distance of points to a simple polygon, 0 for those inside."""
    start, end = outline, np.roll(outline, -1, 0)
    way = end - start
    to = points[:, None] - start
    share = np.clip((to * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-12), 0, 1)
    distance = np.linalg.norm(to - share[..., None] * way, axis=-1).min(1)
    above = (start[:, 1] > points[:, 1, None]) != (end[:, 1] > points[:, 1, None])
    slope = way[:, 0] / np.where(np.abs(way[:, 1]) < 1e-12, 1e-12, way[:, 1])
    crossed = above & (to[..., 0] < slope * to[..., 1])
    return np.asarray(np.where(crossed.sum(1) % 2 == 1, 0.0, distance))


def wrong_area(mesh: Mesh) -> float:
    """Share of a mesh's surface whose corners' normals look away from the face."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    look = np.cross(b - a, c - a)
    towards = (look[:, None] * mesh.normals[mesh.faces]).sum(-1).mean(1)
    return float(np.linalg.norm(look[towards < 0], axis=1).sum() / np.linalg.norm(look, axis=1).sum())


def carried(piece: Piece, place: Array, z_m: float) -> bool:
    """Whether an upward face of the piece lies under a place at this height, within 5 mm."""
    for part in piece.parts:
        corners = part.mesh.vertices[part.mesh.faces].astype(np.float64)  # (F, 3, 3)
        level = (np.abs(corners[..., 2] - z_m) < 0.005).all(1)
        a, b, c = (corners[level, i, :2] for i in range(3))
        sides = [cross(a, b, place), cross(b, c, place), cross(c, a, place)]
        if (np.min(sides, axis=0) >= -1e-9).any():
            return True
    return False


def cross(start: Array, end: Array, place: Array) -> Array:
    """(F,) positive where a place is to the left of lines."""
    way, to = end - start, place - start
    return np.asarray(way[:, 0] * to[:, 1] - way[:, 1] * to[:, 0])


def same(first: Piece, second: Piece) -> bool:
    """Whether meshes and looks are equal to the last bit."""
    if [part.look for part in first.parts] != [part.look for part in second.parts]:
        return False
    pairs = zip(first.parts, second.parts, strict=True)
    return all(
        getattr(a.mesh, name).tobytes() == getattr(b.mesh, name).tobytes()
        for a, b in pairs
        for name in ("vertices", "normals", "uv", "faces")
    )
