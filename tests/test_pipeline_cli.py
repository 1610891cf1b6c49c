"""What a person or a script sees of the command line: exit codes, streams, tables, JSON, and errors."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import click
import pytest

import semslam
from semslam.pipeline.cli import cli, run_command
from semslam.pipeline.folder import open_folder
from semslam.stages.contract import StageContext
from tests import fake_stages
from tests.fake_stages import SUMS, command_line, make_log
from tests.pipeline_helpers import World

pytest_plugins = ("tests.pipeline_fixtures",)
Capture = pytest.CaptureFixture[str]


def modules_after(code: str, folder: Path) -> set[str]:
    """Top-level modules that a fresh Python has loaded after the code, whatever way that ended."""
    tail = "\nfinally:\n    import sys; print(' '.join({name.split('.')[0] for name in sys.modules}), file=sys.stderr)"
    script = "try:\n" + "\n".join(f"    {line}" for line in code.splitlines()) + tail
    root = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=folder, env=environment, check=False
    )
    return set(done.stderr.splitlines()[-1].split())


def test_help_loads_no_heavy_library(tmp_path: Path) -> None:
    """`semslam --help` is quick because it imports next to nothing."""
    loaded = modules_after("from semslam.pipeline.cli import main\nmain(['--help'])", tmp_path)
    assert loaded.isdisjoint({"numpy", "pyarrow", "cv2", "onnxruntime", "gtsam", "tqdm", "multiprocessing"})
    assert "click" in loaded


def test_a_run_with_nothing_to_do_loads_no_heavy_library(world: World) -> None:
    """Planning is pure Python."""
    make_log(world.logs)
    world.run()
    code = (
        "from semslam.pipeline.cli import main\n"
        "from tests.fake_stages import FAKE_STAGES\n"
        f"main(['run', {str(world.logs)!r}, '--out', {str(world.out)!r}], stages=FAKE_STAGES)"
    )
    loaded = modules_after(code, world.root)
    assert loaded.isdisjoint({"numpy", "pyarrow", "cv2", "onnxruntime", "gtsam", "tqdm", "multiprocessing"})
    assert "semslam" in loaded


def commands() -> list[tuple[str, click.Command]]:
    """Every command with its full name."""
    found = []
    for name, command in cli.commands.items():
        found.append((name, command))
        inner = command.commands if isinstance(command, click.Group) else {}
        found += [(f"{name} {one}", sub) for one, sub in inner.items()]
    return found


@pytest.mark.parametrize(("name", "command"), commands(), ids=lambda value: str(value))
def test_every_help_ends_with_an_example_that_parses(name: str, command: click.Command) -> None:
    """And the example is of that very command, with options that exist."""
    example = (command.help or "").strip().splitlines()[-1].split()
    assert example[0] == "semslam"
    words = example[1 : example.index(">")] if ">" in example else example[1:]
    assert " ".join(words).startswith(name)
    context = click.Context(cli)
    part: click.Command = cli
    while isinstance(part, click.Group):
        part, words = part.commands[words[0]], words[1:]
    part.make_context(part.name, words, parent=context)


def test_the_version(capsys: Capture) -> None:
    """On stdout."""
    assert run_command(["--version"], None) == 0
    assert capsys.readouterr().out == f"semslam {semslam.__version__}\n"


def test_a_run_ends_with_a_table_and_says_where_to_look(world: World, capsys: Capture) -> None:
    """All on stderr; stdout stays empty without --json."""
    make_log(world.logs, orders="warn")
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 0
    shown = capsys.readouterr()
    assert shown.out == ""
    lines = shown.err.splitlines()
    assert lines[0] == f"semslam run   1 log -> {world.out}"
    start = lines.index("STAGE   PENDING  RUNNING  CACHED  DONE  FAILED  ROWS   TIME")
    table = [line.split()[:7] for line in lines[start + 1 : start + 5]]
    assert table == [
        ["first", "0", "0", "0", "1", "0", "10"],
        ["second", "0", "0", "0", "1", "0", "10"],
        ["third", "0", "0", "0", "3", "0", "30"],
        ["last", "0", "0", "0", "3", "0", "3"],
    ]
    assert lines[-2:] == [
        "warning: `kitchen` first: a line was strange",
        f"results: {world.out}/results/kitchen/careful/map.png and 2 more",
    ]
    assert "\033" not in shown.err
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 0
    again = capsys.readouterr().err.splitlines()
    assert ["first", "0", "0", "1", "0", "0", "10", "-"] in [line.split() for line in again]
    assert f"warnings: 1 of results made before; `semslam status {world.out}` lists them" in again


def test_quiet_leaves_warnings_and_errors(world: World, capsys: Capture) -> None:
    """And nothing else."""
    make_log(world.logs, "a", "warn")
    make_log(world.logs, "b", "refuse")
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0, "--quiet") == 1
    assert capsys.readouterr().err.splitlines() == [
        "warning: `a` first: a line was strange",
        "error: first of `b` failed: No depth topic in `b`",
        "hint: name it with `--topic depth=/depth`",
    ]


def test_a_failed_log_means_exit_code_1_and_stale_results_are_told(world: World, capsys: Capture) -> None:
    """Results of the run before are not passed off as new."""
    path = make_log(world.logs)
    world.run()
    path.write_text("refuse\n")
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 1
    shown = capsys.readouterr().err
    assert f"warning: `{world.out}/results/kitchen/hasty` still holds the result of an earlier run" in shown
    assert "third         3        0       0     0       0" in shown


def test_json_of_a_run(world: World, capsys: Capture) -> None:
    """One object on stdout with tasks, decisions, digests, warnings and failures."""
    make_log(world.logs, "a", "warn")
    make_log(world.logs, "b", "refuse")
    (world.logs / "gone.mcap").symlink_to("nowhere")
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0, "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["format"] == "semslam-run"
    assert told["counts"] == {"blocked": 7, "done": 8, "failed": 1}
    assert told["exit_code"] == 1
    assert [one["reason"] for one in told["unreadable"]] == ["a broken link to `nowhere`"]
    first, *_ = told["logs"][0]["tasks"]
    assert (first["stage"], first["state"], first["decision"]) == ("first", "done", "run (new)")
    assert first["rows"] == {"numbers": 10}
    assert first["warnings"] == ["a line was strange"]
    assert len(first["tables"]["numbers"]) == 64
    failed, blocked, *_ = told["logs"][1]["tasks"]
    assert failed["failure"]["message"] == "No depth topic in `b`"
    assert blocked["decision"] == "blocked: first failed"


def test_status(world: World, capsys: Capture) -> None:
    """Every log with its stages, then failures and warnings."""
    make_log(world.logs, "a", "warn")
    make_log(world.logs, "b", "refuse")
    world.run()
    assert world.invoke("status", world.out) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["LOG", "first", "second", "third", "last", "ROWS", "WARNINGS"]
    assert lines[1].split() == ["a", "done", "done", "3/3", "done", "3/3", "done", "53", "1"]
    assert lines[2].startswith("b    failed  blocked  0/3 done, 3 blocked")
    assert lines[4] == "failed: first of `b`: No depth topic in `b`"
    assert lines[5] == "warning: `a` first: a line was strange"
    assert lines[6].startswith("2 logs, cache ")
    assert world.invoke("status", world.out, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert {(task["log"], task["state"]) for task in told["tasks"]} == {
        ("a", "done"),
        ("b", "failed"),
        ("b", "blocked"),
    }


def test_why(world: World, capsys: Capture) -> None:
    """The last and the next decision, with the options a run would get."""
    make_log(world.logs)
    world.run()
    world.run("second.modulo=7")
    assert world.invoke("why", "second", "kitchen", "--out", world.out) == 0
    assert capsys.readouterr().out.splitlines() == [
        "second",
        "  last run   stale: second.modulo 1000000 -> 7   (done)",
        "  next run   cached",
    ]
    arguments = ("why", "third/hasty", world.logs / "kitchen.mcap", "--out", world.out, "--set", "second.modulo=9")
    assert world.invoke(*arguments, "--json") == 0
    (task,) = json.loads(capsys.readouterr().out)["tasks"]
    assert task == {
        "task": "third/hasty",
        "last": "stale: input sums changed",
        "state": "done",
        "next": "known once second has run, which is: stale: second.modulo 7 -> 9",
    }


def test_why_changes_nothing(world: World) -> None:
    """It only looks."""
    make_log(world.logs)
    world.run()
    before = {path: path.stat().st_mtime_ns for path in world.out.rglob("*")}
    world.invoke("why", "second", "kitchen", "--out", world.out, "--set", "second.modulo=9")
    world.invoke("status", world.out)
    world.invoke("verify", world.out)
    assert {path: path.stat().st_mtime_ns for path in world.out.rglob("*")} == before


def test_config_show_and_check(world: World, capsys: Capture) -> None:
    """What is shown can be checked; a wrong file is wrong use."""
    assert world.invoke("config", "show", "--set", "second.modulo=7") == 0
    text = capsys.readouterr().out
    assert "# Sums are taken modulo this.\n# Range: at least 1.\nmodulo = 7\n" in text
    path = world.root / "home.toml"
    path.write_text(text)
    assert world.invoke("config", "check", path) == 0
    assert capsys.readouterr().out == f"{path}: ok\n"
    assert world.invoke("config", "show", "--defaults", "--config", path) == 0
    assert "modulo = 1000000\n" in capsys.readouterr().out
    path.write_text(text.replace('model = ""', 'model = "none.onnx"'))
    assert world.invoke("config", "check", path) == 2
    assert "`second.model` names" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["run"], "Missing argument 'LOGS...'", "`semslam run --help`"),
        (["rum"], "No such command 'rum'", "`semslam --help`"),
        (["run", "a.mcap", "--fast"], "No such option '--fast'", "--help"),
        (["run", "a.mcap", "--workers", "-1"], "-1 is not in the range", "--help"),
        (["run", "none.mcap", "--out", "new"], "No such file or folder: `none.mcap`", "check the path"),
        (["run", "a.mcap", "--out", "a.mcap"], "`a.mcap` is a file, not a folder", "--out"),
        (["run", "a.mcap", "--out", "foreign"], "is not empty and no output folder of semslam: it holds `x`", "--out"),
        (["run", "a.mcap", "--out", "newer"], "is of format version 9; this semslam reads version 1", "--out"),
        (["run", "a.mcap", "--out", "odd"], "damaged or unreadable `semslam.json`", "--out"),
        (["run", "a.mcap", "--out", "text"], "damaged or unreadable `semslam.json`", '"version": 1'),
        (["clean", "good", "--forget", "b"], "has no log `b`", "semslam status"),
        (["run", "a.mcap", "--out", "new", "--topic", "depth"], "not of the form ROLE=/TOPIC", "depth=/camera/depth"),
        (["run", "a.mcap", "--out", "new", "--set", "first.scale=99"], "`first.scale` must be 1 to 10", "documents"),
        (["run", "a.mcap", "--out", "new", "--config", "none.toml"], "No configuration file", "config show"),
        (["status", "foreign"], "is not an output folder of semslam", "semslam run"),
        (["evaluate", "foreign"], "is not an output folder of semslam", "semslam run"),
        (["why", "frist", "a", "--out", "good"], "No stage is called `frist`", "did you mean `first`?"),
        (["why", "first", "b", "--out", "good"], "has no log `b`", "semslam status"),
        (["why", "third/best", "a", "--out", "good"], "`a` has no task `third/best`", "semslam why third a"),
    ],
)
def test_wrong_use(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: Capture, arguments: list[str], message: str, hint: str
) -> None:
    """Exit code 2, one error, what was found, and what to type."""
    monkeypatch.chdir(world.root)
    make_log(world.root, "a", numbers=[1])
    (world.root / "foreign").mkdir()
    (world.root / "foreign" / "x").touch()
    marks = {"newer": '{"format": "semslam", "version": 9}', "odd": "{", "good": ""}
    marks["text"] = '{"format": "semslam", "version": "1"}'
    for name, text in marks.items():
        (world.root / name).mkdir()
        (world.root / name / "semslam.json").write_text(text or '{"format": "semslam", "version": 1}')
    if arguments[0] in ("why", "clean"):
        world.out = Path("good")
        world.run(names=["a.mcap"], until="first")
        capsys.readouterr()
    assert world.invoke(*arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("error: ")
    assert message in shown.err
    assert "hint: " in shown.err
    assert hint in shown.err
    assert not (world.root / "new" / "cache" / "first").exists()


def test_a_folder_in_use_is_not_shared(world: World, capsys: Capture) -> None:
    """The second run names the process of the first."""
    make_log(world.logs)
    world.run()
    with open_folder(world.out).locked():
        assert world.invoke("run", world.logs, "--out", world.out) == 1
        assert world.invoke("clean", world.out) == 1
    shown = capsys.readouterr().err
    assert shown.count(f"is in use by process {os.getpid()}") == 2
    assert world.invoke("clean", world.out) == 0


def test_verify_finds_every_kind_of_damage(world: World, capsys: Capture) -> None:
    """Each is named with its file; exit code 1."""
    make_log(world.logs)
    world.run()
    assert world.invoke("verify", world.out) == 0
    assert "all as stored" in capsys.readouterr().out
    (first,) = (world.out / "cache" / "first").iterdir()
    (second,) = (world.out / "cache" / "second").iterdir()
    thirds = sorted((world.out / "cache" / "third").iterdir())
    table = first / "shard-00000" / "numbers.parquet"
    table.write_bytes(table.read_bytes()[:-4] + b"PAR2")
    (first / "shard-00001" / "numbers.parquet").unlink()
    (second / "manifest.json").write_text("{}")
    (thirds[0] / "extra.txt").touch()
    shard = thirds[1] / "shard-00000" / "shard.json"
    shard.write_text(shard.read_text().replace('"index": 0', '"index": 5'))
    (world.out / "results" / "kitchen" / "lazy" / "map.png").write_text("scribble")
    assert world.invoke("verify", world.out, "--json") == 1
    told = json.loads(capsys.readouterr().out)
    found = {finding["path"]: finding["what"] for finding in told["findings"]}
    assert found == {
        str(table): "damaged: its content is not what was stored",
        str(first / "shard-00001" / "numbers.parquet"): "cannot be read: No such file or directory",
        str(second / "manifest.json"): "missing or damaged",
        str(thirds[0] / "extra.txt"): "nobody stored it here",
        str(shard): "missing, damaged or out of order",
        "kitchen first": "its result is gone or damaged; the next run makes it anew",
        "kitchen second": "its result is gone or damaged; the next run makes it anew",
        str(world.out / "results" / "kitchen" / "lazy" / "map.png"): (
            "differs from the stored result; the next run copies it again"
        ),
    }
    assert world.invoke("verify", world.out, "--remove") == 1
    assert "removed 4 damaged entries" in capsys.readouterr().out
    world.run()
    assert world.invoke("verify", world.out) == 0


def test_rederive_makes_results_again(world: World, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Equal results are fine, others are named, and nothing of it stays in the folder."""
    make_log(world.logs)
    world.run("second.modulo=7")
    before = sorted(path.name for path in world.out.iterdir())
    assert world.invoke("verify", world.out, "--rederive", "--workers", 0) == 0
    assert "8 results made again: all as stored" in capsys.readouterr().out

    def moody(ctx: StageContext) -> None:
        with ctx.shard(0) as shard:
            shard.table(SUMS).append({"value": [4]})

    monkeypatch.setattr(fake_stages, "second", moody)
    assert world.invoke("verify", world.out, "--rederive", "--workers", 0) == 1
    assert "kitchen second: table `sums` comes out differently when made again" in capsys.readouterr().out
    assert sorted(path.name for path in world.out.iterdir()) == before


def test_rederive_tells_what_can_not_be_compared(world: World, capsys: Capture) -> None:
    """The log is another one now."""
    path = make_log(world.logs)
    world.run(until="second")
    path.write_text("plain\n9\n")
    assert world.invoke("verify", world.out, "--rederive", "--workers", 0) == 1
    assert "kitchen first: cannot be compared, its inputs are others now: log files changed" in capsys.readouterr().out
    path.unlink()
    assert world.invoke("verify", world.out, "--rederive", "--workers", 0) == 1
    assert "kitchen first: cannot be made again" in capsys.readouterr().out


def test_clean_removes_what_nobody_refers_to(world: World, capsys: Capture) -> None:
    """Old configurations, unfinished work, temporary files, results of variants that are gone."""
    make_log(world.logs)
    world.run()
    world.run("second.modulo=7", "third.kinds=hasty")
    work = world.out / "cache" / "first" / ".work-0123"
    (work / "shard-00000").mkdir(parents=True)
    (work / "shard-00000" / "x").write_bytes(bytes(1000))
    (world.out / "logs" / ".tmp-kitchen.json-1").touch()
    kept = world.entries().keys()
    assert world.invoke("clean", world.out, "--dry-run", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["dry_run"] is True
    assert told["bytes"] > 1000
    assert world.entries().keys() == kept
    assert world.invoke("clean", world.out) == 0
    assert "removed " in capsys.readouterr().out
    assert not work.exists()
    assert [path.name for path in (world.out / "results" / "kitchen").iterdir()] == ["hasty"]
    assert len(list((world.out / "cache" / "second").iterdir())) == 1
    world.calls()
    world.run("second.modulo=7", "third.kinds=hasty")
    assert world.calls() == []
    assert world.invoke("clean", world.out, "--all") == 0
    assert list((world.out / "logs").iterdir()) == []
    assert (world.out / "results" / "kitchen" / "hasty" / "map.png").exists()
    assert world.invoke("verify", world.out) == 0
    world.run("second.modulo=7", "third.kinds=hasty")
    assert len(world.calls()) == 4


def test_a_log_can_be_forgotten(world: World) -> None:
    """Its record, its results and what only it used; the file itself and what others share stay."""
    make_log(world.logs, "a")
    make_log(world.logs, "b", "bug")
    make_log(world.logs, "twin")
    world.run()
    world.calls()
    assert world.invoke("clean", world.out, "--forget", "a") == 0
    assert world.invoke("clean", world.out, "--forget", world.logs / "b.mcap") == 0
    assert sorted(path.name for path in (world.out / "logs").iterdir()) == ["twin.json"]
    assert [path.name for path in (world.out / "results").iterdir()] == ["twin"]
    assert (world.logs / "a.mcap").exists()
    assert world.invoke("verify", world.out) == 0
    world.run(names=[world.logs / "twin.mcap"])
    assert world.calls() == []


def test_json_errors(world: World, capsys: Capture) -> None:
    """Whoever asked for JSON gets some, also of an error; the words for people are on stderr as ever."""
    assert world.invoke("run", world.logs / "none.mcap", "--out", world.out, "--json") == 2
    shown = capsys.readouterr()
    error = json.loads(shown.out)["error"]
    assert error["message"].startswith("No such file or folder")
    assert error["exit_code"] == 2
    assert f"hint: {error['hint']}" in shown.err
    assert world.invoke("status", "--fast", "--json") == 2
    assert "No such option" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_forbidden_is_not_full(world: World, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hint fits what the system refused."""
    make_log(world.logs)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(world.out))

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert world.invoke("run", world.logs, "--out", world.out) == 1
    shown = capsys.readouterr().err
    assert f"Permission denied: `{world.out}`" in shown
    assert "permissions" in shown
    assert "space" not in shown


def test_warnings_of_many_logs_are_one_line(world: World, capsys: Capture) -> None:
    """With a count, and the first who said it."""
    for name, number in (("a", 1), ("b", 2), ("c", 3)):
        make_log(world.logs, name, "warn", numbers=[number])
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 0
    shown = capsys.readouterr().err
    assert shown.count("a line was strange") == 1
    assert "warning: `a` first and 2 more: a line was strange" in shown


def test_remarks_of_the_first_logs_are_shown(world: World, capsys: Capture) -> None:
    """With many logs the rest is counted."""
    for number in range(5):
        make_log(world.logs, f"log{number}", "remark", numbers=[number])
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ")]
    assert notes == [
        *(f"note: `log{number}` first: read as log{number}" for number in range(3)),
        "note: and those of 2 more logs; `--json` lists them",
    ]


def test_an_interrupt_at_any_moment_leaves_no_traceback(world: World) -> None:
    """Not from this process, nor from workers that are just starting."""
    make_log(world.logs, numbers=range(40))
    code = (
        "import sys; from tests.fake_stages import FAKE_STAGES\n"
        "from semslam.pipeline.cli import main\n"
        "print('ready', flush=True)\n"
        f"main(['run', {str(world.logs)!r}, '--out', {str(world.out)!r}, '--workers', '2', '--set',"
        " 'first.pause_s=0.2'], stages=FAKE_STAGES)"
    )
    script = world.root / "script.py"
    script.write_text(f"if __name__ == '__main__':\n    exec({code!r})\n")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    for delay_s in (0.02, 0.15, 0.3):
        process = subprocess.Popen(
            [sys.executable, str(script)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(delay_s)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=20)
        assert process.returncode == 130
        assert "Traceback" not in said
        assert "interrupted: run the same command again" in said


def test_split_recordings_are_announced(world: World, capsys: Capture) -> None:
    """So that nobody is surprised by their being one log."""
    make_log(world.logs, "home_0", numbers=[1, 2])
    make_log(world.logs, "home_1", "3", numbers=[4])
    assert world.invoke("run", world.logs, "--out", world.out, "--workers", 0) == 0
    assert "`home` is a recording in 2 files, `home_0.mcap` to `home_1.mcap`" in capsys.readouterr().err
    assert (world.out / "results" / "home" / "hasty" / "map.png").read_text() == "map home hasty [2, 8, 20, 40]"


def test_options_of_their_own_stand_for_settings(
    world: World, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Topics, models and estimators end up in the configuration."""
    monkeypatch.chdir(world.root)
    arguments = ["--topic", "depth=/d", "--topic", "imu=/i", "--detector", "yolo.onnx", "--estimator", "paper"]
    assert run_command(["config", "show", *arguments], None) == 0
    shown = capsys.readouterr().out
    assert 'topics = { depth = "/d", imu = "/i" }\n' in shown
    assert f'detector = "{world.root}/yolo.onnx"\n' in shown
    assert 'estimators = ["paper"]\n' in shown


def on_a_terminal(world: World, **environment: str) -> str:
    """What a run writes to a terminal of 100 columns."""
    parent, child = pty.openpty()
    fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))
    arguments = ["run", world.logs, "--out", world.out, "--workers", 1, "--set", "first.pause_s=0.1"]
    process = subprocess.Popen(
        command_line(arguments), stdout=child, stderr=child, cwd=world.root, env={**os.environ, **environment}
    )
    os.close(child)
    shown = b""
    while True:
        try:
            shown += os.read(parent, 1 << 16)
        except OSError:  # Linux says EIO when the last writer is gone
            break
    os.close(parent)
    assert process.wait() == 0
    return shown.decode()


def test_bars_and_colours_on_a_terminal(world: World) -> None:
    """Rate and time left while it runs; gone at the end, where the table stands. NO_COLOR is respected."""
    make_log(world.logs, orders="warn", numbers=range(8))
    shown = on_a_terminal(world)
    assert re.search(r"kitchen first: +\d+%.*4/8 \[.* line/s\]", shown)
    assert re.search(r"all tasks: +\d+%", shown)
    assert "\033[33mwarning:\033[0m" in shown
    make_log(world.logs, orders="warn", numbers=range(3))
    assert "\033[33m" not in on_a_terminal(world, NO_COLOR="1")
