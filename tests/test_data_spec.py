"""data_spec.md and `semslam/tables/spec.py` say the same."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from semslam.labels import RESERVED
from semslam.stages.catalogue import STAGES
from semslam.tables.spec import ALL_TABLES, Column, Table

PAGE = Path(__file__).parent.parent / "data_spec.md"
COMMANDS = {"evaluate", "merge", "simulate", "train"}
"""They write tables, and are no stages."""


def section(table: Table) -> str:
    """The text of one table's section."""
    text = PAGE.read_text()
    start = text.index(f"### {table.number} `{table.name}`")
    end = re.search(r"^##", text[start + 3 :], re.MULTILINE)
    return text[start : start + 3 + end.start()] if end else text[start:]


def columns(text: str) -> list[Column]:
    """Columns of the Markdown table in a section."""
    found = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 5 and re.fullmatch(r"`\w+`", cells[0]):
            name, kind, unit, null, meaning = cells
            found.append(Column(name.strip("`"), kind, unit, null == "yes", meaning))
    return found


@pytest.mark.parametrize("table", ALL_TABLES, ids=lambda table: table.name)
def test_columns_of_page_and_code_are_equal(table: Table) -> None:
    """Same columns, in the same order, with the same types, units and meanings."""
    assert columns(section(table)) == list(table.columns)


def test_page_has_no_other_tables() -> None:
    """Every table on the page is one of the code."""
    numbered = re.findall(r"^### (\d+) `(\w+)`", PAGE.read_text(), re.MULTILINE)
    assert numbered == [(str(table.number), table.name) for table in ALL_TABLES]


def test_writers_are_the_stages_that_declare_the_table() -> None:
    """`stage` of a table is the stage that writes it, in the catalogue and on the page."""
    written = {table.name: stage.name for stage in STAGES for table in stage.writes}
    for table in ALL_TABLES:
        assert written.get(table.name) == table.stage or table.stage in COMMANDS - set(written.values())
        assert f"Written by `{table.stage}`" in section(table)


def test_every_table_has_an_example_row() -> None:
    """A reader sees what a row looks like."""
    for table in ALL_TABLES:
        assert "Example:" in section(table), table.name


def test_reserved_classes_and_versions_are_on_the_page() -> None:
    """The reserved classes and the tables' versions stand on the page as in the code."""
    text = PAGE.read_text()
    for index, name in enumerate(RESERVED):
        assert f"| {index} | `{name}` |" in text
    for table in ALL_TABLES:
        assert re.findall(r"Version (\d+)\.", section(table)) == ([str(table.version)] if table.version > 1 else [])
