"""Evaluate: scores of known tracks, beside luck and standing still."""

from __future__ import annotations

import json

import pytest

from semslam.pipeline.cli import run_command
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import EVALUATION
from tests.fake_robot import ROBOT_STAGES
from tests.fake_stages import make_log
from tests.pipeline_helpers import World

pytest_plugins = ("tests.pipeline_fixtures",)
Capture = pytest.CaptureFixture[str]


def test_every_estimator_is_scored_beside_luck_and_standing_still(world: World, capsys: Capture) -> None:
    """Four of five keyframes have a pose; the drift sideways is 0, 1, 2, 3 times the step."""
    make_log(world.logs, "a")
    world.run(stages=ROBOT_STAGES, until="localize")
    assert run_command(["evaluate", str(world.out), "--json"], ROBOT_STAGES) == 0
    told = json.loads(capsys.readouterr().out)
    scores = {score["estimator"]: score for score in told["scores"]}
    assert list(scores) == ["paper", "paper_visual", "dead_reckoning", "chance", "standstill"]
    for name, drift in (("paper", 0.1), ("paper_visual", 0.3), ("dead_reckoning", 0.5)):
        assert scores[name]["frames"] == 5
        assert scores[name]["coverage"] == 0.8
        assert scores[name]["ape_m"] == pytest.approx(1.5 * drift)
        assert scores[name]["ape_worst_m"] == pytest.approx(3 * drift)
        assert scores[name]["de_deg"] == 0.0
    assert scores["standstill"]["ape_m"] == pytest.approx(2.0)
    assert scores["chance"]["ape_m"] > 2.0
    table = TableFiles(EVALUATION, [world.out / "results" / "evaluation.parquet"]).read()
    assert table["estimator"] == list(scores)
    assert table["ape_m"] == [score["ape_m"] for score in told["scores"]]


def test_the_table_for_people(world: World, capsys: Capture) -> None:
    """Logs without truth are named, and several logs get a mean."""
    make_log(world.logs, "a")
    make_log(world.logs, "b", numbers=[1])
    make_log(world.logs, "c", "blind")
    world.run("localize.estimators=paper", stages=ROBOT_STAGES, until="localize")
    assert run_command(["evaluate", str(world.out)], ROBOT_STAGES) == 0
    shown = capsys.readouterr()
    assert shown.err == "warning: `c` has no ground truth\n"
    lines = [line.split() for line in shown.out.splitlines()]
    assert lines[0] == ["LOG", "ESTIMATOR", "FRAMES", "COVERAGE", "APE", "DE", "WORST", "APE", "WORST", "DE"]
    assert lines[1] == ["a", "paper", "5", "80.0%", "0.150", "m", "0.00", "deg", "0.300", "m", "0.00", "deg"]
    assert lines[7] == ["mean", "of", "2", "paper", "10", *lines[1][3:]]


def test_without_truth_there_is_nothing_to_compare(world: World, capsys: Capture) -> None:
    """Exit code 1, and how to name the topic."""
    make_log(world.logs, "c", "blind")
    world.run("localize.estimators=paper", stages=ROBOT_STAGES, until="localize")
    assert run_command(["evaluate", str(world.out)], ROBOT_STAGES) == 1
    assert "--topic truth=" in capsys.readouterr().err


def test_poses_older_than_the_observations_are_told(world: World, capsys: Capture) -> None:
    """Extract ran again with other settings, localize did not."""
    make_log(world.logs, "a")
    world.run("localize.estimators=paper", stages=ROBOT_STAGES, until="localize")
    world.run("localize.estimators=paper", "extract.min_score=0.5", stages=ROBOT_STAGES, until="extract")
    assert run_command(["evaluate", str(world.out)], ROBOT_STAGES) == 0
    assert "are older than its observations" in capsys.readouterr().err
