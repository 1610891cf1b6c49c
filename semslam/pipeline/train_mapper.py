"""`semslam train mapper`: from a data set and a run over its logs to a trained map update."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from semslam.models.training.drives import DriveSet, RunTables, logs_of
from semslam.models.training.mapping import USUAL, MapperOptions
from semslam.models.training.runs import Run, require_place, train_map_update
from semslam.models.training.trainer import Schedule
from semslam.pipeline.console import Console
from semslam.pipeline.run_tables import run_tables
from semslam.pipeline.train_request import DrivesRequest
from semslam.pipeline.train_view import LogsView, TrainingView
from semslam.stages.settings import PaperConfig
from semslam.tables.spec import MOTION, OBSERVATIONS


@dataclass(frozen=True, kw_only=True)
class MapperRequest(DrivesRequest):
    """What the command asks for; None means the value of the shipped model."""

    quality: str = "real"
    kernel: str = "3"
    side: int = 11
    binary: bool = False
    own: float = 0.5
    length: int = 40

    @property
    def schedule(self) -> Schedule:
        """How long and how fast."""
        return self.schedule_from(USUAL)

    @property
    def options(self) -> MapperOptions:
        """What to train for."""
        paper = PaperConfig(side=self.side, binary=self.binary)
        return MapperOptions(paper, int(self.kernel), self.own, length=self.length)

    @property
    def command(self) -> str:
        """What to type to make it again, without folders of this machine."""
        sizes = f"--kernel {self.kernel} --side {self.side}{' --binary' * self.binary}"
        sizes += f" --own {self.own:g} --length {self.length}"
        return self.typed("mapper", self.schedule, f"--quality {self.quality} --protocol {self.protocol} {sizes}")


def train_on_drives(console: Console, request: MapperRequest) -> list[Path]:
    """Read the drives, train, and judge on the logs that test; the files written.

    Raises:
        SemslamError: data set, run and options do not fit together, or the folder holds another training.
    """
    require_place(request.out, request.device)
    tables = _tables(request.run_folder) if request.run_folder else None
    drives, unseen = (_drives(console, request, part, tables) for part in ("train", "test"))
    view = TrainingView(console)
    run = Run(
        request.dataset,
        request.out,
        request.schedule,
        request.threads,
        request.device,
        view.progressed,
        command=request.command,
    )
    try:
        return train_map_update(run, drives, unseen, request.options)
    finally:
        view.close()


def _tables(run: Path) -> dict[str, RunTables]:
    """What the run has of every log; those without motion are left out."""
    found = run_tables(run, (MOTION, OBSERVATIONS))
    return {
        log: RunTables(files[MOTION.name], files.get(OBSERVATIONS.name, ()))
        for log, files in found.items()
        if MOTION.name in files
    }


def _drives(console: Console, request: MapperRequest, part: str, tables: Mapping[str, RunTables] | None) -> DriveSet:
    view = LogsView(console)
    try:
        names = logs_of(request.dataset, request.protocol, part)
        paper = request.options.paper
        return DriveSet.open(request.dataset, names, request.quality, run=tables, paper=paper, watch=view.progressed)
    finally:
        view.close()
