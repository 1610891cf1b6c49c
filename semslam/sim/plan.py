"""A home seen from above, drawn like an architect's plan."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.sim.home import Array, Fixture, Home, Part, Placed

Image = NDArray[np.uint8]
_Rgb = tuple[int, int, int]

CLASS_COLOURS: dict[str, _Rgb] = {
    "chair": (236, 151, 60),
    "table": (196, 140, 84),
    "sofa": (92, 128, 188),
    "bed": (150, 118, 186),
    "bookshelf": (146, 92, 58),
    "dresser": (178, 120, 110),
    "plant": (92, 160, 84),
    "lamp": (240, 204, 70),
    "tv": (62, 66, 74),
    "bin": (120, 132, 140),
    "refrigerator": (128, 186, 206),
    "toilet": (90, 190, 180),
}
"""RGB of every class."""

_PAPER, _INK, _WALL, _FLOOR = (255, 255, 255), (40, 42, 46), (58, 60, 66), (246, 243, 236)
_RUG, _LOOSE, _FITTED, _GLASS, _DOOR = (
    (228, 218, 204),
    (206, 200, 190),
    (214, 212, 206),
    (150, 196, 232),
    (186, 130, 78),
)
_MARGIN_M, _SCALE_BAND_M = 0.45, 0.55
_SMOOTH = 3
"""Drawn this many times larger, then averaged: fine lines stay smooth."""


class _Sheet:
    """A picture with world coordinates, y upwards."""

    def __init__(self, home: Home, px_per_m: float) -> None:
        x0, y0, x1, y1 = home.bounds
        self.scale = px_per_m * _SMOOTH
        self.left, self.top = x0 - _MARGIN_M, y1 + _MARGIN_M
        wide, high = x1 - x0 + 2 * _MARGIN_M, y1 - y0 + 2 * _MARGIN_M + _SCALE_BAND_M
        shape = round(high * px_per_m) * _SMOOTH, round(wide * px_per_m) * _SMOOTH, 3
        self.image: Image = np.full(shape, _PAPER, np.uint8)

    def pixels(self, points: Array) -> NDArray[np.int32]:
        return np.asarray(np.round((points - (self.left, self.top)) * (self.scale, -self.scale)), np.int32)

    def area(self, outline: Array, colour: _Rgb, edge: _Rgb | None = None, edge_m: float = 0.015) -> None:
        points = self.pixels(outline)
        cv2.fillPoly(self.image, [points], colour, cv2.LINE_AA)
        if edge is not None:
            cv2.polylines(self.image, [points], True, edge, self.thick(edge_m), cv2.LINE_AA)

    def line(self, points: Array, colour: _Rgb, width_m: float) -> None:
        cv2.polylines(self.image, [self.pixels(points)], False, colour, self.thick(width_m), cv2.LINE_AA)

    def thick(self, width_m: float) -> int:
        return max(1, round(width_m * self.scale))

    def text(self, words: str, height_m: float, x: float, y: float, colour: _Rgb) -> None:
        """Words centred on a place."""
        size = height_m * self.scale / 22.0
        thick = max(1, round(size * 1.6))
        (wide, high), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, thick)
        (px, py) = self.pixels(np.array([[x, y]]))[0]
        where = int(px - wide / 2), int(py + high / 2)
        cv2.putText(self.image, words, where, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thick, cv2.LINE_AA)

    def picture(self) -> Image:
        height, width = self.image.shape[:2]
        small = cv2.resize(self.image, (width // _SMOOTH, height // _SMOOTH), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8)


def draw_plan(home: Home, px_per_m: float = 60) -> Image:
    """(H, W, 3) RGB: floor, walls, openings, objects in the colours of their classes with names and fronts, a scale."""
    sheet = _Sheet(home, px_per_m)
    for outline in home.outline:
        sheet.area(outline, _FLOOR)
    for kind, colour in (("rug", _RUG), ("counter", _FITTED), ("radiator", _FITTED), ("clutter", _LOOSE)):
        _draw_fixtures(sheet, home, kind, colour)
    _draw_fixtures(sheet, home, "wall", _WALL)
    for kind, colour in (("window", _GLASS), ("door", _DOOR), ("curtain", (170, 120, 130)), ("picture", (200, 90, 70))):
        _draw_fixtures(sheet, home, kind, colour)
    for item in sorted(home.objects, key=lambda item: item.z_m):
        _draw_object(sheet, item)
    _draw_walker(sheet, home)
    _draw_start(sheet, home)
    _draw_scale(sheet, home)
    return sheet.picture()


def _draw_fixtures(sheet: _Sheet, home: Home, kind: str, colour: _Rgb) -> None:
    for fixture in home.fixtures:
        if fixture.kind == kind:
            outline = fixture.footprint if fixture.footprint is not None else _shadow(fixture)
            if kind == "wall" and fixture.footprint is None:
                continue  # above a doorway
            edge = _INK if kind in ("counter", "clutter", "window", "radiator") else None
            sheet.area(outline, colour, edge, 0.01)


def _shadow(fixture: Fixture) -> Array:
    """(N, 2) convex outline of a fixture from above."""
    points = np.concatenate([_plane(part) for part in fixture.parts]).astype(np.float32)
    return np.asarray(cv2.convexHull(points)[:, 0], np.float64)


def _plane(part: Part) -> Array:
    return np.asarray(part.mesh.vertices[:, :2], np.float64)


def _draw_object(sheet: _Sheet, item: Placed) -> None:
    """Outline in the colour of its class, a bar along its front, its name."""
    colour = CLASS_COLOURS[item.class_name]
    dark = (colour[0] * 5 // 9, colour[1] * 5 // 9, colour[2] * 5 // 9)
    sheet.area(item.footprint, colour, dark)
    middle = np.array([item.x_m, item.y_m])
    forward = np.array([math.cos(item.yaw_rad), math.sin(item.yaw_rad)])
    left = np.array([-forward[1], forward[0]])
    front = middle + forward * (item.piece.depth_m / 2)
    half = min(item.piece.width_m, 0.3) * 0.3
    notch = np.array([front - left * half, front - forward * half * 1.1, front + left * half])
    sheet.area(notch, dark)
    x, y = middle - forward * 0.03
    sheet.text(*_label(item), float(x), float(y), _INK if sum(colour) > 330 else _PAPER)


def _label(item: Placed) -> tuple[str, float]:
    """The name of an object, shortened if need be, and how high its letters may be to fit inside, metres."""
    room = float(np.ptp(item.footprint[:, 0]))
    for words in (item.class_name, item.class_name[:4], item.class_name[:2]):
        height = min(0.15, room / (0.85 * len(words)))
        if height >= 0.095:
            return words, height
    return item.class_name[0], 0.1


def _draw_walker(sheet: _Sheet, home: Home) -> None:
    if home.walker is None:
        return
    first, last = np.array(home.walker.start), np.array(home.walker.end)
    steps = max(2, int(np.hypot(*(last - first)) / 0.12))
    points = first + np.linspace(0, 1, steps)[:, None] * (last - first)
    for a, b in zip(points[:-1:2], points[1::2], strict=False):
        sheet.line(np.array([a, b]), (200, 40, 90), 0.03)
    place = home.walker.piece.footprint + first
    sheet.area(place, (232, 110, 150), (200, 40, 90))
    sheet.text("person", 0.12, float(first[0]), float(first[1]) - 0.32, (200, 40, 90))


def _draw_start(sheet: _Sheet, home: Home) -> None:
    x, y = home.start
    angles = np.linspace(0, 2 * np.pi, 40)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    sheet.area(ring * 0.11 + (x, y), (214, 60, 50))
    sheet.area(ring * 0.05 + (x, y), _PAPER)
    sheet.text("start", 0.12, x, y - 0.24, (190, 45, 40))


def _draw_scale(sheet: _Sheet, home: Home) -> None:
    """A bar of two metres in half metres, and what is drawn."""
    x0, y0, x1, _ = home.bounds
    y = y0 - _MARGIN_M - 0.12
    for k in range(4):
        bar = np.array([[0, 0], [0.5, 0], [0.5, 0.07], [0, 0.07]]) + (x0 + 0.5 * k, y)
        sheet.area(bar, _INK if k % 2 == 0 else _PAPER, _INK, 0.008)
    sheet.text("0", 0.12, x0, y - 0.13, _INK)
    sheet.text("2 m", 0.12, x0 + 2.0, y - 0.13, _INK)
    words = f"{home.variant}, seed {home.seed}, day {home.day}: {len(home.objects)} objects"
    sheet.text(words, 0.15, (x0 + 2.2 + x1) / 2, y - 0.02, _INK)
