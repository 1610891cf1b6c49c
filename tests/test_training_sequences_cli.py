"""`semslam train mapnet` and `deepvo`: from logs to a network that runs, a card that is honest, and clear refusals."""

from __future__ import annotations

import fcntl
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("onnxscript", reason="needs the extra [train]")

from semslam.geometry.frames import SE2  # noqa: E402
from semslam.models.nets.mapnet import MapNetShape  # noqa: E402
from semslam.models.training import mapping, runs, sequences  # noqa: E402
from semslam.models.training.deepvo import DeepVoBatches  # noqa: E402
from semslam.pipeline import train_sequences  # noqa: E402
from semslam.pipeline.cli import run_command  # noqa: E402
from semslam.pipeline.train_request import DrivesRequest  # noqa: E402
from semslam.slam.estimator import NONE, VISUAL, Belief, PoseEstimate, Step  # noqa: E402
from semslam.tables.parquet import TableFiles, write_table  # noqa: E402
from semslam.tables.spec import SPLITS, TRUTH  # noqa: E402
from tests.bench_world import make_dataset  # noqa: E402
from tests.drives_factory import SIDE, write_data_set  # noqa: E402

STEPS = {"mapnet": 1, "deepvo": 3}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of four short drives in `homes`, and the output folder of an ingest of them in `run`."""
    room = tmp_path_factory.mktemp("world")
    make_dataset(room / "homes", frames=8)
    assert run_command(["ingest", str(room / "homes/logs"), "--out", str(room / "run"), "--workers", "0"], None) == 0
    return room


def train(task: str, world: Path, out: Path, *more: str) -> int:
    folders = [str(world / "homes"), "--run", str(world / "run"), "--out", str(out)]
    return run_command(
        ["train", task, *folders, "--steps", str(STEPS[task]), "--batch", "1", "--device", "cpu", *more], None
    )


@pytest.fixture(scope="module")
def trained(world: Path) -> Path:
    """The folders of two short trainings, by name."""
    assert train("mapnet", world, world / "mapnet") == 0
    assert train("deepvo", world, world / "deepvo") == 0
    return world


@pytest.mark.parametrize("task", ["mapnet", "deepvo"])
def test_the_command_trains_judges_and_writes_a_card(trained: Path, task: str) -> None:
    """The card has what to type, what was learned from, and the worth beside dead reckoning and chance."""
    card = (trained / task / f"{task}.md").read_text()
    assert (
        f"`semslam train {task} homes --run run --out {task} --protocol cross --steps {STEPS[task]} --batch 1" in card
    )
    assert "| data | 2 drives of `homes`, 16 keyframes, digest" in card
    assert f"| steps | {STEPS[task]} of 1 sequences of {'6' if task == 'mapnet' else '8'} keyframes |" in card
    rows = {line.split(" | ")[0]: line.split(" | ")[1:] for line in card.splitlines() if line.count(" | ") == 3}
    assert list(rows) == ["| track", f"| {task}", "| dead reckoning", "| standing still", "| chance"]
    assert float(rows["| dead reckoning"][0]) < float(rows["| standing still"][0]) < float(rows["| chance"][0])
    assert rows[f"| {task}"][2] == "100% |"


def request(world: Path, **more: Any) -> DrivesRequest:
    return DrivesRequest(dataset=world / "homes", out=world / "out", run_folder=world / "run", **more)


class Knowing:
    """An estimator that has read the truth, but misses a keyframe."""

    def __init__(self, truth: Path, miss: int | None = None) -> None:
        rows = TableFiles(TRUTH, [truth]).read()
        places = zip(rows["x_m"], rows["y_m"], rows["heading_rad"], strict=True)
        self._pose_at = {stamp: SE2(*place) for stamp, place in zip(rows["stamp_nanos"], places, strict=True)}
        self._miss = miss

    def step(self, step: Step) -> PoseEstimate:
        assert step.view is not None
        assert step.motion is None
        found = None if step.frame == self._miss else self._pose_at[step.stamp_nanos]
        return PoseEstimate(found, VISUAL if found else NONE)

    def belief(self) -> Belief | None:
        return None

    def state(self) -> bytes:
        return b""

    def restore(self, state: bytes) -> None:
        pass


def test_the_judgement_is_of_tracks(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who knows the truth has no error; a missing pose lowers the coverage alone."""
    unseen, truth = train_sequences.drives_of(request(world))[1], world / "homes/truth/toy_01_t0/truth.parquet"
    for miss, shown in ((None, "100%"), (4, "88%")):
        monkeypatch.setitem(train_sequences.ESTIMATORS, "deepvo", partial(lambda miss, _: Knowing(truth, miss), miss))
        _, table = train_sequences.judged("deepvo", world, unseen[:1])
        assert f"| deepvo | 0.00 | 0.0 | {shown} |" in table


def test_both_protocols_learn_from_and_judge_on_their_own_logs(world: Path) -> None:
    """Across homes the second home tests, within homes the second drive of each."""
    for protocol, wanted in (("cross", ["toy_00_t0", "toy_00_t1"]), ("intra", ["toy_00_t0", "toy_01_t0"])):
        files, unseen = train_sequences.drives_of(request(world, protocol=protocol))
        assert [one.name for one in files] == wanted
        assert not {path for one in files for path in one.frames} & {path for one in unseen for path in one.frames}
        assert [len(one.truth.frames) for one in unseen] == [8, 8]


def test_a_cut_training_goes_on_to_the_same_bytes(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interrupted at its last step, the same command goes on, and does not look at the logs' pictures again."""
    kind, made = runs.SEQUENCES["deepvo"], DeepVoBatches.__call__
    often = replace(kind, defaults=replace(kind.defaults, report_every=1, checkpoint_s=0.0))
    monkeypatch.setitem(runs.SEQUENCES, "deepvo", often)

    def cut(self: DeepVoBatches, step: int) -> Any:
        if step == 2:
            raise KeyboardInterrupt
        return made(self, step)

    monkeypatch.setattr(DeepVoBatches, "__call__", cut)
    assert train("deepvo", trained, tmp_path / "deepvo") == 130
    assert runs.read_checkpoint(tmp_path / "deepvo" / runs.CHECKPOINT)["step"] == 2
    assert not (tmp_path / "deepvo" / "deepvo.onnx").exists()

    def unwanted(files: Any) -> Any:
        raise AssertionError(f"thumbnails of {files.name} are made twice")

    monkeypatch.setattr(DeepVoBatches, "__call__", made)
    monkeypatch.setattr(sequences, "_made", unwanted)
    assert train("deepvo", trained, tmp_path / "deepvo") == 0
    assert (tmp_path / "deepvo/deepvo.onnx").read_bytes() == (trained / "deepvo/deepvo.onnx").read_bytes()


def test_another_training_in_the_folder_is_refused(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With another seed it is another one; a second process in the same folder is told to wait."""
    before = (trained / "deepvo/deepvo.onnx").read_bytes()
    assert train("deepvo", trained, trained / "deepvo", "--seed", "2") == 1
    assert "another run" in capsys.readouterr().err
    descriptor = os.open(trained / "deepvo", os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert train("deepvo", trained, trained / "deepvo") == 1
    os.close(descriptor)
    assert "Another training is at work" in capsys.readouterr().err
    assert (trained / "deepvo/deepvo.onnx").read_bytes() == before


@pytest.mark.parametrize("task", ["mapnet", "deepvo"])
def test_what_is_missing_is_named(world: Path, tmp_path: Path, task: str, capsys: pytest.CaptureFixture[str]) -> None:
    """No run, a run that lacks a log, a run of nothing: refused before anything is written, with what to type."""
    homes, out = world / "homes", tmp_path / "out"
    assert run_command(["train", task, str(homes), "--out", str(out)], None) == 1
    assert f"hint: `semslam ingest {homes}/logs --out RUN`" in capsys.readouterr().err
    assert run_command(["train", task, str(homes), "--run", str(tmp_path), "--out", str(out)], None) == 2
    assert f"`{tmp_path}` is not an output folder" in capsys.readouterr().err
    rows = TableFiles(SPLITS, [homes / "splits.parquet"]).read()
    rows = {name: [*column, column[0]] for name, column in rows.items()}
    rows["log"][-1] = "toy_99_t0"
    (tmp_path / "more").mkdir()
    write_table(tmp_path / "more/splits.parquet", SPLITS, rows, {"seed": 0})
    lacking = ["train", task, str(tmp_path / "more"), "--run", str(world / "run"), "--out", str(out)]
    assert run_command(lacking, None) == 1
    assert "1 of 3 logs have no keyframes, such as `toy_99_t0`" in capsys.readouterr().err
    assert not out.exists()


def test_a_run_over_other_logs_is_refused(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Logs of the same names recorded at another time have no truth here."""
    (tmp_path / "truth").mkdir()
    (tmp_path / "splits.parquet").write_bytes((world / "homes/splits.parquet").read_bytes())
    for folder in (world / "homes/truth").iterdir():
        rows = TableFiles(TRUTH, [folder / "truth.parquet"]).read()
        rows["stamp_nanos"] = [stamp + 1 for stamp in rows["stamp_nanos"]]
        (tmp_path / "truth" / folder.name).mkdir()
        write_table(tmp_path / "truth" / folder.name / "truth.parquet", TRUTH, rows)
    asked = ["train", "deepvo", str(tmp_path), "--run", str(world / "run"), "--out", str(tmp_path / "out")]
    assert run_command(asked, None) == 1
    assert "no true pose for any keyframe of `toy_01_t0`" in capsys.readouterr().err


def test_without_torch_it_says_what_to_install(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A plain installation has no trainings."""
    monkeypatch.setattr("semslam.models.extras.find_spec", lambda _: None)
    assert train("mapnet", world, tmp_path / "out") == 1
    assert "hint: pip install 'semslam[train]'" in capsys.readouterr().err


def _told(network: Any, path: Path, *more: Any) -> None:
    """In place of an export, which takes seconds and has its own tests: what it was given."""
    weights = {name: value.tolist() for name, value in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{weights}\n{more}")


@pytest.mark.parametrize(("task", "more"), [("mapnet", (MapNetShape(),)), ("deepvo", ())])
def test_what_a_run_has_learned_is_exported(
    trained: Path, task: str, more: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`models export --run`: the averaged weights of the checkpoint, and the whole map, larger than in training."""
    monkeypatch.setattr(f"semslam.models.training.{task}.export_{task}", _told)
    assert run_command(["models", "export", task, str(tmp_path), "--run", str(trained / task)], None) == 0
    stored = runs.read_checkpoint(trained / task / runs.CHECKPOINT)
    average = {name.removeprefix("module."): value for name, value in stored["average"].items() if "." in name}
    weights = {name: value.tolist() for name, value in average.items()}
    assert (tmp_path / f"{task}.onnx").read_text() == f"{weights}\n{more}"


def test_a_run_of_another_network_is_not_exported(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A DeepVO's run makes no MapNet and no map update."""
    for task in ("mapnet", "mapper"):
        assert run_command(["models", "export", task, str(tmp_path), "--run", str(trained / "deepvo")], None) == 1
        assert f"not the run of a {task}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def _told_of_mapper(network: Any, path: Path, drives: Any, options: Any) -> None:
    _told(network, path, drives.classes, options)


def test_random_mappers_are_exported_by_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same seed gives the same weights, another one others; the classes are those that are given."""
    monkeypatch.setattr(runs, "export_map_update", _told_of_mapper)
    (tmp_path / "names.txt").write_text("chair\ntable\n")
    classes = ["--classes", str(tmp_path / "names.txt")]
    for name, seed in zip("abc", "112", strict=True):
        assert run_command(["models", "export", "mapper", str(tmp_path / name), "--random", seed, *classes], None) == 0
    one, two, three = ((tmp_path / name / "map_update.onnx").read_text() for name in "abc")
    assert one == two != three
    assert "\n(('unobserved', 'free_floor', 'obstacle', 'chair', 'table'), MapperOptions(" in one
    assert run_command(["models", "export", "deepvo", str(tmp_path), "--random", "1", *classes], None) == 2


def test_a_mapper_s_run_is_exported_with_its_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The weights, classes and options that its training exported, from the checkpoint alone."""
    monkeypatch.setattr(runs, "export_map_update", _told_of_mapper)
    monkeypatch.setattr(mapping, "export_map_update", _told_of_mapper)
    write_data_set(tmp_path / "homes")
    sizes = ["--quality", "ideal", "--side", str(SIDE), "--kernel", "1", "--steps", "2", "--batch", "2"]
    out, again = tmp_path / "out", tmp_path / "again"
    assert run_command(["train", "mapper", str(tmp_path / "homes"), "--out", str(out), *sizes], None) == 0
    assert run_command(["models", "export", "mapper", str(again), "--run", str(out)], None) == 0
    assert (again / "map_update.onnx").read_text() == (out / "map_update.onnx").read_text()
