"""Outlines on the floor: how far two are apart, what lies inside, and where they fall on a raster.

An outline is (N, 2), counter-clockwise, simple, closed by itself; it may be concave.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.sim.home import Array, turn

_SUBPIXEL_BITS = 8


def rectangle_at(x_m: float, y_m: float, depth_m: float, width_m: float, yaw_rad: float = 0.0) -> Array:
    """(4, 2) rectangle about a place, `depth_m` along its own x."""
    corners = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * (depth_m / 2, width_m / 2)
    return np.asarray(corners @ turn(yaw_rad).T + (x_m, y_m))


def span(low: tuple[float, float], high: tuple[float, float]) -> Array:
    """(4, 2) upright rectangle between two corners."""
    return np.array([[high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]])


def disc(x_m: float, y_m: float, radius_m: float) -> Array:
    """(16, 2) polygon around a circle."""
    angles = np.arange(16) * math.pi / 8
    return np.column_stack([np.cos(angles), np.sin(angles)]) * radius_m / math.cos(math.pi / 16) + (x_m, y_m)


def area_m2(outline: Array) -> float:
    """Signed area: positive if counter-clockwise."""
    following = np.roll(outline, -1, 0)
    return float(np.sum(outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]) / 2)


def inside(points: Array, outline: Array) -> NDArray[np.bool_]:
    """(N,) which points lie inside, by counting the edges to their right."""
    x, y = points[:, :1], points[:, 1:]
    ax, ay = outline[:, 0], outline[:, 1]
    bx, by = np.roll(ax, -1), np.roll(ay, -1)
    crosses = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = (bx - ax) * (y - ay) / (by - ay) + ax
    return np.asarray((crosses & (x < cut)).sum(1) % 2 == 1)


def distances_m(points: Array, outline: Array) -> Array:
    """(N,) distance of points to the outline's edges, inside or outside."""
    edges = np.roll(outline, -1, 0) - outline
    lengths = np.maximum((edges**2).sum(1), 1e-18)
    from_start = points[:, None] - outline[None]  # (N, M, 2)
    share = np.clip((from_start * edges).sum(-1) / lengths, 0, 1)
    return np.asarray(np.linalg.norm(from_start - share[..., None] * edges, axis=-1).min(1))


def gap_m(first: Array, second: Array) -> float:
    """Distance between two outlines; 0 if they touch or overlap."""
    if _edges_cross(first, second) or inside(first[:1], second)[0] or inside(second[:1], first)[0]:
        return 0.0
    return float(min(distances_m(first, second).min(), distances_m(second, first).min()))


def near(first: Array, second: Array, margin_m: float) -> bool:
    """True if the upright boxes around two outlines come closer than a margin: cheap, before `gap_m`."""
    return bool(np.all(first.min(0) < second.max(0) + margin_m) and np.all(second.min(0) < first.max(0) + margin_m))


def closer(first: Array, second: Array, margin_m: float) -> bool:
    """True if two outlines overlap or come closer than a margin."""
    return near(first, second, margin_m) and gap_m(first, second) <= margin_m


def touches(outlines: Sequence[Array], others: Sequence[Array], margins_m: float | Array = 0.0) -> bool:
    """True if an outline overlaps one of others or comes closer than a margin; one margin, or one for each other."""
    if not outlines or not others:
        return False
    margins = np.broadcast_to(margins_m, (len(others),))
    first, second = boxes(outlines), boxes(others)
    apart = (first[:, None, :2] >= second[None, :, 2:] + margins[:, None]) | (
        second[None, :, :2] >= first[:, None, 2:] + margins[:, None]
    )
    pairs = np.argwhere(~apart.any(-1))
    return any(gap_m(outlines[i], others[j]) <= margins[j] for i, j in pairs)


def boxes(outlines: Sequence[Array]) -> Array:
    """(N, 4) upright boxes around outlines: least x, least y, greatest x, greatest y."""
    lengths = [len(outline) for outline in outlines]
    starts = np.concatenate([[0], np.cumsum(lengths[:-1])]).astype(np.intp)
    points = np.concatenate(outlines)
    return np.hstack([np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)])


def fill(mask: NDArray[np.uint8], outline: Array, origin: tuple[float, float], cell_m: float, value: int) -> None:
    """Set the cells that an outline covers or touches; cell (i, j) has its middle at origin + (j, i) + half a cell."""
    pixels = ((outline - origin) / cell_m - 0.5) * (1 << _SUBPIXEL_BITS)
    cv2.fillPoly(mask, [np.round(pixels).astype(np.int32)], value, lineType=cv2.LINE_8, shift=_SUBPIXEL_BITS)


def _edges_cross(first: Array, second: Array) -> bool:
    a, b = first[:, None], np.roll(first, -1, 0)[:, None]
    c, d = second[None], np.roll(second, -1, 0)[None]
    sides = _side_of(a, b, c) * _side_of(a, b, d), _side_of(c, d, a) * _side_of(c, d, b)
    return bool(np.any((sides[0] < 0) & (sides[1] < 0)))


def _side_of(start: Array, end: Array, point: Array) -> Array:
    along, to_point = end - start, point - start
    return np.asarray(along[..., 0] * to_point[..., 1] - along[..., 1] * to_point[..., 0])
