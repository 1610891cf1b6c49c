"""Opening ONNX files: what cannot be run is refused in plain words, and what can is quiet and repeatable."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from onnx import helper

from semslam.errors import SemslamError
from semslam.models.session import open_session
from tests.onnx_factory import constant_detector, dense, save, value


def _plain(path: Path, **options: object) -> Path:
    return constant_detector(path, {"o": np.zeros((1, 84, 7), np.float32)}, **options)  # type: ignore[arg-type]


def _truncated(path: Path) -> None:
    path.write_bytes(_plain(path).read_bytes()[:-300])


def _without_weights(path: Path) -> None:
    _plain(path, external=True)
    path.with_name(path.name + ".data").unlink()


def _unknown_operator(path: Path) -> None:
    node = helper.make_node("Frobnicate", ["images"], ["o"])
    save(path, [node], [value("images", (1, 3, 8, 8))], [value("o", (1, 3, 8, 8))], {})


BROKEN: dict[str, Callable[[Path], object]] = {
    "missing": Path,
    "folder": Path.mkdir,
    "empty": Path.touch,
    "text": lambda path: path.write_text("hello there"),
    "truncated": _truncated,
    "weights absent": _without_weights,
    "operator set": lambda path: _plain(path, opset=99),
    "format version": lambda path: _plain(path, ir_version=99),
    "unknown operator": _unknown_operator,
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_cannot_be_opened_is_refused_with_path_and_hint(tmp_path: Path, kind: str) -> None:
    """One error of the family, that names the file and says what to do."""
    path = tmp_path / "broken.onnx"
    BROKEN[kind](path)
    with pytest.raises(SemslamError, match=r"broken\.onnx") as caught:
        open_session(path, what="detector")
    assert caught.value.hint
    assert "detector" in caught.value.message


def test_an_absent_provider_lists_those_present(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A provider that is not installed is never replaced silently."""
    monkeypatch.setenv("SEMSLAM_PROVIDER", "FrobnicateExecutionProvider")
    with pytest.raises(SemslamError, match="Frobnicate") as caught:
        open_session(_plain(tmp_path / "m.onnx"))
    assert "CPUExecutionProvider" in caught.value.text()


def test_a_named_provider_is_used_and_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The session tells what it runs on."""
    monkeypatch.setenv("SEMSLAM_PROVIDER", "CPUExecutionProvider")
    assert open_session(_plain(tmp_path / "m.onnx")).provider == "CPUExecutionProvider"


def test_a_picture_of_the_wrong_shape_is_an_error_of_the_family(tmp_path: Path) -> None:
    """It names the model and the shape it was given."""
    with pytest.raises(SemslamError, match=r"m\.onnx"):
        open_session(_plain(tmp_path / "m.onnx")).run({"images": np.zeros((1, 3, 9, 9), np.float32)})


DATA = os.environ.get("SEMSLAM_TEST_DATA", "")


@pytest.mark.skipif(not DATA, reason="SEMSLAM_TEST_DATA is unset")
def test_opening_a_chatty_model_prints_nothing() -> None:
    """ONNX Runtime would warn once for each of the 185 weights that this file lists as inputs."""
    code = "import sys, pathlib; from semslam.models.session import open_session as o; o(pathlib.Path(sys.argv[1]))"
    model = str(Path(DATA) / "models/nanodet_m_320.onnx")
    done = subprocess.run([sys.executable, "-c", code, model], capture_output=True, text=True, check=True)
    assert done.stdout + done.stderr == ""


def test_nothing_is_reported_to_anybody(tmp_path: Path) -> None:
    """Opening and running a model leaves no trace in the home folder, where onnxruntime would queue its telemetry."""
    model = constant_detector(tmp_path / "m.onnx", {"o": dense(84, 7, {})}, metadata={"names": "['cup', 'chair']"})
    home = tmp_path / "home"
    home.mkdir()
    silent = {"ORT_DISABLE_TELEMETRY", "ORT_RUNNING_UNIT_TESTS", "CI"} | {n for n in os.environ if n.startswith("XDG_")}
    environment = {name: value for name, value in os.environ.items() if name not in silent} | {"HOME": str(home)}
    code = f"from semslam.models.inspect import describe; from pathlib import Path; describe(Path({str(model)!r}))"
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    assert list(home.rglob("*")) == []
