"""What the trainings share: small pictures first, rare classes more often, a calm end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semslam.models.training.pictures import PictureSet

CALM_FROM = 0.93
"""From this share of the steps on, pictures are changed but little: they end up as cameras give them."""
_RARE_CLASS = 0.5
"""How strongly views with rare classes are drawn more often; 0 draws all alike."""

Sizes = Sequence[tuple[float, int, int]]
"""Until which share of the steps, and the width and height of the pictures until then."""


def size_at(sizes: Sizes, done: float) -> tuple[int, int]:
    """Width and height of the pictures when this share of the steps is done."""
    return next((width, height) for until, width, height in sizes if done < until or until >= 1)


def odds(pictures: PictureSet) -> NDArray[np.float64]:
    """(N,) how likely each view is drawn, the likelier the rarer its rarest class is; sums to 1."""
    shares = np.zeros(len(pictures.class_names))
    for present in pictures.classes_of:
        shares[list(present)] += 1 / len(pictures)
    rarity = np.array([max((1 / shares[index] for index in present), default=1.0) for present in pictures.classes_of])
    weights = rarity**_RARE_CLASS
    return np.asarray(weights / weights.sum(), np.float64)
