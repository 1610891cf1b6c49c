"""Do detectors trained on photographs recognise simulated furniture?

    python benchmarks/sim_detectors.py DETECTOR.onnx [--classes coco_classes.txt] [--scenes 6] [--frames 30]
        [--seed 1] [--min-score 0.3] [--strict] [--pictures FOLDER] [--quick]

Draws the first frames of the first log of the first scenes that `semslam simulate --seed 1` records, with noise of the
same kind drawn anew and no JPEG, and prints recall and precision of a COCO detector at IoU 0.5 for the classes that
COCO shares. *Whole* objects show at least 75 % of their silhouette, 400 pixels and no edge of the picture; detections
on lesser glimpses of the right class count neither for nor against. An armchair, which is a sofa here and a chair in
COCO, may be called either; `--strict` takes that back. The baseline is the same boxes against truth of another scene
(chance).
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from machine import machine
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.models.detectors import Detector
from semslam.sim.boxes import TrueBox, true_boxes
from semslam.sim.dataset import Recipe, Recording
from semslam.sim.eye import Eye
from semslam.sim.home import CLASSES
from semslam.sim.layout import free_raster, make_home
from semslam.sim.sensors import draw_colour_camera, measure_rgb
from semslam.sim.vehicle import draw_robot, drive

COCO = {
    "chair": "chair",
    "couch": "sofa",
    "sofa": "sofa",
    "potted plant": "plant",
    "pottedplant": "plant",
    "bed": "bed",
    "dining table": "table",
    "diningtable": "table",
    "toilet": "toilet",
    "tv": "tv",
    "tvmonitor": "tv",
    "refrigerator": "refrigerator",
}
WHOLE_SHARE, WHOLE_PIXELS, MIN_IOU = 0.75, 400, 0.5


@dataclass(frozen=True)
class Found:
    """A detection of a shared class."""

    box: NDArray[np.float32]
    class_name: str


@dataclass(frozen=True)
class Named:
    """A true box and the class names that are right for it, its own first."""

    box: TrueBox
    names: tuple[str, ...]


@dataclass(frozen=True)
class Frame:
    """What is there and what was found."""

    truth: list[Named]
    found: list[Found]


def main() -> None:
    """Render, detect, count."""
    args = _arguments()
    scenes, frames = (1, 3) if args.quick else (args.scenes, args.frames)
    print(machine())
    detector = Detector.open(args.detector, classes_path=args.classes, threads=2)
    recipe = Recipe(scenes=scenes, trajectories=1, steps=frames, seed=args.seed)
    seen = [_frames(recording, detector, args) for recording in recipe.recordings()]
    _report("its own scene", [frame for scene in seen for frame in scene])
    if len(seen) > 1:
        others = [
            Frame(truth.truth, found.found)
            for scene, other in zip(seen, seen[1:] + seen[:1], strict=True)
            for truth, found in zip(scene, other, strict=True)
        ]
        _report("chance: the boxes of another scene", others)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("detector", type=Path)
    parser.add_argument("--classes", type=Path, help="class names, one a line, unless the model has them")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--min-score", type=float, default=0.3)
    parser.add_argument("--strict", action="store_true", help="an armchair called chair is a mistake")
    parser.add_argument("--pictures", type=Path, help="folder for some frames with their boxes drawn")
    parser.add_argument("--quick", action="store_true", help="one scene, three frames: only to see that it runs")
    return parser.parse_args()


def _frames(recording: Recording, detector: Detector, args: argparse.Namespace) -> list[Frame]:
    home = make_home(recording.home_seed, recording.variant)
    robot = draw_robot(recording.home_seed)
    way = drive(home, free_raster(home), robot, recording.drive_seed, steps=recording.steps)
    camera = Camera(640, 480, 320.0, 320.0, 319.5, 239.5)
    eye, frames = Eye(home, camera), []
    rng = np.random.default_rng([recording.drive_seed, 0xC0C0])
    lens = draw_colour_camera(rng)
    for index, time_s in enumerate(way.keyframes_s):
        pose = way.world_from_base(float(time_s)) @ robot.base_from_camera
        sight = eye.look(pose, float(time_s))
        rgb = measure_rgb(sight.rgb, rng, lens)
        found = detector(rgb, args.min_score, 0.5)
        names = [COCO.get(detector.class_names[label]) for label in found.class_ids]
        shared = [Found(box, name) for box, name in zip(found.boxes, names, strict=True) if name]
        armchairs = {item.instance for item in home.objects if item.piece.style == "armchair" and not args.strict}
        truth = [
            Named(box, (CLASSES[box.class_id], *(("chair",) if box.instance in armchairs else ())))
            for box in true_boxes(home, sight, camera, pose)
        ]
        frames.append(Frame(truth, shared))
        if args.pictures and index % 5 == 0:
            _draw(args.pictures / f"{recording.name}_{index:02}.jpg", rgb, shared)
    return frames


def _report(title: str, frames: list[Frame]) -> None:
    wanted, hit, good, bad = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    for frame in frames:
        for item in frame.truth:
            name = item.names[0]
            if name in COCO.values() and _whole(item.box):
                wanted[name] += 1
                right = [found.box for found in frame.found if found.class_name in item.names]
                hit[name] += any(_iou(box, item.box) >= MIN_IOU for box in right)
        for found in frame.found:
            same = [item.box for item in frame.truth if found.class_name in item.names]
            matched = [box for box in same if _iou(found.box, box) >= MIN_IOU]
            if any(_whole(box) for box in matched):
                good[found.class_name] += 1
            elif not any(_inside(found.box, box) for box in same):
                bad[found.class_name] += 1
    print(f"\n{title}: {len(frames)} frames\nclass          whole  recall  found  precision")
    for name in [*sorted(set(COCO.values())), "all"]:
        rows = [counter.total() if name == "all" else counter[name] for counter in (wanted, hit, good, bad)]
        recall = f"{rows[1] / rows[0]:.2f}" if rows[0] else "-"
        precision = f"{rows[2] / (rows[2] + rows[3]):.2f}" if rows[2] + rows[3] else "-"
        print(f"{name:14} {rows[0]:5}  {recall:>6}  {rows[2] + rows[3]:5}  {precision:>9}")
    sys.stdout.flush()


def _whole(box: TrueBox) -> bool:
    return box.share >= WHOLE_SHARE and box.pixels >= WHOLE_PIXELS and not box.cut


def _inside(found: NDArray[np.float32], box: TrueBox) -> bool:
    """If a detection lies mostly on the visible part of an object: half of either's area."""
    shared = _shared(found, box)
    area = float((found[2] - found[0]) * (found[3] - found[1]))
    return shared >= 0.5 * min(area, (box.right - box.left) * (box.bottom - box.top))


def _shared(found: NDArray[np.float32], box: TrueBox) -> float:
    width = min(float(found[2]), box.right) - max(float(found[0]), box.left)
    height = min(float(found[3]), box.bottom) - max(float(found[1]), box.top)
    return max(0.0, width) * max(0.0, height)


def _iou(found: NDArray[np.float32], box: TrueBox) -> float:
    shared = _shared(found, box)
    area = float((found[2] - found[0]) * (found[3] - found[1]))
    return shared / (area + (box.right - box.left) * (box.bottom - box.top) - shared)


def _draw(path: Path, rgb: NDArray[np.uint8], found: list[Found]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = np.ascontiguousarray(rgb[:, :, ::-1])
    for item in found:
        left, top, right, bottom = (round(float(value)) for value in item.box)
        cv2.rectangle(picture, (left, top), (right, bottom), (40, 40, 230), 2)
        cv2.putText(picture, item.class_name, (left + 3, top + 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 230), 1)
    cv2.imwrite(str(path), picture)


if __name__ == "__main__":
    main()
