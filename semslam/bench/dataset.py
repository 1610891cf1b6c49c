"""What the bench needs to know of a data set of `semslam simulate`: who trains, who tests, and how noisy it is.

Reads   splits      data_spec.md, table 12
        plan.json   recipe of the data set
        truth/      tables 4, 6 and 13 of each log, by their digests
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from semslam.bench.rows import PROTOCOLS
from semslam.errors import SemslamError
from semslam.models.training.drives import logs_of, simulating
from semslam.pipeline.cache import key_of
from semslam.pipeline.digest import sha256_file
from semslam.pipeline.files import read_json
from semslam.tables.parquet import TableError, TableFiles, made_by
from semslam.tables.spec import SPLITS, TRUTH


@dataclass(frozen=True)
class Dataset:
    """A data set that was looked at."""

    root: Path
    train: dict[str, tuple[str, ...]]
    """Logs by protocol; a protocol that the data set is too small for is missing."""
    test: dict[str, tuple[str, ...]]
    scenes: int
    noise: str

    @property
    def logs(self) -> tuple[str, ...]:
        """All logs that train or test."""
        return tuple(sorted({log for side in (self.train, self.test) for logs in side.values() for log in logs}))

    @property
    def protocols(self) -> tuple[str, ...]:
        """Those it is large enough for."""
        return tuple(protocol for protocol in PROTOCOLS if protocol in self.test)

    @property
    def longest(self) -> int:
        """Keyframes of the longest log that tests."""
        logs = {log for logs in self.test.values() for log in logs}
        with made_by(simulating(self.root)):
            return max(TableFiles(TRUTH, [self.root / "truth" / log / "truth.parquet"]).rows for log in logs)

    def truth_digest(self, logs: Sequence[str]) -> str:
        """Of the truth of some logs."""
        return key_of({log: _truth_of(self.root, log) for log in logs})


def open_dataset(root: Path) -> Dataset:
    """Look at a data set.

    Raises:
        SemslamError: there is none, or it is too small for either protocol.
    """
    train: dict[str, tuple[str, ...]] = {}
    test: dict[str, tuple[str, ...]] = {}
    problem: SemslamError | None = None
    for protocol in PROTOCOLS:
        try:
            train[protocol], test[protocol] = (logs_of(root, protocol, part) for part in ("train", "test"))
        except TableError:
            raise
        except SemslamError as error:
            problem = error
    if problem and not test:
        raise problem
    scenes = set(TableFiles(SPLITS, [root / "splits.parquet"]).read(["scene"])["scene"])
    return Dataset(root, train, test, len(scenes), _noise(read_json(root / "plan.json")))


@cache
def _truth_of(root: Path, log: str) -> dict[str, str]:
    """Digests of the truth of a log, which nobody changes while a bench runs."""
    return {path.name: sha256_file(path) for path in sorted((root / "truth" / log).glob("*.parquet"))}


def _noise(plan: Any) -> str:
    """The noise level that the recipe names."""
    try:
        return str(plan["recipe"]["noise"])
    except (KeyError, TypeError):
        return "not told"
