"""Runs one real stage on real files, through the real worker and cache, and gives back its tables."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import table_files
from semslam.pipeline.job import InputFile, Job, Outcome
from semslam.pipeline.worker import execute
from semslam.stages.contract import Stage
from semslam.tables.parquet import TableFiles, rows_of
from semslam.tables.spec import Table

KEY = "0" * 64


@dataclass(frozen=True)
class Done:
    """A published entry."""

    folder: Path
    outcome: Outcome

    def table(self, table: Table) -> TableFiles:
        """A table of the entry."""
        return TableFiles(table, [Path(file.path) for file in self.files[table.name]])

    def rows(self, table: Table) -> list[dict[str, Any]]:
        """A table as rows."""
        return list(rows_of(self.table(table).batches()))

    @property
    def files(self) -> dict[str, tuple[InputFile, ...]]:
        """Files of every table."""
        return table_files(self.folder)

    @property
    def manifest(self) -> dict[str, Any]:
        """The entry's manifest."""
        found: dict[str, Any] = json.loads((self.folder / "manifest.json").read_text())
        return found

    @property
    def digests(self) -> dict[str, list[str]]:
        """Content of every table file."""
        return {name: [file.sha256 for file in files] for name, files in self.files.items()}


def run_stage(
    folder: Path,
    stage: Stage,
    config: Any,
    *,
    sources: Sequence[Path] = (),
    inputs: Sequence[Done] = (),
    variant: str = "",
    log: str = "toy",
) -> Done:
    """Run the stage and fail the test if it fails."""
    outcome = try_stage(folder, stage, config, sources=sources, inputs=inputs, variant=variant, log=log)
    assert outcome.failure is None, outcome.failure
    return Done(folder / stage.name / KEY, outcome)


def try_stage(
    folder: Path,
    stage: Stage,
    config: Any,
    *,
    sources: Sequence[Path] = (),
    inputs: Sequence[Done] = (),
    variant: str = "",
    log: str = "toy",
) -> Outcome:
    """Run the stage and tell how it ended."""
    tables: Mapping[str, tuple[InputFile, ...]] = {name: files for d in inputs for name, files in d.files.items()}
    (folder / stage.name).mkdir(parents=True, exist_ok=True)
    job = Job(
        number=0,
        stage=stage,
        variant=variant,
        log=log,
        sources=tuple(sources),
        config=config,
        key=KEY,
        components={"stage": stage.name},
        inputs={table.name: tables[table.name] for table in stage.reads},
        guards=(),
        stage_folder=folder / stage.name,
    )
    return execute(job, lambda *_: None)
