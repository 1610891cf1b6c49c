"""What can be known to be wrong before any log is read: said once, as wrong use, not once a log after hours.

Each rule lives with the code that it protects, and is asked there. That loads numpy and opens networks, so it is done
only for a configuration with which no result was made yet.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError, UsageError
from semslam.pipeline.config import Config
from semslam.pipeline.plan import Planner, Task
from semslam.pipeline.record import LogRecord
from semslam.stages.catalogue import EXPORT, EXTRACT, INGEST, LOCALIZE
from semslam.stages.contract import Stage


def check_new(planner: Planner, config: Config, tasks: Sequence[Task], records: Iterable[LogRecord]) -> None:
    """Check the stages of `tasks`, those of one log, from the first on that has no result of this configuration.

    Raises:
        UsageError: a stage would refuse its configuration, whatever the log.
    """
    proven = _proven(planner, tasks, records)
    stages = dict.fromkeys(task.stage for task in tasks if task.stage.name not in proven)
    check_stages(config, list(stages))


def check_stages(config: Config, stages: Sequence[Stage], *, detector_later: bool = False) -> None:
    """Ask every stage whether its configuration will do; with `detector_later`, a missing detector is no fault.

    Raises:
        UsageError: it will not.
    """
    for stage in stages:
        check = _CHECKS.get(stage.entry)
        if check is None or (detector_later and stage == EXTRACT and not config.of(stage).detector):
            continue
        try:
            check(config)
        except SemslamError as error:
            raise UsageError(error.message, hint=error.hint, details=error.details) from error
        except Exception:  # a bug: the stage will meet it too, and its traceback is kept there
            continue


def _proven(planner: Planner, tasks: Sequence[Task], records: Iterable[LogRecord]) -> set[str]:
    """Stages that some log has passed with this very configuration, as it has all stages before them."""
    wanted = [(task, planner.standing(task)) for task in tasks]
    best: set[str] = set()
    for record in records:
        unlike = {task.stage.name for task, standing in wanted if not _made_with(record, task, standing)}
        names = list(dict.fromkeys(task.stage.name for task, _ in wanted))
        first = min((names.index(name) for name in unlike), default=len(names))
        best = max(best, set(names[:first]), key=len)
    return best


def _made_with(record: LogRecord, task: Task, standing: Mapping[str, Any]) -> bool:
    """Whether the log has a result of the task with this configuration."""
    known = record.tasks.get(task.name)
    return known is not None and all(known.components.get(name) == value for name, value in standing.items())


def _check_ingest(config: Config) -> None:
    from semslam.logs.roles import ROLES

    for role in config.of(INGEST).topics:
        if role not in ROLES:
            close = difflib.get_close_matches(role, ROLES, n=1, cutoff=0.5)
            hint = f"did you mean `{close[0]}`?" if close else f"roles: {', '.join(ROLES)}"
            raise SemslamError(f"`ingest.topics` names the unknown role `{role}`", hint=hint)


def _check_extract(config: Config) -> None:
    _classes(config)


def _classes(config: Config) -> tuple[str, ...]:
    """Open the networks of extract and choose the classes."""
    from semslam.stages.extract import ObjectClasses, open_models

    section = config.of(EXTRACT)
    detector, _ = open_models(section, 1)
    return ObjectClasses.choose(detector.class_names, section).all


def _check_localize(config: Config) -> None:
    """Whether the paper's cells can be made from those of extract, and all estimators take their networks."""
    from semslam.slam.paper_estimator import pooling_factor
    from semslam.slam.registry import model_of, open_estimator
    from semslam.slam.surfel.prior import Grid, open_prior

    section, extract = config.of(LOCALIZE), config.of(EXTRACT)
    if any(name.startswith("paper") for name in section.estimators):
        pooling_factor(section.paper, extract.cell_m, extract.side)
    if section.surfel.prior:
        if "surfel" not in section.estimators:
            raise SemslamError(
                "`localize.surfel.prior` is for the estimator `surfel`, which is not among those to run",
                hint="add `--estimator surfel`",
            )
        open_prior(Path(section.surfel.prior), Grid(_classes(config), extract.cell_m, extract.side))
    for name in section.estimators:
        if model_of(name, section):
            classes = _classes(config) if name.startswith("paper") else ()
            open_estimator(name, section, classes, extract.cell_m, extract.side)


def _check_export(config: Config) -> None:
    from semslam.slam.depth_sight import Columns
    from semslam.slam.exchange import unknown_grey

    section = config.of(EXPORT)
    unknown_grey(section.free_threshold, section.occupied_threshold)
    low_m, high_m = section.min_obstacle_height_m, section.max_obstacle_height_m
    Columns(section.layer_cell_m, low_m, high_m, section.layer_depth_m)


_CHECKS: dict[str, Callable[[Config], None]] = {
    INGEST.entry: _check_ingest,
    EXTRACT.entry: _check_extract,
    LOCALIZE.entry: _check_localize,
    EXPORT.entry: _check_export,
}
"""By the stage's entry point, so that another implementation under the same name is not asked."""
