"""Tracks of all rows of the tables: references, estimators through the pipeline, and peers."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from semslam.bench import peers
from semslam.bench.jobs import Outcome
from semslam.bench.networks import Networks, model_of
from semslam.bench.results import NotRun
from semslam.bench.rows import Row
from semslam.bench.store import Part
from semslam.bench.tracks import TrackScore, column_track, reference_errors, scored, stored_track, true_track
from semslam.bench.work import Work, where
from semslam.errors import SemslamError
from semslam.metrics import Errors, Track, errors
from semslam.tables.spec import FRAMES, MOTION, POSES


def row_tracks(work: Work, networks: Networks, missing: list[NotRun]) -> Iterator[TrackScore]:
    """Scores of every row on every log that tests; what could not be run is added to `missing`."""
    for row in work.rows:
        if row.peer:
            yield from _peer(work, row, missing)
            continue
        for protocol in work.protocols(row):
            if row.reference:
                yield from _reference(work, row, protocol)
            for seed in work.seeds if row.network else (0,) if row.estimator else ():
                yield from _estimator(work, row, protocol, seed, networks, missing)


def settings_of(work: Work, row: Row, protocol: str, seed: int, networks: Networks) -> dict[str, Any]:
    """What a row changes of the configuration.

    Raises:
        SemslamError: its network could not be trained.
    """
    settings = {
        "localize.estimators": [row.estimator],
        "localize.max_keyframes": work.request.steps,
        **row.settings,
    }
    if row.network:
        outcome = networks[row.network, protocol, "real", seed]
        model = model_of(work, outcome)
        if model is None:
            raise SemslamError(outcome.reason)
        settings[row.model_key] = str(model)
    return settings


def track_errors(truth: Track, found: Track | None) -> Errors:
    """Errors of a track; none of no track."""
    if found is None:
        return Errors(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    return errors(truth, found)


def _reference(work: Work, row: Row, protocol: str) -> Iterator[TrackScore]:
    paper = work.pipeline.paper()
    half_m = paper.cell_m * paper.map_side / 2
    for log in work.dataset.test[protocol]:
        truth = true_track(work.dataset.root, log, work.request.steps)
        yield scored(row, protocol, 0, log, truth, reference_errors(row, truth, half_m))


def _estimator(
    work: Work, row: Row, protocol: str, seed: int, networks: Networks, missing: list[NotRun]
) -> Iterator[TrackScore]:
    """Tracks of a row with one seed; a log that failed has no pose."""
    logs, started = work.dataset.test[protocol], time.monotonic()
    name = f"{row.name}, {protocol}-scene" + (f", seed {seed}" if seed else "")
    try:
        runs = work.pipeline.run("localize", logs, settings_of(work, row, protocol, seed, networks))
    except SemslamError as error:
        missing.append(NotRun(row.name, where(protocol, seed), error.in_a_line))
        work.console.say(f"localize {name}: not run, {error.message}")
        return
    if runs.failures:
        missing.append(NotRun(row.name, where(protocol, seed), _first_of(runs.failures, len(logs))))
    work.console.say(f"localize {name}: {len(logs) - len(runs.failures)} logs, {time.monotonic() - started:.1f} s")
    for log in logs if len(runs.failures) < len(logs) else ():
        truth = true_track(work.dataset.root, log, work.request.steps)
        files = runs.files(log, POSES)
        yield scored(
            row, protocol, seed, log, truth, track_errors(truth, stored_track(files, truth) if files else None)
        )


def _first_of(failures: Mapping[str, str], logs: int) -> str:
    """How many logs failed, and why the first did."""
    log, reason = next(iter(failures.items()))
    return f"{len(failures)} of {logs} logs failed; `{log}`: {reason}"


def _peer(work: Work, row: Row, missing: list[NotRun]) -> Iterator[TrackScore]:
    """Tracks of somebody else's package; a crash on a log is coverage 0 there."""
    protocols = list(work.protocols(row))
    if not peers.installed(row.peer):
        reason = f"not installed: `pip install {row.peer.replace('kiss_', 'kiss-')}`"
        missing += [NotRun(row.name, protocol, reason) for protocol in protocols]
        return
    logs = sorted({log for protocol in protocols for log in work.dataset.test[protocol]})
    parts = {log: _peer_part(work, row, log) for log in logs}
    outcomes = work.do(list(parts.values()), apart=True)
    for protocol in protocols:
        yield from _peer_scores(work, row, protocol, {log: outcomes[part.key] for log, part in parts.items()}, missing)


def _peer_scores(
    work: Work, row: Row, protocol: str, outcomes: Mapping[str, Outcome], missing: list[NotRun]
) -> Iterator[TrackScore]:
    logs = work.dataset.test[protocol]
    failures = {log: outcomes[log].reason for log in logs if outcomes[log].result is None}
    if failures:
        missing.append(NotRun(row.name, protocol, _first_of(failures, len(logs))))
    for log in logs:
        truth = true_track(work.dataset.root, log, work.request.steps)
        result = outcomes[log].result
        found = track_errors(truth, column_track(result, truth) if result else None)
        yield scored(row, protocol, 0, log, truth, found)


def _peer_part(work: Work, row: Row, log: str) -> Part:
    facts = {
        "peer": row.peer,
        "package": peers.version(row.peer),
        "version": peers.VERSION,
        "ingest": work.seen.keys([log], "ingest"),
        "steps": work.request.steps,
    }
    arguments = {
        "peer": row.peer,
        "steps": work.request.steps,
        "frames": work.files(log, FRAMES),
        "motion": work.files(log, MOTION),
    }
    return Part("peers", f"{row.peer} on {log}", facts, peers.TASK, arguments, peers.TIMEOUT_S)
