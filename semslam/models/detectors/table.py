"""The table of layouts."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from semslam.models.detectors.adapter import Adapter

LAYOUTS = (
    "rgbd",
    "yolox",
    "nanodet",
    "yolov5",
    "yolov8",
    "yolov8_seg",
    "yolov3",
    "yolov3_zoo",
    "yolov10",
    "rtdetr",
    "detr",
    "class_map",
)
"""Modules of this package, each with `ADAPTERS`. A model is read by the first adapter that fits."""


def adapters(layouts: Sequence[str]) -> tuple[Adapter, ...]:
    """The adapters of these modules, in their order."""
    modules = [import_module(f"semslam.models.detectors.{layout}") for layout in layouts]
    found: tuple[Adapter, ...] = tuple(adapter for module in modules for adapter in module.ADAPTERS)
    return found


ADAPTERS = adapters(LAYOUTS)
"""All adapters, tried in this order."""
