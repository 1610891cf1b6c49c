"""`ingest --check` as the command line gives it: which settings it gets, where its picture goes, what may fail."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from semslam.errors import SemslamError
from semslam.pipeline.cli import run_command
from semslam.stages import check
from semslam.stages.check import CheckReport
from semslam.stages.settings import IngestConfig

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[IngestConfig]:
    """Two logs in the working folder, the second damaged; every configuration that a look at one was given."""
    configs: list[IngestConfig] = []

    def look(paths: Sequence[Path], config: IngestConfig, picture: Path) -> CheckReport:
        configs.append(config)
        if paths[0].stem == "bad":
            raise SemslamError("`bad` is no log")
        picture.write_bytes(b"png")
        return CheckReport(paths[0].stem, 1.0, (), (), {}, str(picture))

    monkeypatch.setattr(check, "check_log", look)
    monkeypatch.chdir(tmp_path)
    for name in ("good", "bad"):
        (tmp_path / f"{name}.mcap").write_bytes(b"")
    return configs


def test_the_whole_configuration_counts(seen: list[IngestConfig]) -> None:
    """Not only the topics."""
    arguments = ["ingest", "good.mcap", "--check", "--set", "ingest.depth_unit_m=0.0005", "--topic", "depth=/d"]
    assert run_command(arguments, None) == 0
    assert seen == [IngestConfig(topics={"depth": "/d"}, depth_unit_m=0.0005)]


def test_the_picture_goes_into_the_folder_that_was_named(
    seen: list[IngestConfig], tmp_path: Path, capsys: Capture
) -> None:
    """Which is made, and may become an output folder afterwards; without --out, the current folder."""
    assert run_command(["ingest", "good.mcap", "--check"], None) == 0
    assert (tmp_path / "good.check.png").read_bytes() == b"png"
    assert run_command(["ingest", "good.mcap", "--check", "--out", "new/out"], None) == 0
    assert (tmp_path / "new" / "out" / "good.check.png").read_bytes() == b"png"
    assert "first keyframe: new/out/good.check.png" in capsys.readouterr().out
    assert len(seen) == 2
    assert run_command(["ingest", "good.mcap", "--out", "new/out", "--workers", "0"], None) == 1
    assert (tmp_path / "new" / "out" / "semslam.json").exists()


def test_a_picture_that_cannot_be_written_does_not_cost_the_report(seen: list[IngestConfig], capsys: Capture) -> None:
    """Report, then error, exit code 1."""
    assert run_command(["ingest", "good.mcap", "--check", "--out", "good.mcap"], None) == 1
    shown = capsys.readouterr()
    assert "usable: yes" in shown.out
    assert "first keyframe" not in shown.out
    assert "error: Picture `good.mcap/good.check.png` cannot be written" in shown.err
    assert len(seen) == 1


def test_an_unknown_role_is_wrong_use(seen: list[IngestConfig], capsys: Capture) -> None:
    """Said once, before any log is looked at."""
    assert run_command(["ingest", ".", "--check", "--topic", "deep=/d"], None) == 2
    assert "did you mean `depth`?" in capsys.readouterr().err
    assert seen == []


def test_one_log_that_cannot_be_read_does_not_hide_the_others(seen: list[IngestConfig], capsys: Capture) -> None:
    """In JSON too, each log has its report or its error."""
    assert run_command(["ingest", ".", "--check", "--json"], None) == 1
    shown = capsys.readouterr()
    bad, good = json.loads(shown.out)
    assert bad["error"]["message"] == "`bad` is no log"
    assert (good["log"], good["ok"]) == ("good", True)
    assert "error: `bad` is no log" in shown.err
    assert len(seen) == 2
