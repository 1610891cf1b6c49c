"""What runs again, and what does not: counted by calls of the stages."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from semslam.errors import UsageError
from semslam.pipeline import plan
from semslam.pipeline.executors import SerialExecutor
from semslam.stages.catalogue import STAGES
from tests.fake_stages import FAKE_STAGES, make_log, with_version
from tests.pipeline_helpers import World, decisions, states

pytest_plugins = ("tests.pipeline_fixtures",)

ALL_CALLS = [
    "kitchen first",
    "kitchen last careful",
    "kitchen last hasty",
    "kitchen last lazy",
    "kitchen second",
    "kitchen third careful",
    "kitchen third hasty",
    "kitchen third lazy",
]


@pytest.fixture(autouse=True)
def _log(world: World) -> None:
    make_log(world.logs)


def test_the_first_run_calls_everything_once_and_the_second_nothing(world: World) -> None:
    """A finished task is never run again."""
    assert set(decisions(world.run()).values()) == {"run (new)"}
    assert world.calls() == ALL_CALLS
    report = world.run()
    assert world.calls() == []
    assert set(states(report).values()) == {"cached"}


def test_a_changed_setting_runs_its_stage_and_those_after_it(world: World) -> None:
    """The change is explained with both values; stages before it stay."""
    world.run()
    world.calls()
    report = world.run("second.modulo=7")
    still = ("kitchen first", "kitchen last lazy")  # the lazy variant's result does not depend on its input
    assert world.calls() == [call for call in ALL_CALLS if call not in still]
    assert decisions(report)["second"] == "stale: second.modulo 1000000 -> 7"
    assert decisions(report)["third/hasty"] == "stale: input sums changed"


def test_an_unchanged_result_stops_the_wave(world: World) -> None:
    """A stage that runs again with the same result does not make later stages run."""
    world.run()
    world.calls()
    report = world.run("second.note=another")
    assert world.calls() == ["kitchen second"]
    assert decisions(report)["third/careful"] == "cached"


def test_a_variant_ignores_settings_of_the_others(world: World) -> None:
    """Only the careful variant depends on the inner section."""
    world.run()
    world.calls()
    report = world.run("third.inner.gain=2.0")
    assert world.calls() == ["kitchen last careful", "kitchen third careful"]
    assert decisions(report)["third/careful"] == "stale: third.inner.gain 1.0 -> 2.0"


def test_going_back_to_an_old_setting_finds_the_old_result(world: World) -> None:
    """Results of earlier configurations stay until they are cleaned away."""
    world.run()
    world.run("second.modulo=7")
    world.calls()
    assert set(states(world.run()).values()) == {"cached"}
    assert world.calls() == []


def test_a_new_stage_version_runs_it_again(world: World) -> None:
    """With the same result, only that stage."""
    world.run()
    world.calls()
    report = world.run(stages=with_version(FAKE_STAGES, "second", 2))
    assert world.calls() == ["kitchen second"]
    assert decisions(report)["second"] == "stale: stage version 1 -> 2"


def test_a_changed_log_is_noticed_and_a_touched_one_is_not_run(world: World) -> None:
    """Content counts, not time or place."""
    world.run()
    world.calls()
    os.utime(world.logs / "kitchen.mcap", (1, 1))
    assert set(states(world.run()).values()) == {"cached"}
    make_log(world.logs, numbers=[5, 6])
    report = world.run()
    assert decisions(report)["first"] == "stale: log files changed"
    assert decisions(report)["second"] == "stale: input numbers changed"
    assert world.calls() == ALL_CALLS


def test_a_log_that_moved_keeps_its_name_and_its_results(world: World) -> None:
    """Paths are never part of a key."""
    world.run()
    world.calls()
    world.logs.rename(world.root / "elsewhere")
    report = world.run(names=[world.root / "elsewhere"])
    assert states(report) == dict.fromkeys(states(report), "cached")
    assert next(iter(report.results)).task.log.name == "kitchen"


def test_a_file_in_a_setting_counts_by_its_content(world: World) -> None:
    """The same model at another path is the same; another content at the same path is not."""
    model = world.root / "model.onnx"
    model.write_text("weights")
    world.run(f"second.model={model}")
    world.calls()
    copy = world.root / "copy.onnx"
    copy.write_text("weights")
    assert "second" not in "".join(world.calls())
    assert set(states(world.run(f"second.model={copy}")).values()) == {"cached"}
    copy.write_text("other weights")
    report = world.run(f"second.model={copy}")
    assert decisions(report)["second"] == "stale: second.model has another content"


def test_weights_outside_an_onnx_file_count_too(world: World) -> None:
    """Under whatever name the exporter gave them."""
    for content in (1.0, 2.0):
        weights = numpy_helper.from_array(np.full(300, content, np.float32), "weights")
        graph = helper.make_graph([], "empty", [], [], [weights])
        onnx.save(
            helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", 17)]),
            world.root / "model.onnx",
            save_as_external_data=True,
            size_threshold=0,
            location="weights.bin",
        )
        report = world.run(f"second.model={world.root / 'model.onnx'}")
    assert decisions(report)["second"] == "stale: second.model has another content"
    assert "second" in "".join(world.calls())
    assert set(states(world.run(f"second.model={world.root / 'model.onnx'}")).values()) == {"cached"}


def test_another_library_version_or_provider_runs_it_again(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only stages that compute with the library or open a network; the change is explained."""
    stages = tuple(replace(s, libraries=("numpy", "gone")) if s.name == "second" else s for s in FAKE_STAGES)
    model = world.root / "model.onnx"
    model.write_text("weights")
    world.run(f"second.model={model}", stages=stages)
    numpy = ".".join(np.__version__.split(".")[:2])
    assert world.manifest("second")["components"]["libraries"] == {"numpy": numpy, "gone": "absent"}
    world.calls()
    monkeypatch.setattr(plan, "library_version", lambda name: {"numpy": "9.1"}.get(name, "absent"))
    report = world.run(f"second.model={model}", stages=stages)
    assert world.calls() == ["kitchen second"]
    assert decisions(report)["second"] == f"stale: numpy {numpy} -> 9.1"
    monkeypatch.setenv("SEMSLAM_PROVIDER", "CUDAExecutionProvider")
    report = world.run(f"second.model={model}", stages=stages)
    assert world.calls() == ["kitchen second"]
    assert decisions(report)["second"] == "stale: provider auto -> CUDAExecutionProvider"


def test_libraries_of_the_real_stages_are_installed() -> None:
    """A name that no package has would be `absent` for ever and notice nothing."""
    names = {name for stage in STAGES for name in stage.libraries}
    assert {name: plan.library_version(name) for name in names if plan.library_version(name) == "absent"} == {}


def test_a_missing_file_in_a_setting_is_wrong_use(world: World) -> None:
    """Said once, before anything runs."""
    with pytest.raises(UsageError, match=r"second\.model.*cannot be read"):
        world.run(f"second.model={world.root / 'none.onnx'}")
    assert world.calls() == []


def test_a_deleted_entry_is_made_again(world: World) -> None:
    """The cache itself decides what exists, not the index nor the record."""
    world.run()
    world.calls()
    (folder,) = (world.out / "cache" / "second").iterdir()
    (folder / "manifest.json").unlink()
    report = world.run()
    assert world.calls() == ["kitchen second"]
    assert decisions(report)["second"] == "run (its result is gone or damaged)"
    assert states(report)["kitchen second"] == "done"


def test_a_damaged_manifest_is_not_believed(world: World) -> None:
    """Its digest of itself does not fit any more."""
    world.run()
    world.calls()
    (folder,) = (world.out / "cache" / "second").iterdir()
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace('"rows": 10', '"rows": 11'))
    world.run()
    assert world.calls() == ["kitchen second"]
    assert set(states(world.run()).values()) == {"cached"}


def test_memories_may_be_deleted_at_any_time(world: World) -> None:
    """index.json, digests.json and results.json only save reading; damaged ones are as good as none."""
    world.run()
    world.calls()
    for name in ("index.json", "digests.json", "results.json"):
        (world.out / "cache" / name).write_text('{"half')
    assert set(states(world.run()).values()) == {"cached"}
    assert world.calls() == []


def test_logs_of_equal_content_share_the_work(world: World) -> None:
    """All stages run once, but for the last, whose files carry the log's name."""
    make_log(world.logs, "twin")
    report = world.run()
    calls = world.calls()
    assert [call for call in calls if "first" in call] == ["kitchen first"]
    assert len([call for call in calls if "last" in call]) == 6
    assert "twin hasty" in (world.out / "results" / "twin" / "hasty" / "map.png").read_text()
    assert decisions(report)["first"] == "same work as `kitchen`"


def test_stages_can_be_run_up_to_one(world: World) -> None:
    """A later run goes on from there."""
    world.run(until="second")
    assert world.calls() == ["kitchen first", "kitchen second"]
    world.run()
    assert world.calls() == [call for call in ALL_CALLS if call not in ("kitchen first", "kitchen second")]


def test_manifests_hold_nothing_that_varies_with_time(world: World, tmp_path: Path) -> None:
    """Two runs into two folders give the same bytes, timing.json apart."""
    world.run()
    other = World(tmp_path / "other")
    other.logs = world.logs
    other.run()
    assert world.entries() == other.entries()
    timing = next((world.out / "cache" / "first").glob("*/timing.json"))
    assert set(json.loads(timing.read_text())) == {"seconds", "max_rss_bytes"}


def test_a_manifest_says_what_the_entry_is(world: World) -> None:
    """Tables by shard, counters summed, warnings, and the versions it was made with."""
    make_log(world.logs, orders="warn notes")
    world.run(until="first")
    manifest = world.manifest("first")
    shards = manifest["tables"]["numbers"]["shards"]
    assert [(part["file"], part["rows"]) for part in shards] == [
        ("shard-00000/numbers.parquet", 4),
        ("shard-00001/numbers.parquet", 4),
        ("shard-00002/numbers.parquet", 2),
    ]
    assert manifest["counters"] == {"read": 10}
    assert manifest["warnings"] == ["a line was strange"]
    assert list(manifest["tables"]) == ["notes", "numbers"]
    assert manifest["provenance"]["semslam"]
    assert manifest["components"]["config"]["shard_rows"] == 4
    assert str(world.root) not in json.dumps(manifest)


def test_results_lie_under_stable_names_and_come_back(world: World) -> None:
    """A result that was deleted or changed by hand is copied again; other files there are left alone."""
    world.run()
    place = world.out / "results" / "kitchen" / "hasty"
    assert sorted(path.name for path in place.iterdir()) == ["map.png", "pictures.parquet"]
    original = (place / "map.png").read_text()
    (place / "map.png").write_text("scribble")
    (place / "pictures.parquet").unlink()
    (place / "mine.txt").write_text("mine")
    world.run()
    assert (place / "map.png").read_text() == original
    assert sorted(path.name for path in place.iterdir()) == ["map.png", "mine.txt", "pictures.parquet"]
    world.run("last.title=plan")
    assert (place / "map.png").read_text().startswith("plan")


def test_a_variant_that_is_no_longer_asked_for_leaves_the_record(world: World) -> None:
    """The record holds the last run's tasks."""
    world.run()
    world.run("third.kinds=hasty")
    record = json.loads((world.out / "logs" / "kitchen.json").read_text())
    assert sorted(record["tasks"]) == ["first", "last/hasty", "second", "third/hasty"]


def test_a_log_that_changes_while_it_is_read_is_not_published(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its key was made from the content before."""
    wait = SerialExecutor.wait

    def scribble(self: SerialExecutor, *arguments: object) -> object:
        make_log(world.logs, numbers=[1])
        return wait(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(SerialExecutor, "wait", scribble)
    report = world.run(until="first")
    (failure,) = report.failures
    assert failure.failure is not None
    assert "changed while it was read" in failure.failure.message
    assert states(world.run(until="first"))["kitchen first"] == "failed"
    monkeypatch.undo()
    assert states(world.run(until="first"))["kitchen first"] == "done"


def test_variants_with_equal_results_stay_apart(world: World) -> None:
    """A stage may show the name of its variant, so an equal input is not enough to share its result."""
    make_log(world.logs, numbers=[0, 0])
    world.run()
    texts = {path.parent.name: path.read_text() for path in world.out.glob("results/kitchen/*/map.png")}
    assert texts == {name: f"map kitchen {name} [0, 0]" for name in ("careful", "hasty", "lazy")}
