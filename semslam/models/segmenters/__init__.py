"""Segmenters: from boxes to masks, by a SAM-shaped pair of models or from colour and depth alone."""

from semslam.models.segmenters.segmenter import Segmenter, open_segmenter

__all__ = ["Segmenter", "open_segmenter"]
