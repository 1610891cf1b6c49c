"""`semslam bench paper`: observe, train, localise, build maps, compare, write.

    OUT/
      pipeline/     output folder of the stages: keyframes, observations, tracks; `--run` names another
      parts/        networks, maps, tracks of peers, under the digests of what they depend on (store.py)
      pictures/     thumbnails that the image networks learn from
      results/      README.md with all tables and figures; CSV, Parquet and SVG

Everything is found again by the digest of what it depends on: a killed bench goes on, and one that is finished writes
the same files again. What cannot be run (a missing package, a network that would not train) is listed with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import semslam
from semslam.bench import figures, tables
from semslam.bench.dataset import Dataset, open_dataset
from semslam.bench.localising import row_tracks
from semslam.bench.mapping import build_maps
from semslam.bench.maps import paper_settings
from semslam.bench.networks import costs, train_networks
from semslam.bench.noise import noise_tracks
from semslam.bench.results import Conditions, NotRun, Results
from semslam.bench.rows import chosen_rows
from semslam.bench.store import Store
from semslam.bench.tracks import Pipeline, Runs
from semslam.bench.work import BenchRequest, Work
from semslam.errors import SemslamError, UsageError
from semslam.pipeline.console import Console
from semslam.pipeline.files import write_text
from semslam.pipeline.folder import OutputFolder
from semslam.stages.contract import Stage
from semslam.stages.settings import PaperConfig

_QUICK_HEADINGS = 24


@dataclass(frozen=True)
class BenchReport:
    """What came of it."""

    results: Results
    page: Path

    @property
    def empty(self) -> bool:
        """Whether nothing that was asked for could be run."""
        return not (self.results.tracks or self.results.maps or self.results.noise)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "format": "semslam-bench",
            "version": 1,
            "page": str(self.page),
            "conditions": asdict(self.results.conditions),
            "tables": {s.name: {"head": s.head, "rows": s.rows} for s in tables.sheets(self.results)},
            "not_run": [asdict(one) for one in self.results.reasons],
        }


def bench_paper(request: BenchRequest, stages: Sequence[Stage], console: Console) -> BenchReport:
    """Regenerate every table and figure.

    Raises:
        SemslamError: no data set, an unknown row, a refused configuration, another bench works in `out`, or matplotlib
            is missing.
    """
    request = _quick(request) if request.quick else request
    rows = chosen_rows(request.rows)
    _require_report()
    _require_device(request.device)
    dataset = open_dataset(request.dataset)
    request = replace(request, steps=min(request.steps, dataset.longest))
    request.out.mkdir(parents=True, exist_ok=True)
    base: dict[str, Any] = {
        "config_file": request.config_file,
        "assignments": request.assignments,
        "workers": request.workers,
    }
    base |= {"options": request.options, "make": request.run is None}
    folder = request.run or request.out / "pipeline"
    opened = Pipeline.opened(folder, stages, dataset.root, **base)
    with OutputFolder(request.out).locked(), opened as pipeline:
        _require_free_rows(pipeline)
        seen = _observed(pipeline, dataset, console)
        work = Work(request, dataset, pipeline, Store(request.out / "parts"), console, rows, seen)
        results = _measured(work)
    return _written(results, request.out / "results", console)


def _quick(request: BenchRequest) -> BenchRequest:
    """One process serves best: parts take less time than processes need to start."""
    options = {"localize.paper.headings": _QUICK_HEADINGS, **request.options}
    return replace(request, seeds=1, options=options, workers=0 if request.workers is None else request.workers)


def _require_report() -> None:
    if not figures.available():
        raise SemslamError("Figures need matplotlib, which is not installed", hint="pip install 'semslam[report]'")


def _require_device(device: str) -> None:
    if device == "cpu" or find_spec("torch") is None:  # a bench without torch lists its networks as not run
        return
    from semslam.models.training.runs import device_of

    device_of(device)


def _require_free_rows(pipeline: Pipeline) -> None:
    """Every row has a map update of its own; one that was asked for would be silently left aside."""
    paper, usual = pipeline.paper(), PaperConfig()
    for name in ("update", "model"):
        if getattr(paper, name) != getattr(usual, name):
            raise UsageError(
                f"`localize.paper.{name}` is chosen by the rows of the bench",
                hint="leave it out of `--set` and of the configuration; `--rows visual_leaky`, say, chooses a row",
            )


def _observed(pipeline: Pipeline, dataset: Dataset, console: Console) -> Runs:
    """Keyframes and observations of all logs.

    Raises:
        SemslamError: a log that trains or tests could not be read.
    """
    console.say(f"observe {len(dataset.logs)} logs")
    runs = pipeline.run("extract", dataset.logs)
    if runs.failures:
        log, reason = next(iter(runs.failures.items()))
        raise SemslamError(
            f"{len(runs.failures)} of {len(dataset.logs)} logs could not be observed; `{log}`: {reason}",
            hint=f"`semslam status {pipeline.folder.root}` shows all",
        )
    return runs


def _measured(work: Work) -> Results:
    """All figures, in the order of what needs what."""
    missing: list[NotRun] = []
    networks = train_networks(work)
    tracks = tuple(row_tracks(work, networks, missing))
    maps = tuple(build_maps(work, networks, missing)) if work.with_maps else ()
    noise = tuple(noise_tracks(work, networks, missing)) if work.with_noise else ()
    return Results(_conditions(work), tracks, maps, tuple(missing), tuple(costs(work, networks)), noise)


def _conditions(work: Work) -> Conditions:
    dataset, paper = work.dataset, work.pipeline.paper()
    detector = work.pipeline.config().sections["extract"].detector
    return Conditions(
        dataset.root.resolve().name,
        dataset.scenes,
        len(dataset.logs),
        dataset.noise,
        work.request.steps,
        work.request.seeds,
        {protocol: len(dataset.test[protocol]) for protocol in dataset.protocols},
        paper_settings(paper),
        Path(detector).name if detector else "the shipped one",
        {"semslam": semslam.__version__},
        work.request.quick,
    )


def _written(results: Results, folder: Path, console: Console) -> BenchReport:
    """Tables, figures, and the page that holds them."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.iterdir():  # of rows that were asked for before, perhaps with other settings
        if path.suffix in (".csv", ".parquet", ".svg") or path.name == tables.TIMES:
            path.unlink()
    tables.write_tables(results, folder)
    drawn = figures.write_figures(results, folder)
    page = folder / "README.md"
    write_text(page, tables.report(results, drawn))
    for one in results.reasons:
        console.warn(f"`{one.name}` ({one.where}) was not run, or not whole: {one.reason}")
    console.say(f"results: {page}")
    return BenchReport(results, page)
