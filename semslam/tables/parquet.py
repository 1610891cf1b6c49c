"""Tables as Parquet files: the same rows give the same bytes, and a flipped byte is an error.

Reads and writes every table of `spec`. Pages carry checksums that are verified on reading, because without them damage
in the data reads back as silently wrong values. Parquet's footer has no checksum: the manifest's SHA-256 of the whole
file guards that (pipeline/context.py compares it before a stage reads). What the writing stage has to say beside the
rows (class list, grid) lies as canonical JSON in the file's metadata under `semslam`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from semslam.errors import SemslamError
from semslam.tables.spec import Column, Table

_ARROW = {
    "bool": pa.bool_(),
    "int8": pa.int8(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "uint16": pa.uint16(),
    "uint32": pa.uint32(),
    "uint64": pa.uint64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
    "string": pa.string(),
    "binary": pa.binary(),
    "list<int64>": pa.list_(pa.int64()),
    "list<uint32>": pa.list_(pa.uint32()),
    "list<float32>": pa.list_(pa.float32()),
    "list<float64>": pa.list_(pa.float64()),
}
_KEY = b"semslam"
_ROW_GROUP_BYTES = 8 << 20


class TableError(SemslamError):
    """A table file is missing, damaged, or of another version."""


@contextmanager
def made_by(command: str) -> Iterator[None]:
    """Errors of table files within hint at the command that makes those files, not at a run of the stages."""
    try:
        yield
    except TableError as error:
        raise TableError(error.message, hint=f"make it again: `{command}`", details=error.details) from error


def arrow_schema(table: Table, meta: Mapping[str, Any] | None = None) -> pa.Schema:
    """The Arrow schema of `table`, with `meta` and the table's version in its metadata."""
    fields = [pa.field(c.name, _ARROW[c.type], nullable=c.null) for c in table.columns]
    header = {"table": table.name, "spec": table.version, "meta": dict(meta or {})}
    return pa.schema(fields, metadata={_KEY: json.dumps(header, sort_keys=True, separators=(",", ":")).encode()})


class TableFileWriter:
    """Writes one table file; rows are flushed in row groups of about 8 MiB, so memory stays bounded."""

    def __init__(self, path: Path, table: Table, meta: Mapping[str, Any] | None = None) -> None:
        self._table = table
        self._schema = arrow_schema(table, meta)
        self._pending: list[pa.RecordBatch] = []
        self._pending_bytes = 0
        self.rows = 0
        plain = [c.name for c in table.columns if c.type == "binary"]
        whole_numbers = [c for c in table.columns if c.type in ("list<int64>", "list<uint32>")]
        self._writer = pq.ParquetWriter(
            path,
            self._schema,
            compression={_leaf(c): "none" if c.name in plain else "zstd" for c in table.columns},
            use_dictionary=[c.name for c in table.columns if c.type == "string"],
            column_encoding={_leaf(c): "DELTA_BINARY_PACKED" for c in whole_numbers},
            write_page_checksum=True,
            write_statistics=[_leaf(c) for c in table.columns if c.name not in plain],
            store_schema=True,
        )

    def append(self, rows: Mapping[str, Sequence[Any]]) -> None:
        """Append equally long columns.

        Raises:
            ValueError: a column is missing, unknown, of another length or type, or null where it must not be.
        """
        names = [c.name for c in self._table.columns]
        if set(rows) != set(names):
            raise ValueError(f"table {self._table.name}: columns {sorted(set(rows) ^ set(names))} missing or unknown")
        arrays = [_array(rows[c.name], _ARROW[c.type]) for c in self._table.columns]
        for column, array in zip(self._table.columns, arrays, strict=True):
            if array.null_count and not column.null:
                raise ValueError(f"table {self._table.name}: column {column.name} must not be null")
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        self._pending.append(batch)
        self._pending_bytes += batch.nbytes
        self.rows += batch.num_rows
        if self._pending_bytes >= _ROW_GROUP_BYTES:
            self._flush()

    def close(self) -> None:
        """Write what is pending and the footer."""
        self._flush()
        self._writer.close()

    def _flush(self) -> None:
        if self._pending:
            self._writer.write_table(pa.Table.from_batches(self._pending, self._schema))
        self._pending, self._pending_bytes = [], 0


def write_table(
    path: Path, table: Table, rows: Mapping[str, Sequence[Any]], meta: Mapping[str, Any] | None = None
) -> None:
    """Write a whole table at once."""
    writer = TableFileWriter(path, table, meta)
    writer.append(rows)
    writer.close()


class TableFiles:
    """One table lying in the files of its shards, read as a whole, in order.

    Raises:
        TableError: a file is missing, damaged, of another table or of another version of it.
    """

    def __init__(self, table: Table, paths: Sequence[Path]) -> None:
        self._table = table
        self._paths = tuple(paths)
        self._files = [_open(path, table) for path in self._paths]
        metas = [_header(file, path, table)["meta"] for file, path in zip(self._files, self._paths, strict=True)]
        self._meta = metas[0] if metas else {}
        for path, meta in zip(self._paths, metas, strict=True):
            if meta != self._meta:
                raise TableError(
                    f"Table file `{path}` was made with other classes or another grid than `{self._paths[0]}`",
                    hint="`semslam verify OUT` lists damaged entries",
                )

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(file.metadata.num_rows for file in self._files)

    @property
    def meta(self) -> Mapping[str, Any]:
        """What the writing stage stored beside the rows."""
        meta: Mapping[str, Any] = self._meta
        return meta

    def batches(
        self, columns: Sequence[str] | None = None, start: int = 0, stop: int | None = None, batch_rows: int = 32
    ) -> Iterator[dict[str, list[Any]]]:
        """Rows [start, stop) as columns, at most `batch_rows` at a time."""
        stop = self.rows if stop is None else stop
        first = 0
        for path, file in zip(self._paths, self._files, strict=True):
            for group in range(file.num_row_groups):
                count = file.metadata.row_group(group).num_rows
                if first + count > start and first < stop:
                    yield from _group_batches(path, file, group, columns, start - first, stop - first, batch_rows)
                first += count

    def read(self, columns: Sequence[str] | None = None) -> dict[str, list[Any]]:
        """All rows as columns."""
        names = [c.name for c in self._table.columns] if columns is None else list(columns)
        whole: dict[str, list[Any]] = {name: [] for name in names}
        for batch in self.batches(columns, batch_rows=1 << 16):
            for name in names:
                whole[name] += batch[name]
        return whole


def rows_of(batches: Iterable[Mapping[str, Sequence[Any]]]) -> Iterator[dict[str, Any]]:
    """The rows of batches of columns, one by one, by the names of the columns."""
    for batch in batches:
        for values in zip(*batch.values(), strict=True):
            yield dict(zip(batch, values, strict=True))


def _leaf(column: Column) -> str:
    """What Parquet calls the values of a column: those of a list have a path of their own."""
    return f"{column.name}.list.element" if column.type.startswith("list<") else column.name


def _array(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """A column as Arrow array; lists that are numpy arrays already are joined without a look at every number."""
    if not pa.types.is_list(kind) or not values or not all(isinstance(value, np.ndarray) for value in values):
        return pa.array(values, kind)
    offsets = np.concatenate([[0], np.cumsum([len(value) for value in values])]).astype(np.int32)
    joined = pa.array(np.concatenate(list(values)), kind.value_type)
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), joined, kind)


def _group_batches(
    path: Path, file: pq.ParquetFile, group: int, columns: Sequence[str] | None, start: int, stop: int, rows: int
) -> Iterator[dict[str, list[Any]]]:
    """Rows [start, stop) of one row group; bounds may lie outside it."""
    names = None if columns is None else list(columns)
    first = 0
    try:
        for batch in file.iter_batches(batch_size=rows, row_groups=[group], columns=names):
            low, high = max(0, start - first), min(batch.num_rows, stop - first)
            if low < high:
                part = batch.slice(low, high - low)
                yield {name: part.column(name).to_pylist() for name in part.schema.names}
            first += batch.num_rows
    except (OSError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    expected = file.metadata.row_group(group).num_rows
    if first != expected:  # a damaged page header makes the reader stop early without a word
        raise _damaged(path, ValueError(f"row group {group} gave {first} of {expected} rows"))


def _open(path: Path, table: Table) -> pq.ParquetFile:
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True, memory_map=False)
    except FileNotFoundError as error:
        raise TableError(f"Table file `{path}` is missing", hint="run the same command again to make it") from error
    except (OSError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    _header(file, path, table)
    expected = arrow_schema(table)
    if not file.schema_arrow.equals(expected, check_metadata=False):
        raise TableError(
            f"Table file `{path}` does not have the columns of table `{table.name}`",
            details=f"found\n{file.schema_arrow.to_string(show_schema_metadata=False)}",
            hint="it was written by another version; use another `--out` folder",
        )
    return file


def _header(file: pq.ParquetFile, path: Path, table: Table) -> dict[str, Any]:
    raw = (file.schema_arrow.metadata or {}).get(_KEY)
    try:
        header: dict[str, Any] = json.loads(raw) if raw else {}
    except ValueError as error:
        raise _damaged(path, error) from error
    if header.get("table") != table.name or header.get("spec") != table.version:
        found = f"table `{header.get('table')}` of version {header.get('spec')}" if header else "no semslam table"
        raise TableError(
            f"Table file `{path}` holds {found}, expected table `{table.name}` of version {table.version}",
            hint="use another `--out` folder, or the version of semslam that wrote it",
        )
    return header


def _damaged(path: Path, error: Exception) -> TableError:
    reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    return TableError(f"Table file `{path}` is damaged: {reason}", hint="`semslam verify OUT` lists every damaged file")
