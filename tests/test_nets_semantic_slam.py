"""SemanticSLAM in torch: every equation equals the one of run time, and equation 8 is what it says on the whole map."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("onnxscript", reason="needs the extra [train]")

import torch.nn.functional as F  # noqa: E402, N812

from semslam.geometry.frames import SE2  # noqa: E402
from semslam.labels import UNOBSERVED  # noqa: E402
from semslam.models.nets import semantic_slam as net  # noqa: E402
from semslam.models.onnxfile import read_onnx  # noqa: E402
from semslam.models.training.drives import DriveSet  # noqa: E402
from semslam.models.training.mapping import MapperOptions, export_map_update  # noqa: E402
from semslam.slam import paper  # noqa: E402
from semslam.slam.learned_map import LearnedMap  # noqa: E402
from semslam.stages.settings import PaperConfig  # noqa: E402

NAMES = ("unobserved", "free_floor", "obstacle", "chair", "table", "plant")
CLASSES, SIDE, MAP_SIDE, HEADINGS = len(NAMES), 5, 13, 12
OURS = net.Grid(HEADINGS, MAP_SIDE, 0.3)
THEIRS = paper.PoseGrid(HEADINGS, MAP_SIDE, 0.3)
POSES = [SE2(0.0, 0.0, 0.0), SE2(1.7, -1.2, 2.0), SE2(-1.9, 0.4, -3.1), SE2(9.0, 0.0, 0.5)]
"""In the middle, near a border, heading backwards, and off the map."""


def planes(shape: tuple[int, ...], seed: int = 0, density: float = 0.5) -> NDArray[np.float32]:
    random = np.random.default_rng(seed)
    return (random.random(shape) * (random.random(shape) < density)).astype(np.float32)


def as_tensor(poses: list[SE2]) -> torch.Tensor:
    return torch.tensor([[pose.x_m, pose.y_m, pose.heading_rad] for pose in poses], dtype=torch.float64)


def network(kernel: int = 3, seed: int = 0) -> net.MapUpdate:
    """Random weights large enough that everything matters."""
    torch.manual_seed(seed)
    made = net.MapUpdate(CLASSES, kernel)
    torch.nn.init.normal_(made.gates.weight, std=0.3)
    torch.nn.init.normal_(made.peepholes, std=0.3)
    return made.eval()


def test_bins_and_poses_are_those_of_run_time() -> None:
    """The same bin for a pose, also off the map, and the same pose for a bin."""
    bins = OURS.bins(as_tensor(POSES))
    assert bins.tolist() == [list(THEIRS.bin_of(pose)) for pose in POSES]
    back = OURS.poses(bins)
    for index, pose in enumerate(POSES):
        wanted = THEIRS.pose_of(THEIRS.bin_of(pose))
        assert back[index].tolist() == pytest.approx([wanted.x_m, wanted.y_m, wanted.heading_rad], abs=1e-9)


def test_rotation_equals_run_time() -> None:
    """All headings of several observations at once, and each by an angle of its own."""
    seen = planes((2, CLASSES, SIDE, SIDE))
    found = net.rotate_observation(torch.from_numpy(seen), HEADINGS)
    wanted = np.stack([paper.rotate_observation(one, HEADINGS) for one in seen])
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-6)
    angles = math.tau * torch.tensor([3.0, 7.0], dtype=torch.float64) / HEADINGS
    single = net.rotate_by(torch.from_numpy(seen), angles)
    np.testing.assert_allclose(single.numpy(), wanted[[0, 1], [3, 7]], atol=1e-6)


def test_equation_2_equals_run_time() -> None:
    """Scores, field and best bin of two drives; one of them has a class in view that its map lacks."""
    seen, world = planes((2, CLASSES, SIDE, SIDE), 1), planes((2, CLASSES, MAP_SIDE, MAP_SIDE), 2)
    world[1, 4] = 0.0
    scores = net.correlate(net.rotate_observation(torch.from_numpy(seen), HEADINGS), torch.from_numpy(world))
    fields = net.visual_field(scores, 2.5)
    for index in range(2):
        wanted = paper.correlate(paper.rotate_observation(seen[index], HEADINGS), world[index])
        np.testing.assert_allclose(scores[index].numpy(), wanted, atol=5e-4)  # run time rounds to 2^-12
        np.testing.assert_allclose(fields[index].numpy(), paper.visual_field(wanted, 2.5)[0], atol=1e-5)
        best = net.best_bins(scores)[index]
        assert tuple(best.tolist()) == np.unravel_index(wanted.argmax(), wanted.shape)


def test_an_observation_without_objects_scores_nothing() -> None:
    """Floor and unknown cells match nowhere."""
    seen = planes((1, CLASSES, SIDE, SIDE))
    seen[:, 3:] = 0.0
    rotated = net.rotate_observation(torch.from_numpy(seen), HEADINGS)
    assert not net.correlate(rotated, torch.ones(1, CLASSES, MAP_SIDE, MAP_SIDE)).any()


def test_equation_3_equals_run_time() -> None:
    """Composition of poses and motions, headings wrapped."""
    motion = [SE2(0.3, -0.1, 2.9), SE2(-0.2, 0.0, 2.0), SE2(0.1, 0.1, -1.0), SE2(0.0, 0.0, 0.0)]
    found = net.step_inertial(as_tensor(POSES), as_tensor(motion))
    for row, pose, step in zip(found, POSES, motion, strict=True):
        wanted = paper.step_inertial(pose, step)
        assert row.tolist() == pytest.approx([wanted.x_m, wanted.y_m, wanted.heading_rad], abs=1e-12)


@pytest.mark.parametrize("gate", ["all", "any"])
def test_equation_4_equals_run_time(gate: str) -> None:
    """Both near, one near, none near; a heading difference across the half turn is small."""
    visual = [SE2(0.1, 0.1, 3.13), SE2(0.1, 0.1, 1.0), SE2(2.0, 0.0, -3.13), SE2(2.0, 0.0, 1.0)]
    inertial = [SE2(0.0, 0.0, -3.13)] * 4
    found = net.cross_check(as_tensor(visual), as_tensor(inertial), net.Matching(1.0, 0.3, 0.1, gate))
    wanted = [paper.cross_check(a, b, 0.3, 0.1, gate) for a, b in zip(visual, inertial, strict=True)]
    assert found.tolist() == wanted
    assert len(set(wanted)) == 2


def test_equation_5_equals_run_time() -> None:
    """One-hot, and nothing for a pose off the map."""
    found = net.pose_field(OURS.bins(as_tensor(POSES)), OURS)
    wanted = np.stack([paper.pose_field(pose, THEIRS) for pose in POSES])
    np.testing.assert_array_equal(found.numpy(), wanted)
    assert found.sum((1, 2, 3)).tolist() == [1, 1, 1, 0]


def test_equations_6_and_7_equal_run_time() -> None:
    """Placed by a soft field inside the region of interest, at the border too; the mask is the same window."""
    seen = planes((4, CLASSES, SIDE, SIDE), 3)
    field = planes((4, HEADINGS, MAP_SIDE, MAP_SIDE), 4, density=0.05)
    field /= field.sum((1, 2, 3), keepdims=True)
    bins = OURS.bins(as_tensor(POSES))
    rotated = net.rotate_observation(torch.from_numpy(seen), HEADINGS)
    placed = net.place_observation(rotated, torch.from_numpy(field), bins)
    mask, cells = net.roi_mask(bins, SIDE, MAP_SIDE), net.roi_cells(bins, SIDE // 2, MAP_SIDE)
    for index, pose in enumerate(POSES):
        window = paper.roi_mask(pose, THEIRS, SIDE)
        inside = np.zeros((MAP_SIDE, MAP_SIDE), bool)
        inside[window] = True
        np.testing.assert_array_equal(mask[index].numpy(), inside)
        wanted = paper.place_observation(paper.rotate_observation(seen[index], HEADINGS), field[index], window)
        found = placed[index][:, cells[index] < MAP_SIDE**2].numpy()
        np.testing.assert_allclose(found.reshape(wanted.shape), wanted, atol=1e-6)


def test_the_untouched_map_is_unobserved() -> None:
    """m_0 is a proper class map: unobserved nearly for certain, whatever the steepness."""
    made = network()
    start = made.start(2, MAP_SIDE)
    read = made.logits(start.hidden[..., :-1]).softmax(1)
    assert read.shape == (2, CLASSES, MAP_SIDE**2)
    assert (read[:, UNOBSERVED] > 0.99).all()
    torch.testing.assert_close(read.sum(1), torch.ones(2, MAP_SIDE**2))
    assert not start.hidden[..., -1].any()


def whole_map_step(
    made: net.MapUpdate, placed: torch.Tensor, hidden: torch.Tensor, cell: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Equation 8 as the paper writes it: the ConvLSTM over the whole map, then the mask; from Shi et al.'s formulas."""
    weight, bias = made.gates.weight, made.gates.bias
    pieces = F.conv2d(torch.cat([placed, hidden], 1), weight, bias, padding=made.kernel // 2).chunk(4, 1)
    peep = made.peepholes
    i = torch.sigmoid(pieces[0] + peep[0] * cell)
    f = torch.sigmoid(pieces[1] + peep[1] * cell)
    c = f * cell + i * torch.tanh(pieces[2])
    h = torch.sigmoid(pieces[3] + peep[2] * c) * torch.tanh(c)
    return torch.where(mask[:, None], h, hidden), torch.where(mask[:, None], c, cell)


@pytest.mark.parametrize("kernel", [3, 1])
def test_region_and_halo_equal_the_whole_map(kernel: int) -> None:
    """Some steps at wandering poses, borders and beyond: the same states; cells outside the region bit for bit."""
    made, state = network(kernel), network(kernel).start(len(POSES), MAP_SIDE)
    hidden, cell = (part[..., :-1].unflatten(2, (MAP_SIDE, MAP_SIDE)) for part in (state.hidden, state.cell))
    for step in range(4):
        bins = OURS.bins(as_tensor([replace(pose, x_m=pose.x_m - 0.3 * step) for pose in POSES]))
        placed = torch.from_numpy(planes((len(POSES), CLASSES, SIDE, SIDE), step))
        cells, mask = net.roi_cells(bins, SIDE // 2, MAP_SIDE), net.roi_mask(bins, SIDE, MAP_SIDE)
        whole = torch.zeros(len(POSES), CLASSES, MAP_SIDE**2 + 1)
        whole.scatter_(2, cells.flatten(1)[:, None].expand(-1, CLASSES, -1), placed.flatten(2))
        before, state = state, net.update_map(made, placed, state, bins, MAP_SIDE)
        laid = whole[..., :-1].unflatten(2, (MAP_SIDE, MAP_SIDE))
        hidden, cell = whole_map_step(made, laid, hidden, cell, mask)
        for found, wanted in ((state.hidden, hidden), (state.cell, cell)):
            torch.testing.assert_close(found[..., :-1], wanted.flatten(2), atol=1e-6, rtol=1e-5)
        kept = ~mask.flatten(1)[:, None].expand_as(hidden.flatten(2))
        assert torch.equal(state.hidden[..., :-1][kept], before.hidden[..., :-1][kept])
        assert not state.hidden[..., -1].any()


def test_drives_without_an_observation_keep_their_maps() -> None:
    """`active` says whose maps change."""
    made, bins = network(), OURS.bins(as_tensor(POSES[:2]))
    start = made.start(2, MAP_SIDE)
    placed = torch.from_numpy(planes((2, CLASSES, SIDE, SIDE)))
    after = net.update_map(made, placed, start, bins, MAP_SIDE, torch.tensor([True, False]))
    assert not torch.equal(after.hidden[0], start.hidden[0])
    assert torch.equal(after.hidden[1], start.hidden[1])


def test_gradients_reach_the_first_step_and_every_parameter() -> None:
    """The loss of a later step depends on what was placed first."""
    made, bins = network(), OURS.bins(as_tensor(POSES[:1]))
    first = torch.from_numpy(planes((1, CLASSES, SIDE, SIDE))).requires_grad_()
    state = net.update_map(made, first, made.start(1, MAP_SIDE), bins, MAP_SIDE)
    state = net.update_map(made, torch.zeros_like(first), state, bins, MAP_SIDE)
    logits = made.logits(state.hidden[..., :-1]).unflatten(2, (MAP_SIDE, MAP_SIDE))
    truth = torch.full((1, MAP_SIDE, MAP_SIDE), 4)
    net.map_loss(logits, truth, torch.ones(1, MAP_SIDE, MAP_SIDE, dtype=torch.bool)).sum().backward()
    assert first.grad is not None
    assert first.grad.abs().sum() > 0
    assert all(value.grad is not None and value.grad.abs().sum() > 0 for value in made.parameters())


def test_equation_9_worked_by_hand() -> None:
    """-ln p of the true class, as a mean over the cells that count; none counts, nothing is lost."""
    logits = torch.log(torch.tensor([[0.7, 0.5], [0.2, 0.25], [0.1, 0.25]])).view(1, 3, 1, 2)
    truth = torch.tensor([[[1, 0]]])
    both, one, none = (torch.tensor(cells).view(1, 1, 2) for cells in ([True, True], [False, True], [False, False]))
    assert net.map_loss(logits, truth, both).item() == pytest.approx((-math.log(0.2) - math.log(0.5)) / 2)
    assert net.map_loss(logits, truth, one).item() == pytest.approx(math.log(2))
    assert net.map_loss(logits, truth, none).item() == 0.0


def test_a_pose_is_found_again_in_a_known_map() -> None:
    """From a motion that is off by a cell the visual pose corrects; a wild motion fails the gates and stands."""
    world = torch.zeros(1, CLASSES, MAP_SIDE, MAP_SIDE)
    for class_id, row, column in ((3, 6, 8), (4, 7, 8), (5, 4, 7), (3, 5, 5)):
        world[0, class_id, row, column] = 1.0
    seen = world[:, :, 4:9, 4:9].clone()  # as from the middle, heading 0
    matching = net.Matching(0.01, 0.5, 0.2, "all")
    start = as_tensor([SE2(-0.3, 0.0, 0.0)])
    poses, placed = net.localise(seen, world, start, as_tensor([SE2(0.55, 0.05, 0.1)]), OURS, matching)
    assert poses[0].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    torch.testing.assert_close(placed, seen, atol=1e-3, rtol=0)
    poses, _ = net.localise(seen, world, start, as_tensor([SE2(1.5, 0.0, 0.0)]), OURS, matching)
    assert poses[0].tolist() == pytest.approx([1.2, 0.0, 0.0])
    poses, _ = net.localise(torch.zeros_like(seen), world, start, as_tensor([SE2(0.4, 0.0, 0.0)]), OURS, matching)
    assert poses[0].tolist() == pytest.approx([0.1, 0.0, 0.0])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Exported networks by kernel; an export takes seconds."""
    room, made = tmp_path_factory.mktemp("exported"), {}
    for kernel in (3, 1):
        drives = DriveSet((), NAMES, "ideal", PaperConfig(side=SIDE))
        made[kernel] = room / f"map_update_{kernel}.onnx"
        export_map_update(network(kernel), made[kernel], drives, MapperOptions(PaperConfig(side=SIDE), kernel))
    return made


@pytest.mark.parametrize("kernel", [3, 1])
def test_the_file_builds_the_same_map_as_torch(kernel: int, files: dict[int, Path]) -> None:
    """A drive of 30 steps, borders included, through ONNX Runtime as localize runs it: equal to 1e-4."""
    made, learned = network(kernel), LearnedMap.open(files[kernel], NAMES, MAP_SIDE, 0.3, SIDE)
    state, random = made.start(1, MAP_SIDE), np.random.default_rng(5)
    for step in range(30):
        pose = SE2(*random.uniform(-2.4, 2.4, 2), 0.0)
        bins, window = OURS.bins(as_tensor([pose])), paper.roi_mask(pose, THEIRS, SIDE)
        placed = torch.from_numpy(planes((1, CLASSES, SIDE, SIDE), step))
        cells = net.roi_cells(bins, SIDE // 2, MAP_SIDE)[0]
        rows, columns = (part.stop - part.start for part in window)
        with torch.no_grad():
            state = net.update_map(made, placed, state, bins, MAP_SIDE)
            read = made.logits(state.hidden[..., :-1]).softmax(1).view(CLASSES, MAP_SIDE, MAP_SIDE)
        learned.update(placed[0][:, cells < MAP_SIDE**2].numpy().reshape(CLASSES, rows, columns), window)
        np.testing.assert_allclose(learned.planes, read.numpy(), atol=1e-4)


def test_the_file_says_what_it_is_for(files: dict[int, Path]) -> None:
    """Classes, read-out, grid, kernel and first state."""
    told = read_onnx(files[3]).metadata
    assert tuple(json.loads(told["classes"])) == NAMES
    assert float(told["kappa"]) == pytest.approx(5.0)
    assert (told["cell_m"], told["side"], told["kernel"]) == ("0.3", str(SIDE), "3")
    assert json.loads(told["initial_hidden"]) == pytest.approx([net.START] + [-net.START] * 5)
    assert len(json.loads(told["initial_cell"])) == CLASSES
    assert told["license"] == "Apache-2.0"
