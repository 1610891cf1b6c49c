"""Estimators by name, as `localize.estimators` lists them."""

from __future__ import annotations

from semslam.errors import SemslamError
from semslam.slam.dead_reckoning import DeadReckoning
from semslam.slam.estimator import Estimator
from semslam.slam.paper_estimator import PaperEstimator
from semslam.stages.settings import LocalizeConfig

NAMES = ("paper", "paper_visual", "dead_reckoning")
WITHOUT_MOTION = ("paper_visual",)
"""Those that never look at the motion."""


def open_estimator(name: str, config: LocalizeConfig, classes: tuple[str, ...], cell_m: float, side: int) -> Estimator:
    """The estimator `name` for observations of `side` cells of `cell_m` metres with that class list.

    Raises:
        SemslamError: there is no such estimator, or its configuration does not fit the observations.
    """
    if name in ("paper", "paper_visual"):
        return PaperEstimator(config.paper, len(classes), cell_m, side, config.modes, inertial=name == "paper")
    if name == "dead_reckoning":
        return DeadReckoning()
    raise SemslamError(f"There is no estimator `{name}`", hint=f"choose from {', '.join(NAMES)}")
