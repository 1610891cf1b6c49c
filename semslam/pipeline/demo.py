"""What `semslam demo` runs on: half a minute of a small robot in a simulated home, and a detector for such homes.

Both are files of the package with a card beside them that says how they were made; the log is read like any other, and
only the detector knows such homes.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError

LOG, DETECTOR = "demo_home.mcap", "demo_detector.onnx"


def demo_log() -> Path:
    """The bundled log: 30 keyframes of ROS 2 messages.

    Raises:
        SemslamError: the installed package lacks it.
    """
    return _bundled(LOG)


def demo_settings() -> dict[str, Any]:
    """Configuration that the demo needs beyond the defaults, by key.

    Raises:
        SemslamError: the installed package lacks the detector.
    """
    return {"extract.detector": str(_bundled(DETECTOR))}


def _bundled(name: str) -> Path:
    path = Path(str(files("semslam") / "data" / name))
    if not path.is_file():
        raise SemslamError(f"A file of the demo is missing: no `{path}`", hint="install again with `pip install .`")
    return path
