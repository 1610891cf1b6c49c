"""Table 4: which maps are built from which observations, as parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from semslam.bench import maps, trainings
from semslam.bench.networks import Networks, model_of
from semslam.bench.results import MapResult, NotRun
from semslam.bench.rows import CONVLSTM, FAR, LEAKS, MAPPER, MAPPER_FAR, QUALITIES, QUALITY_TITLES, leaky_name
from semslam.bench.store import Part
from semslam.bench.work import Work, where


@dataclass(frozen=True)
class _Sight:
    """What a map is built from, and the network that learned from the same."""

    quality: str
    network: str
    paper: Mapping[str, Any]


_SIGHTS = {
    **{quality: _Sight(quality, MAPPER, {}) for quality in QUALITIES},
    FAR: _Sight("real", MAPPER_FAR, trainings.MAPPERS[MAPPER_FAR].paper),
}


def build_maps(work: Work, networks: Networks, missing: list[NotRun]) -> Iterator[MapResult]:
    """Maps at true poses across scenes: the ConvLSTM of every seed, and the heuristics."""
    parts: dict[tuple[str, str, int], Part] = {}
    for name, sight in _SIGHTS.items():
        for leak in LEAKS:
            parts[leaky_name(leak), name, 0] = _part(work, leaky_name(leak), name, 0, leak=leak)
        for seed in work.seeds:
            outcome = networks[sight.network, "cross", sight.quality, seed]
            model = model_of(work, outcome)
            if model is None or outcome.result is None:
                missing.append(NotRun(CONVLSTM, where(name, seed), outcome.reason))
            else:
                learned = {"update": "learned", "model": str(model)}
                digest = str(outcome.result["digest"])
                parts[CONVLSTM, name, seed] = _part(work, CONVLSTM, name, seed, digest=digest, **learned)
    outcomes = work.do(list(parts.values()))
    for (method, name, seed), part in parts.items():
        outcome = outcomes[part.key]
        if outcome.result is None:
            missing.append(NotRun(method, where(name, seed), outcome.reason))
        else:
            yield MapResult(method, name, seed, outcome.result)


def _part(work: Work, method: str, name: str, seed: int, *, digest: str = "", **changes: Any) -> Part:
    logs, sight = work.dataset.test["cross"], _SIGHTS[name]
    paper = {**work.paper(), **sight.paper, **changes}
    shared = {"logs": list(logs), "quality": sight.quality, "steps": work.request.steps}
    facts = {
        **shared,
        "version": maps.VERSION,
        "method": method,
        "network": digest,
        "paper": {**paper, "model": ""},
        "inputs": work.inputs(logs, observed=sight.quality == "real"),
    }
    arguments = {**shared, "dataset": str(work.dataset.root), "run": work.run_files(logs), "paper": paper}
    title = f"maps of {method}, {QUALITY_TITLES[name]}" + (f", seed {seed}" if seed else "")
    return Part("maps", title, facts, maps.TASK, arguments)
