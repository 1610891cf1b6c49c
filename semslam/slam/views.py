"""From a row of the frames table (data_spec.md, table 2) to what an estimator that looks at pictures is given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from semslam.slam.estimator import View
from semslam.tables.pictures import decode_colour, decode_depth


def view_of(row: Mapping[str, Any]) -> View:
    """The keyframe's pictures, decoded, with its camera.

    Raises:
        SemslamError: one cannot be decoded.
    """
    return View(
        rgb=decode_colour(row["colour"]),
        depth_m=decode_depth(row["depth"]),
        **{name: row[name] for name in ("fx", "fy", "cx", "cy")},
        robot_from_camera=np.array(row["robot_from_camera"], np.float64).reshape(4, 4),
    )
