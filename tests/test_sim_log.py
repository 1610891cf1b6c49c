"""Logs of simulated homes: ordinary logs for every reader, with the truth on topics of their own."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from semslam.errors import SemslamError
from semslam.geometry.frames import FLU_FROM_OPTICAL, SE2, matrix_from_pose
from semslam.labels import FIRST_OBJECT, OBSTACLE, class_list
from semslam.logs.decode import decoder_for
from semslam.logs.images import decode_colour, decode_depth
from semslam.logs.messages import CompressedImage, Imu, Odometry, Pose, Transforms
from semslam.logs.reader import LogReader
from semslam.sim.log import LogOptions, LogReceipt, record_log, start_nanos
from semslam.stages.catalogue import STAGES
from semslam.stages.settings import IngestConfig
from semslam.tables.spec import FRAMES, MOTION, TOPICS, TRUTH
from tests.sim_box import BoxDrive, BoxEye, BoxRobot, BoxSight, box_drive, box_home
from tests.stage_room import Done, run_stage

SMALL = LogOptions(size=(160, 120))
EXACT = replace(SMALL, noise="none", camera_noise=False)
COLOUR, DEPTH = "/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth"
ORDINARY = {
    *(COLOUR, DEPTH, "/camera/color/camera_info", "/camera/depth/camera_info"),
    *("/imu/data_raw", "/odom", "/tf", "/tf_static"),
}
TRUE = {f"/ground_truth/{name}" for name in ("pose", "instances", "classes", "objects", "outline")}


def record(path: Path, drive: BoxDrive | None = None, *, seed: int = 1, **options: Any) -> LogReceipt:
    """Record the home of boxes."""
    home, chosen = box_home(walker=options.pop("walker", False)), replace(SMALL, **options)
    observer = options.pop("observer", None)
    return record_log(
        path,
        home,
        BoxRobot(),  # type: ignore[arg-type]
        drive or box_drive(),  # type: ignore[arg-type]
        seed=seed,
        options=chosen,
        eye=BoxEye(home, chosen.camera),  # type: ignore[arg-type]
        observer=observer,
    )


def official(path: Path) -> dict[str, list[Any]]:
    """Messages by topic as the official MCAP and ROS 2 packages read them."""
    found = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found[channel.topic].append(message)
    return found


def ours(path: Path, *topics: str) -> dict[str, list[Any]]:
    """Messages by topic as semslam reads them."""
    found: dict[str, list[Any]] = defaultdict(list)
    reader = LogReader([path])
    for raw in reader.messages(lambda channel: channel.topic in topics):
        found[raw.channel.topic].append(decoder_for(raw.channel)(raw.data))
    assert reader.losses.state == "ok"
    return found


def stamp_of(message: Any) -> int:
    """Header stamp, nanoseconds."""
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def ids(message: Any) -> Any:
    """The picture of an image of ids."""
    return cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> LogReceipt:
    """Five keyframes without any noise."""
    return record(tmp_path_factory.mktemp("exact") / "log.mcap", box_drive(5), noise="none", camera_noise=False)


@pytest.fixture(scope="module")
def ingested(exact: LogReceipt, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """What ingest makes of it at default settings."""
    return run_stage(tmp_path_factory.mktemp("out"), STAGES[0], IngestConfig(), sources=[exact.path])


def test_every_topic_is_there_at_its_rate(exact: LogReceipt) -> None:
    """The official decoder reads every message of every type; the receipt has counted them."""
    found = official(exact.path)
    span = 0.4123 + 4 * 1.1 + 0.3
    assert {topic: len(messages) for topic, messages in found.items()} == exact.messages
    assert set(found) == ORDINARY | TRUE
    assert len(found["/imu/data_raw"]) == pytest.approx(200 * span, abs=2)
    for topic in ("/odom", "/tf", "/ground_truth/pose"):
        assert len(found[topic]) == pytest.approx(50 * span, abs=2)
    for topic in (COLOUR, DEPTH, "/ground_truth/instances", "/ground_truth/classes"):
        assert tuple(map(stamp_of, found[topic])) == exact.stamps_nanos
    assert exact.size_bytes == exact.path.stat().st_size
    limit = 100 * 160 * 120 / (640 * 480)
    shown = [np.bincount(ids(picture).ravel(), minlength=6)[1:] for picture in found["/ground_truth/instances"]]
    assert exact.visible_objects == tuple(int((pixels > limit).sum()) for pixels in shown)
    assert min(exact.visible_objects) > 0


def test_log_time_rises_and_is_later_than_the_stamps(exact: LogReceipt) -> None:
    """Messages arrive in order, some milliseconds after they were stamped, and never quite as late as the last one."""
    times, late = [], defaultdict(list)
    with exact.path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, raw, message in reader.iter_decoded_messages(log_time_order=False):
            times.append(raw.log_time)
            if hasattr(message, "header"):
                late[channel.topic].append((raw.log_time - stamp_of(message)) / 1e6)
    assert times == sorted(times)
    assert 0 < min(map(min, late.values())) < max(map(max, late.values())) < 90
    assert 25 < np.mean(late[COLOUR]) < 50
    assert np.mean(late["/imu/data_raw"]) < 3
    assert len(set(late["/odom"])) > 100


def test_logs_begin_on_different_days(tmp_path: Path) -> None:
    """The date follows from the seed, in some daytime of 2025 or 2026."""
    homes = [replace(box_home(), seed=seed) for seed in range(50)]
    starts = [start_nanos(home, home.seed) for home in homes]
    assert len({start // (86400 * 10**9) for start in starts}) > 35
    assert all(1_735_689_600 < start / 1e9 < 1_777_600_000 for start in starts)
    assert all(8 <= start / 1e9 % 86400 / 3600 <= 18 for start in starts)
    days = [
        [start_nanos(replace(home, day=day), drive) // (86400 * 10**9) for drive in range(3)]
        for home in homes[:9]
        for day in (0, 1)
    ]
    assert all(len(set(day)) == 1 for day in days), "drives of one day share its date"
    assert all(1 <= after[0] - before[0] <= 14 for before, after in zip(days[::2], days[1::2], strict=True))
    receipt = record(tmp_path / "log.mcap", box_drive(1), seed=7)
    assert receipt.stamps_nanos == (start_nanos(box_home(), 7) + 412_300_000,)


def test_nothing_outside_the_truth_says_simulated(exact: LogReceipt) -> None:
    """Names of topics, types, frames and the header of the file are those of any robot."""
    with exact.path.open("rb") as stream:
        reader = make_reader(stream)
        header, summary = reader.get_header(), reader.get_summary()
    assert summary is not None
    words = [header.profile, header.library, *(channel.topic for channel in summary.channels.values())]
    words += [schema.name + schema.data.decode() for schema in summary.schemas.values()]
    words += [str(getattr(message, "header", "")) for messages in official(exact.path).values() for message in messages]
    text = " ".join(words).lower()
    assert not [
        word for word in ("sim", "synth", "toy", "mujoco", "virtual", "fake") if word in text.replace("semslam", "")
    ]


def test_the_same_arguments_give_the_same_bytes(tmp_path: Path) -> None:
    """Recorded twice, equal, with noise; another seed, another log."""
    paths = [tmp_path / f"{number}.mcap" for number in range(3)]
    for path, seed in zip(paths, (1, 1, 2), strict=True):
        record(path, seed=seed)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert paths[0].read_bytes() != paths[2].read_bytes()


def test_what_is_left_out_changes_nothing_else(tmp_path: Path) -> None:
    """Without the truth, or with other noise of the wheels, every picture is the same, bit for bit."""
    full, bare, calm = (tmp_path / f"{name}.mcap" for name in ("full", "bare", "calm"))
    record(full)
    receipt = record(bare, truth=False)
    record(calm, noise="none")
    assert set(receipt.messages) == ORDINARY
    pictures = [ours(path, COLOUR, DEPTH) for path in (full, bare, calm)]
    assert pictures[0] == pictures[1] == pictures[2]
    assert ours(full, "/odom") == ours(bare, "/odom") != ours(calm, "/odom")


def test_pictures_without_noise_are_what_the_eye_saw(exact: LogReceipt) -> None:
    """Depth to half a millimetre, colour as far as JPEG keeps it, ids exactly."""
    drive, home = box_drive(5), box_home()
    sight = BoxEye(home, EXACT.camera).look(drive.world_from_base(drive.keyframes_s[2]) @ BoxRobot().base_from_camera)
    found = ours(exact.path, COLOUR, DEPTH)
    assert np.nan_to_num(decode_depth(found[DEPTH][2])) == pytest.approx(sight.depth_m, abs=0.00051)
    assert np.abs(decode_colour(found[COLOUR][2]).astype(int) - sight.rgb).mean() < 4
    truth = official(exact.path)
    assert np.array_equal(ids(truth["/ground_truth/instances"][2]), sight.instances)
    assert np.array_equal(ids(truth["/ground_truth/classes"][2]), sight.classes)


def test_instances_and_classes_fit_the_list_of_objects(exact: LogReceipt) -> None:
    """Every id of a picture is in the list, and its pixels have the class that the list names."""
    found, classes = official(exact.path), class_list(box_home().classes)
    objects = {item.id: item for item in found["/ground_truth/objects"][0].objects}
    assert [(o.id, o.class_name, o.style) for o in objects.values()] == [
        (item.instance, item.class_name, "plain") for item in box_home().objects
    ]
    seen: set[int] = set()
    for picture, labels in zip(found["/ground_truth/instances"], found["/ground_truth/classes"], strict=True):
        instances, class_ids = ids(picture), ids(labels)
        for number in np.unique(instances[instances > 0]):
            (class_id,) = np.unique(class_ids[instances == number])
            assert classes[class_id] == objects[int(number)].class_name
            seen.add(int(number))
        assert class_ids[instances == 0].max() < FIRST_OBJECT
    assert len(seen) >= 3


def test_pixels_of_an_object_lie_on_its_footprint(exact: LogReceipt) -> None:
    """Carried into the world by depth, tf and true pose, they are within 5 cm of the outline in the list."""
    found, camera = official(exact.path), EXACT.camera
    depth = [decode_depth(message) for message in ours(exact.path, DEPTH)[DEPTH]]
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    checked = 0
    for index, picture in enumerate(found["/ground_truth/instances"]):
        pose = box_drive(5).world_from_base(box_drive(5).keyframes_s[index]) @ BoxRobot().base_from_camera
        world = rays * depth[index][..., None] @ pose[:3, :3].T + pose[:3, 3]
        for item in found["/ground_truth/objects"][0].objects:
            points = world[ids(picture) == item.id]
            outline = np.array([(p.x, p.y) for p in item.footprint.points], np.float32)
            for x, y, z in points[::7]:
                assert cv2.pointPolygonTest(outline, (float(x), float(y)), True) > -0.05
                assert -0.02 < z < item.height + 0.02
                checked += 1
    assert checked > 200


def test_who_walks_about_is_no_object_of_the_list(tmp_path: Path) -> None:
    """The person is in the pictures under an id of its own, as an obstacle, and is not counted among what is seen."""
    receipt = record(tmp_path / "log.mcap", walker=True, noise="none", camera_noise=False)
    found = official(receipt.path)
    pictures = [
        (ids(a), ids(b)) for a, b in zip(found["/ground_truth/instances"], found["/ground_truth/classes"], strict=True)
    ]
    assert any((instances == 9).any() for instances, _ in pictures)
    assert all((classes[instances == 9] == OBSTACLE).all() for instances, classes in pictures)
    assert 9 not in [item.id for item in found["/ground_truth/objects"][0].objects]


def test_outline_and_true_poses_are_in_the_frame_of_the_home(exact: LogReceipt) -> None:
    """The polygon is the room's, the poses are the drive's."""
    found = official(exact.path)
    (polygon,) = found["/ground_truth/outline"]
    assert [(p.x, p.y) for p in polygon.polygon.points] == [(-3, -2.5), (3, -2.5), (3, 2.5), (-3, 2.5)]
    drive, begin = box_drive(5), start_nanos(box_home(), 1)
    for message in ours(exact.path, "/ground_truth/pose")["/ground_truth/pose"][::20]:
        assert isinstance(message, Pose)
        expected = drive.world_from_base((message.stamp_nanos - begin) / 1e9)
        assert matrix_from_pose(message.position, message.orientation) == pytest.approx(expected, abs=1e-9)
        assert message.frame_id == polygon.header.frame_id == "world"


def test_transforms_lead_to_camera_and_imu(exact: LogReceipt) -> None:
    """base_link to camera_link to the optical frame, base_link to imu_link; odom to base_link follows the wheels."""
    found = ours(exact.path, "/tf_static", "/tf", "/odom")
    (message,) = found["/tf_static"]
    assert isinstance(message, Transforms)
    links = {(t.parent, t.child): matrix_from_pose(t.translation, t.orientation) for t in message.transforms}
    link = links["base_link", "camera_link"]
    assert links["camera_link", "camera_color_optical_frame"] == pytest.approx(FLU_FROM_OPTICAL)
    assert link @ FLU_FROM_OPTICAL == pytest.approx(BoxRobot().base_from_camera)
    assert links["base_link", "imu_link"] == pytest.approx(BoxRobot().base_from_imu)
    for moving, wheels in zip(found["/tf"], found["/odom"], strict=True):
        assert isinstance(wheels, Odometry)
        (t,) = moving.transforms
        assert (t.stamp_nanos, t.parent, t.child) == (wheels.stamp_nanos, "odom", "base_link")
        assert (t.translation, t.orientation) == (wheels.position, wheels.orientation)


def test_the_heading_of_the_wheels_is_the_integral_of_the_gyro(tmp_path: Path) -> None:
    """With standard noise, both come to the same angle: no topic knows the heading better than the other."""
    receipt = record(tmp_path / "log.mcap", box_drive(8))
    found = ours(receipt.path, "/imu/data_raw", "/odom")
    turned, last = 0.0, None
    at: dict[int, float] = {}
    for sample in found["/imu/data_raw"]:
        assert isinstance(sample, Imu)
        if last is not None:
            turned += (sample.gyro[2] + last.gyro[2]) / 2 * (sample.stamp_nanos - last.stamp_nanos) / 1e9
        at[sample.stamp_nanos], last = turned, sample
    headings = [2 * math.atan2(m.orientation[2], m.orientation[3]) for m in found["/odom"]]
    stamps = [m.stamp_nanos for m in found["/odom"]]
    assert headings == pytest.approx([at[stamp] for stamp in stamps], abs=0.002)
    assert abs(headings[-1] - box_drive(8).headings()[-1] - 0.3) > 0.01


# -------------------------------------------------------------------------------------------------- the pipeline


def test_ingest_takes_every_pair_as_a_keyframe(ingested: Done, exact: LogReceipt) -> None:
    """At default settings, with colour, depth and truth from the right topics and nothing to warn about."""
    rows = ingested.rows(FRAMES)
    assert tuple(row["stamp_nanos"] for row in rows) == exact.stamps_nanos
    assert {row["depth_offset_nanos"] for row in rows} == {0}
    assert rows[0]["fx"] == pytest.approx(80.0)
    assert rows[0]["camera_height_m"] == pytest.approx(0.45, abs=0.01)
    roles = {row["topic"]: row["role"] for row in ingested.rows(TOPICS)}
    assert {topic: role for topic, role in roles.items() if role} == {
        COLOUR: "colour",
        DEPTH: "depth",
        "/camera/color/camera_info": "colour_info",
        "/camera/depth/camera_info": "depth_info",
        "/imu/data_raw": "imu",
        "/odom": "odometry",
        "/ground_truth/pose": "truth",
        "/tf": "tf",
        "/tf_static": "tf",
    }
    assert not any(row["skipped"] for row in ingested.rows(TOPICS))
    assert not json.dumps(ingested.manifest.get("warnings", [])).strip("[]")


def test_ingest_finds_truth_and_motion(ingested: Done) -> None:
    """Truth at the keyframes is the drive's; without noise, motion is what leads from one true pose to the next."""
    drive = box_drive(5)
    poses = [drive._pose(float(time)) for time in drive.keyframes_s]
    for row, (x, y, heading) in zip(ingested.rows(TRUTH), poses, strict=True):
        assert (row["x_m"], row["y_m"], row["z_m"]) == pytest.approx((x, y, 0.0), abs=1e-4)
        assert row["heading_rad"] == pytest.approx(heading, abs=1e-4)
    motion = ingested.rows(MOTION)
    assert [row["source"] for row in motion] == ["start", *["odometry"] * 4]
    for row, before, after in zip(motion[1:], poses, poses[1:], strict=False):
        step = SE2(*before).between(SE2(*after))
        assert (row["dx_m"], row["dy_m"]) == pytest.approx((step.x_m, step.y_m), abs=1e-3)
        assert row["dheading_rad"] == pytest.approx(step.heading_rad, abs=1e-3)


@pytest.mark.parametrize("jitter", [0.0, 0.25])
def test_intervals_of_a_second_and_more_keep_every_pair(tmp_path: Path, jitter: float) -> None:
    """The shortest interval that a drive at 1 Hz has is one second, and ingest skips none by default."""
    gaps = 1.0 + jitter * np.random.default_rng(3).random(5)
    drive = BoxDrive(0.4 + np.concatenate([[0.0], np.cumsum(gaps)]))
    receipt = record(tmp_path / "log.mcap", drive)
    done = run_stage(tmp_path / "out", STAGES[0], IngestConfig(), sources=[receipt.path])
    assert len(done.rows(FRAMES)) == 6


# ------------------------------------------------------------------------------------------------------ failures


def test_a_failure_midway_leaves_no_log(tmp_path: Path) -> None:
    """Neither a half-written file nor a hidden one; an older log of that name stays as it was."""
    path = tmp_path / "log.mcap"
    path.write_bytes(b"an older log")

    def stumble(index: int, *_: Any) -> None:
        if index == 1:
            raise RuntimeError("the lights went out")

    home = box_home()
    with pytest.raises(RuntimeError, match="lights"):
        record_log(
            path,
            home,
            BoxRobot(),  # type: ignore[arg-type]
            box_drive(),  # type: ignore[arg-type]
            seed=1,
            options=SMALL,
            eye=BoxEye(home, SMALL.camera),  # type: ignore[arg-type]
            observer=stumble,
        )
    assert [entry.name for entry in tmp_path.iterdir()] == ["log.mcap"]
    assert path.read_bytes() == b"an older log"


def test_the_observer_hears_of_every_keyframe_once(tmp_path: Path) -> None:
    """In order, with stamp, view and pose, and nobody looks twice."""
    home, drive, heard = box_home(), box_drive(4), []
    eye = BoxEye(home, SMALL.camera)

    def hear(index: int, stamp: int, sight: BoxSight, world_from_camera: Any) -> None:
        assert sight.depth_m.shape == (120, 160)
        assert world_from_camera == pytest.approx(
            drive.world_from_base(drive.keyframes_s[index]) @ BoxRobot().base_from_camera
        )
        heard.append((index, stamp))

    robot: Any = BoxRobot()
    looker: Any = eye
    watch: Any = hear
    receipt = record_log(
        tmp_path / "log.mcap",
        home,
        robot,
        drive,
        seed=1,
        options=SMALL,
        eye=looker,
        observer=watch,  # type: ignore[arg-type]
    )
    assert heard == list(enumerate(receipt.stamps_nanos))
    assert eye.looks == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": "double"}, "`double` is no noise .*"),
        ({"depth": "jpeg"}, "`jpeg` is no depth .*"),
        ({"size": (0, 480)}, "0 x 480"),
        ({"jpeg_quality": 0}, "quality 0"),
    ],
)
def test_impossible_options_are_refused(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    """One clear sentence, and nothing is written."""
    home = box_home()
    with pytest.raises(SemslamError, match=message) as error:
        record_log(
            tmp_path / "log.mcap",
            home,
            BoxRobot(),  # type: ignore[arg-type]
            box_drive(),  # type: ignore[arg-type]
            seed=1,
            options=replace(SMALL, **options),
            eye=BoxEye(home, SMALL.camera),  # type: ignore[arg-type]
        )
    assert error.value.hint
    assert list(tmp_path.iterdir()) == []


def test_depth_as_rvl_is_the_same_depth(tmp_path: Path) -> None:
    """Both codings, the same millimetres."""
    depth = {}
    for kind in ("png", "rvl"):
        (message, *_) = ours(record(tmp_path / f"{kind}.mcap", depth=kind).path, DEPTH)[DEPTH]
        assert isinstance(message, CompressedImage)
        assert kind in message.format
        depth[kind] = decode_depth(message)
    assert np.array_equal(depth["png"], depth["rvl"])
