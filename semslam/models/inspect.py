"""`semslam models inspect`: what an ONNX file takes and gives, and what semslam would use it for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from semslam.models.class_names import names_from_metadata
from semslam.models.detectors import grouped, matching, with_known_sizes
from semslam.models.onnxfile import file_digest
from semslam.models.session import Signature, open_session


@dataclass(frozen=True)
class ModelDescription:
    """A model, described."""

    path: str
    sha256: str
    bytes: int
    producer: str
    provider: str
    opset: str
    """Operator sets by domain."""
    signature: Signature
    adapter: str
    """Name of the detector adapter that fits; empty if none does."""
    classes: int | None
    """Number of classes the adapter reads from the outputs; None if they do not tell."""
    class_names: tuple[str, ...]
    """As the metadata has them; empty if it has none."""
    reasons: Mapping[str, str]
    """Why the other adapters do not fit."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def text(self) -> str:
        """For a terminal."""
        lines = [f"{self.path}   {self.bytes:,} bytes, sha256 {self.sha256[:16]}...", self.signature.text()]
        lines += [f"  {self.opset}, producer {self.producer or '-'}, runs on {self.provider}", ""]
        if self.adapter:
            count = "any number of" if self.classes is None else self.classes
            lines.append(f"detector: adapter {self.adapter}, {count} classes")
            lines.append(
                f"class names: {', '.join(self.class_names)}" if self.class_names else "class names: none in it"
            )
            if not self.class_names:
                lines.append("hint: give them with `--classes FILE.txt`")
        else:
            lines.append("detector: no adapter fits")
        lines += [f"  not {line.strip()}" for line in grouped(self.reasons)]
        return "\n".join(lines)


def describe(path: Path) -> ModelDescription:
    """Open a model and describe it.

    Raises:
        SemslamError: the file is no usable model.
    """
    session = open_session(path)
    signature = with_known_sizes(session)
    adapter, reasons = matching(signature)
    counts = adapter.classes(signature) if adapter else ()
    return ModelDescription(
        path=str(path),
        sha256=file_digest(path),
        bytes=path.stat().st_size,
        opset=", ".join(f"{domain} {version}" for domain, version in session.signature.opsets),
        producer=session.signature.producer,
        provider=session.provider,
        signature=session.signature,
        adapter=adapter.name if adapter else "",
        classes=counts[0] if counts else None,
        class_names=tuple(names_from_metadata(session.signature.metadata) or ()),
        reasons=reasons,
    )
