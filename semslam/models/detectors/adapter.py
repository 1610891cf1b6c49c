"""What an adapter is: how a layout of detector is recognised, fed and read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from semslam.models.detections import Detections, Floats, Letterbox
from semslam.models.session import Signature

Array = NDArray[Any]


@dataclass(frozen=True)
class Look:
    """One picture on its way through a detector: how it was fitted, and what is wanted of the answer."""

    box: Letterbox
    min_score: float
    max_overlap: float
    class_names: tuple[str, ...] = ()
    depth_m: Floats | None = None
    """(H, W) of the picture, metres, 0 where missing; None if nobody measured it."""


class Adapter(Protocol):
    """How to feed a layout of detector and how to read it."""

    @property
    def name(self) -> str:
        """As `extract.adapter` calls it."""

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""

    def preprocess(
        self, rgb: NDArray[np.uint8], depth_m: Floats | None, signature: Signature, /
    ) -> tuple[Mapping[str, Array], Letterbox]:
        """The model's inputs by name, for one picture (H, W, 3), each with a first dimension of 1."""

    def postprocess(self, outputs: list[Array], look: Look, signature: Signature, /) -> Detections:
        """Detections in pixels of the picture, from outputs with a first dimension of 1."""

    def classes(self, signature: Signature) -> tuple[int, ...]:
        """How many classes a model that fits may have; empty if its outputs do not tell."""
