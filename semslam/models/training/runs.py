"""From pictures to a model that is ready for use: train, export, judge, and write the card.

A run's folder holds `checkpoint.pt` and `curves.csv` while it lasts, and at its end the ONNX file and its card.
"""

from __future__ import annotations

import datetime
import hashlib
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import nn

from semslam.errors import SemslamError
from semslam.models.class_names import names_from_file
from semslam.models.nets.detector import INPUT_HEIGHT, INPUT_WIDTH, Detector, DetectorShape, Exported
from semslam.models.training.detector import Batches, detection_loss
from semslam.models.training.export import export_onnx
from semslam.models.training.pictures import PictureSet
from semslam.models.training.trainer import CHECKPOINT, Progress, Schedule, fit, read_checkpoint

DETECTOR = "detector.onnx"
CLASSES = (
    "chair", "table", "sofa", "bed", "bookshelf", "dresser", "plant", "lamp", "tv", "bin", "refrigerator", "toilet",
)  # fmt: skip
"""Of simulated homes; a test compares them with the simulator's."""


@dataclass(frozen=True)
class Run:
    """What one training is asked to do."""

    data: Path
    """Folder of views to learn from."""
    out: Path
    """Folder of the run."""
    schedule: Schedule
    threads: int = 2
    device: str = "auto"
    """cpu, cuda, or auto: cuda where there is one."""
    watch: Callable[[Progress], None] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Task:
    """A kind of network: what trains it and what exports it; both tell the files they wrote."""

    defaults: Schedule
    train: Callable[[Run], list[Path]]
    export: Callable[[Path, Path | None, int | None, Path | None], list[Path]]
    """Folder to write to, folder of a run or None, seed of random weights or None, file of class names or None."""


def asked(
    task: str,
    *,
    views: Path,
    out: Path,
    steps: int | None = None,
    batch: int | None = None,
    rate: float | None = None,
    seed: int = 1,
    threads: int = 2,
    device: str = "auto",
    watch: Callable[[Progress], None] | None = None,
) -> Run:
    """What a command asks for; None means the value of the shipped model."""
    usual = TASKS[task].defaults
    schedule = replace(
        usual, steps=steps or usual.steps, batch=batch or usual.batch, peak_rate=rate or usual.peak_rate, seed=seed
    )
    return Run(views, out, schedule, threads, device, watch)


def train_detector(run: Run) -> list[Path]:
    """Train a detector and export it. A run that was killed goes on where it was.

    Raises:
        SemslamError: no views, a folder with another run, no such device.
    """
    device = prepare(run)
    pictures = PictureSet.open(run.data)
    network = new_detector(pictures.class_names, run.schedule.seed)
    network = network.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    batches = Batches.of(pictures, steps=run.schedule.steps, batch=run.schedule.batch, seed=run.schedule.seed)
    facts = {"task": "detector", "classes": list(pictures.class_names), "data": pictures.digest}
    trained = fit(network, detection_loss, batches, run.schedule, run.out, facts=facts, watch=run.watch)
    export_detector(trained, run.out / DETECTOR, pictures.class_names)
    return [run.out / DETECTOR]


def exported_detector(out: Path, run: Path | None, seed: int | None, classes: Path | None) -> list[Path]:
    """Export what a run has learned so far, or random weights, into a folder.

    Raises:
        SemslamError: no such run, or a damaged file of class names.
    """
    if run is not None:
        network, names = trained_detector(run)
    else:
        names = tuple(names_from_file(classes)) if classes else CLASSES
        network = new_detector(names, seed or 0)
    export_detector(network, out / DETECTOR, names)
    return [out / DETECTOR]


def prepare(run: Run) -> torch.device:
    """Set threads and seeds; the device to train on.

    Raises:
        SemslamError: there is no such device.
    """
    cv2.setNumThreads(1)
    torch.set_num_threads(run.threads)
    torch.use_deterministic_algorithms(True, warn_only=True)
    name = run.device if run.device != "auto" else ("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise SemslamError("This torch finds no GPU", hint="train with `--device cpu`")
    return torch.device(name)


def new_detector(class_names: Sequence[str], seed: int) -> Detector:
    """A detector as initialised from a seed."""
    torch.manual_seed(seed)
    return Detector(DetectorShape(len(class_names)))


def trained_detector(folder: Path) -> tuple[Detector, tuple[str, ...]]:
    """The averaged weights of a run's checkpoint, finished or not, and the class names.

    Raises:
        SemslamError: no checkpoint there, or one of another network.
    """
    stored = read_checkpoint(folder / CHECKPOINT)
    if stored["run"].get("task") != "detector":
        raise SemslamError(
            f"`{folder}` is not the run of a detector", hint="name the folder of `semslam train detector`"
        )
    names = tuple(stored["run"]["classes"])
    network = new_detector(names, 0)
    average = torch.optim.swa_utils.AveragedModel(network, use_buffers=True)
    average.load_state_dict(stored["average"])
    network.load_state_dict(average.module.state_dict())
    return network.eval(), names


def export_detector(network: nn.Module, path: Path, class_names: Sequence[str]) -> None:
    """Write a detector as ONNX; any number of pictures at once."""
    if not isinstance(network, Detector):
        raise TypeError("not a detector of ours")
    plain = network.to(device=torch.device("cpu"), memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    batch = torch.export.Dim("batch", min=1, max=64)
    export_onnx(
        Exported(plain.eval()),
        (torch.zeros(2, 3, INPUT_HEIGHT, INPUT_WIDTH), torch.zeros(2, 1, INPUT_HEIGHT, INPUT_WIDTH)),
        path,
        input_names=["images", "depth"],
        output_names=["output0"],
        dynamic_shapes={"images": {0: batch}, "depth_m": {0: batch}},
        metadata={
            "names": repr(dict(enumerate(class_names))),
            "task": "detect",
            "input": "rgb 0..1, depth metres",
            "license": "Apache-2.0",
        },
    )


def parameters_of(network: nn.Module) -> int:
    """How many numbers were learned."""
    return sum(value.numel() for value in network.parameters())


def facts_of(path: Path) -> dict[str, str]:
    """What a card says of a file."""
    content = path.read_bytes()
    return {
        "file": f"{path.name}, {len(content) / 1e6:.2f} MB",
        "SHA-256": f"`{hashlib.sha256(content).hexdigest()}`",
    }


def write_card(path: Path, title: str, text: str, facts: Mapping[str, Any], tables: Sequence[str]) -> None:
    """A model card as Markdown: a title, a paragraph, facts, tables."""
    rows = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    stamp = {"torch": torch.__version__, "processor": platform.machine(), "date": datetime.date.today()}
    rows += "".join(f"\n| {name} | {value} |" for name, value in stamp.items())
    body = "\n\n".join([f"# {title}", text, f"| | |\n|---|---|\n{rows}", *tables])
    path.write_text(body + "\n", encoding="utf-8")


TASKS: Mapping[str, Task] = {
    "detector": Task(Schedule(steps=14000, batch=16), train_detector, exported_detector),
}
"""What `semslam train` can train."""
