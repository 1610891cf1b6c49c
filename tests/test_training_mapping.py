"""Training of the map update: drives as they were, symmetries that are exact, and a map better than any heuristic."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("onnxscript", reason="needs the extra [train]")

from semslam.errors import SemslamError  # noqa: E402
from semslam.geometry.frames import SE2  # noqa: E402
from semslam.geometry.grid import pool_observation  # noqa: E402
from semslam.labels import FIRST_OBJECT, UNOBSERVED  # noqa: E402
from semslam.models.nets.semantic_slam import update_map  # noqa: E402
from semslam.models.training import mapping  # noqa: E402
from semslam.models.training.drives import (  # noqa: E402
    DriveSet,
    coarse_observation,
    logs_of,
    mirrored,
    shortened,
    turned,
)
from semslam.models.training.mapping import (  # noqa: E402
    DriveBatches,
    MapperOptions,
    collated,
    grow,
    judged,
    mapping_loss,
    new_map_update,
    options_for,
    train_mapper,
)
from semslam.models.training.trainer import Schedule, fit  # noqa: E402
from semslam.pipeline.cli import run_command  # noqa: E402
from semslam.pipeline.run_tables import run_tables  # noqa: E402
from semslam.stages.settings import PaperConfig  # noqa: E402
from semslam.tables.spec import MOTION, OBSERVATIONS  # noqa: E402
from tests.drives_factory import MAP_SIDE, NAMES, SIDE, look, write_data_set, write_observations, write_run  # noqa: E402
from tests.fake_robot import ROBOT_STAGES  # noqa: E402
from tests.fake_stages import make_log  # noqa: E402
from tests.pipeline_helpers import World  # noqa: E402

pytest_plugins = ("tests.pipeline_fixtures",)
PAPER = PaperConfig(side=SIDE, map_side=MAP_SIDE)
QUICK = Schedule(steps=6, batch=2, warm_up=2, average=0.5, checkpoint_s=0.0, report_every=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of four homes, where every third observed cell says something wrong."""
    root = tmp_path_factory.mktemp("data") / "homes"
    write_data_set(root, wrong=0.3)
    return root


@pytest.fixture(scope="module")
def drives(folder: Path) -> DriveSet:
    return DriveSet.open(folder, logs_of(folder, "cross", "train"), "obstructed", paper=PAPER)


# ------------------------------------------------------------------------------------------------------------- drives


def test_a_drive_is_what_happened(tmp_path: Path) -> None:
    """Poses in the map frame, motion, labels, when cells were seen, and observations, of a run that kept every pair."""
    stories = write_data_set(tmp_path, logs=2)
    story = stories["home_00"]
    run = {"home_00": write_run(tmp_path / "run", story, list(range(12)))}
    made = DriveSet.open(tmp_path, ["home_00"], run=run, paper=PAPER)
    drive = made.drives[0]
    assert (made.classes, len(drive), made.map_side) == (NAMES, 12, MAP_SIDE)
    wanted = [(pose.x_m, pose.y_m, pose.heading_rad) for pose in story.poses]
    np.testing.assert_allclose(drive.poses, wanted, atol=1e-9)
    walked = SE2(*drive.poses[0])
    for motion, pose in zip(drive.motion[1:], wanted[1:], strict=True):
        walked = walked @ SE2(*motion)
        assert (walked.x_m, walked.y_m) == pytest.approx(pose[:2], abs=1e-9)
    assert np.isnan(drive.motion[0]).all()
    np.testing.assert_array_equal(drive.labels, story.labels)
    np.testing.assert_array_equal(drive.visible(3) != UNOBSERVED, (story.first_seen >= 0) & (story.first_seen <= 3))
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(drive.observations[5], look(story, 5, 0.0, rng))


def test_keyframes_join_by_time(tmp_path: Path) -> None:
    """A run that kept every third pair and lost an observation: later steps, true poses there, nothing seen there."""
    story = write_data_set(tmp_path, logs=2)["home_00"]
    frames = [0, 3, 6, 9]
    run = {"home_00": write_run(tmp_path / "run", story, frames, missing=6)}
    drive = DriveSet.open(tmp_path, ["home_00"], run=run, paper=PAPER).drives[0]
    assert drive.poses[:, 0].tolist() == pytest.approx([story.poses[frame].x_m for frame in frames])
    assert drive.sights.seen.tolist() == [True, True, False, True]
    assert not drive.observations[2].any()
    assert drive.observations[3].any()
    np.testing.assert_array_equal(drive.visible(1) != UNOBSERVED, (story.first_seen >= 0) & (story.first_seen <= 3))


def test_observations_are_pooled_as_the_estimator_pools_them() -> None:
    """Pixel shares add up before the noise floor; binary makes what is left 1; reserved planes stay."""
    fine = np.zeros((5, 9, 9), np.float32)
    fine[3, 3:6, 3:6] = 0.004  # 0.036 in the middle cell
    fine[4, 0, 0] = 0.01
    fine[2, 8, 8] = 1.0
    cells = np.flatnonzero(fine)
    arguments: Any = (cells.tolist(), fine.ravel()[cells].tolist(), fine.shape, 3)
    plain = coarse_observation(*arguments, PaperConfig(side=3))
    binary = coarse_observation(*arguments, PaperConfig(side=3, binary=True))
    assert plain[3, 1, 1] == pytest.approx(0.036)
    assert binary[3, 1, 1] == 1.0
    assert not plain[4].any()
    assert plain[2, 2, 2] == 1.0
    fine[UNOBSERVED] = ~fine[1:].any(0)
    np.testing.assert_array_equal(plain[:3], pool_observation(fine, 3, 3)[:3])


def test_labels_follow_the_class_list_of_the_observations(tmp_path: Path) -> None:
    """A detector may name its classes in another order."""
    story = write_data_set(tmp_path, logs=2)["home_00"]
    other = (*NAMES[:3], "plant", "chair", "table")
    tables = write_run(tmp_path / "run", story, [0, 1])
    write_observations(tables.observations[0], [look(story, 0, 0.0, np.random.default_rng(0))] * 2, [0, 1], other)
    made = DriveSet.open(tmp_path, ["home_00"], run={"home_00": tables}, paper=PAPER)
    assert made.classes == other
    names = np.array(other)[made.drives[0].labels]
    np.testing.assert_array_equal(names, np.array(NAMES)[story.labels])


def test_what_does_not_fit_is_told(tmp_path: Path) -> None:
    """No run, another run, a class that is missing, an unknown log, no data set, an even side."""
    story = write_data_set(tmp_path, logs=2)["home_00"]
    with pytest.raises(SemslamError, match="come from a run"):
        DriveSet.open(tmp_path, ["home_00"])
    tables = write_run(tmp_path / "run", story, [0, 1])
    with pytest.raises(SemslamError, match="no finished `ingest` of `home_01`"):
        DriveSet.open(tmp_path, ["home_01"], run={"home_00": tables}, paper=PAPER)
    with pytest.raises(SemslamError, match="no finished `extract` of `home_00`"):
        DriveSet.open(tmp_path, ["home_00"], run={"home_00": replace(tables, observations=())}, paper=PAPER)
    with pytest.raises(SemslamError, match="no log `home_77`"):
        DriveSet.open(tmp_path, ["home_77"], "ideal", paper=PAPER)
    with pytest.raises(SemslamError, match="is no data set"):
        logs_of(tmp_path / "run", "cross", "train")
    with pytest.raises(SemslamError, match="under `intra`"):
        logs_of(tmp_path, "intra", "train")
    with pytest.raises(SemslamError, match="do not give 8 cells"):
        DriveSet.open(tmp_path, ["home_00"], "ideal", paper=replace(PAPER, side=8))
    write_observations(tables.observations[0], [np.zeros((5, SIDE, SIDE), np.float32)] * 2, [0, 1], NAMES[:5])
    with pytest.raises(SemslamError, match="lack: plant"):
        DriveSet.open(tmp_path, ["home_00"], run={"home_00": tables}, paper=PAPER)
    strangers = write_run(tmp_path / "other", story, [0, 1])
    write_run(tmp_path / "third", story, [0, 11])
    made = write_data_set(tmp_path / "short", logs=2, steps=4)
    assert len(made["home_00"].poses) == 4
    late = replace(strangers, motion=(tmp_path / "third" / "motion.parquet",))
    with pytest.raises(SemslamError, match="1 of 2 keyframes of `home_00` are not"):
        DriveSet.open(tmp_path / "short", ["home_00"], run={"home_00": late}, paper=PAPER)


def test_run_tables_finds_what_a_run_left(world: World) -> None:
    """Motion of every log by name; a log whose run failed has nothing; a folder that is no run is refused."""
    make_log(world.logs, "a")
    make_log(world.logs, "b", "broken")
    world.run(stages=ROBOT_STAGES, until="localize")
    found = run_tables(world.out, (MOTION, OBSERVATIONS))
    assert set(found) == {"a", "b"}
    assert set(found["a"]) == {MOTION.name, OBSERVATIONS.name}
    assert all(path.is_file() for path in found["a"][MOTION.name])
    assert found["b"] == {}
    with pytest.raises(SemslamError, match="not an output folder"):
        run_tables(world.logs, (MOTION,))


# --------------------------------------------------------------------------------------------------------- symmetries


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_drive_gives_the_turned_map(drives: DriveSet, quarters: int) -> None:
    """Placing the same sights from turned poses, cell by cell; so are the labels."""
    options = options_for(drives)
    drive = drives.drives[0]
    plain, other = (mapping._leaky_maps(collated([one]), options)[1] for one in (drive, turned(drive, quarters)))
    np.testing.assert_allclose(other.numpy(), np.rot90(plain.numpy(), -quarters, (3, 4)), atol=1e-5)
    np.testing.assert_array_equal(turned(drive, quarters).visible(5), np.rot90(drive.visible(5), -quarters))
    quarter = SE2(0.0, 0.0, quarters * np.pi / 2) @ SE2(*drive.poses[7])
    assert turned(drive, quarters).poses[7, :2].tolist() == pytest.approx([quarter.x_m, quarter.y_m])


def test_a_mirrored_drive_gives_the_mirrored_map(tmp_path: Path) -> None:
    """Sights, poses, motion and labels fit together; twice mirrored is the drive itself."""
    story = write_data_set(tmp_path, logs=2)["home_00"]
    run = {"home_00": write_run(tmp_path / "run", story, list(range(12)))}
    made = DriveSet.open(tmp_path, ["home_00"], run=run, paper=PAPER)
    drive, other = made.drives[0], mirrored(made.drives[0])
    plain, flipped = (mapping._leaky_maps(collated([one]), options_for(made))[1] for one in (drive, other))
    np.testing.assert_allclose(flipped.numpy(), plain.numpy()[:, :, :, ::-1], atol=1e-5)
    np.testing.assert_array_equal(other.visible(5), drive.visible(5)[::-1])
    walked = SE2(*other.poses[3]) @ SE2(*other.motion[4])
    assert (walked.x_m, walked.y_m) == pytest.approx(tuple(other.poses[4, :2]))
    np.testing.assert_array_equal(mirrored(other).observations, drive.observations)


# ----------------------------------------------------------------------------------------------------------- training


def test_batches_depend_on_seed_and_step_alone(drives: DriveSet) -> None:
    """Resuming needs no history; an epoch sees every drive once, in changing symmetries."""
    one, two = (DriveBatches(drives.drives, options_for(drives), 10, 1, seed=3) for _ in range(2))
    two(7)
    assert torch.equal(one(4).observations, two(4).observations)
    assert torch.equal(one(4).poses, two(4).poses)
    for epoch in range(3):
        places = sorted(one._indices(3 * epoch + index)[0] for index in range(3))
        assert places == [0, 1, 2]
    assert len({tuple(one(step).poses[-1, 0].tolist()) for step in range(12)}) > 6


def test_own_poses_come_late_and_never_without_motion(tmp_path: Path, drives: DriveSet) -> None:
    """The share rises to what was asked; the first step is known; no motion, no own pose."""
    options = MapperOptions(own_share=0.8, teacher_share=0.5)
    assert [options.own_odds(done) for done in (0.0, 0.5, 0.75, 1.0)] == pytest.approx([0.0, 0.0, 0.4, 0.8])
    story = write_data_set(tmp_path, logs=2)["home_00"]
    run = {"home_00": write_run(tmp_path / "run", story, list(range(12)))}
    made = DriveSet.open(tmp_path, ["home_00"], run=run, paper=PAPER)
    rng = np.random.default_rng(0)
    assert collated(made.drives, rng, 1.0).own[:, 0].tolist() == [False] + [True] * 11
    assert not collated(drives.drives, rng, 1.0).own.any()
    assert options_for(drives, options).own_share == 0.0
    assert options_for(made, options).own_share == 0.8


def test_own_poses_follow_the_motion_and_are_held_by_the_map(tmp_path: Path) -> None:
    """A robot that stands still while its wheels slip: the map holds it, motion alone carries it away."""
    story = write_data_set(tmp_path, logs=2)["home_00"]
    story = replace(story, poses=[story.poses[0]] * 12)
    run = {"home_00": write_run(tmp_path / "run", story, list(range(12)))}
    made = DriveSet.open(tmp_path, ["home_00"], run=run, paper=replace(PAPER, temperature=0.02))
    slipped = made.drives[0].motion + (0.05, 0.03, 0.0)
    drive = replace(made.drives[0], motion=slipped, poses=np.zeros((12, 3)))
    batch = collated([drive], np.random.default_rng(0), 1.0)

    class Remembering(mapping.MapUpdate):
        """Takes over whatever is placed."""

        def forward(self, placed: Any, hidden: Any, cell: Any) -> Any:
            inner = hidden[:, :, 1:-1, 1:-1]
            kept = torch.where(placed[:, 1:].sum(1, keepdim=True) > 0.5, 2 * placed - 1, inner)
            return kept, cell

    blind = replace(batch, observations=torch.zeros_like(batch.observations))
    errors = {}
    for name, one in (("seeing", batch), ("blind", blind)):
        with torch.no_grad():
            poses = torch.cat([part.poses for part in grow(Remembering(6), one, options_for(made))])
        errors[name] = float(torch.hypot(*(poses - batch.poses)[..., :2].unbind(-1)).mean())
    assert errors["blind"] == pytest.approx(5.5 * np.hypot(0.05, 0.03))
    assert errors["seeing"] < 1e-6


def test_only_cells_that_could_be_known_count(drives: DriveSet) -> None:
    """Labels beyond every region of interest change nothing; those inside do; unseen steps leave no trace."""
    options, network = options_for(drives), new_map_update(len(NAMES), 3, 1)
    batch = collated(drives.drives[:1])
    *_, last = grow(network, batch, options)
    beyond = ~last.visited[-1]
    assert 0 < int(beyond.sum()) < beyond.numel()
    value = mapping_loss(network, batch, options)[0].item()
    elsewhere = replace(batch, labels=torch.where(beyond, 5, batch.labels))
    assert mapping_loss(network, elsewhere, options)[0].item() == value
    inside = replace(batch, labels=torch.where(beyond, batch.labels, 5))
    assert mapping_loss(network, inside, options)[0].item() != value
    blind = replace(batch, seen=torch.zeros_like(batch.seen))
    assert not any(part.visited.any() for part in grow(network, blind, options))


def test_shorter_drives_do_not_count_beyond_their_end(drives: DriveSet) -> None:
    """A pair of drives loses the mean of what each loses over its own steps."""
    options, network = options_for(drives), new_map_update(len(NAMES), 3, 1)
    long = drives.drives[0]
    short = replace(drives.drives[1], poses=drives.drives[1].poses[:4], motion=drives.drives[1].motion[:4])
    seen = short.sights
    cut = replace(seen, seen=seen.seen[:4], starts=seen.starts[:5], cells=seen.cells[: seen.starts[4]])
    short = replace(short, sights=replace(cut, weights=seen.weights[: seen.starts[4]]))
    losses = [mapping_loss(network, collated(part), options)[0].item() for part in ([long], [short], [long, short])]
    assert losses[2] == pytest.approx((12 * losses[0] + 4 * losses[1]) / 16, rel=1e-5)


def test_it_learns_a_better_map_than_any_heuristic(tmp_path: Path) -> None:
    """From sights that are wrong in every third cell, in a home it has not seen."""
    write_data_set(tmp_path, logs=9, wrong=0.3)
    made, unseen = (
        DriveSet.open(tmp_path, logs_of(tmp_path, "cross", part), "obstructed", paper=PAPER)
        for part in ("train", "test")
    )
    schedule = Schedule(steps=90, batch=4, peak_rate=2e-2, warm_up=5, average=0.8)
    options = options_for(made)
    batches = DriveBatches(made.drives, options, schedule.steps, schedule.batch, seed=1)
    loss = partial(mapping_loss, options=options)
    network = fit(new_map_update(len(NAMES), 3, 1), loss, batches, schedule, tmp_path / "run", facts={})
    scores = judged(mapping.map_update(network), unseen, options)
    assert scores["network"].cross_entropy is not None
    assert scores["network"].cross_entropy < 1.0
    best = min(score.squared_error for name, score in scores.items() if name != "network")
    assert scores["network"].squared_error < 0.9 * best


def _write_weights(network: Any, path: Path, *_: Any) -> None:
    path.write_bytes(b"".join(value.detach().numpy().tobytes() for value in network.state_dict().values()))


def test_a_killed_training_goes_on_to_the_same_bytes(
    drives: DriveSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped in the middle and started again: the same file; another training in the folder is refused."""
    monkeypatch.setattr(mapping, "export_map_update", _write_weights)  # an export takes seconds, and has its own tests
    whole = train_mapper(drives, tmp_path / "whole", schedule=QUICK)
    made = DriveBatches.__call__

    def stopped(self: DriveBatches, step: int) -> Any:
        if step == 4:
            raise KeyboardInterrupt
        return made(self, step)

    monkeypatch.setattr(DriveBatches, "__call__", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_mapper(drives, tmp_path / "cut", schedule=QUICK)
    monkeypatch.setattr(DriveBatches, "__call__", made)
    assert train_mapper(drives, tmp_path / "cut", schedule=QUICK).read_bytes() == whole.read_bytes()
    with pytest.raises(SemslamError, match="another run"):
        train_mapper(drives, tmp_path / "cut", schedule=QUICK, options=MapperOptions(PAPER, kernel=1))


def test_a_training_that_ends_in_no_numbers_writes_nothing(
    drives: DriveSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last step may spoil the weights without a loss to tell it; no network comes of that, nor a checkpoint."""

    def spoil(optimizer: torch.optim.Optimizer) -> None:
        for group in optimizer.param_groups:
            for weights in group["params"]:
                weights.data.fill_(torch.inf)

    monkeypatch.setattr(torch.optim.AdamW, "step", spoil)
    with pytest.raises(SemslamError, match="weight") as caught:
        train_mapper(drives, tmp_path / "wild", schedule=replace(QUICK, steps=1))
    assert "--rate" in caught.value.hint
    assert not list((tmp_path / "wild").glob("*.onnx"))
    assert not (tmp_path / "wild" / "checkpoint.pt").exists()


@pytest.mark.parametrize("rate", ["nan", "inf", "0", "2"])
def test_a_rate_that_is_none_is_refused(rate: str, folder: Path, tmp_path: Path, capsys: Any) -> None:
    """As wrong use, before anything is read."""
    asked = ["train", "mapper", str(folder), "--out", str(tmp_path / "out"), "--quality", "ideal", "--rate", rate]
    assert run_command(asked, None) == 2
    assert "--rate" in capsys.readouterr().err


def test_a_shortened_drive_is_the_drive_as_it_began(drives: DriveSet) -> None:
    """The same observations, motion and poses, and the same map as far as it was visible by then."""
    whole = drives.drives[0]
    short = shortened(whole, 5)
    assert len(short) == 5
    assert np.array_equal(short.observations, whole.observations[:5])
    assert np.array_equal(short.poses, whole.poses[:5])
    assert np.array_equal(short.motion, whole.motion[:5], equal_nan=True)
    assert np.array_equal(short.visible(4), whole.visible(4))
    assert len(shortened(whole, 10_000)) == len(whole)


def test_a_map_update_writes_down_what_it_sees_before_any_training() -> None:
    """Every class, from weights as small as a share of an object; cells without anything stay unobserved."""
    for seed in (1, 2):
        fresh = new_map_update(6, 3, seed).eval()
        placed = torch.zeros(1, 6, 7, 7)
        placed[:, UNOBSERVED] = 1.0
        placed[0, :, 3, 1:6] = 0.0
        for label in range(1, 6):
            placed[0, label, 3, label] = 1.0 if label < FIRST_OBJECT else 0.2
        state = fresh.start(1, 7)
        for _ in range(3):
            state = update_map(fresh, placed, state, torch.tensor([[0, 3, 3]]), 7)
        labels = state.hidden[0, :, :-1].argmax(0).view(7, 7)
        assert labels[3].tolist() == [0, 1, 2, 3, 4, 5, 0]
        assert not labels[[0, 1, 5, 6]].any()


def test_the_command_trains_judges_and_writes_a_card(folder: Path, tmp_path: Path, capsys: Any) -> None:
    """`semslam train mapper` with the data set's own observations; without a run there is no real camera."""
    sizes = ["--side", str(SIDE), "--steps", "2", "--batch", "2", "--kernel", "1"]
    asked = ["train", "mapper", str(folder), "--out", str(tmp_path / "out"), "--quality", "ideal", *sizes]
    assert run_command(asked, None) == 0
    card = (tmp_path / "out" / "map_update.md").read_text()
    assert "| leaky 0.3 |" in card
    assert "| network |" in card
    assert "--quality ideal --protocol cross --kernel 1" in card
    assert "| poses | true ones alone |" in card
    assert "| keyframes | the first 40 of each drive |" in card
    assert (tmp_path / "out" / "map_update.onnx").is_file()
    capsys.readouterr()
    assert run_command(["train", "mapper", str(folder), "--out", str(tmp_path / "real")], None) == 1
    told = capsys.readouterr().err
    assert "come from a run" in told
    assert "hint:" in told
