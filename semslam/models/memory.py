"""What the allocator does with the memory of large arrays."""

from __future__ import annotations

import numpy as np

_KEPT_BYTES = 24 << 20
"""Larger than any array of a keyframe, and below the 32 MiB up to which glibc learns."""


def keep_freed_memory() -> None:
    """Have the allocator keep what one keyframe frees for the next.

    glibc returns blocks of a picture's size to the system at once, until one as large has been freed; to have them
    anew, page by page, took a third of a keyframe's time outside the models, and two fifths of a step of the paper's
    estimator. Elsewhere this does nothing.
    """
    np.empty(_KEPT_BYTES, np.uint8)
