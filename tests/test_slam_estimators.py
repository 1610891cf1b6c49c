"""Estimators on a small world whose truth is known: what they do at the start, without a match, and after a gap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, UNOBSERVED
from semslam.metrics import Track, score
from semslam.slam.estimator import Estimator, PoseEstimate, Step
from semslam.slam.registry import open_estimator
from semslam.stages.settings import LocalizeConfig, PaperConfig
from tests.slam_world import CELL_M, CLASSES, SIDE, make_steps, make_walk, make_world

SMALL = PaperConfig(
    side=21, headings=90, temperature=0.01, gate_distance_m=0.6, gate_heading_rad=0.3, leak=0.3, map_side=33
)
"""A wider view, a sharper field and fewer headings than the paper's: better and faster."""


def opened(name: str, paper: PaperConfig = SMALL) -> Estimator:
    return open_estimator(name, LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)


def run(estimator: Estimator, steps: Sequence[Step]) -> list[PoseEstimate]:
    return [estimator.step(step) for step in steps]


def track(estimates: Sequence[PoseEstimate]) -> Track:
    poses = [(i, e.map_from_robot) for i, e in enumerate(estimates) if e.map_from_robot]
    frames = [i for i, _ in poses]
    return Track.of(frames, frames, *([getattr(p, a) for _, p in poses] for a in ("x_m", "y_m", "heading_rad")))


def true_track(walk: Sequence[SE2]) -> Track:
    return track([PoseEstimate(pose, "start") for pose in walk])


def test_matching_beats_dead_reckoning_when_the_motion_is_biased() -> None:
    """The promise of the method: clean observations bound the drift that biased motion alone accumulates."""
    walk = make_walk(40)
    truth = true_track(walk)
    errors = {"paper": np.zeros(2), "dead_reckoning": np.zeros(2)}
    for seed in (0, 1):
        steps = make_steps(make_world(seed=seed), walk, bias=SE2(0.1, 0.05, math.radians(2.5)))
        for name, total in errors.items():
            result = score(truth, track(run(opened(name), steps)))
            total += [result.ape_m or 0.0, result.de_deg or 0.0]
    assert (errors["dead_reckoning"] > [1.8, 80.0]).all()  # summed over two worlds
    assert errors["paper"][0] < 0.5 * errors["dead_reckoning"][0]
    assert errors["paper"][1] < 0.25 * errors["dead_reckoning"][1]


def test_visual_mode_never_looks_at_the_motion() -> None:
    """Same track with wrong motions and without any."""
    steps = make_steps(make_world(), make_walk(8), bias=SE2(1.0, 1.0, 1.0))
    without = [replace(step, motion=None) for step in steps]
    estimates = run(opened("paper_visual"), steps)
    assert estimates == run(opened("paper_visual"), without)
    assert [e.source for e in estimates] == ["start"] + ["visual"] * 7


def test_the_first_keyframe_makes_the_map() -> None:
    """Pose known, observation placed from it with the leak, everything out of sight still unobserved."""
    estimator = opened("paper")
    steps = make_steps(make_world(), make_walk(1))
    assert estimator.step(steps[0]) == PoseEstimate(SE2(0.0, 0.0, 0.0), "start")
    belief = estimator.belief()
    assert belief is not None
    assert (belief.cell_m, belief.origin_x_m, belief.origin_y_m) == (0.3, pytest.approx(-4.95), pytest.approx(-4.95))
    assert belief.planes.shape == (len(CLASSES), 33, 33)
    assert belief.planes[FREE_FLOOR, 16, 18] == pytest.approx(SMALL.leak)  # ahead of the robot
    np.testing.assert_array_equal(belief.planes[:, 16, 10], np.eye(len(CLASSES))[UNOBSERVED])  # behind it


def empty_steps(frames: int) -> list[Step]:
    """A robot that sees floor but no object."""
    return make_steps(make_world(objects=0), make_walk(frames))


def test_without_any_object_the_motion_decides() -> None:
    """A flat field is no visual pose; it is reported as flat, and nothing is smeared over the map."""
    estimator = opened("paper")
    estimates = run(estimator, empty_steps(5))
    assert [e.source for e in estimates] == ["start"] + ["inertial"] * 4
    bins = SMALL.headings * SMALL.map_side**2
    assert estimates[-1].peak == pytest.approx(1 / bins)
    assert estimates[-1].entropy_nats == pytest.approx(math.log(bins))
    assert estimates[-1].modes == ()
    assert track(estimates).x_m[-1] == pytest.approx(make_walk(5)[-1].x_m)
    belief = estimator.belief()
    assert belief is not None
    assert belief.planes[FREE_FLOOR].max() > 0.7  # four keyframes at the full leak


def test_visual_mode_without_any_object_stays_where_it_is() -> None:
    """Of all equal scores the last pose is nearest; ties never jump to a corner, and nothing is smeared."""
    estimator = opened("paper_visual")
    estimates = run(estimator, empty_steps(5))
    belief = estimator.belief()
    assert belief is not None
    assert belief.planes[FREE_FLOOR].max() > 0.7
    assert [e.map_from_robot for e in estimates[1:]] == [SE2(pytest.approx(0.0), pytest.approx(0.0), 0.0)] * 4


def test_an_implausible_match_is_refused() -> None:
    """Equation 4: the robot is carried off in the images but not in the motion, so the motion is believed."""
    world, walk = make_world(), make_walk(10)
    steps = make_steps(world, walk)
    carried = replace(steps[9], observation=world.observe(walk[9] @ SE2(1.5, 0.0, 0.0)))
    gated, open_gates = opened("paper"), opened("paper", replace(SMALL, gate_distance_m=1e6, gate_heading_rad=3.2))
    for estimator in (gated, open_gates):
        run(estimator, steps[:9])
    assert gated.step(carried).source == "inertial"
    assert open_gates.step(carried).source == "visual"


def test_without_motion_the_match_is_taken_unchecked() -> None:
    """A visual-inertial track survives a hole in the odometry."""
    walk = make_walk(12)
    steps = make_steps(make_world(), walk)
    steps[6] = replace(steps[6], motion=None)
    estimates = run(opened("paper"), steps)
    assert estimates[6].source == "visual"
    result = score(true_track(walk), track(estimates))
    assert result.coverage == 1.0
    assert result.ape_worst_m is not None
    assert result.ape_worst_m < 0.6


def test_without_an_observation_the_motion_is_taken() -> None:
    """And visual mode has no pose."""
    steps = make_steps(make_world(), make_walk(4))
    steps[2] = replace(steps[2], observation=None)
    assert run(opened("paper"), steps)[2].source == "inertial"
    assert run(opened("paper_visual"), steps)[2] == PoseEstimate(None, "none")


def test_after_a_hole_in_everything_the_next_match_is_believed() -> None:
    """The gates compare with a pose that is out of date, so they would refuse every right match from here on."""
    world, walk = make_world(), make_walk(12)
    jump = SE2(1.0, 0.0, 0.0)
    walk = walk[:6] + [walk[5] @ jump @ walk[5].between(later) for later in walk[6:]]
    steps = make_steps(world, walk)
    steps[6] = replace(steps[6], motion=None, observation=None)
    estimates = run(opened("paper"), steps)
    assert estimates[6] == PoseEstimate(None, "none")
    assert estimates[7].source == "visual"
    found = estimates[7].map_from_robot
    assert found is not None
    assert math.hypot(found.x_m - walk[7].x_m, found.y_m - walk[7].y_m) < 0.4


def test_dead_reckoning_composes_and_holds() -> None:
    """Unknown motion costs that keyframe its pose; the track goes on from the held one."""
    nothing = np.zeros((len(CLASSES), SIDE, SIDE), np.float32)
    motions = [None, SE2(1.0, 0.0, math.pi / 2), None, SE2(1.0, 0.0, 0.0)]
    steps = [Step(i, i, nothing, motion) for i, motion in enumerate(motions)]
    estimates = run(opened("dead_reckoning"), steps)
    assert [e.source for e in estimates] == ["start", "inertial", "none", "inertial"]
    assert estimates[2].map_from_robot is None
    assert estimates[3].map_from_robot == SE2(pytest.approx(1.0), pytest.approx(1.0), pytest.approx(math.pi / 2))


@pytest.mark.parametrize("name", ["paper", "paper_visual", "dead_reckoning"])
@pytest.mark.parametrize("cut", [0, 4, 7])
def test_a_restored_estimator_goes_on_bit_for_bit(name: str, cut: int) -> None:
    """Whatever it was doing: before the start, after it, lost, or in the middle."""
    steps = make_steps(make_world(), make_walk(9), noise_m=0.02)
    steps[6] = replace(steps[6], motion=None, observation=None)
    straight, first, second = opened(name), opened(name), opened(name)
    expected = run(straight, steps)
    run(first, steps[:cut])
    second.restore(first.state())
    assert second.state() == first.state()
    assert run(second, steps[cut:]) == expected[cut:]
    assert second.state() == straight.state()


def test_noise_floor_and_binary_change_what_is_seen() -> None:
    """beta removes faint object cells but never floor; binary makes the rest count fully."""
    planes = make_world(objects=0).observe(SE2(0.0, 0.0, 0.0))
    planes[FIRST_OBJECT, 49, 58], planes[FIRST_OBJECT, 49, 70] = 0.01, 0.3
    plain, binary = opened("paper"), opened("paper", replace(SMALL, binary=True))
    maps = []
    for estimator in (plain, binary):
        estimator.step(Step(0, 0, planes, None))
        belief = estimator.belief()
        assert belief is not None
        maps.append(belief.planes)
    assert np.count_nonzero(maps[0][FIRST_OBJECT]) == 1
    assert maps[0][FIRST_OBJECT].max() == pytest.approx(0.3 * SMALL.leak, abs=2e-6)
    assert maps[1][FIRST_OBJECT].max() == pytest.approx(SMALL.leak, abs=2e-6)
    assert maps[0][FREE_FLOOR].max() == pytest.approx(SMALL.leak)


@pytest.mark.parametrize(
    ("paper", "words"),
    [
        (PaperConfig(cell_m=0.2), ["`localize.paper.cell_m` is 0.2", "`extract.cell_m`", "0.1, 0.3, 0.5, 0.7"]),
        (PaperConfig(cell_m=0.25), ["`localize.paper.cell_m` is 0.25", "0.1, 0.3, 0.5, 0.7"]),
        (PaperConfig(cell_m=0.04), ["`localize.paper.cell_m` is 0.04", "0.1, 0.3, 0.5, 0.7"]),
        (PaperConfig(side=12), ["`localize.paper.side` is 12", "11 or 13"]),
        (PaperConfig(map_side=34), ["`localize.paper.map_side` is 34", "33 or 35"]),
        (PaperConfig(side=37), ["`localize.paper.side` is 37", "`extract.side`", "33 or less"]),
    ],
)
def test_a_grid_that_does_not_fit_is_refused_by_name(paper: PaperConfig, words: list[str]) -> None:
    """The message names both keys and says what would do."""
    with pytest.raises(SemslamError) as caught:
        opened("paper", paper)
    for word in words:
        assert word in caught.value.text()


def test_the_largest_side_that_the_hint_names_is_accepted() -> None:
    """A hint that is wrong is worse than none."""
    opened("paper", PaperConfig(side=33))
    with pytest.raises(SemslamError, match="side"):
        opened("paper", PaperConfig(side=35))


def test_an_unknown_estimator_is_refused_by_name() -> None:
    """With the names that there are."""
    with pytest.raises(SemslamError, match="`rtabmap`"):
        opened("rtabmap")
