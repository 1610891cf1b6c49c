"""DeepVO: its loss and memory are what the paper says, it learns, and its export equals torch behind the estimator."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("onnxscript", reason="needs the extra [train]")

from semslam.geometry.frames import SE2  # noqa: E402
from semslam.models.nets.deepvo import DeepVo, DeepVoShape, pose_loss  # noqa: E402
from semslam.models.small_view import network_input, small_view  # noqa: E402
from semslam.models.training import deepvo as training  # noqa: E402
from semslam.models.training.deepvo import (  # noqa: E402
    USUAL,
    DeepVoBatches,
    export_deepvo,
    motion_loss,
    new_deepvo,
    train_deepvo,
)
from semslam.models.training.sequences import from_first, motions_of  # noqa: E402
from semslam.models.training.trainer import CHECKPOINT, read_checkpoint  # noqa: E402
from semslam.slam.deepvo_estimator import DeepVoEstimator  # noqa: E402
from tests.picture_world import make_drive, make_drives, make_steps  # noqa: E402

SMALL = DeepVoShape(channels=(8, 16, 24, 32, 32), memory=32)
SCHEDULE = replace(USUAL, steps=90, batch=6, warm_up=10, average=0.9, peak_rate=4e-3)


def test_the_loss_is_the_paper_s() -> None:
    """Squared translation and a hundred times squared heading, by hand; no coordinate counts for another."""
    found, true = torch.tensor([[[1.0, 2.0, 0.1], [0.0, 0.0, 0.0]]]), torch.zeros(1, 2, 3)
    value, translation, heading = pose_loss(found, true)
    assert float(translation) == pytest.approx(2.5)
    assert float(heading) == pytest.approx(0.005)
    assert float(value) == pytest.approx(3.0)


def test_the_memory_is_an_lstm() -> None:
    """As torch's own LSTM cell says with the same weights."""
    network, size = new_deepvo(SMALL, 0), SMALL.memory
    lstm = torch.nn.LSTMCell(size, size)
    order = torch.cat([torch.arange(2 * size), torch.arange(3 * size, 4 * size), torch.arange(2 * size, 3 * size)])
    seen, hidden, cell = torch.rand(3, 2, size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        lstm.weight_ih.copy_(network.gates.weight[order, :size])
        lstm.weight_hh.copy_(network.gates.weight[order, size:])
        lstm.bias_ih.copy_(network.gates.bias[order])
        lstm.bias_hh.zero_()
        _, *found = network.recall(seen, hidden, cell)
        wanted = lstm(seen, (hidden, cell))
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-6)


def test_motions_lead_along_the_drive() -> None:
    """The motions to learn, composed, are the poses they come from."""
    walk = [SE2(0.0, 0.0, 0.0).between(pose) for pose in make_drive(10, 4)]
    poses = np.array([(pose.x_m, pose.y_m, pose.heading_rad) for pose in walk])
    here, track = SE2(0.0, 0.0, 0.0), from_first(poses)
    for motion, wanted in zip(motions_of(poses).tolist(), track[1:].tolist(), strict=True):
        here = here @ SE2(*motion)
        assert (here.x_m, here.y_m) == pytest.approx(wanted[:2])
        assert math.cos(here.heading_rad - wanted[2]) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A DeepVO after a short training on tiled floors."""
    room = tmp_path_factory.mktemp("deepvo")
    return train_deepvo(make_drives(8, 16), room, schedule=SCHEDULE, shape=SMALL, length=4)


def test_it_learns(trained: Path) -> None:
    """A step's turn is known several times better than by always saying straight on, on the floors it knows."""
    errors, turns = [], []
    for seed in range(4):
        estimator, walk = DeepVoEstimator(trained), make_drive(8, seed)
        found = [estimator.step(step).map_from_robot for step in make_steps(8, seed)]
        for index in range(1, 8):
            before, now = found[index - 1], found[index]
            assert before is not None
            assert now is not None
            true = walk[index - 1].between(walk[index])
            turns.append(true.heading_rad)
            errors.append(before.between(now).heading_rad - true.heading_rad)
    assert np.std(errors) < 0.5 * np.std(turns)


def thumbnails(frames: int) -> list[Any]:
    views = [step.view for step in make_steps(frames) if step.view]
    small = [small_view(v.rgb, v.depth_m, v.fx, v.fy, v.cx, v.cy, v.robot_from_camera) for v in views]
    return [network_input(one.picture) for one in small]


def test_the_estimator_equals_torch(tmp_path: Path) -> None:
    """Along twelve keyframes the track is the one that torch's motions compose to, within 1e-4 a step."""
    network = new_deepvo(SMALL, 2).eval()
    export_deepvo(network, tmp_path / "deepvo.onnx")
    pictures = thumbnails(12)
    pairs = np.stack([np.concatenate(pair) for pair in pairwise(pictures)])
    with torch.no_grad():
        motions = network.roll(torch.from_numpy(pairs)[None])[0].tolist()
    estimator, here = DeepVoEstimator(tmp_path / "deepvo.onnx"), SE2(0.0, 0.0, 0.0)
    found = [estimator.step(step).map_from_robot for step in make_steps(12)]
    for count, (motion, pose) in enumerate(zip(motions, found[1:], strict=True), 1):
        here = here @ SE2(*motion)
        assert pose is not None
        assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx(
            (here.x_m, here.y_m, here.heading_rad), abs=1e-4 * count
        )


def test_a_training_that_was_cut_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut after a checkpoint and started again: the weights of an undisturbed training; its sizes are recognised."""
    monkeypatch.setattr(training, "export_deepvo", lambda network, path: torch.save(network.state_dict(), path))
    schedule = replace(SCHEDULE, steps=6, batch=2, report_every=2, checkpoint_s=0.0)

    def cut(progress: Any) -> None:
        if progress.step == 4:
            raise KeyboardInterrupt

    drives = make_drives(1, 6)
    whole = train_deepvo(drives, tmp_path / "whole", schedule=schedule, shape=SMALL, length=3)
    with pytest.raises(KeyboardInterrupt):
        train_deepvo(drives, tmp_path / "cut", schedule=schedule, shape=SMALL, length=3, watch=cut)
    assert read_checkpoint(tmp_path / "cut" / CHECKPOINT)["step"] == 2
    resumed = train_deepvo(drives, tmp_path / "cut", schedule=schedule, shape=SMALL, length=3)
    for mine, theirs in zip(torch.load(resumed).values(), torch.load(whole).values(), strict=True):
        assert torch.equal(mine, theirs)


def test_batches_are_pairs_in_order() -> None:
    """The latter picture of a pair is the former of the next; motions belong to the former's frame."""
    batch = DeepVoBatches.of(make_drives(1, 8), replace(USUAL, batch=3), 5)(0)
    assert batch.pairs.shape == (3, 4, 6, 96, 128)
    assert torch.equal(batch.pairs[:, :-1, 3:], batch.pairs[:, 1:, :3])
    np.testing.assert_allclose(
        batch.motions[..., 0], 0.25, atol=1e-6
    )  # the robot always goes straight ahead, then turns
    value, parts = motion_loss(new_deepvo(SMALL, 1), batch)
    assert torch.isfinite(value)
    assert set(parts) == {"off_m", "off_deg"}


def test_the_network_is_small() -> None:
    """With its usual sizes: at most 400,000 parameters, 1.6 MB."""
    assert sum(value.numel() for value in DeepVo(DeepVoShape()).parameters()) < 4e5
