"""semslam's own segmenter pair at run time, on networks whose answers are known: what is red, or what is far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import helper

from semslam.errors import SemslamError
from semslam.models.segmenters import open_segmenter
from semslam.models.segmenters.prompted import TASK, PromptedSegmenter
from semslam.models.segmenters.sam import SamSegmenter
from semslam.models.session import Session
from tests.onnx_factory import sam_decoder, sam_encoder, save, value

HEIGHT, WIDTH, GRID, MARGIN = 96, 128, 48, 0.25
METADATA = {"task": TASK, "box_margin": str(MARGIN)}


def encoder(path: Path, *, channels: int = 1, metadata: Mapping[str, str] = METADATA, by_depth: bool = False) -> Path:
    """Features that are positive where the picture is red, or where depth is beyond 1.5 m."""
    weights: dict[str, NDArray[Any]] = {
        "start": np.array([0], np.int64),
        "end": np.array([1], np.int64),
        "axis": np.array([1], np.int64),
        "limit": np.array(1.5 if by_depth else 0.5, np.float32),
        "repeats": np.array([1, channels, 1, 1], np.int64),
    }
    nodes = [
        helper.make_node("Slice", ["images", "start", "end", "axis"], ["red"]),
        helper.make_node("Sub", ["depth" if by_depth else "red", "limit"], ["one"]),
        helper.make_node("Tile", ["one", "repeats"], ["features"]),
    ]
    inputs = [value("images", (1, 3, HEIGHT, WIDTH)), value("depth", (1, 1, HEIGHT, WIDTH))]
    return save(path, nodes, inputs, [value("features", (1, channels, HEIGHT, WIDTH))], weights, metadata=metadata)


def decoder(
    path: Path, *, metadata: Mapping[str, str] = METADATA, broken_box: int = -1, one_mask: bool = False
) -> Path:
    """The features under each box and its margin; no numbers for the box of the index `broken_box`."""
    grow = np.eye(4, dtype=np.float32) * (1 + MARGIN)  # boxes (N, 4) @ grow
    grow[[2, 3, 0, 1], [0, 1, 2, 3]] = -MARGIN
    weights: dict[str, NDArray[Any]] = {
        "grow": grow,
        "first": np.array([0], np.int64),
        "axis": np.array([1], np.int64),
        "one": np.array([1], np.int64),
        "zero": np.array(0, np.int64),
        "broken": np.array(broken_box, np.int64),
        "none": np.array(np.nan, np.float32),
        "step": np.array(1, np.int64),
        "last_axes": np.array([1, 2], np.int64),
    }
    roi = {"output_height": GRID, "output_width": GRID, "sampling_ratio": 1, "spatial_scale": 1.0}
    roi_align = helper.make_node(
        "RoiAlign", ["features", "rois", "pictures"], ["seen"], coordinate_transformation_mode="half_pixel", **roi
    )
    nodes = [
        helper.make_node("MatMul", ["boxes", "grow"], ["rois"]),
        helper.make_node("Shape", ["boxes"], ["shape"]),
        helper.make_node("Gather", ["shape", "zero"], ["count"]),
        helper.make_node("Range", ["zero", "count", "step"], ["numbers"]),
        helper.make_node("Mul", ["numbers", "zero"], ["pictures"]),
        roi_align,
        helper.make_node("Squeeze", ["seen", "axis"], ["given"]),
        helper.make_node("Equal", ["numbers", "broken"], ["is_broken"]),
        helper.make_node("Unsqueeze", ["is_broken", "last_axes"], ["bad"]),
        helper.make_node("Where", ["bad", "none", "given"], ["all"]),
        helper.make_node("Slice", ["all", "first", "one"], ["masks"])
        if one_mask
        else helper.make_node("Identity", ["all"], ["masks"]),
    ]
    inputs = [value("features", (1, 1, HEIGHT, WIDTH)), value("boxes", ("boxes", 4))]
    return save(path, nodes, inputs, [value("masks", ("boxes", GRID, GRID))], weights, metadata=metadata)


@pytest.fixture
def pair(tmp_path: Path) -> PromptedSegmenter:
    return PromptedSegmenter.open(encoder(tmp_path / "e.onnx"), decoder(tmp_path / "d.onnx"))


def scene(
    height: int = HEIGHT, width: int = WIDTH
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """Two red ellipses at 2 m on blue-green at 1 m: colour, depth, masks (2, H, W) and boxes (2, 4)."""
    masks = np.zeros((2, height, width), np.uint8)
    centres = (width // 4, height // 2), (7 * width // 10, height // 3)
    for mask, centre, axes in zip(masks, centres, ((width // 6, height // 4), (width // 7, height // 5)), strict=True):
        cv2.ellipse(mask, centre, axes, 0, 0, 360, 1, -1)
    red = masks.any(0)
    rgb = np.where(red[..., None], (230, 40, 40), (20, 200, 200)).astype(np.uint8)
    depth = np.where(red, 2.0, 1.0).astype(np.float32)
    boxes = [cv2.boundingRect(mask) for mask in masks]
    edges = np.array([(x, y, x + w, y + h) for x, y, w, h in boxes], np.float32)
    return rgb, depth, masks > 0, edges


def share(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    return float((one & other).sum() / max(1, int((one | other).sum())))


@pytest.mark.parametrize("by_depth", [False, True])
@pytest.mark.parametrize("size", [(96, 128), (480, 640), (240, 180), (90, 300)])
def test_what_is_wanted_is_cut_out_whatever_the_size_of_the_picture(
    tmp_path: Path, size: tuple[int, int], by_depth: bool
) -> None:
    """Through letterbox, window and back: the ellipses come out where they are, by colour and by depth."""
    segment = PromptedSegmenter.open(
        encoder(tmp_path / "e.onnx", by_depth=by_depth), decoder(tmp_path / "d.onnx"), threads=1
    )
    rgb, depth, truth, boxes = scene(*size)
    masks = segment(rgb, depth, boxes)
    assert masks.shape == (2, *size)
    assert masks.dtype == bool
    assert min(share(mask, true) for mask, true in zip(masks, truth, strict=True)) > 0.9


def test_a_mask_keeps_to_its_box_and_margin(pair: PromptedSegmenter) -> None:
    """All of the picture is red, and yet the mask ends a quarter of the box's sides beyond it."""
    red = np.zeros((HEIGHT, WIDTH, 3), np.uint8) + np.array([255, 0, 0], np.uint8)
    mask = pair(red, np.ones((HEIGHT, WIDTH), np.float32), np.array([[40, 30, 80, 50]], np.float32))[0]
    expected = np.zeros_like(mask)
    expected[25:55, 30:90] = True
    assert np.array_equal(mask, expected)


def test_boxes_at_the_edges_give_masks_up_to_the_edge(pair: PromptedSegmenter) -> None:
    """Boxes that touch, cross or cover the picture."""
    red = np.zeros((HEIGHT, WIDTH, 3), np.uint8) + np.array([255, 0, 0], np.uint8)
    boxes = np.array([[0, 0, 32, 32], [100, 70, 128, 96], [-40, -40, 400, 400]], np.float32)
    masks = pair(red, np.ones((HEIGHT, WIDTH), np.float32), boxes)
    assert masks[0, :32, :32].all()
    assert masks[1, 70:, 100:].all()
    assert masks[2].all()


def test_useless_boxes_give_empty_masks_and_do_not_disturb_the_others(pair: PromptedSegmenter) -> None:
    """Not finite, beyond the picture, or inside out."""
    rgb, depth, _, boxes = scene()
    bad = [[np.nan, 0, 10, 10], [0, 0, np.inf, 10], [200, 10, 300, 50], [-50, 10, -1, 50], [60, 60, 20, 20]]
    masks = pair(rgb, depth, np.concatenate([np.array(bad, np.float32), boxes]))
    assert not masks[:5].any()
    assert np.array_equal(masks[5:], pair(rgb, depth, boxes))


def test_a_box_thinner_than_a_pixel_is_handled(pair: PromptedSegmenter) -> None:
    """It is taken as one pixel."""
    rgb, depth, *_ = scene()
    masks = pair(rgb, depth, np.array([[30.2, 40.1, 30.4, 40.3], [128, 96, 128, 96]], np.float32))
    assert masks.shape == (2, HEIGHT, WIDTH)
    assert masks.sum() <= 18


def test_answers_that_are_no_numbers_are_no_object(tmp_path: Path) -> None:
    """The other box of the same run keeps its mask."""
    segment = PromptedSegmenter.open(encoder(tmp_path / "e.onnx"), decoder(tmp_path / "d.onnx", broken_box=0))
    rgb, depth, truth, boxes = scene()
    masks = segment(rgb, depth, boxes)
    assert not masks[0].any()
    assert share(masks[1], truth[1]) > 0.9


def test_depth_that_is_no_distance_is_missing(tmp_path: Path) -> None:
    """Infinite, negative and undefined depth reach the encoder as 0."""
    segment = PromptedSegmenter.open(encoder(tmp_path / "e.onnx", by_depth=True), decoder(tmp_path / "d.onnx"))
    rgb, depth, truth, boxes = scene()
    for bad in (np.inf, np.nan, -3.0):
        spoiled = depth.copy()
        spoiled[truth[0]] = bad
        masks = segment(rgb, spoiled, boxes)
        assert not masks[0].any()
        assert share(masks[1], truth[1]) > 0.9


@dataclass(frozen=True)
class Counted:
    """A session that counts its runs."""

    session: Session
    runs: list[int] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.session, name)

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        self.runs.append(1)
        return self.session.run(feeds)


def test_the_encoder_runs_once_for_all_boxes_and_never_without_any(pair: PromptedSegmenter) -> None:
    """And the decoder answers all boxes at once."""
    first, second = Counted(pair.encoder), Counted(pair.decoder)
    segment = replace(pair, encoder=cast(Session, first), decoder=cast(Session, second))
    rgb, depth, _, boxes = scene()
    nowhere = np.array([[np.nan, 0, 1, 1]], np.float32)
    assert segment(rgb, depth, np.zeros((0, 4), np.float32)).shape == (0, HEIGHT, WIDTH)
    assert segment(rgb, depth, nowhere).shape == (1, HEIGHT, WIDTH)
    assert (len(first.runs), len(second.runs)) == (0, 0)
    segment(rgb, depth, np.concatenate([boxes, boxes, boxes]))
    assert (len(first.runs), len(second.runs)) == (1, 1)


def test_masks_are_the_same_bytes_again(pair: PromptedSegmenter) -> None:
    """Also when other boxes come along."""
    rgb, depth, _, boxes = scene()
    both = pair(rgb, depth, boxes)
    assert np.array_equal(both, pair(rgb, depth, boxes))
    assert np.array_equal(both[:1], pair(rgb, depth, boxes[:1]))


def test_a_pair_is_recognised_by_what_its_file_says(tmp_path: Path) -> None:
    """Ours by its task, SAM's by the lack of it."""
    ours = open_segmenter("auto", str(encoder(tmp_path / "e.onnx")), str(decoder(tmp_path / "d.onnx")))
    assert isinstance(ours, PromptedSegmenter)
    theirs = open_segmenter("sam", str(sam_encoder(tmp_path / "se.onnx")), str(sam_decoder(tmp_path / "sd.onnx")))
    assert isinstance(theirs, SamSegmenter)


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    """Another decoder, other features, the wrong way round: the error names the file or says so."""
    ours, other = encoder(tmp_path / "e.onnx"), encoder(tmp_path / "wide.onnx", channels=2)
    theirs, mine = sam_decoder(tmp_path / "sd.onnx"), decoder(tmp_path / "d.onnx")
    with pytest.raises(SemslamError, match=r"sd\.onnx.*unknown inputs"):
        open_segmenter("sam", str(ours), str(theirs))
    with pytest.raises(SemslamError, match="belong together"):
        open_segmenter("sam", str(other), str(mine))
    with pytest.raises(SemslamError, match=r"d\.onnx"):
        open_segmenter("sam", str(mine), str(ours))


@pytest.mark.parametrize("margin", ["", "wide", "-0.1", "nan"])
def test_a_decoder_must_say_how_far_its_masks_reach(tmp_path: Path, margin: str) -> None:
    """Without it masks would land in the wrong place."""
    files = encoder(tmp_path / "e.onnx"), decoder(tmp_path / "d.onnx", metadata={"task": TASK, "box_margin": margin})
    with pytest.raises(SemslamError, match="how far beyond its box") as caught:
        PromptedSegmenter.open(*files)
    assert "box_margin" in caught.value.hint


def test_masks_of_another_number_are_refused(tmp_path: Path) -> None:
    """One mask for two boxes."""
    segment = PromptedSegmenter.open(encoder(tmp_path / "e.onnx"), decoder(tmp_path / "d.onnx", one_mask=True))
    rgb, depth, _, boxes = scene()
    with pytest.raises(SemslamError, match="answers 2 boxes"):
        segment(rgb, depth, boxes)
