"""Networks of the bench: one adapter a kind, each the training that `semslam train` offers.

A training is a part (store.py): its folder holds the checkpoint from which a killed one goes on, and at the end the
network's file. torch is imported by what this calls and by nothing else of the bench. The environment of every process
(pipeline/threads.py) gives it one thread: the same weights for any number of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from semslam.bench.rows import DEEPVO, FAR_SIDE, MAPNET, MAPPER, MAPPER_CELL, MAPPER_FAR
from semslam.models.extras import require_torch

TASK = "semslam.bench.trainings:train"
VERSION = 2
"""Raise it whenever the same training would come out differently."""


@dataclass(frozen=True)
class MapperKind:
    """How a kind of map update differs from the usual one."""

    paper: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the estimator that will use it."""
    options: Mapping[str, Any] = field(default_factory=dict)
    steps: int | None = None


MAPPERS = {
    MAPPER: MapperKind(),
    MAPPER_CELL: MapperKind(options={"kernel": 1}),
    MAPPER_FAR: MapperKind({"side": FAR_SIDE}, {"own_share": 0.0}, 300),
}


def train(arguments: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Train a network and export it; the result names its file and the file's digest.

    Args:
        arguments: kind, seed, device, steps (None: as usual), and what the kind's adapter below needs.
        folder: of the training.

    Raises:
        SemslamError: torch is missing, or the data will not do.
    """
    require_torch()
    from semslam.models.onnxfile import file_digest

    path = _ADAPTERS[arguments["kind"]](arguments, folder)
    return {"model": path.name, "digest": file_digest(path), "bytes": path.stat().st_size}


def _mapper(arguments: Mapping[str, Any], folder: Path) -> Path:
    """The map update of equation 8: dataset, logs, quality, run, paper."""
    from semslam.models.training.drives import DriveSet, RunTables
    from semslam.models.training.mapping import USUAL, MapperOptions, train_mapper
    from semslam.stages.settings import PaperConfig

    paper = PaperConfig(**arguments["paper"])
    run = {log: RunTables(*(tuple(map(Path, files)) for files in both)) for log, both in arguments["run"].items()}
    drives = DriveSet.open(Path(arguments["dataset"]), arguments["logs"], arguments["quality"], run=run, paper=paper)
    kind = MAPPERS[arguments["kind"]]
    options = MapperOptions(paper=paper, **kind.options)
    schedule = _schedule(replace(USUAL, steps=kind.steps or USUAL.steps), arguments)
    return train_mapper(drives, folder, schedule=schedule, options=options, device=arguments["device"])


def _mapnet(arguments: Mapping[str, Any], folder: Path) -> Path:
    """MapNet: dataset, logs, frames ({log: files}), cache."""
    from semslam.models.training.mapnet import USUAL, train_mapnet

    schedule = _schedule(USUAL, arguments)
    return train_mapnet(
        _pictures(arguments), folder, schedule=schedule, device=arguments["device"], **_short(arguments)
    )


def _deepvo(arguments: Mapping[str, Any], folder: Path) -> Path:
    """DeepVO: likewise."""
    from semslam.models.training.deepvo import USUAL, train_deepvo

    schedule = _schedule(USUAL, arguments)
    return train_deepvo(
        _pictures(arguments), folder, schedule=schedule, device=arguments["device"], **_short(arguments)
    )


_ADAPTERS: dict[str, Callable[[Mapping[str, Any], Path], Path]] = {
    **dict.fromkeys(MAPPERS, _mapper),
    MAPNET: _mapnet,
    DEEPVO: _deepvo,
}


def _pictures(arguments: Mapping[str, Any]) -> Any:
    """Thumbnails and poses of the logs, from the cache that all trainings share."""
    from semslam.models.training.sequences import PictureDrives, drive_files

    frames = {log: [Path(path) for path in paths] for log, paths in arguments["frames"].items()}
    return PictureDrives.open(
        drive_files(Path(arguments["dataset"]), arguments["logs"], frames), Path(arguments["cache"])
    )


def _schedule(usual: Any, arguments: Mapping[str, Any]) -> Any:
    """The usual schedule with the seed, and with fewer steps if asked."""
    schedule = replace(usual, seed=arguments["seed"])
    if arguments["steps"] is None:
        return schedule
    steps = int(arguments["steps"])
    return replace(schedule, steps=steps, warm_up=1, batch=min(2, schedule.batch), report_every=steps)


def _short(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Sequences of a data set of very short logs."""
    return {} if arguments["length"] is None else {"length": int(arguments["length"])}
