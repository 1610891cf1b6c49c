"""How accuracy and coverage depend on the rate of keyframes: the same drives, seen at 10 to 0.2 Hz.

    semslam simulate fast --scenes 2 --trajectories 1 --steps 400 --rate 10 --seed 5
    python benchmarks/rates.py fast/logs/*.mcap --out OUT [--svg rates.svg]

Prints a table and draws it, with small_gicp on motion, dead reckoning and standing still beside semslam's estimators.
The figure needs `pip install '.[report]'`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import machine
from peers import peer_scores

RATES_HZ = (10.0, 2.0, 1.0, 0.5, 0.2)
ESTIMATORS = ("surfel", "paper", "paper_visual", "orb_rgbd", "mapnet", "deepvo", "dead_reckoning")
PEER = "small_gicp"
ROWS = (*ESTIMATORS[:1], PEER, *ESTIMATORS[1:], "chance", "standstill")
SEMSLAM = [sys.executable, "-m", "semslam.pipeline.cli"]
COLOURS = {
    "surfel": "#d6006c",
    "small_gicp": "#0072B2",
    "orb_rgbd": "#009E73",
    "paper": "#E69F00",
    "mapnet": "#882255",
    "deepvo": "#56B4E9",
    "dead_reckoning": "#4d5663",
}


@dataclass(frozen=True)
class Point:
    """A method at a rate: means over the logs, and the worst."""

    ape_m: float | None
    de_deg: float | None
    worst_m: float | None
    coverage: float


def main() -> None:
    """Run all methods at all rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs, one folder a rate")
    parser.add_argument("--svg", type=Path, help="draw the figure there")
    parser.add_argument("--estimator", action="append", choices=ESTIMATORS, help="default: all")
    parser.add_argument("--rate", action="append", type=float, help="default: 10, 2, 1, 0.5, 0.2")
    parser.add_argument("--peer-until", type=float, default=10.0, help="rate up to which small_gicp runs too")
    args = parser.parse_args()
    rates = sorted(args.rate or RATES_HZ, reverse=True)
    print(machine("small_gicp"))
    chosen = args.estimator or ESTIMATORS
    found = {rate: at_rate(rate, args.logs, args.out, chosen, peer=rate <= args.peer_until) for rate in rates}
    tell(found)
    if args.svg:
        draw(found, args.svg)


def at_rate(rate: float, logs: Sequence[Path], out: Path, estimators: Sequence[str], *, peer: bool) -> dict[str, Point]:
    """All methods at one rate."""
    folder = out / f"{rate:g}_hz"
    period = 0.0 if rate >= max(RATES_HZ) else 1.0 / rate
    names = [part for name in estimators for part in ("--estimator", name)]
    run = [*SEMSLAM, "localize", *map(str, logs), "--out", str(folder), "--quiet", *names]
    subprocess.run([*run, "--set", f"ingest.period_s={period}"], check=True, stderr=subprocess.DEVNULL)
    told = subprocess.run([*SEMSLAM, "evaluate", str(folder), "--json"], check=True, capture_output=True, text=True)
    scores: dict[str, list[Mapping[str, Any]]] = {}
    for line in json.loads(told.stdout)["scores"]:
        scores.setdefault(line["estimator"], []).append(line)
    if peer:
        scores[PEER] = [vars(one) for _, one in peer_scores(folder, PEER)]
    return {name: mean(lines) for name, lines in scores.items()}


def mean(lines: Sequence[Mapping[str, Any]]) -> Point:
    """Over logs; those without a pose lower the coverage only."""
    known = [line for line in lines if line["ape_m"] is not None]
    coverage = sum(line["coverage"] for line in lines) / len(lines)
    if not known:
        return Point(None, None, None, coverage)
    ape, de = (sum(line[name] for line in known) / len(known) for name in ("ape_m", "de_deg"))
    return Point(ape, de, max(line["ape_worst_m"] for line in known), coverage)


def tell(found: Mapping[float, Mapping[str, Point]]) -> None:
    """Position and heading error, worst position error and coverage."""
    print("\n| | " + " | ".join(f"{rate:g} Hz" for rate in found) + " |")
    print("|---" * (len(found) + 1) + "|")
    for name in ROWS:
        points = [of_rate.get(name) for of_rate in found.values()]
        if any(points):
            print(f"| `{name}` | " + " | ".join(shown(point) for point in points) + " |")


def shown(point: Point | None) -> str:
    """One cell."""
    if point is None:
        return "-"
    if point.ape_m is None:
        return "no pose"
    return f"{point.ape_m:.3f} m, {point.de_deg:.2f} deg, worst {point.worst_m:.2f} m, {point.coverage:.0%}"


def draw(found: Mapping[float, Mapping[str, Point]], path: Path) -> None:
    """Error and coverage over the rate."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "semslam", "svg.fonttype": "none", "font.size": 9})
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9.6, 3.8), layout="constrained")
    rates = list(found)
    for name, colour in COLOURS.items():
        points = [of_rate.get(name) for of_rate in found.values()]
        if not any(points):
            continue
        width = 2.6 if name == "surfel" else 1.5
        errors = [point.ape_m if point and point.ape_m is not None else float("nan") for point in points]
        covered = [100 * point.coverage if point else float("nan") for point in points]
        for axis, values in zip(axes, (errors, covered), strict=True):
            axis.plot(rates, values, color=colour, linewidth=width, marker="o", markersize=3.5, label=name)
    for axis, title in zip(axes, ("Mean position error, m", "Keyframes with a pose, %"), strict=True):
        axis.set_xscale("log")
        axis.set_xticks(rates, [f"{rate:g}" for rate in rates])
        axis.minorticks_off()
        axis.invert_xaxis()
        axis.set_xlabel("keyframes a second")
        axis.set_title(title, loc="left")
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_yscale("log")
    axes[1].set_ylim(0, 104)
    names, labels = axes[0].get_legend_handles_labels()
    figure.legend(names, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=8)
    figure.savefig(path, metadata={"Date": None, "Creator": None})


if __name__ == "__main__":
    main()
