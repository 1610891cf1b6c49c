"""Cameras: lens models both ways, rectifying, and calibrations that make no sense."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.camera import Camera

WIDTH, HEIGHT = 640, 480


def camera(model: str, focal: float, *distortion: float) -> Camera:
    k = [focal, 0.0, 319.5, 0.0, focal * 1.01, 236.0, 0.0, 0.0, 1.0]
    return Camera.from_info(WIDTH, HEIGHT, k, model, distortion)


LENSES = {
    "plain": camera("plumb_bob", 525.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "barrel": camera("plumb_bob", 400.0, -0.35, 0.13, 1e-3, -5e-4, -0.02),
    "pincushion": camera("plumb_bob", 525.0, 0.26, -0.95, -0.005, 0.002, 1.16),
    "rational": camera("rational_polynomial", 500.0, 0.5, -2.6, 6e-4, -1e-4, 1.5, 0.4, -2.4, 1.4),
    "prism": camera("rational_polynomial", 520.0, 0.1, -0.2, 1e-3, 2e-3, 0.1, 0.0, 0.0, 0.0, 4e-3, -1e-3, -3e-3, 2e-3),
    "equidistant": camera("equidistant", 285.0, -0.01, 0.04, -0.04, 0.006),
    "half_sphere": camera("fisheye", 204.0, 0.0, 0.0, 0.0, 0.0),
}

lenses = st.sampled_from(sorted(LENSES)).map(LENSES.__getitem__)
pixels = st.tuples(st.floats(60, WIDTH - 60), st.floats(60, HEIGHT - 60))


@given(lenses, pixels, st.floats(0.2, 20.0))
@settings(deadline=None)
def test_pixels_round_trip(lens: Camera, pixel: tuple[float, float], depth_m: float) -> None:
    """A pixel's ray, at any depth, projects to the pixel."""
    ray = lens.rays(np.array([pixel]))
    assert ray[0, 2] == 1.0
    assert lens.project(ray * depth_m)[0] == pytest.approx(pixel, abs=1e-5)


@given(lenses, st.floats(-0.5, 0.5), st.floats(-0.35, 0.35))
@settings(deadline=None)
def test_projection_is_that_of_opencv(lens: Camera, x: float, y: float) -> None:
    """The lens models are OpenCV's, which calibrations are made with."""
    points, zero = np.array([[[x, y, 1.0]]]) * 3.0, np.zeros(3)
    if lens.model == "equidistant":
        seen, _ = cv2.fisheye.projectPoints(points, zero, zero, lens.matrix, np.array(lens.distortion))
    else:
        seen, _ = cv2.projectPoints(points, zero, zero, lens.matrix, np.array(lens.distortion))
    assert lens.project(points[0])[0] == pytest.approx(seen.ravel(), abs=1e-6)


def test_a_pinhole_by_hand() -> None:
    """One metre right and half a metre down, two metres ahead; behind the camera there is no pixel."""
    lens = camera("", 500.0)
    assert lens.project(np.array([[1.0, 0.5, 2.0]]))[0].tolist() == [569.5, 362.25]
    assert np.isnan(lens.project(np.array([[1.0, 0.5, -2.0], [0.0, 0.0, 0.0]]))).all()


def test_pixels_without_a_ray_are_nan() -> None:
    """The corners of a 180 degree fisheye look behind the camera."""
    corner, middle = LENSES["half_sphere"].rays(np.array([[0.0, 0.0], [320.0, 240.0]]))
    assert np.isnan(corner[:2]).all()
    assert np.isfinite(middle).all()


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("plumb_bob", "plumb_bob"),
        ("", "none"),
        ("none", "none"),
        ("rational_polynomial", "rational_polynomial"),
        ("equidistant", "equidistant"),
        ("kannala_brandt", "equidistant"),
        ("Kannala-Brandt", "equidistant"),
        ("fisheye", "equidistant"),
        ("Brown Conrady", "plumb_bob"),
        ("radtan", "plumb_bob"),
    ],
)
def test_names_of_lens_models(name: str, model: str) -> None:
    """ROS, Foxglove and drivers name the same models differently."""
    assert camera(name, 500.0).model == model


def test_zero_coefficients_are_a_pinhole_but_not_for_a_fisheye() -> None:
    """A fisheye without coefficients still bends."""
    assert LENSES["plain"].is_pinhole
    assert camera("plumb_bob", 500.0).is_pinhole
    assert camera("inverse_brown_conrady", 500.0, 0.0, 0.0, 0.0, 0.0, 0.0).is_pinhole
    assert not LENSES["half_sphere"].is_pinhole


def test_spare_zero_coefficients_are_dropped() -> None:
    """Some drivers send a fisheye's four coefficients and a zero."""
    assert camera("equidistant", 285.0, 0.1, 0.2, 0.3, 0.4, 0.0).distortion == (0.1, 0.2, 0.3, 0.4)


@pytest.mark.parametrize(
    ("model", "distortion", "match"),
    [
        ("fisheye62", (0.1,) * 8, "`fisheye62` with 8 coefficients"),
        ("inverse_brown_conrady", (0.1, 0.0, 0.0, 0.0, 0.0), "`inverse_brown_conrady`"),
        ("equidistant", (0.1, 0.1, 0.1), "takes 0 or 4"),
        ("", (0.1, 0.2, 0.0, 0.0, 0.0), "takes 0 finite"),
        ("rational_polynomial", (0.1,) * 14, "takes 0 or 4 or 5 or 8 or 12"),
        ("plumb_bob", (math.nan, 0.0, 0.0, 0.0, 0.0), "finite"),
    ],
)
def test_unusable_lens_models_are_named(model: str, distortion: tuple[float, ...], match: str) -> None:
    """What was found stands in the message."""
    with pytest.raises(SemslamError, match=match):
        camera(model, 500.0, *distortion)


@pytest.mark.parametrize(
    ("width", "height", "k", "match"),
    [
        (640, 480, [0.0] * 9, "uncalibrated"),
        (640, 480, [-500.0, 0, 320, 0, 500, 240, 0, 0, 1], "fx = -500"),
        (640, 480, [500.0, 0, 320, 0, 5e7, 240, 0, 0, 1], "fy = 5e\\+07"),
        (640, 480, [500.0, 0, 9000, 0, 500, 240, 0, 0, 1], "cx = 9000"),
        (640, 480, [math.inf, 0, 320, 0, 500, 240, 0, 0, 1], "not finite"),
        (0, 480, [500.0, 0, 320, 0, 500, 240, 0, 0, 1], "0 x 480"),
        (2**31, 2**31, [500.0, 0, 320, 0, 500, 240, 0, 0, 1], "not within"),
        (640, 480, [500.0, 320], "2 numbers"),
    ],
)
def test_absurd_calibrations_are_refused(width: int, height: int, k: list[float], match: str) -> None:
    """Before anything is computed or allocated with them."""
    with pytest.raises(SemslamError, match=match):
        Camera.from_info(width, height, k, "plumb_bob", [])


def test_a_pinhole_is_its_own_rectified_camera() -> None:
    """Nothing is resampled without need."""
    lens, image = LENSES["plain"], np.ones((HEIGHT, WIDTH), np.uint8)
    assert lens.rectified() is lens
    assert lens.rectify(image) is image


@pytest.mark.parametrize("name", ["barrel", "rational", "equidistant", "half_sphere"])
def test_rectified_borders_look_where_the_camera_can(name: str) -> None:
    """No empty margin along the axes, pixel shape kept, at most 60 degrees to a side, most of the view kept."""
    lens = LENSES[name]
    flat = lens.rectified()
    assert flat.is_pinhole
    assert (flat.width, flat.height) == (WIDTH, HEIGHT)
    assert flat.fy / flat.fx == pytest.approx(lens.fy / lens.fx)
    middles = np.array([[0.0, flat.cy], [WIDTH - 1, flat.cy], [flat.cx, 0.0], [flat.cx, HEIGHT - 1]])
    rays = flat.rays(middles)
    assert np.abs(rays[:, :2]).max() <= math.tan(math.radians(60.0)) + 1e-6
    seen = lens.project(rays)
    assert (seen > -1.0).all()
    assert (seen < [WIDTH, HEIGHT]).all()
    view = math.degrees(math.atan(-rays[0, 0]) + math.atan(rays[1, 0]))
    full = lens.rays(np.array([[0.0, lens.cy], [WIDTH - 1, lens.cy]]))
    assert view > min(0.9 * math.degrees(math.atan(-full[0, 0]) + math.atan(full[1, 0])), 100.0)


def picture(lens: Camera) -> NDArray[np.float32]:
    """What a camera sees of a smooth pattern at infinity: brightness by direction."""
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
    rays = lens.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    bright = 100.0 + 50.0 * np.sin(4 * rays[:, 0]) + 50.0 * np.cos(3 * rays[:, 1])
    return np.nan_to_num(bright).reshape(HEIGHT, WIDTH).astype(np.float32)


@pytest.mark.parametrize("name", ["barrel", "equidistant"])
def test_rectifying_shows_what_a_pinhole_would_see(name: str) -> None:
    """The rectified picture equals the one rendered for the rectified camera; nearest stays within a pixel's change."""
    lens = LENSES[name]
    seen, wanted = picture(lens), picture(lens.rectified())
    inside = (slice(20, -20), slice(20, -20))
    assert np.abs(lens.rectify(seen) - wanted)[inside].max() < 0.2
    assert np.abs(lens.rectify(seen, cv2.INTER_NEAREST) - wanted)[inside].max() < 2.0


def test_nearest_makes_no_depth_that_was_not_measured() -> None:
    """At the edge between 1 m and 5 m there is no 3 m."""
    depth = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    depth[:, WIDTH // 2 :] = 5.0
    assert set(np.unique(LENSES["barrel"].rectify(depth, cv2.INTER_NEAREST))) <= {0.0, 1.0, 5.0}


def test_an_image_of_another_size_is_refused() -> None:
    """Both sizes stand in the message."""
    with pytest.raises(SemslamError, match=r"320 x 240 pixels, but its calibration is for 640 x 480"):
        LENSES["barrel"].rectify(np.zeros((240, 320), np.uint8))


def test_a_lens_model_that_folds_near_the_middle_is_refused() -> None:
    """Rectifying such a picture would show things twice."""
    with pytest.raises(SemslamError, match="cannot be undone"):
        camera("plumb_bob", 300.0, -9.0, 0.0, 0.0, 0.0, 0.0).rectified()


def test_scaling_keeps_the_view() -> None:
    """The corner of the picture, not the centre of its first pixel, stays where it is."""
    lens = LENSES["barrel"]
    half = lens.scaled(WIDTH // 2, HEIGHT // 2)
    corner = lens.rays(np.array([[-0.5, -0.5]]))
    assert half.rays(np.array([[-0.5, -0.5]])) == pytest.approx(corner)
    assert half.scaled(WIDTH, HEIGHT) == lens
