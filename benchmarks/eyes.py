"""How well do detector and segmenter see, on homes that nothing was trained on?

    python benchmarks/eyes.py DATASET --detector detector.onnx [--encoder encoder.onnx --decoder decoder.onnx]
        [--rival yolox_nano.onnx --rival-classes coco_classes.txt] [--work FOLDER] [--every 4]
        [--unfamiliar] [--observations] [--pictures FOLDER] [--json FILE] [--quick]

DATASET is a folder of `semslam simulate`; the logs that test across scenes are judged, as far as they are recorded.

* Boxes: average precision by pycocotools, beside chance: the detections of a frame of another home.
* Masks: overlap with the true ones, from true boxes and from detected ones (`--min-score` or better; each object takes
  the one of its class that overlaps it most, by 0.5 at least), beside the segmenters without a network.
* `--rival`: a detector trained on photographs, on the classes that COCO shares, on the same frames. An armchair, which
  is a sofa here and a chair in COCO, is an ignore region for both.
* `--unfamiliar`: the same places in `sim.unfamiliar.estranged` homes, seen by another camera, and what is lost.
* `--observations`: equation 1 from detections (*real camera*) against that of true masks and perfect depth
  (*obstructed*) and against true labels (*ideal*), pooled to the paper's 33 x 33 cells of 0.3 m; objects occupy a cell
  from beta = 0.02 on. Robot and camera pose are true.
* `--pictures`: panels for documents: truth, ours, the rival.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from log_pictures import LogViews, TestLog, armchairs, finished_test_logs, log_views, poses_of, robot_from_camera
from machine import machine
from numpy.typing import NDArray
from sim_detectors import COCO

from semslam.errors import SemslamError
from semslam.geometry.frames import Matrix
from semslam.geometry.grid import Planes, pool_observation, to_dense
from semslam.geometry.projection import Landing, land, observe_landed, points_in_robot
from semslam.labels import FIRST_OBJECT, UNOBSERVED, class_list
from semslam.models.detections import Detections
from semslam.models.detectors import Detector
from semslam.models.segmenters import Segmenter, open_segmenter
from semslam.models.training.pictures import Picture
from semslam.models.training.scores import (
    MaskScores,
    Wanted,
    average_precision,
    hits,
    in_classes,
    mask_overlap,
    mask_scores,
    mean,
    of_class_names,
    paired,
    total_hits,
    wanted_of,
)
from semslam.sim.home import CLASSES
from semslam.sim.log import LogOptions
from semslam.slam.palette import class_colours
from semslam.stages import extract
from semslam.stages.settings import ExtractConfig
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import OBSERVATIONS

LEAST_SCORE = 0.01
"""For average precision, which wants the tail too."""
MAX_OVERLAP = ExtractConfig().max_overlap
POOL, SIDE, BETA = 3, 33, 0.02
"""Cells of 0.1 m to the paper's of 0.3 m, its window, and the noise floor from which a cell counts as occupied."""
PANEL = (400, 300)
JPEG_QUALITY = 82

Cell = str | float | int | None


@dataclass(frozen=True)
class Table:
    """What a section prints and stores."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def markdown(self) -> str:
        """The table for people."""
        lines = [self.columns, tuple("---" for _ in self.columns), *(tuple(map(_shown, row)) for row in self.rows)]
        return f"\n### {self.title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)


@dataclass(frozen=True, eq=False)
class Finder:
    """A detector and which class of ours each of its classes is."""

    detector: Detector
    class_of: Mapping[int, int]

    @staticmethod
    def open(path: Path, classes: Path | None) -> Finder:
        detector = Detector.open(path, classes_path=classes, threads=2)
        return Finder(detector, of_class_names(detector.class_names, CLASSES, COCO))

    def find(self, picture: Picture) -> Detections:
        """Detections in our classes."""
        found = self.detector(picture.rgb, LEAST_SCORE, MAX_OVERLAP, depth_m=picture.depth_m)
        return in_classes(found, self.class_of)


@dataclass(frozen=True, eq=False)
class Judged:
    """A set of pictures and what was found in each, parallel."""

    views: Sequence[LogViews]
    homes: tuple[int, ...]
    truth: tuple[list[Wanted], ...]
    found: tuple[Detections, ...]


def main() -> None:
    """Judge what the command line names."""
    parser = _parser()
    args = parser.parse_args()
    try:
        tables = _judge(args)
    except SemslamError as error:
        parser.exit(error.exit_code, f"error: {error.text()}\n")
    if args.json:
        rows = [
            {"title": table.title, "rows": [dict(zip(table.columns, r, strict=True)) for r in table.rows]}
            for table in tables
        ]
        args.json.write_text(
            json.dumps({"machine": machine(), "command": sys.argv[1:], "tables": rows}, indent=1) + "\n"
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--detector", type=Path, required=True)
    parser.add_argument("--classes", type=Path, help="its class names, one a line, unless the model has them")
    parser.add_argument("--encoder", type=Path, help="of the segmenter")
    parser.add_argument("--decoder", type=Path)
    parser.add_argument("--rival", type=Path, help="detector trained on photographs")
    parser.add_argument("--rival-classes", type=Path)
    parser.add_argument("--work", type=Path, default=Path("eyes-work"), help="where pictures are kept between runs")
    parser.add_argument("--every", type=int, default=4, help="judge every so many keyframes")
    parser.add_argument("--min-score", type=float, default=ExtractConfig().min_score, help="for all but AP")
    parser.add_argument("--unfamiliar", action="store_true", help="also in settings that training never uses")
    parser.add_argument("--observations", action="store_true", help="also the maps of equation 1")
    parser.add_argument("--pictures", type=Path, help="folder for panels")
    parser.add_argument("--panels", type=int, default=8, help="how many")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quick", action="store_true", help="two frames of one log: only to see that it runs")
    return parser


def _judge(args: argparse.Namespace) -> list[Table]:
    """All sections in turn, printed as they are done."""
    print(machine("onnxruntime"))
    logs = _logs(args)
    ours = Finder.open(args.detector, args.classes)
    rival = Finder.open(args.rival, args.rival_classes) if args.rival else None
    segmenters = _segmenters(args)
    tables: list[Table] = []

    def show(*made: Table) -> None:
        for table in made:
            tables.append(table)
            print(table.markdown(), flush=True)

    seen: dict[str, list[Table]] = {}
    for setting in ("familiar", "unfamiliar") if args.unfamiliar else ("familiar",):
        views = [
            log_views(log, args.work, args.every, unfamiliar=setting == "unfamiliar", most=args.most) for log in logs
        ]
        judged = _judged(views, ours)
        seen[setting] = [
            *_box_tables(judged, args.min_score, setting),
            *_mask_tables(judged, segmenters, args.min_score, setting),
        ]
        show(*seen[setting])
        if rival is not None:
            show(_rival_table(judged, _judged(views, rival), rival, setting))
        if args.pictures:
            _draw_panels(args.pictures / setting, judged, segmenters, rival, args)
        if args.observations and setting == "familiar":
            show(*_observation_tables(views, ours, next(iter(segmenters.values())), args.min_score))
    if args.unfamiliar:
        show(_loss_table(seen["familiar"], seen["unfamiliar"]))
    return tables


def _logs(args: argparse.Namespace) -> list[TestLog]:
    """The logs to judge; `most` is set to the number of frames of each."""
    logs, missing = finished_test_logs(args.dataset)
    args.most = 2 if args.quick else None
    if args.quick:
        logs, args.every = logs[:1], 40
    elif missing:
        print(f"\n**Not recorded yet, so not judged: {', '.join(missing)}**")
    if not logs:
        raise SemslamError(f"No finished test log in `{args.dataset}`", hint=f"semslam simulate {args.dataset}")
    print(f"\n{len(logs)} logs of {len({log.home for log in logs})} homes, every {args.every}th keyframe")
    return logs


def _segmenters(args: argparse.Namespace) -> dict[str, Segmenter]:
    """Those to compare, the best first: the one the observations are made with."""
    found: dict[str, Segmenter] = {}
    if args.encoder or args.decoder:
        found["segmenter"] = open_segmenter("auto", str(args.encoder or ""), str(args.decoder or ""), 2)
    return {**found, "depth_box": open_segmenter("depth_box"), "box": open_segmenter("box")}


def _each(views: Sequence[LogViews]) -> Iterator[Picture]:
    for one in views:
        for index in range(len(one.pictures)):
            yield one.pictures[index]


def _judged(views: Sequence[LogViews], eyes: Finder) -> Judged:
    homes = tuple(one.log.home for one in views for _ in one.frames)
    truth, found = [], []
    for picture in _each(views):
        truth.append(wanted_of(picture))
        found.append(eyes.find(picture))
    return Judged(views, homes, tuple(truth), tuple(found))


def _from_another_home(homes: Sequence[int]) -> list[int] | None:
    """For every picture one of another home, half the list away or a little more; None in a single home."""
    if len(set(homes)) < 2:
        return None
    count, chosen = len(homes), []
    for index, home in enumerate(homes):
        ahead = ((index + count // 2 + step) % count for step in range(count))
        chosen.append(next(other for other in ahead if homes[other] != home))
    return chosen


# --------------------------------------------------------------------------------------------------------------- boxes


def _box_tables(judged: Judged, min_score: float, setting: str) -> list[Table]:
    scores = average_precision(judged.truth, judged.found, CLASSES)
    others = _from_another_home(judged.homes)
    chance = others and average_precision(judged.truth, [judged.found[k] for k in others], CLASSES)
    by_class = hits(judged.truth, judged.found, len(CLASSES), min_score)
    rows: list[tuple[Cell, ...]] = [
        (name, scores.objects[k], scores.ap50[k], scores.ap50_95[k], by_class[k].precision, by_class[k].recall)
        for k, name in enumerate(CLASSES)
    ]
    whole = total_hits(by_class)
    rows.append(("**all**", sum(scores.objects), scores.map50, scores.map50_95, whole.precision, whole.recall))
    if chance:
        rows.append(("chance: another home", sum(scores.objects), chance.map50, chance.map50_95, None, None))
    columns = ("class", "objects", "AP50", "AP50-95", f"precision at {min_score:g}", f"recall at {min_score:g}")
    return [Table(f"Boxes, {setting}, {len(judged.truth)} frames", columns, tuple(rows))]


def _rival_table(ours: Judged, theirs: Judged, rival: Finder, setting: str) -> Table:
    """Both detectors on the classes that they share."""
    shared = sorted(set(rival.class_of.values()))
    number = {class_id: place for place, class_id in enumerate(shared)}
    names = [CLASSES[class_id] for class_id in shared]
    truth = [_photographers_view(picture, chairs, number) for picture, chairs in _with_armchairs(ours.views)]
    own, other = (
        average_precision(truth, [in_classes(found, number) for found in one.found], names) for one in (ours, theirs)
    )
    rows: list[tuple[Cell, ...]] = [
        (name, own.objects[k], own.ap50[k], other.ap50[k], own.ap50_95[k], other.ap50_95[k])
        for k, name in enumerate(names)
    ]
    rows.append(("**all**", sum(own.objects), own.map50, other.map50, own.map50_95, other.map50_95))
    columns = ("class", "objects", "AP50 ours", "AP50 rival", "AP50-95 ours", "AP50-95 rival")
    return Table(f"Shared classes, zero-shot rival, {setting}", columns, tuple(rows))


def _with_armchairs(views: Sequence[LogViews]) -> Iterator[tuple[Picture, frozenset[int]]]:
    for one in views:
        chairs = armchairs(one.log)
        for picture in _each([one]):
            yield picture, chairs


def _photographers_view(picture: Picture, chairs: frozenset[int], number: Mapping[int, int]) -> list[Wanted]:
    """The objects of shared classes; an armchair is to be ignored as chair and as sofa."""
    wanted = []
    for item, object_ in zip(wanted_of(picture), picture.objects, strict=True):
        if object_.instance in chairs:
            either = (CLASSES.index("chair"), CLASSES.index("sofa"))
            wanted += [replace(item, class_id=number[k], counts=False) for k in either if k in number]
        elif item.class_id in number:
            wanted.append(replace(item, class_id=number[item.class_id]))
    return wanted


# --------------------------------------------------------------------------------------------------------------- masks


def _mask_tables(judged: Judged, segmenters: Mapping[str, Segmenter], min_score: float, setting: str) -> list[Table]:
    overlaps: dict[tuple[str, str], list[float | None]] = {}
    class_ids: list[int] = []
    pictures = zip(_each(judged.views), judged.truth, judged.found, strict=True)
    for picture, wanted, found in pictures:
        kept = [k for k, item in enumerate(wanted) if item.counts]
        class_ids += [wanted[k].class_id for k in kept]
        true = [picture.instances == picture.objects[k].instance for k in kept]
        boxes = np.array([wanted[k].box for k in kept], np.float32).reshape(-1, 4)
        sure = in_classes(_above(found, min_score), {k: k for k in range(len(CLASSES))})
        pairs = paired([wanted[k] for k in kept], sure)
        for name, segmenter in segmenters.items():
            masks = segmenter(picture.rgb, picture.depth_m, boxes)
            overlaps.setdefault((name, "true boxes"), []).extend(map(mask_overlap, true, masks))
            masks = segmenter(picture.rgb, picture.depth_m, sure.boxes)
            overlaps.setdefault((name, "detected boxes"), []).extend(_overlaps_of_pairs(true, masks, pairs))
        if sure.masks is not None:
            own = overlaps.setdefault(("the detector's own", "detected boxes"), [])
            own.extend(_overlaps_of_pairs(true, sure.masks, pairs))
    scores = {key: mask_scores(values, class_ids, CLASSES) for key, values in overlaps.items()}
    return [_mask_summary(scores, setting), _masks_by_class(scores, setting)]


def _above(found: Detections, min_score: float) -> Detections:
    kept = found.scores >= min_score
    masks = None if found.masks is None else found.masks[kept]
    return replace(
        found, boxes=found.boxes[kept], scores=found.scores[kept], class_ids=found.class_ids[kept], masks=masks
    )


def _overlaps_of_pairs(
    true: Sequence[NDArray[np.bool_]], masks: NDArray[np.bool_], pairs: Sequence[int | None]
) -> list[float | None]:
    return [None if k is None else mask_overlap(mask, masks[k]) for mask, k in zip(true, pairs, strict=True)]


def _mask_summary(scores: Mapping[tuple[str, str], MaskScores], setting: str) -> Table:
    rows = tuple(
        (
            name,
            boxes,
            one.objects,
            one.missed,
            one.by_object,
            one.by_classes,
            one.by_object_missed_0,
            one.by_classes_missed_0,
        )
        for (name, boxes), one in scores.items()
    )
    columns = (
        "segmenter",
        "from",
        "objects",
        "missed",
        "IoU by object",
        "mIoU by class",
        "by object, missed 0",
        "by class, missed 0",
    )
    return Table(f"Masks, {setting}", columns, rows)


def _masks_by_class(scores: Mapping[tuple[str, str], MaskScores], setting: str) -> Table:
    rows = tuple((name, *(one.by_class[k] for one in scores.values())) for k, name in enumerate(CLASSES))
    columns = ("class", *(f"{name}, {boxes}" for name, boxes in scores))
    return Table(f"Mask IoU by class, {setting}", columns, rows)


def _loss_table(familiar: Sequence[Table], unfamiliar: Sequence[Table]) -> Table:
    """The headline numbers of both settings."""
    before, after = _headlines(familiar), _headlines(unfamiliar)
    rows = tuple((name, value, after.get(name), _difference(value, after.get(name))) for name, value in before.items())
    return Table("What unfamiliar settings cost", ("measure", "familiar", "unfamiliar", "change"), rows)


def _headlines(tables: Sequence[Table]) -> dict[str, float | None]:
    boxes, masks, _ = tables
    whole = next(row for row in boxes.rows if row[0] == "**all**")
    found = {f"{name} (boxes)": value for name, value in zip(boxes.columns[2:], whole[2:], strict=True)}
    found |= {f"mask mIoU by class, {row[0]}, {row[1]}": row[5] for row in masks.rows}
    return {name: value for name, value in found.items() if not isinstance(value, str)}


def _difference(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else after - before


# -------------------------------------------------------------------------------------------------------- observations


def _observation_tables(views: Sequence[LogViews], ours: Finder, segmenter: Segmenter, min_score: float) -> list[Table]:
    """Equation 1 from what was detected, against the two better kinds."""
    maps: dict[str, list[Planes]] = {"real camera": [], "true masks, measured depth": [], "obstructed": [], "ideal": []}
    eyes = _extract_eyes(ours, segmenter, min_score)
    for one in views:
        poses = poses_of(one.log)
        stored = {kind: _stored(one.log, kind) for kind in ("obstructed", "ideal")}
        for index, frame in enumerate(one.frames):
            picture = one.pictures[index]
            keyframe = _keyframe(picture, robot_from_camera(one.log, poses[frame]), eyes.config)
            maps["real camera"].append(_real(keyframe, eyes))
            maps["true masks, measured depth"].append(_with_true_masks(picture, keyframe.landing, eyes.config))
            for kind, rows in stored.items():
                maps[kind].append(_pooled(rows[frame]))
    homes = [one.log.home for one in views for _ in one.frames]
    return [_error_table(maps, homes), _occupied_table(maps, homes)]


def _extract_eyes(ours: Finder, segmenter: Segmenter, min_score: float) -> extract.Eyes:
    """Extract as it would run with these models, with those of the detector's classes that are ours, named as ours."""
    names = ours.detector.class_names
    called = {names[k]: CLASSES[own] for k, own in ours.class_of.items()}
    remap = {name: own for name, own in called.items() if name != own}
    config = ExtractConfig(select=tuple(called), exclude=(), remap=remap, min_score=min_score)
    return extract.Eyes(ours.detector, segmenter, extract.ObjectClasses.choose(names, config), config)


def _keyframe(picture: Picture, pose: Matrix, config: ExtractConfig) -> extract.Frame:
    """A picture as extract has it; `pose` is robot_from_camera."""
    depth_m = np.asarray(picture.depth_m, np.float32)
    in_range = (depth_m > 0) & (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
    camera = LogOptions().camera
    landing = land(
        points_in_robot(depth_m * in_range, camera.fx, camera.fy, camera.cx, camera.cy, pose),
        in_range,
        cell_m=config.cell_m,
        side=config.side,
        floor_tolerance_m=config.floor_tolerance_m,
        max_height_m=config.max_height_m,
    )
    return extract.Frame({"frame": 0, "stamp_nanos": 0}, picture.rgb, depth_m, in_range, landing)


def _real(keyframe: extract.Frame, eyes: extract.Eyes) -> Planes:
    """Through extract itself; planes in the order of our classes."""
    (detections,) = extract.find([keyframe], eyes)
    found = extract.cut_out(keyframe, detections, eyes)
    if isinstance(found, SemslamError):
        raise found
    seen, names = extract.look(keyframe, found, eyes).observation, eyes.classes.all
    planes = to_dense(seen["cells"][0], seen["weights"][0], (len(names), eyes.config.side, eyes.config.side))
    ordered = np.zeros((FIRST_OBJECT + len(CLASSES), *planes.shape[1:]), np.float32)
    for place, name in enumerate(class_list(CLASSES)):
        if name in names:
            ordered[place] = planes[names.index(name)]
    return _pooled(ordered)


def _with_true_masks(picture: Picture, landing: Landing, config: ExtractConfig) -> Planes:
    """What is left of the error with perfect eyes: that of the depth camera."""
    masks = np.array([picture.instances == item.instance for item in picture.objects], bool)
    class_ids = np.array([FIRST_OBJECT + item.class_id for item in picture.objects], np.int64)
    masks = masks.reshape(-1, *picture.instances.shape)
    return _pooled(observe_landed(masks, class_ids, landing, FIRST_OBJECT + len(CLASSES), config.min_pixels))


def _stored(log: TestLog, kind: str) -> dict[int, Planes]:
    """Planes of the data set's own observations by keyframe."""
    table = TableFiles(OBSERVATIONS, [log.table(kind)])
    rows, shape = table.read(["frame", "cells", "weights"]), (len(table.meta["classes"]), *(table.meta["side"],) * 2)
    if tuple(table.meta["classes"]) != class_list(CLASSES):
        raise SemslamError(f"`{log.table(kind)}` has other classes", hint="simulate the data set again")
    columns = zip(rows["frame"], rows["cells"], rows["weights"], strict=True)
    return {
        frame: to_dense(np.asarray(cells, np.uint32), np.asarray(weights, np.float32), shape)
        for frame, cells, weights in columns
    }


def _pooled(planes: Planes) -> Planes:
    """(classes, 33, 33): 1 where a class is, objects from beta on."""
    coarse = pool_observation(planes, POOL, SIDE)
    coarse[FIRST_OBJECT:] = coarse[FIRST_OBJECT:] >= BETA
    return coarse


def _error_table(maps: Mapping[str, list[Planes]], homes: Sequence[int]) -> Table:
    rows = []
    for name, planes in _rows_of_maps(maps, homes).items():
        cells: list[Cell] = [name]
        for kind in ("obstructed", "ideal"):
            pairs = list(zip(planes, maps[kind], strict=True))
            cells += [_error(pairs, FIRST_OBJECT), _error(pairs, 0)]
        rows.append(tuple(cells))
    columns = (
        "observation",
        *(f"{kind}: {what}" for kind in ("obstructed", "ideal") for what in ("objects", "all classes")),
    )
    return Table(f"Observation maps, MSE x 100 against, {len(homes)} frames", columns, tuple(rows))


def _rows_of_maps(maps: Mapping[str, list[Planes]], homes: Sequence[int]) -> dict[str, list[Planes]]:
    """What is compared: ours, perfect eyes, the paper's middle quality, an empty map, the map of another frame."""
    real = maps["real camera"]
    empty = np.zeros_like(real[0])
    empty[UNOBSERVED] = 1.0
    others = _from_another_home(homes)
    chance = {"chance: real camera elsewhere": [real[k] for k in others]} if others else {}
    kept = {name: maps[name] for name in ("real camera", "true masks, measured depth", "obstructed")}
    return {**kept, "empty": [empty] * len(real), **chance}


def _error(pairs: Sequence[tuple[Planes, Planes]], first: int) -> float | None:
    """Mean squared difference x 100 over cells and the classes from `first` on."""
    return mean(100.0 * float(np.mean((ours[first:] - true[first:]) ** 2)) for ours, true in pairs)


def _occupied_table(maps: Mapping[str, list[Planes]], homes: Sequence[int]) -> Table:
    """Overlap of the cells that each class occupies, over all frames, with the obstructed maps."""
    columns = {name: _occupied(planes, maps["obstructed"]) for name, planes in _rows_of_maps(maps, homes).items()}
    columns.pop("obstructed")
    names = class_list(CLASSES)
    rows = [(name, *(values[k] for values in columns.values())) for k, name in enumerate(names)]
    rows.append(("**objects**", *(mean(values[FIRST_OBJECT:]) for values in columns.values())))
    return Table("Observation maps, IoU of occupied cells with obstructed", ("class", *columns), tuple(rows))


def _occupied(ours: Sequence[Planes], true: Sequence[Planes]) -> list[float | None]:
    both = np.sum([((a > 0) & (b > 0)).sum((1, 2)) for a, b in zip(ours, true, strict=True)], axis=0)
    either = np.sum([((a > 0) | (b > 0)).sum((1, 2)) for a, b in zip(ours, true, strict=True)], axis=0)
    return [float(n / m) if m else None for n, m in zip(both, either, strict=True)]


# ------------------------------------------------------------------------------------------------------------ pictures


def _draw_panels(
    folder: Path, judged: Judged, segmenters: Mapping[str, Segmenter], rival: Finder | None, args: argparse.Namespace
) -> None:
    """Panels of frames evenly spread over the set: truth | ours | rival."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{one.log.name}_{frame:02}" for one in judged.views for frame in one.frames]
    chosen = {round(k) for k in np.linspace(0, len(names) - 1, min(args.panels, len(names)))}
    segmenter = next(iter(segmenters.values()))
    for index, picture in enumerate(_each(judged.views)):
        if index not in chosen:
            continue
        panels = [_truth_panel(picture), _found_panel(picture, judged.found[index], segmenter, args.min_score, "ours")]
        if rival is not None:
            panels.append(_found_panel(picture, rival.find(picture), None, args.min_score, args.rival.stem))
        sheet = np.ascontiguousarray(np.hstack(panels)[:, :, ::-1])
        cv2.imwrite(str(folder / f"{names[index]}.jpg"), sheet, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])


def _truth_panel(picture: Picture) -> NDArray[np.uint8]:
    """Objects that count, named; glimpses in outline only."""
    canvas = picture.rgb.copy()
    for item in picture.counting:
        _tint(canvas, picture.instances == item.instance, CLASSES[item.class_id])
    for item in picture.glimpses:
        _frame(canvas, (item.left, item.top, item.right, item.bottom), CLASSES[item.class_id], "", 1)
    for item in picture.counting:
        name = CLASSES[item.class_id]
        _frame(canvas, (item.left, item.top, item.right, item.bottom), name, name, 2)
    return _titled(canvas, "truth")


def _found_panel(
    picture: Picture, found: Detections, segmenter: Segmenter | None, min_score: float, title: str
) -> NDArray[np.uint8]:
    canvas, sure = picture.rgb.copy(), _above(found, min_score)
    names = [CLASSES[int(class_id)] for class_id in sure.class_ids]
    if segmenter is not None:
        for mask, name in zip(segmenter(picture.rgb, picture.depth_m, sure.boxes), names, strict=True):
            _tint(canvas, mask, name)
    for box, score, name in zip(sure.boxes.tolist(), sure.scores, names, strict=True):
        _frame(canvas, tuple(box), name, f"{name} {score:.2f}", 2)
    return _titled(canvas, title)


def _colour(name: str) -> tuple[int, int, int]:
    """RGB."""
    blue, green, red = class_colours(CLASSES)[name]
    return red, green, blue


def _tint(canvas: NDArray[np.uint8], mask: NDArray[np.bool_], name: str) -> None:
    canvas[mask] = (0.55 * canvas[mask] + 0.45 * np.array(_colour(name))).astype(np.uint8)


def _frame(canvas: NDArray[np.uint8], box: Sequence[float], name: str, text: str, thick: int) -> None:
    left, top, right, bottom = (round(side) for side in box)
    cv2.rectangle(canvas, (left, top), (right - 1, bottom - 1), _colour(name), thick)
    if text:
        (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        corner = (min(left, canvas.shape[1] - wide - 4), max(top, high + 6))
        cv2.rectangle(canvas, (corner[0], corner[1] - high - 6), (corner[0] + wide + 4, corner[1]), _colour(name), -1)
        dark = sum(_colour(name)) < 330
        ink = (255, 255, 255) if dark else (20, 20, 20)
        cv2.putText(canvas, text, (corner[0] + 2, corner[1] - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.55, ink, 1, cv2.LINE_AA)


def _titled(canvas: NDArray[np.uint8], title: str) -> NDArray[np.uint8]:
    small = cv2.resize(canvas, PANEL, interpolation=cv2.INTER_AREA)
    bar = np.full((22, PANEL[0], 3), 255, np.uint8)
    cv2.putText(bar, title, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
    return np.asarray(np.pad(np.vstack([bar, small]), ((0, 0), (0, 4), (0, 0)), constant_values=255), np.uint8)


def _shown(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.3f}" if isinstance(cell, float) else str(cell)


if __name__ == "__main__":
    main()
