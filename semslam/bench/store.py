"""Parts: finished work under the digest of all that it depends on, so that a killed bench goes on where it was.

STORE/<kind>/<digest>/
  facts.json       what the digest was made from
  result.json      written last: the part is finished
  timing.json      seconds it took, outside all digests
  ...              whatever the part makes (networks, checkpoints of a training)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import key_of
from semslam.pipeline.digest import sha256_file
from semslam.pipeline.files import read_json, write_json

_DIGITS = 20
"""Of the digest in the folder's name: enough for any number of parts."""


@dataclass(frozen=True)
class Part:
    """A piece of work that nothing else has to wait for once its inputs are there.

    Attributes:
        kind: folder of the store.
        title: what people read while it runs.
        facts: plain values that the result depends on; equal facts, equal result.
        task: `module:function`, called with (arguments, folder); returns plain values, the result.
        arguments: facts in the form the function needs, such as paths; not part of the digest.
        timeout_s: it is ended after so long; None waits for ever.
    """

    kind: str
    title: str
    facts: Mapping[str, Any]
    task: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    timeout_s: float | None = None

    @property
    def key(self) -> str:
        """Digest of kind and facts."""
        return key_of({"kind": self.kind, "facts": dict(self.facts)})[:_DIGITS]


@dataclass(frozen=True)
class Store:
    """A folder of parts."""

    root: Path

    def folder(self, part: Part) -> Path:
        """Where the part works and leaves its files."""
        return self.root / part.kind / part.key

    def result(self, part: Part) -> dict[str, Any] | None:
        """Its result if it is finished, and the network that it names is there as it was."""
        found = read_json(self.folder(part) / "result.json")
        return found if isinstance(found, dict) and self._whole(part, found) else None

    def _whole(self, part: Part, result: Mapping[str, Any]) -> bool:
        if "digest" not in result:
            return True
        path = self.folder(part) / str(result.get("model"))
        return path.is_file() and sha256_file(path) == result["digest"]

    def seconds(self, part: Part) -> float | None:
        """How long it took, over all its beginnings; None if nobody knows."""
        found = read_json(self.folder(part) / "timing.json")
        return float(found["seconds"]) if isinstance(found, dict) and "seconds" in found else None

    def begin(self, part: Part) -> Path:
        """Its folder, made and labelled."""
        folder = self.folder(part)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "facts.json", {"kind": part.kind, "title": part.title, "facts": dict(part.facts)})
        return folder

    def finish(self, part: Part, result: Mapping[str, Any], seconds: float) -> None:
        """Keep the result; the part is finished once this returns."""
        self.spent(part, seconds)
        write_json(self.folder(part) / "result.json", dict(result), durable=True)

    def spent(self, part: Part, seconds: float) -> None:
        """Add to the time it took."""
        write_json(self.folder(part) / "timing.json", {"seconds": (self.seconds(part) or 0.0) + seconds})
