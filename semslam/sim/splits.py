"""Which logs of a data set train and which test, for the two protocols of the paper.

Reads and writes `splits` (data_spec.md, table 12). *Intra-scene*: the last trajectory of every scene tests.
*Cross-scene*: whole scenes test, with all days and variants of them, because those share materials and furniture, and
most of them walls.
"""

from __future__ import annotations

import difflib
import itertools
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from semslam.errors import SemslamError, UsageError
from semslam.tables.parquet import TableFiles, write_table
from semslam.tables.spec import SPLITS

PROTOCOLS = ("intra", "cross")
PARTS = ("train", "test")
TEST_SHARE = 4 / 30
"""Share of the scenes that test across scenes: 4 of the paper's 30."""
_STREAM = 0x5B117
"""Of the draw of test scenes; no other random number of the simulator comes from it."""


class Recorded(Protocol):
    """What a split needs to know of a log."""

    @property
    def name(self) -> str: ...
    @property
    def variant(self) -> str: ...
    @property
    def scene(self) -> int: ...
    @property
    def day(self) -> int: ...
    @property
    def trajectory(self) -> int: ...


@dataclass(frozen=True)
class Split:
    """One row of the table: a log and its side of each protocol."""

    log: str
    variant: str
    scene: int
    day: int
    trajectory: int
    intra: str | None
    cross: str | None


def assign(recordings: Sequence[Recorded], seed: int) -> list[Split]:
    """The side of every log, in the order given. With one trajectory there is no `intra`, with one scene no `cross`."""
    last = max((one.trajectory for one in recordings), default=0)
    testing = held_out_scenes(max((one.scene for one in recordings), default=0) + 1, seed)
    return [
        Split(
            one.name,
            one.variant,
            one.scene,
            one.day,
            one.trajectory,
            _part(one.trajectory == last) if last else None,
            _part(one.scene in testing) if testing else None,
        )
        for one in recordings
    ]


def held_out_scenes(scenes: int, seed: int) -> tuple[int, ...]:
    """Scenes that test across scenes, rising; none of fewer than two.

    One of every 7.5 scenes in a row, drawn from `seed`: 4 of 30. The side of a scene depends on nothing else, so that a
    data set that grows never trains with what has tested, nor the other way round. The first is one of the first two.
    """
    if scenes < 2:
        return ()
    edges = [round(block / TEST_SHARE) for block in range(round(TEST_SHARE * scenes) + 2)]
    rng = np.random.default_rng([seed, _STREAM])
    drawn = [int(rng.integers(low, high if low else 2)) for low, high in itertools.pairwise(edges)]
    return tuple(scene for scene in drawn if scene < scenes)


def _part(test: bool) -> str:
    return PARTS[test]


def write_splits(path: Path, splits: Sequence[Split], seed: int) -> None:
    """Write the table, whole or not at all.

    Raises:
        SemslamError: a scene or a trajectory would be on both sides.
    """
    refuse_mixed(splits, str(path))
    temporary = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        columns = [column.name for column in SPLITS.columns]
        write_table(temporary, SPLITS, {c: [getattr(one, c) for one in splits] for c in columns}, {"seed": seed})
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_splits(path: Path) -> list[Split]:
    """All rows of a splits table.

    Raises:
        SemslamError: the file is missing, damaged or no splits table, or has one thing on both sides.
    """
    rows = TableFiles(SPLITS, [path]).read()
    splits = [Split(**_row(rows, index)) for index in range(len(rows["log"]))]
    refuse_mixed(splits, str(path))
    return splits


def load_split(path: Path, protocol: str, part: str) -> list[str]:
    """Names of the logs that train or test under a protocol, in the order of the data set.

    Args:
        path: `splits.parquet` of a data set.
        protocol: `intra` or `cross`.
        part: `train` or `test`.

    Raises:
        UsageError: no such protocol or part, or the data set is too small for the protocol.
        SemslamError: the file is damaged, or has one thing on both sides.
    """
    _known(protocol, PROTOCOLS, "protocol")
    _known(part, PARTS, "part")
    splits = read_splits(path)
    if splits and all(getattr(one, protocol) is None for one in splits):
        what = "trajectories" if protocol == "intra" else "scenes"
        raise UsageError(
            f"`{path}` has no split `{protocol}`: the data set has fewer than two {what}",
            hint=f"make a larger one with `semslam simulate --{what} 2`",
        )
    return [one.log for one in splits if getattr(one, protocol) == part]


def refuse_mixed(splits: Sequence[Split], where: str) -> None:
    """Refuse what no honest comparison may have.

    Raises:
        SemslamError: a log stands twice, a side is neither train, test nor null, a scene trains and tests across
            scenes, or a trajectory trains and tests within them.
    """
    _refuse_twice([one.log for one in splits], where)
    for protocol in PROTOCOLS:
        for one in splits:
            if getattr(one, protocol) not in (*PARTS, None):
                raise _bad(where, f"`{getattr(one, protocol)}` of `{one.log}` is no part of `{protocol}`")
    _refuse_both(((one.scene, one.cross) for one in splits), "cross", "scene", where)
    drives = (((one.scene, one.trajectory), one.intra) for one in splits)
    _refuse_both(drives, "intra", "trajectory (scene, number)", where)


def _refuse_twice(names: Sequence[str], where: str) -> None:
    for name, times in Counter(names).items():
        if times > 1:
            raise _bad(where, f"log `{name}` stands in it {times} times")


def _refuse_both(sides: Iterable[tuple[Any, str | None]], protocol: str, what: str, where: str) -> None:
    """Every key has one side."""
    seen: dict[Any, str | None] = {}
    for key, side in sides:
        if seen.setdefault(key, side) != side:
            raise _bad(where, f"{what} {key} is on both sides of `{protocol}`")


def _bad(where: str, reason: str) -> SemslamError:
    hint = "let `semslam simulate` with the options of the data set write it again"
    return SemslamError(f"Splits table `{where}` must not be used: {reason}", hint=hint)


def _known(name: str, names: Sequence[str], what: str) -> None:
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
        hint = f"did you mean `{close[0]}`?" if close else f"use {' or '.join(f'`{one}`' for one in names)}"
        raise UsageError(f"No {what} `{name}` of splits", hint=hint)


def _row(rows: Mapping[str, Sequence[Any]], index: int) -> dict[str, Any]:
    return {name: values[index] for name, values in rows.items()}
