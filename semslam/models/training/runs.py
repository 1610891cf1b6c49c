"""From pictures to a model that is ready for use: train, export, judge, and write the card.

A run's folder holds `checkpoint.pt` and `curves.csv` while it lasts, and at its end the ONNX file and its card.
Networks that learn from pictures in a row keep their thumbnails there too, in `pictures/`.
"""

from __future__ import annotations

import datetime
import fcntl
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import torch
from torch import nn

from semslam.errors import SemslamError
from semslam.labels import class_list
from semslam.models.class_names import names_from_file
from semslam.models.nets.deepvo import DeepVoShape
from semslam.models.nets.detector import INPUT_HEIGHT, INPUT_WIDTH, Detector, DetectorShape, Exported
from semslam.models.nets.mapnet import MapNetShape
from semslam.models.nets.segmenter import Segmenter
from semslam.models.onnxfile import file_digest
from semslam.models.small_view import HEIGHT, WIDTH
from semslam.models.training import deepvo, mapnet
from semslam.models.training.detector import Batches, detection_loss
from semslam.models.training.drives import DriveSet
from semslam.models.training.export import export_onnx
from semslam.models.training.judge import box_table, judged_detector, judged_segmenter, mask_table
from semslam.models.training.mapping import (
    MAP_UPDATE,
    MapperOptions,
    export_map_update,
    judged,
    new_map_update,
    options_for,
    score_table,
    train_mapper,
)
from semslam.models.training.pictures import CLASSES, PictureSet
from semslam.models.training.segmenter import PromptBatches, export_segmenter, mask_loss, new_segmenter
from semslam.models.training.sequences import DriveFiles, PictureDrives
from semslam.models.training.trainer import CHECKPOINT, Progress, Schedule, fit, read_checkpoint
from semslam.stages.settings import PaperConfig

DETECTOR = "detector.onnx"
PICTURES = "pictures"
"""Folder of a run with the thumbnails that it learns from."""


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
    test: Path | None = None
    """Folder of views to judge the result on."""
    command: str = ""
    """What to type to make it again; for the card."""


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
    test: Path | None = None,
) -> Run:
    """What a command asks for; None means the value of the shipped model."""
    usual = TASKS[task].defaults
    schedule = replace(
        usual, steps=steps or usual.steps, batch=batch or usual.batch, peak_rate=rate or usual.peak_rate, seed=seed
    )
    command = f"semslam train {task} {views.name} --out {out.name} --steps {schedule.steps} --batch {schedule.batch}"
    command += f" --rate {schedule.peak_rate:g} --seed {seed} --threads {threads}"
    return Run(views, out, schedule, threads, device, watch, test, command)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Nobody else trains into the folder meanwhile.

    Raises:
        SemslamError: somebody does, or it is no folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise _not_a_folder(folder) from error
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        hint = "wait for it, or give another `--out`"
        raise SemslamError(f"Another training is at work in `{folder}`", hint=hint) from error


_Maker = Callable[[Run, torch.device, PictureSet, PictureSet | None], list[Path]]
"""Trains and exports: a run, its device, the views to learn from, and those to judge on."""


def _trained(run: Run, make: _Maker) -> list[Path]:
    """Open everything that a run needs, then have it made while nobody else works in its folder."""
    device = prepare(run)
    pictures = PictureSet.open(run.data)
    unseen = _unseen(run, pictures)
    with _alone(run.out):
        return make(run, device, pictures, unseen)


def train_detector(run: Run) -> list[Path]:
    """Train a detector and export it. A run that was killed goes on where it was.

    Raises:
        SemslamError: no views, a folder with another run, no such device.
    """
    return _trained(run, _detector_made)


def _detector_made(run: Run, device: torch.device, pictures: PictureSet, unseen: PictureSet | None) -> list[Path]:
    network = new_detector(pictures.class_names, run.schedule.seed)
    network = network.to(device=device, memory_format=torch.channels_last)
    batches = Batches.of(pictures, steps=run.schedule.steps, batch=run.schedule.batch, seed=run.schedule.seed)
    facts = {"task": "detector", "classes": list(pictures.class_names), "data": pictures.digest}
    trained = fit(network, detection_loss, batches, run.schedule, run.out, facts=facts, watch=run.watch)
    path = run.out / DETECTOR
    export_detector(trained, path, pictures.class_names)
    table = box_table(judged_detector(path, unseen)) if unseen else ""
    facts = {
        "input": f"`images` (N, 3, {INPUT_HEIGHT}, {INPUT_WIDTH}) RGB 0 to 1, `depth` (N, 1, same) metres, 0 missing",
        "output": "`output0` (N, 4 + classes, cells), YOLOv8's layout, boxes in input pixels",
        "classes": ", ".join(pictures.class_names),
        **_made(run, device, network, pictures),
    }
    write_card(path, "Object detector from colour and depth", _ON_HOMES, facts, _judged(unseen, table))
    return [path, path.with_suffix(".md")]


def train_segmenter(run: Run) -> list[Path]:
    """Train a segmenter and export it. A run that was killed goes on where it was.

    Raises:
        SemslamError: no views, a folder with another run, no such device.
    """
    return _trained(run, _segmenter_made)


def _segmenter_made(run: Run, device: torch.device, pictures: PictureSet, unseen: PictureSet | None) -> list[Path]:
    network = new_segmenter(run.schedule.seed)
    network = network.to(device=device, memory_format=torch.channels_last)
    batches = PromptBatches.of(pictures, steps=run.schedule.steps, batch=run.schedule.batch, seed=run.schedule.seed)
    facts = {"task": "segmenter", "data": pictures.digest}
    trained = fit(network, mask_loss, batches, run.schedule, run.out, facts=facts, watch=run.watch)
    encoder, decoder = export_segmenter(_segmenter(trained), run.out)
    table = mask_table(judged_segmenter(encoder, decoder, unseen)) if unseen else ""
    described = {
        "input": "`images` (1, 3, h, w) RGB 0 to 1, `depth` (1, 1, h, w) metres; then `features` and `boxes` (N, 4)",
        "output": "`masks` (N, m, m) logits on a grid over each box and its margin (metadata `box_margin`)",
        "decoder": f"{decoder.name}, SHA-256 `{file_digest(decoder)}`",
        **_made(run, device, network, pictures),
    }
    write_card(encoder, "Box-prompted segmenter of colour and depth", _ON_HOMES, described, _judged(unseen, table))
    return [encoder, decoder, encoder.with_suffix(".md")]


def exported_segmenter(out: Path, run: Path | None, seed: int | None, _classes: Path | None) -> list[Path]:
    """Export what a run has learned so far, or random weights, into a folder.

    Raises:
        SemslamError: no such run.
    """
    network = new_segmenter(seed or 0)
    if run is not None:
        network.load_state_dict(_averaged(run, "segmenter", network))
    return export_segmenter(network, out)


def _segmenter(network: nn.Module) -> Segmenter:
    if not isinstance(network, Segmenter):
        raise TypeError("not a segmenter of ours")
    return network


_ON_HOMES = (
    "Trained on simulated homes alone, with pictures changed at random in colour, light, sharpness, noise, scale and "
    "depth. Expect little of it on photographs."
)


def _made(run: Run, device: torch.device, network: nn.Module, pictures: PictureSet) -> dict[str, Any]:
    """How a model came about, for its card."""
    return {
        "parameters": f"{parameters_of(network):,}",
        "data": f"{len(pictures):,} views, `{pictures.origin}`, digest {pictures.digest}",
        **_asked_for(run, device, "views"),
    }


def _asked_for(run: Run, device: torch.device, unit: str) -> dict[str, Any]:
    """How to make a model again, for its card; `unit` is what a batch counts."""
    return {
        "command": f"`{run.command} --device {device.type}`",
        "seed": run.schedule.seed,
        "steps": f"{run.schedule.steps:,} of {run.schedule.batch} {unit}",
        "licence": "Apache-2.0, model and data",
    }


def _unseen(run: Run, pictures: PictureSet) -> PictureSet | None:
    """The views to judge on, opened before the work of hours begins.

    Raises:
        SemslamError: no views there, other classes, or homes that are trained on.
    """
    if run.test is None:
        return None
    unseen = PictureSet.open(run.test)
    shared = sorted({*pictures.homes} & {*unseen.homes})
    if shared:
        raise SemslamError(
            f"{len(shared)} homes of `{run.test}` are in `{run.data}` too, such as `{shared[0]}`",
            hint="judge on other homes: `semslam train pictures` with another `--seed`",
        )
    if unseen.class_names != pictures.class_names:
        raise SemslamError(f"`{run.test}` has other classes than `{run.data}`", hint="judge on views of the same kind")
    return unseen


def _judged(unseen: PictureSet | None, table: str) -> list[str]:
    if unseen is None:
        return ["Not judged: `--test VIEWS` was not given."]
    return [f"On {len(unseen):,} views of homes it has not seen (`{unseen.origin}`), objects that count:", table]


def train_map_update(run: Run, drives: DriveSet, unseen: DriveSet | None, options: MapperOptions) -> list[Path]:
    """Train a map update, export it and write its card. A run that was killed goes on where it was.

    Args:
        run: what is asked; `data` and `test` are not looked at.
        drives: what to learn from.
        unseen: what to judge the result on; None for no judgement.
        options: what it is trained for.

    Raises:
        SemslamError: a folder with another run, no such device.
    """
    device = prepare(run)
    chosen = options_for(drives, options)
    with _alone(run.out):
        path = train_mapper(drives, run.out, schedule=run.schedule, options=chosen, device=device.type, watch=run.watch)
        network = new_map_update(len(drives.classes), chosen.kernel, 0)
        network.load_state_dict(_averaged(run.out, "mapper", network))
        network.eval()
        table = score_table(judged(network, unseen, chosen)) if unseen else ""
        write_card(
            path,
            "Map update of SemanticSLAM (equation 8)",
            _ON_DRIVES,
            _mapped(run, device, drives, chosen),
            _mapped_worth(unseen, table),
        )
    return [path, path.with_suffix(".md")]


_ON_DRIVES = (
    "Trained on drives through simulated homes alone. It updates the region of interest of a semantic map from what "
    "was placed there; `localize.paper.update = learned` runs it, on observations of the same classes, cells and side."
)


def _mapped(run: Run, device: torch.device, drives: DriveSet, options: MapperOptions) -> dict[str, Any]:
    """What a map update is and how it came about, for its card."""
    paper, classes = options.paper, len(drives.classes)
    around = "r, c" if options.kernel == 1 else "r + 2, c + 2"
    return {
        "input": f"`placed` (1, {classes}, r, c), `hidden` (1, {classes}, {around}), `cell` (1, {classes}, r, c)",
        "output": f"`new_hidden`, `new_cell` (1, {classes}, r, c)",
        "classes": ", ".join(drives.classes),
        "grid": f"cells of {paper.cell_m:g} m, observations of {paper.side} x {paper.side} cells",
        "kernel": options.kernel,
        "parameters": f"{parameters_of(new_map_update(classes, options.kernel, 0)):,}",
        "data": f"{len(drives)} drives of `{drives.origin}`, quality {drives.quality}, digest {drives.digest}",
        "keyframes": f"the first {options.length} of each drive" if options.length else "all",
        "poses": _posed(options),
        **_asked_for(run, device, "drives"),
    }


def _posed(options: MapperOptions) -> str:
    if not options.own_share:
        return "true ones alone"
    return (
        f"true ones for {options.teacher_share:.0%} of the steps, then own ones, up to {options.own_share:.0%} of them"
    )


def _mapped_worth(unseen: DriveSet | None, table: str) -> list[str]:
    if unseen is None:
        return ["Not judged: the protocol has no logs to test."]
    text = (
        f"On {len(unseen)} drives that test, with true poses; means over steps and over the cells that have been "
        "inside a region of interest by then, against the class map visible by then:"
    )
    return [text, table]


def exported_mapper(out: Path, run: Path | None, seed: int | None, classes: Path | None) -> list[Path]:
    """Export the map update that a run has learned so far, or random weights, into a folder.

    Raises:
        SemslamError: no such run, or a damaged file of class names.
    """
    stored: dict[str, Any] = {"classes": _class_list(classes), "options": {}}
    if run is not None:
        stored = _stored(run, "mapper")["run"]
    names, options = tuple(stored["classes"]), _mapper_options(stored["options"])
    network = new_map_update(len(names), options.kernel, seed or 0)
    if run is not None:
        network.load_state_dict(_averaged(run, "mapper", network))
    export_map_update(network, out / MAP_UPDATE, DriveSet((), names, "unknown", options.paper), options)
    return [out / MAP_UPDATE]


def _class_list(classes: Path | None) -> tuple[str, ...]:
    return class_list(tuple(names_from_file(classes)) if classes else CLASSES)


def _mapper_options(stored: Mapping[str, Any]) -> MapperOptions:
    return replace(_known(MapperOptions, stored), paper=_known(PaperConfig, stored.get("paper", {})))


_Facts = TypeVar("_Facts")


def _known(kind: type[_Facts], stored: Mapping[str, Any]) -> _Facts:
    """A dataclass from what a checkpoint tells; fields that it does not tell have their defaults."""
    names = {one.name for one in fields(kind)}  # type: ignore[arg-type]  # mypy has no bound for dataclasses
    return kind(**{name: value for name, value in stored.items() if name in names})


@dataclass(frozen=True)
class SequenceTask:
    """A network that learns motion from pictures in a row."""

    title: str
    text: str
    """Of its card."""
    defaults: Schedule
    length: int
    """Keyframes of a training sequence."""
    train: Callable[..., Path]
    """As `train_mapnet`."""
    new: Callable[[], nn.Module]
    """A network of the usual sizes."""
    facts: Mapping[str, Any]
    """What goes in and comes out, for the card."""


def train_on_pictures(
    task: str,
    run: Run,
    files: Sequence[DriveFiles],
    judge: Callable[[Path], Sequence[str]],
    opened: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Train one of `SEQUENCES`, export it and write its card. A run that was killed goes on where it was.

    Args:
        task: which.
        run: what is asked; `data` names the data set on the card, `test` is not looked at.
        files: what to learn from.
        judge: tells what an exported file is worth, in paragraphs of Markdown.
        opened: hears how many of how many logs are in memory.

    Raises:
        SemslamError: a folder with another run, no such device, or a log that will not do.
    """
    device, kind = prepare(run), SEQUENCES[task]
    with _alone(run.out):
        drives = PictureDrives.open(files, run.out / PICTURES, opened)
        path = kind.train(
            drives, run.out, schedule=run.schedule, length=kind.length, device=device.type, watch=run.watch
        )
        write_card(path, kind.title, kind.text, _from_sequences(kind, run, device, drives), judge(path))
    return [path, path.with_suffix(".md")]


def _from_sequences(kind: SequenceTask, run: Run, device: torch.device, drives: PictureDrives) -> dict[str, Any]:
    """What a network is and how it came about, for its card."""
    keyframes = sum(len(drive.poses) for drive in drives.drives)
    return {
        **kind.facts,
        "parameters": f"{parameters_of(kind.new()):,}",
        "data": f"{len(drives)} drives of `{run.data.resolve().name}`, {keyframes:,} keyframes, digest {drives.digest}",
        **_asked_for(run, device, f"sequences of {kind.length} keyframes"),
    }


def exported_mapnet(out: Path, run: Path | None, seed: int | None, _classes: Path | None) -> list[Path]:
    """Export the MapNet that a run has learned so far, or random weights, into a folder.

    Raises:
        SemslamError: no such run.
    """
    shape = _known(MapNetShape, _stored(run, "mapnet")["run"] if run else {})
    network = mapnet.new_mapnet(shape, seed or 0)
    if run is not None:
        network.load_state_dict(_averaged(run, "mapnet", network))
    whole = replace(shape, map_side=MapNetShape().map_side)  # training has a small map
    mapnet.export_mapnet(network, out / mapnet.MAPNET, whole)
    return [out / mapnet.MAPNET]


def exported_deepvo(out: Path, run: Path | None, seed: int | None, _classes: Path | None) -> list[Path]:
    """Export the DeepVO that a run has learned so far, or random weights, into a folder.

    Raises:
        SemslamError: no such run.
    """
    network = deepvo.new_deepvo(_known(DeepVoShape, _stored(run, "deepvo")["run"] if run else {}), seed or 0)
    if run is not None:
        network.load_state_dict(_averaged(run, "deepvo", network))
    deepvo.export_deepvo(network, out / deepvo.DEEPVO)
    return [out / deepvo.DEEPVO]


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
    torch.utils.deterministic.fill_uninitialized_memory = False  # nobody reads it; filling it takes time
    return device_of(run.device)


def require_place(out: Path, device: str) -> None:
    """Refuse what could never be trained before data are read, which may take minutes.

    Raises:
        SemslamError: there is no such device, or `out` is a file.
    """
    device_of(device)
    if out.exists() and not out.is_dir():
        raise _not_a_folder(out)


def _not_a_folder(out: Path) -> SemslamError:
    return SemslamError(f"`{out}` is a file", hint="give another `--out`")


def device_of(asked: str) -> torch.device:
    """The device of a name: cpu, cuda, or auto.

    Raises:
        SemslamError: there is no such device.
    """
    name = asked if asked != "auto" else ("cuda" if torch.cuda.is_available() else "cpu")
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
    names = tuple(_stored(folder, "detector")["run"]["classes"])
    network = new_detector(names, 0)
    network.load_state_dict(_averaged(folder, "detector", network))
    return network.eval(), names


def _averaged(folder: Path, task: str, network: nn.Module) -> Mapping[str, Any]:
    """Averaged weights of a run of this task; `network` tells their shapes."""
    average = torch.optim.swa_utils.AveragedModel(network, use_buffers=True)
    try:
        average.load_state_dict(_stored(folder, task)["average"])
    except RuntimeError as error:
        raise SemslamError(
            f"The checkpoint in `{folder}` is of a network of another shape", hint="export it with the version it is of"
        ) from error
    return average.module.state_dict()


def _stored(folder: Path, task: str) -> dict[str, Any]:
    """The checkpoint of a run of this task."""
    stored = read_checkpoint(folder / CHECKPOINT)
    if stored["run"].get("task") != task:
        raise SemslamError(f"`{folder}` is not the run of a {task}", hint=f"name that of `semslam train {task}`")
    return stored


def export_detector(network: nn.Module, path: Path, class_names: Sequence[str]) -> None:
    """Write a detector as ONNX; any number of pictures at once."""
    if not isinstance(network, Detector):
        raise TypeError("not a detector of ours")
    plain = network.to(device=torch.device("cpu"), memory_format=torch.contiguous_format)
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


def write_card(path: Path, title: str, text: str, facts: Mapping[str, Any], more: Sequence[str]) -> None:
    """The card of a model as Markdown beside it: a title, a paragraph, facts, and what it is worth."""
    own = {"file": f"{path.name}, {path.stat().st_size / 1e6:.2f} MB", "SHA-256": f"`{file_digest(path)}`"}
    stamp = {"torch": torch.__version__, "date": datetime.date.today()}
    rows = "\n".join(f"| {name} | {value} |" for name, value in {**own, **facts, **stamp}.items())
    body = "\n\n".join([f"# {title}", text, f"| | |\n|---|---|\n{rows}", *more])
    card = path.with_suffix(".md")
    unfinished = card.with_name(f".tmp-{card.name}")
    unfinished.write_text(body + "\n", encoding="utf-8")
    unfinished.replace(card)


TASKS: Mapping[str, Task] = {
    "detector": Task(Schedule(steps=8000, batch=16), train_detector, exported_detector),
    "segmenter": Task(Schedule(steps=7000, batch=4), train_segmenter, exported_segmenter),
}
"""What `semslam train` can train on views."""


_ON_PICTURES = (
    "Trained on drives through simulated homes alone, with mirrored pictures and changed light. Expect little of it "
    "elsewhere."
)
SEQUENCES: Mapping[str, SequenceTask] = {
    "mapnet": SequenceTask(
        "MapNet (Henriques and Vedaldi, 2018)",
        f"A map of image features in which the robot finds itself. {_ON_PICTURES} `localize.mapnet.model` takes it.",
        mapnet.USUAL,
        mapnet.LENGTH,
        mapnet.train_mapnet,
        lambda: mapnet.new_mapnet(MapNetShape(), 0),
        {
            "input": f"`picture` (1, 3, {HEIGHT}, {WIDTH}) RGB 0 to 1, `cells` of its parts by depth, `given`, the map",
            "output": "`field` (headings, rows, columns) over poses, the new map",
            "grid": (
                f"{MapNetShape().map_side} x {MapNetShape().map_side} cells of {MapNetShape().cell_m:g} m, "
                f"{MapNetShape().headings} headings, observations of {MapNetShape().side} x {MapNetShape().side} cells"
            ),
        },
    ),
    "deepvo": SequenceTask(
        "DeepVO (Wang et al., 2017)",
        f"The motion between two pictures, with a memory. {_ON_PICTURES} `localize.deepvo.model` takes it.",
        deepvo.USUAL,
        deepvo.LENGTH,
        deepvo.train_deepvo,
        lambda: deepvo.new_deepvo(DeepVoShape(), 0),
        {
            "input": f"`pair` (1, 6, {HEIGHT}, {WIDTH}) former and latter picture, RGB 0 to 1, and the memory",
            "output": "`motion` (1, 3) dx, dy in metres and dheading in radians, in the former robot frame; the memory",
        },
    ),
}
"""What learns from pictures in a row: `semslam train mapnet` and `semslam train deepvo`."""
EXPORTS: Mapping[str, Callable[[Path, Path | None, int | None, Path | None], list[Path]]] = {
    **{name: task.export for name, task in TASKS.items()},
    "mapper": exported_mapper,
    "mapnet": exported_mapnet,
    "deepvo": exported_deepvo,
}
"""What `semslam models export` can export; arguments as those of `Task.export`."""
