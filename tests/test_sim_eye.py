"""The simulated camera against geometry that can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco_warp", reason="needs the simulator: pip install '.[sim]'")

from semslam.geometry.camera import Camera
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.sim import shapes
from semslam.sim.boxes import silhouette_pixels, true_boxes
from semslam.sim.eye import Eye, studio
from semslam.sim.home import CLASSES, Home, Look, Part, Piece, Walker

CAMERA = Camera(160, 120, 80.0, 80.0, 79.5, 59.5)
RED = Look("plain", ((0.9, 0.1, 0.1),))
BLUE = Look("plain", ((0.1, 0.1, 0.9),))


def crate(class_name: str = "table", look: Look = RED, size: float = 0.6) -> Piece:
    half = size / 2
    part = Part(shapes.box((-half, -half, 0.0), (half, half, size)), look)
    return Piece(class_name, "crate", (part,), shapes.rectangle(size, size), size)


def looking_back(x: float, y: float, z: float) -> np.ndarray:
    """Pose of an optical frame that looks along -x of the world."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = x, y, z
    return pose


@pytest.fixture(scope="module")
def home() -> Home:
    return studio([crate(), crate("sofa", BLUE)])


def test_depth_of_wall_and_crate_is_their_distance(home: Home) -> None:
    """Along the axis: the wall at x = -1.5, the fronts of the crates at x = 0.3; the floor by its height."""
    eye = Eye(home, CAMERA)
    first = home.objects[0]
    sight = eye.look(looking_back(3.0, first.y_m, 0.3))
    assert sight.depth_m[60, 80] == pytest.approx(2.7, abs=2e-3)
    assert sight.depth_m[30, 80] == pytest.approx(4.5, abs=2e-3)
    assert sight.depth_m[30, 20] == pytest.approx(4.5, abs=2e-3), "depth is along the axis, not along the ray"
    row = 115
    assert sight.depth_m[row, 80] == pytest.approx(0.3 / ((row - 59.5) / 80), rel=1e-3)


def test_every_pixel_says_what_it_is(home: Home) -> None:
    """Instances and classes of floor, wall, crates and the nothing above the wall."""
    sight = Eye(home, CAMERA).look(looking_back(3.0, home.objects[0].y_m, 0.3))
    assert sight.instances[60, 80] == 1
    assert sight.classes[60, 80] == FIRST_OBJECT + CLASSES.index("table")
    assert sight.classes[118, 80] == FREE_FLOOR
    assert sight.classes[40, 80] == OBSTACLE
    assert sight.classes[0, 80] == UNOBSERVED
    assert sight.depth_m[0, 80] == 0
    assert set(np.unique(sight.instances)) == {0, 1, 2}


def test_left_in_the_world_is_left_in_the_picture(home: Home) -> None:
    """Looking along -x, greater y is to the right; the red crate stands at the lower y."""
    rgb = Eye(home, CAMERA).look(looking_back(3.0, sum(item.y_m for item in home.objects) / 2, 0.3)).rgb.astype(int)
    left, right = rgb[60, 60], rgb[60, 100]
    assert left[0] > 2 * left[2]
    assert right[2] > 2 * right[0]


def test_the_same_view_twice_is_the_same_bytes(home: Home) -> None:
    """Also from another eye in the same home."""
    pose = looking_back(2.5, 0.7, 0.5)
    first, second = (Eye(home, CAMERA).look(pose) for _ in range(2))
    for name in ("rgb", "depth_m", "instances", "classes", "normals_cos"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


def test_the_angle_of_surfaces(home: Home) -> None:
    """Head-on the wall's cosine is that of the ray; the floor far away is seen at a grazing angle."""
    sight = Eye(home, CAMERA).look(looking_back(3.0, home.objects[0].y_m, 0.3))
    assert sight.normals_cos[40, 80] == pytest.approx(math.cos(math.atan(19.5 / 80)), abs=0.01)
    row = 110
    slope = math.atan((row - 59.5) / 80)
    assert sight.normals_cos[row, 80] == pytest.approx(math.sin(slope), abs=0.02)


def test_who_walks_is_elsewhere_later(home: Home) -> None:
    """The walker moves between two looks and is an obstacle with an instance of its own."""
    walker = Walker(77, crate("person", BLUE, 0.5), (0.5, -1.0), (0.5, 3.0), 0.5)
    eye = Eye(replace(home, walker=walker), CAMERA)
    pose = looking_back(4.0, 0.7, 0.5)
    places = []
    for time_s in (0.0, 2.0, 4.0):
        mask = eye.look(pose, time_s).instances == 77
        assert mask.any()
        places.append(np.argwhere(mask)[:, 1].mean())
        assert set(np.unique(eye.look(pose, time_s).classes[mask])) == {OBSTACLE}
    assert places[0] < places[1] < places[2]


def test_shadows_fall(home: Home) -> None:
    """Without the shadow the same floor is brighter somewhere and darker nowhere."""
    lit = replace(home, lights=tuple(replace(light, shadow=False) for light in home.lights))
    pose = looking_back(3.0, 0.7, 0.8)
    with_shadow, without = (Eye(place, CAMERA).look(pose).rgb.astype(int).sum(-1) for place in (home, lit))
    assert (without - with_shadow).max() > 30
    assert (without - with_shadow).min() >= 0


def test_true_boxes_know_how_much_is_hidden() -> None:
    """A crate alone is seen whole; behind another one its share falls; at the edge it is cut."""
    home = studio([crate(size=0.5)])
    item = home.objects[0]
    pose = looking_back(2.5, item.y_m, 0.3)
    (alone,) = true_boxes(home, Eye(home, CAMERA).look(pose), CAMERA, pose)
    assert alone.share > 0.9  # the outline of a drawn silhouette is half a pixel too wide
    assert not alone.cut
    assert alone.pixels <= silhouette_pixels(item, CAMERA, pose)
    front = replace(item, instance=2, x_m=0.8, y_m=item.y_m + 0.25)
    crowded = replace(home, objects=(item, front))
    boxes = {box.instance: box for box in true_boxes(crowded, Eye(crowded, CAMERA).look(pose), CAMERA, pose)}
    assert boxes[1].share < 0.7
    assert boxes[2].share > 0.95
    aside = looking_back(2.5, item.y_m + 2.2, 0.3)
    (cut,) = true_boxes(home, Eye(home, CAMERA).look(aside), CAMERA, aside)
    assert cut.cut
    assert cut.share < 0.95


def test_another_kind_of_camera_is_refused(home: Home) -> None:
    """The eye is a plain pinhole."""
    with pytest.raises(ValueError, match="pinhole"):
        Eye(home, Camera(160, 120, 80.0, 90.0, 79.5, 59.5))
