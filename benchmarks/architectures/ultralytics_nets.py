"""YOLOv8, 10, 11, 26, their segmenting sisters and RT-DETR, built and exported by the ultralytics package (AGPL).

The package is a tool of this benchmark alone: nothing of it is in semslam.
"""

from __future__ import annotations

import contextlib
import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from architectures.made import Answer, Feeds, Made, array, enliven, parameters, thing_names

SIDE = 256
_SELECTING = ("yolov10", "yolo26")
"""Kinds that leave no overlaps; `nms=False` exports them so."""


def ultralytics(kind: str, folder: Path) -> Made:
    """`kind` is a file of the package, such as yolov8n.yaml."""
    import ultralytics as package
    from ultralytics.utils import LOGGER

    LOGGER.setLevel(logging.ERROR)
    model = (package.RTDETR if "rtdetr" in kind else package.YOLO)(kind)
    enliven(model.model, SIDE)
    count = parameters(model.model)
    options = {"nms": False} if kind.startswith(_SELECTING) else {}
    model.model.pt_path = str(folder / kind.replace(".yaml", ".pt"))
    with contextlib.redirect_stdout(io.StringIO()):
        written = model.export(format="onnx", imgsz=SIDE, simplify=False, verbose=False, **options)
    path = Path(written).rename(folder / kind.replace(".yaml", ".onnx"))
    names = [model.model.names[index] for index in range(len(model.model.names))]
    return Made(
        path,
        f"its own export(format='onnx'{', nms=False' if options else ''})",
        count,
        names or thing_names(80),
        _reader(model.model, kind),
    )


def _reader(network: Any, kind: str) -> Any:
    network = network.float().eval()
    if kind.startswith(_SELECTING):
        network.end2end = True

    def read(feeds: Feeds, size: tuple[int, int]) -> Answer:
        with torch.no_grad():
            answer = network(torch.from_numpy(feeds["images"]))[0]
        if isinstance(answer, tuple | list):  # candidates and prototypes
            return _candidates(answer[0][0], size, answer[1][0])
        return _shares(answer[0], size) if "rtdetr" in kind else _candidates(answer[0], size, None)

    return read


def _candidates(answer: torch.Tensor, size: tuple[int, int], prototypes: torch.Tensor | None) -> Answer:
    """(4 + C + K, N) columns, or (N, 6 + K) rows of models without suppression."""
    from ultralytics.utils import ops

    masks = 0 if prototypes is None else prototypes.shape[0]
    if answer.shape[1] == 6 + masks:
        boxes, scores, class_ids, weights = answer[:, :4], answer[:, 4], answer[:, 5].long(), answer[:, 6:]
    else:
        rows = answer.T
        boxes, weights = ops.xywh2xyxy(rows[:, :4]), rows[:, len(answer) - masks :]
        scores, class_ids = rows[:, 4 : len(answer) - masks].max(1)
    boxes = ops.scale_boxes((SIDE, SIDE), boxes.clone(), size)

    def masks_of(chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
        return array(ops.process_mask_native(prototypes, weights[chosen], boxes[chosen], size)) > 0

    return Answer(array(boxes), array(scores), array(class_ids), masks_of if masks else None)


def _shares(rows: torch.Tensor, size: tuple[int, int]) -> Answer:
    """RT-DETR's rows: class probabilities, or of later versions a score and a class."""
    from ultralytics.utils import ops

    boxes = ops.xywh2xyxy(rows[:, :4]) * torch.tensor([size[1], size[0]] * 2)
    scores, class_ids = (rows[:, 4], rows[:, 5].long()) if rows.shape[1] == 6 else rows[:, 4:].max(1)
    return Answer(array(boxes), array(scores), array(class_ids))
