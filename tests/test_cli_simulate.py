"""What a person or a script sees of `semslam simulate`: errors before any work, streams, table, JSON."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from semslam.pipeline.cli import run_command
from semslam.sim import simulate as simulating
from semslam.sim.dataset import NOISES, VARIANTS
from semslam.sim.engine import CACHE_VARIABLE
from tests import fake_sim
from tests.fake_sim import PAUSE, tree

Capture = pytest.CaptureFixture[str]
ROOT = Path(__file__).parent.parent
SMALL = ("--scenes", "2", "--trajectories", "2", "--steps", "3", "--workers", "0")


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The command with a quick recorder, whether the simulator is installed or not, in an empty folder."""
    monkeypatch.setattr(simulating, "record_home", fake_sim.quick)
    monkeypatch.setattr("semslam.sim.engine._NEEDED", ())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command line with a quick recorder in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "tests.fake_sim", "simulate", *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environment},
        check=False,
    )


def python(code: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Some Python in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **(environment or {})},
        check=False,
    )


@pytest.mark.parametrize("missing", ["mujoco", "mujoco_warp", "warp"])
def test_a_missing_extra_says_what_to_type(tmp_path: Path, missing: str) -> None:
    """One error, no traceback, nothing written, exit code 1."""
    out = tmp_path / "homes"
    done = python(
        f"import sys; sys.modules[{missing!r}] = None\n"
        f"from semslam.pipeline.cli import main\nmain(['simulate', {str(out)!r}])"
    )
    assert done.returncode == 1
    assert done.stdout == ""
    first, hint = done.stderr.splitlines()
    assert first.startswith("error: Simulating needs packages")
    assert f"`{missing}`" in first
    assert hint == "hint: pip install 'semslam[sim]'"
    assert not out.exists()


def test_help_and_refusals_load_nothing_heavy() -> None:
    """Neither the help nor a wrong value costs the import of what draws."""
    for arguments in (["simulate", "--help"], ["simulate", "--scenes", "0"]):
        done = python(
            "import sys\nfrom semslam.pipeline.cli import main\n"
            f"try:\n    main({arguments!r})\nfinally:\n    print(*sys.modules, file=sys.stderr)"
        )
        loaded = set(done.stderr.splitlines()[-1].split())
        assert loaded.isdisjoint({"numpy", "cv2", "pyarrow", "mujoco", "warp", "mujoco_warp", "tqdm"})
        assert "semslam.pipeline.cli" in loaded


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["--scenes", "0"], "`--scenes 0` makes no data set", "`--scenes` takes 1 to 1000"),
        (["--trajectories", "-1"], "`--trajectories -1` makes no data set", "`--trajectories` takes 1 to 100"),
        (["--steps", "0"], "`--steps 0` makes no data set", "`--steps` takes 1 to 100000"),
        (["--days", "3"], "`--days 3` makes no data set", "`--days` takes 1 to 2"),
        (["--seed", "-1"], "`--seed -1` makes no data set", "`--seed` takes 0 to 2147483647"),
        (["--rate", "0"], "`--rate 0` makes no data set", "`--rate` takes 0.01 to 10"),
        (["--rate", "nan"], "`--rate nan` makes no data set", "`--rate` takes 0.01 to 10"),
        (["--noise", "tripel"], "There is no `--noise tripel`", "did you mean `--noise triple`?"),
        (["--variant", "cave"], "There is no `--variant cave`", "one of standard, plain,"),
        (
            ["--variant", "plain", "--variant", "roms"],
            "There is no `--variant roms`",
            "did you mean `--variant rooms`?",
        ),
        (["--size", "640"], "`--size 640` is not of the form WIDTHxHEIGHT", "`--size 640x480`"),
        (["--size", "640x0"], "`--size 0` makes no data set", "`--size` takes 32 to 4096"),
        (["--scenes", "few"], "Invalid value for '--scenes'", "`semslam simulate --help` shows how"),
        (["--workers", "-1"], "Invalid value for '--workers'", "`semslam simulate --help` shows how"),
        (["a", "b"], "Got unexpected extra argument", "`semslam simulate --help` shows how"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_values(fake: Path, capsys: Capture, arguments: list[str], message: str, hint: str) -> None:
    """One error and something to type; exit code 2; nothing is written."""
    assert run_command(["simulate", *arguments], None) == 2
    out, err = capsys.readouterr()
    assert out == ""
    first, second = err.splitlines()
    assert first.startswith(f"error: {message}")
    assert second.startswith(f"hint: {hint}")
    assert list(fake.iterdir()) == []


def test_out_that_is_a_file(fake: Path, capsys: Capture) -> None:
    """Exit code 2, and the file stays."""
    (fake / "homes").write_text("mine")
    assert run_command(["simulate", "homes", *SMALL], None) == 2
    assert capsys.readouterr().err.startswith("error: `homes` is a file, not a folder\nhint: ")
    assert (fake / "homes").read_text() == "mine"


def test_the_default_folder_and_the_table_at_the_end(fake: Path, capsys: Capture) -> None:
    """`indoor_scenes`; stdout stays empty; a row for every kind of home and one for all."""
    assert run_command(["simulate", *SMALL, "--variant", "standard", "--variant", "rooms"], None) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert (fake / "indoor_scenes" / "logs" / "rooms_01_t1.mcap").exists()
    lines = err.splitlines()
    assert lines[0] == "8 logs; 24 frames to make"
    assert lines[1].split()[:5] == ["HOMES", "LOGS", "CACHED", "DONE", "FAILED"]
    assert [line.split()[:8] for line in lines[2:5]] == [
        ["standard", "4", "0", "4", "0", "12", "5", "(4)"],
        ["rooms", "4", "0", "4", "0", "12", "5", "(4)"],
        ["all", "8", "0", "8", "0", "24", "5", "(4)"],
    ]
    assert lines[5].startswith("wall time: ")
    assert lines[-1] == "logs: indoor_scenes/logs"


def test_finished_logs_are_told(fake: Path, capsys: Capture) -> None:
    """Cached in the second run, and a note when the data set grows."""
    run_command(["simulate", "homes", *SMALL], None)
    capsys.readouterr()
    assert run_command(["simulate", "homes", *SMALL, "--scenes", "3"], None) == 0
    err = capsys.readouterr().err
    assert err.startswith("6 logs, 4 finished already; 6 frames to make\n")
    assert "\nwarning: 4 logs grow to 6: `splits.parquet` is drawn again\n" in err
    assert err.splitlines()[2].split()[:5] == ["standard", "6", "4", "2", "0"]
    assert fake.exists()


def test_another_recipe_is_an_error_with_the_difference(fake: Path, capsys: Capture) -> None:
    """Exit code 1, the difference between two empty lines, and what to type."""
    run_command(["simulate", "homes", *SMALL], None)
    before = tree(fake / "homes")
    capsys.readouterr()
    assert run_command(["simulate", "homes", *SMALL, "--rate", "0.5"], None) == 1
    assert capsys.readouterr().err.splitlines() == [
        "error: Data set `homes` was made otherwise than asked for now",
        "",
        "  rate_hz  1.0 -> 0.5",
        "",
        "hint: name another folder, or let `--replace` make anew what differs and remove what is not asked for",
    ]
    assert tree(fake / "homes") == before
    assert run_command(["simulate", "homes", *SMALL, "--rate", "0.5", "--replace", "--quiet"], None) == 0


def test_failures_are_told_once_and_mean_exit_code_1(
    fake: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same reason of two logs is one error; the others are done."""
    monkeypatch.setattr(simulating, "record_home", fake_sim.unlucky)
    assert run_command(["simulate", "homes", *SMALL, "--quiet"], None) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: `home_01_t0` and 1 more: RuntimeError: the sofa is in the way\n")
    assert err.count("error: ") == 1
    assert len(list((fake / "homes" / "logs").iterdir())) == 2


def test_a_full_disk_is_one_error(fake: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """No traceback, and the hint says how to go on."""
    monkeypatch.setattr(simulating, "record_home", fake_sim.full_disk)
    assert run_command(["simulate", "homes", *SMALL, "--quiet"], None) == 1
    assert capsys.readouterr().err.splitlines() == [
        "error: No space left for data set `homes`",
        "hint: free some space, then run the same command again",
    ]
    assert fake.exists()


def test_json_is_all_that_stdout_gets(tmp_path: Path) -> None:
    """Real workers; counts, and of every log state, size and digest."""
    out = tmp_path / "homes"
    done = command(str(out), "--scenes", "2", "--trajectories", "1", "--steps", "3", "--workers", "2", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    files = tree(out)
    assert (told["cached"], told["done"], told["failed"], told["frames"]) == (0, 2, 0, 6)
    assert told["objects_per_frame"] == {"median": 5.0, "min": 4}
    assert told["frames_per_cpu_s"] > 0
    assert told["bytes"] == sum((out / name).stat().st_size for name in files if name.startswith(("logs", "truth")))
    assert [one["sha256"] for one in told["logs"]] == [files[f"logs/home_0{k}_t0.mcap"] for k in (0, 1)]
    assert "frames to make" in done.stderr


def test_a_pipe_gets_lines_and_a_terminal_gets_a_bar(tmp_path: Path) -> None:
    """On a terminal the frames done, their rate and the time left; in a pipe no control characters."""
    arguments = ("--scenes", "1", "--trajectories", "1", "--steps", "8", "--workers", "1")
    piped = command(str(tmp_path / "a"), *arguments, **{PAUSE: "0.05"})
    assert "\r" not in piped.stderr
    assert "\033" not in piped.stderr
    ours, theirs = pty.openpty()
    _set_size(ours)
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.fake_sim", "simulate", str(tmp_path / "b"), *arguments],
        stderr=theirs,
        stdout=subprocess.DEVNULL,
        cwd=ROOT,
        env={**os.environ, PAUSE: "0.05", "TERM": "xterm", "COLUMNS": "100"},
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            shown += os.read(ours, 4096)
        except OSError:
            break
    assert process.wait() == 0
    os.close(ours)
    assert b"0/1 logs" in shown
    assert b"/8 [" in shown
    assert b" frame/s]" in shown


def _set_size(terminal: int) -> None:
    import fcntl
    import struct
    import termios

    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))


def test_the_engine_starts_without_chatter_and_without_a_cache_of_its_own() -> None:
    """No word about missing graphics cards, and a folder for kernels even where the user's may not be written to."""
    pytest.importorskip("warp", reason="the simulator is not installed: pip install 'semslam[sim]'")
    code = (
        "import os, sys\nfrom semslam.sim.engine import start_engine, without_chatter\nstart_engine()\n"
        "import warp\nprint(warp.get_device(), warp.config.kernel_cache_dir)\n"
        "with without_chatter():\n    os.write(2, b'important\\n')\n"
    )
    done = python(code, {"XDG_CACHE_HOME": "/proc/nowhere", "HOME": "/proc/nowhere", CACHE_VARIABLE: ""})
    assert done.stderr == "important\n"
    device, cache = done.stdout.split()
    assert device == "cpu"
    assert "semslam-kernels-" in cache
    assert not Path(cache).parent.exists()


def test_the_help_names_every_kind_of_home_and_noise(capsys: Capture) -> None:
    """The help is written by hand, because it must not import the simulator."""
    run_command(["simulate", "--help"], None)
    words = set(capsys.readouterr().out.replace(",", " ").replace(";", " ").replace(".", " ").split())
    assert {*VARIANTS, *NOISES} <= words
