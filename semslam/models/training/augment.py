"""Domain randomisation: pictures changed in every way that must not matter, so that no one renderer is learned.

Geometry (zoom, shift, mirror), colours of each object and of the building by themselves, light, sharpness, noise, holes
in depth, depth missing altogether, and objects cut out of other pictures and put in with regard to depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.models.training.pictures import Picture, SeenObject

Rng = np.random.Generator
Colour = NDArray[np.float32]
"""(H, W, 3), 0 to 1."""


@dataclass(frozen=True)
class Strength:
    """How much is changed. 0 leaves pictures alone, 1 is usual."""

    geometry: float = 1.0
    colour: float = 1.0
    depth: float = 1.0
    paste: float = 0.3
    """Share of pictures that get objects of another one."""
    no_depth: float = 0.08
    """Share of pictures without any depth."""


def randomised(picture: Picture, other: Picture | None, rng: Rng, strength: Strength) -> Picture:
    """A picture changed at random; objects of `other`, a picture of the same size, may be put into it."""
    if other is not None and rng.random() < strength.paste:
        picture = pasted(picture, other, rng)
    if strength.geometry > 0:
        picture = moved(picture, rng, strength.geometry)
    rgb = recoloured(picture, rng) if rng.random() < 0.5 * strength.colour else _unit(picture.rgb)
    if strength.colour > 0:
        rgb = photographed(rgb, rng, strength.colour)
    depth_m = disturbed(picture.depth_m, rng, strength.depth)
    if rng.random() < strength.no_depth:
        depth_m = np.zeros_like(depth_m)
    return replace(picture, rgb=np.asarray(np.rint(rgb * 255), np.uint8), depth_m=depth_m)


# Geometry


def moved(picture: Picture, rng: Rng, strength: float) -> Picture:
    """Zoomed, shifted and perhaps mirrored; depth along the axis stays what it is."""
    height, width = picture.instances.shape
    zoom = float(np.exp(rng.uniform(-0.35, 0.45) * strength)) if rng.random() < 0.7 else 1.0
    room_x, room_y = abs(width * (zoom - 1)) / 2, abs(height * (zoom - 1)) / 2
    shift = rng.uniform(-1, 1, 2) * (room_x + 0.05 * strength * width, room_y + 0.05 * strength * height)
    across = -zoom if rng.random() < 0.5 else zoom
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    matrix = np.array([[across, 0, centre[0] * (1 - across) + shift[0]], [0, zoom, centre[1] * (1 - zoom) + shift[1]]])
    return _warped(picture, matrix, zoom)


def _warped(picture: Picture, matrix: NDArray[np.float64], zoom: float) -> Picture:
    height, width = picture.instances.shape
    size = (width, height)
    grey = (114, 114, 114)
    rgb = cv2.warpAffine(picture.rgb, matrix, size, flags=cv2.INTER_LINEAR, borderValue=grey)
    depth = cv2.warpAffine(picture.depth_m, matrix, size, flags=cv2.INTER_NEAREST, borderValue=0)
    instances = cv2.warpAffine(picture.instances, matrix, size, flags=cv2.INTER_NEAREST, borderValue=0)
    objects = [found for item in picture.objects if (found := _moved(item, matrix, zoom, width, height))]
    return Picture(
        np.asarray(rgb, np.uint8),
        np.asarray(depth, np.float32),
        np.asarray(instances, np.uint16),
        tuple(_fitted(item, np.asarray(instances, np.uint16)) if item.cut else item for item in objects),
    )


def _fitted(item: SeenObject, instances: NDArray[np.uint16]) -> SeenObject:
    """An object that was cut, with box, pixels and share of what is really left of it."""
    mask = (instances == item.instance).astype(np.uint8)
    pixels = int(np.count_nonzero(mask))
    if pixels == 0:
        return replace(item, pixels=0, share=0.0)
    left, top, width, height = cv2.boundingRect(mask)
    share = min(1.0, item.share * pixels / max(1, item.pixels))
    return replace(item, left=left, top=top, right=left + width, bottom=top + height, pixels=pixels, share=share)


def _moved(item: SeenObject, matrix: NDArray[np.float64], zoom: float, width: int, height: int) -> SeenObject | None:
    """An object after a warp; None if it left the picture. Its pixels are taken to fill its box evenly."""
    x = matrix[0, 0] * (np.array([item.left, item.right]) - 0.5) + matrix[0, 2] + 0.5
    y = matrix[1, 1] * (np.array([item.top, item.bottom]) - 0.5) + matrix[1, 2] + 0.5
    left, right = (float(np.clip(v, 0, width)) for v in (x.min(), x.max()))
    top, bottom = (float(np.clip(v, 0, height)) for v in (y.min(), y.max()))
    kept = (right - left) * (bottom - top) / max(1e-6, (x.max() - x.min()) * (y.max() - y.min()))
    if kept < 0.02 or right - left < 1 or bottom - top < 1:
        return None
    pixels = round(item.pixels * zoom**2 * kept)
    cut = item.cut or kept < 0.999
    return SeenObject(item.instance, item.class_id, left, top, right, bottom, pixels, item.share * kept, cut)


def pasted(picture: Picture, other: Picture, rng: Rng) -> Picture:
    """With up to four objects of another picture, at their own depth: what is nearer hides what is farther."""
    chosen = [item for item in other.counting if not item.cut or rng.random() < 0.3]
    if not chosen:
        return picture
    rng.shuffle(chosen)
    rgb, depth, instances = picture.rgb.copy(), picture.depth_m.copy(), picture.instances.copy()
    first = int(picture.instances.max(initial=0)) + 1  # slivers and people have ids without being objects
    candidates = list(picture.objects)
    for index, item in enumerate(chosen[:4]):
        mask = other.instances == item.instance
        mask &= (other.depth_m > 0) & ((depth == 0) | (other.depth_m < depth))
        rgb[mask], depth[mask], instances[mask] = other.rgb[mask], other.depth_m[mask], first + index
        candidates.append(replace(item, instance=first + index))
    return Picture(rgb, depth, instances, seen_again(candidates, instances))


def seen_again(objects: Sequence[SeenObject], instances: NDArray[np.uint16]) -> tuple[SeenObject, ...]:
    """Objects with the boxes and shares that their remaining pixels leave them; hidden ones are dropped."""
    remaining = np.bincount(instances.ravel(), minlength=int(instances.max(initial=0)) + 1)
    found = []
    for item in objects:
        pixels = int(remaining[item.instance]) if item.instance < len(remaining) else 0
        if pixels == 0:
            continue
        if abs(pixels - item.pixels) <= 0.01 * item.pixels:
            found.append(item)
            continue
        left, top, width, height = cv2.boundingRect((instances == item.instance).astype(np.uint8))
        share = item.share * min(1.0, pixels / max(1, item.pixels))
        found.append(
            SeenObject(item.instance, item.class_id, left, top, left + width, top + height, pixels, share, item.cut)
        )
    return tuple(found)


# Colour


def recoloured(picture: Picture, rng: Rng) -> Colour:
    """Every object, and the building, with colours of its own: mixed channels, other brightness, or another texture."""
    rgb = _unit(picture.rgb)
    ids, labels = np.unique(picture.instances, return_inverse=True)
    changed = rng.random(len(ids)) < 0.6
    mixes = np.stack([_mix(rng) if change else np.eye(3, dtype=np.float32) for change in changed])  # (K, 3, 3)
    shifts = np.where(changed[:, None], rng.uniform(-0.12, 0.12, (len(ids), 3)), 0).astype(np.float32)
    labels = labels.reshape(picture.instances.shape)
    for index in np.flatnonzero(changed):
        mask = labels == index
        rgb[mask] = rgb[mask] @ mixes[index].T + shifts[index]
    if rng.random() < 0.3:
        where = labels == int(rng.integers(len(ids)))
        rgb[where] = rgb[where] * (0.5 + _cloud(rgb.shape[:2], rng)[where])
    return np.clip(rgb, 0, 1)


def _mix(rng: Rng) -> NDArray[np.float32]:
    """(3, 3) matrix that turns the hue, changes saturation and brightness."""
    turn = rng.uniform(-np.pi, np.pi)
    cosine, sine = np.cos(turn), np.sin(turn) / np.sqrt(3)
    hue = cosine * np.eye(3) + (1 - cosine) / 3 + sine * np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]])
    grey = np.full((3, 3), 1 / 3)
    saturation = rng.uniform(0.2, 1.6)
    return np.asarray(rng.uniform(0.5, 1.4) * (saturation * hue + (1 - saturation) * grey), np.float32)


def _cloud(shape: tuple[int, ...], rng: Rng) -> Colour:
    """(H, W, 3) smooth or striped noise, 0 to 1."""
    coarse = rng.integers(2, 24, 2)
    small = rng.random((*(int(side) for side in coarse), 3), np.float32)
    method = cv2.INTER_NEAREST if rng.random() < 0.3 else cv2.INTER_CUBIC
    return np.clip(np.asarray(cv2.resize(small, (shape[1], shape[0]), interpolation=method), np.float32), 0, 1)


def photographed(rgb: Colour, rng: Rng, strength: float) -> Colour:
    """In other light and by another camera: gamma, gain, cast, saturation, vignette, blur, fewer pixels, noise."""
    curve = rng.uniform(0.65, 1.5) ** strength
    gain = np.exp(rng.uniform(-0.5, 0.3) * strength + rng.uniform(-0.15, 0.15, 3) * strength).astype(np.float32)
    rgb = np.clip(np.asarray(cv2.pow(rgb, float(curve)), np.float32) * gain, 0, 1)
    if rng.random() < 0.5:
        share = float(rng.uniform(1 - 0.7 * strength, 1 + 0.4 * strength)) if rng.random() < 0.85 else 0.0
        mixed = cv2.transform(rgb, np.asarray(share * np.eye(3) + (1 - share) / 3, np.float32))
        rgb = np.asarray(mixed, np.float32)
    if rng.random() < 0.25:
        rgb = rgb * (1 + strength * (_cloud(rgb.shape[:2], rng)[..., :1] - 0.5))
    rgb = _softened(rgb, rng)
    noise = rng.standard_normal(rgb.shape, np.float32) * np.float32(rng.uniform(0, 0.04) * strength)
    return np.clip(rgb + noise, 0, 1)


def _softened(rgb: Colour, rng: Rng) -> Colour:
    """Fewer pixels, out of focus, or moved during the exposure; or none of it."""
    height, width = rgb.shape[:2]
    soft: NDArray[Any] = rgb
    if rng.random() < 0.3:
        share = float(rng.uniform(0.35, 0.9))
        small = cv2.resize(rgb, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        soft = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    elif rng.random() < 0.2:
        soft = cv2.GaussianBlur(rgb, (0, 0), float(rng.uniform(0.4, 1.3)))
    elif rng.random() < 0.15:
        soft = cv2.filter2D(rgb, -1, _smear(rng))
    return np.asarray(soft, np.float32)


def _smear(rng: Rng) -> NDArray[np.float32]:
    """Kernel of a camera that moved while it exposed."""
    size, turn = int(rng.integers(3, 8)), rng.uniform(0, np.pi)
    kernel = np.zeros((9, 9), np.float32)
    reach = np.array([np.cos(turn), np.sin(turn)]) * size / 2
    start, end = (tuple(int(v) for v in np.rint(4 + sign * reach)) for sign in (-1, 1))
    cv2.line(kernel, start, end, 1.0)
    return np.asarray(kernel / kernel.sum(), np.float32)


# Depth


def disturbed(depth_m: NDArray[np.float32], rng: Rng, strength: float) -> NDArray[np.float32]:
    """Depth with a scale of its own, noise that grows with range, round holes, and perhaps a nearer end."""
    if strength <= 0:
        return depth_m
    depth_m = depth_m * np.float32(np.exp(rng.normal(0, 0.03 * strength)))
    sigma = np.float32(rng.uniform(0, 0.006) * strength)
    depth_m = depth_m + sigma * depth_m**2 * rng.standard_normal(depth_m.shape, np.float32)
    if rng.random() < 0.3 * strength:
        for _ in range(int(rng.integers(1, 8))):
            x, y = (int(rng.integers(side)) for side in (depth_m.shape[1], depth_m.shape[0]))
            axes = tuple(int(side) for side in rng.integers(3, max(4, depth_m.shape[0] // 6), 2))
            cv2.ellipse(depth_m, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, 0.0, -1)
    if rng.random() < 0.15 * strength:
        depth_m[depth_m > rng.uniform(3, 7)] = 0
    return np.maximum(depth_m, 0)


def _unit(rgb: NDArray[np.uint8]) -> Colour:
    return rgb.astype(np.float32) * np.float32(1 / 255)
