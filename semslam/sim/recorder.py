"""One log of a data set, from its recording to files: home, robot, drive, pictures, log, true tables."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from semslam.errors import SemslamError
from semslam.sim.dataset import Recording

if TYPE_CHECKING:
    from semslam.geometry.camera import Camera
    from semslam.geometry.frames import Matrix
    from semslam.sim.eye import Eye, Sight
    from semslam.sim.home import Home


def record_home(recording: Recording, log: Path, truth: Path, report: Callable[[int], None]) -> tuple[int, ...]:
    """Record a home into the file `log` and its true tables into the folder `truth`; objects in view of every frame.

    `report` is told the frames done. All packages that draw and move are imported here, because planning a data set, or
    hearing that they are not installed, must not need them.

    Raises:
        SemslamError: the home leaves no way to drive, the robot bumped into something, or a file cannot be written.
    """
    from semslam.sim.engine import start_engine

    start_engine()
    import cv2
    import numpy as np

    from semslam.sim.layout import free_raster
    from semslam.sim.log import LogOptions, record_log
    from semslam.sim.truth import TruthCollector, write_truth
    from semslam.sim.vehicle import draw_robot, drive

    cv2.setNumThreads(1)
    options = LogOptions(noise=recording.noise, size=(recording.width, recording.height))
    home, eye = _visit(recording.home_seed, recording.variant, recording.day, options.camera)
    robot, seed = draw_robot(recording.home_seed), recording.drive_seed
    free, origin = free_raster(home)
    motion = drive(home, (free, np.asarray(origin)), robot, seed, steps=recording.steps, rate_hz=recording.rate_hz)
    if motion.contacts:
        raise SemslamError(
            f"The robot of `{recording.name}` touched furniture or a wall {motion.contacts} times",
            hint="use another `--seed`, and report this home",
        )
    collector = TruthCollector(home, motion, options.camera)

    def observe(index: int, stamp_nanos: int, sight: Sight, world_from_camera: Matrix) -> None:
        collector.see(index, stamp_nanos, sight, world_from_camera)
        report(index + 1)

    receipt = record_log(log, home, robot, motion, seed=seed, options=options, observer=observe, eye=eye)
    write_truth(truth, home, robot, motion, collector)
    return receipt.visible_objects


@lru_cache(maxsize=1)  # the next log of this worker is most likely of the same home, which takes seconds to build
def _visit(home_seed: int, variant: str, day: int, camera: Camera) -> tuple[Home, Eye]:
    """A home and an eye in it; looking leaves no trace in either."""
    from semslam.sim.eye import Eye
    from semslam.sim.layout import make_home

    home = make_home(home_seed, variant, day)
    return home, Eye(home, camera)
