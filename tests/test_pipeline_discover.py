"""From names to logs: folders, globs, split recordings, unique names, and what cannot be read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semslam.errors import UsageError
from semslam.pipeline.discover import _named, discover


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"\x89MCAP0\r\n")


def found(*names: object) -> dict[str, list[str]]:
    """File names by log."""
    return {log.name: [path.name for path in log.sources] for log in discover([str(name) for name in names]).logs}


def test_a_folder_is_searched_through_and_through(tmp_path: Path) -> None:
    """Only for *.mcap, in any case of letters."""
    touch(tmp_path / "a.mcap", tmp_path / "deep" / "er" / "b.MCAP", tmp_path / "notes.txt")
    assert found(tmp_path) == {"a": ["a.mcap"], "b": ["b.MCAP"]}


def test_a_glob_that_the_shell_left_alone(tmp_path: Path) -> None:
    """Also through folders."""
    touch(tmp_path / "x" / "a.mcap", tmp_path / "x" / "b.mcap", tmp_path / "y" / "a2.mcap")
    assert found(tmp_path / "x" / "*.mcap") == {"a": ["a.mcap"], "b": ["b.mcap"]}
    assert set(found(tmp_path / "**" / "a*.mcap")) == {"a", "a2"}


def test_a_file_named_twice_is_one_log(tmp_path: Path) -> None:
    """By whatever way it was named."""
    touch(tmp_path / "a.mcap")
    (tmp_path / "link.mcap").symlink_to(tmp_path / "a.mcap")
    assert found(tmp_path / "a.mcap", tmp_path, tmp_path / "link.mcap") == {"a": ["a.mcap"]}


def test_split_recordings_belong_together(tmp_path: Path) -> None:
    """Numbered from 0 without a gap, in the order of their numbers, not of their letters."""
    parts = [tmp_path / f"kitchen_{number}.mcap" for number in range(12)]
    touch(*parts, tmp_path / "other.mcap")
    expected = {"kitchen": [part.name for part in parts], "other": ["other.mcap"]}
    assert found(tmp_path) == expected
    assert found(*reversed(parts)) == {"kitchen": expected["kitchen"]}


def test_numbers_that_do_not_start_at_zero_are_names(tmp_path: Path) -> None:
    """Unless rosbag2 says by its metadata.yaml that they are parts."""
    touch(tmp_path / "kitchen_01.mcap", tmp_path / "kitchen_02.mcap")
    assert set(found(tmp_path)) == {"kitchen_01", "kitchen_02"}
    (tmp_path / "metadata.yaml").touch()
    assert found(tmp_path) == {"kitchen": ["kitchen_01.mcap", "kitchen_02.mcap"]}


def test_missing_parts_are_named(tmp_path: Path) -> None:
    """Between those that are there, and before the first of what rosbag2 recorded; plain names warn of nothing."""
    touch(*(tmp_path / f"r_{number}.mcap" for number in (0, 2, 5)), tmp_path / "day_3.mcap", tmp_path / "day_7.mcap")
    apart = "; they are taken as 3 logs"
    assert discover([str(tmp_path)]).warnings == (
        f"`r_1.mcap` is missing between `r_0.mcap` and `r_2.mcap`{apart}",
        f"`r_3.mcap` to `r_4.mcap` are missing between `r_2.mcap` and `r_5.mcap`{apart}",
    )
    assert discover([str(tmp_path / "day_*.mcap")]).warnings == ()
    other = tmp_path / "bag"
    touch(other / "r_01.mcap", other / "r_03.mcap", other / "metadata.yaml")
    assert discover([str(other)]).warnings == (
        "`r_00.mcap` is missing before `r_01.mcap`",
        "`r_02.mcap` is missing between `r_01.mcap` and `r_03.mcap`",
    )


def test_a_part_named_alone_is_a_log_alone(tmp_path: Path) -> None:
    """Also one that lies in a folder alone."""
    touch(tmp_path / "kitchen_0.mcap", tmp_path / "kitchen_1.mcap")
    assert found(tmp_path / "kitchen_1.mcap") == {"kitchen_1": ["kitchen_1.mcap"]}
    assert found(tmp_path / "kitchen_0.mcap") == {"kitchen_0": ["kitchen_0.mcap"]}


def test_equal_names_get_their_folders(tmp_path: Path) -> None:
    """As many as it takes."""
    touch(tmp_path / "mon" / "home" / "run.mcap", tmp_path / "tue" / "home" / "run.mcap", tmp_path / "tue" / "x.mcap")
    assert set(found(tmp_path)) == {"mon-home-run", "tue-home-run", "x"}


def test_names_that_are_no_folder_names(tmp_path: Path) -> None:
    """Spaces and signs become underscores, and two that become equal get numbers."""
    touch(tmp_path / "my run.mcap", tmp_path / "my_run.mcap", tmp_path / ".hidden.mcap")
    names = set(found(tmp_path))
    assert "hidden" in names
    assert len(names) == 3
    assert all(" " not in name for name in names)


def test_a_log_keeps_the_name_that_the_output_folder_knows(tmp_path: Path) -> None:
    """And another log of the same name does not take its place while it exists."""
    old, new = tmp_path / "a" / "run.mcap", tmp_path / "b" / "run.mcap"
    touch(old, new)
    known = {"run": [str(old)]}
    assert [log.name for log in discover([str(new)], known).logs] == ["b-run"]
    assert sorted(log.name for log in discover([str(tmp_path)], known).logs) == ["b-run", "run"]
    old.unlink()
    assert [log.name for log in discover([str(new)], known).logs] == ["run"]


def test_broken_links_in_a_folder_are_reported_and_left_out(tmp_path: Path) -> None:
    """The other logs go on."""
    touch(tmp_path / "a.mcap")
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere.mcap")
    (tmp_path / "folder.mcap").mkdir()
    discovery = discover([str(tmp_path)])
    assert [log.name for log in discovery.logs] == ["a"]
    (problem,) = discovery.problems
    assert (problem.path.name, "broken link" in problem.reason) == ("gone.mcap", True)
    assert [one.path.name for one in discover([str(tmp_path / "*.mcap")]).problems] == ["gone.mcap"]


def test_links_that_go_round_in_circles(tmp_path: Path) -> None:
    """Are walked once."""
    touch(tmp_path / "a.mcap")
    (tmp_path / "loop").symlink_to(tmp_path)
    assert found(tmp_path) == {"a": ["a.mcap"]}


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    """Named alone it is wrong use, in a folder it is reported."""
    touch(tmp_path / "secret.mcap", tmp_path / "a.mcap")
    (tmp_path / "secret.mcap").chmod(0)
    with pytest.raises(UsageError, match="may not be read"):
        found(tmp_path / "secret.mcap")
    assert [one.path.name for one in discover([str(tmp_path)]).problems] == ["secret.mcap"]


@pytest.mark.parametrize(
    ("name", "message", "hint"),
    [
        ("none.mcap", "No such file or folder", "check the path"),
        ("kitchn.mcap", "No such file or folder", "did you mean"),
        ("none/none.mcap", "No such file or folder", "there is no folder"),
        ("*.bag2", "Nothing matches", "name a folder"),
        ("empty", r"No \*.mcap in folder", "another folder"),
        ("broken.mcap", "is a broken link to", "repair it"),
        ("old.bag", "is a .bag recording", "mcap convert"),
    ],
)
def test_names_that_lead_to_nothing(tmp_path: Path, name: str, message: str, hint: str) -> None:
    """Wrong use, with what to type."""
    touch(tmp_path / "kitchen.mcap", tmp_path / "old.bag")
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.mcap").symlink_to(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=message) as caught:
        found(tmp_path / name)
    assert hint in caught.value.hint
    with pytest.raises(UsageError, match="No logs were named"):
        found()


@given(st.lists(st.lists(st.sampled_from(["a", "b c", "b_c", "d"]), min_size=1, max_size=4), unique_by=tuple))
def test_names_are_always_unique(paths: list[list[str]]) -> None:
    """Whatever the folders are called."""
    groups = [(Path("/", *parts[:-1], f"{parts[-1]}.mcap"),) for parts in paths]
    logs = _named(sorted(groups), {})
    assert len({log.name for log in logs}) == len(groups)
    assert sorted(log.sources for log in logs) == sorted(groups)
