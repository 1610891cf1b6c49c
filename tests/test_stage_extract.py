"""Extract puts objects where they stand in the room, and lets every cell be traced to a detection."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import helper

from semslam.errors import SemslamError
from semslam.geometry import rle
from semslam.geometry.frames import SE2
from semslam.geometry.grid import to_dense
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.models import builtin
from semslam.models.builtin import with_shipped
from semslam.models.detectors import Detections, Detector
from semslam.models.session import Session
from semslam.pipeline.config import file_settings, load_config
from semslam.pipeline.job import Outcome
from semslam.stages.catalogue import EXTRACT, INGEST, STAGES
from semslam.stages.extract import ObjectClasses
from semslam.stages.settings import ExtractConfig, IngestConfig
from semslam.tables.pictures import decode_colour
from semslam.tables.spec import DETECTIONS, FRAMES, OBSERVATIONS
from tests.make_log import ToyTruth, make_log
from tests.onnx_factory import constant_detector, dense, sam_decoder, sam_encoder, save, value
from tests.stage_room import Done, run_stage, try_stage
from tests.toy.render import Renderer, visible_boxes
from tests.toy.toyroom import CLASSES

SIZE = (160, 120)
NAMES = {"names": str(dict(enumerate(CLASSES)))}


def first_view_boxes(truth: ToyTruth) -> list[Any]:
    """The true boxes of the first keyframe, largest first."""
    x, y, heading = truth.poses[0]
    room_from_base = np.eye(4)
    cosine, sine = math.cos(heading), math.sin(heading)
    room_from_base[:2, :2] = [[cosine, -sine], [sine, cosine]]
    room_from_base[:2, 3] = x, y
    view = Renderer(truth.room).view(truth.colour_camera, room_from_base @ truth.base_from_camera)
    return sorted(visible_boxes(view, min_pixels=150), key=lambda box: -box.pixels)


def oracle(path: Path, boxes: list[Any], extra: Mapping[int, list[float]] | None = None) -> Path:
    """A YOLOv8-shaped network that answers every picture with these boxes."""
    width, height = SIZE
    rows = dict(extra or {})
    for index, box in enumerate(boxes):
        scores = [0.0] * len(CLASSES)
        scores[box.class_id] = 0.9 - 0.01 * index
        centre = [(box.left + box.right) / 2, (box.top + box.bottom) / 2]
        rows[index] = [*centre, box.right - box.left, box.bottom - box.top, *scores]
    columns = dense(84, 4 + len(CLASSES), rows).transpose(0, 2, 1).copy()
    return constant_detector(path, {"output0": columns}, input_shape=(1, 3, height, width), metadata=NAMES)


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> tuple[ToyTruth, Done, list[Any], Path]:
    """One keyframe of a toy room, ingested, with a detector that knows the truth about it."""
    folder = tmp_path_factory.mktemp("extract")
    truth = make_log(folder / "toy.mcap", frames=1, seed=3, size=SIZE, noise=False)
    boxes = first_view_boxes(truth)
    assert boxes
    frames = run_stage(folder, INGEST, IngestConfig(), sources=[truth.path])
    return truth, frames, boxes, oracle(folder / "oracle.onnx", boxes)


def extract(folder: Path, frames: Done, detector: Path | str, **settings: Any) -> Done:
    return run_stage(folder, EXTRACT, ExtractConfig(detector=str(detector), **settings), inputs=[frames])


def refused(folder: Path, frames: Done, **settings: Any) -> Outcome:
    outcome = try_stage(folder, EXTRACT, ExtractConfig(**settings), inputs=[frames])
    assert outcome.failure is not None
    return outcome


def picture(frames: Done, index: int) -> np.ndarray:
    """The colour picture of a keyframe."""
    return decode_colour(frames.rows(FRAMES)[index]["colour"])


def failing_on(monkeypatch: pytest.MonkeyPatch, bad: list[np.ndarray]) -> list[np.ndarray]:
    """Have every detector fail on these pictures; the list may grow."""
    real = Detector.look

    def failing(self: Detector, pictures: Any, *rest: Any) -> Any:
        if any(np.array_equal(one, other) for one in pictures for other in bad):
            raise SemslamError("the model fails on this picture")
        return real(self, pictures, *rest)

    monkeypatch.setattr(Detector, "look", failing)
    return bad


def planes_of(done: Done) -> np.ndarray:
    meta = done.table(OBSERVATIONS).meta
    row = done.rows(OBSERVATIONS)[0]
    return to_dense(
        np.array(row["cells"], np.uint32),
        np.array(row["weights"], np.float32),
        (len(meta["classes"]), meta["side"], meta["side"]),
    )


def test_objects_stand_where_they_are(toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path) -> None:
    """The cells of a class lie on the footprints of that class, to a few cells, where nothing stands before them."""
    truth, frames, boxes, _ = toy
    boxes = [box for box in boxes if box.pixels > 0.5 * (box.right - box.left) * (box.bottom - box.top)]
    assert boxes
    detector = oracle(tmp_path / "clear.onnx", boxes)
    done = extract(tmp_path, frames, detector)
    planes, meta = planes_of(done), done.table(OBSERVATIONS).meta
    base = SE2(*truth.poses[0])
    for class_id in {box.class_id for box in boxes}:
        plane = planes[meta["classes"].index(CLASSES[class_id])]
        iy, ix = np.nonzero(plane > 0.002)
        assert len(ix) > 0, CLASSES[class_id]
        seen = (np.stack([ix, iy], 1) - meta["side"] // 2) * meta["cell_m"]
        in_room = base.apply(seen)
        footprints = [thing for thing in truth.objects if thing.class_name == CLASSES[class_id]]
        away = np.min([distance_to(thing, in_room) for thing in footprints], axis=0)
        weight = plane[iy, ix] / plane[iy, ix].sum()
        assert (weight * (away < 0.25)).sum() > 0.8, CLASSES[class_id]


def distance_to(thing: Any, points: np.ndarray) -> np.ndarray:
    """Distance of points (N, 2) to an object's footprint, metres."""
    local = SE2(thing.x_m, thing.y_m, thing.yaw_rad).inverse().apply(points)
    beyond = np.maximum(np.abs(local) - np.array([thing.depth_m, thing.width_m]) / 2, 0)
    return np.asarray(np.hypot(beyond[:, 0], beyond[:, 1]))


def test_floor_walls_and_the_unseen(toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path) -> None:
    """Free floor lies inside the room, walls at its border, and behind them nothing was seen."""
    truth, frames, _, detector = toy
    planes = planes_of(extract(tmp_path, frames, detector))
    centre = planes.shape[1] // 2
    base = SE2(*truth.poses[0])
    iy, ix = np.nonzero(planes[FREE_FLOOR])
    assert len(ix) > 50
    in_room = base.apply((np.stack([ix, iy], 1) - centre) * 0.1)
    half = np.array([truth.room.width_m, truth.room.depth_m]) / 2
    assert (np.abs(in_room) < half + 0.1).all(axis=1).mean() > 0.97
    assert planes[OBSTACLE].sum() > 10
    iy, ix = np.indices(planes.shape[1:]).reshape(2, -1)
    beyond = (np.abs(base.apply((np.stack([ix, iy], 1) - centre) * 0.1)) > half + 0.3).any(axis=1)
    assert planes[UNOBSERVED].ravel()[beyond].mean() > 0.98
    assert planes[UNOBSERVED][:, : centre - 3].all()  # behind the camera


def test_a_cell_can_be_traced_to_a_detection(toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path) -> None:
    """Each detection keeps box, score, names, mask and 3D extent."""
    _, frames, boxes, detector = toy
    rows = extract(tmp_path, frames, detector).rows(DETECTIONS)
    assert len(rows) == len(boxes)
    assert [row["score"] for row in rows] == sorted((row["score"] for row in rows), reverse=True)
    for row, box in zip(rows, boxes, strict=True):
        assert (row["label"], row["source_label"]) == (CLASSES[box.class_id],) * 2
        assert (row["x0_px"], row["y1_px"]) == pytest.approx((box.left, box.bottom), abs=1)
        mask = rle.decode(row["mask_runs"], SIZE[1], SIZE[0])
        assert mask.sum() == row["mask_pixels"] > 0
        assert row["min_z_m"] < row["max_z_m"] < 2.7
        assert row["min_z_m"] > -0.2


def test_select_exclude_remap(toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path) -> None:
    """Classes can be dropped, renamed and merged; the class list tells."""
    _, frames, boxes, detector = toy
    name = CLASSES[boxes[0].class_id]
    only = extract(tmp_path / "a", frames, detector, select=(name,))
    assert only.table(OBSERVATIONS).meta["classes"][FIRST_OBJECT:] == [name]
    assert {row["label"] for row in only.rows(DETECTIONS)} == {name}
    without = extract(tmp_path / "b", frames, detector, exclude=(name,))
    assert name not in without.table(OBSERVATIONS).meta["classes"]
    merged = extract(tmp_path / "c", frames, detector, remap=dict.fromkeys(CLASSES, "thing"))
    assert merged.table(OBSERVATIONS).meta["classes"][FIRST_OBJECT:] == ["thing"]
    assert {row["source_label"] for row in merged.rows(DETECTIONS)} == {CLASSES[box.class_id] for box in boxes}


def test_impossible_boxes_are_counted(toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path) -> None:
    """NaN from a model drops that candidate, and says how many."""
    _, frames, boxes, _ = toy
    broken = oracle(tmp_path / "nan.onnx", boxes, {80: [math.nan, 1, 1, 1, *[0.9] * len(CLASSES)]})
    done = extract(tmp_path, frames, broken)
    assert len(done.rows(DETECTIONS)) == len(boxes)
    assert done.manifest["counters"]["boxes_impossible"] == 1


def test_one_bad_keyframe_does_not_stop_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that fails on one picture costs that picture; one that fails on all is an error."""
    truth = make_log(tmp_path / "toy.mcap", frames=3, size=SIZE)
    frames = run_stage(tmp_path, INGEST, IngestConfig(), sources=[truth.path])
    detector = oracle(tmp_path / "oracle.onnx", first_view_boxes(truth)[:2])
    bad = failing_on(monkeypatch, [picture(frames, 1)])
    done = extract(tmp_path / "one", frames, detector)
    assert [row["frame"] for row in done.rows(OBSERVATIONS)] == [0, 1, 2]
    assert done.manifest["counters"]["frames_failed"] == 1
    assert any("keyframe 1 left out" in warning for warning in done.manifest["warnings"])
    bad += [picture(frames, 0), picture(frames, 2)]
    failure = refused(tmp_path / "all", frames, detector=str(detector)).failure
    assert failure is not None
    assert "fails on this picture" in failure.message


def test_no_objects_is_a_result(toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path) -> None:
    """A detector that finds nothing leaves floor and walls."""
    _, frames, _, _ = toy
    done = extract(tmp_path, frames, oracle(tmp_path / "blind.onnx", []))
    assert done.rows(DETECTIONS) == []
    assert done.rows(OBSERVATIONS)[0]["objects"] == 0
    assert planes_of(done)[FREE_FLOOR].sum() > 50
    assert done.manifest["counters"]["frames_without_objects"] == 1


def test_what_is_wrong_is_said(
    toy: tuple[ToyTruth, Done, list[Any], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No detector, an even side, an unknown class: one sentence and something to type."""
    monkeypatch.setattr(builtin, "FOLDER", tmp_path)
    _, frames, _, detector = toy
    none = refused(tmp_path, frames).failure
    assert none is not None
    assert "--detector" in none.hint
    even = refused(tmp_path, frames, detector=str(detector), side=98).failure
    assert even is not None
    assert "extract.side=99" in even.hint
    floor = refused(tmp_path, frames, detector=str(detector), remap={"chair": "free_floor"}).failure
    assert floor is not None
    assert "reserved" in floor.hint
    typo = refused(tmp_path, frames, detector=str(detector), exclude=("chairr",)).failure
    assert typo is not None
    assert "`chair`" in typo.hint


def test_resumed_extract_gives_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped after a shard and run again: same tables, and finished keyframes are not looked at again."""
    truth = make_log(tmp_path / "toy.mcap", frames=5, size=SIZE)
    frames = run_stage(tmp_path, INGEST, IngestConfig(), sources=[truth.path])
    detector = oracle(tmp_path / "oracle.onnx", first_view_boxes(truth)[:2])
    whole = extract(tmp_path / "whole", frames, detector, shard_frames=2)
    from semslam.stages import extract as stage

    real, looks = stage.look, []

    def counting(*args: Any) -> Any:
        looks.append(1)
        if len(looks) == 4:
            raise RuntimeError("stopped by the test")
        return real(*args)

    monkeypatch.setattr(stage, "look", counting)
    config = ExtractConfig(detector=str(detector), shard_frames=2)
    assert try_stage(tmp_path / "stopped", EXTRACT, config, inputs=[frames]).failure is not None
    resumed = extract(tmp_path / "stopped", frames, detector, shard_frames=2)
    assert resumed.outcome.resumed == 1
    assert len(looks) == 4 + 3
    assert resumed.digests == whole.digests


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Done, Path]:
    """Five ingested keyframes, and a detector of open batch size whose boxes move with the brightness of a picture."""
    folder = tmp_path_factory.mktemp("drive")
    truth = make_log(folder / "toy.mcap", frames=5, size=SIZE)
    frames = run_stage(folder, INGEST, IngestConfig(), sources=[truth.path])
    return frames, moving_detector(folder / "moving.onnx")


def moving_detector(path: Path) -> Path:
    """YOLOv8's layout; its two boxes stand `40 * mean(picture)` pixels further right and lower than written here."""
    scores = [0.0] * len(CLASSES)
    rows = {0: [30.0, 40.0, 40.0, 50.0, 0.9, *scores[1:]], 1: [90.0, 60.0, 30.0, 40.0, 0.0, 0.8, *scores[2:]]}
    weights = {
        "boxes": dense(84, 4 + len(CLASSES), rows).transpose(0, 2, 1).copy(),
        "reach": np.array([40.0, 40.0] + [0.0] * (2 + len(CLASSES)), np.float32).reshape(1, -1, 1),
        "flat": np.array([-1, 1, 1], np.int64),
    }
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3]),
        helper.make_node("Reshape", ["mean", "flat"], ["brightness"]),
        helper.make_node("Mul", ["brightness", "reach"], ["shift"]),
        helper.make_node("Add", ["boxes", "shift"], ["output0"]),
    ]
    inputs = [value("images", ("batch", 3, SIZE[1], SIZE[0]))]
    return save(path, nodes, inputs, [value("output0", ("batch", 4 + len(CLASSES), 84))], weights, metadata=NAMES)


def test_results_do_not_depend_on_the_batch(
    drive: tuple[Done, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keyframes looked at together give the bytes they give alone, in fewer runs of the detector."""
    frames, detector = drive
    real, pictures = Session.run, []

    def counting(session: Session, feeds: Mapping[str, Any]) -> Any:
        pictures.append(len(feeds["images"]))
        return real(session, feeds)

    monkeypatch.setattr(Session, "run", counting)
    alone = extract(tmp_path / "1", frames, detector, batch=1)
    assert len({row["x0_px"] for row in alone.rows(DETECTIONS)}) == 10
    pictures.clear()
    for batch in (2, 4, 9):
        assert extract(tmp_path / str(batch), frames, detector, batch=batch).digests == alone.digests
    assert [count for count in pictures if count > 1] == [2, 2, 4, 5]
    assert extract(tmp_path / "shards", frames, detector, batch=4, shard_frames=3).rows(DETECTIONS) == alone.rows(
        DETECTIONS
    )


def test_a_bad_keyframe_of_a_batch_fails_alone(
    drive: tuple[Done, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a run on several pictures fails, the good ones among them are looked at all the same."""
    frames, detector = drive
    whole = extract(tmp_path / "whole", frames, detector, batch=3)
    failing_on(monkeypatch, [picture(frames, 1)])
    done = extract(tmp_path / "bad", frames, detector, batch=3)
    assert done.manifest["counters"]["frames_failed"] == 1
    assert {row["frame"] for row in done.rows(DETECTIONS)} == {0, 2, 3, 4}
    assert [r for r in whole.rows(OBSERVATIONS) if r["frame"] != 1] == [
        r for r in done.rows(OBSERVATIONS) if r["frame"] != 1
    ]


def with_masks(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    """Have every detector give masks of this size: for its first object the upper half, for its second a third."""
    real = Detector.look

    def masked(self: Detector, *args: Any) -> list[Detections]:
        masks = np.zeros((2, *shape), bool)
        masks[0, : shape[0] // 2] = masks[1, : shape[0] // 3] = True
        return [replace(found, masks=masks[: len(found)]) for found in real(self, *args)]

    monkeypatch.setattr(Detector, "look", masked)


def test_masks_of_the_detector_are_used_unless_another_way_is_named(
    drive: tuple[Done, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With segmenter auto a detector that gives masks needs no segmenter; with box, boxes are filled as ever."""
    frames, detector = drive
    box = extract(tmp_path / "plain", frames, detector, segmenter="box")
    with_masks(monkeypatch, (SIZE[1], SIZE[0]))
    rows = extract(tmp_path / "auto", frames, detector, select=(CLASSES[1],)).rows(DETECTIONS)
    assert [row["mask_pixels"] for row in rows] == [SIZE[0] * SIZE[1] // 3] * 5
    assert extract(tmp_path / "box", frames, detector, segmenter="box").digests == box.digests


def test_masks_of_another_size_are_no_traceback(
    drive: tuple[Done, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message tells both sizes and a way out."""
    frames, detector = drive
    with_masks(monkeypatch, (30, 40))
    failure = refused(tmp_path, frames, detector=str(detector)).failure
    assert failure is not None
    assert "masks [2, 30, 40] for 2 objects in a picture [120, 160]" in failure.message
    assert "extract.segmenter=depth_box" in failure.hint


def test_shipped_models_are_used_where_none_are_named(
    drive: tuple[Done, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a setting extract takes the models of the package; with one, that. The pair goes with the detector."""
    frames, detector = drive
    monkeypatch.setattr(builtin, "FOLDER", tmp_path)
    moving_detector(tmp_path / "detector.onnx")
    assert extract(tmp_path / "a", frames, "").digests == extract(tmp_path / "b", frames, detector).digests
    pair = sam_encoder(tmp_path / "segmenter_encoder.onnx"), sam_decoder(tmp_path / "segmenter_decoder.onnx")
    shipped = extract(tmp_path / "c", frames, "")
    given = {"segmenter_encoder": str(pair[0]), "segmenter_decoder": str(pair[1])}
    assert shipped.digests == extract(tmp_path / "d", frames, detector, segmenter="sam", **given).digests
    assert shipped.digests == extract(tmp_path / "e", frames, detector, segmenter="sam").digests
    plain = extract(tmp_path / "f", frames, detector, segmenter="depth_box")
    assert shipped.digests != plain.digests == extract(tmp_path / "g", frames, detector).digests


def test_the_cache_key_holds_the_shipped_models_that_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task names every shipped file it may use, and no other; what a user names stays."""
    monkeypatch.setattr(builtin, "FOLDER", tmp_path)

    def named(*assignments: str) -> dict[str, str]:
        config = load_config(STAGES, assignments=assignments)
        return {key: Path(path).name for key, path in file_settings(config.for_variant(EXTRACT, ""), "extract")}

    assert named() == {}
    for name in ("detector", "segmenter_encoder", "segmenter_decoder"):
        (tmp_path / f"{name}.onnx").write_bytes(b"")
    keys = ("extract.detector", "extract.segmenter_encoder", "extract.segmenter_decoder")
    every = {key: f"{key.removeprefix('extract.')}.onnx" for key in keys}
    assert named() == named("extract.segmenter=sam") == every
    assert named("extract.segmenter=box") == {"extract.detector": "detector.onnx"}
    assert named("extract.detector=mine.onnx") == {"extract.detector": "mine.onnx"}
    mine = every | {"extract.detector": "mine.onnx"}
    assert named("extract.detector=mine.onnx", "extract.segmenter=sam") == mine
    half = named("extract.segmenter_encoder=mine.onnx")
    assert half == {"extract.detector": "detector.onnx", "extract.segmenter_encoder": "mine.onnx"}
    assert with_shipped(with_shipped(ExtractConfig())) == with_shipped(ExtractConfig())


def test_looking_ahead_changes_nothing() -> None:
    """Groups come in their order, and what goes wrong in making one is said when its turn comes."""
    from semslam.stages.extract import ahead

    def groups() -> Iterator[list[Any]]:
        yield from ([1], [2, 3])
        raise SemslamError("Stored picture cannot be decoded")

    got: list[Any] = []
    with pytest.raises(SemslamError, match="cannot be decoded"):
        got.extend(ahead(groups()))
    assert got == [[1], [2, 3]]
    assert list(ahead(iter([]))) == []


@pytest.mark.parametrize("name", ["unobserved", "free_floor", "", "two\nlines"])
def test_a_detector_s_class_may_not_have_a_reserved_or_unprintable_name(name: str) -> None:
    """It would be taken for something else; renamed or left out, it is no trouble."""
    with pytest.raises(SemslamError, match="no object class may have") as caught:
        ObjectClasses.choose([name, "chair"], ExtractConfig())
    assert "remap" in (caught.value.hint or "")
    assert ObjectClasses.choose([name, "chair"], ExtractConfig(remap={name: "thing"})).all[-2:] == ("thing", "chair")
    assert ObjectClasses.choose([name, "chair"], ExtractConfig(exclude=(name,))).all[-1] == "chair"
