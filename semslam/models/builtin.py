"""The models that come with the package, each a file of `semslam/data` with a card beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError
from semslam.stages.settings import ExtractConfig, LocalizeConfig

FOLDER = Path(__file__).parent.parent / "data"
_FILES = {
    "detector": "detector.onnx",
    "segmenter_encoder": "segmenter_encoder.onnx",
    "segmenter_decoder": "segmenter_decoder.onnx",
    "map_update": "map_update.onnx",
    "mapnet": "mapnet.onnx",
    "deepvo": "deepvo.onnx",
}


def shipped(role: str) -> Path | None:
    """The shipped model of a role, which is the name of its file; None if this package has none."""
    path = FOLDER / _FILES[role]
    return path if path.is_file() else None


def named_or_shipped(path: str, role: str, key: str) -> Path:
    """The model that setting `key` names, or the shipped one where it is empty.

    Raises:
        SemslamError: neither is there.
    """
    found = Path(path) if path else shipped(role)
    if found is None:
        raise SemslamError(
            f"`{key}` is empty, and this package has no `{_FILES[role]}` of its own",
            hint=f"name one with `--set {key}=FILE.onnx`",
        )
    return found


def with_shipped(config: Any) -> Any:
    """The configuration of a stage with the shipped models named where it leaves them open and may use them.

    Whoever decides about results asks for this one, so that a cache key holds the content of shipped models too.
    """
    if isinstance(config, ExtractConfig):
        return _extract_with_shipped(config)
    return _localize_with_shipped(config) if isinstance(config, LocalizeConfig) else config


def _extract_with_shipped(config: ExtractConfig) -> ExtractConfig:
    """Left to itself, the segmenter goes with the detector of the package alone: it knows the same simulated homes."""
    ours = str(shipped("detector") or "")
    detector, encoder, decoder = config.detector or ours, config.segmenter_encoder, config.segmenter_decoder
    pair = shipped("segmenter_encoder"), shipped("segmenter_decoder")
    own = Path(detector).resolve() == Path(ours).resolve()
    wanted = config.segmenter == "sam" or (config.segmenter == "auto" and own)
    if wanted and not (encoder or decoder) and all(pair):
        encoder, decoder = str(pair[0]), str(pair[1])
    return replace(config, detector=detector, segmenter_encoder=encoder, segmenter_decoder=decoder)


def _localize_with_shipped(config: LocalizeConfig) -> LocalizeConfig:
    """Names only what one of the configuration's own estimators opens: no other may depend on it."""
    paper, mapnet, deepvo = config.paper, config.mapnet, config.deepvo
    if config.uses_map_update:
        paper = replace(paper, model=_or_shipped(paper.model, "map_update"))
    if "mapnet" in config.estimators:
        mapnet = replace(mapnet, model=_or_shipped(mapnet.model, "mapnet"))
    if "deepvo" in config.estimators:
        deepvo = replace(deepvo, model=_or_shipped(deepvo.model, "deepvo"))
    return replace(config, paper=paper, mapnet=mapnet, deepvo=deepvo)


def _or_shipped(path: str, role: str) -> str:
    return path or str(shipped(role) or "")
