"""A bench at work: what was asked for, what is there already, and who watches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semslam.bench.dataset import Dataset
from semslam.bench.jobs import Outcome, run_parts
from semslam.bench.maps import paper_settings
from semslam.bench.rows import MAPS, NOISE, Row, protocols_of
from semslam.bench.store import Part, Store
from semslam.bench.tracks import Pipeline, Runs
from semslam.pipeline.console import Console
from semslam.processes import usable_cpus
from semslam.tables.spec import MOTION, OBSERVATIONS, Table


@dataclass(frozen=True)
class BenchRequest:
    """What was asked for.

    Attributes:
        rows: names of rows, `maps` and `noise`; none: all.
        seeds: trainings of each network.
        steps: keyframes of each test log that are scored.
        quick: networks that hardly learn, few headings, one seed: for trying every path.
        run: output folder of an earlier run over the same logs, whose observations are used if they were made with
            the same configuration; None takes one of the bench's own.
        device: cpu or cuda, for trainings. Weights of another device are other weights.
        workers: processes; 0 does everything in this one but the peers, None chooses.
    """

    dataset: Path
    out: Path
    rows: tuple[str, ...] = ()
    seeds: int = 3
    steps: int = 30
    quick: bool = False
    config_file: Path | None = None
    assignments: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    run: Path | None = None
    device: str = "cpu"
    workers: int | None = None


@dataclass(frozen=True)
class Work:
    """Everything that the parts of a bench share."""

    request: BenchRequest
    dataset: Dataset
    pipeline: Pipeline
    store: Store
    console: Console
    rows: tuple[Row, ...]
    seen: Runs
    """Keyframes and observations of all logs."""

    @property
    def workers(self) -> int:
        """Processes for parts."""
        chosen = self.request.workers
        return usable_cpus() if chosen is None else chosen

    @property
    def seeds(self) -> range:
        """Of the trainings."""
        return range(1, self.request.seeds + 1)

    @property
    def with_maps(self) -> bool:
        """Whether table 4 was asked for, and there is a test across scenes."""
        return self._wanted(MAPS)

    @property
    def with_noise(self) -> bool:
        """Whether other levels of noise were asked for, likewise."""
        return self._wanted(NOISE)

    def _wanted(self, name: str) -> bool:
        asked = not self.request.rows or name in self.request.rows
        return asked and "cross" in self.dataset.protocols

    def protocols(self, row: Row) -> Iterator[str]:
        """Those in which a row is run and that the data set is large enough for."""
        yield from (protocol for protocol in protocols_of(row) if protocol in self.dataset.protocols)

    def paper(self) -> dict[str, Any]:
        """The paper's section of the configuration, plain, without a network."""
        return paper_settings(self.pipeline.paper(), model="", update="leaky")

    def files(self, log: str, table: Table) -> list[str]:
        """Files of a table that was observed."""
        return [str(file) for file in self.seen.files(log, table)]

    def run_files(self, logs: Iterable[str]) -> dict[str, list[list[str]]]:
        """Files of motion and observations, by log."""
        return {log: [self.files(log, table) for table in (MOTION, OBSERVATIONS)] for log in logs}

    def inputs(self, logs: Sequence[str], *, observed: bool) -> dict[str, Any]:
        """What the data of some logs depend on, for digests."""
        keys = {"ingest": self.seen.keys(logs, "ingest"), "truth": self.dataset.truth_digest(logs)}
        return {**keys, "extract": self.seen.keys(logs, "extract") if observed else []}

    def do(self, parts: Sequence[Part], *, apart: bool = False) -> dict[str, Outcome]:
        """Do parts and tell how each came out; outcomes by key. `apart` takes processes even for `--workers 0`."""
        return run_parts(self.store, parts, max(int(apart), self.workers), self._told(len(parts)))

    def _told(self, total: int) -> Callable[[Outcome], None]:
        """Says what became of each part, with a count."""
        done = 0

        def settled(outcome: Outcome) -> None:
            nonlocal done
            done += 1
            took = "cached" if outcome.cached else f"{outcome.seconds:.1f} s"
            end = f"failed, {outcome.reason}" if outcome.reason else took
            self.console.say(f"[{done}/{total}] {outcome.part.title}: {end}")

        return settled


def where(place: str, seed: int) -> str:
    """A protocol or quality, and the seed if there is one."""
    return f"{place}, seed {seed}" if seed else place
