"""What a stage is, and what it may ask of whoever runs it. Below both; imports neither.

A stage reads tables, writes tables in *shards*, and knows nothing of caches, processes or terminals. A shard is the
unit of resumption: when a killed run starts again, shards already published are listed by `StageContext.finished` and
must not be written again.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from semslam.errors import SemslamError
from semslam.tables.spec import Table


@dataclass(frozen=True)
class Stage:
    """A step of the pipeline, as plain data that costs nothing to import.

    Attributes:
        name: also the name of its command and of its section in the configuration.
        version: raised whenever the same input and configuration would give other bytes.
        config: its frozen dataclass (settings.py).
        reads: tables of earlier stages; their digests are part of the cache key.
        writes: tables of this stage.
        entry: `module:function`, called with the StageContext; loaded only when the stage really runs.
        unit: what its progress counts.
        from_log: whether it reads the log files themselves (their digests are then part of the cache key).
        optional: tables among `writes` that may be absent, such as truth.
        libraries: distributions whose code shapes the stage's bytes; their versions are part of the cache key.
        variants: name of the config field that lists the stage's variants; each is a task with its own cache entry,
            run with `config.for_variant(name)`. Later stages run once for each variant. Empty: no variants.
    """

    name: str
    version: int
    config: type[Any]
    reads: tuple[Table, ...]
    writes: tuple[Table, ...]
    entry: str
    unit: str = "frame"
    from_log: bool = False
    optional: tuple[Table, ...] = ()
    variants: str = ""
    libraries: tuple[str, ...] = ()

    def load(self) -> Callable[[StageContext], None]:
        """Import the stage's code and return its entry function."""
        module, function = self.entry.split(":")
        loaded: Callable[[StageContext], None] = getattr(importlib.import_module(module), function)
        return loaded


class TableSink(Protocol):
    """Where a stage appends rows of one table; written in the order of the calls."""

    def append(self, rows: Mapping[str, Sequence[Any]]) -> None:
        """Append rows given as equally long columns; every column of the table must be there."""


class TableSource(Protocol):
    """A table of an earlier stage, whole, whatever number of shards it lies in."""

    @property
    def rows(self) -> int:
        """Number of rows."""

    @property
    def meta(self) -> Mapping[str, Any]:
        """What the writing stage stored beside the rows (classes, grid, ...)."""

    def batches(
        self, columns: Sequence[str] | None = None, start: int = 0, stop: int | None = None, batch_rows: int = 32
    ) -> Iterator[dict[str, list[Any]]]:
        """Rows [start, stop) in order, at most `batch_rows` at a time; memory stays that of a batch."""

    def read(self, columns: Sequence[str] | None = None) -> dict[str, list[Any]]:
        """All rows as columns."""


class ShardWriter(Protocol):
    """One shard being written. Nothing of it exists for readers until it is published."""

    def table(self, table: Table, meta: Mapping[str, Any] | None = None) -> TableSink:
        """The sink for `table`; a shard may write several. `meta` must be the same JSON in every shard."""

    def path(self, name: str) -> Path:
        """Path for a file of the shard that is no table (pictures, model states); the caller writes it."""

    def note(self, key: str, value: Any) -> None:
        """Keep a small JSON value in the shard's manifest, for the stage itself when it resumes."""

    def warn(self, message: str) -> None:
        """Say something the user should know: shown at the end, kept in the manifest."""

    def remark(self, message: str) -> None:
        """Say how the stage understood its input (which topics, which adapter): shown when it runs, kept likewise."""

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter of the manifest, such as `frames_skipped`; summed over shards."""


@dataclass(frozen=True)
class FinishedShard:
    """A shard published by an earlier, interrupted run."""

    index: int
    rows: Mapping[str, int]
    """Rows by table name."""
    notes: Mapping[str, Any]
    folder: Path
    """Where its files lie (`path` above)."""


class StageContext(Protocol):
    """Everything a running stage may touch."""

    @property
    def log(self) -> str:
        """Name of the log, for messages."""

    @property
    def variant(self) -> str:
        """Variant of the task (estimator); empty before the first stage with variants."""

    @property
    def sources(self) -> tuple[Path, ...]:
        """Files of the log, in recording order; only for stages with `from_log`."""

    @property
    def config(self) -> Any:
        """The stage's own configuration."""

    @property
    def threads(self) -> int:
        """Threads a library may use in this process: one, since sums come out otherwise with more."""

    def read(self, table: Table) -> TableSource:
        """A table that the stage declared in `reads`."""

    @property
    def finished(self) -> tuple[FinishedShard, ...]:
        """Shards 0..n-1 already published, in order."""

    def shard(self, index: int) -> AbstractContextManager[ShardWriter]:
        """Open shard `index` (the next one); published when the block ends without an exception."""

    def progress(self, done: int, total: int | None = None) -> None:
        """Units done so far, of how many if known."""


def row_shards(rows: int, shard_rows: int) -> Iterator[tuple[int, int, int]]:
    """Cut `rows` into (index, start, stop) of at most `shard_rows`; one empty shard for no rows."""
    for index in range(max(1, -(-rows // shard_rows))):
        yield index, index * shard_rows, min(rows, (index + 1) * shard_rows)


class LogRefusedError(SemslamError):
    """The log cannot be processed by this stage (no depth topic, say); recorded, shown, other logs go on."""
