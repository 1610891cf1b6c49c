"""The models that come with the package, each a file of `semslam/data` with a card beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from semslam.stages.settings import ExtractConfig

FOLDER = Path(__file__).parent.parent / "data"
_FILES = {
    "detector": "detector.onnx",
    "segmenter_encoder": "segmenter_encoder.onnx",
    "segmenter_decoder": "segmenter_decoder.onnx",
}


def shipped(role: str) -> Path | None:
    """The shipped model of a role (detector, segmenter_encoder, segmenter_decoder); None if this package has none."""
    path = FOLDER / _FILES[role]
    return path if path.is_file() else None


def with_shipped(config: ExtractConfig) -> ExtractConfig:
    """The configuration with the shipped models named where it leaves them open and may use them.

    Whoever decides about results asks for this one, so that a cache key holds the content of shipped models too.
    """
    detector = config.detector or str(shipped("detector") or "")
    encoder, decoder = config.segmenter_encoder, config.segmenter_decoder
    ours = shipped("segmenter_encoder"), shipped("segmenter_decoder")
    if config.segmenter in ("auto", "sam") and not (encoder or decoder) and all(ours):
        encoder, decoder = str(ours[0]), str(ours[1])
    return replace(config, detector=detector, segmenter_encoder=encoder, segmenter_decoder=decoder)
