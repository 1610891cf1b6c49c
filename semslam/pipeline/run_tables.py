"""Where the tables of a finished run lie, for those who read several logs at once: trainings and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semslam.errors import SemslamError
from semslam.pipeline.cache import EntryIndex, table_files
from semslam.pipeline.context import check_inputs
from semslam.pipeline.folder import OutputFolder, open_folder
from semslam.pipeline.record import LogRecord, load_records, task_name
from semslam.tables.spec import Table

LogTables = dict[str, tuple[Path, ...]]
"""Files of a log's tables, by the table's name; tables that it does not have are missing."""


def run_tables(
    run: Path, tables: Sequence[Table], logs: Sequence[str] | None = None, variant: str = ""
) -> dict[str, LogTables]:
    """Files of tables of every log of an output folder, compared with their digests.

    Args:
        run: an output folder.
        tables: of stages with variants only if `variant` is named.
        logs: names of logs to look at; None means all. Those that the folder does not know are left out.
        variant: of the stages that have variants, such as the estimator.

    Raises:
        SemslamError: no output folder, one without logs, or a damaged file.
    """
    folder = open_folder(run)
    index, records = EntryIndex(folder.cache), load_records(folder.logs)
    if not records:
        raise SemslamError(f"Output folder `{run}` has no logs", hint=f"`semslam run DATASET/logs --out {run}`")
    chosen = (record for name, record in records.items() if logs is None or name in logs)
    return {record.name: log_tables(folder, index, record, tables, variant) for record in chosen}


def log_tables(
    folder: OutputFolder, index: EntryIndex, record: LogRecord, tables: Sequence[Table], variant: str = ""
) -> LogTables:
    """Files of tables of one log of an opened output folder, likewise.

    Raises:
        SemslamError: a damaged file.
    """
    found: LogTables = {}
    for table in tables:
        task = record.tasks.get(task_name(table.stage, variant)) or record.tasks.get(table.stage)
        entry = index.find(table.stage, task.key) if task and task.key else None
        if entry is None or table.name not in entry.tables:
            continue
        files = table_files(folder.stage(table.stage) / entry.key)[table.name]
        check_inputs(table.name, record.name, files)
        found[table.name] = tuple(Path(file.path) for file in files)
    return found
