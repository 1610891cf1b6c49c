"""Views of simulated homes: true to their pixels, kept when the command comes again, never mixed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra [sim]")

from semslam.errors import SemslamError
from semslam.models.training.pictures import CLASSES, PictureSet
from semslam.sim.home import CLASSES as HOME_CLASSES
from semslam.sim.views import ViewRecipe, file_of, make_views

RECIPE = ViewRecipe(homes=1, views=3, seed=4321)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views of one home."""
    out = tmp_path_factory.mktemp("views")
    report = make_views(out, RECIPE, workers=0)
    assert (report.done, report.cached, report.failures) == (1, 0, {})
    return out


def test_boxes_are_those_of_the_pixels(drawn: Path) -> None:
    """Every object in view has the box and the number of its pixels; no object is left out."""
    views = PictureSet.open(drawn)
    assert len(views) == 3
    for index in range(3):
        picture = views[index]
        assert len(picture.objects) >= 2
        for item in picture.objects:
            left, top, width, height = cv2.boundingRect((picture.instances == item.instance).astype(np.uint8))
            assert (item.left, item.top, item.right, item.bottom) == (left, top, left + width, top + height)
            assert item.pixels == (picture.instances == item.instance).sum()
            assert 0 < item.share <= 1
        ids, counts = np.unique(picture.instances[picture.instances > 0], return_counts=True)
        assert set(ids[counts >= 40].tolist()) <= {item.instance for item in picture.objects}


def test_depth_and_colour_belong_together(drawn: Path) -> None:
    """Most pixels have a depth of a room."""
    picture = PictureSet.open(drawn)[0]
    assert picture.rgb.shape == (480, 640, 3)
    assert picture.depth_m.shape == (480, 640)
    known = picture.depth_m[picture.depth_m > 0]
    assert known.size > 0.5 * picture.depth_m.size
    assert 0.3 <= known.min() <= known.max() <= 8.1


def test_what_is_there_is_kept(drawn: Path) -> None:
    """The same command again draws nothing."""
    before = file_of(drawn, 4321000).stat().st_mtime_ns
    report = make_views(drawn, RECIPE, workers=0)
    assert (report.done, report.cached) == (0, 1)
    assert file_of(drawn, 4321000).stat().st_mtime_ns == before


def test_other_options_need_another_folder(drawn: Path, tmp_path: Path) -> None:
    """Sets are never mixed; the error says what differs."""
    with pytest.raises(SemslamError, match="seed 4321 -> 7"):
        make_views(drawn, ViewRecipe(homes=1, views=3, seed=7), workers=0)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SemslamError, match="holds no views"):
        make_views(tmp_path, RECIPE, workers=0)


@pytest.mark.parametrize("wrong", [{"homes": 0}, {"homes": 1001}, {"views": 0}, {"seed": -1}])
def test_impossible_numbers_are_refused(wrong: dict[str, int]) -> None:
    """One clear error with the range."""
    with pytest.raises(SemslamError, match="--") as caught:
        ViewRecipe(**wrong)
    assert "from" in (caught.value.hint or "")


def test_the_classes_of_random_networks_are_those_of_the_homes() -> None:
    """One list, in one order."""
    assert CLASSES == HOME_CLASSES
