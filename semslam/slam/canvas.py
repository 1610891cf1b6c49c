"""A picture to draw on: antialiased lines, shapes and text at sub-pixel positions, by OpenCV alone."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semslam.slam.palette import INK, PAGE, Colour

Image = NDArray[np.uint8]
"""(rows, columns, 3), blue, green, red."""

REGULAR, MEDIUM, BOLD = 400, 550, 700
_SHIFT = 4
"""OpenCV takes positions in sixteenths of a pixel."""
_AROUND = tuple((x, y) for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2) if x * x + y * y <= 5)


class Canvas:
    """Pixels with their origin in the upper left corner, x right, y down."""

    def __init__(self, width: int, height: int) -> None:
        self.image: Image = np.full((height, width, 3), PAGE, np.uint8)
        self._font = cv2.FontFace("sans")

    def box(self, x: float, y: float, width: float, height: float, fill: Colour, edge: Colour | None = None) -> None:
        """A filled rectangle, with an edge of one pixel if asked."""
        left, top, right, bottom = (round(v) for v in (x, y, x + width - 1, y + height - 1))
        cv2.rectangle(self.image, (left, top), (right, bottom), fill, cv2.FILLED)
        if edge is not None:
            cv2.rectangle(self.image, (left, top), (right, bottom), edge, 1)

    def line(self, points: ArrayLike, colour: Colour, thickness: int = 1) -> None:
        """A polyline through points (N, 2)."""
        cv2.polylines(self.image, [_fixed(points)], False, colour, thickness, cv2.LINE_AA, _SHIFT)

    def polygon(self, points: ArrayLike, fill: Colour, edge: Colour | None = None, thickness: int = 1) -> None:
        """A filled polygon with an optional edge."""
        cv2.fillPoly(self.image, [_fixed(points)], fill, cv2.LINE_AA, _SHIFT)
        if edge is not None:
            cv2.polylines(self.image, [_fixed(points)], True, edge, thickness, cv2.LINE_AA, _SHIFT)

    def disc(self, x: float, y: float, radius: float, fill: Colour, edge: Colour, thickness: int = 2) -> None:
        """A filled circle with an edge."""
        centre = tuple(_fixed([[x, y]])[0].tolist())
        size = round(radius * 2**_SHIFT)
        cv2.circle(self.image, centre, size, fill, cv2.FILLED, cv2.LINE_AA, _SHIFT)
        cv2.circle(self.image, centre, size, edge, thickness, cv2.LINE_AA, _SHIFT)

    def text(
        self,
        x: float,
        y: float,
        text: str,
        size: int = 15,
        *,
        weight: int = REGULAR,
        colour: Colour = INK,
        align: float = 0.0,
        halo: Colour | None = None,
    ) -> None:
        """Text with its baseline at y; `align` 0 starts it at x, 0.5 centres it there, 1 ends it there."""
        place = (round(x - align * self.text_width(text, size, weight)), round(y))
        if halo is not None:
            for dx, dy in _AROUND:
                self._put(text, (place[0] + dx, place[1] + dy), halo, size, weight)
        self._put(text, place, colour, size, weight)

    def _put(self, text: str, place: tuple[int, int], colour: Colour, size: int, weight: int) -> None:
        cv2.putText(self.image, text, place, colour, self._font, size, weight)

    def text_width(self, text: str, size: int, weight: int = REGULAR) -> int:
        """Pixels that the text takes along x."""
        _, _, width, _ = cv2.getTextSize((0, 0), text, (0, 0), self._font, size, weight)
        return int(width)

    def shortened(self, text: str, size: int, weight: int, width: int) -> str:
        """The text, cut with an ellipsis if it is wider than `width` pixels."""
        if self.text_width(text, size, weight) <= width:
            return text
        while text and self.text_width(text + "...", size, weight) > width:
            text = text[:-1]
        return text + "..."

    def png(self) -> bytes:
        """The picture as a PNG file."""
        done, data = cv2.imencode(".png", self.image, [cv2.IMWRITE_PNG_COMPRESSION, 6])
        if not done:
            raise RuntimeError("OpenCV could not encode a PNG")
        return bytes(data)


def _fixed(points: ArrayLike) -> NDArray[np.int32]:
    return np.asarray(np.rint(np.asarray(points, np.float64) * 2**_SHIFT), np.int32)
