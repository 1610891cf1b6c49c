"""The learned map update at run time: equation 8 on the region of interest, its files, and the estimator with it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.labels import FIRST_OBJECT, UNOBSERVED
from semslam.slam.estimator import Step
from semslam.slam.learned_map import LearnedMap
from semslam.slam.registry import open_estimator
from semslam.stages.settings import LocalizeConfig, PaperConfig
from tests.map_update_factory import KAPPA, make_map_update, slow_update
from tests.slam_world import CELL_M, CLASSES, SIDE, make_steps, make_walk, make_world

PAPER = PaperConfig(headings=36, temperature=0.01, gate_distance_m=0.6, gate_heading_rad=0.3, update="learned")
WINDOW = (slice(2, 13), slice(0, 9))
Array = NDArray[np.float32]


def opened(model: Path, map_side: int = 15) -> LearnedMap:
    return LearnedMap.open(model, CLASSES, map_side, 0.3, 11)


def random_placed(window: tuple[slice, slice] = WINDOW, seed: int = 0) -> Array:
    shape = (len(CLASSES), *(part.stop - part.start for part in window))
    return np.random.default_rng(seed).random(shape, np.float32)


@pytest.mark.parametrize("kernel", [3, 1])
def test_the_region_alone_gives_what_the_whole_map_would(tmp_path: Path, kernel: int) -> None:
    """Equation 8 masked by equation 7, step after step: the halo makes the region's border an ordinary place."""
    learned = opened(make_map_update(tmp_path / "update.onnx", CLASSES, kernel=kernel))
    hidden = np.zeros((len(CLASSES), 15, 15), np.float32)
    hidden[UNOBSERVED] = 1.0
    cell = np.zeros_like(hidden)
    for seed, window in enumerate((WINDOW, (slice(4, 15), slice(3, 14)), (slice(0, 6), slice(9, 15)), WINDOW)):
        placed = np.zeros_like(hidden)
        part = (slice(None), *window)
        placed[part] = random_placed(window, seed)
        learned.update(placed[part], window)
        for state, new in zip((hidden, cell), slow_update(hidden, cell, placed, kernel), strict=True):
            state[part] = new[part]
        raised = np.exp(KAPPA * hidden.astype(np.float64))
        np.testing.assert_allclose(learned.planes, raised / raised.sum(0), atol=1e-5)


def test_cells_outside_the_region_keep_every_bit(tmp_path: Path) -> None:
    """Of hidden state, cell state and read-out."""
    learned = opened(make_map_update(tmp_path / "update.onnx", CLASSES))
    learned.update(random_placed(), WINDOW)
    before = {**{name: state.copy() for name, state in learned.arrays().items()}, "planes": learned.planes.copy()}
    window = (slice(6, 9), slice(5, 14))
    learned.update(random_placed(window, 1), window)
    for name, state in {**learned.arrays(), "planes": learned.planes}.items():
        changed = (state != before[name]).any(0)
        assert changed[window].all()
        changed[window] = False
        assert not changed.any(), name


def test_an_empty_region_changes_nothing(tmp_path: Path) -> None:
    """A pose far off the map."""
    learned = opened(make_map_update(tmp_path / "update.onnx", CLASSES))
    before = learned.planes.copy()
    learned.update(np.zeros((len(CLASSES), 5, 0), np.float32), (slice(2, 7), slice(15, 15)))
    np.testing.assert_array_equal(learned.planes, before)


def test_a_new_map_is_a_class_map_that_knows_nothing(tmp_path: Path) -> None:
    """Probabilities in every cell, unobserved the likeliest; the network's file may set the state they come from."""
    learned = opened(make_map_update(tmp_path / "update.onnx", CLASSES))
    np.testing.assert_allclose(learned.planes.sum(0), 1.0, rtol=1e-6)
    assert (learned.planes.argmax(0) == UNOBSERVED).all()
    start = [0.0] * len(CLASSES)
    start[4] = 2.0
    other = opened(make_map_update(tmp_path / "other.onnx", CLASSES, initial_hidden=start, initial_cell=start))
    assert (other.planes.argmax(0) == 4).all()
    assert other.arrays()["cell"][4].min() == 2.0


def estimator(model: Path, name: str = "paper", **changes: Any) -> Any:
    config = LocalizeConfig(paper=replace(PAPER, model=str(model), **changes))
    return open_estimator(name, config, CLASSES, CELL_M, SIDE)


def test_the_estimator_matches_with_what_the_network_remembers(tmp_path: Path) -> None:
    """Its belief is the network's read-out, and its poses differ from those of the leaky average."""
    model = make_map_update(tmp_path / "update.onnx", CLASSES)
    steps = make_steps(make_world(), make_walk(6), noise_m=0.05)
    learned, leaky = estimator(model, "paper_visual"), estimator(model, "paper_visual", update="leaky")
    tracks = [[one.step(step).map_from_robot for step in steps] for one in (learned, leaky)]
    assert tracks[0] != tracks[1]
    belief = learned.belief().planes
    np.testing.assert_allclose(belief.sum(0), 1.0, rtol=1e-5)
    assert belief[FIRST_OBJECT:].max() > 0.2


@pytest.mark.parametrize("cut", [0, 3, 5])
def test_a_restored_estimator_goes_on_bit_for_bit(tmp_path: Path, cut: int) -> None:
    """Hidden state, cell state and read-out."""
    model = make_map_update(tmp_path / "update.onnx", CLASSES)
    steps = make_steps(make_world(), make_walk(7), noise_m=0.02)
    straight, first, second = (estimator(model) for _ in range(3))
    expected = [straight.step(step) for step in steps]
    for step in steps[:cut]:
        first.step(step)
    second.restore(first.state())
    assert second.state() == first.state()
    assert [second.step(step) for step in steps[cut:]] == expected[cut:]
    assert second.state() == straight.state()
    np.testing.assert_array_equal(second.belief().planes, straight.belief().planes)


def test_without_a_network_the_setting_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where none is shipped; the message says what to type."""
    monkeypatch.setattr("semslam.models.builtin.FOLDER", tmp_path)
    with pytest.raises(SemslamError, match=r"`localize\.paper\.model` is empty") as caught:
        open_estimator("paper", LocalizeConfig(paper=PAPER), CLASSES, CELL_M, SIDE)
    assert "--set localize.paper.model=" in caught.value.hint


def test_a_network_for_other_classes_is_refused_with_both_lists(tmp_path: Path) -> None:
    """Planes of another class list would be read as the wrong things."""
    model = make_map_update(tmp_path / "update.onnx", [*CLASSES[:-1], "fridge"])
    with pytest.raises(SemslamError, match=r"update\.onnx.*other classes") as caught:
        estimator(model)
    assert "fridge" in caught.value.text()
    assert CLASSES[-1] in caught.value.text()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"side": 33}, ["trained with side 33", "`localize.paper.side` is 11", "set `localize.paper.side` to 33"]),
        ({"cell_m": 0.1}, ["trained with cell_m 0.1", "`localize.paper.cell_m` is 0.3"]),
        ({"kappa": None}, ["no map update", "lack 'kappa'"]),
        ({"binary": "true"}, ["trained on binary observations", "makes them weighted", "paper.binary=true"]),
        ({"cell_m": "nan"}, ["trained with cell_m nan"]),
        ({"kappa": "inf"}, ["no map update", "kappa is inf"]),
        ({"kappa": "steep"}, ["no map update", "steep"]),
        ({"kappa": -1.0}, ["no map update", "kappa is -1"]),
        ({"classes": "chair"}, ["no map update", "cannot be read"]),
        ({"initial_hidden": "[1.0]"}, ["no map update", f"initial_hidden must hold {len(CLASSES)} numbers"]),
        ({"initial_cell": json.dumps(["x"] * len(CLASSES))}, ["no map update", "cannot be read"]),
    ],
)
def test_a_network_that_does_not_fit_is_refused_by_name(
    tmp_path: Path, changes: dict[str, Any], words: list[str]
) -> None:
    """What its file says, and what would do."""
    model = make_map_update(tmp_path / "update.onnx", CLASSES, **changes)
    with pytest.raises(SemslamError) as caught:
        estimator(model)
    for word in [str(model), *words]:
        assert word in caught.value.text()


def test_another_kind_of_network_is_refused_by_its_inputs(tmp_path: Path) -> None:
    """A detector, say."""
    from tests.onnx_factory import constant_detector

    model = constant_detector(tmp_path / "detector.onnx", {"boxes": np.zeros((1, 6, 84), np.float32)})
    with pytest.raises(SemslamError, match="no map update: it has images where placed, hidden, cell are wanted"):
        estimator(model)


def test_a_keyframe_without_observation_leaves_the_map(tmp_path: Path) -> None:
    """The motion decides the pose; nothing is placed."""
    one = estimator(make_map_update(tmp_path / "update.onnx", CLASSES))
    steps = make_steps(make_world(), make_walk(3))
    one.step(steps[0])
    before = one.belief().planes
    assert one.step(Step(1, 1, None, steps[1].motion)).source == "inertial"
    np.testing.assert_array_equal(one.belief().planes, before)
