"""Ingest gives keyframes whose geometry, motion and truth are those of the room the log was recorded in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semslam.geometry.frames import FLU_FROM_OPTICAL, SE2, wrap_angle
from semslam.logs.decode import decoder_for
from semslam.logs.messages import CompressedImage, Imu, Message, Odometry
from semslam.logs.reader import LogReader
from semslam.logs.roles import choose_roles, peek
from semslam.logs.writer import Ros2LogWriter
from semslam.stages.catalogue import INGEST
from semslam.stages.contract import ShardWriter, StageContext
from semslam.stages.keyframes import KeyframeWalk
from semslam.stages.settings import IngestConfig
from semslam.tables.pictures import decode_colour, decode_depth
from semslam.tables.spec import FRAMES, MOTION, TOPICS, TRUTH
from tests.make_log import ToyTruth, make_log
from tests.stage_room import Done, run_stage, try_stage


def ingest(folder: Path, truth: ToyTruth, config: IngestConfig | None = None) -> Done:
    return run_stage(folder, INGEST, config or IngestConfig(), sources=[truth.path])


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[ToyTruth, Done]:
    """A small log as most robots leave it, ingested once."""
    folder = tmp_path_factory.mktemp("plain")
    truth = make_log(folder / "toy.mcap", frames=4)
    return truth, ingest(folder, truth)


def test_keyframes_are_whole(plain: tuple[ToyTruth, Done]) -> None:
    """Every keyframe has its stamp, its pictures and its intrinsics."""
    truth, done = plain
    rows = done.rows(FRAMES)
    assert [row["stamp_nanos"] for row in rows] == list(truth.stamps_nanos)
    assert [row["frame"] for row in rows] == [0, 1, 2, 3]
    for row in rows:
        assert decode_colour(row["colour"]).shape == (120, 160, 3)
        assert decode_depth(row["depth"]).shape == (120, 160)
        assert (row["width"], row["height"]) == (160, 120)
        assert row["fx"] == pytest.approx(truth.colour_camera.fx)


def test_jpeg_of_a_pinhole_camera_is_kept_as_recorded(plain: tuple[ToyTruth, Done]) -> None:
    """Nothing is encoded twice: the stored file is the recorded one."""
    assert all(row["colour"][:2] == b"\xff\xd8" for row in plain[1].rows(FRAMES))


def test_camera_pose_on_the_robot(plain: tuple[ToyTruth, Done]) -> None:
    """robot_from_camera is the mounting of the camera, with the height seen from the floor."""
    truth, done = plain
    for row in done.rows(FRAMES):
        found = np.array(row["robot_from_camera"]).reshape(4, 4)
        assert np.allclose(found[:3, :3], truth.base_from_camera[:3, :3], atol=1e-6)
        assert np.allclose(found[:2, 3], truth.base_from_camera[:2, 3], atol=1e-6)
        assert found[2, 3] == pytest.approx(truth.base_from_camera[2, 3], abs=0.03)
        assert (row["level_source"], row["height_source"]) == ("tf", "floor")


def test_truth_is_the_path_that_was_driven(plain: tuple[ToyTruth, Done]) -> None:
    """Ground truth at each keyframe is the pose of the robot when the picture was taken."""
    truth, done = plain
    found = [(row["x_m"], row["y_m"], row["heading_rad"]) for row in done.rows(TRUTH)]
    assert np.allclose(found, truth.poses, atol=1e-3)


def test_motion_is_odometry_between_keyframes(plain: tuple[ToyTruth, Done]) -> None:
    """The first keyframe has no motion, the others that of the wheels, close to the true one."""
    truth, done = plain
    rows = done.rows(MOTION)
    assert [row["source"] for row in rows] == ["start", "odometry", "odometry", "odometry"]
    assert rows[0]["dx_m"] is None
    for row, before, after in zip(rows[1:], truth.poses[:-1], truth.poses[1:], strict=True):
        true = SE2(*before).between(SE2(*after))
        assert math.hypot(row["dx_m"] - true.x_m, row["dy_m"] - true.y_m) < 0.2
        assert abs(wrap_angle(row["dheading_rad"] - true.heading_rad)) < math.radians(8)


def test_topics_tell_what_was_read(plain: tuple[ToyTruth, Done]) -> None:
    """Each topic with its role and its number of messages."""
    rows = {row["topic"]: row for row in plain[1].rows(TOPICS)}
    assert rows["/camera/color/image_raw/compressed"]["role"] == "colour"
    assert rows["/camera/color/image_raw/compressed"]["messages"] == 4
    assert rows["/tf_static"]["role"] == "tf"
    assert rows["/ground_truth/pose"]["role"] == "truth"
    assert all(row["skipped"] == 0 for row in rows.values())


@pytest.mark.parametrize("depth", ["png", "rvl", "raw16", "raw32"])
def test_depth_is_registered_to_colour(tmp_path: Path, depth: str) -> None:
    """A depth camera with its own lens and place gives the depth that the colour camera would measure."""
    beside = make_log(tmp_path / "a.mcap", frames=1, depth=depth, noise=False, depth_camera_offset=(0.0, 0.03, 0.0))
    within = make_log(tmp_path / "b.mcap", frames=1, depth="raw32", noise=False)
    found, wanted = (
        decode_depth(ingest(tmp_path / name, truth).rows(FRAMES)[0]["depth"])
        for name, truth in (("a", beside), ("b", within))
    )
    assert (found > 0).mean() > 0.9 * (wanted > 0).mean()
    around = np.ones((7, 7), np.uint8)
    smooth = cv2.dilate(wanted, around) - cv2.erode(wanted, around) < 0.1  # away from outlines, where views differ
    error = np.abs(found - wanted)[smooth & (found > 0) & (wanted > 0)]
    assert error.size > 1000
    assert np.percentile(error, 99) < 0.02


def test_raw_colour_becomes_png_without_loss(tmp_path: Path) -> None:
    """An uncompressed picture is stored without loss."""
    truth = make_log(tmp_path / "toy.mcap", frames=1, compressed=False)
    row = ingest(tmp_path, truth).rows(FRAMES)[0]
    assert row["colour"][:4] == b"\x89PNG"
    lossy = make_log(tmp_path / "lossy.mcap", frames=1, compressed=True)
    other = decode_colour(ingest(tmp_path / "lossy", lossy).rows(FRAMES)[0]["colour"])
    assert np.abs(decode_colour(row["colour"]).astype(int) - other).mean() < 8


def test_without_tf_the_imu_levels_the_camera(tmp_path: Path) -> None:
    """A camera pitched 25 degrees, with no frame tree at all, is levelled by its accelerometer and gyro."""
    pitch = math.radians(25)
    truth = make_log(tmp_path / "toy.mcap", frames=4, tf=False, pitch_rad=pitch)
    for row in ingest(tmp_path, truth).rows(FRAMES):
        assert row["level_source"] == "imu"
        assert row["pitch_rad"] == pytest.approx(pitch, abs=math.radians(1.5))
        assert row["camera_height_m"] == pytest.approx(0.55, abs=0.06)


def test_without_odometry_the_imu_tells_the_turn(tmp_path: Path) -> None:
    """Motion falls back to the IMU, and says so; its heading is good."""
    truth = make_log(tmp_path / "toy.mcap", frames=4, odometry=False)
    rows = ingest(tmp_path, truth).rows(MOTION)
    assert [row["source"] for row in rows] == ["start", "imu", "imu", "imu"]
    for row, before, after in zip(rows[1:], truth.poses[:-1], truth.poses[1:], strict=True):
        assert abs(wrap_angle(row["dheading_rad"] - (after[2] - before[2]))) < math.radians(3)


def test_without_any_motion_the_source_is_none(tmp_path: Path) -> None:
    """Neither odometry nor IMU: keyframes without motion, not invented motion."""
    truth = make_log(tmp_path / "toy.mcap", frames=3, odometry=False, imu=False)
    rows = ingest(tmp_path, truth).rows(MOTION)
    assert [(row["source"], row["dx_m"]) for row in rows] == [("start", None), ("none", None), ("none", None)]


def test_without_truth_there_is_no_truth_table(tmp_path: Path) -> None:
    """A log of a real robot has no ground truth, and that is fine."""
    truth = make_log(tmp_path / "toy.mcap", frames=2, truth=False)
    assert "truth" not in ingest(tmp_path, truth).files


def test_keyframes_by_time(tmp_path: Path) -> None:
    """Ten pictures a second give one keyframe a period."""
    truth = make_log(tmp_path / "toy.mcap", frames=12, rate_hz=10.0)
    stamps = [r["stamp_nanos"] for r in ingest(tmp_path, truth, IngestConfig(period_s=0.5)).rows(FRAMES)]
    assert np.allclose(np.diff(stamps) / 1e9, 0.5, atol=0.02)


def test_keyframes_by_motion(tmp_path: Path) -> None:
    """Keyframes by motion are at least the distance or the turn apart, and fewer than the pictures."""
    truth = make_log(tmp_path / "toy.mcap", frames=20, rate_hz=5.0)
    config = IngestConfig(keyframes="motion", min_distance_m=0.4, min_turn_rad=0.5)
    rows = ingest(tmp_path, truth, config).rows(MOTION)
    assert 1 < len(rows) < 20
    for row in rows[1:]:
        assert math.hypot(row["dx_m"], row["dy_m"]) >= 0.39 or abs(row["dheading_rad"]) >= 0.49


def test_topic_without_calibration_is_refused_with_a_hint(tmp_path: Path) -> None:
    """A log without what is needed says what it has and what to type."""
    truth = make_log(tmp_path / "toy.mcap", frames=2)
    outcome = try_stage(tmp_path, INGEST, IngestConfig(topics={"colour": "/nowhere"}), sources=[truth.path])
    assert outcome.failure is not None
    assert "/nowhere" in outcome.failure.message
    assert "/camera/color/camera_info" in outcome.failure.details
    assert "--topic colour=" in outcome.failure.hint


def test_nothing_within_tolerance_is_refused(tmp_path: Path) -> None:
    """Colour and depth that never meet give an error with numbers, not an empty map."""
    truth = make_log(tmp_path / "toy.mcap", frames=3)
    late = with_late_depth(truth.path, tmp_path / "late.mcap", 100_000_000)
    outcome = try_stage(tmp_path / "strict", INGEST, IngestConfig(), sources=[late])
    assert outcome.failure is not None
    assert "pair_tolerance_s" in outcome.failure.hint
    assert "colour_unpaired 3" in outcome.failure.details
    patient = run_stage(tmp_path / "patient", INGEST, IngestConfig(pair_tolerance_s=0.15), sources=[late])
    assert [row["depth_offset_nanos"] for row in patient.rows(FRAMES)] == [100_000_000] * 3


def with_late_depth(source: Path, target: Path, delay_nanos: int) -> Path:
    """The same log with depth images stamped later."""

    def delay(topic: str, message: Message, log_time: int) -> tuple[Message, int]:
        if "depth/image" in topic and isinstance(message, CompressedImage):
            message = replace(message, stamp_nanos=message.stamp_nanos + delay_nanos)
        return message, log_time

    return rewritten(source, target, delay)


def rewritten(source: Path, target: Path, change: Callable[[str, Message, int], tuple[Message, int] | None]) -> Path:
    """The same log with every message, and when it was logged, changed or left out."""
    with Ros2LogWriter(target) as writer:
        for raw in LogReader([source]).messages():
            changed = change(raw.channel.topic, decoder_for(raw.channel)(raw.data), raw.log_time)
            if changed is not None:
                writer.write(raw.channel.topic, *changed)
    return target


def test_static_transforms_logged_late_still_count(tmp_path: Path) -> None:
    """A recorder that writes tf_static after some seconds has the same rig from the first keyframe on."""
    truth = make_log(tmp_path / "toy.mcap", frames=5, depth_camera_offset=(0.0, 0.03, 0.0))
    late = rewritten(
        truth.path, tmp_path / "late.mcap", lambda topic, m, t: (m, t + 3_500_000_000 if topic == "/tf_static" else t)
    )
    there = ingest(tmp_path / "in_time", truth).rows(FRAMES)
    found = run_stage(tmp_path / "late", INGEST, IngestConfig(), sources=[late]).rows(FRAMES)
    assert [row["robot_from_camera"] for row in found] == [row["robot_from_camera"] for row in there]
    assert [row["depth"] for row in found] == [row["depth"] for row in there]


def test_odometry_that_cannot_be_used_is_told(tmp_path: Path) -> None:
    """Quaternions of zeros are no poses: the IMU speaks instead, and a warning says why."""
    truth = make_log(tmp_path / "toy.mcap", frames=3)

    def spoil(_topic: str, message: Message, log_time: int) -> tuple[Message, int]:
        return (replace(message, orientation=(0.0,) * 4) if isinstance(message, Odometry) else message), log_time

    done = run_stage(tmp_path, INGEST, IngestConfig(), sources=[rewritten(truth.path, tmp_path / "zero.mcap", spoil)])
    assert [row["source"] for row in done.rows(MOTION)] == ["start", "imu", "imu"]
    assert any("messages of `/odom` cannot be used" in warning for warning in done.manifest["warnings"])


def test_what_a_map_lacks_is_told(tmp_path: Path) -> None:
    """No levelling and no motion are said in so many words, not left for the map to show."""
    truth = make_log(tmp_path / "toy.mcap", frames=3, tf=False, imu=False, odometry=False)
    warnings = " / ".join(ingest(tmp_path, truth).manifest["warnings"])
    assert "3 of 3 keyframes are not levelled" in warnings
    assert "no motion for 2 of 3 keyframes" in warnings


def test_truth_of_another_frame(tmp_path: Path) -> None:
    """`truth_frame` says whose pose the truth topic tells; the robot's follows from tf."""
    truth = make_log(tmp_path / "toy.mcap", frames=2, noise=False)
    plain = ingest(tmp_path / "a", truth).rows(TRUTH)
    moved = ingest(tmp_path / "b", truth, IngestConfig(truth_frame="camera_link")).rows(TRUTH)
    link_from_base = np.linalg.inv(truth.base_from_camera @ np.linalg.inv(FLU_FROM_OPTICAL))
    for one, other in zip(plain, moved, strict=True):
        away = SE2(one["x_m"], one["y_m"], one["heading_rad"]).between(SE2(other["x_m"], other["y_m"], 0.0))
        assert (away.x_m, away.y_m, other["z_m"] - one["z_m"]) == pytest.approx(link_from_base[:3, 3], abs=1e-6)


def test_hours_without_a_picture_take_no_memory(tmp_path: Path) -> None:
    """A camera that died leaves the IMU running: what it says is not kept for ever."""
    truth = make_log(tmp_path / "toy.mcap", frames=2)
    last = truth.stamps_nanos[-1] + 1_000_000_000
    long = tmp_path / "long.mcap"
    with Ros2LogWriter(long) as writer:
        for raw in LogReader([truth.path]).messages():
            writer.write(raw.channel.topic, decoder_for(raw.channel)(raw.data), raw.log_time)
        for i in range(12_000):
            stamp = last + i * 10_000_000
            writer.write("/imu/data_raw", Imu(stamp, "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), None), stamp)
    reader = LogReader([long])
    walk = KeyframeWalk(reader, choose_roles(peek(reader), {}), IngestConfig(), {})
    assert len(list(walk.keyframes())) == 2
    assert len(walk._imu._samples) < 4_000


def test_orientation_of_a_jpeg_does_not_turn_it(tmp_path: Path) -> None:
    """EXIF may ask to turn a picture; depth and intrinsics know nothing of that, so its pixels stay where they are."""
    truth = make_log(tmp_path / "toy.mcap", frames=1)
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif

    def turn(_topic: str, message: Message, log_time: int) -> tuple[Message, int]:
        if isinstance(message, CompressedImage) and message.data[:2] == b"\xff\xd8":
            message = replace(message, data=message.data[:2] + segment + message.data[2:])
        return message, log_time

    done = run_stage(tmp_path, INGEST, IngestConfig(), sources=[rewritten(truth.path, tmp_path / "turned.mcap", turn)])
    plain = decode_colour(ingest(tmp_path / "plain", truth).rows(FRAMES)[0]["colour"])
    assert (decode_colour(done.rows(FRAMES)[0]["colour"]) == plain).all()


def test_resumed_ingest_gives_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped between shards and run again: same tables, and no published keyframe is decoded twice."""
    truth = make_log(tmp_path / "toy.mcap", frames=7, depth_camera_offset=(0.0, 0.03, 0.0))
    config = IngestConfig(shard_frames=2)
    whole = ingest(tmp_path / "whole", truth, config)
    stop_after_shards(monkeypatch, 2)
    outcome = try_stage(tmp_path / "stopped", INGEST, config, sources=[truth.path])
    assert outcome.failure is not None
    monkeypatch.undo()
    decoded = count_pictures(monkeypatch)
    resumed = ingest(tmp_path / "stopped", truth, config)
    assert resumed.outcome.resumed == 2
    assert len(decoded) == 3
    assert resumed.digests == whole.digests
    assert resumed.manifest == whole.manifest


def stop_after_shards(monkeypatch: pytest.MonkeyPatch, shards: int) -> None:
    """Let the stage die when it opens the shard after so many."""
    from semslam.pipeline.context import Context

    real = Context.shard

    def dying(self: StageContext, index: int) -> object:
        if index >= shards:
            raise RuntimeError("stopped by the test")
        return real(self, index)  # type: ignore[arg-type]

    monkeypatch.setattr(Context, "shard", dying)


def count_pictures(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Record every decoding of a pair."""
    decoded: list[int] = []
    real = KeyframeWalk._picture

    def counting(self: KeyframeWalk, colour: object, depth: object) -> object:
        decoded.append(1)
        return real(self, colour, depth)  # type: ignore[arg-type]

    monkeypatch.setattr(KeyframeWalk, "_picture", counting)
    return decoded


def test_a_damaged_picture_costs_one_keyframe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture that does not decode is skipped, counted and named; the others stay."""
    truth = make_log(tmp_path / "toy.mcap", frames=4)
    from semslam.errors import SemslamError
    from semslam.stages import keyframes

    calls: list[int] = []
    real = keyframes.decode_colour

    def failing(message: object) -> object:
        calls.append(1)
        if len(calls) == 2:
            raise SemslamError("JPEG is cut short")
        return real(message)  # type: ignore[arg-type]

    monkeypatch.setattr(keyframes, "decode_colour", failing)
    done = ingest(tmp_path, truth)
    assert [row["stamp_nanos"] for row in done.rows(FRAMES)] == [truth.stamps_nanos[i] for i in (0, 2, 3)]
    assert done.manifest["counters"]["pairs_damaged"] == 1
    assert any("cut short" in warning for warning in done.manifest["warnings"])


def test_cut_log_keeps_what_was_written(tmp_path: Path) -> None:
    """A recorder that lost power: the chunks before are used, and the loss is told."""
    truth = make_log(tmp_path / "toy.mcap", frames=6, size=(320, 240), compressed=False)
    data = truth.path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: int(len(data) * 0.7)])
    done = run_stage(tmp_path, INGEST, IngestConfig(), sources=[cut])
    frames = len(done.rows(FRAMES))
    assert 1 <= frames < 6
    assert done.manifest["warnings"]
    assert LogReader([cut]).channels()


def test_writer_protocol_is_what_the_context_gives() -> None:
    """The shard of the pipeline is what stages are promised."""
    from semslam.pipeline.context import Shard

    promised = {name for name in vars(ShardWriter) if not name.startswith("_")}
    assert promised <= set(vars(Shard))
