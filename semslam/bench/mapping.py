"""Table 4: which maps are built from which observations, as parts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from semslam.bench import maps
from semslam.bench.networks import Networks, model_of
from semslam.bench.results import MapResult, NotRun
from semslam.bench.rows import CONVLSTM, LEAKS, MAPPER, QUALITIES, leaky_name
from semslam.bench.store import Part
from semslam.bench.work import Work, where


def build_maps(work: Work, networks: Networks, missing: list[NotRun]) -> Iterator[MapResult]:
    """Maps at true poses across scenes: the ConvLSTM of every seed, and the heuristics."""
    parts: dict[tuple[str, str, int], Part] = {}
    for quality in QUALITIES:
        for leak in LEAKS:
            parts[leaky_name(leak), quality, 0] = _part(work, leaky_name(leak), quality, 0, leak=leak)
        for seed in work.seeds:
            outcome = networks[MAPPER, "cross", quality, seed]
            model = model_of(work, outcome)
            if model is None or outcome.result is None:
                missing.append(NotRun(CONVLSTM, where(quality, seed), outcome.reason))
            else:
                learned = {"update": "learned", "model": str(model)}
                digest = str(outcome.result["digest"])
                parts[CONVLSTM, quality, seed] = _part(work, CONVLSTM, quality, seed, digest=digest, **learned)
    outcomes = work.do(list(parts.values()))
    for (method, quality, seed), part in parts.items():
        outcome = outcomes[part.key]
        if outcome.result is None:
            missing.append(NotRun(method, where(quality, seed), outcome.reason))
        else:
            yield MapResult(method, quality, seed, outcome.result)


def _part(work: Work, method: str, quality: str, seed: int, *, digest: str = "", **changes: Any) -> Part:
    logs = work.dataset.test["cross"]
    paper = {**work.paper(), **changes}
    shared = {"logs": list(logs), "quality": quality, "steps": work.request.steps}
    facts = {
        **shared,
        "version": maps.VERSION,
        "method": method,
        "network": digest,
        "paper": {**paper, "model": ""},
        "inputs": work.inputs(logs, observed=quality == "real"),
    }
    arguments = {**shared, "dataset": str(work.dataset.root), "run": work.run_files(logs), "paper": paper}
    title = f"maps of {method}, {quality}" + (f", seed {seed}" if seed else "")
    return Part("maps", title, facts, maps.TASK, arguments)
