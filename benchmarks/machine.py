"""What every benchmark says about where and with what it ran."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path


def machine(*packages: str) -> str:
    """One line: processor, Python, semslam, the packages named, date."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("semslam", *packages))
    cores = f"{os.cpu_count()} cores"
    return f"{_processor()}, {cores}, Python {platform.python_version()}, {versions}, {datetime.date.today()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
