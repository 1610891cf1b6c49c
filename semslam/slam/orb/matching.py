"""Which keypoint shows which known point: by descriptors alone, or near the place where the point is expected."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semslam.slam.orb.features import SCALE, Bytes, Features, Floats, Ints

MAX_BITS = 64
"""Descriptors of one point differ in at most this many of their 256 bits where its place is known too.

ORB-SLAM2 allows 100. With thousands of points a wrong pose then finds as many by chance as a right one by merit.
"""
MAX_BITS_ANYWHERE = 50
"""Likewise where descriptors are all there is (ORB-SLAM2's TH_LOW)."""


@dataclass(frozen=True)
class Pairs:
    """K matches: no keypoint and no point occurs twice."""

    keypoints: Ints
    """(K,) indices of keypoints."""
    points: Ints
    """(K,) indices into what they were matched with."""

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True)
class Expected:
    """M points as the camera should see them."""

    pixels: Floats
    """(M, 2)"""
    disparities_px: Floats
    """(M,)"""
    octaves: Ints
    """(M,) level at which the point's keypoint should be found."""
    descriptors: Bytes
    """(M, 32)"""


def match_anywhere(descriptors: Bytes, known: Bytes, ratio: float) -> Pairs:
    """Keypoints (N, 32) whose most similar known descriptor (M, 32) is clearly more similar than the second."""
    if len(descriptors) == 0 or len(known) < 2:
        return _pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    bits, nearest = cv2.batchDistance(descriptors, known, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)  # (N, 2)
    clear = (bits[:, 0] <= MAX_BITS_ANYWHERE) & (bits[:, 0] < ratio * bits[:, 1])
    keypoints = np.flatnonzero(clear)
    return _pairs(keypoints, nearest[keypoints, 0].astype(np.int64), bits[keypoints, 0].astype(np.int64))


def match_expected(features: Features, expected: Expected, radius_px: float, ratio: float) -> Pairs:
    """Keypoints within `radius_px`, at the finest level, of where a point is expected, and most similar to it.

    A second keypoint about as similar makes a match ambiguous only at the same level: the same corner is often found
    at two.
    """
    points, keypoints = _candidates(features, expected, radius_px)
    bits = hamming(expected.descriptors[points], features.descriptors[keypoints])
    order = np.lexsort((keypoints, bits, points))
    points, keypoints, bits = points[order], keypoints[order], bits[order]
    _, first, count = np.unique(points, return_index=True, return_counts=True)
    second = np.minimum(first + 1, len(points) - 1)
    same_level = features.octaves[keypoints[first]] == features.octaves[keypoints[second]]
    ambiguous = (count > 1) & same_level & (bits[first] >= ratio * bits[second])
    good = first[(bits[first] <= MAX_BITS) & ~ambiguous]
    return _pairs(keypoints[good], points[good], bits[good])


def hamming(a: Bytes, b: Bytes) -> Ints:
    """(K,) bits in which descriptors (K, 32) differ."""
    words = np.ascontiguousarray(a).view(np.uint64) ^ np.ascontiguousarray(b).view(np.uint64)
    return np.asarray(np.bitwise_count(words).sum(axis=1, dtype=np.int64))


def _candidates(features: Features, expected: Expected, radius_px: float) -> tuple[Ints, Ints]:
    """Points and keypoints, pair by pair, that agree in place, in depth where it is known, and in level."""
    radii = np.asarray(radius_px * SCALE**expected.octaves, np.float64)
    points, keypoints = _in_columns(features.pixels[:, 0], expected.pixels[:, 0], radii)
    rows = np.abs(expected.pixels[points, 1] - features.pixels[keypoints, 1])
    depth = np.abs(expected.disparities_px[points] - features.disparities_px[keypoints])
    levels = np.abs(expected.octaves[points] - features.octaves[keypoints])
    near = (levels <= 1) & (rows <= radii[points]) & ~(depth > radii[points])  # NaN says nothing
    return points[near], keypoints[near]


def _in_columns(columns: Floats, centres: Floats, radii: Floats) -> tuple[Ints, Ints]:
    """Pairs of a centre (M,) and a keypoint (N,) within its radius, along one axis."""
    order = np.argsort(columns, kind="stable")
    first = np.searchsorted(columns[order], centres - radii, "left")
    count = np.searchsorted(columns[order], centres + radii, "right") - first
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - first, count)
    return np.repeat(np.arange(len(centres)), count), order[place]


def _pairs(keypoints: Ints, points: Ints, bits: Ints) -> Pairs:
    """Of several keypoints for one point, or points for one keypoint, the most similar."""
    order = np.lexsort((keypoints, points, bits))
    for of in (points, keypoints):
        _, first = np.unique(of[order], return_index=True)
        order = order[np.sort(first)]
    return Pairs(keypoints[order], points[order])
