"""What `semslam demo` runs on: half a minute of a small robot in a furnished room, and the detector for such rooms.

The log is recorded on the spot and is like any other; only the detector (semslam/data/demo_detector.md) knows these
rooms.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError
from semslam.sim.toy.recording import Plan, record

DEMO_SEED = 128
"""A room whose every keyframe shows three objects or more, and a drive with less wheel drift than most: the map of the
demo is to be read at a glance."""
_PAIRS_PER_S = 2
"""Pairs of images a second; ingest keeps one of two by default."""
_DEPTH_OFFSET_M = (0.0, 0.03, 0.0)
"""The depth camera sits 3 cm to the left of the colour camera, so that the demo registers depth as real logs need."""


def record_demo(
    path: Path, *, seed: int = DEMO_SEED, keyframes: int = 30, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Record the demo's log, an MCAP file of ROS 2 messages, and return its path.

    Args:
        path: file to write; an existing one is replaced.
        seed: room, path and noise.
        keyframes: seconds of driving, which is the number of keyframes at the default of one a second.
        progress: called with image pairs done and all image pairs.

    Raises:
        SemslamError: the file cannot be written.
    """
    plan = Plan(seed, _PAIRS_PER_S * keyframes, _PAIRS_PER_S, depth_offset_m=_DEPTH_OFFSET_M)
    return record(path, plan, progress).path


def demo_settings() -> dict[str, Any]:
    """Configuration that the demo needs beyond the defaults, by key.

    Raises:
        SemslamError: the installed package lacks the detector.
    """
    detector = Path(str(files("semslam") / "data" / "demo_detector.onnx"))
    if not detector.is_file():
        raise SemslamError(
            f"The demo's detector is missing: no file `{detector}`", hint="install again with `pip install .`"
        )
    return {"extract.detector": str(detector)}
