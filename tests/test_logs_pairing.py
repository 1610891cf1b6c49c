"""Colour and depth images find their nearest partner, in one pass."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from semslam.logs.messages import CompressedImage
from semslam.logs.pairing import PairBuffer, Stamped

MS = 1_000_000


def image(stamp_ms: int) -> Stamped:
    return Stamped(stamp_ms * MS, stamp_ms * MS, CompressedImage(stamp_ms * MS, "camera", "jpeg", b""))


def pairs(
    colour: Sequence[int], depth: Sequence[int], tolerance_ms: int = 20
) -> tuple[list[tuple[int, int]], PairBuffer]:
    """Pairs (in ms) of two streams that arrive interleaved by stamp."""
    buffer = PairBuffer(tolerance_ms * MS)
    events = sorted([(s, "colour") for s in colour] + [(s, "depth") for s in depth])
    found = [pair for stamp, role in events for pair in buffer.push(role, image(stamp))]
    found += buffer.finish()
    return [(c.stamp_nanos // MS, d.stamp_nanos // MS) for c, d in found], buffer


def test_nearest_depth_within_tolerance() -> None:
    """Each colour image gets the nearest depth image, and none beyond the tolerance."""
    found, buffer = pairs([0, 100, 200, 300], [3, 98, 107, 230])
    assert found == [(0, 3), (100, 98)]
    assert buffer.unpaired == 2


def test_depth_may_come_before_or_after() -> None:
    """A partner at exactly the tolerance still counts, on either side."""
    assert pairs([100], [80])[0] == [(100, 80)]
    assert pairs([100], [120])[0] == [(100, 120)]
    assert pairs([100], [121])[0] == []


def test_disordered_images_are_counted_not_paired() -> None:
    """An image whose stamp does not rise is dropped and counted."""
    buffer = PairBuffer(20 * MS)
    assert list(buffer.push("depth", image(100))) == []
    assert list(buffer.push("depth", image(50))) == []
    assert [c.stamp_nanos for c, _ in buffer.push("colour", image(100))] == [100 * MS]
    assert buffer.disordered == 1


def test_colour_is_not_held_for_ever() -> None:
    """Without any depth, colour images are given up as log time moves on."""
    buffer = PairBuffer(20 * MS)
    for i in range(2000):
        assert list(buffer.push("colour", image(i * 33))) == []
    assert buffer.unpaired > 1900


@given(
    st.lists(st.integers(0, 3000), min_size=1, max_size=40, unique=True),
    st.lists(st.integers(0, 3000), min_size=1, max_size=40, unique=True),
)
def test_streaming_equals_looking_at_everything(colour: list[int], depth: list[int]) -> None:
    """The pairs are those of a search over the whole log."""
    colour, depth = sorted(colour), sorted(depth)
    expected = []
    for c in colour:
        near = min(depth, key=lambda d: (abs(d - c), d))
        if abs(near - c) <= 20:
            expected.append((c, near))
    assert pairs(colour, depth)[0] == expected
