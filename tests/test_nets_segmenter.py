"""The segmenter as a network: what it learns from, that it learns, and that its files answer as it does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

import onnxruntime  # noqa: E402
from onnx import helper  # noqa: E402

from semslam.models.nets.segmenter import GRID, HEIGHT, MARGIN, STRIDE, WIDTH, Segmenter, crop, grown  # noqa: E402
from semslam.models.onnxfile import read_onnx  # noqa: E402
from semslam.models.segmenters import open_segmenter  # noqa: E402
from semslam.models.segmenters.prompted import PromptedSegmenter  # noqa: E402
from semslam.models.training import segmenter as training  # noqa: E402
from semslam.models.training.augment import Strength  # noqa: E402
from semslam.models.training.pictures import Picture, PictureSet, SeenObject  # noqa: E402
from semslam.tables.pictures import encode_colour, encode_depth  # noqa: E402
from tests.onnx_factory import save, value  # noqa: E402

_SHAPES = ("ellipse", "legs", "ring")


def room(seed: int, width: int = 160, height: int = 128) -> Picture:
    """Three things of one colour before a wall of many: an ellipse, a plate on thin legs, a ring."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(90, 160, (height, width, 3)).astype(np.uint8)
    depth = np.full((height, width), 4.0, np.float32)
    instances = np.zeros((height, width), np.uint16)
    objects = []
    for index, shape in enumerate(_SHAPES):
        mask = np.zeros((height, width), np.uint8)
        x, y = width * (2 * index + 1) // 6 + int(rng.integers(-4, 5)), height // 2 + int(rng.integers(-15, 16))
        _draw(mask, shape, x, y)
        instances[mask > 0] = index + 1
        rgb[mask > 0] = rng.integers(0, 256, 3)
        depth[mask > 0] = rng.uniform(1.5, 2.5)
        left, top, across, down = cv2.boundingRect(mask)
        pixels = int(mask.sum())
        objects.append(SeenObject(index + 1, index, left, top, left + across, top + down, pixels, 1.0, False))
    return Picture(rgb, depth, instances, tuple(objects))


def _draw(mask: NDArray[np.uint8], shape: str, x: int, y: int) -> None:
    if shape == "ellipse":
        cv2.ellipse(mask, (x, y), (22, 30), 0, 0, 360, 1, -1)
    elif shape == "ring":
        cv2.circle(mask, (x, y), 20, 1, 8)
    else:
        cv2.rectangle(mask, (x - 22, y - 25), (x + 22, y - 10), 1, -1)
        for leg in (-20, 0, 20):
            cv2.rectangle(mask, (x + leg - 2, y - 25), (x + leg + 2, y + 25), 1, -1)


def as_set(pictures: list[Picture]) -> PictureSet:
    """Pictures as the files hold them."""
    rows: list[dict[str, Any]] = [
        {
            "colour": encode_colour(picture.rgb),
            "depth": encode_depth(picture.depth_m),
            "instances": cv2.imencode(".png", picture.instances)[1].tobytes(),
            "instance": [item.instance for item in picture.objects],
            "class_id": [item.class_id for item in picture.objects],
            "boxes_px": [v for item in picture.objects for v in (item.left, item.top, item.right, item.bottom)],
            "pixels": [item.pixels for item in picture.objects],
            "share": [item.share for item in picture.objects],
            "cut": [int(item.cut) for item in picture.objects],
        }
        for picture in pictures
    ]
    return PictureSet(_SHAPES, rows, "test")


def overlap(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    return float((one & other).sum() / max(1, int((one | other).sum())))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Segmenter, Path, Path]:
    """A network with random weights, its statistics not those of a fresh one, and its two files."""
    network = training.new_segmenter(3)
    generator = torch.Generator().manual_seed(5)
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.running_mean.copy_(torch.rand(layer.num_features, generator=generator) * 0.2 - 0.1)
            layer.running_var.copy_(torch.rand(layer.num_features, generator=generator) + 0.3)
    encoder, decoder = training.export_segmenter(network, tmp_path_factory.mktemp("pair"))
    return network.eval(), encoder, decoder


def _answers(path: Path, feeds: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, feeds)[0], np.float32)


def test_the_files_answer_as_the_network_does(exported: tuple[Segmenter, Path, Path]) -> None:
    """To 1e-4, for any number of boxes, at the edges of the picture and beyond, and where depth is missing."""
    network, encoder, decoder = exported
    rng = np.random.default_rng(1)
    images = rng.random((1, 3, HEIGHT, WIDTH), np.float32)
    depth = (rng.uniform(0.3, 6, (1, 1, HEIGHT, WIDTH)) * (rng.random((1, 1, HEIGHT, WIDTH)) > 0.2)).astype(np.float32)
    depth[..., :100, :100] = 0
    boxes = np.array([[0, 0, 60, 60], [300, 100, 380, 400], [600, 440, 640, 480], [-9, -9, 700, 500]], np.float32)
    with torch.no_grad():
        features = network.encoder(torch.from_numpy(images), torch.from_numpy(depth))
        logits = network.decoder(features, torch.from_numpy(boxes)[None]).numpy()
    given = _answers(encoder, {"images": images, "depth": depth})
    np.testing.assert_allclose(given, features.numpy(), atol=1e-4)
    np.testing.assert_allclose(_answers(decoder, {"features": given, "boxes": boxes}), logits, atol=1e-4)
    one = _answers(decoder, {"features": given, "boxes": boxes[1:2]})
    np.testing.assert_allclose(one, logits[1:2], atol=1e-4)


def test_the_files_are_small_complete_and_say_what_they_are(exported: tuple[Segmenter, Path, Path]) -> None:
    """At most 2.5 MB together; opened by what they say of themselves; the margin is that of training."""
    _, encoder, decoder = exported
    assert encoder.stat().st_size + decoder.stat().st_size < 2.5e6
    assert read_onnx(decoder).metadata["box_margin"] == str(MARGIN)
    assert not read_onnx(encoder).external_files
    segment = open_segmenter("auto", str(encoder), str(decoder))
    assert isinstance(segment, PromptedSegmenter)
    picture = room(0)
    masks = segment(picture.rgb, picture.depth_m, np.array([[10, 10, 60, 60]], np.float32))
    assert masks.shape == (1, *picture.instances.shape)


def test_the_same_weights_give_the_same_files(exported: tuple[Segmenter, Path, Path], tmp_path: Path) -> None:
    """Byte for byte, so that a digest stands for the weights."""
    network, encoder, decoder = exported
    again = training.export_segmenter(network, tmp_path)
    assert [path.read_bytes() for path in again] == [encoder.read_bytes(), decoder.read_bytes()]


def test_a_wanted_mask_comes_back_where_the_object_is(tmp_path: Path) -> None:
    """What training asks for, given as the decoder's answer, is the object again: both mean the same window."""
    nothing = {"zero": np.zeros((1, 1, 8, 8), np.float32)}
    inputs = [value("images", (1, 3, 128, 160)), value("depth", (1, 1, 128, 160))]
    nodes = [helper.make_node("Identity", ["zero"], ["features"])]
    metadata = {"task": training.TASK, "box_margin": str(MARGIN)}
    outputs = [value("features", (1, 1, 8, 8))]
    encoder = save(tmp_path / "e.onnx", nodes, inputs, outputs, nothing, metadata=metadata)
    picture = room(4)
    for item in picture.objects:
        rng = np.random.default_rng(item.instance)
        box = training.jittered(item, 160, 128, rng)
        answer = {"answer": training.wanted_mask(picture.instances, item.instance, box)[None] - np.float32(0.5)}
        nodes = [helper.make_node("Identity", ["answer"], ["masks"])]
        inputs = [value("features", (1, 1, 8, 8)), value("boxes", ("boxes", 4))]
        outputs = [value("masks", ("boxes", GRID, GRID))]
        decoder = save(tmp_path / "d.onnx", nodes, inputs, outputs, answer, metadata=metadata)
        mask = PromptedSegmenter.open(encoder, decoder)(picture.rgb, picture.depth_m, box[None])[0]
        assert overlap(mask, picture.instances == item.instance) > 0.93


def test_a_window_shows_what_is_under_the_box() -> None:
    """A picture whose features are its coordinates: the window reads them off, with its margin, as far as they go."""
    down, across = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    features = torch.stack([across, down])[None] * STRIDE  # (1, 2, 48, 64) in pixels of the input
    box = torch.tensor([[[20.0, 30, 60, 70]]])
    seen = crop(features, grown(box), 50)
    expected = 20 - MARGIN * 40 + (torch.arange(50) + 0.5) / 50 * 40 * (1 + 2 * MARGIN)
    torch.testing.assert_close(seen[0, 0], expected.expand(50, 50), atol=1e-3, rtol=0)
    torch.testing.assert_close(seen[0, 1], (expected + 10)[:, None].expand(50, 50), atol=1e-3, rtol=0)


def test_a_batch_depends_on_seed_and_step_alone() -> None:
    """So that a run which was killed goes on exactly; other steps and seeds give others."""
    pictures = as_set([room(seed) for seed in range(4)])
    made = training.PromptBatches.of(pictures, steps=50, batch=2, seed=1)
    again = training.PromptBatches.of(pictures, steps=50, batch=2, seed=1)
    made(3)
    first, second = made(7), again(7)
    for name in ("images", "depth_m", "boxes", "masks", "weights"):
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert not torch.equal(first.boxes, made(8).boxes)
    assert not torch.equal(first.boxes, training.PromptBatches.of(pictures, steps=50, batch=2, seed=2)(7).boxes)


def test_a_batch_is_small_at_first_and_of_full_size_at_last() -> None:
    """And holds what its shapes say."""
    batches = training.PromptBatches.of(as_set([room(0)]), steps=100, batch=1, seed=1)
    for step, (width, height) in ((0, training.SIZES[0][1:]), (99, (WIDTH, HEIGHT))):
        batch = batches(step)
        assert batch.images.shape == (1, 3, height, width)
        assert batch.depth_m.shape == (1, 1, height, width)
        assert batch.boxes.shape == (1, training.BOXES, 4)
        assert batch.masks.shape == (training.BOXES, GRID, GRID)
        assert 0 <= float(batch.masks.min()) <= float(batch.masks.max()) <= 1


def test_boxes_are_disturbed_but_never_by_much_and_stay_inside() -> None:
    """At most an eighth of their sides; some are left alone."""
    item = SeenObject(1, 0, 0, 20, 100, 60, 2000, 1.0, True)
    rng = np.random.default_rng(0)
    boxes = np.stack([training.jittered(item, 120, 90, rng) for _ in range(300)])
    off = np.abs(boxes - np.array([0, 20, 100, 60])) / np.array([100, 40, 100, 40])
    assert 0.08 < off.max() <= 0.121
    assert boxes.min() >= 0
    assert 30 < (off.max(1) == 0).sum() < 150


def test_pictures_without_objects_teach_nothing_and_break_nothing() -> None:
    """A wall, without depth: the loss is zero, not undefined."""
    bare = Picture(
        np.full((64, 80, 3), 90, np.uint8), np.zeros((64, 80), np.float32), np.zeros((64, 80), np.uint16), ()
    )
    batch = training.collated([bare], np.random.default_rng(0))
    value_, parts = training.mask_loss(training.new_segmenter(0).train(), batch)
    assert float(value_.detach()) == 0
    assert all(np.isfinite(number) for number in parts.values())


def test_it_learns_four_pictures_by_heart() -> None:
    """From nothing to masks that overlap by 0.85 in a few dozen steps, thin legs and the hole of the ring included."""
    torch.manual_seed(0)
    pictures = [room(seed) for seed in range(4)]
    network = training.new_segmenter(0).to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=4e-3)
    parts: list[float] = []
    for step in range(40):
        batch = training.collated([pictures[step % 4], pictures[(step + 1) % 4]], np.random.default_rng([1, step]))
        value_, told = training.mask_loss(network, batch)
        optimizer.zero_grad()
        value_.backward()
        optimizer.step()
        parts.append(told["iou"])
    assert np.mean(parts[:3]) < 0.6
    assert np.mean(parts[-5:]) > 0.85


def test_strength_zero_leaves_pictures_as_they_are() -> None:
    """What is asked of the masks then is the truth of the files."""
    calm = Strength(0, 0, 0, 0, 0)
    picture = room(1, 320, 240)
    batches = training.PromptBatches.of(as_set([picture]), steps=100, batch=1, seed=1, strength=calm)
    images = batches(0).images[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(images, picture.rgb / 255, atol=1e-3)
