"""Four small stages in the shape of the real ones, for testing whatever runs stages.

A log is a text file. Its first line may hold orders: `refuse`, `bug`, `full`, `kill`, `kill-once`, `warn`, `remark`,
`notes`.
Every call of a stage appends a line to the file named by SEMSLAM_FAKE_CALLS, from whatever process it runs in.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from semslam.stages.contract import LogRefusedError, Stage, StageContext, row_shards
from semslam.stages.settings import setting
from semslam.tables.spec import Column, Table

CALLS = "SEMSLAM_FAKE_CALLS"


def _table(name: str, number: int, stage: str) -> Table:
    return Table(name, number, stage, (Column("value", "int64", "", False, "a number"),))


NUMBERS = _table("numbers", 101, "first")
NOTES = _table("notes", 102, "first")
SUMS = _table("sums", 103, "second")
TRACKS = _table("tracks", 104, "third")
PICTURES = _table("pictures", 105, "last")


@dataclass(frozen=True)
class FirstConfig:
    """Reads the log."""

    scale: int = setting(1, low=1, high=10)
    """Every number is multiplied by this."""
    shard_rows: int = setting(4, low=1, high=1000)
    """Numbers a shard."""
    pause_s: float = setting(0.0, low=0.0, high=10.0)
    """Sleep in every shard, seconds."""
    mode: str = setting("plain", choices=("plain", "fancy"))
    """A word to choose."""
    names: Mapping[str, str] = setting({})
    """Texts by name."""


@dataclass(frozen=True)
class SecondConfig:
    """Sums."""

    modulo: int = setting(1000000, low=1)
    """Sums are taken modulo this."""
    model: str = setting("", file=True)
    """A file whose content matters."""
    note: str = setting("")
    """Changes the key and nothing else."""


@dataclass(frozen=True)
class InnerConfig:
    """A section within a section."""

    gain: float = setting(1.0, low=0.0, high=100.0)
    """Factor of the careful variant."""


@dataclass(frozen=True)
class ThirdConfig:
    """Has variants."""

    kinds: tuple[str, ...] = setting(("careful", "hasty", "lazy"), choices=("careful", "hasty", "lazy"))
    """Variants to run."""
    inner: InnerConfig = field(default_factory=InnerConfig)
    """Section `[third.inner]`."""
    shard_rows: int = setting(4, low=1, high=1000)
    """Numbers a shard."""
    pause_s: float = setting(0.0, low=0.0, high=10.0)
    """Sleep in every shard, seconds."""

    def for_variant(self, kind: str) -> ThirdConfig:
        """Only the careful variant depends on the inner section."""
        return replace(self, kinds=(kind,), inner=self.inner if kind == "careful" else InnerConfig())


@dataclass(frozen=True)
class LastConfig:
    """Writes files."""

    title: str = setting("map")
    """Text of the picture."""


def count_call(ctx: StageContext, stage: str) -> None:
    """Leave a line that tells who was called."""
    if name := os.environ.get(CALLS):
        with open(name, "a", encoding="utf-8") as file:
            file.write(f"{ctx.log} {stage} {ctx.variant}".strip() + "\n")


def first(ctx: StageContext) -> None:
    """Numbers of all lines after the first."""
    count_call(ctx, "first")
    lines = [line for path in ctx.sources for line in path.read_text().splitlines()]
    _obey(ctx, lines[0])
    values = [ctx.config.scale * int(line) for line in lines[1:] if line.lstrip("-").isdigit()]
    for index, start, stop in row_shards(len(values), ctx.config.shard_rows):
        if index < len(ctx.finished):
            continue
        with ctx.shard(index) as shard:
            shard.table(NUMBERS, {"classes": ["a", "b"]}).append({"value": values[start:stop]})
            if "notes" in lines[0] and index == 0:
                shard.table(NOTES).append({"value": [7]})
            time.sleep(ctx.config.pause_s)
            shard.count("read", stop - start)
            if "warn" in lines[0] and index == 0:
                shard.warn("a line was strange")
            if "remark" in lines[0] and index == 0:
                shard.remark(f"read as {ctx.log}")
            ctx.progress(stop, len(values))


def second(ctx: StageContext) -> None:
    """Running sums."""
    count_call(ctx, "second")
    values = ctx.read(NUMBERS).read()["value"]
    sums = [sum(values[: index + 1]) % ctx.config.modulo for index in range(len(values))]
    with ctx.shard(0) as shard:
        shard.table(SUMS).append({"value": sums})


def third(ctx: StageContext) -> None:
    """A state that goes from shard to shard, as an estimator's does."""
    count_call(ctx, "third")
    values = ctx.read(SUMS).read()["value"]
    gain = int(ctx.config.inner.gain * {"careful": 3, "hasty": 2, "lazy": 0}[ctx.variant])
    state = int((ctx.finished[-1].folder / "state.txt").read_text()) if ctx.finished else 0
    for index, start, stop in row_shards(len(values), ctx.config.shard_rows):
        if index < len(ctx.finished):
            continue
        with ctx.shard(index) as shard:
            track = []
            for value in values[start:stop]:
                state += gain * value
                track.append(state)
            time.sleep(ctx.config.pause_s)
            shard.table(TRACKS).append({"value": track})
            shard.path("state.txt").write_text(str(state))
            ctx.progress(stop, len(values))


def last(ctx: StageContext) -> None:
    """A picture, so to say."""
    count_call(ctx, "last")
    values = ctx.read(TRACKS).read()["value"]
    with ctx.shard(0) as shard:
        shard.table(PICTURES).append({"value": values[-1:]})
        shard.path("map.png").write_text(f"{ctx.config.title} {ctx.log} {ctx.variant} {values}")


def _obey(ctx: StageContext, orders: str) -> None:
    if "refuse" in orders:
        raise LogRefusedError(f"No depth topic in `{ctx.log}`", hint="name it with `--topic depth=/depth`")
    if "bug" in orders:
        raise ZeroDivisionError("division by zero")
    if "full" in orders:
        raise OSError(errno.ENOSPC, "No space left on device")
    once = ctx.sources[0].with_suffix(".killed")
    if "kill-once" in orders:
        if not once.exists():
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    elif "kill" in orders:
        os.kill(os.getpid(), signal.SIGKILL)


FIRST = Stage(
    "first",
    version=1,
    config=FirstConfig,
    reads=(),
    writes=(NUMBERS, NOTES),
    entry="tests.fake_stages:first",
    unit="line",
    from_log=True,
    optional=(NOTES,),
)
SECOND = Stage(
    "second", version=1, config=SecondConfig, reads=(NUMBERS,), writes=(SUMS,), entry="tests.fake_stages:second"
)
THIRD = Stage(
    "third",
    version=1,
    config=ThirdConfig,
    reads=(SUMS,),
    writes=(TRACKS,),
    entry="tests.fake_stages:third",
    variants="kinds",
)
LAST = Stage(
    "last",
    version=1,
    config=LastConfig,
    reads=(TRACKS,),
    writes=(PICTURES,),
    entry="tests.fake_stages:last",
    unit="file",
)
FAKE_STAGES = (FIRST, SECOND, THIRD, LAST)


def make_log(folder: Path, name: str = "kitchen", orders: str = "plain", numbers: Sequence[int] = range(10)) -> Path:
    """Write a log of the given numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.mcap"
    path.write_text("\n".join([orders, *map(str, numbers)]) + "\n")
    return path


def with_version(stages: Sequence[Stage], name: str, version: int) -> tuple[Stage, ...]:
    """The stages with another version of one of them."""
    return tuple(replace(stage, version=version) if stage.name == name else stage for stage in stages)


def command_line(arguments: Sequence[Any]) -> list[str]:
    """A command that runs the real command line over the fake stages in a process of its own."""
    return [sys.executable, str(Path(__file__)), *map(str, arguments)]


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from semslam.pipeline.cli import main
    from tests.fake_stages import FAKE_STAGES as STAGES  # by its import name, which workers can find

    main(stages=STAGES)
