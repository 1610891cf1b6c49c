"""Train and test never share what they must not share."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semslam.errors import SemslamError, UsageError
from semslam.sim.dataset import VARIANTS, Recipe
from semslam.sim.splits import Split, assign, held_out_scenes, load_split, read_splits, write_splits
from semslam.tables.parquet import write_table
from semslam.tables.spec import SPLITS, TRUE_MAP

RECIPES = st.builds(
    Recipe,
    scenes=st.integers(1, 45),
    trajectories=st.integers(1, 5),
    days=st.integers(1, 2),
    seed=st.integers(0, 2**31 - 1),
    variants=st.lists(st.sampled_from(VARIANTS), min_size=1, max_size=3).map(tuple),
)


def splits_of(recipe: Recipe) -> list[Split]:
    return assign(recipe.recordings(), recipe.seed)


def write_unchecked(path: Path, splits: list[Split]) -> None:
    """A table as somebody else might have written it."""
    write_table(path, SPLITS, {c.name: [getattr(one, c.name) for one in splits] for c in SPLITS.columns}, {"seed": 0})


@settings(deadline=None)  # a busy machine is no fault
@given(RECIPES)
def test_no_home_trains_and_tests_across_scenes(recipe: Recipe) -> None:
    """Homes are told apart by their seeds: the same home in another variant or on another day is the same home."""
    recordings = {one.name: one for one in recipe.recordings()}
    splits = splits_of(recipe)
    train = {recordings[one.log].home_seed for one in splits if one.cross == "train"}
    test = {recordings[one.log].home_seed for one in splits if one.cross == "test"}
    assert not train & test
    assert len(train) + len(test) == (recipe.scenes if recipe.scenes > 1 else 0)
    assert (math.floor(recipe.scenes / 7.5) or 1) <= len(test) <= math.ceil(recipe.scenes / 7.5) or recipe.scenes == 1


@settings(deadline=None)  # a busy machine is no fault
@given(RECIPES)
def test_no_trajectory_trains_and_tests_within_scenes(recipe: Recipe) -> None:
    """Every scene has exactly its last trajectory in the test, whatever the day, and none on both sides."""
    splits = splits_of(recipe)
    for scene in range(recipe.scenes):
        here = [one for one in splits if one.scene == scene]
        train = {one.trajectory for one in here if one.intra == "train"}
        test = {one.trajectory for one in here if one.intra == "test"}
        assert test == ({recipe.trajectories - 1} if recipe.trajectories > 1 else set())
        assert train == (set(range(recipe.trajectories - 1)) if recipe.trajectories > 1 else set())


@settings(deadline=None)  # a busy machine is no fault
@given(RECIPES)
def test_drives_of_train_and_test_have_different_seeds(recipe: Recipe) -> None:
    """No drive is driven twice, on either side of either protocol, except in other variants of its home."""
    drives = [(one.variant, one.drive_seed) for one in recipe.recordings()]
    assert len(set(drives)) == len(drives)


def test_the_paper_s_numbers(tmp_path: Path) -> None:
    """30 scenes of 3 trajectories: 60 logs train and 30 test within, 78 train and 12 test across scenes."""
    path, recipe = tmp_path / "splits.parquet", Recipe()
    write_splits(path, splits_of(recipe), recipe.seed)
    counts = {(p, part): len(load_split(path, p, part)) for p in ("intra", "cross") for part in ("train", "test")}
    assert counts == {("intra", "train"): 60, ("intra", "test"): 30, ("cross", "train"): 78, ("cross", "test"): 12}
    assert load_split(path, "intra", "test")[:2] == ["home_00_t2", "home_01_t2"]


def test_test_scenes_come_from_the_seed() -> None:
    """The same for the same seed, others for other seeds, and not always the first or last."""
    assert held_out_scenes(30, 7) == held_out_scenes(30, 7)
    drawn = {held_out_scenes(30, seed) for seed in range(20)}
    assert len(drawn) > 15
    assert len({scene for scenes in drawn for scene in scenes}) > 20


@settings(deadline=None)
@given(st.integers(2, 200), st.integers(0, 200), st.integers(0, 2**31 - 1))
def test_a_set_that_grows_moves_no_scene_across(scenes: int, more: int, seed: int) -> None:
    """What has trained never tests and what has tested never trains, however many homes join."""
    before, after = held_out_scenes(scenes, seed), held_out_scenes(scenes + more, seed)
    assert before == tuple(scene for scene in after if scene < scenes)


def test_the_table_comes_back_as_it_was_and_with_the_same_bytes(tmp_path: Path) -> None:
    """Written twice, it is the same file; read, it is the same rows."""
    recipe = Recipe(scenes=3, days=2, variants=("rooms", "standard"))
    for name in ("a", "b"):
        write_splits(tmp_path / name, splits_of(recipe), recipe.seed)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert read_splits(tmp_path / "a") == splits_of(recipe)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("cross", "other side", "scene 0 is on both sides of `cross`"),
        ("intra", "other side", r"trajectory .* \(0, 0\) is on both sides of `intra`"),
        ("cross", "validate", "`validate` of `home_00_d0_t0` is no part of `cross`"),
        ("cross", None, "scene 0 is on both sides of `cross`"),
        ("log", "home_01_d0_t0", "log `home_01_d0_t0` stands in it 2 times"),
    ],
)
def test_a_mixed_table_is_refused(tmp_path: Path, column: str, value: str | None, reason: str) -> None:
    """Neither read nor written: one row changed makes a table nobody may train on."""
    splits = splits_of(Recipe(scenes=4, days=2))
    first = splits[0]
    swapped = {"train": "test", "test": "train"}.get(getattr(first, column), "") if value == "other side" else value
    changed: dict[str, Any] = {column: swapped}
    splits[0] = replace(first, **changed)
    write_unchecked(tmp_path / "splits.parquet", splits)
    with pytest.raises(SemslamError, match=reason):
        load_split(tmp_path / "splits.parquet", "intra", "train")
    with pytest.raises(SemslamError, match=reason):
        write_splits(tmp_path / "new.parquet", splits, 0)
    assert not (tmp_path / "new.parquet").exists()


@pytest.mark.parametrize(
    ("protocol", "part", "message", "hint"),
    [
        ("intra-scene", "test", "No protocol `intra-scene`", "did you mean `intra`?"),
        ("paper", "test", "No protocol `paper`", "use `intra` or `cross`"),
        ("cross", "tset", "No part `tset`", "did you mean `test`?"),
    ],
)
def test_unknown_names_are_refused(tmp_path: Path, protocol: str, part: str, message: str, hint: str) -> None:
    """A misspelt protocol or part is no empty list."""
    write_splits(tmp_path / "splits.parquet", splits_of(Recipe(scenes=2)), 1)
    with pytest.raises(UsageError, match=message) as caught:
        load_split(tmp_path / "splits.parquet", protocol, part)
    assert caught.value.hint == hint


@pytest.mark.parametrize(
    ("recipe", "protocol", "option"),
    [(Recipe(scenes=1), "cross", "--scenes 2"), (Recipe(trajectories=1), "intra", "--trajectories 2")],
)
def test_a_data_set_too_small_for_a_protocol_says_so(
    tmp_path: Path, recipe: Recipe, protocol: str, option: str
) -> None:
    """Null on every row is an error with what to type, not an empty training set."""
    write_splits(tmp_path / "splits.parquet", splits_of(recipe), recipe.seed)
    with pytest.raises(UsageError) as caught:
        load_split(tmp_path / "splits.parquet", protocol, "train")
    assert option in caught.value.hint


def test_damaged_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    """Errors that name the file."""
    path = tmp_path / "splits.parquet"
    with pytest.raises(SemslamError, match="missing"):
        load_split(path, "cross", "train")
    path.write_bytes(b"PAR1 no more")
    with pytest.raises(SemslamError, match="damaged"):
        load_split(path, "cross", "train")
    write_table(path, TRUE_MAP, {column.name: [] for column in TRUE_MAP.columns})
    with pytest.raises(SemslamError, match="expected table `splits`"):
        load_split(path, "cross", "train")
