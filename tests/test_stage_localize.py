"""The localize stage on tables in a folder: whole outputs, and that a run that was cut goes on with the same bytes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.geometry.grid import to_dense
from semslam.labels import UNOBSERVED
from semslam.models import builtin
from semslam.models.builtin import with_shipped
from semslam.slam.dead_reckoning import DeadReckoning
from semslam.slam.estimator import PoseEstimate, Step, View
from semslam.slam.registry import NAMES as REGISTERED
from semslam.slam.registry import NEEDS_VIEWS, WHOLE_LOGS, open_estimator
from semslam.stages import localize
from semslam.stages.contract import FinishedShard
from semslam.stages.settings import DeepVoConfig, LocalizeConfig, MapNetConfig, OrbConfig, PaperConfig, SurfelConfig
from semslam.tables.parquet import TableFiles, write_table
from semslam.tables.pictures import encode_colour, encode_depth
from semslam.tables.spec import CELLS, FRAMES, MOTION, OBSERVATIONS, POSES, SNAPSHOTS
from tests.slam_world import CELL_M, CLASSES, SIDE, MemoryContext, make_steps, make_walk, make_world, write_inputs

PAPER = PaperConfig(headings=36, temperature=0.01, gate_distance_m=0.6, gate_heading_rad=0.3)
CONFIG = LocalizeConfig(paper=PAPER, shard_frames=4, snapshot_every=3)
NAMES = ["paper", "paper_visual", "dead_reckoning"]


def make_context(
    folder: Path, steps: list[Step], variant: str = "paper", config: LocalizeConfig = CONFIG
) -> MemoryContext:
    inputs = folder / "inputs"
    inputs.mkdir(parents=True)
    return MemoryContext(folder / "out", write_inputs(inputs, steps), config, variant)


def walk_steps(frames: int = 10) -> list[Step]:
    return make_steps(make_world(), make_walk(frames), noise_m=0.02)


def every_byte(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("variant", NAMES)
def test_whole_output(tmp_path: Path, variant: str) -> None:
    """One pose a keyframe, snapshots when due and at the end, cells once, all with the class list."""
    steps = walk_steps()
    context = make_context(tmp_path, steps, variant)
    localize.run(context)
    tables = context.results(POSES, SNAPSHOTS, CELLS)
    poses, snapshots, cells = (tables[t.name].read() for t in (POSES, SNAPSHOTS, CELLS))
    assert poses["frame"] == list(range(10))
    assert poses["stamp_nanos"] == [s.stamp_nanos for s in steps]
    assert poses["source"][0] == "start"
    assert (poses["x_m"][0], poses["y_m"][0], poses["heading_rad"][0]) == (0.0, 0.0, 0.0)
    assert snapshots["frame"] == [2, 5, 8, 9]
    assert len(cells["ix"]) > 1000
    assert context.done[-1] == (10, 10)
    for table in tables.values():
        assert table.meta == {"classes": list(CLASSES), "cell_m": CELL_M, "estimator": variant}


def test_cells_say_what_the_world_holds(tmp_path: Path) -> None:
    """With right poses every object in sight is on the map under its name, at its place, and little else is."""
    world = make_world()
    context = make_context(tmp_path, make_steps(world, make_walk(20)), "dead_reckoning")
    localize.run(context)
    cells = context.results(CELLS)["cells"].read()
    objects = {
        (x, y): label
        for x, y, label in zip(cells["x_m"], cells["y_m"], cells["label"], strict=True)
        if label not in CLASSES[:3]
    }
    right = 0
    for (x, y), label in objects.items():
        distance = np.hypot(*(world.middles - (x, y)).T)
        right += label in {CLASSES[class_id] for class_id in world.class_id[distance < 0.45]}
    assert len(objects) > 200
    assert right > 0.98 * len(objects)
    assert cells["x_m"] == pytest.approx([(ix + 0.5) * CELL_M for ix in cells["ix"]])


def test_paper_rows_describe_the_field(tmp_path: Path) -> None:
    """Peak, entropy and modes where there was a field, null and empty where there was none."""
    context = make_context(tmp_path, walk_steps(4))
    localize.run(context)
    poses = context.results(POSES)["poses"].read()
    assert poses["peak"][0] is None
    assert poses["mode_x_m"][0] == []
    for frame in (1, 2, 3):
        assert 0.0 < poses["peak"][frame] <= 1.0
        assert poses["entropy_nats"][frame] >= 0.0
        probability = poses["mode_probability"][frame]
        assert 1 <= len(probability) <= CONFIG.modes
        assert probability == sorted(probability, reverse=True)
        assert probability[0] == pytest.approx(poses["peak"][frame])


def test_snapshots_are_the_estimators_own_map(tmp_path: Path) -> None:
    """The paper's grid for the paper, the cells so far for dead reckoning."""
    for variant, rows in (("paper", 33), ("dead_reckoning", None)):
        context = make_context(tmp_path / variant, walk_steps(4), variant)
        localize.run(context)
        last = {name: column[-1] for name, column in context.results(SNAPSHOTS)["snapshots"].read().items()}
        shape = len(CLASSES), last["rows"], last["columns"]
        planes = to_dense(np.array(last["cells"], np.uint32), np.array(last["weights"], np.float32), shape)
        assert rows is None or shape[1:] == (rows, rows)
        assert last["cell_m"] == pytest.approx(0.3 if rows else CELL_M)
        assert planes[1:].any()
        assert planes.max() <= 1.0
        column, row = (int(-last[f"origin_{axis}_m"] // last["cell_m"]) for axis in "xy")
        assert planes[1:, row, column + 3].any()  # just ahead of the start


class KilledError(Exception):
    """Stands for the end of the process."""


@pytest.mark.parametrize("variant", NAMES)
@pytest.mark.parametrize("cut", [1, 2])
def test_a_cut_run_goes_on_with_the_same_bytes(tmp_path: Path, variant: str, cut: int) -> None:
    """Every file of every shard, states included."""
    steps = walk_steps()
    steps[2] = replace(steps[2], motion=SE2(-50.0, 0.0, 0.0))
    steps[5] = replace(steps[5], motion=None, observation=None)
    straight = make_context(tmp_path / "straight", steps, variant)
    localize.run(straight)
    resumed = make_context(tmp_path / "resumed", steps, variant)

    def die(done: int, _total: int | None = None) -> None:
        if done > cut * CONFIG.shard_frames:
            raise KilledError

    dying = replace(resumed)
    dying.progress = die  # type: ignore[method-assign, assignment]
    with pytest.raises(KilledError):
        localize.run(dying)
    for leftover in (resumed.folder / f"shard-{cut}").iterdir():
        leftover.unlink()
    (resumed.folder / f"shard-{cut}").rmdir()
    resumed.finished = tuple(FinishedShard(i, {}, {}, resumed.folder / f"shard-{i}") for i in range(cut))
    localize.run(resumed)
    assert every_byte(resumed.folder) == every_byte(straight.folder)


def test_the_size_of_shards_changes_no_row(tmp_path: Path) -> None:
    """Three shards or one."""
    rows: list[dict[str, Any]] = []
    for shard_frames in (4, 100):
        context = make_context(
            tmp_path / str(shard_frames), walk_steps(), config=replace(CONFIG, shard_frames=shard_frames)
        )
        localize.run(context)
        rows.append({name: table.read() for name, table in context.results(POSES, SNAPSHOTS, CELLS).items()})
    assert rows[0] == rows[1]


def test_keyframes_without_observation_or_motion(tmp_path: Path) -> None:
    """A keyframe that extract skipped still gets a row; one without anything gets a null pose, and is counted."""
    steps = walk_steps(6)
    steps[2] = replace(steps[2], observation=None)
    steps[4] = replace(steps[4], observation=None, motion=None)
    context = make_context(tmp_path, steps)
    localize.run(context)
    poses = context.results(POSES)["poses"].read()
    assert poses["source"][2] == "inertial"
    assert poses["source"][4] == "none"
    assert (poses["x_m"][4], poses["y_m"][4], poses["heading_rad"][4]) == (None, None, None)
    assert poses["source"][5] == "visual"
    counters = [shard.counters for shard in context.shards]
    assert sum(c.get("poses_none", 0) for c in counters) == 1
    assert sum(sum(c.values()) for c in counters) == 6


def test_leaving_the_map_of_the_estimator_is_said(tmp_path: Path) -> None:
    """The grid of the paper has a border; the message says how to move it."""
    config = replace(CONFIG, paper=replace(CONFIG.paper, map_side=9), shard_frames=100)
    walk = [SE2(0.4 * i, 0.0, 0.0) for i in range(6)]  # the border is at 1.35 m
    context = make_context(tmp_path, make_steps(make_world(objects=0), walk), config=config)
    localize.run(context)
    (warning,) = context.shards[0].warnings
    assert warning.startswith("2 keyframes lie outside the map of `paper`, 2.7 m wide")
    assert "`localize.paper.map_side`" in warning


def warnings_of(folder: Path, steps: list[Step], variant: str) -> list[str]:
    context = make_context(folder, steps, variant)
    localize.run(context)
    return [warning for shard in context.shards for warning in shard.warnings]


def test_a_track_without_trouble_is_not_warned_of(tmp_path: Path) -> None:
    """Nothing to say about a good log, nor about a single step without motion."""
    steps = walk_steps(13)
    steps[6] = replace(steps[6], motion=None)
    for variant in ("paper", "paper_visual"):
        assert warnings_of(tmp_path / variant, steps, variant) == []


def test_lost_poses_and_missing_motion_are_said_once(tmp_path: Path) -> None:
    """For the whole log, in its last shard; visual mode does not miss a motion that it never uses."""
    steps = walk_steps(10)
    for frame in (2, 3, 7):
        steps[frame] = replace(steps[frame], motion=None, observation=None)
    motion, pose = warnings_of(tmp_path / "dead", steps, "dead_reckoning")
    assert motion.startswith("no motion for 3 of 9 steps")
    assert pose.startswith("no pose for 3 of 10 keyframes")
    (pose,) = warnings_of(tmp_path / "visual", steps, "paper_visual")
    assert pose.startswith("no pose for 3 of 10 keyframes")


def test_a_teleport_of_odometry_is_said_by_frame(tmp_path: Path) -> None:
    """Across shards too; a fast robot between far keyframes is no teleport."""
    steps = walk_steps(10)
    steps[4] = replace(steps[4], motion=SE2(100.0, 0.0, 0.0))
    (jump,) = warnings_of(tmp_path / "one", steps, "dead_reckoning")
    assert jump.startswith("odometry jumps 100 m between keyframes 3 and 4;")
    slow = [replace(step, stamp_nanos=step.stamp_nanos * 30) for step in steps]
    assert warnings_of(tmp_path / "slow", slow, "dead_reckoning") == []


def test_odometry_that_leaves_the_planet_costs_no_map(tmp_path: Path) -> None:
    """What was mapped before stays; what was seen out there is counted, and said."""
    steps = walk_steps(8)
    steps[5] = replace(steps[5], motion=SE2(1e9, 0.0, 0.0))
    context = make_context(tmp_path, steps, "dead_reckoning")
    localize.run(context)
    assert len(context.results(CELLS)["cells"].read()["ix"]) > 1000
    assert sum(shard.counters.get("observations_off_the_map", 0) for shard in context.shards) == 3
    jump, far = context.shards[-1].warnings
    assert jump.startswith("odometry jumps 1,000,000,000 m between keyframes 4 and 5;")
    assert far.startswith("3 observations lie too far")


def test_a_log_without_keyframes_gives_empty_tables(tmp_path: Path) -> None:
    """All of them there, none with a row."""
    context = make_context(tmp_path, [])
    localize.run(context)
    assert {name: table.rows for name, table in context.results(POSES, SNAPSHOTS, CELLS).items()} == {
        "poses": 0, "snapshots": 0, "cells": 0,
    }  # fmt: skip


@pytest.mark.parametrize("most", [1, 5, 8, 20])
def test_only_the_first_keyframes_if_asked(tmp_path: Path, most: int) -> None:
    """As if the log ended there."""
    results = []
    for name, steps, keyframes in (("all", walk_steps(10)[:most], 0), ("some", walk_steps(10), most)):
        context = make_context(tmp_path / name, steps, "paper", replace(CONFIG, max_keyframes=keyframes))
        localize.run(context)
        assert context.done[-1] == (min(most, 10), min(most, 10))
        results.append(every_byte(context.folder))
    assert results[0] == results[1]


def test_a_motion_that_is_no_number_is_unknown(tmp_path: Path) -> None:
    """NaN in the odometry must not poison the rest of the track."""
    steps = walk_steps(5)
    steps[2] = replace(steps[2], motion=SE2(float("nan"), 0.0, 0.0))
    context = make_context(tmp_path, steps, "dead_reckoning")
    localize.run(context)
    poses = context.results(POSES)["poses"].read()
    assert [x is None for x in poses["x_m"]] == [False, False, True, False, False]


def test_the_unobserved_plane_follows_from_the_others(tmp_path: Path) -> None:
    """Whether extract stores class 0 or leaves it out, the result is the same."""
    steps = walk_steps(3)
    bare = []
    for step in steps:
        assert step.observation is not None
        planes = step.observation.copy()
        planes[UNOBSERVED] = 0.0
        bare.append(replace(step, observation=planes))
    results = []
    for name, given in (("with", steps), ("without", bare)):
        context = make_context(tmp_path / name, given)
        localize.run(context)
        results.append(every_byte(context.folder))
    assert results[0] == results[1]


def test_a_cell_outside_the_observation_is_refused_by_frame(tmp_path: Path) -> None:
    """A table that contradicts its own grid is an error with the frame's number, not a crash."""
    context = make_context(tmp_path, walk_steps(2))
    rows = {
        "frame": [0],
        "stamp_nanos": [0],
        "cells": [[len(CLASSES) * SIDE * SIDE]],
        "weights": [[1.0]],
        "objects": [0],
    }
    path = tmp_path / "bad.parquet"
    write_table(path, OBSERVATIONS, rows, {"classes": list(CLASSES), "cell_m": CELL_M, "side": SIDE})
    context.tables = {MOTION.name: context.tables["motion"], OBSERVATIONS.name: TableFiles(OBSERVATIONS, [path])}
    with pytest.raises(SemslamError, match="frame 0"):
        localize.run(context)


def frame_rows(steps: list[Step]) -> dict[str, list[Any]]:
    """The frames table of a walk; keyframe 3 is missing. The pictures tell their keyframe's number."""
    frames = [step.frame for step in steps if step.frame != 3]
    camera = {"fx": 50.0, "fy": 51.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    camera |= {"log_time_nanos": 0, "depth_offset_nanos": 0, "camera_height_m": 1.2, "height_source": "tf"}
    camera |= {"roll_rad": 0.0, "pitch_rad": 0.0, "level_source": "tf", "robot_from_camera": np.eye(4).ravel().tolist()}
    pictures = [encode_colour(np.full((48, 64, 3), 10 * frame, np.uint8)) for frame in frames]
    depths = [encode_depth(np.full((48, 64), 0.5 + frame, np.float32)) for frame in frames]
    columns: dict[str, list[Any]] = {name: [what] * len(frames) for name, what in camera.items()}
    return {**columns, "frame": frames, "stamp_nanos": frames, "colour": pictures, "depth": depths}


class Watcher(DeadReckoning):
    """Dead reckoning that remembers what it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.views: dict[int, View | None] = {}

    def step(self, step: Step) -> PoseEstimate:
        self.views[step.frame] = step.view
        return super().step(step)


def watched_run(folder: Path, monkeypatch: pytest.MonkeyPatch, variant: str, finished: int = 0) -> Watcher:
    """A run of six keyframes, four a shard, in which a watcher stands for the variant's estimator."""
    steps, watcher = walk_steps(6), Watcher()
    monkeypatch.setattr(localize, "open_estimator", lambda *_: watcher)
    context = make_context(folder, steps, variant)
    if variant in NEEDS_VIEWS:
        write_table(folder / "frames.parquet", FRAMES, frame_rows(steps))
        context.tables = {**context.tables, FRAMES.name: TableFiles(FRAMES, [folder / "frames.parquet"])}
    if finished:
        localize.run(context)
        shard = context.folder / "shard-1"
        for file in shard.iterdir():
            file.unlink()
        shard.rmdir()
        context.finished = (FinishedShard(0, {}, {}, context.folder / "shard-0"),)
        watcher.views.clear()
    localize.run(context)
    return watcher


@pytest.mark.parametrize("variant", [name for name in NEEDS_VIEWS if name not in WHOLE_LOGS])
def test_estimators_of_pictures_see_their_keyframes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    """Colour, depth and camera of the keyframe itself; none where the table has none."""
    watcher = watched_run(tmp_path, monkeypatch, variant)
    assert list(watcher.views) == list(range(6))
    assert watcher.views[3] is None
    for frame in (0, 1, 2, 4, 5):
        view = watcher.views[frame]
        assert view is not None
        assert view.rgb.shape == (48, 64, 3)
        assert (view.rgb == 10 * frame).all()
        np.testing.assert_allclose(view.depth_m, 0.5 + frame)
        assert (view.fx, view.fy, view.cx, view.cy) == (50.0, 51.0, 31.5, 23.5)
        np.testing.assert_array_equal(view.robot_from_camera, np.eye(4))


def test_a_run_that_goes_on_shows_the_right_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second shard begins with keyframe 4."""
    watcher = watched_run(tmp_path, monkeypatch, "mapnet", finished=1)
    assert list(watcher.views) == [4, 5]
    view = watcher.views[4]
    assert view is not None
    assert (view.rgb == 40).all()


def test_other_estimators_cost_no_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They get no views, and the frames table is not even opened (here there is none)."""
    watcher = watched_run(tmp_path, monkeypatch, "paper")
    assert set(watcher.views.values()) == {None}


def test_a_task_depends_on_the_settings_of_its_own_estimator_alone() -> None:
    """Else another network for MapNet would make every estimator's tracks anew."""
    changed = replace(
        CONFIG,
        mapnet=MapNetConfig("m.onnx"),
        deepvo=DeepVoConfig("d.onnx"),
        orb_rgbd=OrbConfig(features=500),
        surfel=SurfelConfig(surfels=500),
        paper=replace(PAPER, leak=0.7),
    )
    own = {name: name for name in ("surfel", "paper", "mapnet", "deepvo", "orb_rgbd")} | {"paper_visual": "paper"}
    plain = LocalizeConfig(shard_frames=CONFIG.shard_frames, snapshot_every=CONFIG.snapshot_every)
    for name in REGISTERED:
        section = own.get(name)
        expected = replace(plain, estimators=(name,), **({section: getattr(changed, section)} if section else {}))
        assert changed.for_variant(name) == expected


def test_shipped_networks_are_named_where_they_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache key holds what a setting names, so an empty one must become the file that will be opened."""
    for name in ("map_update", "mapnet", "deepvo"):
        (tmp_path / f"{name}.onnx").touch()
    monkeypatch.setattr(builtin, "FOLDER", tmp_path)
    learned = LocalizeConfig(paper=replace(PAPER, update="learned"))
    assert with_shipped(learned.for_variant("paper")).paper.model == str(tmp_path / "map_update.onnx")
    assert with_shipped(learned.for_variant("mapnet")).mapnet.model == str(tmp_path / "mapnet.onnx")
    assert with_shipped(learned.for_variant("deepvo")).deepvo.model == str(tmp_path / "deepvo.onnx")
    assert with_shipped(CONFIG.for_variant("paper")) == CONFIG.for_variant("paper")
    assert with_shipped(learned.for_variant("dead_reckoning")) == learned.for_variant("dead_reckoning")
    named = LocalizeConfig(mapnet=MapNetConfig("mine.onnx")).for_variant("mapnet")
    assert with_shipped(named) == named


@pytest.mark.parametrize("name", ["mapnet", "deepvo"])
def test_an_estimator_without_its_network_says_how_to_name_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Where this package ships none."""
    monkeypatch.setattr(builtin, "FOLDER", tmp_path)
    with pytest.raises(SemslamError) as caught:
        open_estimator(name, LocalizeConfig(), CLASSES, CELL_M, SIDE)
    assert f"`localize.{name}.model` is empty" in caught.value.message
    assert f"--set localize.{name}.model=FILE.onnx" in caught.value.hint
