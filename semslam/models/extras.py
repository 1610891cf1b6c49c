"""Packages that a plain installation leaves out."""

from __future__ import annotations

from importlib.util import find_spec

from semslam.errors import SemslamError

_FOR_TRAINING = ("torch", "onnx", "onnxscript", "pycocotools")


def require_torch() -> None:
    """Make sure that what trains and exports networks is installed, without importing it.

    Raises:
        SemslamError: a package is missing.
    """
    missing = [name for name in _FOR_TRAINING if find_spec(name) is None]
    if missing:
        names = ", ".join(f"`{name}`" for name in missing)
        verb = "is" if len(missing) == 1 else "are"
        raise SemslamError(
            f"Training and export need packages that a plain installation leaves out: {names} {verb} missing",
            hint="pip install 'semslam[train]'",
        )
