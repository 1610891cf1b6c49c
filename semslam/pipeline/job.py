"""What runner and workers say to each other: plain values that travel between processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semslam.pipeline.digest import FileStamp
from semslam.pipeline.failure import Failure
from semslam.stages.contract import Stage


@dataclass(frozen=True)
class InputFile:
    """A file of an earlier entry that holds part of a table."""

    path: str
    sha256: str


@dataclass(frozen=True)
class Job:
    """A task as a worker gets it.

    Attributes:
        number: how executor and runner call it.
        inputs: the files of every table the stage reads, in order; an optional table that is absent is missing.
        guards: input files outside the cache with the stamp they had when their digests went into the key.
    """

    number: int
    stage: Stage
    variant: str
    log: str
    sources: tuple[Path, ...]
    config: Any
    key: str
    components: Mapping[str, Any]
    inputs: Mapping[str, tuple[InputFile, ...]]
    guards: tuple[tuple[str, FileStamp], ...]
    stage_folder: Path


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    Attributes:
        failure: None if its entry is published.
        out_of_space: whether it failed because the disk is full, which ends the whole run.
        resumed: shards that an earlier run had finished.
    """

    number: int
    failure: Failure | None
    seconds: float
    max_rss_bytes: int = 0
    resumed: int = 0
    out_of_space: bool = False
