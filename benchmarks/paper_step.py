"""Step time of the paper's estimator, and what the learned map update costs in maps of two sizes.

    python benchmarks/paper_step.py [--quick]

The first table compares a whole step (pooling, rotating, correlating, softmax, modes, placing, map update) with one
bare ONNX Runtime convolution of the correlation's size (benchmarks/correlate.py), taken in turns in the same run.
Beside the leaky average stands the learned update: the one in the package, cut to twelve classes, since what a step
costs depends on how sharp its map is. The second table is that update alone, in the middle of maps of 33 x 33 and
330 x 330 cells. One thread each.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import json
import statistics
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
from correlate import (
    CELL_M,
    CLASSES,
    PAPER,
    SIDE,
    SIZES,
    bare_convolution,
    convolution_of,
    dense_observation,
    room_observation,
    rounds_wanted,
    timed,
)
from machine import machine

from semslam.geometry.frames import SE2
from semslam.geometry.grid import Planes, pool_observation
from semslam.models.builtin import shipped
from semslam.models.memory import keep_freed_memory
from semslam.slam.estimator import Step
from semslam.slam.learned_map import LearnedMap
from semslam.slam.paper import Window, rotate_observation
from semslam.slam.registry import open_estimator
from semslam.stages.settings import LocalizeConfig, PaperConfig

MAP_SIDES = (33, 330)


def main() -> None:
    """Measure and print."""
    rounds = rounds_wanted(__doc__ or "")
    print(machine("numpy", "onnxruntime"))
    print(f"{rounds} rounds, median; {SIZES}")
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        network = cut_update(Path(folder) / "map_update.onnx", CLASSES)
        print_steps(network, rounds)
        print_updates(network, rounds)


def print_steps(network: Path, rounds: int) -> None:
    """The first table."""
    learned = replace(PAPER, update="learned", model=str(network))
    print(f"\n{'observation':12} {'update':8} {'convolution':>14} {'whole step':>14}   ratio")
    for name, make in (("dense", dense_observation), ("room", room_observation)):
        for paper in (PAPER, learned):
            baseline, whole = (statistics.median(times) * 1e3 for times in measure_steps(make, paper, rounds))
            print(f"{name:12} {paper.update:8} {baseline:11.1f} ms {whole:11.1f} ms   {whole / baseline:5.2f}")


def print_updates(network: Path, rounds: int) -> None:
    """The second table."""
    print(f"\n{'map':12} {'learned update':>22}   ratio")
    times = [statistics.median(one) * 1e3 for one in measure_updates(network, rounds)]
    for side, time_ms in zip(MAP_SIDES, times, strict=True):
        print(f"{side:3} x {side:<6} {time_ms:19.3f} ms   {time_ms / times[0]:5.2f}")


def measure_steps(make: Callable[[int], Planes], paper: PaperConfig, rounds: int) -> tuple[list[float], list[float]]:
    """Seconds of convolution and whole step, taken in turns."""
    estimator = open_estimator("paper", LocalizeConfig(paper=paper), CLASSES, CELL_M, SIDE)
    convolve = bare_convolution()
    times: tuple[list[float], list[float]] = ([], [])
    for frame in range(rounds + 2):
        belief, observation = estimator.belief(), make(frame)
        assert belief is not None
        rotated = rotate_observation(pool_observation(observation, 3, paper.side), paper.headings)
        step = Step(frame, frame, observation, SE2(0.05, 0.0, 0.02) if frame else None)
        actions = (convolution_of(convolve, rotated, belief.planes), lambda step=step: estimator.step(step))
        for kept, action in zip(times, actions, strict=True):
            seconds = timed(action)
            if frame >= 2:  # the first two fill caches
                kept.append(seconds)
    return times


def measure_updates(network: Path, rounds: int) -> list[list[float]]:
    """Seconds of the learned update in the middle of maps of all sizes, taken in turns."""
    maps = [LearnedMap.open(network, CLASSES, side, PAPER.cell_m, PAPER.side) for side in MAP_SIDES]
    windows = [middle(side) for side in MAP_SIDES]
    times: list[list[float]] = [[] for _ in MAP_SIDES]
    for seed in range(10 * rounds):
        placed = np.random.default_rng(seed).random((len(CLASSES), PAPER.side, PAPER.side), np.float32)
        for kept, world, window in zip(times, maps, windows, strict=True):
            kept.append(timed(lambda world=world, window=window, placed=placed: world.update(placed, window)))
    return times


def middle(side: int) -> Window:
    """The region of interest of a robot in the middle of the map."""
    start = (side - PAPER.side) // 2
    return slice(start, start + PAPER.side), slice(start, start + PAPER.side)


def cut_update(path: Path, classes: Sequence[str]) -> Path:
    """The shipped map update with its first classes alone."""
    model = onnx.load(shipped("map_update"))
    facts = {entry.key: entry.value for entry in model.metadata_props}
    trained, kept = len(json.loads(facts["classes"])), len(classes)
    for tensor in model.graph.initializer:
        tensor.CopyFrom(onnx.numpy_helper.from_array(_cut(tensor, trained, kept), tensor.name))
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.shape.dim[1].dim_value = kept
    del model.graph.value_info[:]  # shapes between the nodes, of all classes
    initial = {name: json.dumps(json.loads(facts[name])[:kept]) for name in ("initial_hidden", "initial_cell")}
    onnx.helper.set_model_props(model, {**facts, **initial, "classes": json.dumps(list(classes))})
    onnx.save(model, path)
    return path


def _cut(tensor: onnx.TensorProto, trained: int, kept: int) -> np.ndarray:
    """Weights of some classes: an axis may hold them once, or once for each gate or input."""
    array = onnx.numpy_helper.to_array(tensor)
    for axis, size in enumerate(array.shape):
        if array.dtype == np.float32 and size % trained == 0:
            chosen = [group * trained + index for group in range(size // trained) for index in range(kept)]
            array = array.take(chosen, axis)
    return np.ascontiguousarray(array)


if __name__ == "__main__":
    main()
