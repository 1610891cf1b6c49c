"""Equation 2 against one bare ONNX Runtime convolution of the same size, in the same run.

    python benchmarks/correlate.py [--quick]

The baseline is the convolution alone: map (1, 10, 33, 33), kernels (360, 10, 11, 11), float32, zero padded, one thread.
`dense` has weight in every cell of every class; `room` has what a camera sees of one: four of ten classes, a few cells
each. benchmarks/paper_step.py measures the step of the estimator around it.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import onnx
import onnxruntime
from machine import machine

from semslam.geometry.grid import Planes, pool_observation
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, UNOBSERVED, class_list
from semslam.models.memory import keep_freed_memory
from semslam.slam.paper import correlate, rotate_observation
from semslam.stages.settings import PaperConfig

CELL_M, SIDE = 0.1, 99
CLASSES = class_list([f"class {i}" for i in range(10)])
PAPER = PaperConfig()
SIZES = f"L = {len(CLASSES) - FIRST_OBJECT} object classes, h = {PAPER.side}, R = {PAPER.headings}"


def main() -> None:
    """Measure and print."""
    rounds = rounds_wanted(__doc__ or "")
    print(machine("numpy", "onnxruntime"))
    print(f"{rounds} rounds, median; {SIZES}")
    print(f"{'case':6} {'convolution':>14} {'correlate':>14}   ratio")
    keep_freed_memory()
    for name, make in (("dense", dense_observation), ("room", room_observation)):
        baseline, alone = (statistics.median(times) * 1e3 for times in measure(make, rounds))
        print(f"{name:6} {baseline:11.1f} ms {alone:11.1f} ms   {alone / baseline:5.2f}")


def rounds_wanted(text: str) -> int:
    """How often to measure, from the command line."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three rounds, to exercise the code")
    return 3 if parser.parse_args().quick else 40


def measure(make: Callable[[int], Planes], rounds: int) -> tuple[list[float], list[float]]:
    """Seconds of convolution and correlation, taken in turns."""
    convolve = bare_convolution()
    world = pool_observation(make(0), 3, PAPER.map_side)
    times: tuple[list[float], list[float]] = ([], [])
    for seed in range(rounds + 2):
        rotated = rotate_observation(pool_observation(make(seed), 3, PAPER.side), PAPER.headings)
        actions = (convolution_of(convolve, rotated, world), lambda rotated=rotated: correlate(rotated, world))
        for kept, action in zip(times, actions, strict=True):
            seconds = timed(action)
            if seed >= 2:  # the first two fill caches
                kept.append(seconds)
    return times


def timed(action: Callable[[], object]) -> float:
    """Seconds that it takes."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def convolution_of(
    convolve: Callable[[Planes, Planes], Planes], rotated: Planes, world: Planes
) -> Callable[[], Planes]:
    """The baseline's share of a step, with its inputs laid out beforehand."""
    kernels = np.ascontiguousarray(rotated[:, FIRST_OBJECT:])
    image = np.ascontiguousarray(world[None, FIRST_OBJECT:])
    return lambda: convolve(image, kernels)


def dense_observation(seed: int) -> Planes:
    """Weight everywhere."""
    planes = np.random.default_rng(seed).random((len(CLASSES), SIDE, SIDE), np.float32)
    planes[UNOBSERVED] = 0.0
    return planes


def room_observation(seed: int) -> Planes:
    """Four classes ahead of the robot, half a metre wide, on a floor seen 90 degrees wide."""
    random = np.random.default_rng(seed)
    planes = np.zeros((len(CLASSES), SIDE, SIDE), np.float32)
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    planes[FREE_FLOOR] = (x > 0) & (np.abs(y) < x)
    for class_id in FIRST_OBJECT + random.choice(4, 4, replace=False):
        row, column = 49 + random.integers(-8, 8), 49 + random.integers(6, 14)
        planes[class_id, row - 2 : row + 3, column - 2 : column + 3] = 0.04
    planes[UNOBSERVED] = ~planes[1:].any(0)
    return planes


def bare_convolution() -> Callable[[Planes, Planes], Planes]:
    """ONNX Runtime's Conv with run-time weights, one thread."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    node = helper.make_node("Conv", ["x", "w"], ["y"], pads=[PAPER.side // 2] * 4)
    inputs = [helper.make_tensor_value_info(name, kind, [None] * 4) for name in "xw"]
    graph = helper.make_graph([node], "conv", inputs, [helper.make_tensor_value_info("y", kind, [None] * 4)])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])

    def convolve(image: Planes, kernels: Planes) -> Planes:
        result: Planes = session.run(None, {"x": image, "w": kernels})[0]
        return result

    return convolve


if __name__ == "__main__":
    main()
