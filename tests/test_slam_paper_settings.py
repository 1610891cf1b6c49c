"""Every setting of the paper's estimator changes what it should, and nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from semslam.geometry.frames import SE2
from semslam.labels import FIRST_OBJECT, UNOBSERVED
from semslam.slam.estimator import PoseEstimate
from semslam.slam.registry import open_estimator
from semslam.stages.settings import LocalizeConfig, PaperConfig
from tests.slam_world import CELL_M, CLASSES, SIDE, make_steps, make_walk, make_world

SHARP = PaperConfig(side=21, headings=72, temperature=0.01)
"""A wider view than the paper's and a field that knows what it wants, so that the visual pose is right."""
MOVED, TURNED = SE2(0.9, 0.0, 0.0), SE2(0.0, 0.0, math.radians(40))


def carried_off(paper: PaperConfig, by: SE2) -> PoseEstimate:
    """The answer to a keyframe at which the pictures moved by `by` more than the motion says."""
    world, walk = make_world(), make_walk(8)
    estimator = open_estimator("paper", LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)
    steps = make_steps(world, walk)
    for step in steps[:-1]:
        estimator.step(step)
    return estimator.step(replace(steps[-1], observation=world.observe(walk[-1] @ by)))


@pytest.mark.parametrize(
    ("by", "distance_m", "heading_rad", "gate", "source"),
    [
        (MOVED, 0.5, 0.3, "all", "inertial"),
        (MOVED, 0.5, 0.3, "any", "visual"),  # the heading agrees
        (MOVED, 1.5, 0.3, "all", "visual"),  # gamma_1 lets it through
        (MOVED, 1.5, 1e-9, "all", "inertial"),  # gamma_2 stops it
        (TURNED, 0.5, 0.3, "all", "inertial"),
        (TURNED, 0.5, 0.3, "any", "visual"),  # the place agrees
        (TURNED, 0.5, 1.0, "all", "visual"),  # gamma_2 lets it through
        (TURNED, 1e-9, 1.0, "all", "inertial"),  # gamma_1 stops it
    ],
)
def test_gates_and_their_connective(by: SE2, distance_m: float, heading_rad: float, gate: str, source: str) -> None:
    """Equation 4: `all` or `any` of two gates, each in its own unit."""
    paper = replace(SHARP, gate_distance_m=distance_m, gate_heading_rad=heading_rad, gate=gate)
    assert carried_off(paper, by).source == source


def second_keyframe(paper: PaperConfig) -> PoseEstimate:
    """The visual answer to the second keyframe of a clean walk."""
    estimator = open_estimator("paper_visual", LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)
    return [estimator.step(step) for step in make_steps(make_world(), make_walk(2))][-1]


def test_temperature_sharpens_the_field_and_moves_no_pose() -> None:
    """Equation 2: the same best bin, with more or less of the probability."""
    estimates = [second_keyframe(replace(SHARP, temperature=t)) for t in (1.0, 0.1, 0.01)]
    assert len({e.map_from_robot for e in estimates}) == 1
    peaks = [e.peak for e in estimates]
    entropies = [e.entropy_nats for e in estimates]
    assert all(peaks)
    assert peaks == sorted(peaks, key=lambda p: p or 0.0)
    assert peaks[2] > 10 * (peaks[0] or 1.0)
    assert entropies == sorted(entropies, key=lambda e: -(e or 0.0))


@pytest.mark.parametrize("headings", [8, 120, 360])
def test_headings_are_whole_bins(headings: int) -> None:
    """R: the visual pose lies in one of R headings, the nearest that there is."""
    estimate = second_keyframe(replace(SHARP, headings=headings))
    found = estimate.map_from_robot
    assert found is not None
    turns = found.heading_rad * headings / math.tau
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert abs(found.heading_rad - math.tau / 24) < max(math.radians(6), math.pi / headings + 1e-9)


@pytest.mark.parametrize("side", [11, 33])
def test_the_side_of_the_observation_bounds_what_the_map_takes_up(side: int) -> None:
    """h: at 0.3 m a cell, 11 cells see 1.65 m ahead, 33 see as far as the camera."""
    paper = replace(SHARP, side=side, headings=8, map_side=45)
    estimator = open_estimator("paper", LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)
    estimator.step(make_steps(make_world(), make_walk(1))[0])
    belief = estimator.belief()
    assert belief is not None
    seen = np.argwhere(np.delete(belief.planes, UNOBSERVED, axis=0).any(0)) - 45 // 2
    assert np.abs(seen).max() == {11: 5, 33: 15}[side]  # 4.5 m is 15 cells


def test_binary_observations_count_fully() -> None:
    """Every object cell above the noise floor scores alike, so the scores rise and the field sharpens."""
    plain, binary = (second_keyframe(replace(SHARP, temperature=1.0, binary=b)) for b in (False, True))
    assert plain.peak
    assert binary.peak
    assert binary.peak > plain.peak
    world = np.zeros((2, 33, 33), np.float32)
    for index, flag in enumerate((False, True)):
        paper = replace(SHARP, binary=flag, leak=1.0)
        estimator = open_estimator("paper", LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)
        estimator.step(make_steps(make_world(), make_walk(1))[0])
        belief = estimator.belief()
        assert belief is not None
        world[index] = belief.planes[FIRST_OBJECT:].max(0)
    assert world[1][world[0] >= SHARP.noise_floor] == pytest.approx(1.0)
    assert world[0].max() < 1.0


def test_the_leak_is_the_share_of_what_is_new() -> None:
    """alpha of equation 10: the first keyframe puts that share of itself on the map."""
    for leak in (0.1, 0.7, 1.0):
        paper = replace(SHARP, leak=leak)
        estimator = open_estimator("paper", LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)
        estimator.step(make_steps(make_world(objects=0), make_walk(1))[0])
        belief = estimator.belief()
        assert belief is not None
        assert belief.planes[1].max() == pytest.approx(leak)
