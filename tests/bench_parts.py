"""A part for tests that does as it is told; apart, so that its process imports next to nothing."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semslam.bench.store import Part
from semslam.errors import SemslamError


def work(arguments: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A part for tests: counts its calls, and fails as it is told."""
    with (folder / "calls").open("a") as calls:
        calls.write("x")
    how = arguments.get("how")
    if how == "error":
        raise SemslamError("there is no such thing")
    if how == "surprise":
        raise KeyError("surprise")
    if how == "crash":
        os.kill(os.getpid(), 9)
    if how == "hang":
        (folder / "process").write_text(str(os.getpid()))
        time.sleep(60)
    return {"value": arguments["value"]}


def part(value: int = 1, how: str = "", timeout_s: float | None = None) -> Part:
    arguments = {"value": value, "how": how}
    return Part("test", f"part {value}", {"value": value}, "tests.bench_parts:work", arguments, timeout_s)
