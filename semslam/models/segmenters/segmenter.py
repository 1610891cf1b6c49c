"""What a segmenter is, and which one a configuration asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.segmenters.box import BoxSegmenter
from semslam.models.segmenters.depth_box import DepthBoxSegmenter
from semslam.models.segmenters.prompted import PromptedSegmenter, is_prompted
from semslam.models.segmenters.sam import SamSegmenter


class Segmenter(Protocol):
    """Finds the pixels of objects whose boxes are known."""

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], boxes: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Masks (N, H, W) of boxes (N, 4), from colour (H, W, 3) and depth (H, W) in metres, 0 where missing."""


def open_segmenter(kind: str, encoder: str = "", decoder: str = "", threads: int = 1) -> Segmenter:
    """The segmenter a configuration names.

    Args:
        kind: auto, sam, depth_box or box; auto is sam if its two files are given (`builtin.py` may), else depth_box.
        encoder: ONNX file of the image encoder, for sam: semslam's own (its metadata says so) or one of SAM's kind.
        decoder: ONNX file of the mask decoder that belongs to it.
        threads: threads within an operator.

    Raises:
        SemslamError: a file is missing or unsuitable, or only one of the two is given.
    """
    if bool(encoder) != bool(decoder):
        missing = "segmenter-decoder" if encoder else "segmenter-encoder"
        raise SemslamError(
            "A segmenter is an image encoder and a mask decoder", hint=f"give `--{missing} FILE.onnx` too"
        )
    if kind == "sam" and not encoder:
        hint = "give `--segmenter-encoder FILE.onnx --segmenter-decoder FILE.onnx`"
        raise SemslamError("`extract.segmenter` is sam, but no models are given", hint=hint)
    if kind == "sam" or (kind == "auto" and encoder):
        pair = PromptedSegmenter if is_prompted(Path(encoder)) else SamSegmenter
        return pair.open(Path(encoder), Path(decoder), threads=threads)
    return BoxSegmenter() if kind == "box" else DepthBoxSegmenter()
