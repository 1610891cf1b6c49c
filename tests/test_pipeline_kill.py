"""Real processes that are killed, interrupted and run side by side: what they leave is always whole."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.fake_stages import make_log
from tests.pipeline_helpers import World

pytest_plugins = ("tests.pipeline_fixtures",)


def wait_for(world: World, pattern: str, process: subprocess.Popen[str]) -> None:
    """Until the pattern matches something in the output folder."""
    deadline = time.monotonic() + 30
    while not any(world.out.glob(pattern)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def reference(world: World) -> dict[str, bytes]:
    """What an undisturbed run leaves."""
    other = World(world.root / "other")
    other.logs = world.logs
    other.run(*SLOW[1::2])
    return other.entries()


SLOW = ("--set", "first.pause_s=0.05", "--set", "third.pause_s=0.05", "--set", "third.kinds=careful,hasty")


def test_killed_at_random_moments_and_resumed(world: World) -> None:
    """SIGKILL again and again, then the same command to its end: the same bytes as an undisturbed run's."""
    make_log(world.logs, "a", "warn notes", range(22))
    expected = reference(world)
    dice = random.Random(5)
    for _ in range(3):
        process = world.start("run", world.logs, "--out", world.out, "--workers", 2, *SLOW)
        wait_for(world, "cache/first/.work-*", process) if not world.out.exists() else time.sleep(0.4)
        time.sleep(dice.uniform(0.0, 0.5))
        process.kill()
        process.communicate()
    done = world.command("run", world.logs, "--out", world.out, "--workers", 2, *SLOW)
    assert done.returncode == 0, done.stderr
    assert world.entries() == expected
    assert world.invoke("verify", world.out) == 0


def test_workers_do_not_outlive_a_killed_run(world: World) -> None:
    """Nothing changes in the folder once the parent has been gone for a moment."""
    make_log(world.logs, numbers=range(400))
    process = world.start("run", world.logs, "--out", world.out, "--workers", 1, *SLOW)
    wait_for(world, "cache/first/.work-*/shard-00001", process)
    process.kill()
    process.communicate()
    time.sleep(0.3)
    before = sorted(world.out.rglob("*"))
    time.sleep(0.3)
    assert sorted(world.out.rglob("*")) == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted(world: World, number: signal.Signals) -> None:
    """Exit code 130, what to type, and the finished shards stay."""
    make_log(world.logs, numbers=range(100))
    process = world.start("run", world.logs, "--out", world.out, "--workers", 1, *SLOW)
    wait_for(world, "cache/first/.work-*/shard-00001", process)
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert out == ""
    assert err.splitlines()[-1] == "interrupted: run the same command again to resume"
    assert "Traceback" not in err
    assert world.invoke("status", world.out) == 0
    assert "interrupted" in (status := world.command("status", world.out, "--json").stdout)
    assert json.loads(status)["unfinished"] == 1
    assert world.invoke("why", "first", "kitchen", "--out", world.out) == 0


def test_one_run_at_a_time(world: World) -> None:
    """The second one is told who is there; the first goes on."""
    make_log(world.logs, numbers=range(100))
    process = world.start("run", world.logs, "--out", world.out, "--workers", 1, *SLOW)
    wait_for(world, "cache/first/.work-*", process)
    assert world.invoke("run", world.logs, "--out", world.out) == 1
    assert process.poll() is None
    process.kill()
    process.communicate()


def test_the_number_of_workers_does_not_show(world: World) -> None:
    """In-process or two at once: the same bytes."""
    make_log(world.logs, "a", numbers=range(5))
    make_log(world.logs, "b", numbers=range(3))
    results = []
    for workers in (0, 2):
        out = world.root / f"out{workers}"
        done = world.command("run", world.logs, "--out", out, "--workers", workers, "--json", "--quiet")
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        digests = [
            (log["log"], task["key"], task["tables"], task["files"]) for log in told["logs"] for task in log["tasks"]
        ]
        results.append((digests, world.entries(out)))
    assert results[0] == results[1]


def test_a_pipe_that_closes_early(world: World) -> None:
    """`semslam config show | head -1` ends without a word."""
    process = world.start("config", "show")
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    assert "Traceback" not in process.stderr.read()
    process.wait()


def test_the_console_script_is_this_command_line(tmp_path: Path) -> None:
    """`python -m` works as well as the installed script."""
    import sys

    done = subprocess.run(
        [sys.executable, "-m", "semslam.pipeline.cli", "status", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
