"""Recorders that stand in for the simulator: they write small real logs, count their calls, and misbehave on demand.

As a script, this is the command line with `slow` in place of the simulator.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from semslam.logs.messages import Pose
from semslam.logs.writer import Ros2LogWriter
from semslam.sim.dataset import Recording
from semslam.sim.dataset_folder import sha256_file

CALLS, PAUSE = "FAKE_SIM_CALLS", "FAKE_SIM_PAUSE_S"
"""Environment: the file that counts calls, and how long a frame takes."""

Report = Callable[[int], None]


def quick(recording: Recording, log: Path, truth: Path, report: Report) -> list[int]:
    """A log of a few poses that depend on the recording alone, and a file of truth."""
    if os.environ.get(CALLS):
        with open(os.environ[CALLS], "a") as file:
            file.write(f"{recording.name}\n")
    pause_s = float(os.environ.get(PAUSE, "0"))
    with Ros2LogWriter(log) as writer:
        for frame in range(recording.steps):
            stamp = 10**18 + recording.drive_seed * 10**9 + frame
            position = float(recording.home_seed), float(frame), recording.rate_hz
            writer.write("/pose", Pose(stamp, "world", position, (0.0, 0.0, 0.0, 1.0)), stamp)
            time.sleep(pause_s)
            report(frame + 1)
    (truth / "truth.txt").write_text(f"{recording}\n")
    return [4 + (frame + recording.scene) % 3 for frame in range(recording.steps)]


def unlucky(recording: Recording, log: Path, truth: Path, report: Report) -> list[int]:
    """Scene 1 cannot be recorded."""
    if recording.scene == 1:
        raise RuntimeError("the sofa is in the way")
    return quick(recording, log, truth, report)


def dies_once(recording: Recording, log: Path, truth: Path, report: Report) -> list[int]:
    """The first worker that gets scene 1 is killed with the log half written."""
    mark = Path(os.environ[CALLS]).with_suffix(".died")
    if recording.scene == 1 and not mark.exists():
        mark.touch()
        _die(log, truth, report)
    return quick(recording, log, truth, report)


def deadly(recording: Recording, log: Path, truth: Path, report: Report) -> list[int]:
    """Every worker that gets scene 1 is killed with the log half written."""
    if recording.scene == 1:
        _die(log, truth, report)
    return quick(recording, log, truth, report)


def full_disk(recording: Recording, log: Path, truth: Path, report: Report) -> list[int]:
    """No space left at scene 1."""
    if recording.scene == 1:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(log))
    return quick(recording, log, truth, report)


def echo(task: str, report: Report) -> str:
    """A job that gives its task back."""
    report(1)
    return task


def _die(log: Path, truth: Path, report: Report) -> None:
    (truth / "truth.txt").write_text("half")
    with Ros2LogWriter(log) as writer:
        writer.write("/pose", Pose(1, "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), 1)
        report(1)
        os.kill(os.getpid(), signal.SIGKILL)


def tree(root: Path) -> dict[str, str]:
    """SHA-256 of every file of a data set, by path; the lock holds the number of a process that was killed."""
    files = (path for path in root.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(root)): sha256_file(path) for path in sorted(files)}


if __name__ == "__main__":
    from semslam.pipeline.cli import main
    from semslam.sim import simulate
    from tests.fake_sim import quick as importable  # workers import it by this name

    setattr(simulate, "record_home", importable)  # noqa: B010
    main(sys.argv[1:])
