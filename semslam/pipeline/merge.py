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

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.pipeline.cache import Entry, EntryIndex, key_of
from semslam.pipeline.config import Config, load_config, plain
from semslam.pipeline.folder import OutputFolder
from semslam.pipeline.merge_folder import MERGE_VERSION, mark, notes_of, recover, refuse, replacing, untouched, writing
from semslam.pipeline.merge_view import LogRow, MergeReport
from semslam.pipeline.plan import library_version
from semslam.pipeline.record import LogRecord, load_records, task_name
from semslam.pipeline.run_tables import log_tables
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
_TAKEN = frozenset(
    f"{name}.{end}"
    for name, ends in {
        "map": ("parquet", "png", "yaml", "pgm"),
        "layers": ("parquet", "png"),
        "places": ("parquet",),
        "sites": ("parquet",),
        "merge": ("json",),
    }.items()
    for end in ends
)
"""Files of the folder and of a site."""
_LIBRARIES = ("numpy", "opencv-contrib-python-headless", "gtsam", "small_gicp", "pyarrow")
_POSE = ("frame", "stamp_nanos", "x_m", "y_m", "heading_rad", "verdict")


@dataclass(frozen=True)
class Source:
    """The finished track of a log."""

    out: OutputFolder
    index: EntryIndex
    record: LogRecord
    entry: Entry

    def open(self, table: Table) -> TableFiles:
        """One of its tables.

        Raises:
            SemslamError: it is damaged.
        """
        return TableFiles(table, log_tables(self.out, self.index, self.record, (table,), ESTIMATOR)[table.name])


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
        return Path(os.path.abspath(self.into or self.out.sites))


def merge_run(request: MergeRequest, stages: Sequence[Stage], watch: Watch) -> MergeReport:
    """Merge the logs of a run.

    Raises:
        SemslamError: there are no maps to merge, they were made of other observations than each other, or a table is
            damaged.
        UsageError: there is no such log, or the folder to write holds something else.
    """
    target = request.target
    refuse(target, request.out)
    with request.out.locked():
        recover(target)
        sources, notes = _sources(request)
        configs = {name: load_config(stages, stored=source.record.config) for name, source in sources.items()}
        key = _key(sources, configs, stages)
        if untouched(target, key):
            return MergeReport(target, _stored_rows(target), (*notes, *notes_of(target)), cached=True)
        settings = {name: _Settings.of(config, stages) for name, config in configs.items()}
        return _merged(target, key, sources, settings, notes, watch)


@dataclass(frozen=True)
class _Settings:
    """The configuration that counts: that of the first log."""

    localize: LocalizeConfig
    export: ExportConfig

    @staticmethod
    def of(config: Config, stages: Sequence[Stage]) -> _Settings:
        known = {stage.name: config.of(stage) for stage in stages}
        return _Settings(known[POSES.stage], known[TRAJECTORY.stage])

    @property
    def that_count(self) -> tuple[object, ...]:
        """Those that a merge looks at."""
        return self.localize.surfel, self.localize.ok_m, self.localize.ok_rad, self.export


def _merged(
    target: Path,
    key: str,
    sources: Mapping[str, Source],
    settings: Mapping[str, _Settings],
    notes: Sequence[str],
    watch: Watch,
) -> MergeReport:
    """Do it, and put the folder in place."""
    first = next(iter(settings))
    notes = (*notes, *_others_settings(settings, first))
    tracks = {name: _track(source) for name, source in sources.items()}  # what is damaged is said before the long part
    with replacing(target) as temporary:
        grid, drives = _drives(sources)
        sites = merge(drives, grid, settings[first].localize.surfel, watch)
        style = SiteStyle(ESTIMATOR, grid, settings[first].export)
        rows = [row for site in sites for row in _rows(site)]
        with writing(target):
            warnings = list(_write_sites(temporary, sites, tracks, settings[first].localize, style))
            write_table(temporary / "sites.parquet", SITES, _columns(rows))
            mark(temporary, key, warnings)
    return MergeReport(target, tuple(rows), (*notes, *warnings), cached=False)


def _others_settings(settings: Mapping[str, _Settings], first: str) -> Iterator[str]:
    """Which logs were run with others than those that count."""
    for name, one in settings.items():
        if one.that_count != settings[first].that_count:
            yield f"`{name}` was run with other settings than `{first}`, whose `[localize]` and `[export]` count here"


# --- what there is to merge


def _sources(request: MergeRequest) -> tuple[dict[str, Source], list[str]]:
    """The logs that have a map, by name, and what is to be said of the others."""
    records = load_records(request.out.logs)
    for path in sorted(request.out.logs.glob("[!.]*.json")):
        if not request.logs and path.stem not in records:
            raise SemslamError(
                f"`{path}`, the record of a log, is damaged",
                hint=f"remove it and run the log again: `semslam run LOG --out {request.out.root}`",
            )
    if request.logs:
        records = {record.name: record for record in sorted(_named(request), key=lambda record: record.name)}
    index = EntryIndex(request.out.cache)
    sources: dict[str, Source] = {}
    notes: list[str] = []
    for name, record in records.items():
        _refuse_name(name)
        task = record.tasks.get(task_name(PLACES.stage, ESTIMATOR))
        entry = index.find(PLACES.stage, task.key) if task and task.key else None
        if entry is None and task and task.key and not task.failure:
            raise _gone(request.out, name)
        if entry is None or not entry.rows.get(PLACES.name):
            failure = f": {task.failure.message}" if task and task.failure else ""
            notes.append(f"`{name}` has no map of `{ESTIMATOR}` and was left out{failure}")
        else:
            sources[name] = Source(request.out, index, record, entry)
    if len(sources) < 2:
        raise _too_few(request.out, sources, notes)
    return sources, notes


def _refuse_name(log: str) -> None:
    """The folder of a log's site lies among files that have names already, and its tracks among the site's."""
    if log in _TAKEN:
        raise SemslamError(
            f"Log `{log}` has the name of a file that a merge writes",
            hint="rename the log and run it again, or leave it out: name the others with `--log`",
        )


def _gone(folder: OutputFolder, log: str) -> SemslamError:
    return SemslamError(
        f"What `{ESTIMATOR}` made of `{log}` is damaged or gone",
        hint=f"`semslam verify {folder.root} --remove`, then run the log again: `semslam run LOG --out {folder.root}`",
    )


def _named(request: MergeRequest) -> Iterator[LogRecord]:
    for name in dict.fromkeys(request.logs):
        yield find_record(request.out, name)


def _too_few(folder: OutputFolder, sources: Mapping[str, Source], notes: Sequence[str]) -> SemslamError:
    found = f"one log with a map of `{ESTIMATOR}`, `{next(iter(sources))}`," if sources else f"no map of `{ESTIMATOR}`"
    return SemslamError(
        f"Output folder `{folder.root}` has {found} where two or more are needed to merge them",
        details="\n".join(notes),
        hint=f"`semslam run LOG... --estimator {ESTIMATOR} --out {folder.root}` makes them; `--log`, if any, must name "
        "each",
    )


def _drives(sources: Mapping[str, Source]) -> tuple[Grid, list[Drive]]:
    """All logs, and the observations that they share.

    Raises:
        SemslamError: they do not, or a table is damaged.
    """
    tables = {name: source.open(PLACES) for name, source in sources.items()}
    grids = {name: Grid.of(table.meta) for name, table in tables.items()}
    first, grid = next(iter(grids.items()))
    for name, other in grids.items():
        if other != grid:
            raise SemslamError(
                f"Logs `{first}` and `{name}` were made of other observations than each other",
                details=f"{first}: {grid.told}\n{name}: {other.told}",
                hint="run both with the same detector and the same `[extract]`, or name those that belong together "
                "with `--log`",
            )
    return grid, [Drive(name, tuple(remembered(table, grid, f"`{name}`"))) for name, table in tables.items()]


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
    folder: Path, sites: Sequence[Site], known: Mapping[str, Sequence[Pose]], bounds: LocalizeConfig, style: SiteStyle
) -> Iterator[str]:
    """The folders of all sites; what there is to warn of."""
    for site in sites:
        tracks = [
            list(track_in(site, number, known[drive.name], bounds.ok_m, bounds.ok_rad))
            for number, drive in enumerate(site.drives)
        ]
        name = site.drives[0].name
        doubt = write_site(folder / name, site, tracks, style)
        if doubt:
            yield f"site `{name}`: {doubt}"


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
