"""What makes a bookshelf, dresser, plant, lamp, television, bin, refrigerator or toilet of the simulator one."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.sim.furniture import appliances, lamps, plants, stock, storage
from semslam.sim.furniture.common import draw_palette
from semslam.sim.furniture.solids import block, shell, skin
from semslam.sim.home import Mesh, Piece
from semslam.sim.shapes import merge

SEEDS = range(4)
MAKERS = {
    "bookshelf": storage.BOOKSHELVES,
    "dresser": storage.DRESSERS,
    "plant": plants.PLANTS,
    "lamp": lamps.LAMPS,
    "tv": appliances.TVS,
    "bin": appliances.BINS,
    "refrigerator": appliances.REFRIGERATORS,
    "toilet": appliances.TOILETS,
}


@functools.cache
def make(class_name: str, style: str, seed: int) -> Piece:
    rng = np.random.default_rng([seed, 71])
    return MAKERS[class_name][style](rng, draw_palette(rng))


def every(class_name: str) -> list[Piece]:
    return [make(class_name, style, seed) for style in MAKERS[class_name] for seed in SEEDS]


def points(piece: Piece) -> NDArray[np.float64]:
    return np.concatenate([part.mesh.vertices for part in piece.parts]).astype(np.float64)


def triangles(mesh: Mesh) -> NDArray[np.float64]:
    """(F, 3, 3)."""
    return np.asarray(mesh.vertices[mesh.faces], np.float64)


def volume(mesh: Mesh) -> float:
    """Of what a mesh encloses; only closed meshes with consistent faces give the true one."""
    a, b, c = np.moveaxis(triangles(mesh), 1, 0)
    return float((np.cross(a, b) * c).sum() / 6)


def area(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(triangles(mesh), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def top_of_ray(piece: Piece, x: float, y: float) -> float:
    """Height at which something that falls onto a piece at a place comes to rest; 0 on the floor."""
    corners = np.concatenate([triangles(part.mesh) for part in piece.parts])
    a, b, c = np.moveaxis(corners, 1, 0)
    edges = [(a, b), (b, c), (c, a)]
    sides = np.stack([(q - p)[:, 0] * (y - p[:, 1]) - (q - p)[:, 1] * (x - p[:, 0]) for p, q in edges])
    size = sides.sum(0)
    hit = (sides >= 0).all(0) & (size > 1e-12)  # only faces that look up hold anything
    weights = sides[:, hit] / size[hit]
    heights = weights[1] * a[hit, 2] + weights[2] * b[hit, 2] + weights[0] * c[hit, 2]
    return float(heights.max(initial=0.0))


def test_a_board_is_a_closed_box_that_lost_only_its_edges() -> None:
    """A board encloses the volume of its box but for the broken edges, and keeps its bounds."""
    board = block((-0.4, 0.1, 0.0), (0.6, 0.4, 0.02), 0.004)
    assert len(board.faces) == 44
    assert 0.97 * 0.006 < volume(board) < 0.006
    assert np.allclose(board.vertices.min(0), (-0.4, 0.1, 0.0), atol=1e-6)
    assert np.allclose(board.vertices.max(0), (0.6, 0.4, 0.02), atol=1e-6)


@pytest.mark.parametrize("along", [0, 1, 2])
def test_the_grain_of_a_board_runs_along_it_at_true_scale(along: int) -> None:
    """A metre along the grain is a metre on the texture, on every side that is not an end."""
    board = block((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.01, grain=along)
    assert np.allclose(board.uv[:24, 0], board.vertices[:24, along])


def test_a_skin_looks_outwards_and_a_shell_has_an_inside() -> None:
    """Faces of a band point away from its axis; an open vessel has the volume of its wall alone."""
    angles = np.arange(24) * 2 * np.pi / 24
    rings = [np.column_stack([np.cos(angles), np.sin(angles), np.full(24, z)]) for z in (0.0, 0.5, 1.0)]
    band = skin(rings)
    a, b, c = np.moveaxis(triangles(band), 1, 0)
    assert (np.cross(b - a, c - a) * (a * (1, 1, 0))).sum(1).min() > 0
    wall = volume(shell([(0.2, 0.0), (0.2, 0.5)], 0.01, segments=64))
    assert wall == pytest.approx(np.pi * (0.2**2 - 0.19**2) * 0.5, rel=0.02)


def test_bookshelves_are_full_of_books_of_different_height() -> None:
    """At least eight different heights of edges of things in book colours, none of them outside the shelf."""
    for piece in every("bookshelf"):
        books = merge(part.mesh for part in piece.parts if part.look.colours[0] in stock.BOOKS)
        assert len(np.unique(np.round(books.vertices[:, 2], 3))) >= 8, piece.style
        frame = points(piece)
        assert books.vertices[:, 0].max() <= frame[:, 0].max() + 1e-6
        assert np.abs(books.vertices[:, 1]).max() < piece.width_m / 2, piece.style


def test_books_stand_on_boards() -> None:
    """Under the lowest books of a bookcase there is its plinth, not air, and none pierces its top board."""
    for seed in SEEDS:
        piece = make("bookshelf", "bookcase", seed)
        books = merge(part.mesh for part in piece.parts if part.look.colours[0] in stock.BOOKS)
        assert 0.05 < books.vertices[:, 2].min() < 0.12
        assert books.vertices[:, 2].max() < piece.height_m - storage.BOARD_M


def test_a_bench_carries_a_television() -> None:
    """Benches are low and their top takes the stand of a 40 inch set."""
    for seed in SEEDS:
        (top,) = make("dresser", "bench", seed).tops
        assert 0.40 <= top.z_m <= 0.55
        assert top.high[1] - top.low[1] > 0.9
        assert top.high[0] - top.low[0] > 0.3


def test_tops_of_dressers_are_where_things_come_to_rest() -> None:
    """What falls on the middle of a dresser's top comes to rest at the height that the top says."""
    for piece in every("dresser"):
        for top in piece.tops:
            x, y = np.add(top.low, top.high) / 2
            assert top_of_ray(piece, x + 0.003, y + 0.002) == pytest.approx(top.z_m, abs=0.002)


def test_fronts_of_dressers_have_gaps_that_look_dark() -> None:
    """Between drawers or doors one sees something much darker than the fronts."""
    for style in ("chest", "sideboard", "wardrobe"):
        piece = make("dresser", style, 1)
        bright = [max(part.look.colours[0]) for part in piece.parts]
        assert min(bright) < 0.5 * max(bright)


def test_screens_are_16_to_9_and_face_forward() -> None:
    """A television shows its screen, of 32 to 60 inches, to who stands in front of it."""
    for piece in every("tv"):
        (screen,) = [part.mesh for part in piece.parts if part.look.pattern == "screen"]
        wide, tall = np.ptp(screen.vertices[:, 1]), np.ptp(screen.vertices[:, 2])
        assert wide / tall == pytest.approx(16 / 9, rel=1e-3)
        assert 31.9 < np.hypot(wide, tall) / 0.0254 < 60.1
        assert np.allclose(screen.normals, (1, 0, 0))
        middle = screen.vertices.mean(0)
        others = merge(part.mesh for part in piece.parts if part.look.pattern != "screen").vertices
        near = np.abs(others[:, 1:] - middle[1:]).max(1) < 0.3 * tall
        assert others[near, 0].max(initial=-1.0) < middle[0]


def test_the_outline_of_a_television_includes_its_stand() -> None:
    """A set on feet or a pedestal is deeper than one on the wall, which is flat."""
    for seed in SEEDS:
        depths = {style: make("tv", style, seed).depth_m for style in appliances.TVS}
        assert depths["wall"] < 0.08 < 0.2 < min(depths["feet"], depths["pedestal"])


@pytest.mark.parametrize("style", ["basket", "wire"])
def test_open_bins_are_hollow(style: str) -> None:
    """Something dropped into a waste-paper basket falls below its rim."""
    for seed in SEEDS:
        piece = make("bin", style, seed)
        assert top_of_ray(piece, 0.001, 0.002) < piece.height_m - 0.03
        assert 0.25 <= piece.height_m <= 0.4


@pytest.mark.parametrize("style", ["pedal", "swing"])
def test_bins_with_a_lid_are_closed(style: str) -> None:
    """Something dropped onto a pedal bin or a swing bin stays on top."""
    for seed in SEEDS:
        piece = make("bin", style, seed)
        assert top_of_ray(piece, -0.02, 0.01) > 0.9 * piece.height_m


def test_refrigerators_have_doors_in_front() -> None:
    """The doors' face covers most of the front; handles stand out by less than 6 cm."""
    for piece in every("refrigerator"):
        front = points(piece)[:, 0].max()
        faces = np.concatenate([triangles(part.mesh) for part in piece.parts])
        flat = np.abs(np.ptp(faces[:, :, 0], axis=1)) < 1e-4
        near = faces[:, :, 0].mean(1) > front - 0.06
        a, b, c = np.moveaxis(faces[flat & near], 1, 0)
        normal = np.cross(b - a, c - a)[:, 0]
        assert normal[normal > 0].sum() / 2 > 0.7 * piece.width_m * piece.height_m, piece.style


def test_toilets_face_forward_and_seat_at_sitting_height() -> None:
    """What stands above the seat is at the back; in front something rests at sitting height."""
    for piece in every("toilet"):
        above = points(piece)
        above = above[above[:, 2] > 0.6]
        assert above[:, 0].mean() < 0, piece.style
        assert 0.36 < top_of_ray(piece, 0.42 * piece.depth_m, 0.001) < 0.5, piece.style


def test_an_open_lid_shows_the_bowl() -> None:
    """Into an open toilet things fall below the seat, on a closed one they rest on the lid."""
    for seed in SEEDS:
        closed, opened = make("toilet", "closed", seed), make("toilet", "open", seed)
        place = 0.28 * closed.depth_m, 0.005
        assert top_of_ray(closed, *place) > 0.40
        assert 0.15 < top_of_ray(opened, *place) < 0.33


def test_plants_are_mostly_leaves_above_a_pot() -> None:
    """Green makes up more than a quarter of a plant's surface and lies above the pot; it fits into a corner."""
    for piece in every("plant"):
        green = [part for part in piece.parts if part.look.pattern == "foliage"]
        pot = [part for part in piece.parts if part.look.pattern != "foliage"]
        leaves, rest = (sum(area(part.mesh) for part in parts) for parts in (green, pot))
        assert leaves > 0.25 * (leaves + rest), piece.style
        heights = merge(part.mesh for part in green).vertices[:, 2]
        assert 0.5 <= heights.max() <= 1.85, piece.style
        assert max(piece.depth_m, piece.width_m) < 1.45, piece.style


def test_plants_stand_in_the_middle_of_their_outline() -> None:
    """The pot, all that is near the floor, is within 20 cm of the origin's surroundings."""
    for piece in every("plant"):
        low = points(piece)
        low = low[low[:, 2] < 0.05]
        assert np.abs((low[:, :2].min(0) + low[:, :2].max(0)) / 2).max() < 0.2


def test_lamps_shine_near_their_top() -> None:
    """Something in the upper half of a floor lamp gives off light, nothing in the lower half does."""
    for piece in every("lamp"):
        glowing = merge(part.mesh for part in piece.parts if part.look.glow > 0.2)
        assert glowing.vertices[:, 2].min() > 0.5 * piece.height_m, piece.style
        assert 1.3 <= piece.height_m <= 1.82
