"""What the simulator needs installed, and Warp set up for it: quiet, on the processor, with a folder it may write to.

MuJoCo and Warp are imported by whoever calls `start_engine`, never by planning or by the command line's start.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from semslam.errors import SemslamError

CACHE_VARIABLE = "WARP_CACHE_PATH"
"""Where Warp keeps compiled kernels, if not in the user's cache folder."""
_NEEDED = ("mujoco", "mujoco_warp", "warp")
_CHATTER = (b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver", b"Warp CUDA error 100: no CUDA")
"""No driver and no card are no news: the simulator never looks for one."""


def require_engine() -> None:
    """Make sure that the simulator's packages are installed, without importing them.

    Raises:
        SemslamError: one is missing.
    """
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        names = ", ".join(f"`{name}`" for name in missing)
        verb = "is" if len(missing) == 1 else "are"
        raise SemslamError(
            f"Simulating needs packages that a plain installation leaves out: {names} {verb} missing",
            hint="pip install 'semslam[sim]'",
        )


@cache
def start_engine() -> None:
    """Import and set up Warp once per process; everything runs on the device `cpu` even where there is a GPU."""
    with without_chatter():
        import warp

        warp.config.log_level = warp.LOG_WARNING
        # For any processor of the kind, not just for this one: as fast as native code, and the same code everywhere.
        flags = getattr(warp.config, "cpu_compiler_flags", None) or ""
        warp.config.cpu_compiler_flags = flags.replace("-march=native", "").strip()
        if not cache_writable():
            warp.config.kernel_cache_dir = _temporary_cache()
        warp.init()  # type: ignore[no-untyped-call]
    warp.set_device("cpu")


def _temporary_cache() -> str:
    folder = tempfile.mkdtemp(prefix="semslam-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@contextmanager
def kernel_cache() -> Iterator[dict[str, str]]:
    """What workers need in their environment to share compiled kernels; nothing where Warp's own folder will do."""
    if cache_writable():
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="semslam-kernels-", ignore_cleanup_errors=True) as folder:
        yield {CACHE_VARIABLE: folder}


def cache_writable() -> bool:
    """Whether Warp can keep compiled kernels where it wants to; it may have to make the folder first."""
    shared = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "warp"
    folder = Path(os.environ.get(CACHE_VARIABLE) or shared)
    existing = next((path for path in (folder, *folder.parents) if path.exists()), Path("/"))
    try:
        with tempfile.TemporaryFile(dir=existing):  # os.access does not know of read-only file systems on all systems
            return True
    except OSError:
        return False


@contextmanager
def without_chatter() -> Iterator[None]:
    """Hold back what native code writes to stderr meanwhile, then pass on all of it but `_CHATTER`."""
    sys.stderr.flush()
    terminal = os.dup(2)
    with tempfile.TemporaryFile() as kept:
        os.dup2(kept.fileno(), 2)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(terminal, 2)
            os.close(terminal)
            kept.seek(0)
            for line in kept:
                if not line.startswith(_CHATTER):
                    os.write(2, line)
