"""Quarter turns: why correlating and placing with all headings takes a third of the products.

Headings a quarter turn apart show the observation turned by 90 degrees about its centre cell, and on a square grid that
only exchanges cells: four at a time, an *orbit*, go round in a circle. What the four headings make of an orbit is a
cyclic correlation of four values with four values, 16 products. Fourier's transform of length four, which needs no
products itself, turns it into one for the sum, one for the alternating sum, and one of complex numbers, which takes
three (Gauss): 5.

Where the number of headings is no multiple of four, an orbit is a single cell, and nothing is saved.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.int64]
"""Flat indices into an observation of h x h cells."""
Values = NDArray[Any]
"""float32, or float64 where whole numbers keep sums exact."""


@lru_cache(maxsize=8)
def turned_cells(side: int) -> Cells:
    """Where the cells of an observation lie before it is turned left by 0, 1, 2, 3 quarters -> (4, h * h).

    `turned = flat[..., turned_cells(side)[q]]`: what was ahead (+x) lies left (+y) after one quarter.
    """
    cells = np.arange(side * side).reshape(side, side)
    return np.stack([np.rot90(cells, -quarters).ravel() for quarters in range(4)])


def turns_of(headings: int) -> int:
    """Headings that share an orbit: 4, or 1 if a quarter turn is no whole number of headings."""
    return 1 if headings % 4 else 4


@lru_cache(maxsize=8)
def orbits(side: int, turns: int) -> tuple[Cells, NDArray[np.float32]]:
    """The orbits of the cells (turns, O), and the share of its value that each place of an orbit holds (O,).

    Place j of an orbit is where its first cell lies before j quarters to the left. The centre, which never moves, fills
    all four places of its orbit, so each has a quarter of it.
    """
    cells = turned_cells(side)[:turns]  # (turns, h * h)
    ours = cells[:, cells[0] == cells.min(0)]
    return ours, np.float32(1.0) / (ours == ours[0]).sum(0, dtype=np.float32)


def turned_products(left: Values, right: Values, product: Callable[[Values, Values], Values]) -> Values:
    """Cyclic correlation within orbits, summed over terms: (turns, n, T), (turns, T, m) -> (turns, n, m).

    result[q] is the sum over j of the matrix `product` of left[j + q] and right[j], with j + q round the circle.
    Overwrites both.
    """
    if len(left) == 1:
        return product(left[0], right[0])[None]
    left *= left.dtype.type(0.25)
    _transform(left)
    _transform(right)
    same, flipped = product(left[0], right[0]), product(left[1], right[1])
    left[2:] *= 2
    common = product(left[2], right[2] + right[3])
    real, imaginary = common - product(left[2] - left[3], right[3]), product(left[2] + left[3], right[2]) - common
    result = np.empty((4, *same.shape), same.dtype)
    for first, mean, wave in ((0, same + flipped, real), (1, same - flipped, imaginary)):
        np.add(mean, wave, out=result[first])
        np.subtract(mean, wave, out=result[first + 2])
    return result


def _transform(values: Values) -> None:
    """Fourier's transform of length four along the first axis, in place: sum, alternating sum, real, imaginary rest."""
    first, second, third, fourth = values
    even, odd = first + third, second + fourth
    np.subtract(first, third, out=third)
    np.subtract(second, fourth, out=fourth)
    np.add(even, odd, out=first)
    np.subtract(even, odd, out=second)
