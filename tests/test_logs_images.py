"""Pixels and depth come out of every encoding as they were, and damaged images are refused."""

from __future__ import annotations

import contextlib
import os
import struct
import time
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from mcap.reader import make_reader
from numpy.typing import NDArray

from semslam.logs.channels import Channel
from semslam.logs.decode import decoder_for
from semslam.logs.images import ImageError, decode_colour, decode_depth, image_size
from semslam.logs.messages import CompressedImage, Image
from semslam.logs.rvl import RvlError, decode_rvl, encode_rvl
from semslam.logs.writer import encode_jpeg, encode_png_depth, encode_rvl_depth

FAST = settings(max_examples=60, deadline=None)

RGB = np.array(
    [[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[1, 2, 3], [200, 100, 50], [7, 7, 7]]],
    np.uint8,
)  # (2, 3, 3)
DEPTH_MM = np.array([[0, 1, 1000], [1500, 65535, 2]], np.uint16)
DEPTH_M = DEPTH_MM.astype(np.float32) / 1000


def raw(pixels: NDArray[Any], encoding: str, padding: int = 0, big_endian: bool = False) -> Image:
    """An image message whose rows end in `padding` bytes of rubbish."""
    rows = [np.ascontiguousarray(row).tobytes() + b"\xaa" * padding for row in pixels]
    return Image(0, "camera", len(rows), pixels.shape[1], encoding, len(rows[0]), big_endian, b"".join(rows))


def file(data: bytes, image_format: str = "") -> CompressedImage:
    return CompressedImage(0, "camera", image_format, data)


def encode(suffix: str, pixels: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(suffix, pixels, list(options))
    assert done
    return data.tobytes()


def scene(height: int = 60, width: int = 80) -> NDArray[np.uint8]:
    """A smooth picture with some texture. (H, W, 3) RGB."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // width, y * 255 // height, 128 + (x * y) % 8], axis=2).astype(np.uint8)


def scene_depth(height: int = 60, width: int = 80) -> NDArray[np.uint16]:
    """A slanted wall with a hole and a step. (H, W) millimetres."""
    y, x = np.mgrid[:height, :width]
    depth: NDArray[np.uint16] = (1500 + 3 * x + 2 * y + (x * 7919 + y * 104729) % 5).astype(np.uint16)
    depth[10:20, 30:50] = 0
    depth[40:] += 700
    return depth


# -------------------------------------------------------------------------------------------------------- colour


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[:, :, ::-1]),
        ("8UC3", RGB[:, :, ::-1]),
        ("rgba8", np.dstack([RGB, np.full((2, 3), 9, np.uint8)])),
        ("bgra8", np.dstack([RGB[:, :, ::-1], np.full((2, 3), 9, np.uint8)])),
        ("8UC4", np.dstack([RGB[:, :, ::-1], np.full((2, 3), 9, np.uint8)])),
    ],
)
def test_colour_encodings_give_rgb(encoding: str, pixels: NDArray[np.uint8], padding: int) -> None:
    """Channel order and row padding are undone, alpha is dropped, and the result is one's own to write to."""
    message = raw(pixels, encoding, padding)
    colour = decode_colour(message)
    np.testing.assert_array_equal(colour, RGB)
    colour[:] = 0
    np.testing.assert_array_equal(decode_colour(message), RGB)


@pytest.mark.parametrize(
    ("encoding", "dtype", "big_endian"),
    [("mono8", "u1", False), ("8UC1", "u1", True), ("mono16", "<u2", False), ("mono16", ">u2", True)],
)
def test_grey_encodings_give_equal_channels(encoding: str, dtype: str, big_endian: bool) -> None:
    """Sixteen bits keep the high byte."""
    grey = np.array([[0, 128, 255], [3, 2, 1]])
    scale = 256 if dtype.endswith("2") else 1
    colour = decode_colour(raw((grey * scale).astype(dtype), encoding, 3, big_endian))
    np.testing.assert_array_equal(colour, np.repeat(grey[:, :, None], 3, axis=2))


@pytest.mark.parametrize(
    ("encoding", "tile"),
    [
        ("bayer_rggb8", [[0, 1], [1, 2]]),
        ("bayer_bggr8", [[2, 1], [1, 0]]),
        ("bayer_gbrg8", [[1, 2], [0, 1]]),
        ("bayer_grbg8", [[1, 0], [2, 1]]),
    ],
)
def test_bayer_patterns_give_the_colour_of_the_scene(encoding: str, tile: list[list[int]]) -> None:
    """An even orange wall, seen through each mosaic."""
    orange = np.array([200, 120, 40], np.uint8)
    mosaic = orange[np.tile(np.array(tile), (4, 4))]
    colour = decode_colour(raw(mosaic, encoding))
    np.testing.assert_array_equal(colour[2:-2, 2:-2], np.broadcast_to(orange, (4, 4, 3)))


@pytest.mark.parametrize(
    ("encoding", "order"), [("yuv422", (1, 0, 2, 0)), ("yuv422_yuy2", (0, 1, 0, 2)), ("yuyv", (0, 1, 0, 2))]
)
def test_yuv_pairs_give_the_colour_of_the_scene(encoding: str, order: tuple[int, ...]) -> None:
    """An even wall: Y 145, U 54, V 34 is full green in BT.601."""
    pair = np.array([145, 54, 34], np.uint8)[list(order)].reshape(2, 2)
    colour = decode_colour(raw(np.tile(pair, (2, 2, 1)), encoding))
    np.testing.assert_allclose(colour, np.broadcast_to([0, 255, 0], (2, 4, 3)), atol=2)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_image_files_give_rgb(suffix: str) -> None:
    """JPEG, PNG and WebP by their content; the format string need not be right."""
    rgb = scene()
    colour = decode_colour(
        file(encode(suffix, rgb[:, :, ::-1], *([cv2.IMWRITE_WEBP_QUALITY, 101] * (suffix == ".webp"))))
    )
    assert colour.shape == (60, 80, 3)
    assert np.abs(colour.astype(int) - rgb).mean() < (6 if suffix == ".jpg" else 0.1)


def test_a_jpeg_keeps_the_orientation_of_the_sensor() -> None:
    """An EXIF tag does not turn the picture: the calibration belongs to the pixels as they were read out."""
    tiff = b"MM\x00\x2a\x00\x00\x00\x08" + struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    exif = b"Exif\x00\x00" + tiff
    jpeg = encode_jpeg(scene(), 95)
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]
    np.testing.assert_array_equal(decode_colour(file(turned)), decode_colour(file(jpeg)))


def test_a_grey_png_and_a_png_with_alpha_are_colour_too() -> None:
    """The number of channels in the file does not matter."""
    grey = scene()[:, :, 0]
    np.testing.assert_array_equal(decode_colour(file(encode(".png", grey)))[:, :, 1], grey)
    bgra = np.dstack([scene()[:, :, ::-1], np.zeros((60, 80), np.uint8)])
    np.testing.assert_array_equal(decode_colour(file(encode(".png", bgra))), scene())


# --------------------------------------------------------------------------------------------------------- depth


@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize(("encoding", "big_endian"), [("16UC1", False), ("16UC1", True), ("mono16", False)])
def test_integer_depth_is_millimetres(encoding: str, big_endian: bool, padding: int) -> None:
    """In either byte order, with and without padding."""
    pixels = DEPTH_MM.astype(">u2" if big_endian else "<u2")
    depth = decode_depth(raw(pixels, encoding, padding, big_endian))
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, DEPTH_M, rtol=1e-6)


def test_the_unit_of_integer_depth_can_be_given() -> None:
    """Some cameras count in 0.1 or 0.25 mm; floats stay metres."""
    np.testing.assert_allclose(decode_depth(raw(DEPTH_MM, "16UC1"), unit_m=0.00025), DEPTH_M / 4, rtol=1e-6)
    np.testing.assert_allclose(decode_depth(raw(DEPTH_M, "32FC1"), unit_m=0.00025), DEPTH_M, rtol=1e-6)
    np.testing.assert_allclose(decode_depth(file(encode_png_depth(DEPTH_MM)), unit_m=0.0001), DEPTH_M / 10, rtol=1e-6)


@pytest.mark.parametrize("big_endian", [False, True])
def test_float_depth_is_metres_and_what_is_no_distance_is_missing(big_endian: bool) -> None:
    """NaN, both infinities, negative numbers and zero all become 0."""
    values = np.array([[1.25, np.nan, np.inf], [-np.inf, -0.5, 0.0]], ">f4" if big_endian else "<f4")
    depth = decode_depth(raw(values, "32FC1", 4, big_endian))
    np.testing.assert_array_equal(depth, np.array([[1.25, 0, 0], [0, 0, 0]], np.float32))


@pytest.mark.parametrize(
    "message",
    [
        file(encode_png_depth(scene_depth()), "16UC1; compressedDepth png"),
        file(encode_png_depth(scene_depth()), "16UC1; compressedDepth"),
        file(encode_png_depth(scene_depth()), "png"),
        file(encode_png_depth(scene_depth())[12:], "png"),
        file(encode_png_depth(scene_depth())[12:], "16UC1; png compressed "),
        file(encode_png_depth(scene_depth())[12:], "16UC1; compressedDepth png"),
        file(encode_rvl_depth(scene_depth()), "16UC1; compressedDepth rvl"),
    ],
    ids=["png", "old png", "unnamed", "plain png", "compressed png", "png without header", "rvl"],
)
def test_compressed_depth_is_read_in_all_its_dresses(message: CompressedImage) -> None:
    """PNG or RVL, with or without the header of 12 bytes, whatever the name says."""
    np.testing.assert_allclose(decode_depth(message), scene_depth() / 1000, rtol=1e-6)
    assert image_size(message) == (60, 80)


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_compressed_float_depth_is_inverse_depth(codec: str) -> None:
    """32FC1 is sent as v = A / depth + B, with B below 0 for a range of 10 m; v = 0 is missing all the same."""
    a, b = 10100.0, 1.0 - 10100.0 / 10.0
    steps = np.array([[0, 1, 9091], [41, 4041, 60000]], np.uint16)
    header = struct.pack("<iff", 0, a, b)
    body = encode(".png", steps) if codec == "png" else struct.pack("<II", 3, 2) + encode_rvl(steps)
    depth = decode_depth(file(header + body, f"32FC1; compressedDepth {codec}"))
    expected = [[0, 10.0, 1.0], [a / 1050, 2.0, a / 61009]]
    np.testing.assert_allclose(depth, np.array(expected, np.float32), rtol=1e-6)


def test_inverse_depth_beyond_infinity_is_missing() -> None:
    """v <= B has no distance."""
    body = struct.pack("<iffII", 0, 1000.0, 10.0, 3, 1) + encode_rvl(np.array([5, 10, 510], np.uint16))
    np.testing.assert_allclose(decode_depth(file(body, "32FC1; compressedDepth rvl")), [[0, 0, 2.0]], rtol=1e-6)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (raw(RGB, "rgb8"), "`rgb8` is no depth encoding"),
        (raw(RGB, "64FC1"), "`64FC1` is no depth encoding"),
        (file(encode_jpeg(scene())), "a jpeg file with 3 x 8 bits"),
        (file(encode(".png", scene()[:, :, 0])), "a png file with 1 x 8 bits"),
        (file(encode(".png", scene().astype(np.uint16))), "a png file with 3 x 16 bits"),
        (file(b"", "16UC1; compressedDepth png"), "error: unpack_from"),
        (file(bytes(12), "16UC1; compressedDepth png"), "which is no JPEG, PNG or WebP"),
        (file(bytes(30), "16UC1; compressedDepth rvl"), "0 x 0 is not between"),
    ],
)
def test_what_is_no_depth_image_is_refused(message: Image | CompressedImage, reason: str) -> None:
    """Colour in the place of depth would otherwise become a map."""
    with pytest.raises(ImageError, match=reason):
        decode_depth(message)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (raw(DEPTH_MM, "16UC1"), "`16UC1` is no colour encoding"),
        (raw(DEPTH_MM, "h264"), "`h264` is no colour encoding"),
        (file(encode_rvl_depth(DEPTH_MM), "16UC1; compressedDepth rvl"), "holds depth, not colour"),
        (file(b"GIF89a......"), "starts with `47 49 46"),
        (file(b""), "no JPEG, PNG or WebP"),
    ],
)
def test_what_is_no_colour_image_is_refused(message: Image | CompressedImage, reason: str) -> None:
    """By name, with the frame it came from."""
    with pytest.raises(ImageError, match=reason) as caught:
        decode_colour(message)
    assert "frame `camera`" in caught.value.message


# -------------------------------------------------------------------------------------------------------- damage


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_cut_anywhere_is_refused(progressive: int) -> None:
    """OpenCV fills the rest of a cut JPEG with grey; here the end marker has to be there."""
    jpeg = encode(".jpg", scene(), cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    decode_colour(file(jpeg))
    decode_colour(file(jpeg + b"\x00" * 7))  # some cameras pad
    for cut in range(0, len(jpeg) - 1, 7):
        with pytest.raises(ImageError):
            decode_colour(file(jpeg[:cut]))


def test_a_cut_jpeg_with_a_thumbnail_is_refused() -> None:
    """The end marker of a thumbnail inside the header does not count."""
    jpeg, thumbnail = encode_jpeg(scene()), encode_jpeg(scene(8, 8))
    block = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    decode_colour(file(jpeg[:2] + block + jpeg[2:]))
    with pytest.raises(ImageError, match="without an end marker"):
        decode_colour(file((jpeg[:2] + block + jpeg[2:])[:-40]))


@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_a_png_or_webp_cut_anywhere_is_refused(suffix: str) -> None:
    """Every prefix but the whole."""
    data = encode(suffix, scene(20, 30))
    for cut in range(0, len(data) - 1, 11):
        with pytest.raises(ImageError):
            decode_colour(file(data[:cut]))


def test_a_png_is_checked_before_it_is_decoded() -> None:
    """The place of the damage is named."""
    data = bytearray(encode_png_depth(scene_depth()))
    data[100] ^= 1
    with pytest.raises(ImageError, match="the PNG file is damaged near byte"):
        decode_depth(file(bytes(data), "16UC1; compressedDepth png"))


def test_a_png_with_any_flipped_byte_is_refused_or_unchanged() -> None:
    """No wrong depth gets through: the checksum of every chunk is compared."""
    depth = scene_depth(20, 30)
    data = encode_png_depth(depth)
    for at in range(12, len(data)):
        damaged = data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]
        with contextlib.suppress(ImageError):
            np.testing.assert_allclose(decode_depth(file(damaged, "compressedDepth")), depth / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    "message",
    [
        Image(0, "camera", 2**31, 2**31, "rgb8", 0, False, b""),
        Image(0, "camera", 480, 640, "rgb8", 0, False, bytes(1000)),
        Image(0, "camera", 480, 640, "rgb8", 100, False, bytes(921_600)),
        Image(0, "camera", 0, 640, "rgb8", 1920, False, b""),
        Image(0, "camera", 2, 3, "rgb8", 2**31, False, bytes(100)),
        file(b"\x89PNG\r\n\x1a\n" + b"\x00\x00\x00\x00IEND\xae\x42\x60\x82"),
    ],
)
def test_absurd_sizes_are_refused_before_anything_is_allocated(message: Image | CompressedImage) -> None:
    """The size a header claims is compared with the bytes that are there."""
    tracemalloc.start()
    with pytest.raises(ImageError):
        decode_colour(message)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def png_claiming(width: int, height: int) -> bytes:
    """A sound PNG of 60 bytes or so that claims a size."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_files_that_claim_more_pixels_than_they_can_hold_are_refused() -> None:
    """Deflate and JPEG have a limit to how much they expand; the cap of 256 megapixels holds for the rest."""
    with pytest.raises(ImageError, match="cannot hold the 16000 x 16000"):
        decode_depth(file(png_claiming(16_000, 16_000)))
    jpeg = bytearray(encode_jpeg(scene()))
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = struct.pack(">HH", 16_000, 16_000)
    with pytest.raises(ImageError, match="cannot hold the 16000 x 16000"):
        decode_colour(file(bytes(jpeg)))
    rvl = bytes(12) + struct.pack("<II", 2**20, 2**20) + bytes(64)
    with pytest.raises(ImageError, match="is not between 1 and"):
        decode_depth(file(rvl, "16UC1; compressedDepth rvl"))


SAMPLES = [
    raw(RGB, "rgb8"),
    raw(DEPTH_MM, "16UC1"),
    file(encode_jpeg(scene(16, 16))),
    file(encode(".png", scene(8, 8))),
    file(encode(".webp", scene(8, 8))),
    file(encode_png_depth(scene_depth(8, 8)), "16UC1; compressedDepth png"),
    file(encode_rvl_depth(scene_depth(8, 8)), "16UC1; compressedDepth rvl"),
]


@given(
    st.sampled_from(SAMPLES),
    st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 255)), max_size=5),
    st.integers(0, 4000),
)
@settings(max_examples=200, deadline=None)
def test_damage_raises_one_kind_of_error(
    sample: Image | CompressedImage, edits: list[tuple[int, int]], cut: int
) -> None:
    """Cuts and flips in every kind of image: pixels or an ImageError, never anything else."""
    data = bytearray(sample.data)
    for at, value in edits:
        data[at % len(data)] = value
    changed = bytes(data[: max(1, cut)])
    if isinstance(sample, Image):
        message: Image | CompressedImage = Image(
            0, "c", sample.height, sample.width, sample.encoding, 0, False, changed
        )
    else:
        message = file(changed, sample.format)
    for decode in (decode_colour, decode_depth, image_size):
        with contextlib.suppress(ImageError):
            decode(message)


# ----------------------------------------------------------------------------------------------------------- RVL


def test_rvl_words_written_by_hand_decode() -> None:
    """Two zeros, then 3 pixels 5, 4, 104: nibbles 2, 3, folded differences 10, 1, 200."""
    nibbles = [2, 3, 0b1010, 1, 1, 0b1000, 0b1001, 3]  # 10 = 001 010, 200 = 011 001 000, low digits first
    word = int("".join(f"{nibble:x}" for nibble in nibbles), 16)
    payload = struct.pack("<I", word)
    np.testing.assert_array_equal(decode_rvl(payload, 5), [0, 0, 5, 4, 104])
    assert encode_rvl(np.array([0, 0, 5, 4, 104], np.uint16)) == payload


@given(
    arrays.arrays(
        np.uint16,
        st.tuples(st.integers(0, 9), st.integers(0, 9)),
        elements=st.sampled_from([0, 0, 0, 1, 2, 500, 501, 65535]) | st.integers(0, 65535),
    )
)
@FAST
def test_rvl_round_trips_any_image(depth: NDArray[np.uint16]) -> None:
    """Empty, all zero, full, alternating, extreme."""
    np.testing.assert_array_equal(decode_rvl(encode_rvl(depth), depth.size), depth.ravel())


@given(st.binary(max_size=64), st.integers(0, 400))
@settings(max_examples=200, deadline=None)
def test_rvl_refuses_any_rubbish(payload: bytes, pixels: int) -> None:
    """An image of the right size or an RvlError."""
    with contextlib.suppress(RvlError):
        depth = decode_rvl(payload, pixels)
        assert depth.shape == (pixels,)


def test_rvl_cut_or_of_another_size_is_refused() -> None:
    """Whole words are missing, half a word is missing, or the runs do not add up to the image."""
    depth = scene_depth()
    payload = encode_rvl(depth)
    for cut in range(0, len(payload) - 1, 13):
        with pytest.raises(RvlError):
            decode_rvl(payload[:cut], depth.size)
    for pixels in (depth.size - 1, depth.size + 1, 10 * depth.size):
        with pytest.raises(RvlError):
            decode_rvl(payload, pixels)


@pytest.mark.parametrize("folded", [0, 1])
def test_rvl_values_outside_their_range_are_refused(folded: int) -> None:
    """A pixel of a non-zero run cannot be 0, nor less."""
    with pytest.raises(RvlError, match="out of 1 to 65535"):
        decode_rvl(struct.pack("<I", int(f"01{folded}00000", 16)), 1)


def test_an_rvl_image_of_vga_size_decodes_in_milliseconds() -> None:
    """No loop over pixels: well under the 33 ms between two frames."""
    depth = scene_depth(480, 640)
    payload = encode_rvl(depth)
    decode_rvl(payload, depth.size)
    times = []
    for _ in range(5):
        start = time.process_time()
        decode_rvl(payload, depth.size)
        times.append(time.process_time() - start)
    assert min(times) < 0.030


# ------------------------------------------------------------------------------------------------------ real log

SHARED = os.environ.get("SEMSLAM_TEST_DATA", "")


@pytest.mark.skipif(not SHARED, reason="SEMSLAM_TEST_DATA does not name the folder of shared test logs")
def test_the_images_of_a_real_recording_decode() -> None:
    """The kitchen log: JPEG colour and PNG depth, 640 x 480, at indoor distances; RVL gives the same depth."""
    with (Path(SHARED) / "logs" / "redkitchen.mcap").open("rb") as stream:
        seen: dict[str, list[CompressedImage]] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is not None and "CompressedImage" in schema.name and message.log_time % 10 == 0:
                source = Channel(channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding, {})
                image = decoder_for(source)(message.data)
                assert isinstance(image, CompressedImage)
                seen.setdefault(channel.topic, []).append(image)
    for image in seen["/camera/color/image_raw/compressed"][:10]:
        assert decode_colour(image).shape == (480, 640, 3)
    for image in seen["/camera/depth/image_raw/compressedDepth"][:10]:
        depth = decode_depth(image)
        measured = depth[depth > 0]
        assert measured.size > depth.size / 2
        assert 0.3 < np.median(measured) < 5.0
        steps = np.rint(depth * 1000).astype(np.uint16)
        again = decode_depth(file(encode_rvl_depth(steps), "16UC1; compressedDepth rvl"))
        np.testing.assert_array_equal(again, depth)
