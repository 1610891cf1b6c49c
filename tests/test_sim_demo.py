"""The demo's log and its detector, as they are shipped."""

from __future__ import annotations

import ast
import hashlib
import math
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.logs.reader import LogReader
from semslam.logs.roles import choose_roles, peek
from semslam.sim import demo
from semslam.sim.toy.render import Renderer, VisibleBox, pinhole, visible_boxes
from semslam.sim.toy.robot import base_pose, mount, optical, plan_path
from semslam.sim.toy.toyroom import CLASSES, make_room

UNSEEN_ROOM = 30_001
MIN_PIXELS, MIN_SHARE, MIN_SCORE, MIN_OVERLAP = 120, 0.25, 0.3, 0.5


@pytest.fixture(scope="module")
def detector() -> Path:
    """The ONNX file that the settings name."""
    return Path(demo.demo_settings()["extract.detector"])


def test_the_demo_log_is_reproducible_and_reports_progress(tmp_path: Path) -> None:
    """Two seconds of it: two pairs a second, the same bytes each time."""
    steps: list[tuple[int, int]] = []
    first = demo.record_demo(tmp_path / "a.mcap", keyframes=2, progress=lambda done, total: steps.append((done, total)))
    again = demo.record_demo(tmp_path / "b.mcap", keyframes=2)
    assert first == tmp_path / "a.mcap"
    assert first.read_bytes() == again.read_bytes()
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_every_topic_of_the_demo_finds_its_role(tmp_path: Path) -> None:
    """Nothing needs naming: colour, depth, both calibrations, IMU, wheels and truth are guessed right."""
    path = demo.record_demo(tmp_path / "demo.mcap", keyframes=1)
    roles = choose_roles(peek(LogReader([path])), {})
    assert {role: seen.channel.topic for role, seen in roles.topics.items()} == {
        "colour": "/camera/color/image_raw/compressed",
        "depth": "/camera/depth/image_raw/compressedDepth",
        "colour_info": "/camera/color/camera_info",
        "depth_info": "/camera/depth/camera_info",
        "imu": "/imu/data_raw",
        "odometry": "/odom",
        "truth": "/ground_truth/pose",
    }


def test_every_keyframe_of_the_demo_shows_several_objects() -> None:
    """Once a second, at least three objects; over the drive, every object of the room."""
    room = make_room(demo.DEMO_SEED)
    renderer, path = Renderer(room), plan_path(room, demo.DEMO_SEED)
    camera, base_from_camera = pinhole(80, 60, math.radians(90)), mount(0.1, 0, 0.55, pitch_rad=0.21) @ optical()
    views = [renderer.view(camera, base_pose(path, 0.2 + second) @ base_from_camera) for second in range(30)]
    shown = [{box.object_id for box in visible_boxes(view, min_pixels=8)} for view in views]
    assert min(len(ids) for ids in shown) >= 3
    assert set.union(*shown) == {item.object_id for item in room.objects}


def test_a_package_without_the_detector_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The message names the file and what to type."""
    monkeypatch.setattr(demo, "files", lambda _: tmp_path)
    with pytest.raises(SemslamError, match=r"demo_detector\.onnx") as caught:
        demo.demo_settings()
    assert "pip install" in caught.value.hint


def test_the_detector_is_small_and_its_card_tells_the_truth(detector: Path) -> None:
    """Half a megabyte at most; the card's digest is that of the file; class names are inside."""
    content = detector.read_bytes()
    assert len(content) < 520_000
    assert hashlib.sha256(content).hexdigest() in detector.with_suffix(".md").read_text(encoding="utf-8")
    names = onnxruntime.InferenceSession(content).get_modelmeta().custom_metadata_map["names"]
    assert ast.literal_eval(names) == dict(enumerate(CLASSES))


def test_the_detector_finds_the_furniture_of_an_unseen_room(detector: Path) -> None:
    """Through ONNX Runtime alone, on the demo's camera: most objects are found, and most finds are objects."""
    session = onnxruntime.InferenceSession(str(detector), providers=["CPUExecutionProvider"])
    room = make_room(UNSEEN_ROOM)
    renderer, path = Renderer(room), plan_path(room, UNSEEN_ROOM)
    camera, base_from_camera = pinhole(320, 240, math.radians(90)), mount(0.1, 0, 0.55, pitch_rad=0.21) @ optical()
    hits = found = wanted = given = 0
    for time_s in range(0, 24, 2):
        pose = base_pose(path, float(time_s)) @ base_from_camera
        view = renderer.view(camera, pose)
        images = view.rgb.astype(np.float32).transpose(2, 0, 1)[None] / 255
        answers = suppressed(session.run(None, {"images": images})[0][0])
        truth, whole = visible_boxes(view, min_pixels=20), renderer.silhouettes(camera, pose)
        clear = [b for b in truth if b.pixels >= max(MIN_PIXELS, MIN_SHARE * whole[b.object_id])]
        hits += sum(any(matches(answer, box) for answer in answers) for box in clear)
        found += sum(any(matches(answer, box) for box in truth) for answer in answers)
        wanted += len(clear)
        given += len(answers)
    assert hits / wanted > 0.75
    assert found / given > 0.75


def suppressed(output: NDArray[np.float32]) -> list[tuple[int, NDArray[np.float32]]]:
    """Class and box (left, top, right, bottom) of every answer that survives non-maximum suppression."""
    boxes = np.hstack([output[:2].T - output[2:4].T / 2, output[:2].T + output[2:4].T / 2])
    scores, labels = output[4:].max(0), output[4:].argmax(0)
    kept: list[tuple[int, NDArray[np.float32]]] = []
    for index in np.argsort(-scores):
        label, box = int(labels[index]), boxes[index]
        if scores[index] >= MIN_SCORE and all(label != other or overlap(box, rival) <= 0.5 for other, rival in kept):
            kept.append((label, box))
    return kept


def matches(answer: tuple[int, NDArray[np.float32]], truth: VisibleBox) -> bool:
    """Same class, and boxes that overlap by half."""
    box = np.array([truth.left, truth.top, truth.right, truth.bottom], np.float32)
    return answer[0] == truth.class_id and overlap(answer[1], box) >= MIN_OVERLAP


def overlap(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Intersection over union."""
    sides = np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2])
    shared = float(np.prod(np.maximum(sides, 0)))
    return shared / float(np.prod(first[2:] - first[:2]) + np.prod(second[2:] - second[:2]) - shared)
