"""Detectors: `Detector.open` recognises a model's layout; `ADAPTERS` is the table of layouts."""

from semslam.models.detections import Detections
from semslam.models.detectors.detector import ADAPTERS, Adapter, Detector, matching, with_known_sizes

__all__ = ["ADAPTERS", "Adapter", "Detections", "Detector", "matching", "with_known_sizes"]
