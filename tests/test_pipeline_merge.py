"""Logs of one place come into one map and one frame, and those of others stay out of it."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semslam.geometry.frames import SE2, planar
from semslam.pipeline import merge as merge_module
from semslam.pipeline.cli import run_command
from semslam.pipeline.files import files_below
from semslam.slam.surfel.merging import CONTRADICTED, FIRST, Drive, Grouping, Site, merge
from semslam.slam.surfel.prior import Grid, read_prior, submap_of
from semslam.slam.surfel.registration import AMBIGUOUS, FOUND, LOST, Placement, Proposal, place_in
from semslam.slam.surfel.site_map import Pose, thinned, track_in
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import CELLS, PLACES, SITES, TRAJECTORY
from tests.fake_stages import make_log
from tests.fake_surfel import CONFIG, SURFEL_STAGES, make_known, true_drive
from tests.pipeline_helpers import World
from tests.slam_world import CELL_M, CLASSES, SIDE

pytest_plugins = ("tests.pipeline_fixtures",)
Capture = pytest.CaptureFixture[str]
GRID = Grid(CLASSES, CELL_M, SIDE)


def silent(_what: str, _done: int, _total: int) -> None:
    """Nobody listens."""


def away(one: SE2, other: SE2) -> float:
    apart = one.between(other)
    return math.hypot(apart.x_m, apart.y_m)


# --- which belong together, and where each lies -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def sites() -> list[Site]:
    """Two drives of one room and one of another."""
    drives = [
        make_known("b", "box5", "there", 7),
        make_known("c", "box11", "here", 5),
        make_known("a", "box5", "here", 8),
    ]
    return merge(drives, GRID, CONFIG, silent)


def test_two_drives_of_a_room_join_and_a_third_stays_apart(sites: list[Site]) -> None:
    """With verdicts that say so; a pair of keyframes of both is tied by what both show."""
    assert [[drive.name for drive in site.drives] for site in sites] == [["a", "b"], ["c"]]
    assert [[answer.verdict for answer in site.answers] for site in sites] == [[FIRST, FOUND], [LOST]]
    assert sites[0].answers[1].other == "a"
    assert sites[0].ties[0] == sites[0].ties[1] > 3
    assert sites[1].ties == (0,)


def test_all_keyframes_agree_in_the_frame_of_the_first_log(sites: list[Site]) -> None:
    """Within 2 cm of the truth, better than the tracks that went in; a log by itself stays as it was."""
    room = true_drive("here", 8)
    for poses, start, number in zip(sites[0].poses, ("here", "there"), (8, 7), strict=True):
        apart = [
            away(room[0].between(true), planar(pose))
            for true, pose in zip(true_drive(start, number), poses, strict=True)
        ]
        assert max(apart) < 0.02
    before = [away(pose, planar(one.place.pose)) for pose, one in zip(room, sites[0].drives[0].known, strict=True)]
    after = [away(pose, planar(one)) for pose, one in zip(room, sites[0].poses[0], strict=True)]
    assert np.mean(after) < 0.5 * np.mean(before)
    assert away(SE2(0.0, 0.0, 0.0), planar(sites[0].poses[0][0])) < 1e-6
    assert all(
        (pose == one.place.pose).all() for pose, one in zip(sites[1].poses[0], sites[1].drives[0].known, strict=True)
    )


def test_where_a_map_lies_is_told_with_its_error(sites: list[Site]) -> None:
    """That of b's first keyframe; of a log by itself nothing is known."""
    wanted = true_drive("here", 1)[0].between(true_drive("there", 1)[0])
    assert away(wanted, sites[0].map_pose(1)) < 0.02
    error = sites[0].map_error(1)
    assert error is not None
    assert 1e-4 < math.sqrt(error[0, 0]) < 0.05
    assert sites[1].map_error(0) is None


def test_a_room_that_looks_the_same_from_both_ends_is_not_joined() -> None:
    """Both logs are said to be ambiguous."""
    drives = [make_known("a", "sym5", "here", 12), make_known("b", "sym5", "there", 9)]
    found = merge(drives, GRID, CONFIG, silent)
    assert [(site.drives[0].name, site.answers[0].verdict) for site in found] == [("a", AMBIGUOUS), ("b", AMBIGUOUS)]
    assert [site.answers[0].other for site in found] == ["b", "a"]


def arrange(answers: dict[tuple[str, str], SE2 | str]) -> tuple[list[list[str]], dict[str, str]]:
    """Groups and verdicts of logs a to d, the longest first, where laying one on a group is answered by this: the pose,
    or the verdict, for a pair of logs, the first in the frame of the second; lost for all others."""
    one = make_known("x", "box5", "here", 4).known
    drives = [Drive(name, one[: 4 - number]) for number, name in enumerate("abcd")]

    class Told(Grouping):
        def _lay(self, index: int, group: dict[int, SE2]) -> Placement:
            for other, pose in group.items():
                told = answers.get((drives[index].name, drives[other].name), LOST)
                if isinstance(told, SE2):
                    return Placement(FOUND, (Proposal(pose @ told, 1.0, 0.3, 0.5, np.eye(3), 1.0),))
                if told != LOST:
                    return Placement(told)
            return Placement(LOST)

    grouping = Told(drives, GRID, silent)
    groups = [sorted(drives[index].name for index in group) for group in grouping.result()]
    return sorted(groups), {drives[index].name: answer.verdict for index, answer in grouping.answers.items()}


STEP = SE2(1.0, 0.0, 0.0)


def test_logs_that_meet_by_another_one_are_one_site() -> None:
    """Neither b nor d shows anything of a, until c has joined, which shows something of each."""
    groups, _ = arrange({("c", "a"): STEP, ("b", "c"): STEP, ("d", "b"): STEP})
    assert groups == [["a", "b", "c", "d"]]


def test_two_sites_join_where_one_log_of_the_smaller_is_found() -> None:
    """All of it comes along."""
    groups, _ = arrange({("b", "a"): STEP, ("d", "c"): STEP})
    assert groups == [["a", "b"], ["c", "d"]]
    groups, _ = arrange({("b", "a"): STEP, ("d", "c"): STEP, ("c", "b"): STEP})
    assert groups == [["a", "b", "c", "d"]]


def test_a_join_that_contradicts_another_is_undone() -> None:
    """The way from c to a over b is half a metre longer than the one that c tells of a itself."""
    ways = {("b", "a"): STEP, ("c", "a"): SE2(2.0, 0.0, 0.0), ("c", "b"): SE2(1.5, 0.0, 0.0)}
    groups, verdicts = arrange(ways)
    assert groups == [["a", "b"], ["c"], ["d"]]
    assert verdicts["c"] == CONTRADICTED
    groups, verdicts = arrange({**ways, ("c", "b"): SE2(1.1, 0.0, 0.0)})
    assert groups == [["a", "b", "c"], ["d"]]
    assert verdicts["c"] == FOUND


def test_ambiguous_never_joins() -> None:
    """Even where all others agree."""
    groups, verdicts = arrange({("b", "a"): AMBIGUOUS, ("c", "a"): STEP})
    assert groups == [["a", "c"], ["b"], ["d"]]
    assert verdicts == {"a": FOUND, "b": AMBIGUOUS, "c": FOUND, "d": LOST}


# --- what a site is worth to others -----------------------------------------------------------------------------------


def test_of_too_many_keyframes_those_stay_that_show_something_else() -> None:
    """Of ten times the same place two stay, and all of the others."""
    known = make_known("a", "box5", "here", 6).known
    many = [*known, *[known[0]] * 9]
    assert thinned(many, 10) == [*known, known[0]]
    assert thinned(many, 15) == many


def test_keyframes_without_a_place_go_with_the_nearest(sites: list[Site]) -> None:
    """And keep their verdict, while the others get one by the error that they have in the site."""
    known = sites[0].drives[1].known
    rows = [Pose(one.frame, one.stamp_nanos, planar(one.place.pose), "ok") for one in known]
    blind = replace(rows[3], frame=99, pose=rows[3].pose @ STEP, verdict="uncertain")
    told = list(track_in(sites[0], 1, [*rows, blind], 0.1, 0.035))
    assert {row.verdict for row in told[:-1]} == {"ok"}
    assert away(told[3].pose @ STEP, told[-1].pose) < 1e-9
    assert told[-1].verdict == "uncertain"
    assert {row.verdict for row in track_in(sites[0], 1, rows, 1e-6, 0.035)} == {"uncertain"}


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def run(world: World) -> World:
    """A finished run over three logs."""
    return make_run(world, "monday", "tuesday", "cellar")


def make_run(world: World, *logs: str) -> World:
    for name in logs:
        make_log(world.logs, name, name)  # no log is the copy of another
    report = world.run("localize.estimators=surfel", stages=SURFEL_STAGES, until="localize")
    assert not report.failures
    return world


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in files_below(folder)}


def test_a_site_is_a_folder_with_a_map_and_the_tracks(run: World, capsys: Capture) -> None:
    """Other logs are found in its map; a second merge does nothing, and one from nothing gives the same bytes."""
    assert run_command(["merge", str(run.out), "--json"], SURFEL_STAGES) == 0
    told = json.loads(capsys.readouterr().out)
    assert [(site["site"], [log["log"] for log in site["logs"]]) for site in told["sites"]] == [
        ("cellar", ["cellar"]),
        ("monday", ["monday", "tuesday"]),
    ]
    folder = run.out / "sites"
    first = contents(folder)
    files = {"layers.parquet", "layers.png", "map.parquet", "map.pgm", "map.png", "map.yaml", "places.parquet"}
    tracks = {f"{log}/trajectory.{end}" for log in ("monday", "tuesday") for end in ("parquet", "tum")}
    assert {name.removeprefix("monday/") for name in first if name.startswith("monday/")} == files | tracks
    rows = TableFiles(SITES, [folder / "sites.parquet"]).read()
    assert (rows["log"], rows["site"]) == (["cellar", "monday", "tuesday"], ["cellar", "monday", "monday"])
    assert (rows["verdict"], rows["keyframes"]) == (["lost", "first", "found"], [2, 8, 7])
    track = TableFiles(TRAJECTORY, [folder / "monday" / "tuesday" / "trajectory.parquet"]).read()
    room, tuesday = true_drive("here", 1)[0], true_drive("there", 8)
    for x, y, heading, true in zip(track["x_m"], track["y_m"], track["heading_rad"], tuesday, strict=True):
        assert away(room.between(true), SE2(x, y, heading)) < 0.03
    prior = read_prior(folder / "monday" / "places.parquet", GRID)
    assert len(prior.places) == 15
    assert TableFiles(PLACES, [folder / "monday" / "places.parquet"]).read(["frame"])["frame"] == list(range(15))
    assert TableFiles(CELLS, [folder / "monday" / "map.parquet"]).rows > 500
    wednesday = make_known("wednesday", "box5", "back", 5)
    own = submap_of([one.place for one in wednesday.known], [one.seen for one in wednesday.known], GRID)
    found = place_in(own, prior).other_from_own
    assert found is not None
    assert away(room.between(true_drive("back", 1)[0]), found) < 0.03

    calls: list[str] = []
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merge_module, "merge", lambda *_: calls.append("merge"))
        assert run_command(["merge", str(run.out), "--json"], SURFEL_STAGES) == 0
    again = json.loads(capsys.readouterr().out)
    assert calls == []
    assert {**again, "cached": False} == told
    assert run_command(["verify", str(run.out)], SURFEL_STAGES) == 0
    (folder / "monday" / "map.png").write_bytes(b"scribbled over")
    (folder / "monday" / "map.yaml").unlink()  # a link that leads nowhere is missing, too
    (folder / "monday" / "map.yaml").symlink_to("nowhere")
    capsys.readouterr()
    assert run_command(["verify", str(run.out)], SURFEL_STAGES) == 1
    said = capsys.readouterr().out
    assert f"{folder / 'monday' / 'map.png'}: damaged" in said
    assert "2 findings" in said
    assert f"{folder / 'monday' / 'map.yaml'}: missing; `semslam merge {run.out}`, with the `--log`" in said
    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 0
    assert contents(folder) == first


def test_an_interrupted_merge_leaves_nothing_half_written(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """Nor does it harm the folder that was there, nor promise to go on where it was."""
    run = make_run(world, "cellar", "attic")
    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 0
    make_run(world, "cellar", "attic", "monday")
    before = contents(run.out / "sites")

    def write(folder: Path, *_: object) -> str:
        folder.mkdir()
        (folder / "map.png").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(merge_module, "write_site", write)
    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted: the same command starts anew"
    assert contents(run.out / "sites") == before
    assert not list(run.out.glob(".tmp-*"))


def test_a_folder_that_is_being_replaced_is_never_lost(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted or killed between taking the old one away and putting the new one there, the old one is back."""
    run = make_run(world, "cellar", "attic")
    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 0
    before = contents(run.out / "sites")
    make_run(world, "cellar", "attic", "monday")
    rename = Path.rename

    def cut(path: Path, target: Path) -> Path:
        if path.name.startswith(".tmp-"):
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", cut)
        assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 130
    assert contents(run.out / "sites") == before
    assert not list(run.out.glob(".tmp-*"))
    (run.out / "sites").rename(run.out / ".sites-before")  # as a kill leaves it
    assert run_command(["clean", str(run.out)], SURFEL_STAGES) == 0
    assert run_command(["merge", str(run.out), "--log", "cellar", "--log", "attic", "--quiet"], SURFEL_STAGES) == 0
    assert contents(run.out / "sites") == before


def test_what_a_merge_did_not_write_is_not_replaced(run: World, capsys: Capture) -> None:
    """Files of the user's own, folders within the run, a link: each is named, before anything is computed."""

    def told(*arguments: str) -> str:
        assert run_command(["merge", str(run.out), *arguments], SURFEL_STAGES) == 2
        return capsys.readouterr().err

    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 0
    (run.out / "sites" / "monday" / "notes.txt").write_text("mine")
    assert "notes.txt` was not written by `semslam merge`" in told()
    (run.out / "sites" / "monday" / "notes.txt").unlink()
    before = contents(run.out / "sites")
    for inside in ("results/maps", "cache/maps", "sites/inner"):
        assert "lies within output folder" in told("--into", str(run.out / inside))
    (run.root / "link").symlink_to(run.out / "sites")
    assert "is a link" in told("--into", str(run.root / "link"))
    mark = json.loads((run.out / "sites" / "merge.json").read_text())
    (run.out / "sites" / "merge.json").write_text(json.dumps({**mark, "warnings": 3}))
    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 0
    assert contents(run.out / "sites") == before


def test_a_damaged_log_is_not_left_out_in_silence(run: World, capsys: Capture) -> None:
    """The folder that has it stays as it is; a log whose name is taken is named before anything is computed."""
    assert run_command(["merge", str(run.out), "--quiet"], SURFEL_STAGES) == 0
    before = contents(run.out / "sites")
    (table,) = [path for path in run.out.glob("cache/localize/*/shard-*/places.parquet") if path.stat().st_size][:1]
    whole = table.read_bytes()
    table.write_bytes(whole[:-100])
    assert run_command(["merge", str(run.out)], SURFEL_STAGES) == 1
    assert "damaged or gone" in capsys.readouterr().err
    table.write_bytes(whole)
    record = run.out / "logs" / "monday.json"
    kept = record.read_bytes()
    record.write_bytes(kept[:50])
    assert run_command(["merge", str(run.out)], SURFEL_STAGES) == 1
    assert "the record of a log, is damaged" in capsys.readouterr().err
    assert contents(run.out / "sites") == before
    record.write_bytes(kept)
    (run.out / "logs" / "map.png.json").write_bytes(kept.replace(b'"monday"', b'"map.png"'))
    assert run_command(["merge", str(run.out)], SURFEL_STAGES) == 1
    assert "has the name of a file that a merge writes" in capsys.readouterr().err


def test_a_killed_merge_leaves_nothing_half_written(world: World) -> None:
    """What it leaves is a temporary folder that the next merge, or `clean`, removes."""
    run = make_run(world, "cellar", "attic")
    command = [sys.executable, "-m", "semslam.pipeline.cli", "merge", str(run.out), "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while not list(run.out.glob(".tmp-sites-*")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not (run.out / "sites").exists()
    assert run_command(["clean", str(run.out)], SURFEL_STAGES) == 0
    assert not list(run.out.glob(".tmp-*"))


def test_what_cannot_be_merged_is_said(world: World, capsys: Capture) -> None:
    """Too few maps, unknown logs, maps of other classes, folders of others: each with something to type."""
    make_run(world, "monday", "dark", "other")

    def told(*arguments: str) -> str:
        assert run_command(["merge", str(world.out), *arguments], SURFEL_STAGES) in (1, 2)
        return capsys.readouterr().err

    assert "were made of other observations" in (text := told())
    assert "`--log`" in text
    text = told("--log", "monday", "--log", "dark")
    assert "has one log with a map of `surfel`, `monday`" in text
    assert "`dark` has no map of `surfel`" in text
    assert "semslam run LOG... --estimator surfel" in text
    assert "did you mean `monday`?" in told("--log", "mondy")
    (world.root / "mine").mkdir()
    (world.root / "mine" / "thesis.txt").write_text("dear")
    assert "no folder of `semslam merge`" in told("--into", str(world.root / "mine"))
    assert "is a file" in told("--into", str(world.root / "mine" / "thesis.txt"))
    assert not (world.out / "sites").exists()
