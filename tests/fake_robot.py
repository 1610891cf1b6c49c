"""Stand-ins for ingest and localize that write tracks known in advance, under the real stages' names and tables."""

from __future__ import annotations

from dataclasses import replace

from semslam.stages.catalogue import STAGES
from semslam.stages.contract import LogRefusedError, StageContext
from semslam.tables.spec import MOTION, POSES, TRUTH

FRAMES = 5
DRIFT_M = {"paper": 0.1, "paper_visual": 0.3, "dead_reckoning": 0.5}


def ingest(ctx: StageContext) -> None:
    """A robot that drives along x, one metre a keyframe; a log that says `blind` has no truth, `broken` is refused.

    The measured motion slips sideways once and is unknown once.
    """
    if b"broken" in ctx.sources[0].read_bytes():
        raise LogRefusedError("No depth topic")
    with ctx.shard(0) as shard:
        for table in STAGES[0].writes:
            if table not in (TRUTH, MOTION):
                shard.table(table)
        shard.table(MOTION).append(
            {
                **_stamps(),
                "dx_m": [None, 1.0, None, 1.0, 1.0],
                "dy_m": [None, 0.5, None, 0.0, 0.0],
                "dheading_rad": [None, 0.0, None, 0.0, 0.0],
                "source": ["start", "odometry", "none", "odometry", "odometry"],
            }
        )
        if b"blind" not in ctx.sources[0].read_bytes():
            zeros = [0.0] * FRAMES
            columns = {"x_m": [float(i) for i in range(FRAMES)], "y_m": zeros, "z_m": zeros, "heading_rad": zeros}
            shard.table(TRUTH).append({**_stamps(), **columns, "roll_rad": zeros, "pitch_rad": zeros})


def extract(ctx: StageContext) -> None:
    """Nothing was seen."""
    with ctx.shard(0) as shard:
        for table in STAGES[1].writes:
            shard.table(table, {"score": ctx.config.min_score})


def localize(ctx: StageContext) -> None:
    """A track that drifts sideways, and has no pose at the last keyframe."""
    drift = DRIFT_M[ctx.variant]
    x_m = [float(i) for i in range(FRAMES - 1)] + [None]
    y_m = [drift * i for i in range(FRAMES - 1)] + [None]
    heading_rad = [0.0] * (FRAMES - 1) + [None]
    empty: list[list[float]] = [[]] * FRAMES
    with ctx.shard(0) as shard:
        for table in STAGES[2].writes:
            shard.table(table)
        shard.table(POSES).append(
            {
                **_stamps(),
                "x_m": x_m,
                "y_m": y_m,
                "heading_rad": heading_rad,
                "source": ["inertial"] * FRAMES,
                "verdict": ["ok"] * (FRAMES - 1) + ["lost"],
                "covariance": [[1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6]] * (FRAMES - 1) + [[]],
                "peak": [None] * FRAMES,
                "entropy_nats": [None] * FRAMES,
                **{f"mode_{name}": empty for name in ("x_m", "y_m", "heading_rad", "probability")},
            }
        )


def _stamps() -> dict[str, list[int]]:
    return {"frame": list(range(FRAMES)), "stamp_nanos": [10**9 * i for i in range(FRAMES)]}


ROBOT_STAGES = tuple(replace(stage, entry=f"tests.fake_robot:{stage.name}") for stage in STAGES[:3])
