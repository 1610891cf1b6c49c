"""Which networks the bench needs, and their trainings as parts."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from semslam.bench import trainings
from semslam.bench.jobs import Outcome
from semslam.bench.results import Trained
from semslam.bench.rows import ALL, DEEPVO, MAPNET, MAPPER, MAPPER_FAR, NOISE_ROWS, QUALITIES
from semslam.bench.store import Part
from semslam.bench.work import Work
from semslam.tables.spec import FRAMES

_QUICK_STEPS, _QUICK_LENGTH = 2, 3
"""Steps of a quick training, and keyframes of its sequences."""

Networks = dict[tuple[str, str, str, int], Outcome]
"""By kind, protocol, quality and seed."""


def train_networks(work: Work) -> Networks:
    """Train every network that anything asked for needs; without torch there are none, and the reason."""
    wanted = {(row.network, p, "real") for row in work.rows if row.network for p in work.protocols(row)}
    if work.with_maps:
        wanted |= {(MAPPER, "cross", quality) for quality in QUALITIES} | {(MAPPER_FAR, "cross", "real")}
    if work.with_noise:
        wanted |= {(ALL[name].network, "cross", "real") for name in NOISE_ROWS if ALL[name].network}
    parts = {(*one, seed): _training(work, *one, seed) for seed in work.seeds for one in sorted(wanted)}
    if find_spec("torch") is None:
        reason = "torch is not installed: `pip install 'semslam[train]'`"
        return {name: Outcome(part, work.store.result(part), reason) for name, part in parts.items()}
    outcomes = work.do(list(parts.values()))
    return {name: outcomes[part.key] for name, part in parts.items()}


def model_of(work: Work, outcome: Outcome) -> Path | None:
    """The file of a trained network; None if there is none."""
    return (work.store.folder(outcome.part) / outcome.result["model"]).resolve() if outcome.result else None


def costs(work: Work, networks: Networks) -> Iterator[Trained]:
    """What the trainings cost."""
    for (kind, protocol, quality, seed), outcome in networks.items():
        seconds = work.store.seconds(outcome.part)
        if outcome.result and seconds is not None:
            yield Trained(kind, protocol, quality, seed, seconds, int(outcome.result["bytes"]))


def _training(work: Work, kind: str, protocol: str, quality: str, seed: int) -> Part:
    """The training of one network."""
    logs, quick = work.dataset.train[protocol], work.request.quick
    shared = {
        "kind": kind,
        "seed": seed,
        "steps": _QUICK_STEPS if quick else None,
        "length": _QUICK_LENGTH if quick else None,
        "logs": list(logs),
        "device": work.request.device,
    }
    facts: dict[str, Any] = {**shared, "version": trainings.VERSION}
    arguments: dict[str, Any] = {**shared, "dataset": str(work.dataset.root)}
    if kind in trainings.MAPPERS:
        paper = {**work.paper(), **trainings.MAPPERS[kind].paper}
        own = {"quality": quality, "paper": paper}
        facts |= {**own, "inputs": work.inputs(logs, observed=quality == "real")}
        arguments |= {**own, "run": work.run_files(logs)}
    elif kind in (MAPNET, DEEPVO):
        facts["inputs"] = work.inputs(logs, observed=False)
        frames = {log: work.files(log, FRAMES) for log in logs}
        arguments |= {"frames": frames, "cache": str(work.request.out / "pictures")}
    title = f"train {kind} ({protocol}-scene, {quality}, seed {seed})"
    return Part("networks", title, facts, trainings.TASK, arguments)
