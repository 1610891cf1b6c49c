"""Colours of the map picture: few, distinct, also for colour-blind eyes, and the same for a class on every picture."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

Colour = tuple[int, int, int]
"""Blue, green, red, 0 to 255, as OpenCV orders them."""


def _rgb(text: str) -> Colour:
    red, green, blue = (int(text[i : i + 2], 16) for i in (0, 2, 4))
    return blue, green, red


PAGE = _rgb("FFFFFF")
INK = _rgb("1F2933")
SOFT_INK = _rgb("616E7C")
HAIRLINE = _rgb("CBD2D9")
UNKNOWN = _rgb("E4E7EB")
FREE = _rgb("FFFFFF")
OBSTACLE = _rgb("52606D")
TRACK = _rgb("D6006E")

OBJECTS: tuple[Colour, ...] = tuple(
    _rgb(text)
    for text in (
        "E69F00", "56B4E9", "009E73", "0072B2", "F0E442", "D55E00", "882255", "44AA99",
        "999933", "332288", "DDAA77", "117733", "8C564B", "7FC97F", "B07AE0", "00CED1",
    )
)  # fmt: skip
"""Okabe and Ito 2008, then Tol's muted set and fillers; pinks are left to the trajectory, greys to the background."""

_HOUSEHOLD = (
    "chair", "couch", "dining table", "bed", "potted plant", "tv", "refrigerator", "sink",
    "toilet", "laptop", "desk", "book", "oven", "bottle", "cup", "microwave",
)  # fmt: skip
"""Class names that have the colour of the same place in `OBJECTS` wherever they appear."""

_SPELLINGS = {"diningtable": "dining table", "pottedplant": "potted plant", "tvmonitor": "tv", "sofa": "couch"}
"""How older COCO and VOC lists spell some of them."""


def class_colours(names: Iterable[str]) -> dict[str, Colour]:
    """A colour for every class name on one picture.

    Known names have fixed colours, others the one their name hashes to; if that is taken, the next free one. Colours
    repeat only beyond sixteen classes.
    """
    wanted = sorted(set(names), key=lambda name: (_SPELLINGS.get(name, name) not in _HOUSEHOLD, name))
    slots: dict[str, int] = {}
    for name in wanted:
        slot = _slot(name)
        while slot in slots.values() and len(slots) < len(OBJECTS):
            slot = (slot + 1) % len(OBJECTS)
        slots[name] = slot
    return {name: OBJECTS[slot] for name, slot in slots.items()}


def _slot(name: str) -> int:
    known = _SPELLINGS.get(name, name)
    if known in _HOUSEHOLD:
        return _HOUSEHOLD.index(known)
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big") % len(OBJECTS)


def darker(colour: Colour) -> Colour:
    """The same hue for outlines."""
    blue, green, red = (round(channel * 0.62) for channel in colour)
    return blue, green, red
