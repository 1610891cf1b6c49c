"""A run as the commands ask for it: folder, logs, configuration, executor; then the words at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError
from semslam.pipeline.config import Config, load_config
from semslam.pipeline.console import Console, RunView, say_end
from semslam.pipeline.discover import Discovery, Log, discover
from semslam.pipeline.executors import Executor, ProcessPool, SerialExecutor
from semslam.pipeline.folder import OutputFolder, create_folder
from semslam.pipeline.plan import stages_until, variants_of
from semslam.pipeline.record import RecordBook
from semslam.pipeline.report import RunOutcome
from semslam.pipeline.runner import Runner, RunReport
from semslam.processes import usable_cpus
from semslam.stages.contract import Stage


@dataclass(frozen=True)
class RunRequest:
    """What was asked for on the command line.

    Attributes:
        names: files, folders and globs.
        until: name of the last stage to run.
        options: settings given by options of their own, {"section.key": value}.
        workers: processes; 0 runs everything in this one, None chooses.
    """

    names: Sequence[str]
    out: Path
    until: str
    command: str = "run"
    config_file: Path | None = None
    assignments: Sequence[str] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    workers: int | None = None


def run(request: RunRequest, stages: Sequence[Stage], console: Console) -> RunOutcome:
    """Do it and say what came of it."""
    config = load_config(stages, request.config_file, request.assignments, request.options)
    folder = create_folder(request.out)
    with folder.locked():
        book = RecordBook(folder.logs)
        found = discover(request.names, {name: record.sources for name, record in book.records.items()})
        _say_start(console, request, found)
        report = run_logs(folder, stages, request.until, config, found.logs, request.workers, console, book)
    say_end(console, report, str(folder.root), *_places(folder, report, stages[-1].name))
    for problem in found.problems:
        console.error(SemslamError(f"`{problem.path}` was left out: {problem.reason}"))
    return RunOutcome(folder, report, found.problems, found.warnings)


def run_logs(
    folder: OutputFolder,
    stages: Sequence[Stage],
    until: str,
    config: Config,
    logs: Sequence[Log],
    workers: int | None,
    console: Console,
    book: RecordBook | None = None,
) -> RunReport:
    """Run the stages up to `until` over the logs, and show it."""
    needed = stages_until(stages, until)
    published = stages[-1].name
    number = usable_workers(needed, config, len(logs)) if workers is None else workers
    executor: Executor = ProcessPool(number) if number else SerialExecutor()
    view = RunView(console)
    runner = Runner(folder, needed, config, logs, executor, view, published, max(1, number), book)
    try:
        report = runner.run()
    finally:
        view.close()
    console.say("\n" + view.table() + "\n")
    return report


def usable_workers(stages: Sequence[Stage], config: Config, logs: int) -> int:
    """As many workers as processors, but not more than there can be tasks at once."""
    widest = max(len(variants_of(stages, stage, config)) for stage in stages)
    return max(1, min(usable_cpus(), logs * widest))


def _say_start(console: Console, request: RunRequest, found: Discovery) -> None:
    count = f"{len(found.logs)} {'log' if len(found.logs) == 1 else 'logs'}"
    console.say(f"{console.colour(f'semslam {request.command}', 'bold')}   {count} -> {request.out}")
    for log in found.logs:
        if len(log.sources) > 1:
            ends = f"`{log.sources[0].name}` to `{log.sources[-1].name}`"
            console.say(f"`{log.name}` is a recording in {len(log.sources)} files, {ends}")
    for warning in found.warnings:
        console.warn(warning)


def _places(folder: OutputFolder, report: RunReport, published: str) -> tuple[list[str], list[str]]:
    """Where results lie, a map first where there is one, and folders that hold older ones."""
    places, stale = [], []
    for result in report.results:
        if result.task.stage.name != published:
            continue
        place = folder.results / result.task.log.name / result.task.variant
        if result.entry is not None:
            places.append(str(place / "map.png" if "map.png" in result.entry.files else place))
        elif place.is_dir():
            stale.append(str(place))
    return places, stale
