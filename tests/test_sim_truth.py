"""The truth about a simulated home: its class map, what of it has been visible, and perfect observations."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.frames import SE2, matrix_from_pose, planar
from semslam.geometry.grid import pool_observation, to_dense
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED, class_list
from semslam.sim import truth
from semslam.sim.home import CLASSES, Home, Placed
from semslam.sim.log import LogOptions, record_log
from semslam.sim.truth import Grid, Ground, TruthCollector, cell_classes, write_truth
from semslam.stages.settings import ExtractConfig
from semslam.tables.parquet import TableFiles
from semslam.tables.spec import HOME_OBJECTS, OBSERVATIONS, TRUTH, Table
from semslam.tables.true_map import NEVER, TrueMap, map_at, read_true_map
from tests.sim_box import HALF_X_M, HALF_Y_M, BoxDrive, BoxEye, BoxRobot, box_drive, box_home, box_piece

OPTIONS = LogOptions(size=(320, 240))
FRAMES = 8
FILES = ["home_objects", "ideal", "obstructed", "true_map", "truth"]


def collect(home: Home, drive: BoxDrive) -> TruthCollector:
    """See a whole drive, without a log."""
    collector, eye = TruthCollector(home, drive, OPTIONS.camera), BoxEye(home, OPTIONS.camera)  # type: ignore[arg-type]
    for index, time_s in enumerate(drive.keyframes_s.tolist()):
        pose = drive.world_from_base(time_s) @ BoxRobot().base_from_camera
        collector.see(index, 1000 + index, eye.look(pose, time_s), pose)  # type: ignore[arg-type]
    return collector


def write(folder: Path, home: Home, drive: BoxDrive) -> Path:
    """The folder, with all tables."""
    write_truth(folder, home, BoxRobot(), drive, collect(home, drive))  # type: ignore[arg-type]
    return folder


def read(folder: Path, name: str, table: Table) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """Columns and metadata of a file."""
    files = TableFiles(table, [folder / f"{name}.parquet"])
    return files.read(), dict(files.meta)


def observations(folder: Path, name: str) -> list[NDArray[np.float32]]:
    """Planes of every keyframe."""
    rows, meta = read(folder, name, OBSERVATIONS)
    shape = len(meta["classes"]), meta["side"], meta["side"]
    return [
        to_dense(np.array(cells), np.array(weights), shape)
        for cells, weights in zip(rows["cells"], rows["weights"], strict=True)
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Truth of a drive through the home of boxes."""
    return write(tmp_path_factory.mktemp("truth") / "home_00_t0", box_home(), box_drive(FRAMES))


@pytest.fixture(scope="module")
def fine(folder: Path) -> TrueMap:
    """Cells of 0.1 m."""
    return read_true_map(folder / "true_map.parquet", 0.1)


@pytest.fixture(scope="module")
def paper(folder: Path) -> TrueMap:
    """The grid of the paper."""
    return read_true_map(folder / "true_map.parquet")


def centres(found: TrueMap) -> NDArray[np.float64]:
    """(rows, columns, 2) cell centres in the world."""
    rows, columns = found.class_ids.shape
    x = found.origin_x_m + (np.arange(columns) + 0.5) * found.cell_m
    y = found.origin_y_m + (np.arange(rows) + 0.5) * found.cell_m
    start = planar(box_drive(FRAMES).world_from_base(box_drive(FRAMES).keyframes_s[0]))
    return start.apply(np.stack(np.meshgrid(x, y), -1))


def depth_inside(points: NDArray[np.float64], outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far (metres) points (..., 2) lie inside an outline; negative outside."""
    contour = outline.astype(np.float32)
    flat = [cv2.pointPolygonTest(contour, (float(x), float(y)), True) for x, y in points.reshape(-1, 2)]
    return np.array(flat).reshape(points.shape[:-1])


# ---------------------------------------------------------------------------------------------------- class map


@pytest.mark.parametrize("cell_m", [0.1, 0.3])
def test_the_class_map_agrees_with_the_footprints(folder: Path, cell_m: float) -> None:
    """A cell wholly inside an object has its class, one that no object reaches has none of an object."""
    found = read_true_map(folder / "true_map.parquet", cell_m)
    reach, points = cell_m / math.sqrt(2) + 0.01, centres(found)
    free = np.ones(found.class_ids.shape, bool)
    for item in box_home().objects:
        inside = depth_inside(points, item.footprint)
        assert (found.class_ids[inside > reach] == FIRST_OBJECT + item.class_id).all()
        assert cell_m > 0.2 or (inside > reach).any()
        free &= inside < -reach
    assert (found.class_ids[free] < FIRST_OBJECT).all()
    room = depth_inside(points, box_home().outline[0])
    assert (found.class_ids[free & (room > reach)] == FREE_FLOOR).all()
    assert (found.class_ids[room < -0.16 - reach] == UNOBSERVED).all()
    walls = (np.abs(room + 0.08) < 0.02) & (depth_inside(points, grown_room(0.16)) > 0.02)
    assert (found.class_ids[walls] == OBSTACLE).all()
    assert walls.any()


def grown_room(margin_m: float) -> NDArray[np.float64]:
    """The room with its walls."""
    x, y = HALF_X_M + margin_m, HALF_Y_M + margin_m
    return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])


def test_both_grids_lie_as_the_page_says(fine: TrueMap, paper: TrueMap) -> None:
    """The start in the middle of the middle cell of 33 x 33; fine cells counted from the origin, the whole home in."""
    assert paper.class_ids.shape == (33, 33)
    assert (paper.origin_x_m, paper.origin_y_m) == (-4.95, -4.95)
    assert centres(paper)[16, 16] == pytest.approx((-1.5, -0.5), abs=0.01)
    assert (fine.origin_x_m / 0.1) % 1 == pytest.approx(0.0, abs=1e-6)
    area = (fine.class_ids > OBSTACLE).sum() * 0.01
    covered = sum(item.piece.depth_m * item.piece.width_m for item in box_home().objects)
    assert covered < area < 1.25 * covered  # a quarter of a cell is enough
    floor = (fine.class_ids == FREE_FLOOR).sum() * 0.01
    assert floor == pytest.approx(30.0 - area, rel=0.05)
    assert fine.classes == class_list(box_home().classes)


@pytest.mark.parametrize(
    ("share", "expected"), [(0.0, FREE_FLOOR), (0.2, FREE_FLOOR), (0.3, FIRST_OBJECT), (1.0, FIRST_OBJECT)]
)
def test_an_object_takes_a_cell_from_a_quarter_on(share: float, expected: int) -> None:
    """Less is free floor still."""
    low = 0.5 - share * 0.3
    chair = Placed(1, box_piece("chair", 1.0, 2.0, 0.9), low + 0.5, 0.0, 0.0)
    ground = Ground.of(box_home((chair,) if share else ()))
    assert cell_classes(ground, SE2(0.2, 0.0, 0.0), Grid(0.3, 1, 1, 0.0, -0.15))[0, 0] == expected


def test_a_thin_wall_never_vanishes() -> None:
    """Wherever a wall of 10 cm lies on the grid of 30 cm, it fills a row of cells."""
    home = box_home(())
    for offset in np.linspace(0.0, 0.3, 13):
        wall = replace(
            home.fixtures[0], footprint=np.array([(-2, offset), (2, offset), (2, offset + 0.1), (-2, offset + 0.1)])
        )
        cells = cell_classes(
            Ground.of(replace(home, fixtures=(wall,))), SE2(0.0, 0.0, 0.0), Grid(0.3, 4, 10, -1.5, -0.6)
        )
        assert (cells == OBSTACLE).any(0).all(), offset


def test_the_smaller_of_two_objects_counts() -> None:
    """A tv on its bench, a chair under its table."""
    bench = Placed(1, box_piece("dresser", 0.5, 1.2, 0.5), 0.0, 0.0, 0.0)
    tv = Placed(2, box_piece("tv", 0.3, 0.8, 0.5), 0.0, 0.0, 0.0, 0.5)
    for order in ((bench, tv), (tv, bench)):
        ground = Ground.of(box_home(order))
        codes = ground.codes_at(np.array([0.0, 0.0]), np.array([0.0, 0.5]))
        assert [int(ground.class_of[code]) - FIRST_OBJECT for code in codes] == [tv.class_id, bench.class_id]


# ----------------------------------------------------------------------------------------------- visible so far


def test_what_is_visible_only_grows(fine: TrueMap, paper: TrueMap, folder: Path) -> None:
    """Every step holds what the step before held, with the true class; the first one holds something, no one all."""
    for found, cell_m in ((fine, 0.1), (paper, 0.3)):
        maps = [map_at(folder / "true_map.parquet", step, cell_m) for step in range(FRAMES)]
        for before, after in pairwise(maps):
            assert (after[before != UNOBSERVED] == before[before != UNOBSERVED]).all()
            assert (after != UNOBSERVED).sum() > (before != UNOBSERVED).sum()
        for step in maps:
            assert np.isin(step, [UNOBSERVED]).any()
            assert ((step == UNOBSERVED) | (step == found.class_ids)).all()
        assert (maps[0] != UNOBSERVED).sum() > 0.1 * (found.class_ids != UNOBSERVED).sum()
        assert (found.first_seen == NEVER).any()
        assert found.first_seen.max() == FRAMES - 1


def test_what_hides_behind_something_is_not_visible(fine: TrueMap) -> None:
    """Floor between sofa and wall, and the inside of the sofa, stay unseen; its front and floor before it do not."""
    points, seen = centres(fine), fine.at(FRAMES - 1)
    sofa = box_home().objects[0]
    behind = depth_inside(points, np.array([(2.55, 0.0), (2.95, 0.0), (2.95, 1.0), (2.55, 1.0)])) > 0
    assert (seen[behind] == UNOBSERVED).all()
    assert (seen[depth_inside(points, sofa.footprint) > 0.2] == UNOBSERVED).all()
    front = depth_inside(points, np.array([(1.57, -0.2), (1.63, -0.2), (1.63, 1.2), (1.57, 1.2)])) > 0
    assert (seen[front] == FIRST_OBJECT + sofa.class_id).mean() > 0.9
    before = depth_inside(points, np.array([(0.9, 0.0), (1.4, 0.0), (1.4, 0.9), (0.9, 0.9)])) > 0
    assert (seen[before] == FREE_FLOOR).all()


@pytest.mark.parametrize("shift", [0.0, 0.02, 0.04, 0.06, 0.08])
def test_walls_are_visible_wherever_they_lie_on_the_grid(shift: float) -> None:
    """A wall that is looked at becomes a row of obstacles, even where its front coincides with the border of cells."""
    home = box_home(())
    pose = np.eye(4)
    pose[0, 3] = shift
    level = {"world_from_base": lambda _: pose, "keyframes_s": np.array([0.4])}
    still: Any = type("Still", (), level)
    still.world_from_base = staticmethod(lambda _: pose)
    collector = TruthCollector(home, still, OPTIONS.camera)
    seen_from = pose @ BoxRobot().base_from_camera
    collector.see(0, 0, BoxEye(home, OPTIONS.camera).look(seen_from), seen_from)  # type: ignore[arg-type]
    for seen in collector.maps:
        grid = seen.grid
        column = math.floor((HALF_X_M - shift + 0.01 - grid.origin_x_m) / grid.cell_m)
        rows = [math.floor((y - grid.origin_y_m) / grid.cell_m) for y in np.arange(-1.5, 1.6, 0.1)]
        visible = seen.first_seen[rows][:, column : column + 2] == 0
        assert (visible & (seen.class_ids[rows][:, column : column + 2] == OBSTACLE)).any(1).all()


def test_people_are_in_no_map(tmp_path: Path, folder: Path) -> None:
    """Whoever walks through the view changes no class, and hides cells for that moment only."""
    home = box_home(walker=True)
    found = read_true_map(write(tmp_path / "walk", home, box_drive(FRAMES)) / "true_map.parquet", 0.1)
    empty = read_true_map(folder / "true_map.parquet", 0.1)
    assert np.array_equal(found.class_ids, empty.class_ids)
    assert not ((found.first_seen != NEVER) & (empty.first_seen == NEVER)).any()
    assert found.first_seen.tobytes() != empty.first_seen.tobytes()


def test_a_grid_that_is_not_there_is_an_error(folder: Path) -> None:
    """It says which there are."""
    with pytest.raises(SemslamError, match=r"no grid of 0\.2 m") as error:
        read_true_map(folder / "true_map.parquet", 0.2)
    assert "0.3, 0.1" in (error.value.hint or "")


# ------------------------------------------------------------------------------------------------- observations


def test_the_window_is_that_of_extract() -> None:
    """Same cells, ranges and heights as extract has by default."""
    config = ExtractConfig()
    assert (config.cell_m, config.side) == (truth.OBSERVATION_CELL_M, truth.OBSERVATION_SIDE)
    assert (config.min_depth_m, config.max_depth_m) == truth.DEPTH_M
    assert (config.floor_tolerance_m, config.max_height_m) == (truth.FLOOR_TOLERANCE_M, truth.MAX_HEIGHT_M)
    assert config.min_pixels == truth.MIN_PIXELS


def test_ideal_observations_are_the_map_around_the_robot(folder: Path, paper: TrueMap) -> None:
    """The first one, pooled to the grid of the paper, is the true map; a later one is the map turned and moved."""
    ideal = observations(folder, "ideal")
    for planes in ideal:
        assert (planes.sum(0) == 1.0).all()
    share = ideal[0].reshape(-1, 33, 3, 33, 3).mean((2, 4))  # fine cells of each class in a coarse one
    for class_id in range(FIRST_OBJECT, len(share)):
        assert (paper.class_ids[share[class_id] > 0.5] == class_id).all()
        assert (paper.class_ids[share[class_id] < 0.15] != class_id).all()
    assert (paper.class_ids[share[FREE_FLOOR] == 1.0] == FREE_FLOOR).all()
    assert (share[FIRST_OBJECT:] > 0.5).sum() > 20
    pooled = pool_observation(ideal[0], 3, 33)
    assert ((pooled[OBSTACLE] > 0) >= (paper.class_ids == OBSTACLE)).all()
    last, labels = planar(box_drive(FRAMES).world_from_base(box_drive(FRAMES).keyframes_s[-1])), ideal[-1].argmax(0)
    for item in box_home().objects:
        x, y = last.inverse().apply((item.x_m, item.y_m))
        assert labels[math.floor(y / 0.1 + 49.5), math.floor(x / 0.1 + 49.5)] == FIRST_OBJECT + item.class_id
    assert read(folder, "ideal", OBSERVATIONS)[0]["objects"] == [5] * FRAMES


def test_obstructed_observations_are_the_visible_part_of_the_ideal_ones(folder: Path) -> None:
    """Floor is floor, objects stand where they stand to one cell; and what is hidden or behind is unobserved."""
    for obstructed, ideal in zip(observations(folder, "obstructed"), observations(folder, "ideal"), strict=True):
        free = obstructed[FREE_FLOOR] > 0
        assert ideal[FREE_FLOOR][free].mean() > 0.97
        for plane, true in zip(obstructed[FIRST_OBJECT:], ideal[FIRST_OBJECT:], strict=True):
            near = cv2.dilate(true, np.ones((3, 3), np.uint8))
            assert (near[plane > 0.01] > 0).all()
        seen, there = obstructed[UNOBSERVED] == 0, ideal[UNOBSERVED] == 0
        assert 0.05 * there.sum() < seen.sum() < 0.7 * there.sum()
        assert not seen[:, :48].any()  # the camera looks ahead
        assert obstructed[FIRST_OBJECT:].sum((1, 2)).max() <= 1.0 + 1e-5


def test_obstructed_counts_the_objects_in_view(folder: Path) -> None:
    """As many as the pictures show."""
    rows, meta = read(folder, "obstructed", OBSERVATIONS)
    assert meta == {"classes": list(class_list(box_home().classes)), "cell_m": 0.1, "side": 99}
    drive, eye = box_drive(FRAMES), BoxEye(box_home(), OPTIONS.camera)
    for count, time_s in zip(rows["objects"], drive.keyframes_s.tolist(), strict=True):
        sight = eye.look(drive.world_from_base(time_s) @ BoxRobot().base_from_camera)
        near = sight.instances[(sight.depth_m > 0.3) & (sight.depth_m < 6.0)]
        assert count == (np.bincount(near, minlength=2)[1:] >= truth.MIN_MASK_PIXELS).sum()
    assert rows["stamp_nanos"] == list(range(1000, 1000 + FRAMES))


# -------------------------------------------------------------------------------------------------- files


def test_objects_and_poses_are_those_of_home_and_drive(folder: Path) -> None:
    """Every object with what it is and where; every keyframe with where the robot was."""
    rows, meta = read(folder, "home_objects", HOME_OBJECTS)
    objects = box_home().objects
    assert rows["label"] == [item.class_name for item in objects]
    assert [meta["classes"][class_id] for class_id in rows["class_id"]] == rows["label"]
    for k, item in enumerate(objects):
        assert np.array(rows["footprint"][k]).reshape(-1, 2) == pytest.approx(item.footprint)
        assert (rows["instance"][k], rows["x_m"][k], rows["height_m"][k]) == (
            item.instance,
            item.x_m,
            item.piece.height_m,
        )
    assert np.array(meta["base_from_camera"]).reshape(4, 4) == pytest.approx(BoxRobot().base_from_camera)
    assert np.array(meta["outline"]).reshape(-1, 2) == pytest.approx(box_home().outline[0])
    poses, _ = read(folder, "truth", TRUTH)
    expected = [box_drive(FRAMES)._pose(float(time)) for time in box_drive(FRAMES).keyframes_s]
    assert np.column_stack([poses["x_m"], poses["y_m"], poses["heading_rad"]]) == pytest.approx(np.array(expected))


def test_the_same_drive_gives_the_same_bytes(tmp_path: Path, folder: Path) -> None:
    """File by file."""
    again = write(tmp_path / "again", box_home(), box_drive(FRAMES))
    assert sorted(path.name for path in folder.iterdir()) == [f"{name}.parquet" for name in FILES]
    for name in FILES:
        assert (again / f"{name}.parquet").read_bytes() == (folder / f"{name}.parquet").read_bytes(), name


def test_a_collector_that_missed_keyframes_is_refused(tmp_path: Path) -> None:
    """Nothing is written."""
    home, drive = box_home(), box_drive(3)
    collector = TruthCollector(home, drive, OPTIONS.camera)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="0 of 3 keyframes"):
        write_truth(tmp_path / "truth", home, BoxRobot(), drive, collector)  # type: ignore[arg-type]
    assert not (tmp_path / "truth").exists()


def test_a_failure_leaves_no_half_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file in the making disappears, an older one of that name stays."""
    (tmp_path / "true_map.parquet").write_bytes(b"older")

    def full(path: Path, *_: Any) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(truth, "write_table", full)
    with pytest.raises(OSError, match="no space"):
        write(tmp_path, box_home(), box_drive(1))
    assert [path.name for path in tmp_path.iterdir()] == ["true_map.parquet"]
    assert (tmp_path / "true_map.parquet").read_bytes() == b"older"


def test_log_and_truth_are_made_in_one_go(tmp_path: Path) -> None:
    """The collector observes the recording, and its stamps are those of the log."""
    home, drive = box_home(), box_drive(2)
    robot: Any = BoxRobot()
    collector = TruthCollector(home, drive, OPTIONS.camera)  # type: ignore[arg-type]
    receipt = record_log(
        tmp_path / "log.mcap",
        home,
        robot,
        drive,  # type: ignore[arg-type]
        seed=1,
        options=OPTIONS,
        observer=collector.see,
        eye=BoxEye(home, OPTIONS.camera),  # type: ignore[arg-type]
    )
    write_truth(tmp_path / "truth", home, robot, drive, collector)  # type: ignore[arg-type]
    assert tuple(read(tmp_path / "truth", "truth", TRUTH)[0]["stamp_nanos"]) == receipt.stamps_nanos


def test_objects_as_drawn_stand_on_their_footprints() -> None:
    """What MuJoCo shows of a piece of every class lies within 5 cm of its outline, and on cells of that object."""
    pytest.importorskip("mujoco_warp", reason="needs the renderer: pip install 'semslam[sim]'")
    from semslam.sim.eye import Eye, studio
    from semslam.sim.furniture import make_piece

    rng, camera = np.random.default_rng(4), LogOptions(size=(160, 120)).camera
    home = studio([make_piece(name, rng) for name in CLASSES])
    eye, ground, seen = Eye(home, camera), Ground.of(home), set()
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    for y in np.arange(0.5, home.objects[-1].y_m, 3.0):
        facing_back = matrix_from_pose((2.0, float(y), 0.0), (0.0, 0.0, 1.0, 0.0))
        world_from_camera = facing_back @ BoxRobot().base_from_camera
        sight = eye.look(world_from_camera)
        points = rays * sight.depth_m[..., None] @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        for item in home.objects:
            mine = sight.instances == item.instance
            assert (sight.classes[mine] == FIRST_OBJECT + item.class_id).all()
            inside = depth_inside(points[mine][:, :2], item.footprint)
            assert (inside > -0.05).all(), (item.class_name, item.piece.style, inside.min())
            codes = ground.codes_at(*points[mine][inside > 0.02][:, :2].T)
            assert (ground.class_of[codes] == FIRST_OBJECT + item.class_id).all()
            seen |= {item.instance} if mine.sum() > 20 else set()
    assert len(seen) == len(CLASSES)
