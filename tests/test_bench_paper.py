"""`semslam bench paper`: tables that say what was found, figures that come out the same, and a bench that goes on."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("matplotlib", reason="the figures need the extra [report]")

from semslam.bench import figures, peers, tables
from semslam.bench.dataset import open_dataset
from semslam.bench.jobs import run_parts
from semslam.bench.paper import BenchReport, bench_paper
from semslam.bench.rows import ALL, chosen_rows
from semslam.bench.store import Store
from semslam.bench.work import BenchRequest
from semslam.errors import SemslamError, UsageError
from semslam.pipeline.cli import run_command
from semslam.pipeline.console import Console
from semslam.pipeline.folder import OutputFolder
from semslam.stages.catalogue import STAGES
from tests.bench_parts import part
from tests.bench_world import made_up_results, make_dataset


def test_a_finished_part_is_not_done_again(tmp_path: Path) -> None:
    """Its result is found by its facts, whatever its title and arguments."""
    store = Store(tmp_path)
    first = run_parts(store, [part(1), part(2)], 0)
    again = run_parts(store, [part(2, how="error"), part(1)], 0)
    assert [one.result for one in again.values()] == [{"value": 2}, {"value": 1}]
    assert all(one.cached for one in again.values())
    assert not any(one.cached for one in first.values())
    assert (store.folder(part(1)) / "calls").read_text() == "x"


def test_a_failed_part_says_why_and_is_tried_again(tmp_path: Path) -> None:
    """Our errors by their message; surprises with a traceback in the part's folder, gone once it succeeds."""
    store = Store(tmp_path)
    (told,) = run_parts(store, [part(how="error")], 0).values()
    (surprised,) = run_parts(store, [part(how="surprise")], 0).values()
    assert told.reason == "there is no such thing"
    assert "KeyError" in surprised.reason
    assert "surprise" in (store.folder(part()) / "traceback.txt").read_text()
    (done,) = run_parts(store, [part()], 0).values()
    assert (done.result, done.reason) == ({"value": 1}, "")
    assert not (store.folder(part()) / "traceback.txt").exists()


def test_a_crash_or_a_hang_costs_its_part_alone(tmp_path: Path) -> None:
    """In processes of their own: a killed one and one that takes too long are named, the third is done."""
    parts = [part(1, "crash"), part(2, "hang", timeout_s=4.0), part(3)]
    outcomes = list(run_parts(Store(tmp_path), parts, 3).values())
    assert "SIGKILL" in outcomes[0].reason
    assert "more than 4 s" in outcomes[1].reason
    assert outcomes[2].result == {"value": 3}


def test_a_killed_bench_leaves_nobody_behind_and_goes_on(tmp_path: Path) -> None:
    """What was finished when the power went is there, workers are gone, and the rest is done by the next run."""
    store = Store(tmp_path)
    script = (
        "from pathlib import Path\n"
        "from semslam.bench.jobs import run_parts\n"
        "from semslam.bench.store import Store\n"
        "from tests.bench_parts import part\n"
        f"if __name__ == '__main__': run_parts(Store(Path({str(tmp_path)!r})), [part(1), part(2, 'hang')], 1)\n"
    )
    (tmp_path / "bench.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    bench = subprocess.Popen([sys.executable, str(tmp_path / "bench.py")], env=environment)
    mark = store.folder(part(2)) / "process"
    _await(lambda: mark.exists() and mark.read_text() != "")
    bench.kill()
    bench.wait()
    worker = int(mark.read_text())
    _await(lambda: not _runs(worker))
    outcomes = run_parts(store, [part(1), part(2)], 0)
    assert [(one.result, one.cached) for one in outcomes.values()] == [({"value": 1}, True), ({"value": 2}, False)]


def _await(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def _runs(process: int) -> bool:
    """Whether a process is there and not a corpse."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_tables_put_the_published_figure_beside_ours() -> None:
    """With interval, coverage, seeds and drives; chance, standing still and dead reckoning among the rows."""
    results = made_up_results()
    sheet = tables.pose_sheet(results, "cross")
    rows = {row[0]: row for row in sheet.rows}
    visual = rows["SemanticSLAM, visual-inertial"]
    assert (visual[1], visual[3], visual[5], visual[6]) == ("2.39", "57.1", "100%", "2 x 5")
    low, high = visual[2].split("(")[1].rstrip(")").split(" to ")
    assert float(low) < float(visual[2].split()[0]) < float(high)
    assert {"Chance", "Standing still", "Dead reckoning"} <= rows.keys()
    assert rows["kiss-icp"][2:] == ("-", "", "-", "-", "not run")


def test_the_ablation_tells_signs() -> None:
    """The IMU improves both there and here; each change is paired."""
    sheet = tables.ablation_sheet(made_up_results())
    assert [row[0] for row in sheet.rows] == ["MapNet", "+ semantic observations", "+ ConvLSTM", "+ IMU"]
    imu = sheet.rows[-1]
    assert imu[2] == "-0.85"
    assert imu[4].startswith("-1.96 (-2.")
    assert imu[-1] == "APE yes, DE yes"


def test_the_margin_names_the_best_heuristic() -> None:
    """Two thirds of the error of leaky 0.1, better on every drive, intervals apart."""
    for row in tables.margin_sheet(made_up_results()).rows:
        assert row[1] == "leaky 0.1"
        assert 0.6 < float(row[3]) < 0.7
        assert row[4:6] == ("yes", "5 of 5")


def test_settings_are_told_for_both_methods() -> None:
    """Each changed setting beside the method as configured; gates are for the visual-inertial one alone."""
    inertial, visual = tables.settings_sheets(made_up_results())
    assert inertial.rows[0][0] == visual.rows[0][0] == "as configured"
    assert {"R = 8", 'gate "any"'} <= {row[0] for row in inertial.rows}
    changes = {row[0]: row[2] for row in visual.rows}
    assert 0.5 < float(changes["visual, R = 8"].split()[0]) < 1.5
    assert not any("gate" in name for name in changes)


def test_poses_are_looked_for_in_maps_of_true_poses() -> None:
    """Errors of each quality; the keyframe in which nothing fitted is counted, not averaged."""
    sheet = tables.found_sheet(made_up_results())
    assert [row[0] for row in sheet.rows] == ["ConvLSTM", "leaky 0.1", "leaky 0.3", "leaky 0.7", "leaky 1.0"]
    assert sheet.rows[0][1].startswith("0.07")  # 0.02 times the mean of 2, 3, 4, 5
    assert {row[2].split()[0] for row in sheet.rows} == {"10.0"}
    assert "80%" in sheet.notes[0]


def test_classes_are_pooled_over_drives() -> None:
    """Cells of all maps together: chairs (2 + 3 + 4 + 5 + 6) / 50; classes in no map have no row."""
    sheet = tables.class_sheet(made_up_results(), "real")
    assert sheet.head[:2] == ("class", "ConvLSTM")
    assert [row[0] for row in sheet.rows] == ["unobserved", "free floor", "obstacle", "chair"]
    assert set(sheet.rows[3][1:]) == {"0.400"}


def test_the_page_tells_conditions_and_what_is_missing(tmp_path: Path) -> None:
    """Noise, keyframes, seeds; each missing row once, with its reason."""
    results = made_up_results()
    page = tables.report(results, {"errors_cross.svg": "Error over time"})
    assert "noise of IMU and wheels: standard" in page
    assert "the first 6 keyframes" in page
    assert "| kiss-icp | intra; cross | not installed |" in page
    assert "![Error over time](errors_cross.svg)" in page
    tables.write_tables(results, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"table1_cross.csv", "table4_reached.csv", "pose_scores.parquet", "map_steps.parquet"} <= names
    assert "training_times.md" in names
    head, first = (tmp_path / "pose_scores.csv").read_text().splitlines()[:2]
    assert head == "row,protocol,seed,log,coverage,ape_m,de_deg"
    assert first.startswith("chance,intra,0,log_0,1.0,")


def test_figures_come_out_the_same_and_carry_no_date(tmp_path: Path) -> None:
    """Every figure of the paper, byte for byte, whatever the user's own matplotlib is set to."""
    results = made_up_results(steps=3, drives=2)
    (tmp_path / "other").mkdir()
    drawn = figures.write_figures(results, tmp_path)
    import matplotlib

    matplotlib.rcParams["lines.linewidth"] = 9.0
    again = figures.write_figures(results, tmp_path / "other")
    assert drawn == again
    wanted = {"errors_intra", "errors_cross", "table1", "map_loss", "map_updates_real", "map_updates_ideal"}
    assert {f"{name}.svg" for name in wanted} <= drawn.keys()
    for name in drawn:
        text = (tmp_path / name).read_text()
        assert text == (tmp_path / "other" / name).read_text()
        assert "<dc:date>" not in text
    assert matplotlib.rcParams["lines.linewidth"] == 9.0


def test_labels_are_pushed_apart() -> None:
    """No closer than the gap, in their order, none below the axis, and those with room stay where they are."""
    places = figures._apart([0.0, 0.1, 0.15, 5.0], 1.0, 0.0)
    assert places == pytest.approx([0.0, 1.0, 2.0, 5.0])
    assert figures._apart([1.0, 3.0], 1.0, 0.0) == [1.0, 3.0]
    assert figures._apart([2.9, 3.0], 1.0, 0.0) == pytest.approx([2.45, 3.45])


def test_an_unknown_row_is_refused() -> None:
    """With the names there are."""
    with pytest.raises(UsageError, match="no row `slam`") as caught:
        chosen_rows(["slam"])
    assert "visual_inertial" in caught.value.hint
    assert [row.name for row in chosen_rows(["mapnet", "chance"])] == ["chance", "mapnet"]


ROWS = ("chance", "dead_reckoning", "visual_inertial_leaky", "small_gicp", "kiss_icp", "r_8", "maps", "noise")


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A toy data set, and a bench over it that needs no torch, run once."""
    root = tmp_path_factory.mktemp("bench")
    make_dataset(root / "homes", frames=3)
    return root


def quick(toy: Path, *rows: str) -> BenchReport:
    request = BenchRequest(toy / "homes", toy / "out", rows=rows, steps=3, quick=True, workers=0)
    return bench_paper(request, STAGES, Console(quiet=True))


def results_of(toy: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (toy / "out" / "results").iterdir()}


def test_a_quick_bench_fills_every_table_and_goes_on(toy: Path) -> None:
    """From logs to the page; a second run does nothing again but what was lost, and writes the same bytes."""
    report = quick(toy, *ROWS)
    first = results_of(toy)
    found = {(one.row, one.protocol) for one in report.results.tracks}
    assert {("chance", "intra"), ("dead_reckoning", "cross"), ("visual_inertial_leaky", "cross")} <= found
    assert ("r_8", "intra") not in found
    reckoned = report.results.poses("dead_reckoning", "cross", "ape_m")
    assert reckoned.shape == (1, 2)
    assert (reckoned < 0.2).all()
    leaky = report.results.map_curves("leaky_0.3", "ideal")
    assert leaky.shape == (1, 2, 3)
    assert (leaky < 0.1).all()
    again = report.results.found_again("leaky_0.3", "ideal", "ape_m")
    assert again.shape == (1, 2)
    assert (again < 0.6).all()  # two cells: the whole room around the robot was laid down in the first keyframe
    for row in ("dead_reckoning", "visual_inertial_leaky"):  # the logs' own noise: as through the pipeline
        own, piped = report.results.noise_poses(row, 1.0, "ape_m"), report.results.poses(row, "cross", "ape_m")
        assert own.tolist() == piped.tolist()
    exact, triple = (report.results.noise_poses("dead_reckoning", level, "ape_m") for level in (0.0, 3.0))
    assert (exact < 1e-6).all()
    assert (triple > 2 * reckoned).all()
    assert {"README.md", "map_loss.svg", "table1.svg", "errors_cross.svg", "map_updates_ideal.svg"} <= first.keys()
    parts = list((toy / "out" / "parts" / "maps").glob("*/result.json"))
    stamps = {path: path.stat().st_mtime_ns for path in parts}
    parts[0].unlink()
    quick(toy, *ROWS)
    assert results_of(toy) == first
    changed = [path for path in parts if path.stat().st_mtime_ns != stamps[path]]
    assert changed == parts[:1]


def test_what_cannot_run_is_listed(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Peers that are not installed and networks without torch are rows with a reason, not gaps."""
    monkeypatch.setattr(peers, "installed", lambda _: False)
    monkeypatch.setattr("semslam.bench.networks.find_spec", lambda _: None)
    request = BenchRequest(
        toy / "homes", toy / "other", ("kiss_icp", "deepvo"), quick=True, run=toy / "out" / "pipeline"
    )
    report = bench_paper(request, STAGES, Console(quiet=True))
    assert not (toy / "other" / "pipeline").exists()  # it builds on the run that is there
    told = {one.name: one for one in report.results.reasons}
    assert told["kiss_icp"].reason == "not installed: `pip install kiss-icp`"
    assert "torch is not installed" in told["deepvo"].reason
    page = report.page.read_text()
    assert "| DeepVO | 3.97 | - |" in page
    assert "pip install 'semslam[train]'" in page


def test_networks_are_trained_and_used(toy: Path) -> None:
    """The paper's own method with its network, in both tables; the network is kept for the next run."""
    pytest.importorskip("torch", reason="needs torch: pip install 'semslam[train]'")
    report = quick(toy, "visual_inertial", "maps")
    assert not report.results.missing
    assert report.results.poses("visual_inertial", "cross", "ape_m").shape == (1, 2)
    assert report.results.map_curves("convlstm", "real").shape == (1, 2, 3)
    models = list((toy / "out" / "parts" / "networks").glob("*/map_update.onnx"))
    assert len(models) == 5  # intra; cross of three qualities, and with the wide view
    stamps = [path.stat().st_mtime_ns for path in models]
    again = quick(toy, "visual_inertial", "maps")
    assert [path.stat().st_mtime_ns for path in models] == stamps
    assert again.results.tracks == report.results.tracks
    before = models[0].read_bytes()
    models[0].write_bytes(before[: len(before) // 2])  # a network that was lost is made again from its checkpoint
    assert quick(toy, "visual_inertial", "maps").results.tracks == report.results.tracks
    assert models[0].read_bytes() == before


def test_a_run_to_build_on_must_be_there(toy: Path, tmp_path: Path) -> None:
    """A mistyped folder is not made anew and observed all over again."""
    request = BenchRequest(toy / "homes", tmp_path / "out", ("chance",), quick=True, run=tmp_path / "nowhere")
    with pytest.raises(UsageError, match="nowhere"):
        bench_paper(request, STAGES, Console(quiet=True))
    assert not (tmp_path / "nowhere").exists()


def test_a_map_update_is_chosen_by_the_rows_alone(toy: Path, tmp_path: Path) -> None:
    """One that is asked for is refused, not silently left aside."""
    for setting in ("update=learned", "model=mine.onnx"):
        asked = {"assignments": (f"localize.paper.{setting}",), "run": toy / "out" / "pipeline"}
        request = BenchRequest(toy / "homes", tmp_path / "out", ("chance",), **asked)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="chosen by the rows") as caught:
            bench_paper(request, STAGES, Console(quiet=True))
        assert "--rows" in caught.value.hint


def test_one_bench_at_a_time(toy: Path, tmp_path: Path) -> None:
    """A second one in the same folder is told who is there."""
    (tmp_path / "out").mkdir()
    request = BenchRequest(toy / "homes", tmp_path / "out", ("chance",), run=toy / "out" / "pipeline")
    with (
        OutputFolder(tmp_path / "out").locked(),
        pytest.raises(SemslamError, match=f"is in use by process {os.getpid()}"),
    ):
        bench_paper(request, STAGES, Console(quiet=True))


def test_a_damaged_data_set_is_made_again_by_simulate(toy: Path, tmp_path: Path) -> None:
    """The hint names the command that makes its files, not a run's."""
    homes = tmp_path / "homes"
    shutil.copytree(toy / "homes", homes)
    for damaged in (next(homes.glob("truth/*/truth.parquet")), homes / "splits.parquet"):
        damaged.write_bytes(damaged.read_bytes()[:100])
        with pytest.raises(SemslamError, match=f"`{damaged}` is damaged") as caught:
            open_dataset(homes).longest  # noqa: B018
        assert caught.value.hint == f"make it again: `semslam simulate {homes} --verify`"


@pytest.mark.skipif(find_spec("torch") is None, reason="needs torch: pip install 'semslam[train]'")
def test_a_gpu_that_is_not_there_is_refused(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before anything is read."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    request = BenchRequest(toy / "homes", tmp_path / "out", ("deepvo",), device="cuda")
    with pytest.raises(SemslamError, match="finds no GPU"):
        bench_paper(request, STAGES, Console(quiet=True))
    assert not (tmp_path / "out").exists()


def test_results_hold_only_what_was_asked_for(toy: Path) -> None:
    """Tables and figures of rows that an earlier command asked for do not stay behind."""
    quick(toy, "chance", "maps")
    assert "map_loss.svg" in results_of(toy)
    quick(toy, "chance")
    assert not [name for name in results_of(toy) if name.startswith(("map", "table4"))]


def test_the_command_asks_for_a_data_set(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Without one it says what to type; a folder that is none is named."""
    assert run_command(["bench", "paper"], None) == 2
    assert "semslam simulate" in capsys.readouterr().err
    assert run_command(["bench", "paper", str(tmp_path), "--out", str(tmp_path / "out"), "--json"], None) == 1
    captured = capsys.readouterr()
    assert "splits.parquet" in captured.err
    assert str(tmp_path) in json.loads(captured.out)["error"]["message"]


def test_every_row_has_a_title_of_its_own() -> None:
    """Two rows of one name would be told apart by nobody."""
    titles = [row.title for row in ALL.values()]
    assert len(titles) == len(set(titles))
