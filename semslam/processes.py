"""What every pool of worker processes needs: how many to start, and that none outlives its parent."""

from __future__ import annotations

import os
import sys


def die_with_parent() -> None:
    """End this process as soon as its parent is gone, so that nobody writes after a killed run."""
    import multiprocessing  # here, because counting processors should cost nothing
    import threading
    from multiprocessing.connection import wait

    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def usable_cpus() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
