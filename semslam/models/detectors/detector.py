"""A detector: a session, the adapter that fits it, and the names of its classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.class_names import names_from_file, names_from_metadata
from semslam.models.detections import Detections, Floats
from semslam.models.detectors.adapter import Adapter, Array, Look
from semslam.models.detectors.layout import blank_feeds
from semslam.models.detectors.table import ADAPTERS
from semslam.models.session import Session, Signature, open_session


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

    def __call__(
        self, rgb: NDArray[np.uint8], min_score: float, max_overlap: float, depth_m: Floats | None = None
    ) -> Detections:
        """Objects in a picture (H, W, 3) RGB with depth (H, W) in metres, 0 where missing, for models that use it."""
        prepared = self._prepare(rgb, depth_m, min_score, max_overlap)
        return self._read(self.session.run(prepared.feeds), prepared.look)

    def look(
        self, pictures: Sequence[NDArray[np.uint8]], depths_m: Sequence[Floats], min_score: float, max_overlap: float
    ) -> list[Detections]:
        """Objects in each of many pictures: all in one run if the model's batch size is open, else one by one."""
        pairs = zip(pictures, depths_m, strict=True)
        prepared = [self._prepare(rgb, depth_m, min_score, max_overlap) for rgb, depth_m in pairs]
        outputs = self._run_together(prepared) or [self.session.run(one.feeds) for one in prepared]
        return [self._read(answer, one.look) for answer, one in zip(outputs, prepared, strict=True)]

    def _prepare(
        self, rgb: NDArray[np.uint8], depth_m: Floats | None, min_score: float, max_overlap: float
    ) -> _Prepared:
        feeds, box = self.adapter.preprocess(rgb, depth_m, self.signature)
        return _Prepared(feeds, Look(box, min_score, max_overlap, self.class_names, depth_m))

    def _read(self, outputs: list[Array], look: Look) -> Detections:
        return self.adapter.postprocess(outputs, look, self.signature).of_classes(len(self.class_names))

    def _run_together(self, prepared: Sequence[_Prepared]) -> list[list[Array]] | None:
        """The outputs for each picture from one run; None if the model cannot, or does not give one answer each."""
        signature = self.session.signature
        if len(prepared) < 2 or not _open_batch(signature):
            return None
        try:
            joined = {t.name: np.concatenate([one.feeds[t.name] for one in prepared]) for t in signature.inputs}
            outputs = self.session.run(joined)
        except (SemslamError, ValueError):  # its graph does not keep what its inputs promise
            return None
        if any(len(output) != len(prepared) for output in outputs):
            return None
        return [[output[i : i + 1] for output in outputs] for i in range(len(prepared))]


@dataclass(frozen=True)
class _Prepared:
    feeds: Mapping[str, Array]
    look: Look


def _open_batch(signature: Signature) -> bool:
    tensors = (*signature.inputs, *signature.outputs)
    return all(tensor.shape and isinstance(tensor.shape[0], str) for tensor in tensors)


def with_known_sizes(session: Session) -> Signature:
    """The signature with every output size a number: where the file leaves one open, an empty picture is run.

    It stays as it is where that is impossible: a model that is no detector is to be refused in words.
    """
    signature = session.signature
    feeds = blank_feeds(signature)
    if feeds is None or all(isinstance(size, int) for tensor in signature.outputs for size in tensor.shape):
        return signature
    try:
        outputs = session.run(feeds)
    except SemslamError:
        return signature
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
    return SemslamError(
        f"No adapter fits detector `{session.path}`",
        details="\n".join([session.signature.text(), "Tried", *grouped(reasons)]),
        hint="export it in one of these layouts, or name the one it has with `--set extract.adapter=NAME`",
    )


def grouped(reasons: Mapping[str, str]) -> list[str]:
    """One line a reason, adapters with the same one together."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return [f"  {', '.join(who)}: {reason}" for reason, who in names.items()]


def _names(session: Session, counts: tuple[int, ...], path: Path | None) -> tuple[str, ...]:
    """Class names, as many as the model may have."""
    found: Sequence[str] | None
    if path is not None:
        found, where = names_from_file(path), f"`{path}`"
    else:
        found, where = names_from_metadata(session.signature.metadata), "its metadata"
    classes = f"{' or '.join(map(str, counts))} classes" if counts else "classes"
    if found is None:
        raise SemslamError(
            f"Detector `{session.path}` has {classes} and does not say their names",
            hint="give a text file with one name a line: `--classes FILE.txt`",
        )
    if counts and len(found) not in counts:
        raise SemslamError(
            f"Detector `{session.path}` has {classes}, {where} names {len(found)}",
            hint="use the class list that the model was trained with: `--classes FILE.txt`",
        )
    return tuple(found)
