"""The renderer against geometry worked out by hand, and its ids against the room it shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from tests.toy.furniture import Material, Solid
from tests.toy.render import Renderer, View, pinhole, visible_boxes
from tests.toy.robot import base_pose, mount, optical, plan_path
from tests.toy.toyroom import CLASSES, ToyRoom, make_room

CAMERA = pinhole(160, 120, math.radians(90))
GREY = Material("plain", (0.5, 0.5, 0.5), (0.4, 0.4, 0.4))


def empty_room(*solids: Solid) -> ToyRoom:
    """6 x 5 x 2.6 m with nothing in it but the solids given."""
    return replace(make_room(0), objects=(), solids=solids)


def look(x_m: float = 0.0, y_m: float = 0.0, *, yaw_rad: float = 0.0, pitch_rad: float = 0.0) -> NDArray[np.float64]:
    """room_from_camera of a camera 0.5 m above the floor."""
    pose = mount(x_m, y_m, 0.5, pitch_rad=pitch_rad)
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(yaw_rad), -math.sin(yaw_rad)], [math.sin(yaw_rad), math.cos(yaw_rad)]]
    turn[:2, 3], pose[:2, 3] = (x_m, y_m), 0.0
    return turn @ pose @ optical()


def in_room(view: View, camera: Camera, room_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3) points of a depth picture."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    points = rays * view.depth_m[..., None]
    return np.asarray(points @ room_from_camera[:3, :3].T + room_from_camera[:3, 3])


@given(x=st.floats(-2, 2))
@settings(max_examples=15, deadline=None)
def test_a_wall_ahead_is_as_far_as_it_is(x: float) -> None:
    """Depth along the optical axis is one number for a whole wall, and the floor's follows from the ray's slope."""
    depth = Renderer(empty_room()).depth_m(CAMERA, look(x))
    assert depth[40:60, 60:100] == pytest.approx(3.0 - x, abs=1e-5)
    bottom = 0.5 * CAMERA.fy / (119 - CAMERA.cy)
    assert depth[119] == pytest.approx(bottom, abs=1e-5)


def test_a_wall_seen_askew_obeys_the_ray_equation() -> None:
    """Turned by 30 degrees, the ray through column u meets the wall at 3 / (cos - x sin) m along the axis."""
    yaw = math.radians(30)
    depth = Renderer(empty_room()).depth_m(CAMERA, look(yaw_rad=yaw))
    slope = (np.arange(60, 160) - CAMERA.cx) / CAMERA.fx
    expected = 3.0 / (math.cos(yaw) + slope * math.sin(yaw))
    hits_side = np.abs(expected * (math.sin(yaw) - slope * math.cos(yaw))) > 2.5
    assert depth[59, 60:][~hits_side] == pytest.approx(expected[~hits_side], abs=1e-4)
    assert (~hits_side).sum() > 50


@given(yaw=st.floats(-1.5, 1.5), ahead=st.floats(0.8, 2.0))
@settings(max_examples=20, deadline=None)
def test_every_point_on_a_box_lies_on_its_surface(yaw: float, ahead: float) -> None:
    """Turned back into the box's axes, hit points sit on a face, and the nearest corner bounds the depth."""
    half = np.array([0.2, 0.3, 0.25])
    box = Solid((ahead, 0.1, 0.5), (0.2, 0.3, 0.25), GREY, yaw_rad=yaw)
    pose = look()
    view = Renderer(empty_room(box)).view(CAMERA, pose)
    blank = Renderer(empty_room()).depth_m(CAMERA, pose)
    hit = view.depth_m < blank - 1e-3
    assert hit.sum() > 200
    local = (in_room(view, CAMERA, pose)[hit] - box.centre_m) @ np.array(
        [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    )
    assert np.abs(np.abs(local) / half).max(1) == pytest.approx(1.0, abs=1e-4)


def test_a_box_around_the_camera_plane_is_still_seen() -> None:
    """A long board that reaches behind the camera covers the lower middle of the picture."""
    board = Solid((0.0, 0.0, 0.1), (2.0, 0.2, 0.05), GREY)
    depth = Renderer(empty_room(board)).depth_m(CAMERA, look())
    assert depth[119, 80] == pytest.approx(0.35 * CAMERA.fy / (119 - CAMERA.cy), abs=1e-5)


def test_the_nearer_of_two_solids_hides_the_other() -> None:
    """Whatever their order in the room."""
    near, far = (Solid((x, 0.0, 0.5), (0.1, 0.4, 0.4), GREY) for x in (1.0, 2.0))
    for order in ((near, far), (far, near)):
        assert Renderer(empty_room(*order)).depth_m(CAMERA, look())[59, 80] == pytest.approx(0.9, abs=1e-5)


@pytest.mark.parametrize("seed", [0, 5, 27])
def test_ids_name_the_object_that_stands_there(seed: int) -> None:
    """Every pixel of an object, put back into the room, lies within its footprint; classes follow the ids."""
    room = make_room(seed)
    renderer, path = Renderer(room), plan_path(room, seed)
    seen = set()
    for time_s in (0.0, 7.0, 14.0, 21.0):
        pose = base_pose(path, time_s) @ mount(0.1, 0, 0.55, pitch_rad=0.2) @ optical()
        view = renderer.view(CAMERA, pose)
        points = in_room(view, CAMERA, pose)
        assert np.all((view.class_ids == -1) == (view.object_ids == 0))
        for item in room.objects:
            mine = view.object_ids == item.object_id
            assert np.all(view.class_ids[mine] == item.class_id)
            local = (points[mine][:, :2] - (item.x_m, item.y_m)) @ np.array(
                [[math.cos(item.yaw_rad), -math.sin(item.yaw_rad)], [math.sin(item.yaw_rad), math.cos(item.yaw_rad)]]
            )
            assert np.all(np.abs(local) <= np.array([item.depth_m, item.width_m]) / 2 + 0.03)
            seen |= {item.class_name} if mine.any() else set()
    assert len(seen) >= 5


def test_a_silhouette_is_what_an_object_covers_alone() -> None:
    """Of two boxes in a row, the far one keeps its whole silhouette though most of it is hidden."""
    room = make_room(0)
    near, far = (Solid((x, 0.0, 0.5), (0.1, 0.3, 0.3), GREY, object_id=n) for n, x in ((1, 1.0), (2, 2.0)))
    alone = Renderer(replace(room, solids=(far,))).view(CAMERA, look())
    both = Renderer(replace(room, solids=(near, far)))
    assert both.silhouettes(CAMERA, look())[2] == (alone.object_ids == 2).sum() > 0
    assert (both.view(CAMERA, look()).object_ids == 2).sum() == 0


def test_boxes_are_tight_around_the_visible_pixels() -> None:
    """One pixel less on any side would cut the object; small glimpses are left out."""
    room = make_room(5)
    pose = base_pose(plan_path(room, 5), 3.0) @ mount(0.1, 0, 0.55) @ optical()
    view = Renderer(room).view(CAMERA, pose)
    boxes = visible_boxes(view, min_pixels=30)
    assert boxes
    for box in boxes:
        mask = view.object_ids == box.object_id
        assert mask[box.top : box.bottom, box.left : box.right].sum() == mask.sum() == box.pixels >= 30
        edges = mask[box.top], mask[box.bottom - 1], mask[:, box.left], mask[:, box.right - 1]
        assert all(edge.any() for edge in edges)
        assert CLASSES[box.class_id] == room.objects[box.object_id - 1].class_name
    shown = np.bincount(view.object_ids.ravel(), minlength=len(room.objects) + 1)[1:]
    assert {box.object_id for box in boxes} == set(np.flatnonzero(shown >= 30) + 1)


def test_pictures_have_light_colour_and_texture() -> None:
    """Not a flat cartoon: the floor alone has many shades, and the same view twice gives the same bytes."""
    room = make_room(5)
    pose = base_pose(plan_path(room, 5), 3.0) @ mount(0.1, 0, 0.55) @ optical()
    view = Renderer(room).view(CAMERA, pose)
    floor = view.rgb[100:, :][view.object_ids[100:, :] == 0]
    assert len(np.unique(floor, axis=0)) > 100
    assert 60 < view.rgb.mean() < 200
    assert np.array_equal(view.rgb, Renderer(room).view(CAMERA, pose).rgb)
