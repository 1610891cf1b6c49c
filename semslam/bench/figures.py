"""The figures of the paper from our results, as SVG that comes out the same whenever the results do.

Colours are Okabe and Ito's, which colour-blind eyes tell apart; every line also carries its name. Needs the extra
`[report]` (matplotlib).
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semslam.bench.published import POSES
from semslam.bench.results import MapResult, Results
from semslam.bench.rows import (
    ALL,
    CONVLSTM,
    MAP_METHODS,
    MAP_TITLES,
    PROTOCOLS,
    QUALITY_TITLES,
    SIGHTS,
    TABLE_1,
    protocols_of,
)
from semslam.bench.statistics import Interval, band, interval
from semslam.labels import FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.pipeline.files import write_text
from semslam.slam.palette import class_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK, _SOFT, _GRID = "#1F2933", "#616E7C", "#E4E7EB"
_STYLE: dict[str, Any] = {
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.edgecolor": _SOFT,
    "axes.labelcolor": _INK,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": _GRID,
    "grid.linewidth": 0.8,
    "xtick.color": _SOFT,
    "ytick.color": _SOFT,
    "text.color": _INK,
    "svg.hashsalt": "semslam",
    "svg.fonttype": "path",
    "figure.dpi": 100,
}
_LABEL_GAP_PT = 11.0
_WEAK = 1.2
_TRACK = "#D6006E"
_NOSE_M = 0.9
"""Line from the robot to where it looks, on maps."""


@dataclass(frozen=True)
class _Line:
    """How a method is drawn wherever it appears."""

    colour: str
    dashes: str = "-"
    width: float = 1.8
    label: str = ""


_METHODS: dict[str, _Line] = {
    "chance": _Line("#9AA5B1", ":", 1.4),
    "standstill": _Line("#9AA5B1", "--", _WEAK),
    "dead_reckoning": _Line("#000000", "--", 1.4),
    "deepvo": _Line("#E69F00"),
    "mapnet": _Line("#D55E00"),
    "orb_rgbd": _Line("#009E73"),
    "surfel": _Line("#117733", width=2.6),
    "visual": _Line("#56B4E9", label="visual"),
    "visual_inertial": _Line("#0072B2", width=2.6, label="visual-inertial"),
    "visual_h_33": _Line("#56B4E9", "--", label="visual, h = 33"),
    "visual_inertial_h_33": _Line("#0072B2", "--", label="visual-inertial, h = 33"),
    "visual_inertial_leaky": _Line("#CC79A7", label="visual-inertial, leaky"),
}
_MAPS: dict[str, _Line] = {
    CONVLSTM: _Line("#0072B2", width=2.6),
    "leaky_0.1": _Line("#E69F00", "-"),
    "leaky_0.3": _Line("#D55E00", "--"),
    "leaky_0.7": _Line("#882255", "-."),
    "leaky_1.0": _Line("#000000", ":"),
}
_PANELS = {"previous": "previous map", "observation": "observation", "updated": "updated map", "truth": "truth"}


def available() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def write_figures(results: Results, folder: Path) -> dict[str, str]:
    """Draw all figures that there are results for; title by file name."""
    makers: list[tuple[str, str, Callable[[], Figure | None]]] = [
        *((f"errors_{p}", f"Error over time, {p}-scene", partial(error_over_time, results, p)) for p in PROTOCOLS),
        ("table1", "Table 1 as a picture", partial(table_1, results)),
        ("map_loss", "Map error over time at true poses", partial(map_loss, results)),
        *((f"map_updates_{q}", f"Map updates, {QUALITY_TITLES[q]}", partial(map_updates, results, q)) for q in SIGHTS),
    ]
    written: dict[str, str] = {}
    for name, title, make in makers:
        with _styled():
            figure = make()
            if figure is not None:
                write_text(folder / f"{name}.svg", svg(figure))
                written[f"{name}.svg"] = title
    return written


@contextmanager
def _styled() -> Iterator[None]:
    """Our style, whatever the user's matplotlib is set to, and no window."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.use("svg")
        matplotlib.rcParams.update(_STYLE)
        yield


def svg(figure: Figure) -> str:
    """The figure as text: no date, and names of parts from a fixed salt, so that equal figures are equal bytes."""
    target = io.StringIO()
    figure.savefig(target, format="svg", metadata={"Date": None, "Creator": None})
    return "\n".join(line.rstrip() for line in target.getvalue().splitlines()) + "\n"


def error_over_time(results: Results, protocol: str) -> Figure | None:
    """Mean position and heading error of every method at every keyframe, with 95 % bands for the paper's own."""
    names = [name for name in _METHODS if name != "standstill" and results.of_row(name, protocol)]
    if not names:
        return None
    figure, axes = _figure(1, 2, width=9.6, height=3.9)
    parts = (("distance_m", "Position error, m"), ("turn_deg", "Heading error, degrees"))
    for axis, (what, title) in zip(axes, parts, strict=True):
        labels = []
        for name in names:
            mean, low, high = band(results.pose_curves(name, protocol, what))
            line = _METHODS[name]
            if name in ("visual", "visual_inertial"):
                axis.fill_between(range(len(mean)), low, high, color=line.colour, alpha=0.14, linewidth=0)
            labels.append(_drawn(axis, mean, line, line.label or ALL[name].title))
        axis.set_title(title)
        axis.set_xlabel("keyframe")
        _finish(axis, labels, results.conditions.steps, figure.get_figheight())
    return figure


def map_loss(results: Results) -> Figure | None:
    """Mean squared error of the maps at every keyframe, one panel a quality."""
    qualities = [q for q in SIGHTS if any(one.quality == q for one in results.maps)]
    if not qualities:
        return None
    figure, axes = _figure(1, len(qualities), width=3.4 * len(qualities) + 0.6, height=3.6, share=True)
    names: list[list[_Label]] = []
    for axis, quality in zip(axes, qualities, strict=True):
        labels: list[_Label] = []
        for method in MAP_METHODS:
            curves = results.map_curves(method, quality)
            if curves.size:
                mean, low, high = (100.0 * values for values in band(curves))
                if method == CONVLSTM:
                    axis.fill_between(range(len(mean)), low, high, color=_MAPS[method].colour, alpha=0.16, linewidth=0)
                labels.append(_drawn(axis, mean, _MAPS[method], MAP_TITLES[method]))
        axis.set_title(QUALITY_TITLES[quality].capitalize())
        axis.set_xlabel("keyframe")
        names.append(labels)
    for axis, labels in zip(axes, names, strict=True):  # once all are drawn: they share their scale
        _finish(axis, labels, results.conditions.steps, figure.get_figheight())
    axes[0].set_ylabel("map error, MSE x 100")
    return figure


def table_1(results: Results) -> Figure | None:
    """Every row of table 1 with its interval, and the published figure as a hollow mark."""
    shown = [(p, row.name) for p in PROTOCOLS for row in TABLE_1 if results.of_row(row.name, p)]
    names = [row.name for row in TABLE_1 if any(name == row.name for _, name in shown)]
    if not names:
        return None
    figure, axes = _figure(1, 2, width=9.6, height=1.3 + 0.36 * len(names), share=True)
    for axis, protocol in zip(axes, PROTOCOLS, strict=True):
        for height, name in enumerate(reversed(names)):
            found = interval(results.poses(name, protocol, "ape_m"))
            _dot(axis, found, height, _METHODS.get(name, _Line(_SOFT)).colour)
            printed = POSES.get((name, protocol))
            if printed and protocol in protocols_of(ALL[name]):
                axis.plot(printed.ape_m, height, "D", color=_INK, fillstyle="none", markersize=6, zorder=3)
        axis.set_title(f"{protocol.capitalize()}-scene: position error, m")
        axis.set_yticks(range(len(names)), [ALL[name].title for name in reversed(names)])
        axis.grid(axis="y", visible=False)
    axes[1].sharex(axes[0])
    axes[0].autoscale(axis="x")
    axes[0].set_xlim(left=0)
    axes[0].tick_params(axis="y", labelcolor=_INK, length=0)
    axes[1].tick_params(axis="y", labelleft=False, length=0)
    axes[1].plot([], [], "D", color=_INK, fillstyle="none", markersize=6, label="published")
    axes[1].plot([], [], "o-", color=_SOFT, markersize=6, label="here, 95 % interval")
    figure.legend(loc="outside lower right", ncols=2, frameon=False, fontsize=8.5)
    return figure


def map_updates(results: Results, quality: str) -> Figure | None:
    """Previous map, observation, updated map and truth at some keyframes of one drive."""
    source = _with_panels(results, quality)
    if source is None:
        return None
    panels, classes = source.values["panels"], source.values["classes"]
    figure, axes = _figure(len(panels), len(_PANELS), width=8.2, height=2.05 * len(panels) + 0.9)
    colours = _class_colours(classes)
    grid = axes.reshape(len(panels), len(_PANELS))
    for row, panel in zip(grid, panels, strict=True):
        for axis, (key, title) in zip(row, _PANELS.items(), strict=True):
            _map_picture(axis, np.array(panel[key]), panel, colours, source.values["cell_m"])
            if panel is panels[0]:
                axis.set_title(title, fontweight="normal")
        row[0].set_ylabel(f"keyframe {panel['step']}", color=_INK)
    _class_legend(figure, panels, classes, colours)
    told = f"{MAP_TITLES[source.method]}, {QUALITY_TITLES[quality]}, {panels[0]['log']}"
    figure.suptitle(f"{told} (square: region of interest; line: heading)", x=0.01, ha="left", fontsize=9.5)
    return figure


def _with_panels(results: Results, quality: str) -> MapResult | None:
    """The ConvLSTM's maps if there are any, else a heuristic's."""
    for method in (CONVLSTM, "leaky_0.3", *MAP_METHODS):
        for one in results.of_method(method, quality):
            if one.values["panels"]:
                return one
    return None


def _figure(rows: int, columns: int, *, width: float, height: float, share: bool = False) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.06))
    axes = figure.subplots(rows, columns, sharey=share, squeeze=False)
    return figure, axes.ravel()


@dataclass(frozen=True)
class _Label:
    """A name to be written at the end of its line."""

    text: str
    colour: str
    x: float
    y: float
    bold: bool


def _drawn(axis: Axes, values: NDArray[np.float64], line: _Line, text: str) -> _Label:
    """Draw a curve; where its name belongs."""
    steps = np.arange(len(values))
    axis.plot(steps, values, color=line.colour, linestyle=line.dashes, linewidth=line.width, solid_capstyle="round")
    known = np.flatnonzero(~np.isnan(values))
    last = int(known[-1]) if known.size else 0
    return _Label(text, line.colour, last, float(values[last]) if known.size else 0.0, line.width > 2.0)


def _finish(axis: Axes, labels: Sequence[_Label], steps: int, height_in: float) -> None:
    """Limits, and the names beside the ends of the lines, pushed apart where they would touch."""
    axis.set_xlim(0, max(1, steps - 1))
    axis.set_ylim(bottom=0)
    low, high = axis.get_ylim()
    height_pt = height_in * 72 * 0.78
    gap = (high - low) * _LABEL_GAP_PT / height_pt
    order = sorted(labels, key=lambda label: label.y)
    for label, place in zip(order, _apart([label.y for label in order], gap, low), strict=True):
        axis.annotate(
            label.text,
            (max(1, steps - 1), place),
            xytext=(5, 0),
            textcoords="offset points",
            color=label.colour,
            fontsize=8.5,
            fontweight="bold" if label.bold else "normal",
            va="center",
            annotation_clip=False,
        )


def _apart(heights: Sequence[float], gap: float, low: float) -> list[float]:
    """Rising heights moved as little as possible so that neighbours are at least `gap` apart and none below `low`."""
    groups: list[tuple[float, int]] = []  # middle, members
    for height in heights:
        group = (height, 1)
        while groups and groups[-1][0] + gap * (groups[-1][1] + group[1]) / 2 > group[0]:
            before, count = groups.pop()
            total = count + group[1]
            group = ((before * count + group[0] * group[1]) / total, total)
        groups.append(group)
    apart: list[float] = []
    for middle, count in groups:
        first = max(middle - gap * (count - 1) / 2, low, apart[-1] + gap if apart else low)
        apart += [first + gap * index for index in range(count)]
    return apart


def _dot(axis: Axes, found: Interval, height: float, colour: str) -> None:
    if not found.known:
        return
    if not math.isnan(found.low):
        axis.plot([found.low, found.high], [height, height], color=colour, linewidth=2.4, solid_capstyle="butt")
    axis.plot(found.mean, height, "o", color=colour, markersize=6)


def _class_colours(classes: Sequence[str]) -> list[str]:
    """A colour a class, those of the map picture of `semslam export`."""
    objects = class_colours(classes[3:])
    fixed = {UNOBSERVED: "#E4E7EB", FREE_FLOOR: "#FFFFFF", OBSTACLE: "#52606D"}
    return [fixed.get(i) or "#{2:02X}{1:02X}{0:02X}".format(*objects[name]) for i, name in enumerate(classes)]


def _map_picture(axis: Axes, ids: NDArray[Any], panel: Mapping[str, Any], colours: list[str], cell_m: float) -> None:
    """A label map with the region of interest and the robot's true pose."""
    from matplotlib.colors import ListedColormap

    half = ids.shape[0] * cell_m / 2
    extent = (-half, half, -half, half)
    shades = ListedColormap(colours)
    axis.imshow(ids, cmap=shades, vmin=0, vmax=len(colours) - 1, origin="lower", extent=extent, interpolation="nearest")
    (top, bottom), (left, right) = ([-half + cell_m * edge for edge in part] for part in panel["window"])
    axis.plot([left, right, right, left, left], [top, top, bottom, bottom, top], color=_TRACK, linewidth=1.0)
    x, y, heading = panel["pose"]
    ahead = x + _NOSE_M * math.cos(heading), y + _NOSE_M * math.sin(heading)
    axis.plot([x, ahead[0]], [y, ahead[1]], color=_TRACK, linewidth=1.6)
    axis.plot(x, y, "o", color=_TRACK, markersize=4)
    axis.set_xticks([]), axis.set_yticks([])
    axis.grid(visible=False)
    for side in axis.spines.values():
        side.set(visible=True, color="#CBD2D9")


def _class_legend(
    figure: Figure, panels: Sequence[Mapping[str, Any]], classes: Sequence[str], colours: list[str]
) -> None:
    """The classes that appear."""
    from matplotlib.patches import Patch

    present = sorted({int(i) for panel in panels for key in _PANELS for i in np.unique(panel[key])})
    patches = [Patch(facecolor=colours[i], edgecolor="#9AA5B1", label=classes[i].replace("_", " ")) for i in present]
    figure.legend(handles=patches, loc="outside lower center", ncols=6, frameon=False, fontsize=8)
