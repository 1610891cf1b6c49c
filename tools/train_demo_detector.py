"""Trains the detector of `semslam demo` on simulated homes and writes the ONNX file and its card.

    pip install -e ".[sim,train]"
    python tools/train_demo_detector.py

Data: pictures of the homes of `semslam simulate --seed 1000` (to test: 2000; the demo's home is of 3000), with the
boxes of their visible pixels as truth. Network: a small anchor-free convolutional detector with two output levels
(strides 8 and 16), trained with task-aligned assignment (Feng et al. 2021, TOOD) as YOLOv8 does. Output layout is that
of YOLOv8: (1, 4 + classes, cells), boxes as centre x, centre y, width, height in input pixels, then class
probabilities. One CPU, no GPU; the same seed and the same number of threads give the same file.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import multiprocessing
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody uses
from numpy.typing import NDArray
from torch import Tensor, nn

from semslam.geometry.camera import Camera
from semslam.models.training.detector import generalised_iou, inside_boxes, pairwise_iou
from semslam.models.training.export import strip_traces
from semslam.sim.boxes import TrueBox, true_boxes
from semslam.sim.dataset import versions
from semslam.sim.eye import Eye, Sight
from semslam.sim.home import CLASSES, Array, Home
from semslam.sim.layout import VARIANTS, free_raster, make_home

WIDTH, HEIGHT = 320, 240
STRIDES = (8, 16)
TRAIN_HOMES = range(1_000_000, 1_000_150)
TEST_HOMES = range(2_000_000, 2_000_020)
VIEWS_A_HOME = 12
SHRINK = 2
"""Pictures are rendered this many times larger than the network's input, as cameras are."""
MIN_PIXELS, MIN_SIDE_PX, MIN_SHARE = 120, 8, 0.25
"""An object counts from this many visible pixels of the input, this side and this share of its silhouette on; lesser
glimpses are neither wanted nor punished."""
FLAT_PIXELS = 20
DATA = Path(__file__).resolve().parent.parent / "semslam" / "data"


@dataclass(frozen=True)
class Example:
    """One picture as JPEG, its boxes (N, 4) left, top, right, bottom, class ids (N,), and boxes to ignore (M, 4)."""

    jpeg: bytes
    boxes: NDArray[np.float32]
    classes: NDArray[np.int64]
    ignored: NDArray[np.float32]


def main() -> None:
    args = _arguments()
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)
    torch.use_deterministic_algorithms(True)
    train, test = _examples(args, "train", TRAIN_HOMES), _examples(args, "test", TEST_HOMES)
    print(f"{len(train)} pictures to train on, {len(test)} to test on", flush=True)
    network = fit(train, steps=args.steps, batch=args.batch, seed=args.seed)
    target = Path(args.out)
    export(network, target)
    report = evaluate(target, test)
    small = evaluate(target, test, shrink=2)
    print(report, small, sep="\n")
    target.with_suffix(".md").write_text(card(target, args, (len(train), len(test)), report, small), encoding="utf-8")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--steps", type=int, default=3500)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2, help="processes that render")
    parser.add_argument("--cache", default="", help="folder to keep the rendered pictures in")
    parser.add_argument("--out", default=str(DATA / "demo_detector.onnx"))
    return parser.parse_args()


# Data


def _examples(args: argparse.Namespace, name: str, homes: Sequence[int]) -> list[Example]:
    """Rendered by as many processes as asked for; order and content do not depend on their number."""
    made_of = [versions(), str(homes), VIEWS_A_HOME, SHRINK, FLAT_PIXELS, MIN_PIXELS, MIN_SIDE_PX, MIN_SHARE]
    key = hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:12]
    stored = Path(args.cache) / f"{name}-{key}.pickle"
    if args.cache and stored.exists():
        rows: list[Example] = pickle.loads(stored.read_bytes())
        return rows
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        examples = [example for found in pool.imap(_home_examples, homes, chunksize=2) for example in found]
    if args.cache:
        stored.parent.mkdir(parents=True, exist_ok=True)
        stored.write_bytes(pickle.dumps(examples))
    return examples


def _home_examples(seed: int) -> list[Example]:
    """Views of one home from free floor, by cameras of different height, pitch and field of view."""
    rng = np.random.default_rng([seed, 0xDE7])
    home = make_home(seed, VARIANTS[0] if rng.random() < 0.8 else "rooms")
    examples: list[Example] = []
    lens = _lens(rng)
    eye, spots = Eye(home, lens), _spots(home)
    for _ in range(4 * VIEWS_A_HOME):
        if len(examples) == VIEWS_A_HOME:
            break
        pose = _pose(rng, spots)
        sight = eye.look(pose)
        seen = [box for box in true_boxes(home, sight, lens, pose) if box.pixels >= FLAT_PIXELS * SHRINK**2]
        if len(seen) >= 2:  # a look at a wall teaches little
            examples.append(_example(sight, seen))
    return examples


def _lens(rng: np.random.Generator) -> Camera:
    """A pinhole of 70 to 95 degrees."""
    width, height = WIDTH * SHRINK, HEIGHT * SHRINK
    focal = width / 2 / np.tan(np.deg2rad(rng.uniform(70, 95)) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _spots(home: Home) -> Array:
    """(N, 2) free places, 0.3 m from everything."""
    free, origin = free_raster(home)
    far = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5) * 0.05 > 0.3
    return np.argwhere(far)[:, ::-1] * 0.05 + np.asarray(origin) + 0.025


def _pose(rng: np.random.Generator, spots: Array) -> Array:
    """A camera somewhere, 0.3 to 0.75 m up, nose level to 20 degrees down."""
    heading, pitch = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(0, 20))
    ahead = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = (*spots[int(rng.integers(len(spots)))], rng.uniform(0.3, 0.75))
    return pose


def _example(sight: Sight, seen: list[TrueBox]) -> Example:
    boxes = np.array([(b.left, b.top, b.right, b.bottom) for b in seen], np.float32).reshape(-1, 4) / SHRINK
    classes = np.array([b.class_id for b in seen], np.int64)
    sides = np.minimum(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1])
    pixels, share = np.array([b.pixels for b in seen]) / SHRINK**2, np.array([b.share for b in seen])
    counts = (pixels >= MIN_PIXELS) & (sides >= MIN_SIDE_PX) & (share >= MIN_SHARE)
    small = cv2.resize(sight.rgb, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    done, jpeg = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    if not done:
        raise RuntimeError("OpenCV could not encode a picture")
    return Example(jpeg.tobytes(), boxes[counts], classes[counts], boxes[~counts])


def _picture(example: Example) -> NDArray[np.uint8]:
    """(H, W, 3) RGB."""
    decoded = cv2.imdecode(np.frombuffer(example.jpeg, np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(decoded[:, :, ::-1], np.uint8)


def _augment(example: Example, rng: np.random.Generator) -> tuple[NDArray[np.float32], Example]:
    """Picture (3, H, W) in 0..1 with other light, colour, sharpness, noise and side; the example with its boxes."""
    picture = cv2.LUT(_picture(example), _exposure(rng))
    if rng.random() < 0.4:
        share = float(rng.uniform(0.4, 0.9))
        small = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        picture = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    mixed = cv2.transform(picture.astype(np.float32) / 255, _saturation(float(rng.uniform(0.5, 1.4))))
    mixed += rng.standard_normal(mixed.shape, np.float32) * np.float32(rng.uniform(0, 0.04))
    if rng.random() < 0.5:
        mixed = mixed[:, ::-1]
        example = replace(example, boxes=_flip(example.boxes), ignored=_flip(example.ignored))
    return np.clip(mixed, 0, 1).transpose(2, 0, 1).copy(), example


def _exposure(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(256, 1, 3) look-up table: gamma, gain, and a cast of colour."""
    ramp = np.arange(256)[:, None] / 255
    curve = ramp ** rng.uniform(0.7, 1.4) * rng.uniform(0.6, 1.3) * rng.uniform(0.8, 1.2, 3)
    return np.asarray((np.clip(curve, 0, 1) * 255).astype(np.uint8)[:, None])


def _saturation(factor: float) -> NDArray[np.float32]:
    """(3, 3) matrix that moves colours away from grey (above 1) or towards it."""
    return np.asarray(factor * np.eye(3) + (1 - factor) / 3, np.float32)


def _flip(boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.stack([WIDTH - boxes[:, 2], boxes[:, 1], WIDTH - boxes[:, 0], boxes[:, 3]], axis=1)


def _batches(examples: list[Example], steps: int, batch: int, seed: int) -> Iterator[tuple[Tensor, list[Example]]]:
    rng = np.random.default_rng([seed, 0xBA7])
    order: list[int] = []
    for _ in range(steps):
        while len(order) < batch:
            order += rng.permutation(len(examples)).tolist()
        chosen, order = order[:batch], order[batch:]
        pairs = [_augment(examples[index], rng) for index in chosen]
        pictures = torch.from_numpy(np.stack([picture for picture, _ in pairs]))
        yield pictures.to(memory_format=torch.channels_last), [example for _, example in pairs]


# Network


def _conv(inputs: int, outputs: int, size: int = 3, stride: int = 1, groups: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, groups=groups, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.SiLU())


def _light(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    """Depthwise, then pointwise."""
    return nn.Sequential(_conv(inputs, inputs, size, stride, groups=inputs), _conv(inputs, outputs, 1))


class Residual(nn.Module):
    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


def _bottleneck(channels: int) -> Residual:
    return Residual(nn.Sequential(_conv(channels, channels // 2, 1), _conv(channels // 2, channels)))


class Head(nn.Module):
    """Class logits and box distances of one level."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.classes = nn.Sequential(_light(channels, channels), nn.Conv2d(channels, len(CLASSES), 1))
        self.boxes = nn.Sequential(_light(channels, channels), nn.Conv2d(channels, 4, 1))
        nn.init.constant_(self.classes[-1].bias, -4.0)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) -> (B, 4 + classes, h * w)"""
        return torch.cat([self.boxes(x), self.classes(x)], 1).flatten(2)


class Detector(nn.Module):
    """(B, 3, 240, 320) RGB in 0..1 -> raw (B, 4 + classes, cells): log distances to the sides, class logits."""

    def __init__(self) -> None:
        super().__init__()
        self.to4 = _conv(3, 24, 7, stride=4)
        self.to8 = nn.Sequential(_conv(24, 48, stride=2), _bottleneck(48), _bottleneck(48))
        self.to16 = nn.Sequential(_light(48, 64, stride=2), _bottleneck(64))
        self.to32 = nn.Sequential(_light(64, 72, stride=2), Residual(_light(72, 72, 5)), Residual(_light(72, 72, 5)))
        self.from32, self.from16 = _conv(72, 64, 1), _conv(64, 48, 1)
        self.join16, self.join8 = Residual(_light(64, 64)), Residual(_light(48, 48))
        self.head8, self.head16 = Head(48), Head(64)

    def forward(self, x: Tensor) -> Tensor:
        p8 = self.to8(self.to4(x))
        p16 = self.to16(p8)
        p32 = self.to32(p16)
        p16 = self.join16(p16 + _double(self.from32(p32))[:, :, : p16.shape[2]])
        p8 = self.join8(p8 + _double(self.from16(p16)))
        return torch.cat([self.head8(p8), self.head16(p16)], 2)


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


def cell_centres() -> tuple[Tensor, Tensor]:
    """(cells, 2) centres in pixels and (cells,) strides, in the order of the network's output."""
    centres, strides = [], []
    for stride in STRIDES:
        rows, columns = HEIGHT // stride, WIDTH // stride
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        centres.append((torch.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride)
        strides.append(torch.full((rows * columns,), float(stride)))
    return torch.cat(centres), torch.cat(strides)


def to_boxes(raw: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """(B, 4, cells) log distances -> (B, cells, 4) left, top, right, bottom in pixels."""
    distances = raw.clamp(-4, 4).exp().transpose(1, 2) * strides[:, None]
    return torch.cat([centres - distances[..., :2], centres + distances[..., 2:]], -1)


class Decoded(nn.Module):
    """The network with decoded output, as it is exported."""

    def __init__(self, network: Detector) -> None:
        super().__init__()
        self.network = network
        centres, strides = cell_centres()
        self.register_buffer("centres", centres)
        self.register_buffer("strides", strides)

    def forward(self, images: Tensor) -> Tensor:
        raw = self.network(images)
        boxes = to_boxes(raw[:, :4], self.centres, self.strides)
        middle, size = (boxes[..., :2] + boxes[..., 2:]) / 2, boxes[..., 2:] - boxes[..., :2]
        return torch.cat([torch.cat([middle, size], -1).transpose(1, 2), raw[:, 4:].sigmoid()], 1)


# Training


def fit(examples: list[Example], *, steps: int, batch: int, seed: int) -> Detector:
    """Train and return the moving average of the weights."""
    network = Detector().to(memory_format=torch.channels_last)  # twice as fast on a CPU
    print(f"{sum(p.numel() for p in network.parameters())} parameters", flush=True)
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.998), use_buffers=True
    )
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=1e-3)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps, pct_start=0.1)
    total = 0.0
    for step, (pictures, truth) in enumerate(_batches(examples, steps, batch, seed), 1):
        loss = detection_loss(network(pictures), truth)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
        rate.step()
        average.update_parameters(network)
        total += loss.item()
        if step % 100 == 0:
            print(f"step {step} of {steps}  loss {total / 100:.3f}", flush=True)
            total = 0.0
    trained: Detector = average.module
    return trained.to(memory_format=torch.contiguous_format).eval()


def detection_loss(raw: Tensor, truth: list[Example]) -> Tensor:
    """Classification against soft targets, and 1 - GIoU of the assigned cells weighted by them."""
    centres, strides = cell_centres()
    boxes, logits = to_boxes(raw[:, :4], centres, strides), raw[:, 4:].transpose(1, 2)
    targets = [assign(boxes[i].detach(), logits[i].detach().sigmoid(), centres, truth[i]) for i in range(len(truth))]
    wanted = torch.stack([target[0] for target in targets])
    goal = torch.stack([target[1] for target in targets])
    used = torch.stack([target[2] for target in targets])
    weight = wanted.sum(-1)
    total = weight.sum().clamp(min=1)
    classification = (F.binary_cross_entropy_with_logits(logits, wanted, reduction="none") * used[..., None]).sum()
    chosen = weight > 0
    regression = ((1 - generalised_iou(boxes[chosen], goal[chosen])) * weight[chosen]).sum()
    return (classification + 4.0 * regression) / total


def assign(boxes: Tensor, scores: Tensor, centres: Tensor, truth: Example) -> tuple[Tensor, Tensor, Tensor]:
    """Which cell answers for which object: soft class targets (cells, classes), boxes (cells, 4), cells that count.

    Each object takes the ten cells inside it whose answer is best, score^0.5 * IoU^4; a cell wanted by several goes
    to the one it overlaps most. Cells on objects too small to count are left out of the loss.
    """
    wanted, goal, used = torch.zeros_like(scores), torch.zeros_like(boxes), torch.ones(len(boxes))
    if len(truth.ignored):
        used[inside_boxes(centres, torch.from_numpy(truth.ignored)).any(0)] = 0
    if not len(truth.boxes):
        return wanted, goal, used
    objects, classes = torch.from_numpy(truth.boxes), torch.from_numpy(truth.classes)
    overlap = pairwise_iou(objects, boxes).clamp(min=1e-6)  # (G, cells)
    quality = scores[:, classes].T.clamp(min=1e-6).sqrt() * overlap**4
    quality = quality * inside_boxes(centres, objects)
    best = quality.topk(10, dim=1)
    mine = torch.zeros_like(quality).scatter_(1, best.indices, 1.0) * (quality > 0)
    owner = (mine * overlap).argmax(0)
    taken = mine.amax(0) > 0
    mine = mine * F.one_hot(owner, len(objects)).T
    quality = quality * mine
    strength = quality / quality.amax(1, keepdim=True).clamp(min=1e-9) * (overlap * mine).amax(1, keepdim=True)
    cells = torch.nonzero(taken).squeeze(1)
    wanted[cells, classes[owner[cells]]] = strength.amax(0)[cells].clamp(min=0.05)
    goal[cells] = objects[owner[cells]]
    used[cells] = 1
    return wanted, goal, used


# Export and evaluation


def export(network: Detector, target: Path) -> None:
    """Write one self-contained ONNX file with the class names in its metadata."""
    target.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        Decoded(network).eval(),
        (torch.zeros(1, 3, HEIGHT, WIDTH),),
        str(target),
        input_names=["images"],
        output_names=["output0"],
        dynamo=True,
        external_data=False,
    )
    model = onnx.load(target)
    strip_traces(model)
    names = dict(enumerate(CLASSES))
    onnx.helper.set_model_props(model, {"names": repr(names), "task": "detect", "license": "Apache-2.0"})
    onnx.checker.check_model(model)
    target.write_bytes(model.SerializeToString(deterministic=True))


def evaluate(model: Path, examples: list[Example], *, min_score: float = 0.3, shrink: int = 1) -> dict[str, float]:
    """Precision and recall at IoU 0.5 of the exported file, all and by class; `shrink` tests smaller cameras."""
    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    counts = np.zeros((3, len(CLASSES)))  # hits, false alarms, misses
    for example in examples:
        picture = _picture(example)
        if shrink > 1:
            small = cv2.resize(picture, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
            picture = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
        images = picture.astype(np.float32).transpose(2, 0, 1)[None] / 255
        found, labels = suppress(session.run(None, {"images": images})[0][0], min_score)
        counts += tally(found, labels, example)
    hits, alarms, misses = counts
    result = {
        "precision": float(hits.sum() / max(1, hits.sum() + alarms.sum())),
        "recall": float(hits.sum() / max(1, hits.sum() + misses.sum())),
    }
    for index, name in enumerate(CLASSES):
        result[f"precision {name}"] = float(hits[index] / max(1, hits[index] + alarms[index]))
        result[f"recall {name}"] = float(hits[index] / max(1, hits[index] + misses[index]))
    return result


def suppress(output: NDArray[np.float32], min_score: float) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Boxes (N, 4) and classes (N,) above `min_score` after non-maximum suppression, best first."""
    middle, size, scores = output[:2].T, output[2:4].T, output[4:].T
    boxes, labels, best = np.hstack([middle - size / 2, middle + size / 2]), scores.argmax(1), scores.max(1)
    order = [index for index in np.argsort(-best, kind="stable") if best[index] >= min_score]
    kept: list[int] = []
    for index in order:
        rivals = [other for other in kept if labels[other] == labels[index]]
        if not rivals or box_iou(boxes[[index]], boxes[rivals]).max() <= 0.5:
            kept.append(int(index))
    return boxes[kept], labels[kept]


def tally(found: NDArray[np.float32], labels: NDArray[np.int64], example: Example) -> NDArray[np.float64]:
    """(3, classes) hits, false alarms and misses; answers on ignored objects count as neither."""
    counts = np.zeros((3, len(CLASSES)))
    open_truth = list(range(len(example.boxes)))
    for box, label in zip(found, labels, strict=True):
        overlaps = [
            float(box_iou(box[None], example.boxes[[index]])[0, 0]) if example.classes[index] == label else 0.0
            for index in open_truth
        ]
        if overlaps and max(overlaps) >= 0.5:
            counts[0, label] += 1
            open_truth.pop(int(np.argmax(overlaps)))
        elif not len(example.ignored) or box_iou(box[None], example.ignored).max() < 0.5:
            counts[1, label] += 1
    for index in open_truth:
        counts[2, example.classes[index]] += 1
    return counts


def box_iou(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 4), (M, 4) -> (N, M)"""
    return np.asarray(pairwise_iou(torch.from_numpy(first), torch.from_numpy(second)).numpy(), np.float32)


def card(
    model: Path, args: argparse.Namespace, pictures: tuple[int, int], report: dict[str, float], small: dict[str, float]
) -> str:
    """The model card, from the run itself."""
    content = model.read_bytes()
    rows = "\n".join(
        f"| {name} | {report[f'precision {name}']:.3f} | {report[f'recall {name}']:.3f} |" for name in CLASSES
    )
    return f"""# demo_detector.onnx

The detector of `semslam demo`, for pictures of simulated homes. It is a toy, trained on simulated homes only, and is of
no use on photographs.

| | |
|---|---|
| file | {len(content) // 1000} kB, SHA-256 `{hashlib.sha256(content).hexdigest()}` |
| input | `images` (1, 3, {HEIGHT}, {WIDTH}), RGB, 0 to 1 |
| output | `output0` (1, {4 + len(CLASSES)}, {len(cell_centres()[1])}), YOLOv8 layout, boxes in input pixels |
| classes | metadata key `names` |
| network | anchor-free, strides 8 and 16, {sum(p.numel() for p in Detector().parameters())} parameters |
| data | {pictures[0]} pictures of homes {TRAIN_HOMES.start} to {TRAIN_HOMES.stop - 1}, rendered by `semslam.sim` |
| command | `python tools/train_demo_detector.py --seed {args.seed} --steps {args.steps} --batch {args.batch} \
--threads {args.threads}` |
| torch | {torch.__version__} |
| date | {datetime.date.today()} |
| licence | Apache-2.0, model and data |

Measured on {pictures[1]} pictures of homes {TEST_HOMES.start} to {TEST_HOMES.stop - 1}, which were not trained on:
IoU 0.5, score 0.3 and above, objects that show {MIN_PIXELS} pixels or more and {MIN_SHARE:.0%} of their silhouette.

| class | precision | recall |
|---|---|---|
| **all** | **{report["precision"]:.3f}** | **{report["recall"]:.3f}** |
{rows}

From pictures of half the size, enlarged: precision {small["precision"]:.3f}, recall {small["recall"]:.3f}.
"""


if __name__ == "__main__":
    main()
