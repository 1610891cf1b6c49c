"""Extract: from keyframes to detections and egocentric observation maps.

Reads   frames                       data_spec.md, table 2
Writes  detections, observations     data_spec.md, tables 5 and 6
Paper   section III-A, equation 1
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry import rle
from semslam.geometry.grid import to_sparse
from semslam.geometry.projection import extent, observe, points_in_robot
from semslam.labels import FIRST_OBJECT, RESERVED, UNOBSERVED, class_list
from semslam.models.detectors import Detector
from semslam.models.segmenters import Segmenter, open_segmenter
from semslam.stages.contract import ShardWriter, StageContext, row_shards
from semslam.stages.settings import ExtractConfig
from semslam.tables.pictures import decode_colour, decode_depth
from semslam.tables.spec import DETECTIONS, FRAMES, OBSERVATIONS, Table

Row = dict[str, Any]


def run(ctx: StageContext) -> None:
    """Detect, segment and project every keyframe, shard by shard.

    Raises:
        SemslamError: no detector, an unsuitable model, a class list that does not fit, an even side.
    """
    config: ExtractConfig = ctx.config
    detector, segmenter = open_models(config, ctx.threads)
    classes = ObjectClasses.choose(detector.class_names, config)
    frames = ctx.read(FRAMES)
    meta = {"classes": classes.all, "cell_m": config.cell_m, "side": config.side}
    for index, start, stop in row_shards(frames.rows, config.shard_frames):
        if index < len(ctx.finished):
            continue
        with ctx.shard(index) as shard:
            shard.remark(f"detector read as {detector.name}, {len(classes.of_detector)} classes, {detector.provider}")
            shard.note("provider", detector.provider)
            detections = shard.table(DETECTIONS, {"classes": classes.all})
            observations = shard.table(OBSERVATIONS, meta)
            failures: list[SemslamError] = []
            for done, frame in enumerate(_frames(frames.batches(None, start, stop, 4), config), start + 1):
                try:
                    seen = look(frame, detector, segmenter, classes, config)
                except SemslamError as error:
                    failures.append(error)
                    shard.warn(f"keyframe {frame.row['frame']} left out: {error.message}")
                    seen = blind(frame, config)
                detections.append(_columns(DETECTIONS, seen.detections))
                observations.append(_columns(OBSERVATIONS, [seen.observation]))
                _count(shard, seen)
                ctx.progress(done, frames.rows)
            if failures:
                shard.count("frames_failed", len(failures))
                if len(failures) == stop - start:
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
        if (FIRST_OBJECT + len(objects)) * config.side**2 >= 2**32:
            raise SemslamError(
                f"{len(objects)} classes on {config.side} x {config.side} cells are more than a table can number",
                hint="choose classes with `extract.select`, or lower `extract.side`",
            )
        ids = {name: FIRST_OBJECT + index for index, name in enumerate(objects)}
        return ObjectClasses(class_list(objects), {i: ids[name] for i, name in renamed.items()})


@dataclass(frozen=True)
class Frame:
    """A keyframe ready for use."""

    row: Row
    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    depth_m: NDArray[np.float32]
    """(H, W), 0 where missing or out of range."""


@dataclass(frozen=True)
class Seen:
    """What one keyframe showed."""

    detections: list[Row]
    observation: Row
    dropped: int
    """Boxes that the detector gave with impossible values."""


def open_models(config: ExtractConfig, threads: int) -> tuple[Detector, Segmenter]:
    """Detector and segmenter of a configuration."""
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


def look(frame: Frame, detector: Detector, segmenter: Segmenter, classes: ObjectClasses, config: ExtractConfig) -> Seen:
    """One keyframe through equation 1."""
    found = detector(frame.rgb, config.min_score, config.max_overlap)
    kept = [i for i, class_id in enumerate(found.class_ids) if int(class_id) in classes.of_detector]
    class_ids = np.array([classes.of_detector[int(found.class_ids[i])] for i in kept], np.int64)
    masks = segmenter(frame.rgb, frame.depth_m, found.boxes[kept])  # (N, H, W)
    points = points_in_robot(
        frame.depth_m,
        frame.row["fx"],
        frame.row["fy"],
        frame.row["cx"],
        frame.row["cy"],
        np.array(frame.row["robot_from_camera"]).reshape(4, 4),
    )
    planes = observe(
        masks,
        class_ids,
        points,
        frame.depth_m > 0,
        len(classes.all),
        cell_m=config.cell_m,
        side=config.side,
        floor_tolerance_m=config.floor_tolerance_m,
        max_height_m=config.max_height_m,
        min_pixels=config.min_pixels,
    )
    cells, weights = to_sparse(planes)
    rows = [
        _detection_row(
            frame,
            index,
            box=found.boxes[i],
            score=found.scores[i],
            class_id=int(class_ids[index]),
            source_label=detector.class_names[int(found.class_ids[i])],
            label=classes.all[int(class_ids[index])],
            mask=masks[index],
            points=points,
        )
        for index, i in enumerate(kept)
    ]
    observation = {
        "frame": frame.row["frame"],
        "stamp_nanos": frame.row["stamp_nanos"],
        "cells": cells,
        "weights": weights,
        "objects": sum(row["depth_pixels"] > 0 for row in rows),
    }
    return Seen(rows, observation, found.dropped)


def blind(frame: Frame, config: ExtractConfig) -> Seen:
    """What a keyframe tells that could not be looked at: nothing, everywhere."""
    cells = np.arange(config.side**2, dtype=np.uint32) + UNOBSERVED * config.side**2
    observation = {
        "frame": frame.row["frame"],
        "stamp_nanos": frame.row["stamp_nanos"],
        "cells": cells,
        "weights": np.ones(cells.size, np.float32),
        "objects": 0,
    }
    return Seen([], observation, 0)


def _detection_row(
    frame: Frame,
    index: int,
    *,
    box: NDArray[np.float32],
    score: float,
    class_id: int,
    source_label: str,
    label: str,
    mask: NDArray[np.bool_],
    points: NDArray[np.float32],
) -> Row:
    """One row of the detections table."""
    window = _window(mask)
    usable = mask[window] & (frame.depth_m[window] > 0)
    span = extent(points[window][usable])
    return {
        "frame": frame.row["frame"],
        "stamp_nanos": frame.row["stamp_nanos"],
        "detection": index,
        "class_id": class_id,
        "label": label,
        "source_label": source_label,
        "score": float(score),
        "x0_px": float(box[0]),
        "y0_px": float(box[1]),
        "x1_px": float(box[2]),
        "y1_px": float(box[3]),
        "mask_runs": rle.encode(mask),
        "mask_pixels": int(mask.sum()),
        "depth_pixels": int(usable.sum()),
        **{f"min_{axis}_m": None if span is None else float(span[0][i]) for i, axis in enumerate("xyz")},
        **{f"max_{axis}_m": None if span is None else float(span[1][i]) for i, axis in enumerate("xyz")},
    }


def _window(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The smallest rectangle of rows and columns that holds a mask; empty for an empty one."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _frames(batches: Iterator[dict[str, list[Any]]], config: ExtractConfig) -> Iterator[Frame]:
    """Decode the pictures of keyframes; depth out of range counts as missing."""
    for batch in batches:
        for index in range(len(batch["frame"])):
            row = {name: values[index] for name, values in batch.items()}
            rgb, depth_m = decode_colour(row.pop("colour")), decode_depth(row.pop("depth"))
            depth_m[(depth_m < config.min_depth_m) | (depth_m > config.max_depth_m)] = 0.0
            yield Frame(row, rgb, depth_m)


def _columns(table: Table, rows: Sequence[Row]) -> dict[str, list[Any]]:
    return {column.name: [row[column.name] for row in rows] for column in table.columns}


def _count(shard: ShardWriter, seen: Seen) -> None:
    shard.count("detections", len(seen.detections))
    shard.count("detections_without_depth", len(seen.detections) - seen.observation["objects"])
    if seen.dropped:
        shard.count("boxes_impossible", seen.dropped)
    if not seen.detections:
        shard.count("frames_without_objects")


def _unknown_class(key: str, name: str, names: Sequence[str]) -> SemslamError:
    near = difflib.get_close_matches(name, names, 1)
    return SemslamError(
        f"`extract.{key}` names the class `{name}`, which the detector does not have",
        details="classes: " + ", ".join(names),
        hint=f"did you mean `{near[0]}`?" if near else "see the classes with `semslam models inspect FILE.onnx`",
    )
