"""Evaluate: scores of known tracks, beside luck and standing still."""

from __future__ import annotations

import json
import math

import pytest

from semslam.geometry.frames import SE2
from semslam.pipeline.cli import run_command
from semslam.pipeline.evaluate import compose
from semslam.pipeline.run_tables import run_tables
from semslam.slam.dead_reckoning import DeadReckoning
from semslam.slam.estimator import Step
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import EVALUATION, MOTION, POSES
from tests.fake_robot import DRIFT_M, ROBOT_STAGES
from tests.fake_stages import make_log
from tests.pipeline_helpers import World

pytest_plugins = ("tests.pipeline_fixtures",)
Capture = pytest.CaptureFixture[str]


def test_every_estimator_is_scored_beside_luck_and_standing_still(world: World, capsys: Capture) -> None:
    """Four of five keyframes have a pose; the drift sideways is 0, 1, 2, 3 times the step."""
    make_log(world.logs, "a")
    world.run("localize.estimators=paper,paper_visual,dead_reckoning", stages=ROBOT_STAGES, until="localize")
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
        assert scores[name]["ok"] == 0.8
        assert scores[name]["ok_wrong"] == {"paper": 0.5, "paper_visual": 0.75, "dead_reckoning": 0.75}[name]
    assert scores["chance"]["ok"] == 0.0
    assert scores["chance"]["ok_wrong"] is None
    assert scores["standstill"]["ape_m"] == pytest.approx(2.0)
    assert scores["chance"]["ape_m"] > 2.0
    table = TableFiles(EVALUATION, [world.out / "results" / "evaluation.parquet"]).read()
    assert table["estimator"] == list(scores)
    assert table["ape_m"] == [score["ape_m"] for score in told["scores"]]


def test_tables_of_a_run_are_found_by_estimator(world: World) -> None:
    """Poses of the one that is named; tables of earlier stages beside them, whichever it is."""
    make_log(world.logs, "a")
    world.run("localize.estimators=paper,dead_reckoning", stages=ROBOT_STAGES, until="localize")
    found = {name: run_tables(world.out, (MOTION, POSES), variant=name)["a"] for name in ("paper", "dead_reckoning")}
    for name, files in found.items():
        assert TableFiles(POSES, files[POSES.name]).read(["y_m"])["y_m"][1] == DRIFT_M[name]
        assert TableFiles(MOTION, files[MOTION.name]).rows == 5
    for name in ("", "mapnet"):
        assert set(run_tables(world.out, (MOTION, POSES), variant=name)["a"]) == {MOTION.name}


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
    head, first, *others = lines
    assert " ".join(head) == "LOG ESTIMATOR FRAMES COVERAGE APE DE WORST APE WORST DE OK OK WRONG"
    assert " ".join(first) == "a paper 5 80.0% 0.150 m 0.00 deg 0.300 m 0.00 deg 80.0% 50.0%"
    assert others[7] == ["mean", "of", "2", "paper", "10", *first[3:]]


def test_dead_reckoning_is_there_without_being_run(world: World, capsys: Capture) -> None:
    """Composed from the measured motion: frames at x 0, 1, -, 2, 3 and y 0, 0.5, -, 0.5, 0.5, the truth at x 0 to 4."""
    make_log(world.logs, "a")
    world.run("localize.estimators=paper", stages=ROBOT_STAGES, until="localize")
    assert run_command(["evaluate", str(world.out), "--json"], ROBOT_STAGES) == 0
    scores = {score["estimator"]: score for score in json.loads(capsys.readouterr().out)["scores"]}
    assert list(scores) == ["paper", "dead_reckoning", "chance", "standstill"]
    found = scores["dead_reckoning"]
    assert found["coverage"] == 0.8
    assert found["ape_m"] == pytest.approx((0 + 0.5 + 2 * math.hypot(1, 0.5)) / 4)
    assert found["ape_worst_m"] == pytest.approx(math.hypot(1, 0.5))


def test_the_track_composed_here_is_that_of_the_estimator() -> None:
    """Turns and unknown steps included."""
    motions = [None, SE2(1.0, 0.2, 0.3), None, SE2(0.5, -0.1, -2.0), SE2(-0.3, 0.0, 1.0)]
    columns = {name: [getattr(m, name[1:]) if m else None for m in motions] for name in ("dx_m", "dy_m")}
    columns["dheading_rad"] = [m.heading_rad if m else None for m in motions]
    frames = list(range(len(motions)))
    track = compose({"frame": frames, "stamp_nanos": frames, **columns})
    estimator = DeadReckoning()
    poses = [estimator.step(Step(frame, frame, None, motion)).map_from_robot for frame, motion in enumerate(motions)]
    assert track.frames.tolist() == [frame for frame, pose in enumerate(poses) if pose]
    known = [pose for pose in poses if pose]
    assert track.x_m.tolist() == [pose.x_m for pose in known]
    assert track.y_m.tolist() == [pose.y_m for pose in known]
    assert track.heading_rad.tolist() == [pose.heading_rad for pose in known]


def test_a_failed_log_is_called_failed(world: World, capsys: Capture) -> None:
    """Not one without ground truth, and not by what an earlier run left of it."""
    path = make_log(world.logs, "a")
    make_log(world.logs, "b", numbers=[1])
    world.run("localize.estimators=paper", stages=ROBOT_STAGES, until="localize")
    path.write_text("broken")
    world.run("localize.estimators=paper", stages=ROBOT_STAGES, until="localize")
    assert run_command(["evaluate", str(world.out), "--json"], ROBOT_STAGES) == 0
    shown = capsys.readouterr()
    assert shown.err == "warning: ingest of `a` failed: No depth topic\n"
    assert {score["log"] for score in json.loads(shown.out)["scores"]} == {"b"}


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
