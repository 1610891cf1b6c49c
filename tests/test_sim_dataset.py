"""Making data sets: what is finished stays, what is not is never there, and nothing is mixed."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from semslam.errors import SemslamError, UsageError
from semslam.logs.reader import LogReader
from semslam.pipeline.discover import discover
from semslam.sim import dataset
from semslam.sim.dataset import NOISES, VARIANTS, Recipe
from semslam.sim.pool import Pool
from semslam.sim.simulate import Recorder, Report, simulate
from semslam.sim.splits import load_split
from tests import fake_sim
from tests.fake_sim import CALLS, PAUSE, tree

SMALL = Recipe(scenes=2, trajectories=2, steps=3)
Calls = Callable[[], list[str]]


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Names of the logs recorded since the last question, sorted."""
    file = tmp_path / "calls.txt"
    monkeypatch.setenv(CALLS, str(file))

    def since() -> list[str]:
        names = sorted(file.read_text().splitlines()) if file.exists() else []
        file.unlink(missing_ok=True)
        return names

    return since


def make(out: Path, recipe: Recipe = SMALL, recorder: Recorder = fake_sim.quick, **options: Any) -> Report:
    options.setdefault("workers", 0)
    return simulate(out, recipe, recorder=recorder, **options)


def states(report: Report) -> dict[str, str]:
    return {one.recording.name: one.state for one in report.results}


ALL_FOUR = ["home_00_t0", "home_00_t1", "home_01_t0", "home_01_t1"]


def test_what_a_data_set_holds(tmp_path: Path, calls: Calls) -> None:
    """Logs, truth, receipts, splits and a plan that names every log's digest; nothing else."""
    report = make(tmp_path / "out")
    assert calls() == ALL_FOUR
    assert states(report) == dict.fromkeys(ALL_FOUR, "done")
    made = tree(tmp_path / "out")
    expected = {"plan.json", "splits.parquet"}
    for name in ALL_FOUR:
        expected |= {f"logs/{name}.mcap", f"truth/{name}/truth.txt", f"receipts/{name}.json"}
    assert set(made) == expected
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert [one["sha256"] for one in plan["logs"]] == [made[f"logs/{name}.mcap"] for name in ALL_FOUR]
    assert plan["recipe"]["scenes"] == 2
    assert {"semslam", "simulator", "mujoco", "mujoco-warp", "warp-lang", "numpy"} <= set(plan["versions"])


def test_the_pipeline_takes_every_log_alone_under_its_name(tmp_path: Path) -> None:
    """No log is taken for the next part of a split recording; names are those of the data set."""
    make(tmp_path / "out", Recipe(scenes=2, trajectories=2, days=2, steps=1, variants=("rooms", "standard")))
    found = discover([str(tmp_path / "out" / "logs")])
    homes = [f"{kind}_{scene:02}_d{day}" for kind in ("home", "rooms") for scene in (0, 1) for day in (0, 1)]
    assert [log.name for log in found.logs] == [f"{home}_t{t}" for home in homes for t in (0, 1)]
    assert all(len(log.sources) == 1 for log in found.logs)
    assert not found.problems
    assert not found.warnings


def test_the_second_time_nothing_is_done(tmp_path: Path, calls: Calls) -> None:
    """Finished logs are skipped by their receipts, and every byte stays."""
    make(tmp_path / "out")
    before = tree(tmp_path / "out")
    calls()
    report = make(tmp_path / "out")
    assert calls() == []
    assert states(report) == dict.fromkeys(ALL_FOUR, "cached")
    assert report.summary().frames == 12
    assert report.summary().frames_per_cpu_s is None
    assert tree(tmp_path / "out") == before


def test_the_number_of_workers_does_not_show(tmp_path: Path) -> None:
    """In this process, with one worker and with two: the same bytes of every file."""
    for workers in (0, 1, 2):
        make(tmp_path / str(workers), workers=workers)
    assert tree(tmp_path / "0") == tree(tmp_path / "1") == tree(tmp_path / "2")


@pytest.mark.parametrize(
    "larger",
    [
        Recipe(scenes=3, trajectories=2, steps=3),
        Recipe(scenes=2, trajectories=3, steps=3),
        Recipe(scenes=2, trajectories=2, steps=3, variants=("plain", "standard")),
    ],
    ids=["scenes", "trajectories", "variants"],
)
def test_a_data_set_grows(tmp_path: Path, calls: Calls, larger: Recipe) -> None:
    """More scenes, trajectories or variants record only what is new, and give what a fresh data set would be."""
    make(tmp_path / "out")
    calls()
    report = make(tmp_path / "out", larger)
    new = {one.name for one in larger.recordings()} - set(ALL_FOUR)
    assert set(calls()) == new
    assert "`splits.parquet` is drawn again" in report.notes[0]
    make(tmp_path / "fresh", larger)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


@pytest.mark.parametrize(
    ("other", "difference"),
    [
        (Recipe(scenes=2, trajectories=2, steps=4), "steps  3 -> 4"),
        (Recipe(scenes=2, trajectories=2, steps=3, seed=2), "seed  1 -> 2"),
        (Recipe(scenes=2, trajectories=2, steps=3, rate_hz=2), "rate_hz  1.0 -> 2.0"),
        (Recipe(scenes=2, trajectories=2, steps=3, noise="none"), "noise  standard -> none"),
        (Recipe(scenes=2, trajectories=2, steps=3, days=2), "days  1 -> 2"),
        (Recipe(scenes=2, trajectories=2, steps=3, width=320), "width  640 -> 320"),
        (Recipe(scenes=2, trajectories=2, steps=3, variants=("plain",)), "variants  standard -> plain"),
        (Recipe(scenes=1, trajectories=2, steps=3), "scenes  2 -> 1"),
        (Recipe(scenes=2, trajectories=1, steps=3), "trajectories  2 -> 1"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_another_recipe_is_refused_and_replaces_when_told(
    tmp_path: Path, calls: Calls, other: Recipe, difference: str
) -> None:
    """The difference is named and nothing touched; with `replace` the folder is what a fresh one would be."""
    make(tmp_path / "out")
    before = tree(tmp_path / "out")
    calls()
    with pytest.raises(SemslamError, match="was made otherwise") as caught:
        make(tmp_path / "out", other)
    assert caught.value.details.strip() == difference
    assert "--replace" in caught.value.hint
    assert (tree(tmp_path / "out"), calls()) == (before, [])
    make(tmp_path / "out", other, replace=True)
    make(tmp_path / "fresh", other)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


def test_replacing_keeps_what_is_still_asked_for(tmp_path: Path, calls: Calls) -> None:
    """Fewer scenes: the others' files go, and nothing is recorded."""
    make(tmp_path / "out")
    calls()
    report = make(tmp_path / "out", Recipe(scenes=1, trajectories=2, steps=3), replace=True)
    assert calls() == []
    assert sorted(path.name for path in (tmp_path / "out" / "logs").iterdir()) == ["home_00_t0.mcap", "home_00_t1.mcap"]
    assert report.notes == ("2 logs that are not asked for were removed",)


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs of two simulators do not lie side by side."""
    make(tmp_path / "out")
    newer = {**dataset.versions(), "mujoco": "99.0", "simulator": "77"}
    monkeypatch.setattr(dataset, "versions", lambda: newer)
    with pytest.raises(SemslamError) as caught:
        make(tmp_path / "out")
    assert "-> 99.0" in caught.value.details
    assert "simulator  1 -> 77" in caught.value.details


def _truncate(out: Path) -> None:
    path = out / "logs" / "home_01_t0.mcap"
    path.write_bytes(path.read_bytes()[:-1])


def _lose_truth(out: Path) -> None:
    (out / "truth" / "home_01_t0" / "truth.txt").unlink()


def _lose_receipt(out: Path) -> None:
    (out / "receipts" / "home_01_t0.json").unlink()


def _spoil_receipt(out: Path) -> None:
    (out / "receipts" / "home_01_t0.json").write_text('{"log": "home_01_t0"}')


@pytest.mark.parametrize("damage", [_truncate, _lose_truth, _lose_receipt, _spoil_receipt])
def test_what_is_not_whole_is_made_again(tmp_path: Path, calls: Calls, damage: Callable[[Path], None]) -> None:
    """A log without its whole truth and receipt is not finished."""
    make(tmp_path / "out")
    before = tree(tmp_path / "out")
    calls()
    damage(tmp_path / "out")
    make(tmp_path / "out")
    assert calls() == ["home_01_t0"]
    assert tree(tmp_path / "out") == before


def test_a_flipped_byte_is_found_by_verify_alone(tmp_path: Path, calls: Calls) -> None:
    """Sizes must do in daily life; `verify` reads."""
    make(tmp_path / "out")
    before = tree(tmp_path / "out")
    path = tmp_path / "out" / "logs" / "home_00_t1.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    calls()
    make(tmp_path / "out")
    assert calls() == []
    report = make(tmp_path / "out", verify=True)
    assert calls() == ["home_00_t1"]
    assert "1 finished logs had been changed" in report.notes[0]
    assert tree(tmp_path / "out") == before


@pytest.mark.parametrize("workers", [0, 2])
def test_one_bad_log_does_not_stop_the_others(tmp_path: Path, calls: Calls, workers: int) -> None:
    """The failure is told with its reason, nothing of the log is left, and the next command tries it again."""
    report = make(tmp_path / "out", recorder=fake_sim.unlucky, workers=workers)
    assert states(report) == dict(zip(ALL_FOUR, ["done", "done", "failed", "failed"], strict=True))
    assert "the sofa is in the way" in str(report.failures[0].failure)
    assert not [name for name in tree(tmp_path / "out") if "home_01" in name]
    calls()
    make(tmp_path / "out")
    assert calls() == ALL_FOUR[2:]
    make(tmp_path / "fresh")
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


def test_a_killed_worker_costs_nothing(tmp_path: Path, calls: Calls) -> None:
    """Its log is tried again by another worker; what it left half written is gone."""
    report = make(tmp_path / "out", recorder=fake_sim.dies_once, workers=2)
    assert states(report) == dict.fromkeys(ALL_FOUR, "done")
    assert len(calls()) == 4
    make(tmp_path / "fresh")
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


def test_a_log_that_kills_its_workers_has_failed(tmp_path: Path) -> None:
    """After the second death the log has failed; the others are done and nothing half written is left."""
    report = make(tmp_path / "out", recorder=fake_sim.deadly, workers=2)
    assert states(report) == dict(zip(ALL_FOUR, ["done", "done", "failed", "failed"], strict=True))
    failure = report.failures[0].failure
    assert failure is not None
    assert failure.message == "The worker process was ended by signal SIGKILL, 2 times"
    assert "--workers" in failure.hint
    assert not [name for name in tree(tmp_path / "out") if "home_01" in name]


def test_a_full_disk_stops_everything(tmp_path: Path, calls: Calls) -> None:
    """One error with a hint; what was finished before stays finished."""
    with pytest.raises(SemslamError, match="No space left") as caught:
        make(tmp_path / "out", recorder=fake_sim.full_disk)
    assert caught.value.hint == "free some space, then run the same command again"
    calls()
    make(tmp_path / "out")
    assert calls() == ALL_FOUR[2:]


def start(*arguments: Any, pause_s: float = 0.0) -> subprocess.Popen[str]:
    """The command line with a slow recorder, in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.fake_sim", "simulate", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent.parent,
        env={**os.environ, PAUSE: str(pause_s)},
    )


def wait_for(process: subprocess.Popen[str], there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not there():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)


OPTIONS = ("--scenes", 4, "--trajectories", 2, "--steps", 10)


def whole_logs(out: Path) -> int:
    """Logs in the folder, every one of them readable to its end with all its messages."""
    logs = sorted((out / "logs").glob("*.mcap"))
    for log in logs:
        assert sum(1 for _ in LogReader([log]).messages()) == 10
    return len(logs)


def test_killed_at_random_moments_and_resumed(tmp_path: Path) -> None:
    """SIGKILL again and again: every log there is whole, and the last command ends with the bytes of a quiet run."""
    many = ("--scenes", 8, *OPTIONS[2:])
    make(tmp_path / "fresh", Recipe(scenes=8, trajectories=2, steps=10))
    out, dice = tmp_path / "out", random.Random(3)
    for _ in range(3):
        process = start(out, *many, "--workers", 2, pause_s=0.04)
        wait_for(process, lambda: bool(list(out.glob("logs/.*.partial-*"))))
        time.sleep(dice.uniform(0.0, 0.5))
        process.kill()
        process.communicate()
        assert whole_logs(out) < 16
    done = start(out, *many, "--workers", 2)
    _, said = done.communicate()
    assert done.returncode == 0, said
    assert tree(out) == tree(tmp_path / "fresh")


def test_workers_end_with_a_killed_command(tmp_path: Path) -> None:
    """Nothing changes in the folder once the command has been gone for a moment."""
    out = tmp_path / "out"
    process = start(out, *OPTIONS, "--workers", 2, pause_s=0.05)
    wait_for(process, lambda: bool(list(out.glob("logs/*.mcap"))))
    process.kill()
    process.communicate()
    time.sleep(0.3)
    before = tree(out)
    time.sleep(0.7)
    assert tree(out) == before


def test_interrupted(tmp_path: Path) -> None:
    """Ctrl-C: exit code 130, no traceback, only whole logs and no leftovers; the same command goes on."""
    out = tmp_path / "out"
    process = start(out, *OPTIONS, "--workers", 2, pause_s=0.03)
    wait_for(process, lambda: len(list(out.glob("receipts/*.json"))) >= 2)
    process.send_signal(signal.SIGINT)
    data, said = process.communicate(timeout=20)
    assert (process.returncode, data) == (130, "")
    assert said.splitlines()[-1] == "interrupted: run the same command again to resume"
    assert "Traceback" not in said
    finished = whole_logs(out)
    assert not list(out.rglob(".*partial*"))
    plan = json.loads((out / "plan.json").read_text())
    receipts = len(list(out.glob("receipts/*.json")))
    assert 2 <= sum(one["sha256"] is not None for one in plan["logs"]) == receipts <= finished
    again = start(out, *OPTIONS, "--workers", 2, "--json")
    told = json.loads(again.communicate()[0])
    assert told["cached"] >= 2
    assert told["cached"] + told["done"] == 8


def test_one_command_at_a_time(tmp_path: Path) -> None:
    """The second one is told who is there; the first goes on."""
    out = tmp_path / "out"
    process = start(out, *OPTIONS, "--workers", 1, pause_s=0.05)
    wait_for(process, lambda: bool(list(out.glob("logs/.*.partial-*"))))
    with pytest.raises(SemslamError, match=f"is in use by process {process.pid}") as caught:
        make(out)
    assert f"kill {process.pid}" in caught.value.hint
    assert process.poll() is None
    process.kill()
    process.communicate()


def test_foreign_folders_and_files_are_left_alone(tmp_path: Path) -> None:
    """A file, a folder with something else in it, an output folder of a run: refused, with another name to type."""
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "plan.json").write_text('{"dinner": "at eight"}')
    for name, what in (("file", "is a file"), ("full", "`thesis.tex`"), ("strange", "no plan of a data set")):
        for replace in (False, True):
            with pytest.raises(SemslamError, match=what) as caught:
                make(tmp_path / name, replace=replace)
            assert "name a" in caught.value.hint
    assert (tmp_path / "full" / "thesis.tex").exists()
    assert sorted(path.name for path in (tmp_path / "full").iterdir()) == ["thesis.tex"]


@pytest.mark.parametrize(
    "plan",
    [
        "{",
        '{"format": "semslam data set", "version": 1, "recipe": {}}',
        '{"format": "semslam data set", "version": 1, "recipe": {}, "versions": {}, "logs": [1]}',
    ],
)
def test_a_damaged_plan_is_said_to_be_damaged(tmp_path: Path, plan: str) -> None:
    """Cut or meddled with: an error that names the file, nothing overwritten."""
    make(tmp_path / "out")
    (tmp_path / "out" / "plan.json").write_text(plan)
    with pytest.raises(SemslamError, match=r"plan\.json` is damaged"):
        make(tmp_path / "out")
    assert (tmp_path / "out" / "plan.json").read_text() == plan


def test_a_stranger_among_the_logs_is_refused_and_never_removed(tmp_path: Path) -> None:
    """A log that somebody put there would be taken for part of the data set."""
    make(tmp_path / "out")
    mine = tmp_path / "out" / "logs" / "kitchen.mcap"
    mine.write_bytes(b"mine")
    for replace in (False, True):
        with pytest.raises(SemslamError, match=r"`kitchen\.mcap`") as caught:
            make(tmp_path / "out", replace=replace)
        assert "move it out" in caught.value.hint
    assert mine.read_bytes() == b"mine"


def test_a_place_that_cannot_be_written_to(tmp_path: Path) -> None:
    """A folder below a file, and one in a file system without files of ours."""
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "out", Path("/proc/semslam_homes")):
        with pytest.raises(UsageError, match="Cannot write to") as caught:
            make(path)
        assert "name another folder" in caught.value.hint


def test_leftovers_are_removed(tmp_path: Path) -> None:
    """What a killed writer left goes at the next start, whoever has its process number now."""
    make(tmp_path / "out")
    before = tree(tmp_path / "out")
    (tmp_path / "out" / "logs" / f".home_00_t0.mcap.partial-{os.getpid()}").touch()
    (tmp_path / "out" / "truth" / ".home_00_t0.partial-77").mkdir()
    (tmp_path / "out" / "truth" / ".home_00_t0.partial-77" / "truth.txt").touch()
    make(tmp_path / "out")
    assert tree(tmp_path / "out") == before
    assert not list(tmp_path.rglob(".*partial*"))


def test_counts(tmp_path: Path) -> None:
    """Objects a frame come from all logs, finished ones included; the rate from new ones alone."""
    make(tmp_path / "out", Recipe(scenes=1, trajectories=2, steps=3))
    summary = make(tmp_path / "out").summary()
    assert summary.states == {"cached": 2, "done": 2, "failed": 0}
    assert (summary.frames, summary.objects_median, summary.objects_min) == (12, 5.0, 4)
    assert summary.frames_per_cpu_s is not None
    size = sum(p.stat().st_size for k in ("logs", "truth") for p in (tmp_path / "out" / k).rglob("*") if p.is_file())
    assert summary.bytes == size


def test_variants_of_a_home_share_its_seed_and_drives_differ() -> None:
    """Home 3 plain and home 3 as it is are one home; trajectories and days are different drives."""
    recordings = Recipe(scenes=4, days=2, variants=("standard", "plain")).recordings()
    homes = {(one.scene, one.home_seed) for one in recordings}
    assert len(homes) == 4
    for variant in ("standard", "plain"):
        drives = [one.drive_seed for one in recordings if one.variant == variant]
        assert len(set(drives)) == len(drives) == 24
    assert not {one.home_seed for one in Recipe(seed=2).recordings()} & {one.home_seed for one in Recipe().recordings()}


def test_names_known_here_are_those_of_the_simulator() -> None:
    """Planning needs the names without importing what they stand for."""
    pytest.importorskip("mujoco", reason="the simulator is not installed: pip install 'semslam[sim]'")
    from semslam.sim.inertial import LEVELS
    from semslam.sim.layout import VARIANTS as HOMES

    assert set(VARIANTS) == set(HOMES)
    assert set(NOISES) == set(LEVELS)


def test_a_real_data_set_is_the_same_with_one_worker_and_with_two(tmp_path: Path) -> None:
    """Two short drives through a real home with somebody in it: every byte of logs, truth, splits and plan.

    One worker keeps the home for the second drive, of two workers each builds its own.
    """
    pytest.importorskip("mujoco_warp", reason="the simulator is not installed: pip install 'semslam[sim]'")
    recipe = Recipe(scenes=1, trajectories=2, steps=2, variants=("person",), width=160, height=120)
    reports = [simulate(tmp_path / str(workers), recipe, workers=workers) for workers in (1, 2)]
    for report in reports:
        assert not report.failures, report.failures[0].failure
    assert tree(tmp_path / "1") == tree(tmp_path / "2")
    assert load_split(tmp_path / "1" / "splits.parquet", "intra", "test") == ["person_00_t1"]
    topics = {
        message.channel.topic for message in LogReader([tmp_path / "1" / "logs" / "person_00_t0.mcap"]).messages()
    }
    assert {"/camera/color/image_raw/compressed", "/imu/data_raw", "/odom", "/ground_truth/pose"} <= topics
    assert sorted(path.stem for path in (tmp_path / "1" / "truth" / "person_00_t0").iterdir()) == [
        "home_objects",
        "ideal",
        "obstructed",
        "true_map",
        "truth",
    ]


def test_a_worker_stays_with_its_home() -> None:
    """Tasks of one kind follow each other, because the worker remembers what they share."""
    with Pool(1, fake_sim.echo, kind=lambda task: task[0]) as pool:
        ended = list(pool.run(["a1", "b1", "a2", "b2"], lambda *_: None))
    assert ended == [(0, "a1"), (2, "a2"), (1, "b1"), (3, "b2")]
