"""Small logs with exact truth for every test: `make_log(path, frames=3)` records a drive through a toy room."""

from __future__ import annotations

import math
from pathlib import Path

from tests.toy.recording import Plan, ToyTruth, record

__all__ = ["ToyTruth", "make_log"]


def make_log(
    path: Path,
    *,
    frames: int = 3,
    seed: int = 0,
    size: tuple[int, int] = (160, 120),
    rate_hz: float = 1.0,
    compressed: bool = True,
    imu: bool = True,
    odometry: bool = True,
    tf: bool = True,
    truth: bool = True,
    depth: str = "png",
    noise: bool = True,
    height_m: float = 0.55,
    pitch_rad: float = math.radians(12.0),
    depth_camera_offset: tuple[float, float, float] | None = None,
) -> ToyTruth:
    """Record a log at `path` and return what it was made from; the arguments are those of `Plan`.

    `depth_camera_offset` (forward, left, up; metres) gives depth its own camera with a wider lens; None gives depth
    that is registered to colour already. Without `tf` the IMU sits in the colour camera and has its axes.
    """
    plan = Plan(
        seed=seed,
        frames=frames,
        rate_hz=rate_hz,
        size=size,
        compressed=compressed,
        depth=depth,
        imu=imu,
        odometry=odometry,
        tf=tf,
        truth=truth,
        noise=noise,
        height_m=height_m,
        pitch_rad=pitch_rad,
        depth_offset_m=depth_camera_offset,
    )
    return record(path, plan)
