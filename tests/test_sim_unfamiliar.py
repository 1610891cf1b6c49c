"""Homes in unfamiliar settings: what changes, what must not, and that a model would notice."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from semslam.sim import shapes
from semslam.sim.home import CLASSES, LIGHTS, Fixture, Home, Light, Look, Part, Piece, Placed, Room
from semslam.sim.textures import PATTERNS
from semslam.sim.unfamiliar import estranged, unfamiliar_camera

WOOD = Look("wood", ((0.7, 0.5, 0.3), (0.6, 0.4, 0.2)), 0.5)
WHITE = Look("paint", ((0.93, 0.93, 0.92),), 1.0)
BULB = Look("plain", ((1.0, 0.96, 0.86),), glow=0.9)
CRATE = shapes.box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.6))


@cache
def home() -> Home:
    """A room with a wooden table, a white refrigerator and a lamp that is nothing but its bulb."""
    outline = shapes.rectangle(0.6, 0.6)
    looks = {"table": WOOD, "refrigerator": WHITE, "lamp": BULB}
    pieces = [Piece(name, "crate", (Part(CRATE, look),), outline, 0.6) for name, look in looks.items()]
    wall = Fixture("wall", (Part(CRATE, WHITE), Part(CRATE, WOOD)), outline)
    floor = Fixture("floor", (Part(CRATE, replace(WOOD, pattern="planks")),))
    day = Light("sun", (0.0, 0.0, 2.6), (0.8, 0.0, -0.6), (0.15, 0.16, 0.17))
    dark = Light("sun", (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
    ground = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    objects = tuple(Placed(index + 1, piece, float(index), 0.0, 0.3) for index, piece in enumerate(pieces))
    room = Room("home", (-2.0, -2.0), (2.0, 2.0))
    return Home(5, "standard", 0, (room,), (ground,), 2.6, objects, (wall, floor), (day, dark, dark, dark), (0.5, -1.0))


def looks_of(one: Home) -> list[Look]:
    parts = [part for item in one.objects for part in item.piece.parts]
    return [part.look for part in (*parts, *(part for item in one.fixtures for part in item.parts))]


def test_everything_keeps_its_place_and_shape() -> None:
    """Boxes, masks and maps of the home stay true: only looks and lights differ."""
    other = estranged(home(), 3)
    for before, after in zip(home().objects, other.objects, strict=True):
        assert replace(after, piece=before.piece).__dict__ == before.__dict__
        assert after.piece.footprint is before.piece.footprint
        assert all(a.mesh is b.mesh for a, b in zip(after.piece.parts, before.piece.parts, strict=True))
    for old, new in zip(home().fixtures, other.fixtures, strict=True):
        assert (new.kind, new.footprint is old.footprint) == (old.kind, True)
        assert all(a.mesh is b.mesh for a, b in zip(new.parts, old.parts, strict=True))
    assert (other.seed, other.rooms, other.start, other.height_m) == (5, home().rooms, (0.5, -1.0), 2.6)


@pytest.mark.parametrize("seed", range(8))
def test_every_surface_but_bulbs_changes_colour(seed: int) -> None:
    """Greys too, which turning their hue would leave as they were; every pattern can be drawn."""
    for before, after in zip(looks_of(home()), looks_of(estranged(home(), seed)), strict=True):
        if before == BULB:
            assert after.colours == BULB.colours
        else:
            assert np.abs(np.subtract(after.colours, before.colours)).max() > 0.08
        assert after.pattern in PATTERNS
        assert all(0.0 <= channel <= 1.0 for colour in after.colours for channel in colour)


def test_wood_is_painted_walls_and_floors_swap_patterns_refrigerators_stay_smooth() -> None:
    """Materials change among those of their kind."""
    for seed in range(12):
        table, refrigerator, _, *wall, floor = (look.pattern for look in looks_of(estranged(home(), seed)))
        assert table in ("paint", "marble")
        assert refrigerator in ("metal", "plain")
        assert wall[0] != "paint"
        assert wall[1] != "wood"
        assert floor != "planks"


def test_the_same_seed_gives_the_same_home() -> None:
    """And another seed another one."""
    first, again, other = (estranged(home(), seed) for seed in (4, 4, 8))
    assert (looks_of(first), first.lights) == (looks_of(again), again.lights)
    assert looks_of(first) != looks_of(other)


def test_four_seeds_in_a_row_give_four_kinds_of_light() -> None:
    """Always as many as the renderer was compiled for, never those of the home, at most one with a shadow."""
    settings = [estranged(home(), seed).lights for seed in range(4)]
    assert len({tuple(light.kind for light in lights if max(light.colour) > 0) for lights in settings}) == 4
    for lights in settings:
        assert len(lights) == LIGHTS
        assert sum(light.shadow for light in lights) <= 1
        assert max(max(light.colour) for light in lights) > 0.3
        assert not {light for light in lights if max(light.colour) > 0} & set(home().lights)


def test_noon_shines_through_the_other_side() -> None:
    """Against the daylight of the home, and several times as strong."""
    sun = estranged(home(), 2).lights[0]
    assert sun.kind == "sun"
    assert sun.direction[0] < -0.5
    assert max(sun.colour) > 0.5


def test_the_camera_is_higher_more_inclined_and_narrower_than_in_training() -> None:
    """And it is one that the simulated eye accepts: square pixels, axis through the middle."""
    for seed in range(20):
        robot, lens = unfamiliar_camera(np.random.default_rng(seed), 320, 240)
        assert 0.9 <= robot.camera_height_m <= 1.3
        assert 20 <= math.degrees(robot.camera_pitch_rad) <= 30
        assert 40 <= 2 * math.degrees(math.atan(160 / lens.fx)) <= 47
        assert (lens.width, lens.height, lens.fx, lens.cx, lens.cy) == (320, 240, lens.fy, 159.5, 119.5)


def test_all_classes_survive() -> None:
    """Nothing is renamed on the way."""
    assert estranged(home(), 1).classes == CLASSES
    assert [item.class_name for item in estranged(home(), 1).objects] == ["table", "refrigerator", "lamp"]
