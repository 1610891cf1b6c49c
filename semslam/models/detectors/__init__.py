"""Detectors: `Detector.open` recognises a model's layout; `table.LAYOUTS` is the table of layouts."""

from semslam.models.detections import Detections
from semslam.models.detectors.adapter import Adapter, Look
from semslam.models.detectors.detector import Detector, grouped, matching, with_known_sizes
from semslam.models.detectors.table import ADAPTERS

__all__ = ["ADAPTERS", "Adapter", "Detections", "Detector", "Look", "grouped", "matching", "with_known_sizes"]
