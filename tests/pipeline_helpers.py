"""Running the fake stages, in this process or in one of its own."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import load_manifest
from semslam.pipeline.cli import run_command
from semslam.pipeline.config import load_config
from semslam.pipeline.console import Console, RunView
from semslam.pipeline.discover import discover
from semslam.pipeline.executors import SerialExecutor
from semslam.pipeline.files import files_below
from semslam.pipeline.folder import create_folder
from semslam.pipeline.plan import stages_until
from semslam.pipeline.runner import Runner, RunReport
from semslam.stages.contract import Stage
from tests.fake_stages import FAKE_STAGES, command_line


class World:
    """A folder with logs and an output folder, and what one does with them."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.logs = root / "logs"
        self.out = root / "out"
        self.calls_file = root / "calls.txt"

    def run(
        self, *assignments: str, stages: Sequence[Stage] = FAKE_STAGES, until: str = "last", names: Sequence[Any] = ()
    ) -> RunReport:
        """A run in this process."""
        folder = create_folder(self.out)
        config = load_config(stages, assignments=assignments)
        logs = discover([str(name) for name in names or [self.logs]]).logs
        needed = stages_until(stages, until)
        with folder.locked():
            view = RunView(Console(quiet=True))
            return Runner(folder, needed, config, logs, SerialExecutor(), view, stages[-1].name).run()

    def calls(self) -> list[str]:
        """Stages called since the last question, sorted."""
        lines = sorted(self.calls_file.read_text().splitlines()) if self.calls_file.exists() else []
        self.calls_file.unlink(missing_ok=True)
        return lines

    def start(self, *arguments: Any) -> subprocess.Popen[str]:
        """The command line in a process of its own; not waited for."""
        return subprocess.Popen(
            command_line(arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.root
        )

    def invoke(self, *arguments: Any) -> int:
        """The command line in this process; its exit code."""
        return run_command([str(argument) for argument in arguments], FAKE_STAGES)

    def command(self, *arguments: Any) -> subprocess.CompletedProcess[str]:
        """The command line in a process of its own, to its end."""
        return subprocess.run(command_line(arguments), capture_output=True, text=True, cwd=self.root, check=False)

    def entries(self, out: Path | None = None) -> dict[str, bytes]:
        """Every stored byte that must not depend on how the entries came about, by path."""
        cache = (out or self.out) / "cache"
        stored = (path for stage in cache.iterdir() if stage.is_dir() for path in files_below(stage))
        return {str(path.relative_to(cache)): path.read_bytes() for path in stored if path.name != "timing.json"}

    def manifest(self, stage: str) -> dict[str, Any]:
        """The manifest of the only entry of a stage."""
        (folder,) = [path for path in (self.out / "cache" / stage).iterdir() if not path.name.startswith(".")]
        manifest = load_manifest(folder)
        assert manifest is not None
        return manifest


def states(report: RunReport) -> dict[str, str]:
    """State by `log task`."""
    return {f"{result.task.log.name} {result.task.name}": result.state for result in report.results}


def decisions(report: RunReport) -> dict[str, str]:
    """Decision by task, for a single log."""
    return {result.task.name: result.decision for result in report.results}
