"""Estimators by name, as `localize.estimators` lists them.

Those that need networks or OpenCV are imported when they are opened: dead reckoning loads neither.
"""

from __future__ import annotations

from pathlib import Path

from semslam.errors import SemslamError
from semslam.models.builtin import named_or_shipped
from semslam.slam.dead_reckoning import DeadReckoning
from semslam.slam.estimator import Estimator, WholeLogEstimator
from semslam.slam.paper_estimator import PaperEstimator
from semslam.stages.settings import LocalizeConfig

NAMES = ("surfel", "paper", "paper_visual", "dead_reckoning", "mapnet", "deepvo", "orb_rgbd")
WHOLE_LOGS = ("surfel",)
"""Those that tell all poses at the end (`WholeLogEstimator`); all others tell each at once (`Estimator`)."""
NEEDS_VIEWS = ("surfel", "mapnet", "deepvo", "orb_rgbd")
"""Those that look at the pictures themselves (`Step.view`); all others get none."""
WITHOUT_MOTION = ("paper_visual", "mapnet", "deepvo", "orb_rgbd")
"""Those that never look at the motion."""


def open_estimator(name: str, config: LocalizeConfig, classes: tuple[str, ...], cell_m: float, side: int) -> Estimator:
    """The estimator `name` for observations of `side` cells of `cell_m` metres with that class list.

    Raises:
        SemslamError: there is no such estimator, its configuration does not fit the observations, or its model is
            missing or unsuitable.
    """
    if name in ("paper", "paper_visual"):
        model = model_of(name, config)
        return PaperEstimator(config.paper, classes, cell_m, side, config.modes, inertial=name == "paper", model=model)
    if name == "dead_reckoning":
        return DeadReckoning()
    if name in NEEDS_VIEWS and name not in WHOLE_LOGS:
        return _open_viewer(name, config)
    steps = [one for one in NAMES if one not in WHOLE_LOGS]
    raise SemslamError(f"There is no estimator `{name}` that steps", hint=f"choose from {', '.join(steps)}")


def open_whole(
    name: str, config: LocalizeConfig, classes: tuple[str, ...], cell_m: float, side: int
) -> WholeLogEstimator:
    """The estimator of whole logs of that name, for observations of `side` cells of `cell_m` metres.

    Raises:
        SemslamError: there is none, or the map made before does not fit the observations.
    """
    if name in WHOLE_LOGS:
        from semslam.slam.surfel.estimator import SurfelEstimator
        from semslam.slam.surfel.prior import Grid

        return SurfelEstimator(config.surfel, Grid(classes, cell_m, side), config.modes)
    raise SemslamError(f"There is no estimator of whole logs `{name}`", hint=f"choose from {', '.join(WHOLE_LOGS)}")


def model_of(name: str, config: LocalizeConfig) -> Path | None:
    """The network that an estimator opens, named or shipped; None if it needs none.

    Raises:
        SemslamError: none is named, and none is shipped.
    """
    if name == "mapnet":
        return named_or_shipped(config.mapnet.model, "mapnet", "localize.mapnet.model")
    if name == "deepvo":
        return named_or_shipped(config.deepvo.model, "deepvo", "localize.deepvo.model")
    if name in ("paper", "paper_visual") and config.paper.update == "learned":
        return named_or_shipped(config.paper.model, "map_update", "localize.paper.model")
    return None


def _open_viewer(name: str, config: LocalizeConfig) -> Estimator:
    """An estimator that looks at pictures."""
    model = model_of(name, config)
    if name == "mapnet" and model:
        from semslam.slam.mapnet_estimator import MapNetEstimator

        return MapNetEstimator(model, config.modes)
    if name == "deepvo" and model:
        from semslam.slam.deepvo_estimator import DeepVoEstimator

        return DeepVoEstimator(model)
    from semslam.slam.orb.estimator import OrbEstimator

    return OrbEstimator(config.orb_rgbd)
