"""Training of the map update (equation 8): true poses first, then more and more of its own.

A batch is some whole drives. The map grows step by step along each; at every step it is compared with the class map of
what had been visible by then (equation 9), over the cells that have been inside a region of interest so far: no others
could have been filled. Gradients flow back through a few steps only (truncated backpropagation through time).

With true poses the map is built where things are (teacher forcing). At run time it is built where the estimator
believes itself, so later in the training a growing share of the steps takes the network's own pose (scheduled
sampling): the one that the visual-inertial step finds in the map as it stands, from the pose of the step before. No
gradient flows through poses.

Every drive comes in the eight symmetries of the square, which are exact on a grid: four quarter turns of the map frame
and the mirror.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from semslam.labels import UNOBSERVED
from semslam.models.nets.semantic_slam import (
    Grid,
    MapState,
    MapUpdate,
    Matching,
    localise,
    map_loss,
    roi_cells,
    roi_mask,
    rotate_by,
    start_state,
    update_map,
)
from semslam.models.training.drives import Drive, DriveSet, mirrored, shortened, turned
from semslam.models.training.export import export_onnx
from semslam.models.training.trainer import Progress, Schedule, fit
from semslam.stages.settings import PaperConfig

MAP_UPDATE = "map_update.onnx"
USUAL = Schedule(steps=600, batch=8, peak_rate=6e-3, warm_up=30, average=0.98, report_every=20)
_TRACE = 2.0**-21
LEAKS = (0.1, 0.3, 0.7, 1.0)
"""alpha of the heuristic maps (equation 10) that a trained network is judged beside."""


@dataclass(frozen=True)
class MapperOptions:
    """What a map update is trained for."""

    paper: PaperConfig = field(default_factory=PaperConfig)
    """Cells, heading bins, temperature and gates of the estimator that will use it."""
    kernel: int = 3
    """Cells along a side of the convolutions; 1 makes it an LSTM a cell."""
    own_share: float = 0.5
    """Share of the steps of a drive that take the network's own pose at the end of the training; 0 never does."""
    teacher_share: float = 0.5
    """Share of the training that takes true poses alone; from then on the share of own ones rises steadily."""
    own_headings: int = 36
    """Heading bins for own poses in training. The estimator's R times as many cost as many times more, and half a bin
    (5 degrees) lies within the gate of equation 4."""
    truncate: int = 10
    """Steps through which gradients flow back."""
    length: int | None = 40
    """Keyframes of a drive that are learned from, from its start; None takes all. Most of a map is made in its first
    half, and half the keyframes take half the time."""

    @property
    def matching(self) -> Matching:
        """How own poses are found."""
        paper = self.paper
        return Matching(paper.temperature, paper.gate_distance_m, paper.gate_heading_rad, paper.gate)

    def grid(self, headings: int) -> Grid:
        """Pose bins."""
        return Grid(headings, self.paper.map_side, self.paper.cell_m)

    def own_odds(self, done: float) -> float:
        """How likely a step takes the network's own pose, after this share of the training."""
        return self.own_share * min(1.0, max(0.0, done - self.teacher_share) / max(1e-9, 1.0 - self.teacher_share))


@dataclass(frozen=True, eq=False)
class DriveBatch:
    """N drives of up to T steps; shorter ones end with steps that do not count."""

    observations: Tensor
    """(T, N, L, h, h)"""
    seen: Tensor
    """(T, N) whether there is an observation."""
    alive: Tensor
    """(T, N) whether the step is part of the drive."""
    poses: Tensor
    """(T, N, 3) true ones."""
    motion: Tensor
    """(T, N, 3)"""
    own: Tensor
    """(T, N) whether the step takes the network's own pose."""
    labels: Tensor
    """(N, H, W)"""
    first_seen: Tensor
    """(N, H, W)"""

    def to(self, device: torch.device) -> DriveBatch:
        """The batch on a device."""
        return DriveBatch(**{name: value.to(device) for name, value in vars(self).items()})


@dataclass(eq=False)
class DriveBatches:
    """Makes the batch of any step; a pure function of seed and step. Every epoch sees each drive once."""

    drives: Sequence[Drive]
    options: MapperOptions
    steps: int
    batch: int
    seed: int

    def __call__(self, step: int) -> DriveBatch:
        rng = np.random.default_rng([self.seed, 0x3A9, step])
        chosen = [self._symmetric(self.drives[index], rng) for index in self._indices(step)]
        return collated(chosen, rng, self.options.own_odds(step / self.steps))

    def _indices(self, step: int) -> list[int]:
        """The drives of a step: the next ones of an endless row of shuffled sets."""
        places = range(step * self.batch, (step + 1) * self.batch)
        epochs = {place // len(self.drives) for place in places}
        orders = {
            epoch: np.random.default_rng([self.seed, 0x0E9, epoch]).permutation(len(self.drives)) for epoch in epochs
        }
        return [int(orders[place // len(self.drives)][place % len(self.drives)]) for place in places]

    @staticmethod
    def _symmetric(drive: Drive, rng: np.random.Generator) -> Drive:
        """One of the eight symmetries of the square."""
        quarters, mirror = rng.integers(4), rng.random() < 0.5
        return turned(mirrored(drive) if mirror else drive, int(quarters))


def collated(drives: Sequence[Drive], rng: np.random.Generator | None = None, own_odds: float = 0.0) -> DriveBatch:
    """Drives as tensors.

    Steps that take own poses are drawn from `rng`; never a first one, nor one whose motion is unknown.
    """
    steps = max(len(drive) for drive in drives)
    motion = _stacked([drive.motion for drive in drives], steps)
    own = np.zeros(motion.shape[:2], bool) if rng is None else rng.random(motion.shape[:2]) < own_odds
    own &= np.isfinite(motion).all(2)
    own[0] = False
    return DriveBatch(
        observations=torch.from_numpy(_stacked([drive.observations for drive in drives], steps)),
        seen=torch.from_numpy(_stacked([drive.sights.seen for drive in drives], steps)),
        alive=torch.from_numpy(_stacked([np.ones(len(drive), bool) for drive in drives], steps)),
        poses=torch.from_numpy(_stacked([drive.poses for drive in drives], steps)),
        motion=torch.from_numpy(np.nan_to_num(motion)),
        own=torch.from_numpy(own),
        labels=torch.from_numpy(np.stack([drive.labels for drive in drives])),
        first_seen=torch.from_numpy(np.stack([drive.first_seen for drive in drives])),
    )


def _stacked(parts: Sequence[NDArray[Any]], steps: int) -> NDArray[Any]:
    """Arrays (t, ...) of several drives as one (steps, N, ...), padded with zeros."""
    result = np.zeros((steps, len(parts), *parts[0].shape[1:]), parts[0].dtype)
    for index, part in enumerate(parts):
        result[: len(part), index] = part
    return result


@dataclass(frozen=True)
class Grown:
    """Maps of a few steps."""

    first: int
    """Step of the first."""
    logits: Tensor
    """(S, N, L, H, W) of the read-out."""
    visited: Tensor
    """(S, N, H, W) cells that have been inside a region of interest so far."""
    poses: Tensor
    """(S, N, 3) where the maps were changed."""


def grow(network: MapUpdate, batch: DriveBatch, options: MapperOptions) -> Iterator[Grown]:
    """Build the maps of a batch, `options.truncate` steps at a time; gradients end where a piece begins."""
    steps, drives = batch.seen.shape
    grid = options.grid(options.paper.headings)
    flat = grid.bins(batch.poses.flatten(0, 1))
    bins = flat.unflatten(0, (steps, drives))  # (T, N, 3)
    placed = rotate_by(batch.observations.flatten(0, 1), grid.angles(flat)).unflatten(0, (steps, drives))
    state = network.start(drives, grid.side)
    visited = torch.zeros(drives, grid.side, grid.side, dtype=torch.bool, device=bins.device)
    last = batch.poses[0]
    for first in range(0, steps, options.truncate):
        state, hidden, seen, poses = state.detached(), [], [], []
        for step in range(first, min(steps, first + options.truncate)):
            last, here, there = _stand(network, batch, step, last, state, (bins[step], placed[step]), options)
            active = batch.seen[step] & batch.alive[step]
            state = update_map(network, there, state, here, grid.side, active)
            visited = visited | (roi_mask(here, options.paper.side, grid.side) & active[:, None, None])
            hidden.append(state.hidden[..., :-1])
            seen.append(visited)
            poses.append(last)
        logits = network.logits(torch.stack(hidden)).unflatten(3, (grid.side, grid.side))
        yield Grown(first, logits, torch.stack(seen), torch.stack(poses))


def _stand(
    network: MapUpdate,
    batch: DriveBatch,
    step: int,
    last: Tensor,
    state: MapState,
    true: tuple[Tensor, Tensor],
    options: MapperOptions,
) -> tuple[Tensor, Tensor, Tensor]:
    """Where each drive stands at a step: pose (N, 3), bins (N, 3) and what is placed there (N, L, h, h).

    The true ones, or its own for drives that take those. Without an observation the pose is inertial.
    """
    own = (batch.own[step] & batch.alive[step]).nonzero()[:, 0]
    poses, (bins, placed) = batch.poses[step], true
    if not len(own):
        return poses, bins, placed
    grid = options.grid(options.own_headings)
    with torch.no_grad():
        maps = network.logits(state.hidden[own, :, :-1]).softmax(1).unflatten(2, (grid.side, grid.side))
        planes = batch.observations[step, own]
        found, laid = localise(planes, maps, last[own], batch.motion[step, own], grid, options.matching)
    poses = poses.index_copy(0, own, found)
    return poses, bins.index_copy(0, own, grid.bins(found)), placed.index_copy(0, own, laid)


def visible(batch: DriveBatch, first: int, steps: int) -> Tensor:
    """(S, N, H, W) class maps visible so far, at steps from `first` on."""
    step = torch.arange(first, first + steps, device=batch.labels.device)[:, None, None, None]
    return torch.where(batch.first_seen <= step, batch.labels, UNOBSERVED)


def mapping_loss(network: nn.Module, batch: DriveBatch, options: MapperOptions) -> tuple[Tensor, Mapping[str, float]]:
    """Equation 9 over the steps of a batch, as a mean over cells, steps and drives; and the share of visited cells
    whose most likely class is the true one, every `options.truncate` steps."""
    mapper = map_update(network)
    batch = batch.to(mapper.log_kappa.device)
    lost, right, counted = torch.zeros((), device=batch.labels.device), 0.0, 0
    for grown in grow(mapper, batch, options):
        steps = len(grown.logits)
        alive = batch.alive[grown.first : grown.first + steps]
        truth = visible(batch, grown.first, steps)
        lost = lost + (map_loss(grown.logits, truth, grown.visited) * alive).sum()
        there = grown.visited[-1] & alive[-1, :, None, None]  # the last step alone: finding the best class is slow
        right += float(((grown.logits[-1].argmax(1) == truth[-1]) & there).sum())
        counted += int(there.sum())
    return lost / batch.alive.sum(), {"right": right / max(1, counted)}


def new_map_update(classes: int, kernel: int, seed: int) -> MapUpdate:
    """A map update as initialised from a seed."""
    torch.manual_seed(seed)
    return MapUpdate(classes, kernel)


def map_update(network: nn.Module) -> MapUpdate:
    """The network as what it must be."""
    if not isinstance(network, MapUpdate):
        raise TypeError("not a map update of ours")
    return network


def train_mapper(
    drives: DriveSet,
    out: Path,
    *,
    schedule: Schedule = USUAL,
    options: MapperOptions | None = None,
    device: str = "cpu",
    watch: Callable[[Progress], None] | None = None,
) -> Path:
    """Train a map update and export it as `map_update.onnx`. A run that was killed goes on where it was.

    Args:
        drives: what to learn from. Without motion there are no own poses: true ones are taken to the end.
        out: folder of the run.
        schedule: how long and how fast; `batch` counts drives.
        options: what it is trained for; its cells and thresholds are those of the drives, whatever it says.
        device: cpu or cuda. Threads are those of torch (`torch.set_num_threads`).
        watch: hears of the progress.

    Raises:
        SemslamError: the folder holds another run, or the loss is no number.
    """
    chosen = options_for(drives, options)
    network = new_map_update(len(drives.classes), chosen.kernel, schedule.seed).to(torch.device(device))
    learned = [shortened(one, chosen.length) if chosen.length else one for one in drives.drives]
    batches = DriveBatches(learned, chosen, schedule.steps, schedule.batch, schedule.seed)
    facts = {"task": "mapper", "classes": list(drives.classes), "data": drives.digest, "options": _facts(chosen)}
    trained = fit(network, partial(mapping_loss, options=chosen), batches, schedule, out, facts=facts, watch=watch)
    export_map_update(map_update(trained), out / MAP_UPDATE, drives, chosen)
    return out / MAP_UPDATE


def options_for(drives: DriveSet, options: MapperOptions | None = None) -> MapperOptions:
    """Options with the drives' cells, and without own poses where nobody knows how the robot moved."""
    given = options or MapperOptions(paper=drives.paper)
    same = {name: getattr(drives.paper, name) for name in ("cell_m", "side", "noise_floor", "binary")}
    paper = replace(given.paper, **same, map_side=drives.map_side)
    return replace(given, paper=paper, own_share=given.own_share if drives.has_motion else 0.0)


def _facts(options: MapperOptions) -> dict[str, Any]:
    """What a training depends on; `update`, `leak` and `model` are of other estimators."""
    facts = {name: value for name, value in asdict(options).items() if value is not None}
    for name in ("update", "leak", "model"):
        facts["paper"].pop(name, None)
    return facts


@dataclass(frozen=True)
class MapScore:
    """How good maps built with true poses are, as means over cells that have been visited, steps and drives."""

    cross_entropy: float | None
    """In nats; None for a heuristic map, which is no probability."""
    squared_error: float
    """Mean over classes and cells of (map - one-hot truth)^2."""


def judged(network: MapUpdate, drives: DriveSet, options: MapperOptions) -> dict[str, MapScore]:
    """The network, and the heuristics of equation 10 on the same steps, with true poses."""
    sums = {name: [0.0, 0.0] for name in ("network", *(f"leaky {leak:g}" for leak in LEAKS))}
    steps = 0
    with torch.no_grad():
        for drive in drives.drives:
            batch = collated([drive])
            steps += len(drive)
            leaky = _leaky_maps(batch, options)
            for grown in grow(network, batch, options):
                truth = visible(batch, grown.first, len(grown.logits))
                sums["network"][0] += float(map_loss(grown.logits, truth, grown.visited).sum())
                sums["network"][1] += float(_squared(grown.logits.softmax(2), truth, grown.visited).sum())
                for leak, maps in zip(LEAKS, leaky, strict=True):
                    part = maps[grown.first : grown.first + len(grown.logits)]
                    sums[f"leaky {leak:g}"][1] += float(_squared(part, truth, grown.visited).sum())
    return {
        name: MapScore(lost / steps if name == "network" else None, squared / steps)
        for name, (lost, squared) in sums.items()
    }


def score_table(scores: Mapping[str, MapScore]) -> str:
    """The scores as a Markdown table."""
    rows = ["| map | cross-entropy, nats | squared error x 100 |", "|---|---|---|"]
    for name, score in scores.items():
        entropy = "-" if score.cross_entropy is None else f"{score.cross_entropy:.3f}"
        rows.append(f"| {name} | {entropy} | {100 * score.squared_error:.2f} |")
    return "\n".join(rows)


def _squared(maps: Tensor, truth: Tensor, counted: Tensor) -> Tensor:
    """(S, N, L, H, W), (S, N, H, W), (S, N, H, W) -> (S, N) mean over the cells that count and the classes."""
    wanted = nn.functional.one_hot(truth, maps.shape[2]).movedim(-1, 2)
    error = ((maps - wanted) ** 2).mean(2)
    return (error * counted).sum((-2, -1)) / counted.sum((-2, -1)).clamp(min=1)


def _leaky_maps(batch: DriveBatch, options: MapperOptions) -> list[Tensor]:
    """(T, N, L, H, W) of every leak: equation 10 with true poses, where anything but *unobserved* was placed.

    Weights below `_TRACE` are none: run time rounds them away, and here they are rounding errors of the rotation.
    """
    grid, (steps, drives) = options.grid(options.paper.headings), batch.seen.shape
    maps = [_untouched(batch, grid.side) for _ in LEAKS]
    stories: list[list[Tensor]] = [[] for _ in LEAKS]
    for step in range(steps):
        bins = grid.bins(batch.poses[step])
        placed = rotate_by(batch.observations[step], grid.angles(bins))
        laid = _laid_out(placed, bins, grid.side)
        touched = (laid[:, UNOBSERVED + 1 :] > _TRACE).any(1, keepdim=True) & batch.seen[step].view(drives, 1, 1, 1)
        for index, leak in enumerate(LEAKS):
            maps[index] = torch.where(touched, (1 - leak) * maps[index] + leak * laid, maps[index])
            stories[index].append(maps[index])
    return [torch.stack(story) for story in stories]


def _untouched(batch: DriveBatch, side: int) -> Tensor:
    world = torch.zeros(batch.seen.shape[1], batch.observations.shape[2], side, side)
    world[:, UNOBSERVED] = 1.0
    return world


def _laid_out(placed: Tensor, bins: Tensor, side: int) -> Tensor:
    """(N, L, h, h) about the bins, on whole maps (N, L, H, W)."""
    drives, classes, rows, _ = placed.shape
    cells = roi_cells(bins, rows // 2, side).flatten(1)[:, None].expand(-1, classes, -1)
    whole = torch.zeros(drives, classes, side * side + 1).scatter(2, cells, placed.flatten(2))
    return whole[..., :-1].unflatten(2, (side, side))


def export_map_update(network: MapUpdate, path: Path, drives: DriveSet, options: MapperOptions) -> None:
    """Write a map update as ONNX for a region of interest of any size; its metadata say what it is for."""
    plain = network.to(torch.device("cpu")).eval()
    rows, columns = (torch.export.Dim(name, min=1, max=1024) for name in ("rows", "columns"))
    halo = 2 * network.halo
    around = {2: rows + halo, 3: columns + halo} if halo else {2: rows, 3: columns}
    inside = {2: rows, 3: columns}
    size, classes = 7, network.classes
    placed, cell = torch.zeros(2, 1, classes, size, size + 2)
    hidden = torch.zeros(1, classes, size + halo, size + 2 + halo)
    export_onnx(
        plain,
        (placed, hidden, cell),
        path,
        input_names=["placed", "hidden", "cell"],
        output_names=["new_hidden", "new_cell"],
        dynamic_shapes={"placed": inside, "hidden": around, "cell": inside},
        metadata=_metadata(network, drives, options),
    )


def _metadata(network: MapUpdate, drives: DriveSet, options: MapperOptions) -> dict[str, str]:
    paper = options.paper
    hidden, cell = (json.dumps([round(value, 6) for value in state.tolist()]) for state in start_state(network.classes))
    return {
        "task": "map update",
        "classes": json.dumps(list(drives.classes)),
        "kappa": repr(float(network.log_kappa.detach().exp())),
        "cell_m": repr(paper.cell_m),
        "side": str(paper.side),
        "kernel": str(network.kernel),
        "initial_hidden": hidden,
        "initial_cell": cell,
        "noise_floor": repr(paper.noise_floor),
        "binary": str(paper.binary).lower(),
        "quality": drives.quality,
        "license": "Apache-2.0",
    }
