"""Metrics against numbers worked out by hand and against evo."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from semslam.geometry.frames import SE2
from semslam.metrics import Score, Track, chance, chance_errors, errors, score, standstill, trusted
from semslam.slam.exchange import tum


def track_of(poses: dict[int, SE2]) -> Track:
    columns = ([getattr(pose, name) for pose in poses.values()] for name in ("x_m", "y_m", "heading_rad"))
    return Track.of(list(poses), [frame * 10**9 for frame in poses], *columns)


def test_by_hand() -> None:
    """Errors of 0, 5 and 1 m and of 0, 90 and 30 degrees; the truth lives in a frame of its own."""
    world_from_map = SE2(10.0, -4.0, math.radians(120))
    truth = {0: SE2(0, 0, 0), 1: SE2(1, 0, 0), 2: SE2(2, 0, math.pi)}
    estimate = {0: SE2(0, 0, 0), 1: SE2(4, 4, math.pi / 2), 2: SE2(2, 1, -math.pi + math.radians(30))}
    result = score(track_of({i: world_from_map @ pose for i, pose in truth.items()}), track_of(estimate))
    assert result == Score(3, 1.0, *(pytest.approx(v) for v in (2.0, 40.0, 5.0, 90.0)))


def test_what_an_ok_is_worth() -> None:
    """Of the keyframes called ok those count as wrong that are beyond either bound; others do not count."""
    truth = track_of({i: SE2(float(i), 0, 0) for i in range(5)})
    estimate = track_of(
        {0: SE2(0, 0, 0), 1: SE2(1.1, 0, 0), 2: SE2(2, 0.4, 0), 3: SE2(3, 0, math.radians(3)), 4: SE2(9, 9, 1)}
    )
    plain, wrong = score(truth, estimate), errors(truth, estimate)
    assert (plain.ok, plain.ok_wrong) == (0.0, None)
    assert trusted(plain, wrong, [], 0.2, 2.0) == plain
    found = trusted(plain, wrong, [0, 1, 2, 3], 0.2, 2.0)
    assert (found.ok, found.ok_wrong, found.ape_m) == (0.8, 0.5, plain.ape_m)
    assert trusted(plain, wrong, [0, 1, 2, 3], 0.5, 4.0).ok_wrong == 0.0


def test_keyframes_without_a_pose_lower_the_coverage_only() -> None:
    """An estimator that gives up is not rewarded by better errors without a trace."""
    truth = track_of({i: SE2(float(i), 0, 0) for i in range(10)})
    estimate = Track.of(
        [0, 1, 2, 11], [0, 0, 0, 0], [0.0, None, 2.0, 5.0], [0.0, None, 1.0, 5.0], [0.0, None, 0.0, 0.0]
    )
    result = score(truth, estimate)
    assert (result.frames, result.coverage) == (10, pytest.approx(0.2))
    assert result.ape_m == pytest.approx(0.5)


def test_errors_keyframe_by_keyframe() -> None:
    """Those of the keyframes that have a pose, under their numbers."""
    truth = track_of({i: SE2(float(i), 0, 0) for i in range(4)})
    found = errors(truth, track_of({0: SE2(0, 0, 0), 2: SE2(2, 3, math.pi / 2), 3: SE2(3, 0, -0.1)}))
    assert found.frames.tolist() == [0, 2, 3]
    assert found.distance_m.tolist() == pytest.approx([0.0, 3.0, 0.0])
    assert found.turn_deg.tolist() == pytest.approx([0.0, 90.0, math.degrees(0.1)])
    assert len(errors(truth, track_of({})).frames) == 0


def test_chance_keyframe_by_keyframe_has_the_same_mean() -> None:
    """It grows with the distance from the middle of the map."""
    truth = track_of({i: SE2(0.5 * i, 0, 0) for i in range(8)})
    found, whole = chance_errors(truth), chance(truth)
    assert found.distance_m.mean() == pytest.approx(whole.ape_m)
    assert found.turn_deg.mean() == pytest.approx(whole.de_deg)
    assert found.distance_m[7] > found.distance_m[0] + 0.5


def test_nothing_in_common_has_no_errors() -> None:
    """Null, not zero."""
    nowhere = score(track_of({0: SE2(0, 0, 0)}), track_of({}))
    assert nowhere == Score(1, 0.0, None, None, None, None)
    assert score(track_of({}), track_of({0: SE2(0, 0, 0)})).ape_m is None


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.14, 3.14))
def test_the_frame_of_the_truth_does_not_matter(x: float, y: float, heading: float) -> None:
    """Only the first pose is aligned, so moving the whole truth changes nothing."""
    truth = {0: SE2(0, 0, 0), 1: SE2(1, 0.5, 0.3), 2: SE2(2, 1.5, 2.9)}
    estimate = track_of({0: SE2(0, 0, 0), 1: SE2(1.1, 0.5, 0.4), 2: SE2(2, 1, -2.9)})
    moved = score(track_of({i: SE2(x, y, heading) @ pose for i, pose in truth.items()}), estimate)
    plain = score(track_of(truth), estimate)
    assert moved.ape_m == pytest.approx(plain.ape_m, abs=1e-9)
    assert moved.de_deg == pytest.approx(plain.de_deg, abs=1e-6)


def random_walk(seed: int) -> dict[int, SE2]:
    random = np.random.default_rng(seed)
    poses = {0: SE2(0.0, 0.0, 0.0)}
    for frame in range(1, 40):
        poses[frame] = poses[frame - 1] @ SE2(*random.normal([0.3, 0.0, 0.1], 0.1))
    return poses


def test_equal_to_evo_without_alignment(tmp_path: Path) -> None:
    """Translation part and rotation angle of evo's APE on TUM files, both tracks starting at the same pose."""
    truth, estimate = random_walk(1), random_walk(2)
    for name, poses in (("truth", truth), ("estimate", estimate)):
        lines = tum((1_700_000_000 * 10**9 + i * 10**9 + 7, p.x_m, p.y_m, p.heading_rad) for i, p in poses.items())
        (tmp_path / name).write_text(lines)
    pair = sync.associate_trajectories(
        *(file_interface.read_tum_trajectory_file(str(tmp_path / name)) for name in ("truth", "estimate"))
    )
    result = score(track_of(truth), track_of(estimate))
    for relation, mean, worst in (
        (evo_metrics.PoseRelation.translation_part, result.ape_m, result.ape_worst_m),
        (evo_metrics.PoseRelation.rotation_angle_deg, result.de_deg, result.de_worst_deg),
    ):
        ape = evo_metrics.APE(relation)
        ape.process_data(pair)
        assert mean == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.mean), abs=1e-6)
        assert worst == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.max), abs=1e-6)


def test_standstill_scores_the_distance_from_the_start() -> None:
    """0, 1 and 2 m; the heading of a robot that turned by a right angle at the end."""
    truth = track_of({0: SE2(5, 5, 1), 1: SE2(5, 5, 1) @ SE2(1, 0, 0), 2: SE2(5, 5, 1) @ SE2(0, 2, math.pi / 2)})
    assert standstill(truth) == Score(3, 1.0, *(pytest.approx(v) for v in (1.0, 30.0, 2.0, 90.0)))


def test_chance_at_the_centre_of_the_paper_map() -> None:
    """90 degrees, and 3.79 m: the mean distance of a 9.9 m square from its centre (0.3826 sides)."""
    result = chance(track_of({i: SE2(0, 0, 0) for i in range(50)}))
    assert result.ape_m == pytest.approx(0.3826 * 9.9, rel=0.01)
    assert result.de_deg == pytest.approx(90.0, rel=0.01)
    assert result.ape_worst_m is not None
    assert 6.0 < result.ape_worst_m < 4.95 * math.sqrt(2)


def test_chance_is_repeatable_and_grows_with_the_map() -> None:
    """Same seed, same figures."""
    truth = track_of({i: SE2(0.1 * i, 0, 0) for i in range(20)})
    assert chance(truth) == chance(truth)
    assert chance(truth, seed=1) != chance(truth)
    small, large = chance(truth, 2.0).ape_m, chance(truth, 20.0).ape_m
    assert small is not None
    assert large is not None
    assert small < large
    assert chance(track_of({})).ape_m is None
