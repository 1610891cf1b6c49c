"""What a person sees of `semslam merge`: a bar over logs, then over keyframes, and a table at the end."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semslam.pipeline.console import Console, table

if TYPE_CHECKING:
    from tqdm import tqdm

_LINE_PERIOD_S = 10.0
_UNITS = {"placed": "log", "aligned": "keyframe"}
_HEAD = ("SITE", "LOG", "VERDICT", "KEYFRAMES", "TIES", "X", "Y", "HEADING", "ASKED OF", "PROBABILITY")


@dataclass(frozen=True)
class LogRow:
    """A row of the sites table."""

    log: str
    site: str
    verdict: str
    x_m: float
    y_m: float
    heading_rad: float
    covariance: list[float]
    keyframes: int
    ties: int
    other: str | None
    likeness: float | None
    probability: float | None


@dataclass(frozen=True)
class MergeReport:
    """What came of a merge, and where it lies."""

    folder: Path
    rows: tuple[LogRow, ...]
    notes: tuple[str, ...]
    cached: bool
    """Whether it was there already."""

    @property
    def sites(self) -> list[str]:
        """Their names."""
        return list(dict.fromkeys(row.site for row in self.rows))

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "format": "semslam-merge",
            "version": 1,
            "folder": str(self.folder),
            "cached": self.cached,
            "sites": [
                {"site": site, "logs": [asdict(row) for row in self.rows if row.site == site]} for site in self.sites
            ],
            "notes": list(self.notes),
        }

    def text(self) -> str:
        """For a terminal."""
        return table([_HEAD, *(_row(row) for row in self.rows)], left=(0, 1, 2, 8))


def _row(row: LogRow) -> Sequence[str]:
    return [
        row.site,
        row.log,
        row.verdict,
        f"{row.keyframes:,}",
        f"{row.ties:,}",
        f"{round(row.x_m, 3) + 0.0:.3f} m",  # no minus before a zero
        f"{round(row.y_m, 3) + 0.0:.3f} m",
        f"{round(math.degrees(row.heading_rad), 2) + 0.0:.2f} deg",
        row.other or "-",
        "-" if row.probability is None else f"{row.probability:.0%}",
    ]


def say_merged(console: Console, report: MergeReport) -> None:
    """Warnings, how many sites there are, and where they lie."""
    for note in report.notes:
        console.warn(note)
    for row in report.rows:
        if row.verdict == "ambiguous":
            console.warn(f"`{row.log}` fits the map of `{row.other}` in several ways alike and was not joined to it")
        elif row.verdict == "contradicted":
            why = "other logs, or what both saw, contradict"
            console.warn(f"`{row.log}` was found in the map of `{row.other}`, but {why}: not joined")
    sites = "1 site" if len(report.sites) == 1 else f"{len(report.sites)} sites"
    again = ", made before and unchanged" if report.cached else ""
    console.say(f"{len(report.rows)} logs, {sites}{again}: {report.folder}")


class MergeView:
    """Shows a merge as it goes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar: tqdm[Any] | None = None
        self._what = ""
        self._said = time.monotonic()

    def progressed(self, what: str, done: int, total: int) -> None:
        """So many logs are placed, or keyframes aligned."""
        if self._console.quiet:
            return
        if self._console.terminal:
            self._move(what, done, total)
        elif time.monotonic() - self._said >= _LINE_PERIOD_S:
            self._said = time.monotonic()
            self._console.say(f"{done:,}/{total:,} {_UNITS[what]}s {what}")

    def close(self) -> None:
        """Take the bar away, whatever ended the command."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _move(self, what: str, done: int, total: int) -> None:
        if what != self._what:
            self.close()
            self._what = what
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(
                desc=what,
                total=total,
                unit=f" {_UNITS[what]}",
                leave=False,
                file=self._console.stream,
                dynamic_ncols=True,
            )
        self._bar.update(done - self._bar.n)
