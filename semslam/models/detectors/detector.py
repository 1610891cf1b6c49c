"""A detector: a session, the adapter that fits it, and the names of its classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.class_names import names_from_file, names_from_metadata
from semslam.models.detections import Detections, Floats, Letterbox
from semslam.models.detectors.layout import Array, input_size, one_picture
from semslam.models.detectors.nanodet import Nanodet
from semslam.models.detectors.yolov5 import Yolov5
from semslam.models.detectors.yolov8 import Yolov8
from semslam.models.detectors.yolox import Yolox
from semslam.models.session import Session, Signature, open_session


class Adapter(Protocol):
    """How to feed a layout of detector and how to read it."""

    @property
    def name(self) -> str:
        """As `extract.adapter` calls it."""

    def mismatch(self, signature: Signature) -> str:
        """Why a model is not of this layout; empty if it is."""

    def preprocess(self, rgb: NDArray[np.uint8], signature: Signature) -> tuple[Floats, Letterbox]:
        """The model's input for a picture (H, W, 3)."""

    def postprocess(
        self, outputs: list[Array], box: Letterbox, signature: Signature, min_score: float, max_overlap: float, /
    ) -> Detections:
        """Detections in pixels of the picture."""

    def classes(self, signature: Signature) -> int:
        """Number of classes of a model that fits."""


ADAPTERS: tuple[Adapter, ...] = (Yolox(), Yolox("yolox_decoded", decoded=True), Nanodet(), Yolov5(), Yolov8())
"""All layouts, tried in this order."""


@dataclass(frozen=True)
class Detector:
    """Finds objects in pictures."""

    session: Session
    signature: Signature
    """That of the session, with the sizes of outputs that only a run tells."""
    adapter: Adapter
    class_names: tuple[str, ...]

    @staticmethod
    def open(path: Path, *, classes_path: Path | None = None, adapter: str = "auto", threads: int = 1) -> Detector:
        """Open an ONNX detector.

        Args:
            path: the model.
            classes_path: text file with its class names, one a line; None takes them from the model's metadata.
            adapter: name of its layout; auto recognises it.
            threads: threads within an operator.

        Raises:
            SemslamError: the file is no usable model, no adapter fits, or names are missing or of the wrong number.
        """
        session = open_session(path, threads=threads, what="detector")
        signature = with_known_sizes(session)
        chosen = _choose(session, signature, adapter)
        names = _names(session, chosen.classes(signature), classes_path)
        return Detector(session, signature, chosen, names)

    @property
    def name(self) -> str:
        """Name of the adapter."""
        return self.adapter.name

    @property
    def provider(self) -> str:
        """Execution provider that runs it."""
        return self.session.provider

    def __call__(self, rgb: NDArray[np.uint8], min_score: float, max_overlap: float) -> Detections:
        """Objects in a picture (H, W, 3) RGB."""
        tensor, box = self.adapter.preprocess(rgb, self.signature)
        outputs = self.session.run({self.signature.inputs[0].name: tensor})
        return self.adapter.postprocess(outputs, box, self.signature, min_score, max_overlap)


def with_known_sizes(session: Session) -> Signature:
    """The signature with every output size a number: where the file leaves one open, an empty picture is run."""
    signature = session.signature
    known = all(isinstance(size, int) for tensor in signature.outputs for size in tensor.shape)
    if known or one_picture(signature):
        return signature
    picture = np.zeros((1, 3, *input_size(signature)), np.float32)
    outputs = session.run({signature.inputs[0].name: picture})
    tensors = (replace(tensor, shape=tuple(out.shape)) for tensor, out in zip(signature.outputs, outputs, strict=True))
    return replace(signature, outputs=tuple(tensors))


def matching(signature: Signature) -> tuple[Adapter | None, dict[str, str]]:
    """The adapter that fits, and for each one tried in vain the reason."""
    reasons: dict[str, str] = {}
    for adapter in ADAPTERS:
        reason = adapter.mismatch(signature)
        if not reason:
            return adapter, reasons
        reasons[adapter.name] = reason
    return None, reasons


def _choose(session: Session, signature: Signature, wanted: str) -> Adapter:
    if wanted == "auto":
        adapter, reasons = matching(signature)
        if adapter is None:
            raise _no_adapter(session, reasons)
        return adapter
    by_name = {adapter.name: adapter for adapter in ADAPTERS}
    if wanted not in by_name:
        raise SemslamError(f"No detector adapter `{wanted}`", hint=f"adapters are auto, {', '.join(by_name)}")
    reason = by_name[wanted].mismatch(replace(signature, operators=None))  # who names a layout knows the graph
    if reason:
        raise SemslamError(
            f"Detector `{session.path}` is not of layout `{wanted}`: {reason}",
            details=session.signature.text(),
            hint="let it be recognised with `--set extract.adapter=auto`",
        )
    return by_name[wanted]


def _no_adapter(session: Session, reasons: dict[str, str]) -> SemslamError:
    tried = "\n".join(f"  {name}: {reason}" for name, reason in reasons.items())
    return SemslamError(
        f"No adapter fits detector `{session.path}`",
        details=f"{session.signature.text()}\nTried\n{tried}",
        hint="export it in one of these layouts, or name the one it has with `--set extract.adapter=NAME`",
    )


def _names(session: Session, classes: int, path: Path | None) -> tuple[str, ...]:
    found: Sequence[str] | None
    if path is not None:
        found, where = names_from_file(path), f"`{path}`"
    else:
        found, where = names_from_metadata(session.signature.metadata), "its metadata"
    if found is None:
        raise SemslamError(
            f"Detector `{session.path}` has {classes} classes and does not say their names",
            hint="give a text file with one name a line: `--classes FILE.txt`",
        )
    if len(found) != classes:
        raise SemslamError(
            f"Detector `{session.path}` has {classes} classes, {where} names {len(found)}",
            hint="use the class list that the model was trained with: `--classes FILE.txt`",
        )
    return tuple(found)
