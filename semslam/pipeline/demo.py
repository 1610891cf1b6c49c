"""What `semslam demo` runs on: half a minute of a small robot in a simulated home.

A file of the package with a card beside it that says how it was made; it is read like any other log, with the models
and the configuration that every log gets. The home is none that those models were trained on.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from semslam.errors import SemslamError

LOG = "demo_home.mcap"


def demo_log() -> Path:
    """The bundled log: 30 keyframes of ROS 2 messages.

    Raises:
        SemslamError: the installed package lacks it.
    """
    path = Path(str(files("semslam") / "data" / LOG))
    if not path.is_file():
        raise SemslamError(f"A file of the demo is missing: no `{path}`", hint="install again with `pip install .`")
    return path
