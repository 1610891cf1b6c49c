"""All stages, in the order of the data: the whole architecture on one page. Imports no stage.

A variant of a stage (an estimator of `localize`) is a task of its own with an entry of its own in the cache.
"""

from __future__ import annotations

from semslam.stages.contract import Stage
from semslam.stages.settings import ExportConfig, ExtractConfig, IngestConfig, LocalizeConfig
from semslam.tables.spec import (
    CELLS,
    DETECTIONS,
    FRAMES,
    LAYERS,
    MOTION,
    OBJECTS,
    OBSERVATIONS,
    PLACES,
    POSES,
    SNAPSHOTS,
    TOPICS,
    TRAJECTORY,
    TRUTH,
)

INGEST = Stage(
    "ingest",
    version=1,
    config=IngestConfig,
    reads=(),
    writes=(TOPICS, FRAMES, MOTION, TRUTH),
    entry="semslam.stages.ingest:run",
    from_log=True,
    optional=(TRUTH,),
    libraries=("numpy", "opencv-contrib-python-headless", "gtsam", "pyarrow"),
)
EXTRACT = Stage(
    "extract",
    version=2,
    config=ExtractConfig,
    reads=(FRAMES,),
    writes=(DETECTIONS, OBSERVATIONS),
    entry="semslam.stages.extract:run",
    libraries=("numpy", "opencv-contrib-python-headless", "onnxruntime", "pyarrow"),
)
LOCALIZE = Stage(
    "localize",
    version=7,
    config=LocalizeConfig,
    reads=(FRAMES, MOTION, OBSERVATIONS),
    writes=(POSES, SNAPSHOTS, CELLS, PLACES),
    optional=(PLACES,),
    entry="semslam.stages.localize:run",
    variants="estimators",
    libraries=("numpy", "opencv-contrib-python-headless", "onnxruntime", "gtsam", "small_gicp", "pyarrow"),
)
EXPORT = Stage(
    "export",
    version=4,
    config=ExportConfig,
    reads=(POSES, CELLS, PLACES, FRAMES, DETECTIONS),
    writes=(TRAJECTORY, OBJECTS, LAYERS),
    entry="semslam.stages.export:run",
    unit="file",
    libraries=("numpy", "opencv-contrib-python-headless", "pyarrow"),
)

STAGES: tuple[Stage, ...] = (INGEST, EXTRACT, LOCALIZE, EXPORT)
