"""The demo's log and its detector, as they are shipped."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.logs.decode import decoder_for
from semslam.logs.messages import CompressedImage
from semslam.logs.reader import LogReader
from semslam.logs.roles import choose_roles, peek
from semslam.models.detectors import Detector
from semslam.pipeline import demo
from semslam.sim.home import CLASSES

CLEAR_PIXELS, MIN_SCORE, MIN_OVERLAP = 1500, 0.3, 0.5


@dataclass(frozen=True)
class Shot:
    """One keyframe of the demo: picture, and the boxes of its objects by class with their visible pixels."""

    rgb: NDArray[np.uint8]
    truth: list[tuple[int, NDArray[np.float32], int]]


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    """The keyframes with their truth, read from the log's own topics."""
    topics = ("/camera/color/image_raw/compressed", "/ground_truth/instances", "/ground_truth/classes")
    pictures = {topic: list(_pictures(topic)) for topic in topics}
    return [
        Shot(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), _boxes(instances, classes))
        for bgr, instances, classes in zip(*(pictures[topic] for topic in topics), strict=True)
    ]


def test_the_log_is_small_and_its_card_tells_the_truth() -> None:
    """At most 6 MB; the card holds the digest of the file."""
    log = demo.demo_log()
    assert log.stat().st_size <= 6_000_000
    assert hashlib.sha256(log.read_bytes()).hexdigest() in log.with_suffix(".md").read_text(encoding="utf-8")


def test_every_topic_of_the_demo_finds_its_role() -> None:
    """Nothing needs naming: colour, depth, both calibrations, IMU, wheels and truth are guessed right."""
    roles = choose_roles(peek(LogReader([demo.demo_log()])), {})
    assert {role: seen.channel.topic for role, seen in roles.topics.items()} == {
        "colour": "/camera/color/image_raw/compressed",
        "depth": "/camera/depth/image_raw/compressedDepth",
        "colour_info": "/camera/color/camera_info",
        "depth_info": "/camera/depth/camera_info",
        "imu": "/imu/data_raw",
        "odometry": "/odom",
        "truth": "/ground_truth/pose",
    }


def test_thirty_keyframes_with_something_to_see(shots: list[Shot]) -> None:
    """Every one shows an object of more than a hundred pixels, most show five or more."""
    seen = [sum(pixels > 100 for _, _, pixels in shot.truth) for shot in shots]
    assert len(seen) == 30
    assert min(seen) >= 1
    assert np.median(seen) >= 5


def test_a_package_without_its_files_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The message names the file and what to type."""
    monkeypatch.setattr(demo, "files", lambda _: tmp_path)
    for call, name in ((demo.demo_settings, "demo_detector.onnx"), (demo.demo_log, "demo_home.mcap")):
        with pytest.raises(SemslamError, match=name) as caught:
            call()
        assert "pip install" in caught.value.hint


def test_the_detector_is_small_and_its_card_tells_the_truth() -> None:
    """A megabyte at most; the card's digest is that of the file; the simulator's class names are inside."""
    path = Path(demo.demo_settings()["extract.detector"])
    content = path.read_bytes()
    assert len(content) < 1_000_000
    assert hashlib.sha256(content).hexdigest() in path.with_suffix(".md").read_text(encoding="utf-8")
    names = onnxruntime.InferenceSession(content).get_modelmeta().custom_metadata_map["names"]
    assert ast.literal_eval(names) == dict(enumerate(CLASSES))


def test_the_detector_finds_the_furniture_of_the_demo(shots: list[Shot]) -> None:
    """A home that it was not trained on: of the objects in plain view most are found, and most finds are objects."""
    detector = Detector.open(Path(demo.demo_settings()["extract.detector"]))
    hits = wanted = right = given = 0
    for shot in shots:
        answers = detector(shot.rgb, MIN_SCORE, 0.5)
        found = list(zip(answers.class_ids, answers.boxes, strict=True))
        clear = [(label, box) for label, box, pixels in shot.truth if pixels >= CLEAR_PIXELS]
        wanted, given = wanted + len(clear), given + len(found)
        hits += sum(any(_matches(answer, item) for answer in found) for item in clear)
        right += sum(any(_matches(answer, (label, box)) for label, box, _ in shot.truth) for answer in found)
    assert hits / wanted > RECALL
    assert right / given > PRECISION


RECALL, PRECISION = 0.5, 0.6
"""Well below what it reaches (its card), well above what a broken one does."""


def _pictures(topic: str) -> Iterator[NDArray[np.generic]]:
    for raw in LogReader([demo.demo_log()]).messages(lambda channel: channel.topic == topic):
        message = decoder_for(raw.channel)(raw.data)
        assert isinstance(message, CompressedImage)
        yield cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)


def _boxes(instances: NDArray[np.generic], classes: NDArray[np.generic]) -> list[tuple[int, NDArray[np.float32], int]]:
    """Class, box and pixels of every object in the truth images."""
    found = []
    for instance in np.unique(instances[instances > 0]):
        rows, columns = np.nonzero(instances == instance)
        box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float32)
        found.append((int(classes[rows[0], columns[0]]) - 3, box, len(rows)))
    return found


def _matches(answer: tuple[int, NDArray[np.float32]], truth: tuple[int, NDArray[np.float32]]) -> bool:
    """Same class, and boxes that overlap by half."""
    return answer[0] == truth[0] and _overlap(answer[1], truth[1]) >= MIN_OVERLAP


def _overlap(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Intersection over union."""
    sides = np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2])
    shared = float(np.prod(np.maximum(sides, 0)))
    return shared / float(np.prod(first[2:] - first[:2]) + np.prod(second[2:] - second[:2]) - shared)
