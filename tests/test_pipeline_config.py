"""Configuration in and out: every wrong key or value is named, with what would be right."""

from __future__ import annotations

import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

from semslam.errors import UsageError
from semslam.pipeline.config import as_toml, field_notes, load_config
from semslam.stages.catalogue import STAGES
from semslam.stages.settings import ExtractConfig, LocalizeConfig, PaperConfig
from tests.fake_stages import FAKE_STAGES


def write(folder: Path, text: str) -> Path:
    path = folder / "home.toml"
    path.write_text(text)
    return path


def test_defaults_are_those_of_the_dataclasses() -> None:
    """Without a file, nothing changes."""
    config = load_config(STAGES)
    assert config.sections["extract"] == ExtractConfig()
    assert config.sections["localize"] == LocalizeConfig()


def test_a_file_may_set_any_part(tmp_path: Path) -> None:
    """Nested sections keep the defaults of what they do not name; whole numbers will do where a float is meant."""
    text = (
        '[extract]\nmax_depth_m = 4\nselect = ["chair"]\nremap = { sofa = "couch" }\n[localize.paper]\nheadings = 90\n'
    )
    config = load_config(STAGES, write(tmp_path, text))
    assert config.sections["extract"] == ExtractConfig(max_depth_m=4.0, select=("chair",), remap={"sofa": "couch"})
    assert type(config.sections["extract"].max_depth_m) is float
    assert config.sections["localize"] == LocalizeConfig(paper=PaperConfig(headings=90))


def test_later_words_win(tmp_path: Path) -> None:
    """File, then --set, then options of their own."""
    path = write(tmp_path, "[extract]\nmin_score = 0.1\nmin_pixels = 9\nside = 55\n")
    config = load_config(STAGES, path, ["extract.min_score=0.2", "extract.min_pixels=8"], {"extract.min_score": 0.3})
    section = config.sections["extract"]
    assert (section.min_score, section.min_pixels, section.side) == (0.3, 8, 55)


def test_paths_in_a_file_are_relative_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those given on the command line are relative to the working folder."""
    folder = tmp_path / "settings"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    path = write(folder, '[extract]\ndetector = "../models/yolox.onnx"\n')
    config = load_config(STAGES, path, ["extract.classes=coco.txt"])
    assert config.sections["extract"].detector == str(tmp_path / "models" / "yolox.onnx")
    assert config.sections["extract"].classes == str(tmp_path / "coco.txt")


@pytest.mark.parametrize(
    ("assignment", "key", "value"),
    [
        ("extract.select=chair,table", "select", ("chair", "table")),
        ('extract.select=["chair"]', "select", ("chair",)),
        ("extract.exclude=", "exclude", ()),
        ("extract.adapter=yolox", "adapter", "yolox"),
        ("extract.adapter=8", "adapter", "8"),
        ("extract.remap.tv=screen", "remap", {"tv": "screen"}),
    ],
)
def test_set_reads_what_people_type(assignment: str, key: str, value: object) -> None:
    """Quotes and brackets are optional."""
    assert getattr(load_config(STAGES, assignments=[assignment]).sections["extract"], key) == value


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("[extrakt]\n", "Unknown section `[extrakt]`", "did you mean `extract`?"),
        ("[sim]\n", "Unknown section `[sim]`", "sections: `ingest`, `extract`, `localize`, `export`"),
        ("min_score = 1\n", "Unknown section `[min_score]`", "`min_score` belongs to section `[extract]`"),
        ("extract = 3\n", "`extract` must be a section, found `3`", "[extract]"),
        ("[extract]\nmin_scor = 0.1\n", "Unknown key `extract.min_scor`", "did you mean `min_score`?"),
        ("[localize.paper]\nheading = 3\n", "Unknown key `localize.paper.heading`", "did you mean `headings`?"),
        ("[localize]\npaper = 3\n", "`localize.paper` must be a section, found `3`", "[localize.paper]"),
        ("[extract]\nmin_score = 1.5\n", "`extract.min_score` must be 0 to 1, found `1.5`", "default is `0.3`"),
        ("[extract]\nmin_score = nan\n", "`extract.min_score` must be a number, found", "min_score = 0.3"),
        ("[extract]\nmin_score = true\n", "`extract.min_score` must be a number, found `true`", "min_score = 0.3"),
        ('[extract]\nside = "wide"\n', '`extract.side` must be a whole number, found `"wide"`', "side = 99"),
        ("[extract]\nside = 9.0\n", "`extract.side` must be a whole number, found `9.0`", "side = 99"),
        ("[extract]\ndetector = 1\n", "`extract.detector` must be a text, found `1`", "detector"),
        ("[extract]\nselect = [1]\n", "`extract.select` must be a list of texts, found `[1]`", "select = []"),
        ("[extract]\nremap = { a = 1 }\n", "`extract.remap` must be a table of texts", "remap = {}"),
        ("[localize.paper]\nbinary = 1\n", "`localize.paper.binary` must be true or false", "binary = false"),
        ('[extract]\nsegmenter = "samm"\n', '`extract.segmenter` cannot be `"samm"`', "did you mean `sam`?"),
        ('[localize]\nestimators = ["best"]\n', '`localize.estimators` cannot be `"best"`', "`dead_reckoning`"),
        ("[localize]\nestimators = []\n", "`localize.estimators` is empty", "leave `estimators` out"),
        ('[localize]\nestimators = ["paper", "paper"]\n', "names `paper` twice", "once"),
        ("[extract]\nside = 98\n", "`extract.side` is 98", "extract.side=99"),
        ("[extract]\nmin_depth_m = 6\n", "`extract.min_depth_m` is 6 and `extract.max_depth_m` is 6", "max_depth_m=11"),
        ("[extract\n", "is no TOML", "semslam config show"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, message: str, hint: str) -> None:
    """Key, value, and what is allowed or nearest."""
    with pytest.raises(UsageError) as caught:
        load_config(STAGES, write(tmp_path, text))
    assert message in caught.value.message
    assert hint in caught.value.hint


def test_the_place_of_a_wrong_value_is_named(tmp_path: Path) -> None:
    """The file, or the words on the command line."""
    path = write(tmp_path, "[extract]\nside = 1\n")
    with pytest.raises(UsageError, match=r"home\.toml"):
        load_config(STAGES, path)
    with pytest.raises(UsageError, match=r"--set extract\.side=1"):
        load_config(STAGES, assignments=["extract.side=1"])


@pytest.mark.parametrize("text", ["extract", "min_score=1", "=3", ""])
def test_set_without_a_key_or_a_value(text: str) -> None:
    """The form is shown."""
    with pytest.raises(UsageError, match=r"not of the form section\.key=value"):
        load_config(STAGES, assignments=[text])


def test_a_missing_or_unreadable_file_is_named(tmp_path: Path) -> None:
    """With how to get one."""
    with pytest.raises(UsageError, match="No configuration file") as caught:
        load_config(STAGES, tmp_path / "none.toml")
    assert "semslam config show" in caught.value.hint
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="cannot be read"):
        load_config(STAGES, tmp_path / "binary.toml")


def test_what_is_shown_can_be_read_again(tmp_path: Path) -> None:
    """TOML out and in is the same configuration, comments or not."""
    given = ['extract.select=["a \\"quoted\\" name", "täble"]', "extract.remap.tv=screen", "localize.paper.leak=0.125"]
    config = load_config(STAGES, assignments=given)
    for comments in (True, False):
        text = as_toml(config, comments=comments)
        assert load_config(STAGES, write(tmp_path, text)) == config
        assert list(tomllib.loads(text)) == ["ingest", "extract", "localize", "export"]
    assert load_config(STAGES, stored=config.as_json()) == config


def test_every_key_is_documented() -> None:
    """The text under each field is its comment in `config show`."""
    text = as_toml(load_config(STAGES))
    for stage in STAGES:
        for item in fields(stage.config):
            assert field_notes(stage.config).get(item.name), f"{stage.name}.{item.name} has no text"
    assert "# Detections below this confidence are dropped.\n# Range: 0 to 1.\nmin_score = 0.3\n" in text
    assert "# One of: auto, sam, depth_box, box.\n" in text
    assert "[localize.paper]\n" in text


def test_fake_and_real_stages_follow_the_same_rules() -> None:
    """Variants come from the field that the stage names."""
    config = load_config(FAKE_STAGES, assignments=["third.kinds=lazy,hasty"])
    assert config.variants(FAKE_STAGES[2]) == ("lazy", "hasty")
    assert config.variants(FAKE_STAGES[0]) == ("",)
    assert config.for_variant(FAKE_STAGES[2], "lazy").kinds == ("lazy",)
