"""The toy room: furniture that fits, and a way through it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.toy.robot import ROBOT_RADIUS_M, clearance_at, clearance_grid, plan_path
from tests.toy.toyroom import CLASSES, RoomObject, ToyRoom, make_room, overlap

SEEDS = range(40)


@cache
def furnished(seed: int) -> ToyRoom:
    """The room of a seed, made once."""
    return make_room(seed)


def test_the_same_seed_furnishes_the_same_room() -> None:
    """A room is its seed."""
    assert make_room(3) == make_room(3)
    assert make_room(3) != make_room(4)


@pytest.mark.parametrize("size", [(6.0, 5.0), (5.0, 6.5)])
def test_furniture_stands_inside_the_walls_and_apart(size: tuple[float, float]) -> None:
    """No footprint leaves the room and no two overlap, whatever the seed."""
    for seed in SEEDS:
        room = make_room(seed, width_m=size[0], depth_m=size[1])
        for item in room.objects:
            assert np.all(np.abs(item.corners()) <= np.array(size) / 2), f"seed {seed}: {item}"
        pairs = [(a, b) for a in room.objects for b in room.objects if a.object_id < b.object_id]
        assert [pair for pair in pairs if overlap(*pair)] == [], f"seed {seed}"


def test_every_room_has_all_classes_and_ids_in_order() -> None:
    """8 to 12 objects of at least 5 classes; object i is entry i - 1."""
    for seed in SEEDS:
        objects = furnished(seed).objects
        assert 8 <= len(objects) <= 12
        assert {item.class_name for item in objects} == set(CLASSES)
        assert [item.object_id for item in objects] == list(range(1, len(objects) + 1))


def test_overlap_sees_what_bounding_boxes_miss() -> None:
    """Two long pieces crossing at an angle overlap; side by side at the same angle they do not."""
    lying = RoomObject(1, "sofa", 0.0, 0.0, 0.0, 0.2, 2.0)
    crossing = RoomObject(2, "sofa", 0.3, 0.0, np.pi / 4, 0.2, 2.0)
    beside = RoomObject(3, "sofa", 1.0, 0.0, np.pi / 4, 0.2, 0.5)
    assert overlap(lying, crossing)
    assert not overlap(lying, beside)
    assert overlap(lying, beside, gap_m=0.9)


def test_walls_furniture_faces_into_the_room() -> None:
    """The front of a sofa looks at the middle rather than at the wall behind it."""
    for seed in SEEDS:
        for item in furnished(seed).objects:
            if item.class_name in ("sofa", "tv", "shelf"):
                front = np.array([np.cos(item.yaw_rad), np.sin(item.yaw_rad)])
                assert front @ np.array([item.x_m, item.y_m]) < -1.0


def test_the_robot_never_touches_anything() -> None:
    """Along the whole loop the robot's disc stays clear of walls and footprints."""
    for seed in SEEDS:
        room = furnished(seed)
        path = plan_path(room, seed)
        clearance = clearance_at(clearance_grid(room), room, path.position(np.arange(0, 40, 0.1)))
        assert clearance.min() >= ROBOT_RADIUS_M, f"seed {seed}"


def test_the_robot_comes_back_to_where_it_was() -> None:
    """Half a minute is more than one loop, so places are seen twice."""
    for seed in range(10):
        way = plan_path(furnished(seed), seed).position(np.arange(0, 30, 0.5))
        late = np.linalg.norm(way[:5, None] - way[None, 40:], axis=2)
        assert late.min() < 0.15


def test_a_room_without_space_is_refused() -> None:
    """A cupboard is no room for a sofa, two shelves and a table."""
    with pytest.raises(ValueError, match="5 m"):
        make_room(0, width_m=3.0)
