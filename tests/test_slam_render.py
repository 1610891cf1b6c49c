"""The map picture: read back from its PNG, pixel by pixel where it matters."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.labels import FREE_FLOOR, OBSTACLE, class_list
from semslam.slam import palette
from semslam.slam.palette import OBJECTS, class_colours
from semslam.slam.panel import LEFT, TOP, fit_view
from semslam.slam.picture import MapCells, Path
from semslam.slam.render import render_map

CLASSES = class_list(("chair", "dining table", "zebra", "giraffe"))
NOWHERE = Path(np.zeros(0), np.zeros(0))


def cells_of(entries: dict[tuple[int, int], int], classes: tuple[str, ...] = CLASSES) -> MapCells:
    places = np.array(list(entries), np.int64).reshape(-1, 2)
    return MapCells(places[:, 0], places[:, 1], np.array(list(entries.values()), np.int64), classes, 0.1)


def room() -> MapCells:
    """Free floor with a wall, a chair and a table."""
    entries = {(x, y): FREE_FLOOR for x in range(-20, 30) for y in range(-15, 25)}
    entries |= {(x, 25): OBSTACLE for x in range(-20, 30)}
    entries |= {(x, y): 3 for x in range(5, 10) for y in range(5, 10)}
    entries |= {(x, y): 4 for x in range(15, 25) for y in range(-5, 3)}
    return cells_of(entries)


def decoded(png: bytes) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, np.uint8)


def colour_at(image: NDArray[np.uint8], cells: MapCells, path: Path, x_m: float, y_m: float) -> tuple[int, ...]:
    column, row = np.rint(fit_view(cells, path, 0).pixels(np.array([[x_m, y_m]]))[0]).astype(int)
    return tuple(image[row, column].tolist())


def test_every_kind_of_cell_has_its_colour_at_its_place() -> None:
    """y points up, x to the right."""
    cells = room()
    image = decoded(render_map(cells, NOWHERE, "room", "test"))
    colours = class_colours(["chair", "dining table"])
    places = {
        (-1.15, -0.65): palette.FREE, (-0.65, 2.55): palette.OBSTACLE, (0.57, 0.57): colours["chair"],
        (1.62, -0.43): colours["dining table"], (-2.2, 0.55): palette.UNKNOWN,
    }  # fmt: skip
    for (x, y), colour in places.items():
        assert colour_at(image, cells, NOWHERE, x, y) == colour


def test_the_picture_has_the_size_of_a_slide() -> None:
    """About 1000 to 1400 pixels for maps of any proportion."""
    for width, height in ((50, 40), (400, 20), (20, 400), (3, 3), (2000, 1500)):
        cells = cells_of({(0, 0): FREE_FLOOR, (width, height): OBSTACLE})
        rows, columns, _ = decoded(render_map(cells, NOWHERE, "t", "s")).shape
        assert 900 <= columns <= 1420
        assert 600 <= rows <= 1100


def test_the_path_is_drawn_over_the_map_and_broken_where_poses_are_missing() -> None:
    """Full width along known poses, thin across a gap."""
    cells = room()
    x = np.array([-1.0, 0.0, 1.0, np.nan, 2.0, 2.5])
    path = Path(x, np.where(np.isnan(x), np.nan, -1.0))
    image = decoded(render_map(cells, path, "room", "test"))

    def width(x_m: float) -> float:
        """Pixels of ink across the path; the track has no green, the floor is white."""
        column, row = np.rint(fit_view(cells, path, 0).pixels(np.array([[x_m, -1.0]]))[0]).astype(int)
        return float((255.0 - image[row - 8 : row + 9, column, 1]).sum() / 255)

    assert width(0.62) > width(1.35) + 0.7
    assert width(1.35) > 1.0
    assert path.length_m == pytest.approx(3.5)


def test_same_input_same_bytes() -> None:
    """Pictures are part of the results that runs are compared by."""
    path = Path(np.array([0.0, 1.0, 1.5]), np.array([0.0, 0.3, -0.2]))
    assert render_map(room(), path, "room", "test") == render_map(room(), path, "room", "test")


def test_an_empty_map_still_gives_a_picture() -> None:
    """With words in the middle of the panel, and no crash without poses."""
    image = decoded(render_map(cells_of({}), NOWHERE, "kitchen_02", "0 keyframes"))
    view = fit_view(cells_of({}), NOWHERE, 0)
    panel = image[TOP : TOP + view.height, LEFT : LEFT + view.width]
    middle = panel[view.height // 2 - 20 : view.height // 2 + 2]
    assert (np.abs(middle.astype(int) - palette.INK).sum(2) < 60).sum() > 300


def test_a_path_torn_far_apart_does_not_need_memory() -> None:
    """A jump of a thousand kilometres gives an ugly picture of the usual size."""
    path = Path(np.array([0.0, 1e6]), np.array([0.0, 0.0]))
    rows, columns, _ = decoded(render_map(room(), path, "torn", "test")).shape
    assert columns <= 1420
    assert rows <= 1100


def test_objects_survive_thinning() -> None:
    """On a map with many cells a pixel, a single object cell is still painted over floor."""
    entries = {(x, 0): FREE_FLOOR for x in range(6000)}
    entries[(3000, 0)] = 3
    cells = cells_of(entries)
    image = decoded(render_map(cells, NOWHERE, "long", "test"))
    view = fit_view(cells, NOWHERE, 0)
    panel = image[TOP : TOP + view.height, LEFT : LEFT + view.width]
    assert (panel == class_colours(["chair"])["chair"]).all(2).any()


def test_pixels_per_cell_can_be_chosen() -> None:
    """And is ignored where the picture would become enormous."""
    assert fit_view(room(), NOWHERE, 30).scale == 30
    huge = cells_of({(0, 0): FREE_FLOOR, (5000, 5000): FREE_FLOOR})
    assert fit_view(huge, NOWHERE, 30).scale < 1


def test_a_class_keeps_its_colour_from_picture_to_picture() -> None:
    """Known names always, others unless their colour is taken; no two classes of sixteen share one."""
    assert class_colours(["chair"])["chair"] == class_colours(["chair", "bed", "zebra"])["chair"]
    assert class_colours(["zebra"])["zebra"] in OBJECTS
    assert class_colours(["diningtable"])["diningtable"] == class_colours(["dining table"])["dining table"]
    names = [f"thing {i}" for i in range(12)] + ["chair", "bed", "tv", "sink"]
    assert len(set(class_colours(names).values())) == 16
    assert class_colours(names) == class_colours(reversed(names))
    assert len(class_colours([f"thing {i}" for i in range(40)])) == 40


def test_object_colours_differ_from_each_other_and_from_the_background() -> None:
    """At least 45 of 441 apart in RGB."""
    colours = [*OBJECTS, palette.FREE, palette.UNKNOWN, palette.OBSTACLE, palette.TRACK]
    for i, one in enumerate(colours):
        for other in colours[:i]:
            close = {one, other} == {palette.FREE, palette.UNKNOWN}
            assert np.linalg.norm(np.subtract(one, other)) > (35 if close else 45), (one, other)


def test_many_classes_are_cut_with_a_word() -> None:
    """The legend does not run off the picture."""
    names = class_list([f"thing number {i} with a very long name indeed" for i in range(60)])
    cells = cells_of({(i, j): 3 + i for i in range(60) for j in range(3)}, names)
    rows, _, _ = decoded(render_map(cells, NOWHERE, "x" * 300, "y" * 300)).shape
    assert rows < 1200
