"""The training loop of all networks: warm-up and cosine rate, moving average of the weights, checkpoints, curves.

A batch is a function of the step alone, so that a run which was killed goes on as if nothing had happened: with the
same number of threads on the same machine the weights come out the same.
"""

from __future__ import annotations

import csv
import io
import math
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from semslam.errors import SemslamError

Batch = TypeVar("Batch")

CHECKPOINT = "checkpoint.pt"
"""The file of a run from which it goes on."""
_AHEAD = 3
_CURVES = "curves.csv"
_CLIP = 10.0


@dataclass(frozen=True)
class Schedule:
    """How long and how fast."""

    steps: int
    batch: int
    """Pictures a step."""
    seed: int = 1
    peak_rate: float = 2e-3
    """Of AdamW."""
    warm_up: int = 300
    """Steps until the peak."""
    end_share: float = 0.02
    """Of the peak rate, at the end."""
    weight_decay: float = 0.02
    average: float = 0.998
    """Weight of the past in the moving average of the weights; that average is what is kept."""
    checkpoint_s: float = 60.0
    """Seconds after which the next report saves a checkpoint, as the first one does."""
    report_every: int = 50
    """Steps between reports."""

    def rate(self, step: int) -> float:
        """Learning rate of a step, from 0."""
        if step < self.warm_up:
            return self.peak_rate * (step + 1) / self.warm_up
        done = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.peak_rate * (self.end_share + (1 - self.end_share) * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


@dataclass(frozen=True)
class Progress:
    """Where a run stands; for whoever watches."""

    step: int
    steps: int
    losses: Mapping[str, float]
    """Means since the last report."""
    steps_per_s: float


def fit(
    network: nn.Module,
    loss: Callable[[nn.Module, Batch], tuple[Tensor, Mapping[str, float]]],
    batch_of: Callable[[int], Batch],
    schedule: Schedule,
    folder: Path,
    *,
    facts: Mapping[str, Any],
    watch: Callable[[Progress], None] | None = None,
) -> nn.Module:
    """Train a network, or go on where a killed run was, and return the average of its weights, in evaluation mode.

    Args:
        network: as initialised from the seed; a checkpoint in the folder replaces its weights.
        loss: of the network on a batch: what is minimised, and parts of it to be told.
        batch_of: the batch of a step, from 0; a pure function, called ahead of time from a thread.
        schedule: how long and how fast.
        folder: gets `checkpoint.pt` and `curves.csv` (step, rate, losses).
        facts: what the run depends on (data, sizes); a checkpoint of other facts is refused.
        watch: hears of the progress at every report.

    Raises:
        SemslamError: the folder holds a checkpoint of another run, or the loss is no number.
    """
    folder.mkdir(parents=True, exist_ok=True)
    run = {**asdict(schedule), **facts}
    run.pop("checkpoint_s")
    run.pop("report_every")
    state = _State.start(network, schedule)
    _require_writable(folder)
    first = state.resume(folder / CHECKPOINT, run)
    curves = _Curves(folder / _CURVES, first)
    network.train()
    saved: float | None = None
    since, sums, counted = time.monotonic(), dict[str, float](), 0
    for step, batch in _ahead(batch_of, first, schedule.steps):
        value, parts = loss(network, batch)
        state.step(value, schedule.rate(step), step)
        for name, number in {"loss": float(value.detach()), **parts}.items():
            sums[name] = sums.get(name, 0.0) + number
        counted += 1
        last = step + 1 == schedule.steps
        if (step + 1) % schedule.report_every == 0 or last:
            means = {name: total / counted for name, total in sums.items()}
            curves.add(step + 1, schedule.rate(step), means)
            if watch:
                watch(Progress(step + 1, schedule.steps, means, counted / (time.monotonic() - since)))
            sums, counted, since = {}, 0, time.monotonic()
            if last or saved is None or time.monotonic() - saved > schedule.checkpoint_s:
                state.save(folder / CHECKPOINT, run, step + 1)
                saved = time.monotonic()
    trained: nn.Module = state.average.module
    return trained.eval()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a run left: `run` (what it depends on), `step`, and the states of network, average and optimizer.

    Raises:
        SemslamError: there is none, or it is damaged.
    """
    if not path.is_file():
        raise SemslamError(f"No checkpoint at `{path}`", hint="name the folder of a `semslam train` run")
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is not None:  # torch itself does not look at the checksums
                raise zipfile.BadZipFile
        stored: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        complete = _is_checkpoint(stored)
    except Exception as error:  # torch throws a dozen types without a common base
        raise SemslamError(
            f"Checkpoint `{path}` cannot be read", hint="remove it to begin again, or give another folder"
        ) from error
    if not complete:
        raise SemslamError(f"`{path}` is no checkpoint of a training", hint="name the folder of a `semslam train` run")
    return stored


def _is_checkpoint(stored: Any) -> bool:
    parts = {"run", "step", "network", "average", "optimizer"}
    if not isinstance(stored, dict) or not parts <= set(stored) or not isinstance(stored["run"], dict):
        return False
    return isinstance(stored["step"], int) and 0 <= stored["step"] <= stored["run"].get("steps", -1)


def _require_writable(folder: Path) -> None:
    """See that a checkpoint can be written before there is one to write.

    Raises:
        SemslamError: it cannot.
    """
    if (folder / CHECKPOINT).is_dir():
        raise SemslamError(f"`{folder / CHECKPOINT}` is a folder", hint="remove it, or give another `--out`")
    with tempfile.TemporaryFile(dir=folder):
        pass


@dataclass
class _State:
    """What a checkpoint holds."""

    network: nn.Module
    average: torch.optim.swa_utils.AveragedModel
    optimizer: torch.optim.Optimizer

    @staticmethod
    def start(network: nn.Module, schedule: Schedule) -> _State:
        decayed = [value for value in network.parameters() if value.ndim > 1]
        plain = [value for value in network.parameters() if value.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": schedule.weight_decay}, {"params": plain, "weight_decay": 0.0}]
        optimizer = torch.optim.AdamW(groups, lr=schedule.peak_rate)
        mean = torch.optim.swa_utils.get_ema_multi_avg_fn(schedule.average)
        average = torch.optim.swa_utils.AveragedModel(network, multi_avg_fn=mean, use_buffers=True)
        return _State(network, average, optimizer)

    def step(self, value: Tensor, rate: float, step: int) -> None:
        if not torch.isfinite(value):
            raise _diverged(f"loss of step {step}", value.item())
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        value.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        if not torch.isfinite(norm):  # weights would be spoilt, and the next checkpoint with them
            raise _diverged(f"gradient of step {step}", norm.item())
        self.optimizer.step()
        self.average.update_parameters(self.network)

    def resume(self, path: Path, run: Mapping[str, Any]) -> int:
        """Steps done by an earlier run in the same folder; 0 if there is none."""
        if not path.is_file():
            return 0
        stored = read_checkpoint(path)
        differing = sorted(name for name in {*run, *stored["run"]} if run.get(name) != stored["run"].get(name))
        if differing:
            was = ", ".join(f"{name} {stored['run'].get(name)} -> {run.get(name)}" for name in differing)
            raise SemslamError(
                f"Checkpoint `{path}` is of another run", details=was, hint="remove it, or give another folder"
            )
        try:
            self.network.load_state_dict(stored["network"])
            self.average.load_state_dict(stored["average"])
            self.optimizer.load_state_dict(stored["optimizer"])
        except (RuntimeError, ValueError, KeyError, TypeError) as error:
            raise SemslamError(
                f"Checkpoint `{path}` is of a network of another shape",
                hint="go on with the version of semslam that began it, or give another folder",
            ) from error
        return int(stored["step"])

    def save(self, path: Path, run: Mapping[str, Any], step: int) -> None:
        for name, weights in self.network.state_dict().items():
            if not bool(torch.isfinite(weights).all()):
                raise _diverged(f"weight `{name}` after step {step}", math.nan)
        temporary = path.with_name(f".{path.name}.partial-{os.getpid()}")
        content = {
            "run": dict(run),
            "step": step,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        packed = io.BytesIO()  # torch wraps what the disk says into errors of its own
        torch.save(content, packed)
        try:
            temporary.write_bytes(packed.getbuffer())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def _diverged(what: str, value: float) -> SemslamError:
    hint = "begin again with a lower `--rate` in another `--out`, or look at the data"
    return SemslamError(f"The {what} is {value}", hint=hint)


class _Curves:
    """A line of CSV a report; lines beyond the checkpoint that a run resumes from are dropped."""

    def __init__(self, path: Path, first: int) -> None:
        self._path = path
        rows = list(csv.reader(path.read_text().splitlines())) if path.is_file() and first else []
        done = {str(step) for step in range(first + 1)} | {"step"}
        self._rows = [row for row in rows if row and row[0] in done]

    def add(self, step: int, rate: float, losses: Mapping[str, float]) -> None:
        if not self._rows:
            self._rows.append(["step", "rate", *losses])
        self._rows.append([str(step), f"{rate:.3g}", *(f"{number:.5g}" for number in losses.values())])
        temporary = self._path.with_name(f".{self._path.name}.partial-{os.getpid()}")
        with temporary.open("w", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows(self._rows)
        temporary.replace(self._path)


def _ahead(batch_of: Callable[[int], Batch], first: int, steps: int) -> Iterator[tuple[int, Batch]]:
    """Batches in order, the next few made meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        waiting: list[tuple[int, Future[Batch]]] = []
        for step in range(first, steps):
            while len(waiting) <= _AHEAD and (ahead := step + len(waiting)) < steps:
                waiting.append((ahead, pool.submit(batch_of, ahead)))
            number, future = waiting.pop(0)
            yield number, future.result()
