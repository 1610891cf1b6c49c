"""What a failure costs: its own task and those that need it, nothing else, and never silently."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from semslam.errors import SemslamError
from semslam.pipeline.cache import SHARD, WORK, Work
from semslam.pipeline.config import load_config
from semslam.pipeline.console import Console, RunView
from semslam.pipeline.context import Context
from semslam.pipeline.discover import discover
from semslam.pipeline.executors import ProcessPool
from semslam.pipeline.folder import create_folder
from semslam.pipeline.runner import Runner
from semslam.stages.contract import StageContext
from tests import fake_stages
from tests.fake_stages import FAKE_STAGES, NUMBERS, SUMS, make_log
from tests.pipeline_helpers import World, decisions, states

pytest_plugins = ("tests.pipeline_fixtures",)


def test_a_refused_log_does_not_stop_the_others(world: World) -> None:
    """It is failed, what needs it is blocked, and everything else is done."""
    make_log(world.logs, "bad", "refuse")
    make_log(world.logs, "good")
    report = world.run()
    assert states(report)["bad first"] == "failed"
    assert {state for task, state in states(report).items() if task.startswith("bad") and "first" not in task} == {
        "blocked"
    }
    assert {state for task, state in states(report).items() if task.startswith("good")} == {"done"}
    (failed,) = report.failures
    assert failed.failure is not None
    assert failed.failure.message == "No depth topic in `bad`"
    assert failed.failure.hint == "name it with `--topic depth=/depth`"


def test_a_failure_is_kept_in_the_record_and_tried_again(world: World) -> None:
    """The next run says that it failed before, and succeeds once the cause is gone."""
    path = make_log(world.logs, "bad", "refuse")
    world.run()
    record = json.loads((world.out / "logs" / "bad.json").read_text())
    assert record["tasks"]["first"]["failure"]["message"] == "No depth topic in `bad`"
    assert decisions(world.run())["first"] == "try again (failed before: No depth topic in `bad`)"
    path.write_text("plain\n1\n")
    assert states(world.run())["bad first"] == "done"
    assert "failure" not in json.loads((world.out / "logs" / "bad.json").read_text())["tasks"]["first"]


def test_an_unexpected_error_is_one_line_and_a_file(world: World) -> None:
    """Type and place in the message, the traceback where the hint says."""
    make_log(world.logs, "odd", "bug")
    (failed,) = world.run().failures
    assert failed.failure is not None
    assert failed.failure.message.startswith("ZeroDivisionError in ")
    assert failed.failure.message.endswith("division by zero")
    assert "tests/fake_stages.py:" in failed.failure.message
    trace = world.out / "logs" / "odd.first.traceback.txt"
    assert str(trace) in failed.failure.hint
    assert "Traceback" in trace.read_text()


def test_a_full_disk_ends_the_run_with_one_error(world: World) -> None:
    """Whatever was finished stays."""
    make_log(world.logs, "a")
    world.run(until="first")
    make_log(world.logs, "b", "full")
    with pytest.raises(SemslamError, match="No space left") as caught:
        world.run()
    assert "run the same command again" in caught.value.hint
    make_log(world.logs, "b")
    assert states(world.run())["a first"] == "cached"


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="needs the right to mount a small disk")
def test_a_disk_that_is_really_full(world: World) -> None:
    """On a disk of 100 kB: exit code 1, one error; with more space the same command goes on and gives the same."""
    world.out.mkdir()
    options = ["-t", "tmpfs", "-o", "size=100k", "tmpfs", str(world.out)]
    if subprocess.run(["mount", *options], check=False, capture_output=True).returncode:
        pytest.skip("mounting is not permitted here")
    try:
        make_log(world.logs, numbers=range(24))
        done = world.command("run", world.logs, "--out", world.out, "--workers", 0)
        assert done.returncode == 1
        assert done.stderr.count("error:") == 1
        assert "No space left" in done.stderr
        subprocess.run(["mount", "-o", "remount,size=4m", str(world.out)], check=True)
        kept = len(list((world.out / "cache" / "first").glob("*/shard-*")))
        assert kept > 0
        assert world.command("run", world.logs, "--out", world.out, "--workers", 0).returncode == 0
        other = World(world.root / "other")
        other.logs = world.logs
        other.run()
        assert world.entries() == other.entries()
    finally:
        subprocess.run(["umount", str(world.out)], check=True)


def test_a_killed_worker_costs_one_try(world: World) -> None:
    """A worker that dies is replaced and its job tried again; the job that kills twice has failed, by name."""
    make_log(world.logs, "a")
    make_log(world.logs, "fatal", "kill")
    make_log(world.logs, "once", "kill-once", [1, 2])
    folder = create_folder(world.out)
    with folder.locked():
        runner = Runner(
            folder,
            FAKE_STAGES[:1],
            load_config(FAKE_STAGES),
            discover([str(world.logs)]).logs,
            ProcessPool(2),
            RunView(Console(quiet=True)),
            "last",
        )
        report = runner.run()
    assert states(report) == {"a first": "done", "fatal first": "failed", "once first": "done"}
    (failed,) = report.failures
    assert failed.failure is not None
    assert "SIGKILL" in failed.failure.message
    assert "memory" in failed.failure.hint
    assert world.calls() == ["a first", "fatal first", "fatal first", "once first", "once first"]


def _interrupted_after(shards: int, monkeypatch: pytest.MonkeyPatch, world: World) -> Path:
    """A run whose stage `first` fails after so many shards; returns the work folder."""
    publish = Context.shard

    def stopping(self: Context, index: int) -> object:
        if index >= shards:
            raise OSError(errno.EIO, "the disk went away")
        return publish(self, index)

    monkeypatch.setattr(Context, "shard", stopping)
    world.run(until="first")
    monkeypatch.setattr(Context, "shard", publish)
    (work,) = (world.out / "cache" / "first").glob(f"{WORK}*")
    return work


def test_finished_shards_are_not_made_again(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the entry is the same as if nothing had happened."""
    make_log(world.logs)
    work = _interrupted_after(2, monkeypatch, world)
    stamps = {path.name: path.stat().st_mtime_ns for path in work.glob("shard-*")}
    assert sorted(stamps) == ["shard-00000", "shard-00001"]
    (result,) = world.run(until="first").results
    assert result.resumed == 2
    (entry,) = (world.out / "cache" / "first").iterdir()
    assert {name: (entry / name).stat().st_mtime_ns for name in stamps} == stamps
    other = World(world.root / "other")
    other.logs = world.logs
    other.run(until="first")
    assert world.entries() == other.entries()


@pytest.mark.parametrize("damage", ["flip", "cut", "missing", "extra", "manifest"])
def test_a_damaged_shard_and_those_after_it_are_made_again(
    world: World, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    """A shard is hashed before it is trusted."""
    make_log(world.logs)
    work = _interrupted_after(2, monkeypatch, world)
    table = work / "shard-00000" / "numbers.parquet"
    content = bytearray(table.read_bytes())
    if damage == "flip":
        content[len(content) // 2] ^= 1
        table.write_bytes(content)
    elif damage == "cut":
        table.write_bytes(content[:-1])
    elif damage == "missing":
        table.unlink()
    elif damage == "extra":
        (work / "shard-00000" / "other.txt").touch()
    else:
        manifest = work / "shard-00000" / SHARD
        manifest.write_text(manifest.read_text().replace('"index": 0', '"index": 1'))
    (result,) = world.run(until="first").results
    assert (result.state, result.resumed) == ("done", 0)
    other = World(world.root / "other")
    other.logs = world.logs
    other.run(until="first")
    assert world.entries() == other.entries()


def test_a_shard_from_the_middle_of_another_chain_is_not_taken(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second shard names the digest of the first; put first, it is out of order."""
    make_log(world.logs)
    work = _interrupted_after(2, monkeypatch, world)
    shutil.rmtree(work / "shard-00000")
    (work / "shard-00001").rename(work / "shard-00000")
    (result,) = world.run(until="first").results
    assert result.resumed == 0


def test_the_decision_tells_how_much_is_there(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task that was merely stopped resumes; one that failed says so."""
    make_log(world.logs)
    _interrupted_after(2, monkeypatch, world)
    (world.out / "logs" / "kitchen.json").unlink()
    assert decisions(world.run(until="first"))["first"] == "resume (2 shards)"


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content)


def _stored(world: World, stage: str, name: str) -> Path:
    return next((world.out / "cache" / stage).glob(f"*/shard-00000/{name}"))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_damaged_input_is_made_again_in_the_same_run(world: World, workers: int) -> None:
    """Two flipped bytes, one behind the other: both entries are dropped and made anew, and the task goes on."""
    make_log(world.logs)
    make_log(world.logs, "twin")
    world.run(until="second")
    before = world.entries()
    world.calls()
    _flip(_stored(world, "first", "numbers.parquet"))
    _flip(_stored(world, "second", "sums.parquet"))
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", workers, "--quiet") == 0
    calls = world.calls()
    assert calls.count("kitchen first") == 1
    assert {name: content for name, content in world.entries().items() if name in before} == before
    assert world.invoke("verify", world.out) == 0


def test_the_table_counts_what_was_made_again(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    """Once, as done."""
    make_log(world.logs)
    world.run(until="first")
    _flip(_stored(world, "first", "numbers.parquet"))
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 0
    shown = capsys.readouterr().err
    assert "kitchen first: stored result damaged, dropped" in shown
    assert ["first", "0", "0", "0", "1", "0", "10"] in [line.split()[:7] for line in shown.splitlines()]
    assert ["second", "0", "0", "0", "1", "0", "10"] in [line.split()[:7] for line in shown.splitlines()]


def test_an_input_that_stays_damaged_fails(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is made again once; then the failure names the file and what to type, with the real folder."""
    make_log(world.logs)
    finish = Work.finish

    def spoiled(self: Work, manifest: Mapping[str, Any]) -> bool:
        if manifest["stage"] == "first":
            _flip(self.folder / "shard-00000" / "numbers.parquet")
        return finish(self, manifest)

    monkeypatch.setattr(Work, "finish", spoiled)
    (failed,) = world.run().failures
    assert world.calls().count("kitchen first") == 2
    assert failed.failure is not None
    assert str(_stored(world, "first", "numbers.parquet")) in failed.failure.message
    assert f"semslam verify {world.out} --remove" in failed.failure.hint


@pytest.mark.parametrize("how", ["missing", "cut"])
def test_a_file_gone_from_the_cache_is_made_again(world: World, how: str) -> None:
    """Even if nothing else changed, and without making what depends on it."""
    make_log(world.logs)
    world.run()
    before = world.entries()
    world.calls()
    table = _stored(world, "first", "numbers.parquet")
    if how == "missing":
        table.unlink()
    else:
        table.write_bytes(table.read_bytes()[:-1])
    assert decisions(world.run())["first"] == "run (its result is gone or damaged)"
    assert world.calls() == ["kitchen first"]
    assert world.entries() == before


@pytest.mark.parametrize(
    ("misuse", "message"),
    [
        ("undeclared", "does not declare that it writes table sums"),
        ("reads", "does not declare that it reads table sums"),
        ("gap", "shard 1 was asked for, the next one is 0"),
        ("nothing", "ended without writing a shard"),
        ("tables", "wrote no table numbers into its first shard"),
        ("name", "cannot be the name of a file in a shard"),
        ("unwritten", "wrote no file there"),
        ("meta", "another meta than in the shard before"),
    ],
)
def test_a_stage_that_breaks_its_contract_is_told(
    world: World, monkeypatch: pytest.MonkeyPatch, misuse: str, message: str
) -> None:
    """And leaves nothing behind that a later run could take for a result."""

    def wrong(ctx: StageContext) -> None:
        if misuse == "nothing":
            return
        if misuse == "reads":
            ctx.read(SUMS)
        with ctx.shard(1 if misuse == "gap" else 0) as shard:
            if misuse == "undeclared":
                shard.table(SUMS)
            if misuse == "name":
                shard.path("numbers.parquet")
            if misuse != "tables":
                shard.table(NUMBERS, {"a": 1})
            if misuse == "meta":
                shard.table(NUMBERS, {"a": 2})
            if misuse == "unwritten":
                shard.path("state.txt")

    monkeypatch.setattr(fake_stages, "first", wrong)
    make_log(world.logs)
    (failed,) = world.run(until="first").failures
    assert failed.failure is not None
    assert message in failed.failure.message
    assert list((world.out / "cache" / "first").iterdir()) == []


def test_the_loser_of_a_race_discards(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody publishes the same entry first: theirs stands, and the run goes on with it."""
    make_log(world.logs)
    world.run(until="first")
    (entry,) = (world.out / "cache" / "first").iterdir()
    kept = world.root / "kept"
    entry.rename(kept)
    shutil.copytree(kept, world.root / "copy")
    original = fake_stages.first

    def slow(ctx: StageContext) -> None:
        original(ctx)
        (world.root / "copy").rename(entry)

    monkeypatch.setattr(fake_stages, "first", slow)
    inode = (world.root / "copy" / "manifest.json").stat().st_ino
    assert states(world.run(until="first")) == {"kitchen first": "done"}
    assert (entry / "manifest.json").stat().st_ino == inode
    assert [path.name for path in entry.parent.iterdir()] == [entry.name]
