"""Class lists: the reserved classes every map has, then the object classes of a run.

A class list is data (data_spec.md, "Classes"): observations, snapshots and map cells carry the list they were made
with, and a class id is an index into it.
"""

from __future__ import annotations

from collections.abc import Sequence

UNOBSERVED = 0
"""Nobody has seen the cell."""
FREE_FLOOR = 1
"""Floor was seen in the cell, and nothing stands on it."""
OBSTACLE = 2
"""A surface above the floor that belongs to no detected object: walls, unknown furniture."""

RESERVED: tuple[str, ...] = ("unobserved", "free_floor", "obstacle")
FIRST_OBJECT = len(RESERVED)


def class_list(object_classes: Sequence[str]) -> tuple[str, ...]:
    """All class names of a run: the reserved ones, then the object classes in the order given."""
    return RESERVED + tuple(object_classes)
