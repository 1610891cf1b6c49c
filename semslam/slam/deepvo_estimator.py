"""DeepVO (Wang et al., 2017) behind the estimator's protocol: the motions that a network sees, one after the other.

The network (models/nets/deepvo.py) takes the thumbnails of the last two keyframes with a view, and its own memory, and
tells the motion between them. Nothing corrects the track: it drifts, as dead reckoning does.

- The first keyframe stands at the origin with heading 0.
- Without a view there is no pose; the next one is paired with the last that was seen, at the pose it had.
- The first view makes no pair. If it is not that of the first keyframe, that one has no pose either: the track goes
  on from the start, and what the robot did before is missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.models.session import Session, open_session
from semslam.models.small_view import HEIGHT, WIDTH, network_input, small_view
from semslam.slam.checkpoint import pack, unpack
from semslam.slam.estimator import NONE, START, VISUAL, Belief, PoseEstimate, Step, View

_START = SE2(0.0, 0.0, 0.0)


class DeepVoEstimator:
    """The pose track that a trained DeepVO gives."""

    def __init__(self, model: Path) -> None:
        """Open a network.

        Raises:
            SemslamError: the file is missing, damaged, or no DeepVO.
        """
        self._session = open_session(model, what="DeepVO")
        self._hidden: NDArray[np.float32] = np.zeros((1, _memory(self._session)), np.float32)
        self._cell = self._hidden
        self._picture: NDArray[np.uint8] | None = None
        self._pose: SE2 | None = None

    def step(self, step: Step) -> PoseEstimate:
        """Go on by the motion since the last keyframe that was seen."""
        first = self._pose is None
        held = self._pose = self._pose or _START
        picture = None if step.view is None else _thumbnail(step.view)
        former, self._picture = self._picture, self._picture if picture is None else picture
        if first:
            return PoseEstimate(held, START)
        if former is None or picture is None:
            return PoseEstimate(None, NONE)
        self._pose = held @ self._motion(former, picture)
        return PoseEstimate(self._pose, VISUAL)

    def belief(self) -> Belief | None:
        """None: there is no map."""
        return None

    def state(self) -> bytes:
        """The last picture and its pose, and the network's memory."""
        pose, picture = self._pose, self._picture
        return pack(
            {
                "pose": np.array([] if pose is None else [pose.x_m, pose.y_m, pose.heading_rad]),
                "picture": np.zeros(0, np.uint8) if picture is None else picture,
                "hidden": self._hidden,
                "cell": self._cell,
            }
        )

    def restore(self, state: bytes) -> None:
        """Go on from `state`."""
        arrays = unpack(state)
        pose = arrays["pose"].tolist()
        self._pose = SE2(*pose) if pose else None
        self._picture = arrays["picture"] if arrays["picture"].size else None
        self._hidden, self._cell = arrays["hidden"], arrays["cell"]

    def _motion(self, former: NDArray[np.uint8], latter: NDArray[np.uint8]) -> SE2:
        """What the network sees between two pictures."""
        pair = np.concatenate([network_input(former), network_input(latter)])[None]  # (1, 6, HEIGHT, WIDTH)
        motion, self._hidden, self._cell = self._session.run({"pair": pair, "hidden": self._hidden, "cell": self._cell})
        return SE2(*(float(part) for part in motion[0]))


def _thumbnail(view: View) -> NDArray[np.uint8]:
    camera = view.fx, view.fy, view.cx, view.cy
    return small_view(view.rgb, view.depth_m, *camera, view.robot_from_camera).picture


def _memory(session: Session) -> int:
    """Cells of the network's memory.

    Raises:
        SemslamError: the file is of another kind of network, or of a version with other thumbnails.
    """
    signature = session.signature
    shapes = {tensor.name: tensor.shape for tensor in signature.inputs}
    fits = set(shapes) == {"pair", "hidden", "cell"} and shapes["pair"] == (1, 6, HEIGHT, WIDTH)
    if signature.metadata.get("task") != "deepvo" or not fits:
        raise SemslamError(
            f"`{session.path}` is no DeepVO of semslam",
            details=signature.text(),
            hint="set `localize.deepvo.model` to the `deepvo.onnx` of a training",
        )
    return int(shapes["hidden"][1])
