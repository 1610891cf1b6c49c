"""Messages that only the simulator sends: outlines and objects, as every reader of ROS 2 logs finds them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from semslam.logs.cdr import ros2_type, serialise
from semslam.logs.images import decode_depth
from semslam.logs.messages import CompressedImage, FloorObject, FloorObjects, Polygon
from semslam.logs.reader import LogReader
from semslam.logs.writer import PNG_DEPTH_FORMAT, Ros2LogWriter, encode_png, encode_png_depth

STAMP = 1_700_000_000_123_456_789
TURN = (0.0, 0.0, 0.6, 0.8)
SQUARE = ((0.0, 0.0), (2.5, 0.0), (2.5, 1.5), (0.0, 1.5))
OUTLINE = Polygon(STAMP, "world", SQUARE)
OBJECTS = FloorObjects(
    STAMP,
    "world",
    (
        FloorObject(1, "chair", "swivel", (1.0, -2.0, 0.0), TURN, SQUARE[:3], 0.9),
        FloorObject(7, "tv", "flat", (1.0, 2.0, 0.5), TURN, SQUARE, 0.6),
    ),
)


def official(path: Path) -> dict[str, Any]:
    """The last message of each topic, as the official packages read it with nothing but the log's own schemas."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """One message of each type."""
    path = tmp_path / "log.mcap"
    with Ros2LogWriter(path) as writer:
        writer.write("/ground_truth/outline", OUTLINE, STAMP)
        writer.write("/ground_truth/objects", OBJECTS, STAMP + 1)
        writer.write("/empty", FloorObjects(STAMP, "world", ()), STAMP + 2)
    return path


def test_an_outline_is_a_polygon(log: Path) -> None:
    """geometry_msgs/PolygonStamped, at height 0, in single precision."""
    message = official(log)["/ground_truth/outline"]
    assert message.header.frame_id == "world"
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP
    assert [(p.x, p.y, p.z) for p in message.polygon.points] == [(x, y, 0.0) for x, y in SQUARE]


def test_objects_say_what_and_where_they_are(log: Path) -> None:
    """Every field comes back, of every object; an empty list is one."""
    found = official(log)
    assert list(found["/empty"].objects) == []
    message = found["/ground_truth/objects"]
    assert message.header.frame_id == "world"
    for one, sent in zip(message.objects, OBJECTS.objects, strict=True):
        assert (one.id, one.class_name, one.style, one.height) == (sent.id, sent.class_name, sent.style, sent.height_m)
        assert (one.pose.position.x, one.pose.position.y, one.pose.position.z) == sent.position
        turn = one.pose.orientation
        assert (turn.x, turn.y, turn.z, turn.w) == TURN
        assert [(p.x, p.y) for p in one.footprint.points] == list(sent.footprint)


def test_our_reader_passes_them_on(log: Path) -> None:
    """Types by name, nothing lost."""
    reader = LogReader([log])
    assert [(raw.channel.topic, raw.channel.schema_name) for raw in reader.messages()] == [
        ("/ground_truth/outline", "geometry_msgs/msg/PolygonStamped"),
        ("/ground_truth/objects", "semslam_msgs/msg/FloorObjects"),
        ("/empty", "semslam_msgs/msg/FloorObjects"),
    ]
    assert reader.losses.state == "ok"


def test_bytes_of_an_outline_are_cdr() -> None:
    """By hand: stamp, frame with its length and end, padding, three floats a point."""
    data = serialise(Polygon(5 * 10**9 + 6, "map", ((1.0, 2.0),)))
    by_hand = struct.pack("<iI", 5, 6) + struct.pack("<I", 4) + b"map\0" + struct.pack("<I3f", 1, 1.0, 2.0, 0.0)
    assert data == b"\x00\x01\x00\x00" + by_hand
    assert ros2_type(OUTLINE) == "geometry_msgs/msg/PolygonStamped"


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_ids_survive_as_png(kind: type) -> None:
    """8 or 16 bits, every value."""
    ids = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (48, 64)).astype(kind)
    decoded = cv2.imdecode(np.frombuffer(encode_png(ids), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    assert decoded.dtype == kind
    assert np.array_equal(decoded, ids)


def test_small_depth_is_the_same_depth() -> None:
    """The smaller coding holds the same millimetres, in fewer bytes where depth comes in steps."""
    steps = np.rint(1000 / np.rint(np.random.default_rng(0).normal(100, 2, (120, 160)))).astype(np.uint16) * 300
    small, plain = encode_png_depth(steps, small=True), encode_png_depth(steps)
    assert len(small) < 0.8 * len(plain)
    for data in (small, plain):
        depth_m = decode_depth(CompressedImage(STAMP, "camera", PNG_DEPTH_FORMAT, data))
        assert np.array_equal(np.rint(depth_m * 1000), steps)
