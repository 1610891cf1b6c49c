"""Our errors are those of evo, the usual tool, on the trajectory file that `export` writes."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("evo", reason="compares with evo: pip install evo")

from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from semslam.bench.tracks import Pipeline, stored_track, true_track
from semslam.metrics import score
from semslam.slam.exchange import tum
from semslam.stages.catalogue import STAGES
from semslam.tables.spec import POSES
from tests.bench_world import make_dataset

FRAMES = 5


def evo_track(path: Path) -> PoseTrajectory3D:
    return file_interface.read_tum_trajectory_file(str(path))


def test_errors_of_an_exported_track_are_evos(tmp_path: Path) -> None:
    """Mean and worst position and heading error, both tracks seen from their first pose, to a micrometre."""
    homes = make_dataset(tmp_path / "homes", scenes=1, trajectories=1, frames=FRAMES)
    settings = {"localize.estimators": ["dead_reckoning"]}
    with Pipeline.opened(tmp_path / "out", STAGES, homes, workers=0) as pipeline:
        runs = pipeline.run("export", ["toy_00_t0"], settings)
    assert not runs.failures
    truth = true_track(homes, "toy_00_t0", FRAMES)
    ours = score(truth, stored_track(runs.files("toy_00_t0", POSES), truth))
    rows = zip(truth.stamp_nanos.tolist(), truth.x_m, truth.y_m, truth.heading_rad, strict=True)
    (tmp_path / "truth.tum").write_text(tum(rows))
    exported = tmp_path / "out" / "results" / "toy_00_t0" / "dead_reckoning" / "trajectory.tum"
    expected, found = sync.associate_trajectories(evo_track(tmp_path / "truth.tum"), evo_track(exported))
    assert expected.num_poses == FRAMES
    found.align_origin(expected)
    assert ours.ape_m is not None
    assert ours.ape_m > 1e-4
    for relation, mean, worst in (
        (evo_metrics.PoseRelation.translation_part, ours.ape_m, ours.ape_worst_m),
        (evo_metrics.PoseRelation.rotation_angle_deg, ours.de_deg, ours.de_worst_deg),
    ):
        ape = evo_metrics.APE(relation)
        ape.process_data((expected, found))
        assert mean == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.mean), abs=1e-6)
        assert worst == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.max), abs=1e-6)
