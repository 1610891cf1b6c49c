"""MapNet (Henriques and Vedaldi, 2018) behind the estimator's protocol: pictures and depth in, no motion.

The network (models/nets/mapnet.py) is one ONNX graph, a keyframe a call: it makes features of the thumbnail, lays them
on the ground, matches them with its map at every pose bin, and writes them into the map by the field that it found. Its
file tells the grids. The pose is the middle of the best bin.

- The first keyframe stands at the map's centre with heading 0.
- Without a view there is no pose, and the map stays as it is.
- While nothing has been written, everything fits everywhere: the next view is taken for one of the start, as the
  paper's visual mode does with a flat field.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.models.session import Session, open_session
from semslam.models.small_view import HEIGHT, PARTS, WIDTH, cells_of, network_input, small_view
from semslam.slam.checkpoint import pack, unpack
from semslam.slam.estimator import NONE, START, VISUAL, Belief, PoseEstimate, Step, View
from semslam.slam.paper import Field, PoseGrid, field_modes, pose_field

_START = SE2(0.0, 0.0, 0.0)
_INPUTS = ("picture", "cells", "given", "hidden", "cell")


class MapNetEstimator:
    """The pose track that a trained MapNet gives."""

    def __init__(self, model: Path, modes: int) -> None:
        """Open a network.

        Raises:
            SemslamError: the file is missing, damaged, or no MapNet.
        """
        self._session = open_session(model, what="MapNet")
        self._side, self._grid = _grids(self._session)
        self._modes = modes
        shape = next(tensor.shape for tensor in self._session.signature.inputs if tensor.name == "hidden")
        self._hidden: NDArray[np.float32] = np.zeros([int(size) for size in shape], np.float32)
        self._cell = self._hidden
        self._started = self._written = False

    def step(self, step: Step) -> PoseEstimate:
        """Match, then write; a keyframe without a view has no pose."""
        first, self._started = not self._started, True
        if step.view is None:
            return PoseEstimate(_START, START) if first else PoseEstimate(None, NONE)
        blank, self._written = not self._written, True
        field = self._see(step.view, blank)
        if first:
            return PoseEstimate(_START, START)
        return self._anywhere() if blank else self._report(field)

    def belief(self) -> Belief | None:
        """None: the map holds features, not classes."""
        return None

    def state(self) -> bytes:
        """The map, and whether it has begun."""
        flags = np.array([self._started, self._written])
        return pack({"hidden": self._hidden, "cell": self._cell, "flags": flags})

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        arrays = unpack(state)
        self._hidden, self._cell = arrays["hidden"], arrays["cell"]
        self._started, self._written = arrays["flags"].tolist()

    def _see(self, view: View, at_start: bool) -> Field:
        """Run the network on a view, at the known start or wherever it finds itself; its pose field."""
        small = small_view(view.rgb, view.depth_m, view.fx, view.fy, view.cx, view.cy, view.robot_from_camera)
        given = pose_field(_START, self._grid)
        feeds: dict[str, NDArray[Any]] = {
            "picture": network_input(small.picture)[None],
            "cells": cells_of(small.ground_m, self._grid.cell_m, self._side)[None],
            "given": given if at_start else np.zeros_like(given),
            "hidden": self._hidden,
            "cell": self._cell,
        }
        field, self._hidden, self._cell = self._session.run(feeds)
        return field

    def _report(self, field: Field) -> PoseEstimate:
        """The best bin, with what the field says about it."""
        best = tuple(int(index) for index in np.unravel_index(int(field.argmax()), field.shape))
        place = (best[0], best[1], best[2])
        modes = field_modes(field, place, self._grid, self._modes)
        return PoseEstimate(self._grid.pose_of(place), VISUAL, float(field[place]), _entropy_nats(field), modes)

    def _anywhere(self) -> PoseEstimate:
        """What a flat field says: of equal bins the one of the start."""
        bins = self._grid.headings * self._grid.side**2
        return PoseEstimate(_START, VISUAL, 1 / bins, math.log(bins))


def _entropy_nats(field: Field) -> float:
    likely = field[field > 0.0].astype(np.float64)
    return max(0.0, -float((likely * np.log(likely)).sum()))


def _grids(session: Session) -> tuple[int, PoseGrid]:
    """Side of the observation, and the pose bins.

    Raises:
        SemslamError: the file is of another kind of network, or of a version with other thumbnails.
    """
    signature, facts = session.signature, session.signature.metadata
    shapes = {tensor.name: tensor.shape for tensor in signature.inputs}
    try:
        grid = PoseGrid(int(facts["headings"]), int(facts["map_side"]), float(facts["cell_m"]))
        side = int(facts["side"])
    except (KeyError, ValueError):
        grid, side = PoseGrid(0, 0, 0.0), 0
    expected = {"picture": (1, 3, HEIGHT, WIDTH), "cells": (1, PARTS), "given": (grid.headings, grid.side, grid.side)}
    fits = set(shapes) == set(_INPUTS) and all(shapes[name] == shape for name, shape in expected.items())
    sane = side > 0 and side % 2 == 1 and 0 < grid.cell_m < math.inf
    if facts.get("task") != "mapnet" or not sane or not fits:
        raise SemslamError(
            f"`{session.path}` is no MapNet of semslam",
            details=signature.text(),
            hint="set `localize.mapnet.model` to the `mapnet.onnx` of a training",
        )
    return side, grid
