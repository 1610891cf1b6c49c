"""MapNet: its operations are the numpy estimator's, its geometry works untaught, it learns, its export is exact."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("onnxscript", reason="needs the extra [train]")

from torch.nn.functional import avg_pool2d, one_hot  # noqa: E402

from semslam.errors import SemslamError  # noqa: E402
from semslam.geometry.frames import SE2  # noqa: E402
from semslam.models.nets.mapnet import (  # noqa: E402
    MapNet,
    MapNetShape,
    MapNetStep,
    bins_of,
    correlate,
    place,
    place_at,
    poses_of,
    project,
    turn,
)
from semslam.models.session import open_session  # noqa: E402
from semslam.models.small_view import PARTS, cells_of, network_input, small_view  # noqa: E402
from semslam.models.training.mapnet import (  # noqa: E402
    USUAL,
    MapNetBatch,
    MapNetBatches,
    export_mapnet,
    field_loss,
    misses,
    new_mapnet,
    train_mapnet,
)
from semslam.models.training.sequences import Clip, PictureDrives, mirrored  # noqa: E402
from semslam.slam import paper  # noqa: E402
from semslam.slam.mapnet_estimator import MapNetEstimator  # noqa: E402
from tests.picture_world import make_drive, make_drives, make_steps  # noqa: E402

SMALL = MapNetShape(channels=8, width=16, side=9, headings=8, map_side=9)
LENGTH = 3


def random(*shape: int, seed: int = 0) -> Any:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_turning_is_the_paper_s() -> None:
    """Same samples as the numpy estimator's, for every heading."""
    observation = random(1, 4, 9, 9)
    wanted = paper.rotate_observation(observation[0].numpy(), 24)
    np.testing.assert_allclose(turn(observation, 24)[0].numpy(), wanted, atol=1e-5)


def test_placing_is_the_paper_s() -> None:
    """Equation 6 on a random field, and its short cut for a pose that is known, at the border too."""
    rotated = paper.rotate_observation(random(4, 5, 5).numpy(), 8)
    turned, field = torch.from_numpy(np.ascontiguousarray(rotated)), random(8, 9, 9, seed=1)
    field /= field.sum()
    wanted = paper.place_observation(rotated, field.numpy(), (slice(0, 9), slice(0, 9)))
    np.testing.assert_allclose(place(turned, field).numpy(), wanted, atol=1e-5)
    for where in (0, 80, 4 * 81 + 40, 8 * 81 - 1):
        known = torch.zeros(8 * 81)
        known[where] = 1.0
        np.testing.assert_allclose(place_at(turned, where, 9), place(turned, known.view(8, 9, 9)), atol=1e-6)
    assert not place_at(turned, -1, 9).any()


def test_matching_is_the_transpose_of_placing() -> None:
    """<correlate(o, m), p> = <m, place(o, p)> for anything: no flip, and the same borders."""
    turned, field, world = random(8, 4, 5, 5), random(8, 9, 9, seed=1), random(4, 9, 9, seed=2)
    assert float((correlate(turned, world) * field).sum()) == pytest.approx(
        float((world * place(turned, field)).sum()), rel=1e-4
    )


def test_projection_takes_the_maximum() -> None:
    """By brute force; negative maxima stay, empty cells are zero, what falls nowhere is gone."""
    features, cells = random(2, 3, 40) - 0.8, torch.randint(0, 10, (2, 40), generator=torch.Generator().manual_seed(0))
    cells[cells == 4] = 9  # 9 is nowhere, and nothing falls into 4
    found = project(features, cells, 3).flatten(2)
    for batch in range(2):
        for cell in range(9):
            here = features[batch][:, cells[batch] == cell]
            wanted = here.amax(1) if here.shape[1] else torch.zeros(3)
            assert torch.equal(found[batch, :, cell], wanted)


def test_bins_are_those_of_run_time() -> None:
    """Training counts pose bins as the estimator does, and knows what lies off the map."""
    shape = MapNetShape(headings=36, map_side=11)
    grid = paper.PoseGrid(36, 11, 0.3)
    rng = np.random.default_rng(0)
    poses = np.stack([rng.uniform(-2, 2, 200), rng.uniform(-2, 2, 200), rng.uniform(-np.pi, np.pi, 200)], 1)
    bins = bins_of(torch.from_numpy(poses), shape).tolist()
    for pose, found in zip(poses.tolist(), bins, strict=True):
        heading, row, column = place_of = grid.bin_of(SE2(*pose))
        assert found == ((heading * 11 + row) * 11 + column if grid.holds(place_of) else -1)
    middle = poses_of(torch.tensor([7 * 121 + 3 * 11 + 9]), shape)[0].tolist()
    wanted = grid.pose_of((7, 3, 9))
    assert middle == pytest.approx([wanted.x_m, wanted.y_m, wanted.heading_rad])


def test_the_memory_is_an_lstm_in_every_cell() -> None:
    """As torch's own LSTM cell says with the same weights, at each place by itself."""
    network = new_mapnet(SMALL, 0)
    placed, hidden, cell = (random(8, 2, 2, seed=seed) for seed in range(3))
    lstm = torch.nn.LSTMCell(8, 8)
    order = torch.cat([torch.arange(0, 16), torch.arange(24, 32), torch.arange(16, 24)])  # torch: i, f, g, o
    with torch.no_grad():
        weights, bias = network.gates.weight[:, :, 0, 0][order], network.gates.bias[order]
        lstm.weight_ih.copy_(weights[:, :8])
        lstm.weight_hh.copy_(weights[:, 8:])
        lstm.bias_ih.copy_(bias)
        lstm.bias_hh.zero_()
        found = network.remember(placed, hidden, cell)
        flat = [part.flatten(1).T for part in (placed, hidden, cell)]
        wanted = lstm(flat[0], (flat[1], flat[2]))
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(mine.flatten(1).T, theirs, atol=1e-6)


def colour_observation(clip: Clip, shape: MapNetShape) -> Any:
    """Bare colours in place of features, (T, 3, h, h), without their mean."""
    parts = avg_pool2d(torch.from_numpy(clip.pictures.copy()), 4).flatten(2)
    cells = torch.from_numpy(cells_of(clip.ground_m, shape.cell_m, shape.side))
    colours = project(parts, cells, shape.side)
    seen = (colours != 0).any(1, keepdim=True)
    mean = colours.sum((2, 3), keepdim=True) / seen.sum((2, 3), keepdim=True)
    return torch.where(seen, colours - mean, 0.0)


@pytest.mark.parametrize("flipped", [False, True])
def test_geometry_alone_finds_the_pose(flipped: bool) -> None:
    """Bare colours of the tiles, projected, turned and matched, meet at the true bin: before and after mirroring."""
    shape = MapNetShape(side=21, map_side=21)
    drives = make_drives(1, 14)
    still, matched = [], []
    for drive, start in drives.windows(2).tolist():
        clip = drives.clip(drive, start, 2)
        clip = mirrored(clip) if flipped else clip
        turned = turn(colour_observation(clip, shape), shape.headings)
        bins = bins_of(torch.from_numpy(clip.poses), shape)
        fields = correlate(turned[1], place_at(turned[0], int(bins[0]), 21)).flatten()[None]
        matched.append(misses(fields, bins[1:], shape))
        still.append(misses(one_hot(bins[:1], fields.shape[1]).float(), bins[1:], shape))
    assert np.median(matched, 0).tolist() == [0.0, 0.0]
    assert np.mean(still, 0)[1] > 15


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A MapNet after a short training on tiled floors."""
    schedule = replace(USUAL, steps=80, batch=4, warm_up=10, average=0.9, peak_rate=5e-3)
    return train_mapnet(
        make_drives(6, 16), tmp_path_factory.mktemp("mapnet"), schedule=schedule, shape=SMALL, length=LENGTH
    )


def test_it_learns(trained: Path) -> None:
    """On floors it has never seen, the third keyframe is found much closer than where the robot started."""
    errors, ways = [], []
    for seed in range(70, 82):
        walk, estimator = make_drive(LENGTH, seed), MapNetEstimator(trained, modes=3)
        found = [estimator.step(step).map_from_robot for step in make_steps(LENGTH, seed)][-1]
        true = walk[0].between(walk[-1])
        assert found is not None
        errors.append(math.hypot(found.x_m - true.x_m, found.y_m - true.y_m))
        ways.append(math.hypot(true.x_m, true.y_m))
    assert np.median(errors) < 0.65 * np.median(ways)


def every_keyframe(path: Path, network: MapNet, frames: int) -> list[tuple[Sequence[Any], Sequence[Any]]]:
    """Outputs of run time and of torch along a drive, each with its own memory."""
    session, step = open_session(path), MapNetStep(network).eval()
    shape = network.shape
    mine = theirs = [np.zeros((1, shape.channels, shape.map_side, shape.map_side), np.float32)] * 2
    outputs = []
    for index, one in enumerate(make_steps(frames)):
        view = one.view
        assert view is not None
        small = small_view(view.rgb, view.depth_m, view.fx, view.fy, view.cx, view.cy, view.robot_from_camera)
        given = np.zeros((shape.headings, shape.map_side, shape.map_side), np.float32)
        given[0, shape.map_side // 2, shape.map_side // 2] = index == 0
        picture, cells = network_input(small.picture)[None], cells_of(small.ground_m, shape.cell_m, shape.side)[None]
        names = ("picture", "cells", "given", "hidden", "cell")
        found = session.run(dict(zip(names, (picture, cells, given, *mine), strict=True)))
        with torch.no_grad():
            wanted = [part.numpy() for part in step(*map(torch.from_numpy, (picture, cells, given, *theirs)))]
        mine, theirs = found[1:], wanted[1:]
        outputs.append((found, wanted))
    return outputs


def test_the_export_equals_torch(tmp_path: Path) -> None:
    """Pose fields and maps along twelve keyframes, each with its own memory, to 1e-4, with grids chosen at export."""
    wider = replace(SMALL, headings=12, map_side=15)
    export_mapnet(new_mapnet(SMALL, 3), tmp_path / "mapnet.onnx", wider)
    network = MapNet(wider)
    network.load_state_dict(new_mapnet(SMALL, 3).state_dict())
    for found, wanted in every_keyframe(tmp_path / "mapnet.onnx", network.eval(), 12):
        assert found[0].shape == (12, 15, 15)
        for mine, theirs in zip(found, wanted, strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-4)
        assert float(found[0].sum()) == pytest.approx(1.0, abs=1e-4)


def test_the_file_tells_its_grids(trained: Path) -> None:
    """Whoever runs it needs no configuration."""
    metadata = open_session(trained).signature.metadata
    assert [metadata[name] for name in ("map_side", "headings", "side", "cell_m")] == ["9", "8", "9", "0.3"]


def batch_of(drives: PictureDrives) -> MapNetBatch:
    return MapNetBatches.of(drives, SMALL, USUAL, LENGTH)(0)


def test_batches_depend_on_seed_and_step_alone() -> None:
    """Resuming needs no history; true poses are given in the first part alone."""
    one, two = (MapNetBatches.of(make_drives(2, 6), SMALL, USUAL, LENGTH) for _ in range(2))
    two(7)
    first, second = one(50), two(50)
    assert torch.equal(first.pictures, second.pictures)
    assert torch.equal(first.bins, second.bins)
    assert not torch.equal(one(51).pictures, first.pictures)
    assert first.cells.shape == (USUAL.batch, LENGTH, PARTS)
    assert first.given
    assert not one(USUAL.steps - 1).given


def test_what_lies_off_the_map_does_not_count() -> None:
    """A batch in which every keyframe has left the map has no loss, and no gradient that is no number."""
    network, batch = new_mapnet(SMALL, 1), batch_of(make_drives(1, 6))
    value, _ = field_loss(network, replace(batch, bins=torch.full_like(batch.bins, -1)))
    value.backward()
    assert float(value.detach()) == 0.0
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in network.parameters())


def test_drives_too_short_are_refused(tmp_path: Path) -> None:
    """Before anything is trained."""
    with pytest.raises(SemslamError, match="9 keyframes"):
        train_mapnet(make_drives(1, 6), tmp_path, shape=SMALL, length=9)
