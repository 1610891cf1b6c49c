"""MapNet and DeepVO as estimators, on hand-made networks: what they do at the start, without a view, after a cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2
from semslam.models.small_view import HEIGHT, PART, PARTS, WIDTH, cells_of, small_view
from semslam.models.training import sequences
from semslam.models.training.sequences import PictureDrives, drive_files
from semslam.slam.checkpoint import unpack
from semslam.slam.deepvo_estimator import DeepVoEstimator
from semslam.slam.estimator import Estimator, PoseEstimate, Step, View
from semslam.slam.mapnet_estimator import MapNetEstimator
from semslam.slam.registry import open_estimator
from semslam.stages import localize
from semslam.stages.settings import DeepVoConfig, LocalizeConfig, MapNetConfig
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import FRAMES, POSES
from tests.onnx_factory import save, value
from tests.picture_world import make_steps, robot_from_camera, write_drive
from tests.slam_world import CELL_M, CLASSES, SIDE, MemoryContext, write_inputs

R, MAP = 4, 9
FOUND = (1, 6, 2)
"""The bin that the hand-made MapNet finds as long as its map is empty."""
MOTION = (0.2, 0.1, 0.3)
"""What the hand-made DeepVO sees between two white pictures."""
START = SE2(0.0, 0.0, 0.0)


def mapnet(path: Path, **metadata: str) -> Path:
    """A MapNet of nine cells: the field is a softmax of fixed scores and of what was written before.

    It writes the field's mass, summed over headings, and the picture's mean into its map.
    """
    scores = np.zeros((R, MAP, MAP), np.float32)
    scores[FOUND], scores[2, 1, 7] = 5.0, 4.0
    wave = np.sin(np.arange(R * MAP * MAP)).reshape(R, MAP, MAP).astype(np.float32)
    weights = {
        "scores": scores,
        "wave": wave,
        "one": np.ones((), np.float32),
        "half": np.full((), 0.5, np.float32),
        "flat": np.array([-1], np.int64),
        "grid": np.array([R, MAP, MAP], np.int64),
        "map": np.array([1, 1, MAP, MAP], np.int64),
        "headings": np.array([0], np.int64),
    }
    nodes = [
        helper.make_node("ReduceMean", ["picture"], ["mean"], keepdims=0),
        helper.make_node("Reshape", ["hidden", "grid_one"], ["before"]),
        helper.make_node("Mul", ["before", "wave"], ["memory"]),
        helper.make_node("Add", ["scores", "memory"], ["logits"]),
        helper.make_node("Reshape", ["logits", "flat"], ["flat_logits"]),
        helper.make_node("Softmax", ["flat_logits"], ["flat_field"], axis=0),
        helper.make_node("Reshape", ["flat_field", "grid"], ["looked"]),
        helper.make_node("ReduceSum", ["given"], ["known"], keepdims=0),
        helper.make_node("Sub", ["one", "known"], ["unknown"]),
        helper.make_node("Mul", ["looked", "unknown"], ["share"]),
        helper.make_node("Add", ["given", "share"], ["field"]),
        helper.make_node("ReduceSum", ["field", "headings"], ["mass"], keepdims=0),
        helper.make_node("Mul", ["mass", "mean"], ["seen"]),
        helper.make_node("Reshape", ["seen", "map"], ["placed"]),
        helper.make_node("Mul", ["hidden", "half"], ["kept"]),
        helper.make_node("Add", ["kept", "placed"], ["new_hidden"]),
        helper.make_node("Add", ["cell", "placed"], ["new_cell"]),
    ]
    weights["grid_one"] = np.array([1, MAP, MAP], np.int64)
    state = [1, 1, MAP, MAP]
    inputs = [
        value("picture", [1, 3, HEIGHT, WIDTH]),
        value("cells", [1, PARTS], TensorProto.INT64),
        value("given", [R, MAP, MAP]),
        value("hidden", state),
        value("cell", state),
    ]
    outputs = [value("field", [R, MAP, MAP]), value("new_hidden", state), value("new_cell", state)]
    facts = {"task": "mapnet", "headings": str(R), "map_side": str(MAP), "side": "5", "cell_m": "0.3"}
    return save(path, nodes, inputs, outputs, weights, metadata={**facts, **metadata})


def deepvo(path: Path, **metadata: str) -> Path:
    """A DeepVO whose motion is the product of both pictures' means with a fixed one, and a little of its memory."""
    weights = {
        "motion_of_white": np.array([MOTION], np.float32),
        "little": np.full((), 0.01, np.float32),
        "cuts": np.array([3, 3], np.int64),
        "all": np.array([1, 2, 3], np.int64),
        "row": np.array([1, 1], np.int64),
    }
    nodes = [
        helper.make_node("Split", ["pair", "cuts"], ["former", "latter"], axis=1),
        helper.make_node("ReduceMean", ["former"], ["mean_former"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("ReduceMean", ["latter"], ["mean_latter"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["mean_former", "mean_latter"], ["both"]),
        helper.make_node("Reshape", ["both", "row"], ["column"]),
        helper.make_node("Mul", ["motion_of_white", "column"], ["seen"]),
        helper.make_node("Mul", ["hidden", "little"], ["memory"]),
        helper.make_node("Add", ["seen", "memory"], ["motion"]),
        helper.make_node("Add", ["cell", "seen"], ["new_cell"]),
        helper.make_node("Tanh", ["new_cell"], ["new_hidden"]),
    ]
    inputs = [value("pair", [1, 6, HEIGHT, WIDTH]), value("hidden", [1, 3]), value("cell", [1, 3])]
    outputs = [value("motion", [1, 3]), value("new_hidden", [1, 3]), value("new_cell", [1, 3])]
    return save(path, nodes, inputs, outputs, weights, metadata={"task": "deepvo", **metadata})


def plain(grey: int) -> View:
    """A picture of one grey, without depth."""
    rgb = np.full((HEIGHT, WIDTH, 3), grey, np.uint8)
    return View(rgb, np.zeros(rgb.shape[:2], np.float32), 64.0, 64.0, 63.5, 47.5, robot_from_camera())


def steps_of(*greys: int | None) -> list[Step]:
    """A keyframe a grey; None is one without a view."""
    return [Step(i, i, None, None, None if grey is None else plain(grey)) for i, grey in enumerate(greys)]


def run(estimator: Estimator, steps: Sequence[Step]) -> list[PoseEstimate]:
    return [estimator.step(step) for step in steps]


def written(estimator: Estimator) -> NDArray[np.float32]:
    """The map of a hand-made MapNet: what was placed where, (rows, columns)."""
    return np.asarray(unpack(estimator.state())["cell"][0, 0])


def test_mapnet_starts_in_the_middle(tmp_path: Path) -> None:
    """The first keyframe's pose is known, and it is written there and nowhere else."""
    estimator = MapNetEstimator(mapnet(tmp_path / "mapnet.onnx"), modes=3)
    assert run(estimator, steps_of(255)) == [PoseEstimate(START, "start")]
    wanted = np.zeros((MAP, MAP))
    wanted[4, 4] = 1.0
    np.testing.assert_array_equal(written(estimator), wanted)
    assert estimator.belief() is None


def test_mapnet_says_what_its_field_says(tmp_path: Path) -> None:
    """Pose in the middle of the best bin; peak, entropy and modes of the softmax, by hand."""
    estimator = MapNetEstimator(mapnet(tmp_path / "mapnet.onnx"), modes=2)
    found = run(estimator, steps_of(0, 128))[1]  # the black one leaves no memory
    total = math.exp(5) + math.exp(4) + R * MAP * MAP - 2
    entropy = math.log(total) - (5 * math.exp(5) + 4 * math.exp(4)) / total
    assert found.source == "visual"
    assert found.map_from_robot == SE2(pytest.approx(-0.6), pytest.approx(0.6), pytest.approx(math.pi / 2))
    assert found.peak == pytest.approx(math.exp(5) / total, rel=1e-5)
    assert found.entropy_nats == pytest.approx(entropy, rel=1e-5)
    assert [mode.probability for mode in found.modes] == pytest.approx(
        [math.exp(5) / total, math.exp(4) / total], rel=1e-5
    )
    assert found.modes[0].map_from_robot == found.map_from_robot
    second = found.modes[1].map_from_robot
    assert second == SE2(pytest.approx(0.9), pytest.approx(-0.9), pytest.approx(math.pi))


def test_mapnet_without_a_view_has_no_pose(tmp_path: Path) -> None:
    """And its map stays as it is."""
    estimator = MapNetEstimator(mapnet(tmp_path / "mapnet.onnx"), modes=3)
    run(estimator, steps_of(255, 99))
    before = written(estimator)
    assert estimator.step(Step(2, 2, None, SE2(0.1, 0.0, 0.0))) == PoseEstimate(None, "none")
    np.testing.assert_array_equal(written(estimator), before)


def test_mapnet_takes_its_first_view_for_one_of_the_start(tmp_path: Path) -> None:
    """In an empty map everything fits everywhere; it says so."""
    estimator = MapNetEstimator(mapnet(tmp_path / "mapnet.onnx"), modes=3)
    start, first = run(estimator, steps_of(None, 255))
    assert start == PoseEstimate(START, "start")
    assert first == PoseEstimate(START, "visual", 1 / (R * MAP * MAP), math.log(R * MAP * MAP))
    assert written(estimator)[4, 4] == 1.0


def test_deepvo_composes_its_motions(tmp_path: Path) -> None:
    """Each motion in the frame of the keyframe before."""
    estimator = DeepVoEstimator(deepvo(tmp_path / "deepvo.onnx"))
    estimates = run(estimator, steps_of(255, 255, 255))
    first = START @ SE2(*MOTION)
    memory = [0.01 * math.tanh(part) for part in MOTION]
    second = first @ SE2(*(part + more for part, more in zip(MOTION, memory, strict=True)))
    assert [e.source for e in estimates] == ["start", "visual", "visual"]
    for estimate, wanted in zip(estimates[1:], (first, second), strict=True):
        assert estimate.map_from_robot == SE2(*(pytest.approx(v) for v in (wanted.x_m, wanted.y_m, wanted.heading_rad)))
    assert estimator.belief() is None


def test_deepvo_pairs_across_a_hole(tmp_path: Path) -> None:
    """A keyframe without a view has no pose; the next one is paired with the last that was seen."""
    estimator = DeepVoEstimator(deepvo(tmp_path / "deepvo.onnx"))
    estimates = run(estimator, steps_of(255, None, 51))
    assert [e.source for e in estimates] == ["start", "none", "visual"]
    found = estimates[2].map_from_robot
    assert found == SE2(*(pytest.approx(0.2 * part, rel=1e-3) for part in MOTION))


def test_deepvo_needs_two_views(tmp_path: Path) -> None:
    """The first view makes no pair; the track goes on from the start."""
    estimates = run(DeepVoEstimator(deepvo(tmp_path / "deepvo.onnx")), steps_of(None, 255, 255))
    assert [e.source for e in estimates] == ["start", "none", "visual"]
    assert estimates[2].map_from_robot == SE2(*(pytest.approx(part) for part in MOTION))


def opened(name: str, folder: Path) -> Estimator:
    """By the registry, with hand-made models."""
    config = LocalizeConfig(
        estimators=(name,),
        mapnet=MapNetConfig(str(mapnet(folder / "mapnet.onnx"))),
        deepvo=DeepVoConfig(str(deepvo(folder / "deepvo.onnx"))),
    )
    return open_estimator(name, config, CLASSES, CELL_M, SIDE)


@pytest.mark.parametrize("name", ["mapnet", "deepvo"])
@pytest.mark.parametrize("cut", [0, 1, 3, 5])
def test_a_restored_estimator_goes_on_bit_for_bit(name: str, cut: int, tmp_path: Path) -> None:
    """Before the start, after it, after a hole, in the middle."""
    steps = make_steps(7, without_view=(2,))
    straight, first, second = (opened(name, tmp_path) for _ in range(3))
    expected = run(straight, steps)
    run(first, steps[:cut])
    second.restore(first.state())
    assert second.state() == first.state()
    assert run(second, steps[cut:]) == expected[cut:]
    assert second.state() == straight.state()


@pytest.mark.parametrize("name", ["mapnet", "deepvo"])
def test_motion_is_never_looked_at(name: str, tmp_path: Path) -> None:
    """Same track with any motion as without."""
    steps = make_steps(5)
    moved = [replace(step, motion=SE2(1.0, 1.0, 1.0)) for step in steps]
    assert run(opened(name, tmp_path), moved) == run(opened(name, tmp_path), steps)


@pytest.mark.parametrize("name", ["mapnet", "deepvo"])
def test_localize_runs_them_on_the_frames_table(name: str, tmp_path: Path) -> None:
    """The stage gives them the pictures, and writes the poses they give."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    files = write_drive(folder, 4)
    stamps = [Step(frame, 10 * frame, None, None) for frame in range(4)]
    tables = {**write_inputs(folder, stamps), "frames": TableFiles(FRAMES, files.frames)}
    config = LocalizeConfig(
        mapnet=MapNetConfig(str(mapnet(folder / "mapnet.onnx"))),
        deepvo=DeepVoConfig(str(deepvo(folder / "deepvo.onnx"))),
    )
    context = MemoryContext(tmp_path / "out", tables, config.for_variant(name), name)
    localize.run(context)
    poses = context.results(POSES)["poses"].read()
    assert poses["source"] == ["start", "visual", "visual", "visual"]
    assert None not in poses["x_m"]
    assert (poses["x_m"][0], poses["y_m"][0]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("opened_as", "made", "metadata", "key"),
    [
        (lambda path: MapNetEstimator(path, 3), deepvo, {}, "localize.mapnet.model"),
        (lambda path: MapNetEstimator(path, 3), mapnet, {"headings": "36"}, "localize.mapnet.model"),
        (lambda path: MapNetEstimator(path, 3), mapnet, {"side": "wide"}, "localize.mapnet.model"),
        (DeepVoEstimator, mapnet, {}, "localize.deepvo.model"),
        (DeepVoEstimator, deepvo, {"task": "detect"}, "localize.deepvo.model"),
    ],
)
def test_another_network_is_refused(
    opened_as: Any, made: Any, metadata: dict[str, str], key: str, tmp_path: Path
) -> None:
    """By name, with what it takes and the setting to change."""
    with pytest.raises(SemslamError, match=r"`.*other.onnx` is no") as caught:
        opened_as(made(tmp_path / "other.onnx", **metadata))
    assert key in (caught.value.hint or "")
    assert "input" in (caught.value.details or "")


@pytest.mark.parametrize("scale", [1, 3])
def test_a_small_view_lies_where_the_pixels_fall(scale: int) -> None:
    """Parts of a floor seen from above, against the ray through their middles; whatever the picture's size."""
    camera, focal = robot_from_camera(1.0, math.pi / 2), 64.0 * scale  # straight down
    rgb = np.zeros((HEIGHT * scale, WIDTH * scale, 3), np.uint8)
    depth = np.ones(rgb.shape[:2], np.float32)
    depth[: HEIGHT * scale // 2] = 0.0  # the half ahead is missing
    small = small_view(rgb, depth, focal, focal, 64.0 * scale - 0.5, 48.0 * scale - 0.5, camera)
    ground = small.ground_m.reshape(HEIGHT // PART, WIDTH // PART, 2)
    assert np.isnan(ground[: HEIGHT // PART // 2]).all()
    v, u = np.mgrid[: HEIGHT // PART, : WIDTH // PART]
    x, y = (48.0 - PART * (v + 0.5)) / 64.0, (64.0 - PART * (u + 0.5)) / 64.0
    half = HEIGHT // PART // 2
    np.testing.assert_allclose(ground[half:], np.stack([x, y], -1)[half:], atol=0.6 / 64.0)


def test_near_far_and_high_parts_have_no_place() -> None:
    """Depth below 0.3 m or beyond 6 m, and ceilings, fall into no cell."""
    level = robot_from_camera(1.0, 0.0)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for depth_m, kept in ((0.2, False), (1.0, True), (7.0, False)):
        depth = np.full(rgb.shape[:2], depth_m, np.float32)
        assert np.isfinite(small_view(rgb, depth, 64.0, 64.0, 63.5, 47.5, level).ground_m).any() == kept
    far = small_view(rgb, np.full(rgb.shape[:2], 5.0, np.float32), 64.0, 64.0, 63.5, 47.5, level).ground_m
    rows = np.isfinite(far.reshape(HEIGHT // PART, WIDTH // PART, 2)).all((1, 2))
    assert not rows[:8].any()  # they rise above 2 m five metres ahead
    assert rows[10:].all()
    assert (cells_of(np.array([[np.nan, np.nan], [9.0, 0.0]], np.float32), 0.3, 5) == 25).all()
    assert cells_of(np.array([0.31, -0.31], np.float32), 0.3, 5) == 1 * 5 + 3  # ahead is a column on, right a row down


def test_sequences_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second opening decodes nothing, and a damaged array file is made again; all give the same."""
    files, cache = [write_drive(tmp_path / "log", 4)], tmp_path / "cache"
    first = PictureDrives.open(files, cache)
    (path,) = cache.iterdir()
    path.write_bytes(path.read_bytes()[:1000])
    again = PictureDrives.open(files, cache)
    monkeypatch.setattr(sequences, "_made", lambda _: pytest.fail("decoded again"))
    third = PictureDrives.open(files, cache)
    assert first.digest == again.digest == third.digest
    for other in (again, third):
        np.testing.assert_array_equal(other.drives[0].pictures, first.drives[0].pictures)
        np.testing.assert_array_equal(other.drives[0].ground_m, first.drives[0].ground_m)


def test_a_stored_drive_is_the_drive(tmp_path: Path) -> None:
    """Poses come from the truth by stamp; where that is missing no window goes."""
    drives = PictureDrives.open([write_drive(tmp_path / "log", 8, untrue=(4,))], tmp_path / "cache")
    drive = drives.drives[0]
    assert drive.pictures.shape == (8, HEIGHT, WIDTH, 3)
    assert np.flatnonzero(np.isnan(drive.poses).any(1)).tolist() == [4]
    assert drives.windows(3).tolist() == [[0, 0], [0, 1], [0, 5]]
    clip = drives.clip(0, 5, 3)
    np.testing.assert_allclose(clip.poses[:2], [[0.0, 0.0, 0.0], [0.25, 0.0, clip.poses[1, 2]]], atol=1e-9)
    with pytest.raises(SemslamError, match="5 keyframes with truth"):
        drives.windows(5)


def test_logs_without_keyframes_are_named(tmp_path: Path) -> None:
    """What is missing, and what to type."""
    frames = {"home_00_t0": (tmp_path / "frames.parquet",)}
    with pytest.raises(SemslamError, match="1 of 2 logs have no keyframes, such as `home_00_t1`") as caught:
        drive_files(tmp_path, ["home_00_t0", "home_00_t1"], frames)
    assert "semslam ingest" in (caught.value.hint or "")
    found = drive_files(tmp_path, ["home_00_t0"], frames)[0]
    assert found.truth == (tmp_path / "truth" / "home_00_t0" / "truth.parquet",)
