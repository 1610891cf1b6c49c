"""Pictures to learn from: what is stored comes back, and what randomisation does to a picture it does to its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semslam.errors import SemslamError
from semslam.models.training.augment import Strength, moved, pasted, photographed, randomised, recoloured
from semslam.models.training.pictures import Picture, PictureSet, SeenObject, resized
from semslam.tables.parquet import TableFiles, write_table
from semslam.tables.spec import VIEWS
from tests.views_factory import NAMES, box_picture, write_views


def box_of(picture: Picture, item: SeenObject) -> tuple[int, int, int, int]:
    """The box of an object's pixels."""
    rows, columns = np.nonzero(picture.instances == item.instance)
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1


def test_views_come_back_as_they_were_written(tmp_path: Path) -> None:
    """Colour, instances, boxes and classes exactly, depth to the millimetre."""
    views = PictureSet.open(write_views(tmp_path, homes=2, views=3))
    assert len(views) == 6
    assert views.class_names == NAMES
    picture, was = views[4], box_picture(101)
    np.testing.assert_array_equal(picture.rgb, was.rgb)
    np.testing.assert_array_equal(picture.instances, was.instances)
    np.testing.assert_allclose(picture.depth_m, was.depth_m, atol=5e-4)
    assert picture.objects == was.objects
    assert views.classes_of[4] == {item.class_id for item in was.objects}


def test_an_empty_folder_says_what_to_type(tmp_path: Path) -> None:
    """No views: the error names the command that makes some."""
    with pytest.raises(SemslamError) as caught:
        PictureSet.open(tmp_path)
    assert "semslam train pictures" in (caught.value.hint or "")


def test_other_views_have_another_digest(tmp_path: Path) -> None:
    """A training can tell that its pictures have changed."""
    one = PictureSet.open(write_views(tmp_path, homes=1)).digest
    assert PictureSet.open(tmp_path).digest == one
    assert PictureSet.open(write_views(tmp_path, homes=2)).digest != one


@pytest.mark.parametrize("seed", range(12))
def test_boxes_follow_their_pixels_through_zoom_shift_and_mirror(seed: int) -> None:
    """After a warp every object's box is that of its pixels, to a pixel and a half."""
    rng = np.random.default_rng(seed)
    picture = moved(box_picture(seed, objects=2), rng, 1.0)
    for item in picture.objects:
        if item.pixels and (picture.instances == item.instance).sum() > 30:
            found = box_of(picture, item)
            np.testing.assert_allclose(found, (item.left, item.top, item.right, item.bottom), atol=1.6)


@pytest.mark.parametrize("seed", range(6))
def test_pasted_objects_hide_what_is_behind_them_and_only_that(seed: int) -> None:
    """The nearer surface wins at every pixel, and boxes and shares are those of what is left to see."""
    first, second = box_picture(seed), box_picture(seed + 50)
    picture = pasted(first, second, np.random.default_rng(seed))
    assert (picture.depth_m <= first.depth_m).all()
    changed = picture.instances != first.instances
    assert changed.any() or all(item.cut for item in second.counting)
    np.testing.assert_array_equal(picture.rgb[~changed], first.rgb[~changed])
    for item in picture.objects:
        assert box_of(picture, item) == (item.left, item.top, item.right, item.bottom)
        assert item.pixels == (picture.instances == item.instance).sum()
    before = {item.instance: item for item in first.objects}
    for item in picture.objects:
        if item.instance in before and item.pixels < 0.9 * before[item.instance].pixels:
            assert item.share < before[item.instance].share


def test_recolouring_changes_colours_and_nothing_else() -> None:
    """Objects get colours of their own: edges between them stay, truth is untouched."""
    picture = box_picture(3)
    rgb = recoloured(picture, np.random.default_rng(1))
    assert rgb.shape == picture.rgb.shape
    assert np.abs(rgb * 255 - picture.rgb).max() > 20
    assert rgb.min() >= 0
    assert rgb.max() <= 1


def test_randomised_pictures_depend_on_the_generator_alone() -> None:
    """The same seed gives the same picture, another one another."""
    first, other = box_picture(1), box_picture(2)
    one, two, three = (randomised(first, other, np.random.default_rng(seed), Strength()) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.rgb, two.rgb)
    np.testing.assert_array_equal(one.depth_m, two.depth_m)
    assert one.objects == two.objects
    assert not np.array_equal(one.rgb, three.rgb)


def test_strength_zero_leaves_a_picture_alone() -> None:
    """Nothing changes when nothing is asked for."""
    picture = box_picture(1)
    same = randomised(picture, None, np.random.default_rng(0), Strength(0, 0, 0, 0, 0))
    np.testing.assert_array_equal(same.rgb, picture.rgb)
    np.testing.assert_array_equal(same.depth_m, picture.depth_m)
    assert same.objects == picture.objects


def test_photographs_stay_pictures() -> None:
    """However light, blur and noise fall, values stay between black and white and are numbers."""
    rgb = box_picture(1).rgb.astype(np.float32) / 255
    for seed in range(40):
        shot = photographed(rgb, np.random.default_rng(seed), 1.0)
        assert np.isfinite(shot).all()
        assert shot.min() >= 0
        assert shot.max() <= 1


def test_what_counts_scales_with_the_picture() -> None:
    """An object that counts at one size counts at another."""
    picture = box_picture(4, width=640, height=480)
    small = resized(picture, 320, 240)
    assert len(small.objects) == len(picture.objects)
    assert [item.instance for item in small.counting] == [item.instance for item in picture.counting]


def test_ids_without_an_object_are_never_taken_for_one() -> None:
    """People and slivers have pixels and no entry; a pasted object gets an id that nobody has."""
    picture, other = box_picture(1), box_picture(2)
    instances = picture.instances.copy()
    instances[:10, :10] = 4  # the next free one, as far as the entries tell
    mixed = pasted(Picture(picture.rgb, picture.depth_m, instances, picture.objects), other, np.random.default_rng(0))
    for item in mixed.objects:
        assert box_of(mixed, item) == (item.left, item.top, item.right, item.bottom)


def test_an_object_cut_by_the_picture_s_edge_has_the_pixels_that_are_left() -> None:
    """Not those of an evenly filled box; its share falls with them."""
    for seed in range(20):
        picture = box_picture(seed, objects=2)
        for item in moved(picture, np.random.default_rng(seed), 1.5).objects:
            before = next(one for one in picture.objects if one.instance == item.instance)
            if item.cut:
                assert item.share < 1
            assert item.share <= before.share


@pytest.mark.parametrize("size", [(384, 288), (448, 336), (320, 240), (256, 192)])
def test_masks_shrink_about_their_middle(size: tuple[int, int]) -> None:
    """The truth of a smaller picture lies where its boxes do, to half a pixel."""
    picture = resized(box_picture(5, width=640, height=480, objects=2), *size)
    for item in picture.objects:
        np.testing.assert_allclose(box_of(picture, item), (item.left, item.top, item.right, item.bottom), atol=0.51)


def spoil(folder: Path, column: str, value: Any, meta: dict[str, Any] | None = None) -> None:
    """Write the first home's views again with another value in the first row of a column."""
    path = sorted(folder.glob("*.parquet"))[0]
    file = TableFiles(VIEWS, [path])
    columns = {name: list(values) for name, values in file.read().items()}
    if column:
        columns[column][0] = value
    write_table(path, VIEWS, columns, file.meta if meta is None else meta)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("class_id", [0, 1, 2]),
        ("class_id", [-1, 0, 0]),
        ("class_id", [0]),
        ("boxes_px", [1.0] * 11),
        ("boxes_px", [float("nan")] * 12),
        ("share", []),
    ],
)
def test_views_that_contradict_themselves_are_refused_at_once(tmp_path: Path, column: str, value: Any) -> None:
    """Not at the step, hours later, that draws the view; the hint says what to remove."""
    spoil(write_views(tmp_path), column, value)
    with pytest.raises(SemslamError, match="contradict") as caught:
        PictureSet.open(tmp_path)
    assert "remove" in (caught.value.hint or "")


def test_views_without_class_names_are_refused(tmp_path: Path) -> None:
    """As are such with none."""
    for meta in ({}, {"classes": []}):
        spoil(write_views(tmp_path), "", None, meta)
        with pytest.raises(SemslamError, match="holds no views"):
            PictureSet.open(tmp_path)


@pytest.mark.parametrize("column", ["colour", "depth", "instances"])
def test_a_picture_that_is_none_is_one_clear_error(tmp_path: Path, column: str) -> None:
    """Empty bytes, as a full disk leaves them."""
    spoil(write_views(tmp_path), column, b"")
    with pytest.raises(SemslamError):
        PictureSet.open(tmp_path)[0]


def test_a_damaged_file_says_what_to_do(tmp_path: Path) -> None:
    """The hint is about views, not about results of a run."""
    path = next(write_views(tmp_path).glob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(SemslamError) as caught:
        PictureSet.open(tmp_path)
    assert "train pictures" in (caught.value.hint or "")


def test_views_without_any_object_teach_nothing(tmp_path: Path) -> None:
    """And are refused."""
    with pytest.raises(SemslamError, match="shows an object"):
        PictureSet.open(write_views(tmp_path, objects=0))
