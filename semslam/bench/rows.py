"""What is compared: every row of the tables with the configuration it needs.

A row is an estimator with settings of its own. A row with a network is trained for every protocol and seed; the file
of the network then goes to `model_key`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from semslam.errors import UsageError

PROTOCOLS = ("intra", "cross")
QUALITIES = ("real", "obstructed", "ideal")
FAR_SIDE = 33
"""Cells along a side of the view in the authors' code, nearly 5 m ahead; the paper's text has 11, which are 1.65 m."""
FAR = f"real_h_{FAR_SIDE}"
SIGHTS = (*QUALITIES, FAR)
"""What maps are built from: observations of each quality, and of the real camera with the wide view."""
LEAKS = (0.1, 0.3, 0.7, 1.0)
CONVLSTM = "convlstm"
NOISE_LEVELS = (0.0, 0.5, 1.0, 3.0)
MAPS, NOISE = "maps", "noise"
"""In the place of rows: table 4, and other levels of noise."""

MAPPER = "mapper"
"""The map update by ConvLSTM, 3 x 3 (equation 8)."""
MAPPER_CELL = "mapper_cell"
"""The same with an LSTM a cell, as MapNet has it."""
MAPPER_FAR = f"mapper_h_{FAR_SIDE}"
"""The 3 x 3 one for the wide view; it learns at true poses alone, since finding its own takes too long."""
MAPNET, DEEPVO = "mapnet", "deepvo"


@dataclass(frozen=True)
class Row:
    """One method of a table of poses.

    Attributes:
        estimator: its name in `localize.estimators`; empty if no estimator of semslam makes its track.
        settings: what it changes of the configuration, {"section.key": value}.
        network: kind of network that is trained for it; empty for none.
        model_key: setting that takes the network's file.
        peer: name of the adapter in `peers` that makes its track.
        note: what to know when reading its figures.
    """

    name: str
    title: str
    estimator: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    network: str = ""
    model_key: str = ""
    peer: str = ""
    note: str = ""

    @property
    def reference(self) -> bool:
        """Whether it needs neither estimator nor peer: chance and standing still."""
        return not self.estimator and not self.peer


_PAPER = "localize.paper"
_LEARNED, _LEAKY = ({f"{_PAPER}.update": update} for update in ("learned", "leaky"))


def _learned(name: str, title: str, estimator: str, network: str, **settings: Any) -> Row:
    changed = {f"{_PAPER}.{key}": value for key, value in settings.items()}
    return Row(name, title, estimator, {**_LEARNED, **changed}, network, f"{_PAPER}.model")


def _variant(name: str, title: str, estimator: str = "paper", **settings: Any) -> Row:
    return Row(name, title, estimator, {**_LEAKY, **{f"{_PAPER}.{key}": value for key, value in settings.items()}})


CHANCE = Row("chance", "Chance", note="uniform poses on the map, mean of many draws")
STANDSTILL = Row("standstill", "Standing still", note="the first pose for ever")
DEAD_RECKONING = Row("dead_reckoning", "Dead reckoning", "dead_reckoning", note="the motion u_t alone")

_VISUAL_FAR = _variant("visual_leaky_h_33", "Visual, leaky map, h = 33", "paper_visual", side=FAR_SIDE)
_INERTIAL_FAR = _variant("visual_inertial_leaky_h_33", "Visual-inertial, leaky map, h = 33", side=FAR_SIDE)

TABLE_1 = (
    CHANCE,
    STANDSTILL,
    DEAD_RECKONING,
    Row("deepvo", "DeepVO", "deepvo", network=DEEPVO, model_key="localize.deepvo.model"),
    Row("mapnet", "MapNet", "mapnet", network=MAPNET, model_key="localize.mapnet.model"),
    Row("orb_rgbd", "ORB RGB-D", "orb_rgbd"),
    _learned("visual", "SemanticSLAM, visual", "paper_visual", MAPPER),
    _learned("visual_inertial", "SemanticSLAM, visual-inertial", "paper", MAPPER),
    _learned("visual_h_33", "SemanticSLAM, visual, h = 33", "paper_visual", MAPPER_FAR, side=FAR_SIDE),
    _learned("visual_inertial_h_33", "SemanticSLAM, visual-inertial, h = 33", "paper", MAPPER_FAR, side=FAR_SIDE),
    Row("visual_leaky", "Visual, leaky map", "paper_visual", _LEAKY, note="equation 10, no ConvLSTM"),
    Row("visual_inertial_leaky", "Visual-inertial, leaky map", "paper", _LEAKY, note="likewise"),
    _VISUAL_FAR,
    _INERTIAL_FAR,
    Row("surfel", "surfel", "surfel", note="motion and geometry of the whole log; not of the paper"),
    Row("small_gicp", "small_gicp, scan to map", peer="small_gicp", note="motion and geometry, no semantics"),
    Row("kiss_icp", "kiss-icp", peer="kiss_icp", note="depth as a scan, no motion"),
    Row("pyorbslam3", "pyorbslam3", peer="pyorbslam3"),
)
ABLATION = ("mapnet", "semantic_cell", "visual", "visual_inertial")
"""Rows of the ablation in their order: each adds one thing to the one before."""
ABLATION_TITLES = ("MapNet", "+ semantic observations", "+ ConvLSTM", "+ IMU")
_ABLATION_ONLY = (_learned("semantic_cell", "Visual, LSTM a cell", "paper_visual", MAPPER_CELL),)


def _changed(name: str, title: str, **settings: Any) -> tuple[Row, Row]:
    """One setting changed, in the visual-inertial method and in the visual one."""
    return _variant(name, title, **settings), _variant(f"visual_{name}", f"visual, {title}", "paper_visual", **settings)


_BOTH = (
    (_INERTIAL_FAR, _VISUAL_FAR),
    _changed("r_8", "R = 8", headings=8),
    _changed("r_120", "R = 120", headings=120),
    _changed("binary", "binary observations", binary=True),
    _changed("temperature", "temperature 0.1", temperature=0.1),
    _changed("leak_0.1", "leaky 0.1", leak=0.1),
    _changed("h_33_leak_0.1", "h = 33, leaky 0.1", side=FAR_SIDE, leak=0.1),
)
SETTINGS = (
    _variant("gate_any", 'gate "any"', gate="any"),
    _variant("gates_double", "gates twice as wide", gate_distance_m=0.6, gate_heading_rad=0.2),
    _variant("gates_open", "gates open", gate_distance_m=1e6, gate_heading_rad=3.2),
    *(inertial for inertial, _ in _BOTH),
)
"""The visual-inertial method with a leaky map, one setting changed at a time: where its error comes from."""
SETTINGS_BASE = "visual_inertial_leaky"
VISUAL_SETTINGS = tuple(visual for _, visual in _BOTH)
"""The visual method, likewise; it has no gates."""
VISUAL_SETTINGS_BASE = "visual_leaky"

NOISE_ROWS = ("dead_reckoning", "visual_inertial", "visual_inertial_leaky")
"""Rows that use the motion; not those with the wide view, which take ten times as long."""
ALL = {row.name: row for row in (*TABLE_1, *_ABLATION_ONLY, *SETTINGS, *VISUAL_SETTINGS)}
CROSS_ONLY = frozenset(ALL) - {row.name for row in TABLE_1 if row.settings.get(f"{_PAPER}.side") != FAR_SIDE}
"""What explains the figures of table 1, and the wide view, which takes ten times as long."""


def protocols_of(row: Row) -> tuple[str, ...]:
    """The protocols in which a row is run."""
    return ("cross",) if row.name in CROSS_ONLY else PROTOCOLS


def chosen_rows(names: Sequence[str]) -> tuple[Row, ...]:
    """The rows of those names, in the tables' order; all for none. `maps` and `noise` are no rows.

    Raises:
        UsageError: there is no row of a name.
    """
    for name in names:
        if name not in ALL and name not in (MAPS, NOISE):
            raise UsageError(f"There is no row `{name}`", hint=f"choose from {', '.join((*ALL, MAPS, NOISE))}")
    return tuple(row for name, row in ALL.items() if not names or name in names)


def leaky_name(leak: float) -> str:
    """Name of a heuristic map as a method of table 4."""
    return f"leaky_{leak:.1f}"


MAP_METHODS = (CONVLSTM, *map(leaky_name, LEAKS))
MAP_TITLES = {CONVLSTM: "ConvLSTM", **{leaky_name(leak): f"leaky {leak:.1f}" for leak in LEAKS}}
QUALITY_TITLES = {
    "real": "real camera",
    "obstructed": "obstructed",
    "ideal": "ideal",
    FAR: f"real camera, h = {FAR_SIDE}",
}
