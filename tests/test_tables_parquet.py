"""Tables survive the disk unchanged, and damage never reads back as data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from semslam.tables.parquet import TableError, TableFiles, TableFileWriter, rows_of, write_table
from semslam.tables.spec import ALL_TABLES, MOTION, OBSERVATIONS, TYPES


def motion_rows(start: int, stop: int) -> dict[str, list[Any]]:
    frames = list(range(start, stop))
    return {
        "frame": frames,
        "stamp_nanos": [10**18 + i for i in frames],
        "dx_m": [None if i == 0 else 0.1 * i for i in frames],
        "dy_m": [None if i == 0 else -0.5 for i in frames],
        "dheading_rad": [None if i == 0 else 0.01 for i in frames],
        "source": ["start" if i == 0 else "odometry" for i in frames],
    }


def test_rows_come_back_across_shards(tmp_path: Path) -> None:
    """Several shard files read as one table, whole or in part, in order."""
    paths = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    write_table(paths[0], MOTION, motion_rows(0, 5), {"note": 1})
    write_table(paths[1], MOTION, motion_rows(5, 9), {"note": 1})
    table = TableFiles(MOTION, paths)
    assert table.rows == 9
    assert table.meta == {"note": 1}
    assert table.read() == motion_rows(0, 9)
    parts = list(table.batches(["frame"], start=3, stop=8, batch_rows=2))
    assert [frame for part in parts for frame in part["frame"]] == [3, 4, 5, 6, 7]
    assert all(len(part["frame"]) <= 2 for part in parts)
    rows = list(rows_of(table.batches(["frame", "source"], start=4, batch_rows=2)))
    assert rows == [{"frame": frame, "source": "odometry"} for frame in range(4, 9)]


def test_same_rows_same_bytes(tmp_path: Path) -> None:
    """Writing the same rows twice gives identical files."""
    rows = {"frame": [0], "stamp_nanos": [5], "cells": [[1, 7]], "weights": [[0.5, 0.25]], "objects": [2]}
    for name in ("a", "b"):
        write_table(tmp_path / name, OBSERVATIONS, rows, {"classes": ["x", "y"], "side": 3})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_every_flipped_data_byte_is_noticed_or_harmless(tmp_path: Path) -> None:
    """A flipped bit in the pages gives an error or the same rows, never other rows."""
    path = tmp_path / "t.parquet"
    write_table(path, MOTION, motion_rows(0, 50))
    good, rows = path.read_bytes(), motion_rows(0, 50)
    noticed = 0
    footer = len(good) - 8 - int.from_bytes(good[-8:-4], "little")
    for position in range(0, footer, 3):
        bad = bytearray(good)
        bad[position] ^= 0x10
        path.write_bytes(bytes(bad))
        try:
            assert TableFiles(MOTION, [path]).read() == rows
        except TableError:
            noticed += 1
        except (UnicodeDecodeError, ValueError):
            pytest.fail(f"flip at {position} escaped as a bare exception")
    assert noticed > 0


def test_wrong_files_are_refused(tmp_path: Path) -> None:
    """A missing, truncated or foreign file is one clear error."""
    path = tmp_path / "t.parquet"
    with pytest.raises(TableError, match="missing"):
        TableFiles(MOTION, [path])
    write_table(path, MOTION, motion_rows(0, 5))
    with pytest.raises(TableError, match="expected table `observations`"):
        TableFiles(OBSERVATIONS, [path])
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(TableError, match="damaged"):
        TableFiles(MOTION, [path])


def test_columns_are_checked_when_written(tmp_path: Path) -> None:
    """A missing column, or a null where none may be, is a mistake of the caller."""
    writer = TableFileWriter(tmp_path / "t.parquet", MOTION)
    rows = motion_rows(0, 2)
    with pytest.raises(ValueError, match="source"):
        writer.append({k: v for k, v in rows.items() if k != "source"})
    with pytest.raises(ValueError, match="must not be null"):
        writer.append({**rows, "source": ["odometry", None]})
    writer.close()


def test_tables_use_known_types_and_distinct_names() -> None:
    """The specification is consistent in itself."""
    assert [t.number for t in ALL_TABLES] == list(range(1, len(ALL_TABLES) + 1))
    assert len({t.name for t in ALL_TABLES}) == len(ALL_TABLES)
    for table in ALL_TABLES:
        assert {c.type for c in table.columns} <= set(TYPES)
        assert len({c.name for c in table.columns}) == len(table.columns)


def test_lists_are_stored_small(tmp_path: Path) -> None:
    """Every column but the pictures is compressed, the values of lists too; rising cell numbers take a byte or so."""
    path = tmp_path / "true.parquet"
    counts = {"list<uint32>": list(range(20_000)), "list<float32>": [0.5] * 20_000, "list<int64>": list(range(20_000))}
    values = _ONE | counts
    row = {column.name: [values[column.type]] for column in OBSERVATIONS.columns}
    write_table(path, OBSERVATIONS, row)
    group = pq.ParquetFile(path).metadata.row_group(0)
    codecs = {group.column(i).path_in_schema: group.column(i).compression for i in range(group.num_columns)}
    assert set(codecs.values()) == {"ZSTD"}, codecs
    assert TableFiles(OBSERVATIONS, [path]).read() == row
    assert path.stat().st_size < 30_000


_ONE: dict[str, Any] = {
    "bool": True,
    "int8": 1,
    "int32": 1,
    "int64": 1,
    "uint16": 1,
    "uint32": 1,
    "uint64": 1,
    "float32": 0.5,
    "float64": 0.5,
    "string": "a",
    "list<float64>": [0.5],
}
