"""What a finished model is worth on views that it has not seen, through the adapters and segmenters of extract."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semslam.errors import SemslamError
from semslam.models.detectors import Detections, Detector
from semslam.models.segmenters import open_segmenter
from semslam.models.training.pictures import PictureSet
from semslam.models.training.scores import (
    BoxScores,
    MaskScores,
    average_precision,
    mask_overlap,
    mask_scores,
    wanted_of,
)

_FAINTEST, _MAX_OVERLAP = 0.01, 0.5


def judged_detector(model: Path, views: PictureSet) -> BoxScores:
    """Average precision of an exported detector on views."""
    detector = Detector.open(model)
    if detector.class_names != views.class_names:
        raise SemslamError(
            f"`{model}` and the views it is to be judged on have different classes",
            details=f"{', '.join(detector.class_names)}\n{', '.join(views.class_names)}",
            hint="judge it on views of the classes it was trained on",
        )
    truth, found = [], list[Detections]()
    for index in range(len(views)):
        picture = views[index]
        truth.append(wanted_of(picture))
        found.append(detector(picture.rgb, _FAINTEST, _MAX_OVERLAP, picture.depth_m))
    return average_precision(truth, found, views.class_names)


def judged_segmenter(encoder: Path, decoder: Path, views: PictureSet) -> MaskScores:
    """Overlap of the masks of an exported pair, from true boxes."""
    segmenter = open_segmenter("sam", str(encoder), str(decoder))
    overlaps, class_ids = list[float | None](), list[int]()
    for index in range(len(views)):
        picture = views[index]
        objects = picture.counting
        boxes = np.array([(item.left, item.top, item.right, item.bottom) for item in objects], np.float32)
        masks = segmenter(picture.rgb, picture.depth_m, boxes.reshape(-1, 4))
        for item, mask in zip(objects, masks, strict=True):
            overlaps.append(mask_overlap(picture.instances == item.instance, mask))
            class_ids.append(item.class_id)
    return mask_scores(overlaps, class_ids, views.class_names)


def box_table(scores: BoxScores) -> str:
    """Markdown, a class a line."""
    head = "| class | objects | lesser glimpses, ignored | AP at 0.5 | AP at 0.5 to 0.95 |\n|---|---|---|---|---|\n"
    columns = (scores.class_names, scores.objects, scores.ignored, scores.ap50, scores.ap50_95)
    rows = [
        f"| {name} | {count} | {ignored} | {_shown(low)} | {_shown(mean)} |"
        for name, count, ignored, low, mean in zip(*columns, strict=True)
    ]
    counts = f"{sum(scores.objects)} | {sum(scores.ignored)}"
    total = f"| **all** | {counts} | **{_shown(scores.map50)}** | **{_shown(scores.map50_95)}** |"
    return head + "\n".join([*rows, total])


def mask_table(scores: MaskScores) -> str:
    """Markdown, a class a line."""
    head = "| class | mean overlap (IoU) from true boxes |\n|---|---|\n"
    rows = [f"| {name} | {_shown(value)} |" for name, value in zip(scores.class_names, scores.by_class, strict=True)]
    total = [f"| **mean of classes** | **{_shown(scores.by_classes)}** |"]
    return head + "\n".join(
        [*rows, *total, f"| **mean of {scores.objects} objects** | **{_shown(scores.by_object)}** |"]
    )


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
