"""What sensors make of a perfect picture: noisy, stepped depth with holes, and colour with exposure and noise.

Depth is that of a structured-light or active-stereo camera, which measures disparity d = K / z. Noise and rounding are
the same for every disparity, so in depth both grow with the square of the range. It misses what it sees at a grazing
angle, what is too near or too far, what lies in the projector's shadow beside an edge, and a few pixels without reason.

Model: K. Khoshelham, S. O. Elberink, Accuracy and Resolution of Kinect Depth Data, Sensors 12 (2012) 1437-1454
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from semslam.sim.eye import Sight

Field = NDArray[np.float32]
"""(H, W)"""

NEAREST_M, FARTHEST_M = 0.3, 8.0
"""Range of the depth camera."""
NOISE_PER_M = 0.0015
"""Standard deviation over the square of the range: 1.5 mm at 1 m, 6 mm at 2 m."""
NOISE_FLOOR_M = 0.001
"""Standard deviation that no range is without."""
STEP_PER_M = 0.004
"""Depth of a step of disparity over the square of the range: an eighth of a pixel at 480 px focal length and 65 mm."""
GRAZING_RAD, GRAZING_SPREAD_RAD = math.radians(8.0), math.radians(2.2)
"""Angle between ray and surface at which half of the pixels are missing, and how soon they come and go: 3 % miss at
12 degrees, nearly all at 4."""
SPECKLE = 0.0015
"""Share of pixels that are missing without reason."""

_LATERAL_PX = 1.5
"""Correlation windows overlap: the noise of neighbours is alike."""
_PATCH_PX = 1.2
_EDGE_M, _EDGE_SHARE = 0.08, 0.04
"""Neighbours whose depths differ by more than _EDGE_M + _EDGE_SHARE * depth lie on either side of an edge."""
_SHADOW_PX_M = 4.0
_SHADOW_PX = 3
"""Pixels of shadow to the left of an edge: this over the near depth less that over the far depth, at most three."""
_FLYING = 0.15
"""Share of edge pixels that hang between both sides."""

_GAMMA = 2.2
_MIDDLE = 0.47
"""Mean display value, 0 to 1, that automatic exposure aims at."""
_FULL_WELL = 1e4
"""Electrons of a white pixel: its noise is one part in a hundred."""
_READ_NOISE = 0.0015
"""Of white."""


def measure_depth(sight: Sight, rng: np.random.Generator) -> NDArray[np.uint16]:
    """What a depth camera measures, (H, W) millimetres along the optical axis; 0 is missing."""
    true_m = sight.depth_m
    lost = _lost_at_grazing(sight.normals_cos, rng) | _lost_at_edges(true_m)
    seen_m = _measured(_with_flying(true_m, rng), _alike(true_m.shape, _LATERAL_PX, rng))
    lost |= (true_m > FARTHEST_M) | (seen_m > FARTHEST_M) | (true_m < NEAREST_M) | (seen_m < NEAREST_M)
    lost.reshape(-1)[rng.integers(0, lost.size, rng.poisson(SPECKLE * lost.size))] = True
    return np.where(lost, 0, np.rint(seen_m * np.float32(1000.0))).astype(np.uint16)


def _measured(depth_m: Field, noise: Field) -> Field:
    """Depth through noisy, rounded disparity; `noise` has a standard deviation of 1."""
    scale = np.float32(1.0 / STEP_PER_M)
    safe_m = np.maximum(depth_m, np.float32(0.1))
    sigma = scale * np.sqrt(np.float32(NOISE_PER_M) ** 2 + (np.float32(NOISE_FLOOR_M) / safe_m**2) ** 2)
    disparity = np.maximum(np.rint(scale / safe_m + sigma * noise), np.float32(1.0))
    return np.asarray(scale / disparity, np.float32)


def _alike(shape: tuple[int, ...], spread_px: float, rng: np.random.Generator) -> Field:
    """Noise (H, W) of standard deviation 1 whose neighbours are alike."""
    kernel = cv2.getGaussianKernel(5, spread_px, cv2.CV_32F)
    noise = cv2.sepFilter2D(rng.standard_normal(shape, np.float32), -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)
    return np.asarray(noise / np.float32((kernel**2).sum()), np.float32)


def _lost_at_grazing(normals_cos: Field, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Where too little of the pattern comes back: in patches, the more the flatter the ray meets the surface."""
    angle_rad = np.arcsin(np.clip(normals_cos, 0.0, 1.0))
    return np.asarray(
        angle_rad + np.float32(GRAZING_SPREAD_RAD) * _alike(normals_cos.shape, _PATCH_PX, rng) < GRAZING_RAD
    )


def _edges(depth_m: Field, axis: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Steps from near to far and from far to near between neighbours along an axis, one shorter than depth."""
    first, second = (depth_m[:, :-1], depth_m[:, 1:]) if axis else (depth_m[:-1], depth_m[1:])
    step = second - first
    reach = np.float32(_EDGE_M) + np.float32(_EDGE_SHARE) * np.minimum(first, second)
    return step > reach, step < -reach


def _lost_at_edges(depth_m: Field) -> NDArray[np.bool_]:
    """The far pixel of every edge, and the shadow that the near side throws to its left."""
    lost = np.zeros(depth_m.shape, bool)
    rising, falling = _edges(depth_m, 0)
    lost[1:] |= rising
    lost[:-1] |= falling
    rising, falling = _edges(depth_m, 1)
    lost[:, 1:] |= rising
    inverse = np.float32(_SHADOW_PX_M) / np.maximum(depth_m, np.float32(0.1))
    rows, columns = np.nonzero(falling)
    width = np.clip(inverse[rows, columns + 1] - inverse[rows, columns], 1.0, _SHADOW_PX)
    for away in range(_SHADOW_PX):
        inside = (width > away) & (columns >= away)
        lost[rows[inside], columns[inside] - away] = True
    return lost


def _with_flying(depth_m: Field, rng: np.random.Generator) -> Field:
    """Depth in which some near pixels of edges are a mixture of both sides."""
    mixed = depth_m.copy()
    rising, falling = _edges(depth_m, 1)
    for edges, near, far in ((rising, 0, 1), (falling, 1, 0)):
        rows, columns = np.nonzero(edges)
        chosen = rng.random(rows.size) < _FLYING
        rows, columns, share = rows[chosen], columns[chosen], rng.random(int(chosen.sum()), np.float32)
        low, high = depth_m[rows, columns + near], depth_m[rows, columns + far]
        mixed[rows, columns + near] = low + share * (high - low)
    return mixed


# ---------------------------------------------------------------------------------------------------------- colour


@dataclass(frozen=True)
class ColourCamera:
    """What stays the same of one camera through a log."""

    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Gain of red, green and blue: what automatic white balance leaves."""
    vignette: float = 0.12
    """Share of light that the corners lack."""
    blur_px: float = 0.55
    """Standard deviation of lens and demosaicing."""


def draw_colour_camera(rng: np.random.Generator) -> ColourCamera:
    """A camera as one finds it."""
    red, blue = np.exp(rng.normal(0.0, 0.025, 2))
    return ColourCamera((float(red), 1.0, float(blue)), float(rng.uniform(0.06, 0.18)), float(rng.uniform(0.5, 0.65)))


def measure_rgb(
    rgb: NDArray[np.uint8], rng: np.random.Generator, camera: ColourCamera | None = None
) -> NDArray[np.uint8]:
    """What a colour camera makes of a picture (H, W, 3): exposure, cast, vignetting, noise of photons and of reading,
    blur.
    """
    camera = camera or ColourCamera()
    light = _to_light()[rgb]  # (H, W, 3)
    gain = np.asarray(camera.cast, np.float32) * np.float32(_exposure(rgb, rng))
    light *= _falloff(rgb.shape[0], rgb.shape[1], camera.vignette)[..., None] * gain
    sigma = np.sqrt(light * np.float32(1.0 / _FULL_WELL) + np.float32(_READ_NOISE**2))
    sigma *= rng.standard_normal(light.shape, np.float32)
    light += sigma
    codes = np.clip(light * np.float32(65535.0), 0.0, 65535.0).astype(np.uint16)
    return np.asarray(cv2.GaussianBlur(_to_display()[codes], (3, 3), camera.blur_px), np.uint8)


def _exposure(rgb: NDArray[np.uint8], rng: np.random.Generator) -> float:
    """Gain of light that automatic exposure chooses: half way to where it aims, and never quite the same."""
    mean = max(0.02, float(rgb[::8, ::8].mean()) / 255.0)
    display = min(1.25, max(0.8, math.sqrt(_MIDDLE / mean))) * math.exp(rng.normal(0.0, 0.02))
    return float(display**_GAMMA)


@lru_cache(maxsize=1)
def _to_light() -> Field:
    """(256,) light by display value."""
    return ((np.arange(256) / 255.0) ** _GAMMA).astype(np.float32)


@lru_cache(maxsize=1)
def _to_display() -> NDArray[np.uint8]:
    """(65536,) display value by light."""
    return np.rint(255.0 * (np.arange(65536) / 65535.0) ** (1.0 / _GAMMA)).astype(np.uint8)


@lru_cache(maxsize=8)
def _falloff(height: int, width: int, vignette: float) -> Field:
    """(H, W) share of light that reaches the sensor: 1 in the middle, 1 - vignette in the corners."""
    across, down = np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height)[:, None]
    square = (across**2 * width**2 + down**2 * height**2) / (width**2 + height**2)
    return (1.0 - vignette * square).astype(np.float32)
