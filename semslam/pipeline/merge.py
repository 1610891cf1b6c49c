"""Merge: the logs of a finished run sorted into the places they were recorded in, each with one map and one frame.

Reads   places, poses      data_spec.md, tables 16 and 7, of estimator surfel
Writes  sites              data_spec.md, table 19, and a folder for each site (site_files.py), as OUT/sites/

The folder is made beside its name and renamed when it is whole. `merge.json` in it says what it was made of; if that is
the same and nothing in the folder was changed, nothing is done again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semslam.errors import SemslamError, UsageError
from semslam.geometry.frames import SE2
from semslam.pipeline.cache import Entry, EntryIndex, key_of, table_files
from semslam.pipeline.config import Config, load_config, plain
from semslam.pipeline.context import check_inputs
from semslam.pipeline.digest import sha256_file
from semslam.pipeline.files import TEMPORARY, files_below, read_json, remove, write_json
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.merge_view import LogRow, MergeReport
from semslam.pipeline.plan import library_version
from semslam.pipeline.record import LogRecord, load_records
from semslam.pipeline.site_files import SiteStyle, write_site
from semslam.pipeline.why import find_record
from semslam.slam.surfel.merging import Drive, Site, Watch, merge
from semslam.slam.surfel.prior import Grid, remembered
from semslam.slam.surfel.site_map import Pose, track_in
from semslam.stages.contract import Stage
from semslam.stages.settings import ExportConfig, LocalizeConfig
from semslam.tables.parquet import TableFiles, write_table
from semslam.tables.spec import CELLS, LAYERS, PLACES, POSES, SITES, TRAJECTORY, Table

ESTIMATOR = "surfel"
"""Whose maps can be merged."""
MARK = "merge.json"
MERGE_FORMAT = "semslam-sites"
MERGE_VERSION = 2
"""Rises whenever the same logs give other files."""
_LIBRARIES = ("numpy", "opencv-contrib-python-headless", "gtsam", "small_gicp", "pyarrow")
_POSE = ("frame", "stamp_nanos", "x_m", "y_m", "heading_rad", "verdict")


@dataclass(frozen=True)
class Source:
    """The finished track of a log."""

    record: LogRecord
    entry: Entry
    folder: Path
    """Of the entry."""

    def open(self, table: Table) -> TableFiles:
        """One of its tables.

        Raises:
            SemslamError: it is damaged.
        """
        files = table_files(self.folder)[table.name]
        check_inputs(table.name, self.record.name, files)
        return TableFiles(table, [Path(file.path) for file in files])


@dataclass(frozen=True)
class MergeRequest:
    """What to merge."""

    out: OutputFolder
    logs: Sequence[str] = ()
    """Names; empty for all."""
    into: Path | None = None
    """None for OUT/sites."""

    @property
    def target(self) -> Path:
        """The folder that is written."""
        return Path(os.path.abspath(self.into or self.out.root / "sites"))


def merge_run(request: MergeRequest, stages: Sequence[Stage], watch: Watch) -> MergeReport:
    """Merge the logs of a run.

    Raises:
        SemslamError: there are no maps to merge, they were made of other observations than each other, or a table is
            damaged.
        UsageError: there is no such log, or the folder to write holds something else.
    """
    target = request.target
    _refuse_foreign(target)
    with request.out.locked():
        _recover(target)
        sources, notes = _sources(request)
        configs = {name: load_config(stages, stored=source.record.config) for name, source in sources.items()}
        key = _key(sources, configs, stages)
        if _untouched(target, key):
            return MergeReport(target, _stored_rows(target), (*notes, *_stored_notes(target)), cached=True)
        first = configs[next(iter(configs))]
        return _merged(target, key, sources, _Settings.of(first, stages), notes, watch)


@dataclass(frozen=True)
class _Settings:
    """The configuration that counts: that of the first log."""

    localize: LocalizeConfig
    export: ExportConfig

    @staticmethod
    def of(config: Config, stages: Sequence[Stage]) -> _Settings:
        known = {stage.name: config.of(stage) for stage in stages}
        return _Settings(known[POSES.stage], known[TRAJECTORY.stage])


def _merged(
    target: Path,
    key: str,
    sources: Mapping[str, Source],
    settings: _Settings,
    notes: Sequence[str],
    watch: Watch,
) -> MergeReport:
    """Do it, and put the folder in place."""
    grid, drives = _drives(sources)
    sites = merge(drives, grid, settings.localize.surfel, watch)
    style = SiteStyle(ESTIMATOR, grid, settings.export)
    temporary = target.with_name(f"{TEMPORARY}{target.name}-{os.getpid()}")
    remove(temporary)
    temporary.mkdir(parents=True)
    try:
        warnings = list(_write_sites(temporary, sites, sources, settings.localize, style))
        rows = [row for site in sites for row in _rows(site)]
        write_table(temporary / "sites.parquet", SITES, _columns(rows))
        _mark(temporary, key, warnings)
        _put(temporary, target)
    finally:
        remove(temporary)
    return MergeReport(target, tuple(rows), (*notes, *warnings), cached=False)


# --- what there is to merge


def _sources(request: MergeRequest) -> tuple[dict[str, Source], list[str]]:
    """The logs that have a map, by name, and what is to be said of the others."""
    records = load_records(request.out.logs)
    if request.logs:
        records = {record.name: record for record in sorted(_named(request), key=lambda record: record.name)}
    index = EntryIndex(request.out.cache)
    sources: dict[str, Source] = {}
    notes: list[str] = []
    for name, record in records.items():
        task = record.tasks.get(f"{PLACES.stage}/{ESTIMATOR}")
        entry = index.find(PLACES.stage, task.key) if task and task.key else None
        if entry is None or not entry.rows.get(PLACES.name):
            failure = f": {task.failure.message}" if task and task.failure else ""
            notes.append(f"`{name}` has no map of `{ESTIMATOR}` and was left out{failure}")
        else:
            sources[name] = Source(record, entry, request.out.stage(PLACES.stage) / entry.key)
    if len(sources) < 2:
        raise _too_few(request.out, sources, notes)
    return sources, notes


def _named(request: MergeRequest) -> Iterator[LogRecord]:
    for name in dict.fromkeys(request.logs):
        yield find_record(request.out, name)


def _too_few(folder: OutputFolder, sources: Mapping[str, Source], notes: Sequence[str]) -> SemslamError:
    found = f"one log with a map of `{ESTIMATOR}`, `{next(iter(sources))}`," if sources else f"no map of `{ESTIMATOR}`"
    return SemslamError(
        f"Output folder `{folder.root}` has {found} where two or more are needed to merge them",
        details="\n".join(notes),
        hint=f"`semslam run LOG... --estimator {ESTIMATOR} --out {folder.root}` makes them",
    )


def _drives(sources: Mapping[str, Source]) -> tuple[Grid, list[Drive]]:
    """All logs, and the observations that they share.

    Raises:
        SemslamError: they do not, or a table is damaged.
    """
    tables = {name: source.open(PLACES) for name, source in sources.items()}
    grids = {name: _grid(table.meta) for name, table in tables.items()}
    first, grid = next(iter(grids.items()))
    for name, other in grids.items():
        if other != grid:
            raise SemslamError(
                f"Logs `{first}` and `{name}` were made of other observations than each other",
                details="\n".join(
                    f"{log}: {one.side} x {one.side} cells of {one.cell_m:g} m, {', '.join(one.classes)}"
                    for log, one in ((first, grid), (name, other))
                ),
                hint="run both with the same detector and the same `[extract]`, or name those that belong together "
                "with `--log`",
            )
    return grid, [Drive(name, tuple(remembered(table, grid, f"`{name}`"))) for name, table in tables.items()]


def _grid(meta: Mapping[str, Any]) -> Grid:
    return Grid(tuple(meta["classes"]), float(meta["cell_m"]), int(meta["side"]))


def _track(source: Source) -> list[Pose]:
    """Keyframes with a pose, in the log's own map frame."""
    rows = source.open(POSES).read(_POSE)
    values = zip(*(rows[name] for name in _POSE), strict=True)
    return [
        Pose(frame, stamp, SE2(x, y, heading), verdict)
        for frame, stamp, x, y, heading, verdict in values
        if x is not None
    ]


def _key(sources: Mapping[str, Source], configs: Mapping[str, Config], stages: Sequence[Stage]) -> str:
    """SHA-256 of all that the folder depends on."""
    digests = {
        name: {table.name: source.entry.tables[table.name] for table in (PLACES, POSES)}
        for name, source in sources.items()
    }
    settings = _Settings.of(configs[next(iter(configs))], stages)
    localize = settings.localize.for_variant(ESTIMATOR)
    return key_of(
        {
            "version": MERGE_VERSION,
            "spec": {table.name: table.version for table in (PLACES, POSES, CELLS, TRAJECTORY, LAYERS, SITES)},
            "logs": digests,
            "localize": plain(localize),
            "export": plain(settings.export),
            "libraries": {name: library_version(name) for name in _LIBRARIES},
        }
    )


# --- what is written


def _write_sites(
    folder: Path, sites: Sequence[Site], sources: Mapping[str, Source], bounds: LocalizeConfig, style: SiteStyle
) -> Iterator[str]:
    """The folders of all sites; what there is to warn of."""
    for site in sites:
        tracks = [
            list(track_in(site, number, _track(sources[drive.name]), bounds.ok_m, bounds.ok_rad))
            for number, drive in enumerate(site.drives)
        ]
        name = site.drives[0].name
        if not write_site(folder / name, site, tracks, style):
            yield f"the map of site `{name}` is too large for map_server; `map.pgm` and `map.yaml` were left out"


def _rows(site: Site) -> Iterator[LogRow]:
    """A row of the sites table for each log."""
    for number, (drive, answer) in enumerate(zip(site.drives, site.answers, strict=True)):
        pose, error = site.map_pose(number), site.map_error(number)
        yield LogRow(
            log=drive.name,
            site=site.drives[0].name,
            verdict=answer.verdict,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=pose.heading_rad,
            covariance=[] if error is None else error.ravel().tolist(),
            keyframes=len(drive.known),
            ties=site.ties[number],
            other=answer.other or None,
            likeness=answer.likeness,
            probability=answer.probability,
        )


def _columns(rows: Sequence[LogRow]) -> dict[str, list[Any]]:
    return {column.name: [getattr(row, column.name) for row in rows] for column in SITES.columns}


def _stored_rows(folder: Path) -> tuple[LogRow, ...]:
    rows = TableFiles(SITES, [folder / "sites.parquet"]).read()
    return tuple(LogRow(**dict(zip(rows, values, strict=True))) for values in zip(*rows.values(), strict=True))


def _stored_notes(folder: Path) -> list[str]:
    return list(read_json(folder / MARK)["warnings"])


# --- whole or not at all


def _mark(folder: Path, key: str, warnings: Sequence[str]) -> None:
    """Say what the folder was made of, and what lies in it."""
    mark = {"format": MERGE_FORMAT, "version": MERGE_VERSION, "key": key, "warnings": list(warnings)}
    write_json(folder / MARK, {**mark, "files": dict(_digests(folder))}, durable=True)


def _digests(folder: Path) -> Iterator[tuple[str, str]]:
    """SHA-256 of all files but the mark."""
    for path in files_below(folder):
        if path != folder / MARK:
            yield str(path.relative_to(folder)), sha256_file(path)


def _untouched(folder: Path, key: str) -> bool:
    """Whether the folder was made of this, and still holds what was written."""
    mark = read_json(folder / MARK)
    return isinstance(mark, dict) and mark.get("key") == key and mark.get("files") == dict(_digests(folder))


def _refuse_foreign(target: Path) -> None:
    """What no merge wrote is not ours to replace."""
    if not target.exists():
        return
    mark = read_json(target / MARK) if target.is_dir() else None
    empty = target.is_dir() and not any(target.iterdir())
    if not empty and not (isinstance(mark, dict) and mark.get("format") == MERGE_FORMAT):
        what = "is not empty and no folder of `semslam merge`" if target.is_dir() else "is a file"
        raise UsageError(f"`{target}` {what}", hint=f"name a new folder, such as `--into {target}_sites`")


def _put(temporary: Path, target: Path) -> None:
    """Rename the folder into place; the one before goes away once the new one is there."""
    old = target.with_name(f"{TEMPORARY}{target.name}-{os.getpid()}-old")
    remove(old)
    try:
        if target.exists():
            target.rename(old)
        temporary.rename(target)
    except BaseException:
        _recover(target)
        raise
    remove(old)


def _recover(target: Path) -> None:
    """Put the folder back that was about to be replaced when that was cut short."""
    for old in sorted(target.parent.glob(f"{TEMPORARY}{target.name}-*-old")):
        if not target.exists():
            old.rename(target)
