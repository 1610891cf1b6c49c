"""Segmenters: a SAM-shaped pair of real sessions, and masks from colour and depth alone."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.segmenters import open_segmenter
from semslam.models.segmenters.sam import SamSegmenter
from tests.onnx_factory import open_height_encoder, sam_decoder, sam_encoder

PICTURE = np.random.default_rng(1).integers(0, 256, (96, 128, 3), np.uint8)
DEPTH = np.full((96, 128), 2.0, np.float32)
BOXES = np.array([[16, 16, 64, 48], [72.4, 40.2, 120, 90]], np.float32)


def _share(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    return float((one & other).sum() / max(1, int((one | other).sum())))


def _filled(box: NDArray[np.float32], shape: tuple[int, int] = (96, 128)) -> NDArray[np.bool_]:
    mask = np.zeros(shape, bool)
    left, top, right, bottom = np.round(box).astype(int)
    mask[top:bottom, left:right] = True
    return mask


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("kind", ["sized", "low", "boxes"])
def test_sam_prompts_land_where_the_boxes_are(tmp_path: Path, channels_last: bool, kind: str) -> None:
    """The decoder fills its prompt, so the masks must be the boxes, through every scaling on the way."""
    encoder = sam_encoder(tmp_path / "e.onnx", channels_last=channels_last)
    decoder = sam_decoder(tmp_path / "d.onnx", sized=kind == "sized", boxes=kind == "boxes")
    masks = open_segmenter("sam", str(encoder), str(decoder))(PICTURE, DEPTH, BOXES)
    assert masks.shape == (2, 96, 128)
    assert masks.dtype == bool
    assert all(_share(mask, _filled(box)) > 0.9 for mask, box in zip(masks, BOXES, strict=True))


@pytest.mark.parametrize("kind", ["sam", "depth_box", "box"])
@pytest.mark.parametrize("size", [(96, 128), (128, 96), (37, 251)])
def test_no_boxes_give_no_masks_and_odd_boxes_give_masks_inside(
    tmp_path: Path, kind: str, size: tuple[int, int]
) -> None:
    """Boxes that leave the picture, are thinner than a pixel or cover everything are all handled."""
    encoder, decoder = sam_encoder(tmp_path / "e.onnx"), sam_decoder(tmp_path / "d.onnx")
    files = (str(encoder), str(decoder)) if kind == "sam" else ("", "")
    segment = open_segmenter(kind, *files)
    rgb, depth = np.full((*size, 3), 80, np.uint8), np.full(size, 1.5, np.float32)
    assert segment(rgb, depth, np.zeros((0, 4), np.float32)).shape == (0, *size)
    odd = [[-20, -5, 30, 20], [5.2, 5.1, 5.6, 5.3], [0, 0, size[1], size[0]], [size[1] - 2, size[0] - 2, 999, 999]]
    assert segment(rgb, depth, np.array(odd, np.float32)).shape == (4, *size)


def test_a_pair_that_does_not_belong_together_is_refused(tmp_path: Path) -> None:
    """Embeddings of 4 channels into a decoder for 8."""
    encoder, decoder = sam_encoder(tmp_path / "e.onnx"), sam_decoder(tmp_path / "d.onnx", channels=8)
    with pytest.raises(SemslamError, match="belong"):
        open_segmenter("sam", str(encoder), str(decoder))


def test_files_given_the_wrong_way_round_are_refused(tmp_path: Path) -> None:
    """The decoder in the place of the encoder."""
    encoder, decoder = sam_encoder(tmp_path / "e.onnx"), sam_decoder(tmp_path / "d.onnx")
    with pytest.raises(SemslamError, match=r"d\.onnx"):
        open_segmenter("sam", str(decoder), str(encoder))


def test_half_a_pair_asks_for_the_other_half() -> None:
    """And sam without files asks for both."""
    with pytest.raises(SemslamError) as caught:
        open_segmenter("auto", "e.onnx", "")
    assert "--segmenter-decoder" in caught.value.hint
    with pytest.raises(SemslamError):
        open_segmenter("sam")


def _scene() -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """A brown disc at 1 m before a textured grey wall at 3 m, with speckles without depth."""
    rng = np.random.default_rng(4)
    rgb = rng.normal(150, 12, (240, 320, 3)).clip(0, 255).astype(np.uint8)
    depth = np.full((240, 320), 3.0, np.float32)
    disc = cv2.circle(np.zeros((240, 320), np.uint8), (160, 120), 60, 1, -1) > 0
    rgb[disc] = (rng.normal(0, 12, (int(disc.sum()), 3)) + [120, 70, 30]).clip(0, 255).astype(np.uint8)
    depth[disc] = 1.0
    depth[rng.random((240, 320)) < 0.05] = 0
    return rgb, depth, disc


@pytest.mark.parametrize(("kind", "least"), [("depth_box", 0.93), ("box", 0.85)])
def test_an_object_before_a_wall_is_cut_out(kind: str, least: float) -> None:
    """GrabCut fills the speckles without depth, the plain one leaves them out."""
    rgb, depth, disc = _scene()
    mask = open_segmenter(kind)(rgb, depth, np.array([[98, 58, 222, 182]], np.float32))[0]
    assert _share(mask, disc) > least


@pytest.mark.parametrize("kind", ["depth_box", "box"])
def test_masks_are_the_same_bytes_again_and_for_any_number_of_threads(kind: str) -> None:
    """Whatever ran before, and however many threads OpenCV has."""
    rgb, depth, _ = _scene()
    boxes, segment = np.array([[98, 58, 222, 182], [10, 10, 300, 200]], np.float32), open_segmenter(kind)
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        first = segment(rgb, depth, boxes)
        cv2.setNumThreads(2)
        cv2.setRNGSeed(99)
        assert np.array_equal(first, segment(rgb, depth, boxes))
    finally:
        cv2.setNumThreads(threads)


def test_without_any_depth_the_box_is_the_mask() -> None:
    """There is nothing to tell the object by."""
    rgb, depth, _ = _scene()
    for kind in ("depth_box", "box"):
        mask = open_segmenter(kind)(rgb, np.zeros_like(depth), np.array([[98, 58, 222, 182]], np.float32))[0]
        assert np.array_equal(mask, _filled(np.array([98, 58, 222, 182], np.float32), (240, 320)))


@pytest.mark.parametrize("count", [1, 3, 40])
def test_many_boxes_go_in_one_run_where_the_decoder_takes_them(tmp_path: Path, count: int) -> None:
    """Prompts of open first dimension: a run a 32 boxes, and the masks of one box a run."""
    encoder = sam_encoder(tmp_path / "e.onnx")
    many, one = sam_decoder(tmp_path / "m.onnx", many=True), sam_decoder(tmp_path / "o.onnx")
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 60, (count, 2))
    boxes = np.concatenate([corners, corners + rng.uniform(8, 30, (count, 2))], axis=1).astype(np.float32)
    together = open_segmenter("sam", str(encoder), str(many))
    runs = _runs_of_decoder(together)
    masks = together(PICTURE, DEPTH, boxes)
    assert len(runs) == -(-count // 32)
    np.testing.assert_array_equal(masks, open_segmenter("sam", str(encoder), str(one))(PICTURE, DEPTH, boxes))


def _runs_of_decoder(segmenter: object) -> list[int]:
    """Prompts of each run of the decoder from now on."""
    sizes: list[int] = []
    session = segmenter.decoder  # type: ignore[attr-defined]
    inner = session._ort

    class Counting:
        def run(self, names: object, feeds: dict[str, NDArray[np.float32]]) -> object:
            sizes.append(len(feeds["point_coords"]))
            return inner.run(names, feeds)

    object.__setattr__(session, "_ort", Counting())
    return sizes


def test_pixels_of_any_size_go_unpadded_to_an_encoder_that_fills_up_itself(tmp_path: Path) -> None:
    """samexporter's `--use-preprocess`: an input (height, width, 3) of open size; the picture is 64 x 48 in it."""
    encoder = open_height_encoder(tmp_path / "e.onnx")
    seen: list[tuple[int, ...]] = []
    segmenter = SamSegmenter.open(encoder, sam_decoder(tmp_path / "d.onnx", channels=3, cells=64))
    inner = segmenter.encoder._ort

    class Noting:
        def run(self, names: object, feeds: dict[str, NDArray[np.float32]]) -> object:
            seen.append(feeds["input_image"].shape)
            return inner.run(names, feeds)

    object.__setattr__(segmenter.encoder, "_ort", Noting())
    masks = segmenter(PICTURE, DEPTH, BOXES)
    assert seen == [(768, 1024, 3)]
    assert all(_share(mask, _filled(box)) > 0.9 for mask, box in zip(masks, BOXES, strict=True))


def test_masks_cropped_for_another_picture_do_not_matter(tmp_path: Path) -> None:
    """Official exports crop `masks` as for the picture they were traced with; `low_res_masks` are right for any."""
    encoder = sam_encoder(tmp_path / "e.onnx")
    tall = np.ascontiguousarray(PICTURE.transpose(1, 0, 2))
    boxes = BOXES[:, [1, 0, 3, 2]].copy()
    masks = open_segmenter("sam", str(encoder), str(sam_decoder(tmp_path / "d.onnx", frozen=(96, 128))))(
        tall, DEPTH.T.copy(), boxes
    )
    assert all(_share(mask, _filled(box, (128, 96))) > 0.9 for mask, box in zip(masks, boxes, strict=True))


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, -np.inf])
def test_boxes_that_are_no_numbers_give_masks_nonetheless(tmp_path: Path, spoilt: float) -> None:
    """Of the right shape, and without a traceback."""
    encoder, decoder = sam_encoder(tmp_path / "e.onnx"), sam_decoder(tmp_path / "d.onnx")
    boxes = np.array([[spoilt, 0, 20, 20], [10, 10, 40, 40]], np.float32)
    masks = open_segmenter("sam", str(encoder), str(decoder))(PICTURE, DEPTH, boxes)
    assert masks.shape == (2, 96, 128)
    assert _share(masks[1], _filled(boxes[1])) > 0.9
