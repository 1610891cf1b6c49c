"""What a running stage sees: its tables, its shards, its log. The one implementation of `StageContext`."""

from __future__ import annotations

import contextlib
import resource
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import SHARD, TIMING, DamagedEntryError, Work, shard_name
from semslam.pipeline.digest import sha256_file, sha256_text
from semslam.pipeline.files import canonical_json, remove
from semslam.pipeline.job import InputFile, Job
from semslam.stages.contract import FinishedShard, ShardWriter, Stage, TableSink, TableSource
from semslam.tables.parquet import TableError, TableFiles, TableFileWriter
from semslam.tables.spec import Table

MAX_WARNINGS = 100
"""Warnings kept a shard; further ones are counted."""
_PROGRESS_PERIOD_S = 0.1


class Shard:
    """A shard being written into a temporary folder (`ShardWriter`)."""

    def __init__(self, stage: Stage, folder: Path, metas: dict[str, str]) -> None:
        self._stage = stage
        self._folder = folder
        self._metas = metas
        self._sinks: dict[str, TableFileWriter] = {}
        self._files: list[str] = []
        self._notes: dict[str, Any] = {}
        self._warnings: list[str] = []
        self._more_warnings = 0
        self._remarks: list[str] = []
        self._counters: dict[str, int] = {}

    def table(self, table: Table, meta: Mapping[str, Any] | None = None) -> TableSink:
        """The sink for `table`.

        Raises:
            ValueError: the stage does not declare the table, or another shard has other `meta`.
        """
        if table not in self._stage.writes:
            raise ValueError(f"stage {self._stage.name} does not declare that it writes table {table.name}")
        said = sha256_text(canonical_json(dict(meta or {})))
        if self._metas.setdefault(table.name, said) != said:
            raise ValueError(f"table {table.name} has another meta than in the shard before")
        if table.name not in self._sinks:
            self._sinks[table.name] = TableFileWriter(self._folder / f"{table.name}.parquet", table, meta)
        return self._sinks[table.name]

    def path(self, name: str) -> Path:
        """Path for a file of the shard that is no table.

        Raises:
            ValueError: the name has folders in it or belongs to a table or to the cache itself.
        """
        reserved = {SHARD, TIMING, *(f"{table.name}.parquet" for table in self._stage.writes)}
        if Path(name).name != name or name.startswith(".") or name in reserved:
            raise ValueError(f"`{name}` cannot be the name of a file in a shard")
        if name not in self._files:
            self._files.append(name)
        return self._folder / name

    def note(self, key: str, value: Any) -> None:
        """Keep a small JSON value for the stage itself when it resumes."""
        self._notes[key] = value

    def warn(self, message: str) -> None:
        """Keep a warning; beyond `MAX_WARNINGS` only their number."""
        if len(self._warnings) < MAX_WARNINGS:
            self._warnings.append(message)
        else:
            self._more_warnings += 1

    def remark(self, message: str) -> None:
        """Keep how the stage understood its input."""
        self._remarks.append(message)

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter."""
        self._counters[name] = self._counters.get(name, 0) + int(number)

    def abandon(self) -> None:
        """Close what is open and remove everything."""
        for sink in self._sinks.values():
            with contextlib.suppress(Exception):  # a half-written table may fail to close; it is removed next
                sink.close()
        remove(self._folder)

    def close(self, index: int, previous: str) -> dict[str, Any]:
        """Finish all files and return the manifest of the shard."""
        tables = {name: self._closed_table(name, sink) for name, sink in self._sinks.items()}
        return {
            "index": index,
            "previous": previous,
            "tables": tables,
            "files": {name: self._stored(name) for name in self._files},
            "notes": self._notes,
            "warnings": self._warnings + ([f"{self._more_warnings} more warnings"] if self._more_warnings else []),
            "remarks": self._remarks,
            "counters": self._counters,
        }

    def _closed_table(self, name: str, sink: TableFileWriter) -> dict[str, Any]:
        sink.close()
        return {**self._stored(f"{name}.parquet"), "rows": sink.rows, "meta": self._metas[name]}

    def _stored(self, name: str) -> dict[str, Any]:
        path = self._folder / name
        if not path.is_file():
            raise FileNotFoundError(f"stage {self._stage.name} asked for the path of `{name}` and wrote no file there")
        return {"file": name, "bytes": path.stat().st_size, "sha256": sha256_file(path)}


class Context:
    """`StageContext` over the cache: reads earlier entries, publishes shards into the work folder."""

    def __init__(self, job: Job, work: Work, report: Callable[[int, int | None], None], threads: int = 1) -> None:
        self._job = job
        self._work = work
        self._report = report
        self._threads = threads
        self._metas = {n: table["meta"] for shard in work.shards for n, table in shard["tables"].items()}
        self._sources: dict[str, TableFiles] = {}
        self._shard_start = time.monotonic()
        self._reported = float("-inf")

    @property
    def log(self) -> str:
        """Name of the log."""
        return self._job.log

    @property
    def variant(self) -> str:
        """Variant of the task; empty for none."""
        return self._job.variant

    @property
    def sources(self) -> tuple[Path, ...]:
        """Files of the log in recording order; empty for stages that do not read the log."""
        return self._job.sources

    @property
    def config(self) -> Any:
        """The stage's own configuration."""
        return self._job.config

    @property
    def threads(self) -> int:
        """Threads a library may use in this process."""
        return self._threads

    @property
    def finished(self) -> tuple[FinishedShard, ...]:
        """Shards already published, in order."""
        return tuple(
            FinishedShard(
                index=index,
                rows={name: table["rows"] for name, table in shard["tables"].items()},
                notes=shard["notes"],
                folder=self._work.folder / shard_name(index),
            )
            for index, shard in enumerate(self._work.shards)
        )

    def read(self, table: Table) -> TableSource:
        """A table that the stage declared in `reads`, after its files were compared with their digests.

        Raises:
            DamagedEntryError: a file is missing or damaged.
            KeyError: an optional table that the log does not have.
        """
        if table not in self._job.stage.reads:
            raise ValueError(f"stage {self._job.stage.name} does not declare that it reads table {table.name}")
        if table.name not in self._sources:
            files = self._job.inputs[table.name]
            check_inputs(table.name, self._job.log, files)
            try:
                self._sources[table.name] = TableFiles(table, [Path(file.path) for file in files])
            except TableError:
                check_inputs(table.name, self._job.log, files)  # removed meanwhile, to be made again
                raise
        return self._sources[table.name]

    @contextlib.contextmanager
    def shard(self, index: int) -> Iterator[ShardWriter]:
        """Open the next shard; published when the block ends without an exception."""
        if index != len(self._work.shards):
            raise ValueError(f"shard {index} was asked for, the next one is {len(self._work.shards)}")
        temporary = self._work.temporary()
        shard = Shard(self._job.stage, temporary, self._metas)
        try:
            yield shard
            manifest = shard.close(index, self._work.last_digest)
            _check_tables(self._job.stage, index, manifest["tables"])
        except BaseException:
            shard.abandon()
            raise
        self._work.publish(temporary, manifest)
        now = time.monotonic()
        self._work.add_timing(now - self._shard_start, max_rss_bytes())
        self._shard_start = now

    def progress(self, done: int, total: int | None = None) -> None:
        """Units done so far; passed on ten times a second at most."""
        now = time.monotonic()
        if done == total or now - self._reported >= _PROGRESS_PERIOD_S:
            self._reported = now
            self._report(done, total)


def check_inputs(table: str, log: str, files: Sequence[InputFile]) -> None:
    """Compare stored files with their digests.

    Raises:
        DamagedEntryError: one is missing or has another content.
    """
    for file in files:
        try:
            found = sha256_file(file.path)
        except OSError as error:
            found = error.strerror or type(error).__name__
        if found != file.sha256:
            entry = Path(file.path).parents[1]  # ENTRY/shard-00000/TABLE.parquet
            raise DamagedEntryError(
                f"Stored table `{table}` of `{log}` is damaged: `{file.path}`",
                hint=f"drop damaged entries with `semslam verify {_output_folder(entry)} --remove`, "
                "then run the same command again",
                entry=entry,
            )


def _output_folder(entry: Path) -> str:
    """The output folder of an entry, which is OUT/cache/STAGE/KEY, as a person would type it."""
    return shlex.quote(str(entry.parents[2]))


def _check_tables(stage: Stage, index: int, written: Mapping[str, Any]) -> None:
    """The first shard holds every table that is not optional, if only with no rows."""
    missing = [t.name for t in stage.writes if t not in stage.optional and t.name not in written]
    if index == 0 and missing:
        raise ValueError(f"stage {stage.name} wrote no table {', '.join(missing)} into its first shard")


def max_rss_bytes() -> int:
    """Largest memory of this process so far, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
