"""What is wrong with a configuration is said before any log is read, once, as wrong use."""

from __future__ import annotations

from pathlib import Path

import pytest

from semslam.errors import UsageError
from semslam.models import builtin
from semslam.pipeline.cache import EntryIndex
from semslam.pipeline.cli import run_command
from semslam.pipeline.config import load_config
from semslam.pipeline.digest import DigestCache
from semslam.pipeline.discover import Log
from semslam.pipeline.plan import Planner, tasks_of
from semslam.pipeline.preflight import check_new
from semslam.pipeline.record import LogRecord, TaskRecord
from semslam.stages.catalogue import STAGES
from tests.onnx_factory import constant_detector, dense, sam_decoder, sam_encoder

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector of two classes, a segmenter, class lists, a broken model, and three logs that nobody may read."""
    folder = tmp_path_factory.mktemp("files")
    boxes = {"output": dense(84, 7, {})}  # 8 x 8 + 4 x 4 + 2 x 2 rows of YOLOX at 64 pixels, two classes
    constant_detector(folder / "detector.onnx", boxes)
    sam_encoder(folder / "encoder.onnx")
    sam_decoder(folder / "decoder.onnx")
    (folder / "classes.txt").write_text("chair\ntable\n")
    (folder / "three.txt").write_text("chair\ntable\nlamp\n")
    (folder / "broken.onnx").write_bytes(bytes(100))
    for name in "abc":
        (folder / "logs").mkdir(exist_ok=True)
        (folder / "logs" / f"{name}.mcap").write_bytes(name.encode())
    return folder


GOOD = ["--detector", "detector.onnx", "--classes", "classes.txt"]
PAPER = [*GOOD, "--estimator", "paper"]


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["--detector", "broken.onnx"], "is no ONNX file, or is damaged", "again"),
        (["--detector", "encoder.onnx"], "No adapter fits detector", "extract.adapter"),
        (["--detector", "detector.onnx", "--classes", "three.txt"], "3", ""),
        ([*GOOD, "--set", "extract.adapter=yolo99"], "No detector adapter `yolo99`", "yolov8"),
        ([*GOOD, "--set", "extract.select=chiar"], "names the class `chiar`", "did you mean `chair`?"),
        ([*GOOD, "--segmenter-encoder", "encoder.onnx"], "an image encoder and a mask decoder", "--segmenter-decoder"),
        ([*GOOD, "--set", "extract.side=98"], "`extract.side` is 98", "extract.side=99"),
        ([*PAPER, "--set", "localize.paper.map_side=32"], "`localize.paper.map_side` is 32", "33"),
        ([*PAPER, "--set", "localize.paper.side=10"], "`localize.paper.side` is 10", "11"),
        ([*PAPER, "--set", "localize.paper.cell_m=0.2"], "no odd multiple of `extract.cell_m`", "0.3"),
        ([*GOOD, "--prior", "nowhere"], "`--prior nowhere` is no map made before", "results/LOG/surfel"),
        ([*GOOD, "--prior", "classes.txt", "--estimator", "paper"], "for the estimator `surfel`", "--estimator surfel"),
        (
            [*GOOD, "--prior", "classes.txt", "--set", "localize.estimators=paper"],
            "not among those to run",
            "--estimator surfel",
        ),
        ([*GOOD, "--prior", "logs"], "there is no `places.parquet`", "results/LOG/surfel"),
        ([*GOOD, "--prior", "classes.txt"], "classes.txt` is damaged", ""),
        ([*PAPER, "--set", "localize.paper.update=learned"], "classes", "localize.paper"),
        (
            [*GOOD, "--estimator", "deepvo", "--set", "localize.deepvo.model=broken.onnx"],
            "is no ONNX file, or is damaged",
            "again",
        ),
        ([*GOOD, "--set", "export.free_threshold=0.9"], "leaves nothing between them", "0.196"),
        ([*GOOD, "--set", "export.min_obstacle_height_m=2"], "nothing between them for obstacles", "1.5"),
        ([*GOOD, "--topic", "color=/camera"], "unknown role `color`", "did you mean `colour`?"),
        ([*GOOD, "--set", "extract.min_depth_m=7"], "leaves no depth between them", "max_depth_m"),
    ],
)
def test_a_wrong_configuration_is_wrong_use(
    files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
    arguments: list[str],
    message: str,
    hint: str,
) -> None:
    """Exit code 2, one error for three logs, and nothing was hashed or run."""
    monkeypatch.chdir(files)
    assert run_command(["run", "logs", "--out", str(tmp_path), "--workers", "0", *arguments], None) == 2
    shown = capsys.readouterr().err
    assert shown.count("error:") == 1
    assert message in shown
    assert hint in shown
    assert not list((tmp_path / "cache").glob("*")) if (tmp_path / "cache").exists() else True
    assert not (tmp_path / "config.json").exists()


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        ([], "No detector", "--detector FILE.onnx"),
        ([*GOOD, "--set", "extract.segmenter=sam"], "no models are given", "--segmenter-encoder"),
    ],
)
def test_a_package_without_models_asks_for_some(
    files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
    arguments: list[str],
    message: str,
    hint: str,
) -> None:
    """Whoever packs semslam without its weights gets told what to name."""
    monkeypatch.chdir(files)
    monkeypatch.setattr(builtin, "FOLDER", tmp_path / "nothing")
    assert run_command(["run", "logs", "--out", str(tmp_path), "--workers", "0", *arguments], None) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert hint in shown


def test_a_right_configuration_gets_to_the_logs(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """Which are no logs here, and are told so each; a stage that is not asked for is not checked."""
    monkeypatch.chdir(files)
    sam = ["--segmenter-encoder", "encoder.onnx", "--segmenter-decoder", "decoder.onnx"]
    for models in ([], GOOD, [*GOOD, *sam]):
        assert run_command(["run", "logs", "--out", str(tmp_path), "--workers", "0", *models], None) == 1
        assert capsys.readouterr().err.count("error: ingest of") == 3
    assert run_command(["ingest", "logs", "--out", str(tmp_path), "--workers", "0"], None) == 1
    assert capsys.readouterr().err.count("error: ingest of") == 3


def test_the_map_of_the_paper_is_not_asked_of_others(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dead reckoning has no cells that could not fit."""
    monkeypatch.chdir(files)
    others = [*GOOD, "--estimator", "dead_reckoning", "--set", "extract.cell_m=0.25"]
    assert run_command(["run", "logs", "--out", str(tmp_path), "--workers", "0", *others], None) == 1


def test_config_check_looks_at_the_models(files: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """A file without a detector is fine, since that is often given on the command line."""
    monkeypatch.chdir(files)
    path = files / "home.toml"
    path.write_text("[localize]\nsnapshot_every = 5\n")
    assert run_command(["config", "check", str(path)], None) == 0
    path.write_text('[extract]\ndetector = "broken.onnx"\n')
    assert run_command(["config", "check", str(path)], None) == 2
    assert "is no ONNX file" in capsys.readouterr().err


def test_a_configuration_that_made_results_is_not_checked_again(files: Path, tmp_path: Path) -> None:
    """Only what is new costs the loading of networks; an earlier stage's change counts as new."""
    config = load_config(STAGES, assignments=[f"extract.detector={files / 'broken.onnx'}"])
    planner = Planner(STAGES, config, tmp_path, EntryIndex(tmp_path), DigestCache(tmp_path / "d.json"), "export")
    tasks = list(tasks_of(STAGES, Log("a", ()), config))
    made = {task.name: TaskRecord("k", {**planner.standing(task), "inputs": {}}, "", "done") for task in tasks}
    check_new(planner, config, tasks, [LogRecord("other"), LogRecord("a", [], {}, made)])
    del made["ingest"]
    with pytest.raises(UsageError, match="no ONNX file"):
        check_new(planner, config, tasks, [LogRecord("a", [], {}, made)])


def test_a_task_is_keyed_by_its_own_sections_alone(tmp_path: Path) -> None:
    """A setting that one estimator gains, or is given, makes no other estimator's results stale."""

    def standing(*assignments: str) -> dict[str, dict[str, object]]:
        config = load_config(STAGES, assignments=["localize.estimators=surfel,paper,dead_reckoning", *assignments])
        planner = Planner(STAGES, config, tmp_path, EntryIndex(tmp_path), DigestCache(tmp_path / "d.json"), "export")
        tasks = tasks_of(STAGES, Log("a", ()), config)
        return {task.variant: planner.standing(task)["config"] for task in tasks if task.stage.name == "localize"}

    before, after = standing(), standing("localize.surfel.rounds=3")
    assert [name for name in before if before[name] != after[name]] == ["surfel"]
    assert {"surfel", "mapnet", "deepvo", "orb_rgbd"}.isdisjoint(before["paper"])
    assert "paper" not in before["surfel"]
    assert before["dead_reckoning"]["snapshot_every"] == 10
