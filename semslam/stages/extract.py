"""Extract: from keyframes to detections and egocentric observation maps.

Reads   frames                       data_spec.md, table 2
Writes  detections, observations     data_spec.md, tables 5 and 6
Paper   section III-A, equation 1
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry import rle
from semslam.geometry.grid import to_sparse
from semslam.geometry.projection import Landing, extent, land, observe_landed, points_in_robot, window
from semslam.labels import FIRST_OBJECT, RESERVED, UNOBSERVED, class_list
from semslam.models.builtin import with_shipped
from semslam.models.detectors import Detections, Detector
from semslam.models.memory import keep_freed_memory
from semslam.models.segmenters import Segmenter, open_segmenter
from semslam.stages.contract import ShardWriter, StageContext, row_shards
from semslam.stages.settings import ExtractConfig
from semslam.tables.parquet import rows_of
from semslam.tables.pictures import decode_colour, decode_depth
from semslam.tables.spec import DETECTIONS, FRAMES, OBSERVATIONS

Row = dict[str, Any]
Columns = dict[str, Any]
"""Equally long columns of a table."""
T = TypeVar("T")

_ROWS_READ = 8
"""Keyframes read at once; what lies in a table is small beside decoded pictures."""


def run(ctx: StageContext) -> None:
    """Detect, segment and project every keyframe, shard by shard.

    Raises:
        SemslamError: no detector, an unsuitable model, a class list that does not fit, an even side.
    """
    config: ExtractConfig = ctx.config
    eyes = Eyes.open(config, ctx.threads)
    frames = ctx.read(FRAMES)
    keep_freed_memory()
    for index, start, stop in row_shards(frames.rows, config.shard_frames):
        if index < len(ctx.finished):
            continue
        groups = ahead(_groups(rows_of(frames.batches(None, start, stop, _ROWS_READ)), config))
        recognised = chain.from_iterable(ahead(_recognised(groups, eyes)))
        with ctx.shard(index) as shard:
            failures = _fill(shard, _counted(recognised, ctx, start, frames.rows), eyes)
            if failures and len(failures) == stop - start:
                raise failures[0]  # not a bad frame, but a model that does not fit


@dataclass(frozen=True)
class ObjectClasses:
    """Which of the detector's classes become which classes of the map."""

    all: tuple[str, ...]
    """Class list of the run: reserved classes, then objects."""
    of_detector: Mapping[int, int]
    """Class id of the run by class id of the detector; dropped classes are absent."""

    @staticmethod
    def choose(names: Sequence[str], config: ExtractConfig) -> ObjectClasses:
        """Apply select, exclude and remap.

        Raises:
            SemslamError: one of them names a class that the detector does not have.
        """
        for key in ("select", "exclude", "remap"):
            for name in getattr(config, key):
                if name not in names and not (key == "exclude" and name == "person"):
                    raise _unknown_class(key, name, names)
        for old, new in config.remap.items():
            if new in RESERVED or not new.strip() or not new.isprintable():
                raise SemslamError(
                    f"`extract.remap` gives class `{old}` the name {new!r}, which no object class may have",
                    hint=f"choose another name; {', '.join(RESERVED)} are reserved",
                )
        kept = [i for i, n in enumerate(names) if (not config.select or n in config.select) and n not in config.exclude]
        renamed = {i: config.remap.get(names[i], names[i]) for i in kept}
        objects = tuple(dict.fromkeys(renamed.values()))
        for name in objects:
            if name in RESERVED or not name.strip() or not name.isprintable():
                raise SemslamError(
                    f"The detector has a class {name!r}, a name that no object class may have",
                    hint="give it another with `extract.remap`, or leave it out with `extract.exclude`",
                )
        if (FIRST_OBJECT + len(objects)) * config.side**2 >= 2**32:
            raise SemslamError(
                f"{len(objects)} classes on {config.side} x {config.side} cells are more than a table can number",
                hint="choose classes with `extract.select`, or lower `extract.side`",
            )
        ids = {name: FIRST_OBJECT + index for index, name in enumerate(objects)}
        return ObjectClasses(class_list(objects), {i: ids[name] for i, name in renamed.items()})


@dataclass(frozen=True)
class Eyes:
    """All that looks at keyframes, as a configuration wants it."""

    detector: Detector
    segmenter: Segmenter
    classes: ObjectClasses
    config: ExtractConfig

    @staticmethod
    def open(config: ExtractConfig, threads: int) -> Eyes:
        """Open the models and choose the classes."""
        detector, segmenter = open_models(config, threads)
        return Eyes(detector, segmenter, ObjectClasses.choose(detector.class_names, config), config)


@dataclass(frozen=True)
class Frame:
    """A keyframe ready for use."""

    row: Row
    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    depth_m: NDArray[np.float32]
    """(H, W), 0 where missing; as measured, for networks know what to make of what is far."""
    in_range: NDArray[np.bool_]
    """(H, W) where depth is there and near enough to be projected."""
    landing: Landing


@dataclass(frozen=True)
class Found:
    """What the models found in a keyframe, of the classes that are kept."""

    boxes: NDArray[np.float32]
    """(N, 4)"""
    scores: NDArray[np.float32]
    """(N,)"""
    source_ids: NDArray[np.int64]
    """(N,) classes of the detector."""
    masks: NDArray[np.bool_]
    """(N, H, W)"""
    dropped: int
    """Boxes that the detector gave with impossible values."""


Recognised = list[tuple[Frame, Found | SemslamError]]
"""A group of keyframes, each with what the models found in it, or why they failed."""


@dataclass(frozen=True)
class Seen:
    """What one keyframe showed."""

    detections: Columns
    observation: Columns
    dropped: int


def open_models(config: ExtractConfig, threads: int) -> tuple[Detector, Segmenter]:
    """Detector and segmenter of a configuration."""
    config = with_shipped(config)
    if not config.detector:
        raise SemslamError(
            "No detector: extract needs an ONNX model that finds objects",
            hint="name one with `--detector FILE.onnx` (and its class names with `--classes FILE.txt`)",
        )
    if config.side % 2 == 0:
        raise SemslamError(
            f"`extract.side` is {config.side}, but the camera stands at the centre of the middle cell",
            hint=f"use an odd number: `--set extract.side={config.side + 1}`",
        )
    detector = Detector.open(
        Path(config.detector),
        classes_path=Path(config.classes) if config.classes else None,
        adapter=config.adapter,
        threads=threads,
    )
    return detector, open_segmenter(config.segmenter, config.segmenter_encoder, config.segmenter_decoder, threads)


def _fill(
    shard: ShardWriter, recognised: Iterable[tuple[Frame, Found | SemslamError]], eyes: Eyes
) -> list[SemslamError]:
    """Write what keyframes show into a shard; returns why some could not be looked at."""
    detector, classes, config = eyes.detector, eyes.classes, eyes.config
    shard.remark(f"detector read as {detector.name}, {len(classes.of_detector)} classes, {detector.provider}")
    shard.note("provider", detector.provider)
    detections = shard.table(DETECTIONS, {"classes": classes.all})
    meta = {"classes": classes.all, "cell_m": config.cell_m, "side": config.side}
    observations = shard.table(OBSERVATIONS, meta)
    failures: list[SemslamError] = []
    dropped = written = 0
    for frame, found in recognised:
        if isinstance(found, SemslamError):
            failures.append(found)
            shard.count("frames_failed")
            shard.warn(f"keyframe {frame.row['frame']} left out: {found.message}")
        seen = blind(frame, config) if isinstance(found, SemslamError) else look(frame, found, eyes)
        detections.append(seen.detections)
        observations.append(seen.observation)
        dropped, written = dropped + seen.dropped, written + _count(shard, seen)
    if dropped and not written:
        shard.warn(f"nothing found: all {dropped} candidates of the detector had impossible values")
    return failures


def _counted(items: Iterable[T], ctx: StageContext, start: int, total: int) -> Iterator[T]:
    """The items; progress is told when the next one is asked for."""
    for done, item in enumerate(items, start + 1):
        yield item
        ctx.progress(done, total)


def _recognised(groups: Iterator[list[Frame]], eyes: Eyes) -> Iterator[Recognised]:
    """Groups of keyframes through the models."""
    for group in groups:
        yield [(frame, cut_out(frame, found, eyes)) for frame, found in zip(group, find(group, eyes), strict=True)]


def find(group: Sequence[Frame], eyes: Eyes) -> list[Detections | SemslamError]:
    """What the detector finds in each keyframe; where it fails on several at once, each is tried alone."""
    config = eyes.config
    pictures, depths_m = [frame.rgb for frame in group], [frame.depth_m for frame in group]
    try:
        return [*eyes.detector.look(pictures, depths_m, config.min_score, config.max_overlap)]
    except SemslamError as error:
        return [error] if len(group) == 1 else [one for frame in group for one in find([frame], eyes)]


def cut_out(frame: Frame, found: Detections | SemslamError, eyes: Eyes) -> Found | SemslamError:
    """The detections of classes that are kept, with their pixels."""
    if isinstance(found, SemslamError):
        return found
    kept = [i for i, class_id in enumerate(found.class_ids.tolist()) if class_id in eyes.classes.of_detector]
    try:
        masks = _masks(frame, found, kept, eyes)
    except SemslamError as error:
        return error
    return Found(found.boxes[kept], found.scores[kept], found.class_ids[kept], masks, found.dropped)


def _masks(frame: Frame, found: Detections, kept: Sequence[int], eyes: Eyes) -> NDArray[np.bool_]:
    """Masks (N, H, W) of the detections kept: the detector's own, if they are wanted and there, else the segmenter's.

    Raises:
        SemslamError: they have another size than the picture, or the segmenter fails.
    """
    if eyes.config.segmenter == "auto" and found.masks is not None:
        masks, by = found.masks[kept], "detector"
    else:
        masks, by = eyes.segmenter(frame.rgb, frame.depth_m, found.boxes[kept]), "segmenter"
    if masks.shape != (len(kept), *frame.depth_m.shape):
        raise SemslamError(
            f"The {by} gives masks {list(masks.shape)} for {len(kept)} objects in a picture "
            f"{list(frame.depth_m.shape)}",
            hint="choose another way to masks: `--set extract.segmenter=depth_box`",
        )
    return masks


def look(frame: Frame, found: Found, eyes: Eyes) -> Seen:
    """One keyframe through equation 1."""
    classes, names = eyes.classes, eyes.detector.class_names
    class_ids = np.array([classes.of_detector[i] for i in found.source_ids.tolist()], np.int64)
    planes = observe_landed(found.masks, class_ids, frame.landing, len(classes.all), eyes.config.min_pixels)
    cells, weights = to_sparse(planes)
    rows = {
        **_who(frame, len(class_ids)),
        "class_id": class_ids,
        "label": [classes.all[i] for i in class_ids.tolist()],
        "source_label": [names[i] for i in found.source_ids.tolist()],
        "score": found.scores,
        **dict(zip(("x0_px", "y0_px", "x1_px", "y1_px"), found.boxes.T, strict=True)),
        **_shapes(frame, found.masks),
    }
    objects = sum(pixels > 0 for pixels in rows["depth_pixels"])
    return Seen(rows, _observation(frame, cells, weights, objects), found.dropped)


def blind(frame: Frame, config: ExtractConfig) -> Seen:
    """What a keyframe tells that could not be looked at: nothing, everywhere."""
    cells = np.arange(config.side**2, dtype=np.uint32) + UNOBSERVED * config.side**2
    nothing: Columns = {column.name: [] for column in DETECTIONS.columns}
    return Seen(nothing, _observation(frame, cells, np.ones(cells.size, np.float32), 0), 0)


def _who(frame: Frame, count: int) -> Columns:
    """The columns that name `count` detections of a keyframe."""
    return {
        "frame": [frame.row["frame"]] * count,
        "stamp_nanos": [frame.row["stamp_nanos"]] * count,
        "detection": list(range(count)),
    }


def _shapes(frame: Frame, masks: NDArray[np.bool_]) -> Columns:
    """The columns that tell the pixels and the 3D extent of every mask."""
    runs = [rle.encode(mask) for mask in masks]
    usable = [_usable_points(frame, mask) for mask in masks]
    spans = [extent(points) for points in usable]
    return {
        "mask_runs": runs,
        "mask_pixels": [int(one[1::2].sum()) for one in runs],
        "depth_pixels": [len(points) for points in usable],
        **{f"min_{axis}_m": [span and float(span[0][i]) for span in spans] for i, axis in enumerate("xyz")},
        **{f"max_{axis}_m": [span and float(span[1][i]) for span in spans] for i, axis in enumerate("xyz")},
    }


def _usable_points(frame: Frame, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Points (n, 3) of the pixels of a mask that have depth."""
    near = window(mask)
    usable = mask[near] & frame.in_range[near]
    return np.stack([axis[usable] for axis in np.moveaxis(frame.landing.points[near], -1, 0)]).T


def _observation(frame: Frame, cells: NDArray[np.uint32], weights: NDArray[np.float32], objects: int) -> Columns:
    """The row of a keyframe in the observations table."""
    row = frame.row
    return {
        "frame": [row["frame"]],
        "stamp_nanos": [row["stamp_nanos"]],
        "cells": [cells],
        "weights": [weights],
        "objects": [objects],
    }


def ahead(items: Iterator[T]) -> Iterator[T]:
    """The same items in the same order, the next one made in a thread while this one is used.

    OpenCV, numpy and ONNX Runtime let go of Python's lock meanwhile, so what is not the models' work hides behind it
    where a processor is free.
    """
    with ThreadPoolExecutor(1) as pool:
        coming: Future[T | None] = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def _groups(rows: Iterator[Row], config: ExtractConfig) -> Iterator[list[Frame]]:
    """Keyframes in groups that the detector sees at once."""
    while group := [_frame(row, config) for row in islice(rows, config.batch)]:
        yield group


def _frame(row: Row, config: ExtractConfig) -> Frame:
    """A keyframe with its pictures decoded and its pixels on the ground; depth out of range counts as missing."""
    rgb, depth_m = decode_colour(row.pop("colour")), decode_depth(row.pop("depth"))
    in_range = (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
    robot_from_camera = np.array(row["robot_from_camera"]).reshape(4, 4)
    points = points_in_robot(depth_m * in_range, row["fx"], row["fy"], row["cx"], row["cy"], robot_from_camera)
    landing = land(
        points,
        in_range & (depth_m > 0),
        cell_m=config.cell_m,
        side=config.side,
        floor_tolerance_m=config.floor_tolerance_m,
        max_height_m=config.max_height_m,
    )
    return Frame(row, rgb, depth_m, in_range & (depth_m > 0), landing)


def _count(shard: ShardWriter, seen: Seen) -> int:
    """Count what a keyframe showed; the number of its detections."""
    detections = len(seen.detections["frame"])
    empty = sum(pixels == 0 for pixels in seen.detections["mask_pixels"])
    if empty:
        shard.count("masks_empty", empty)
    shard.count("detections", detections)
    shard.count("detections_without_depth", detections - seen.observation["objects"][0])
    if seen.dropped:
        shard.count("boxes_impossible", seen.dropped)
    if not detections:
        shard.count("frames_without_objects")
    return detections


def _unknown_class(key: str, name: str, names: Sequence[str]) -> SemslamError:
    near = difflib.get_close_matches(name, names, 1)
    return SemslamError(
        f"`extract.{key}` names the class `{name}`, which the detector does not have",
        details="classes: " + ", ".join(names),
        hint=f"did you mean `{near[0]}`?" if near else "see the classes with `semslam models inspect FILE.onnx`",
    )
