"""The tables of the paper beside ours: Markdown for people, CSV and Parquet for whoever computes on."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from semslam.bench.maps import CELL_SETS
from semslam.bench.published import MAPS, POSES, UNPRINTED
from semslam.bench.results import Results, rows_in
from semslam.bench.rows import (
    ABLATION,
    ABLATION_TITLES,
    ALL,
    CONVLSTM,
    MAP_METHODS,
    MAP_TITLES,
    NOISE_LEVELS,
    NOISE_ROWS,
    PROTOCOLS,
    QUALITY_TITLES,
    SETTINGS,
    SETTINGS_BASE,
    SIGHTS,
    TABLE_1,
    VISUAL_SETTINGS,
    VISUAL_SETTINGS_BASE,
    Row,
    protocols_of,
)
from semslam.bench.statistics import Interval, interval, paired
from semslam.pipeline.files import write_text

TIMES = "training_times.md"
_NONE = "-"
_PER_CENT = 100.0


@dataclass(frozen=True)
class Sheet:
    """A table to be read: `name` is that of its files."""

    name: str
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """As Markdown, the first column to the left, figures to the right."""
        lines = [self.head, ["---", *["---:"] * (len(self.head) - 1)], *self.rows]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        notes = "".join(f"\n{note}\n" for note in self.notes)
        return f"## {self.title}\n\n{table}\n{notes}"


def sheets(results: Results) -> list[Sheet]:
    """All tables that have a row."""
    made = [
        *(pose_sheet(results, protocol) for protocol in PROTOCOLS),
        ablation_sheet(results),
        *(map_sheet(results, cells) for cells in CELL_SETS),
        margin_sheet(results),
        quality_sheet(results),
        *(class_sheet(results, quality) for quality in SIGHTS),
        *settings_sheets(results),
        found_sheet(results),
        noise_sheet(results),
        missing_sheet(results),
    ]
    return [sheet for sheet in made if sheet.rows]


def pose_sheet(results: Results, protocol: str) -> Sheet:
    """Table 1 of the paper for one protocol."""
    names = rows_in(results, [row.name for row in TABLE_1 if protocol in protocols_of(row)])
    rows = tuple(_pose_row(results, name, protocol) for name in names)
    tests = results.conditions.test_logs.get(protocol, 0)
    return Sheet(
        f"table1_{protocol}",
        f"Table 1, {protocol}-scene: position (APE) and heading (DE) errors",
        ("method", "APE published", "APE here, m", "DE published", "DE here, deg", "coverage", "seeds x drives"),
        rows,
        (f"{tests} drives test. Brackets: 95 % interval. A dash: not run, or no pose; see below.",),
    )


def _pose_row(results: Results, name: str, protocol: str) -> tuple[str, ...]:
    printed = POSES.get((name, protocol))
    ape, de, coverage = (interval(results.poses(name, protocol, what)) for what in ("ape_m", "de_deg", "coverage"))
    published = (f"{printed.ape_m:.2f}", f"{printed.de_deg:.1f}") if printed else (UNPRINTED.get(name, ""),) * 2
    return (
        ALL[name].title,
        published[0],
        _with_interval(ape, 2),
        published[1],
        _with_interval(de, 1),
        f"{coverage.mean:.0%}" if coverage.known else _NONE,
        f"{coverage.seeds} x {coverage.drives}" if coverage.known else "not run",
    )


def ablation_sheet(results: Results) -> Sheet:
    """The paper's ablation: what each addition changes, there and here."""
    known = set(rows_in(results, ABLATION))
    rows, before = [], ""
    for name, title in zip(ABLATION, ABLATION_TITLES, strict=True):
        if name in known:
            rows.append((title, *_step_cells(results, name, before)))
        before = name
    return Sheet(
        "ablation",
        "Ablation, cross-scene: what each addition changes",
        (
            "method",
            "APE published",
            "change",
            "APE here, m",
            "change, paired",
            "DE published",
            "DE here, deg",
            "change, paired",
            "signs as published",
        ),
        tuple(rows),
        ("A change is against the row above, on the same drives; below zero is better.",),
    )


def _step_cells(results: Results, name: str, before: str) -> tuple[str, ...]:
    """Figures of a row and its change against the one before it."""
    printed, printed_before = POSES[name, "cross"], POSES.get((before, "cross"))
    ape, de = (results.poses(name, "cross", what) for what in ("ape_m", "de_deg"))
    shown = _with_interval(interval(ape), 2), _with_interval(interval(de), 1)
    if printed_before is None:
        return f"{printed.ape_m:.2f}", "", shown[0], "", f"{printed.de_deg:.1f}", shown[1], "", ""
    changes = [
        paired(now, results.poses(before, "cross", what)).difference
        for now, what in ((ape, "ape_m"), (de, "de_deg"))
        if now.size and results.poses(before, "cross", what).size
    ]
    published = printed.ape_m - printed_before.ape_m, printed.de_deg - printed_before.de_deg
    signs = [_sign(change, wanted) for change, wanted in zip(changes, published, strict=False)]
    cells = [_with_interval(change, digits, signed=True) for change, digits in zip(changes, (2, 1), strict=False)]
    cells += [_NONE] * (2 - len(cells))
    same = ", ".join(f"{what} {sign}" for what, sign in zip(("APE", "DE"), signs, strict=False)) or _NONE
    return (
        f"{printed.ape_m:.2f}",
        f"{published[0]:+.2f}",
        shown[0],
        cells[0],
        f"{printed.de_deg:.1f}",
        shown[1],
        cells[1],
        same,
    )


def _sign(change: Interval, published: float) -> str:
    """Whether a change goes the published way, and whether its interval is clear of zero."""
    if not change.known:
        return _NONE
    same = "yes" if change.mean * published > 0 else "no"
    clear = change.low > 0 or change.high < 0
    return same if clear else f"{same} (not clear of 0)"


_SETS = {
    "reached": "cells that a region of interest has reached",
    "visible": "cells reached and visible so far",
    "all": "all cells of the map",
}


def map_sheet(results: Results, cells: str) -> Sheet:
    """Table 4 of the paper: map error at true poses, over a set of cells."""
    head = ["method"]
    for quality in SIGHTS:
        head += [f"{QUALITY_TITLES[quality]}, published", "here"]
    rows = tuple((MAP_TITLES[m], *_map_cells(results, m, cells)) for m in MAP_METHODS if _wanted(results, m))
    return Sheet(
        f"table4_{cells}",
        f"Table 4: map error at true poses, MSE x 100, over {_SETS[cells]}",
        tuple(head),
        rows,
        (
            "Mean over steps, cells and classes against the class map visible so far. Published: with the deviation "
            "that the paper gives. Here: with the 95 % interval.",
        ),
    )


def _wanted(results: Results, method: str) -> bool:
    return any(one.method == method for one in results.maps) or any(one.name == method for one in results.missing)


def _map_cells(results: Results, method: str, cells: str) -> Iterator[str]:
    for quality in SIGHTS:
        printed = MAPS[method, quality]
        yield f"{printed.mse_x100:.2f} +- {printed.deviation:.2f}"
        yield _with_interval(_scaled(interval(results.map_errors(method, quality, cells)), _PER_CENT), 2)


def margin_sheet(results: Results) -> Sheet:
    """ConvLSTM against the best heuristic of each quality."""
    rows = tuple(row for quality in SIGHTS for row in _margin_row(results, quality))
    return Sheet(
        "table4_margin",
        "Table 4: ConvLSTM against the best heuristic, cells reached",
        ("observations", "best heuristic", "ratio published", "ratio here", "intervals apart", "better on", "paired"),
        rows,
        ("Ratio: MSE of the ConvLSTM over that of the heuristic. Paired: difference of MSE x 100 on the same drives.",),
    )


def _margin_row(results: Results, quality: str) -> Iterator[tuple[str, ...]]:
    ours = results.map_errors(CONVLSTM, quality)
    others = {m: results.map_errors(m, quality) for m in MAP_METHODS if m != CONVLSTM}
    means = {m: interval(values).mean for m, values in others.items() if values.size}
    if not ours.size or not means:
        return
    best = min(means, key=means.__getitem__)
    compared = paired(ours * _PER_CENT, others[best] * _PER_CENT)
    printed = min(MAPS[m, quality].mse_x100 for m in others)
    yield (
        QUALITY_TITLES[quality],
        MAP_TITLES[best],
        f"{MAPS[CONVLSTM, quality].mse_x100 / printed:.2f}",
        f"{compared.ratio:.2f}",
        "yes" if interval(ours).apart(interval(others[best])) else "no",
        f"{compared.better} of {compared.drives}",
        _with_interval(compared.difference, 2, signed=True),
    )


def quality_sheet(results: Results) -> Sheet:
    """What else can be said of the last maps."""
    rows = []
    for quality in SIGHTS:
        for method in MAP_METHODS:
            if results.of_method(method, quality):
                found = [interval(results.map_scores(method, quality, what)) for what in _LAST]
                cells = [_with_interval(one, 3) for one in found]
                rows.append((f"{QUALITY_TITLES[quality]}: {MAP_TITLES[method]}", *cells))
    return Sheet(
        "maps_last",
        "The last maps: classes, outlines, calibration (cells reached)",
        ("method", "IoU of objects", "boundary F1", "Brier", "calibration error"),
        tuple(rows),
        (
            "IoU and F1 (tolerance one cell): mean over object classes present, higher is better. Brier score and "
            "expected calibration error (15 bins): lower is better.",
        ),
    )


def class_sheet(results: Results, quality: str) -> Sheet:
    """Intersection over union of every class."""
    methods = [method for method in MAP_METHODS if results.of_method(method, quality)]
    found = [results.class_iou(method, quality) for method in methods]
    rows = []
    for name in list(found[0]) if found else ():
        if not all(math.isnan(one[name]) for one in found):
            rows.append(
                (name.replace("_", " "), *("-" if math.isnan(v) else f"{v:.3f}" for v in (o[name] for o in found)))
            )
    return Sheet(
        f"classes_{quality}",
        f"The last maps, {QUALITY_TITLES[quality]}: intersection over union of each class",
        ("class", *(MAP_TITLES[method] for method in methods)),
        tuple(rows),
        ("Cells reached, of all drives and seeds together.",),
    )


_LAST = ("object_iou", "boundary_f1", "brier", "ece")


def settings_sheets(results: Results) -> Iterator[Sheet]:
    """The visual-inertial method and the visual one with one setting changed at a time."""
    told = "leaky map, cross-scene, one setting changed"
    yield _settings_sheet(results, "settings", f"visual-inertial, {told}", SETTINGS_BASE, SETTINGS)
    yield _settings_sheet(results, "settings_visual", f"visual, {told}", VISUAL_SETTINGS_BASE, VISUAL_SETTINGS)


def _settings_sheet(results: Results, name: str, title: str, base: str, changed: Sequence[Row]) -> Sheet:
    names = rows_in(results, [base, *(row.name for row in changed)])
    rows = []
    for one in names if len(names) > 1 else []:
        ape, de = (results.poses(one, "cross", what) for what in ("ape_m", "de_deg"))
        usual = results.poses(base, "cross", "ape_m")
        change = "" if one == base or not (ape.size and usual.size) else _change(ape, usual)
        setting = "as configured" if one == base else ALL[one].title
        rows.append((setting, _with_interval(interval(ape), 2), change, _with_interval(interval(de), 1)))
    return Sheet(
        name, f"Where the error comes from: {title}", ("setting", "APE, m", "change, paired", "DE, deg"), tuple(rows)
    )


def found_sheet(results: Results) -> Sheet:
    """How well a pose is found again when all poses before it were right."""
    head = ["map"]
    for quality in SIGHTS:
        head += [f"{QUALITY_TITLES[quality]}: APE, m", "DE, deg"]
    rows = []
    for method in MAP_METHODS:
        found = [[interval(results.found_again(method, q, what)) for what in ("ape_m", "de_deg")] for q in SIGHTS]
        if any(one.known for pair in found for one in pair):
            cells = [_with_interval(one, digits) for pair in found for one, digits in zip(pair, (2, 1), strict=True)]
            rows.append((MAP_TITLES[method], *cells))
    shares = [interval(results.found_again(m, q, "coverage")) for m in MAP_METHODS for q in SIGHTS]
    least = min((one.mean for one in shares if one.known), default=math.nan)
    return Sheet(
        "found_again",
        "Visual poses in maps built at true poses, cross-scene",
        tuple(head),
        tuple(rows),
        (
            "Equation 2 alone, on a whole map, when no pose before it was wrong: what is left of the error of the "
            f"visual method without the damage that its own poses do to its map. Something fitted in {least:.0%} of "
            "the keyframes or more.",
        ),
    )


def _change(now: Any, base: Any) -> str:
    return _with_interval(paired(now, base).difference, 2, signed=True)


def noise_sheet(results: Results) -> Sheet:
    """What the rows that use motion make of more and of less noise."""
    rows = []
    for name in NOISE_ROWS:
        for what, unit, digits in (("ape_m", "APE, m", 2), ("de_deg", "DE, deg", 1)):
            found = [interval(results.noise_poses(name, level, what)) for level in NOISE_LEVELS]
            if any(one.known for one in found):
                cells = [_with_interval(one, digits) for one in found]
                rows.append((f"{ALL[name].title}: {unit}", *cells))
    told = f"level 1 is the logs' own ({results.conditions.noise}); 0 is exact motion"
    return Sheet(
        "noise",
        "More and less noise of IMU and wheels, cross-scene",
        ("method", *(f"{level:g} x" for level in NOISE_LEVELS)),
        tuple(rows),
        (f"The error of every measured motion is multiplied: {told}.",),
    )


def missing_sheet(results: Results) -> Sheet:
    """What was not run, and why."""
    rows = tuple((_title(one.name), one.where, one.reason.replace("|", "\\|")) for one in results.reasons)
    return Sheet("not_run", "Not run", ("row", "where", "why"), rows)


def _title(name: str) -> str:
    return ALL[name].title if name in ALL else MAP_TITLES.get(name, name)


def report(results: Results, figures: Mapping[str, str]) -> str:
    """Everything on one page.

    Args:
        figures: title by file name.
    """
    pictures = "".join(f"## {title}\n\n![{title}]({name})\n\n" for name, title in figures.items())
    tables = "\n".join(sheet.markdown() for sheet in sheets(results))
    return f"# The paper's claims, measured again\n\n{_conditions(results)}\n{tables}\n{pictures}".rstrip() + "\n"


def _conditions(results: Results) -> str:
    """Under what conditions, in words."""
    told, paper = results.conditions, results.conditions.paper
    quick = "**A quick run: it exercises every path, and its figures mean nothing.**\n\n" if told.quick else ""
    seeds = f"{told.seeds} {'seed' if told.seeds == 1 else 'seeds'}"
    return (
        f"{quick}Data: {told.dataset}, {told.logs} simulated drives through {told.scenes} homes; noise of IMU and "
        f"wheels: {told.noise}. Scored: the first {told.steps} keyframes of every test drive. Position errors are in "
        "metres without any alignment but the common start, heading errors absolute and wrapped. Networks: "
        f"{seeds} each; map updates learn with true poses first, then with more and more of their own "
        "(those for h = 33 with true poses alone). Brackets are 95 % intervals, "
        "a percentile bootstrap over drives and seeds (10,000 draws, seed 0); drives through one home "
        "share its furniture, so that for other homes they are somewhat too narrow.\n\n"
        f"Estimator: cells of {paper['cell_m']:g} m, map {paper['map_side']} x {paper['map_side']}, h = "
        f"{paper['side']}, R = {paper['headings']}, gates {paper['gate_distance_m']:g} m and "
        f"{math.degrees(paper['gate_heading_rad']):.1f} deg ({paper['gate']}). Detector: {told.detector}. "
        f"{', '.join(f'{name} {version}' for name, version in told.versions.items())}.\n"
    )


def timing_sheet(results: Results) -> Sheet:
    """What the trainings cost; wall time, which no other table holds."""
    kinds = sorted({(one.kind, one.protocol, one.quality) for one in results.trained})
    rows = []
    for kind in kinds:
        found = [one for one in results.trained if (one.kind, one.protocol, one.quality) == kind]
        minutes = [one.seconds / 60 for one in found]
        size = max(one.bytes for one in found) / 1024
        rows.append((*kind, str(len(found)), f"{min(minutes):.1f} to {max(minutes):.1f}", f"{size:,.0f}"))
    head = ("network", "protocol", "observations", "seeds", "minutes", "kB")
    return Sheet("training_times", "Trainings: wall time on one core each", head, tuple(rows))


def write_tables(results: Results, folder: Path) -> None:
    """Every table as CSV, and the scores behind them as CSV and Parquet."""
    for sheet in sheets(results):
        _write_csv(folder / f"{sheet.name}.csv", sheet.head, sheet.rows)
    if results.trained:
        write_text(folder / TIMES, timing_sheet(results).markdown())
    _write_scores(folder, "pose_scores", _pose_scores(results))
    _write_scores(folder, "noise_scores", _noise_scores(results))
    _write_scores(folder, "pose_steps", _pose_steps(results))
    _write_scores(folder, "map_scores", _map_scores(results))
    _write_scores(folder, "map_steps", _map_steps(results))


_KEYS = ("row", "protocol", "seed", "log", "coverage", "ape_m", "de_deg")


def _pose_scores(results: Results) -> list[dict[str, Any]]:
    return [{key: getattr(one, key) for key in _KEYS} for one in results.tracks]


def _noise_scores(results: Results) -> list[dict[str, Any]]:
    return [{"level": one.level, **{key: getattr(one.track, key) for key in _KEYS}} for one in results.noise]


def _pose_steps(results: Results) -> list[dict[str, Any]]:
    return [
        {"row": one.row, "protocol": one.protocol, "seed": one.seed, "log": one.log, "step": step, **errors}
        for one in results.tracks
        for step, errors in enumerate(
            {"distance_m": d, "turn_deg": t} for d, t in zip(one.distance_m, one.turn_deg, strict=True)
        )
    ]


def _map_scores(results: Results) -> list[dict[str, Any]]:
    return [
        {"method": one.method, "quality": one.quality, "seed": one.seed, "log": log, "cells": cells, **scores}
        for one in results.maps
        for log, found in one.values["logs"].items()
        for cells, scores in found["last"].items()
    ]


def _map_steps(results: Results) -> list[dict[str, Any]]:
    return [
        {
            "method": one.method,
            "quality": one.quality,
            "seed": one.seed,
            "log": log,
            "cells": cells,
            "step": s,
            "mse": v,
        }
        for one in results.maps
        for log, found in one.values["logs"].items()
        for cells, curve in found["mse"].items()
        for s, v in enumerate(curve)
    ]


def _write_scores(folder: Path, name: str, records: Sequence[Mapping[str, Any]]) -> None:
    """Plain records as Parquet, and as CSV if there is one a log and not one a step; nothing for none."""
    if not records:
        return
    columns = {key: [_number(record[key]) for record in records] for key in records[0]}
    if "step" not in columns:
        _write_csv(folder / f"{name}.csv", tuple(columns), zip(*columns.values(), strict=True))
    temporary = folder / f".tmp-{name}.parquet"
    pq.write_table(pa.table(columns), temporary, compression="zstd", store_schema=False)
    temporary.replace(folder / f"{name}.parquet")


def _number(value: Any) -> Any:
    """NaN is no value."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _write_csv(path: Path, head: Sequence[str], rows: Any) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    write_text(path, text.getvalue())


def _with_interval(found: Interval, digits: int, *, signed: bool = False) -> str:
    """A mean with its interval, `2.31 (1.90 to 2.75)`."""
    if not found.known:
        return _NONE
    sign = "+" if signed else ""
    mean = f"{found.mean:{sign}.{digits}f}"
    if math.isnan(found.low):
        return mean
    return f"{mean} ({found.low:{sign}.{digits}f} to {found.high:{sign}.{digits}f})"


def _scaled(found: Interval, factor: float) -> Interval:
    values = asdict(found)
    return Interval(**{**values, **{name: values[name] * factor for name in ("mean", "low", "high")}})
