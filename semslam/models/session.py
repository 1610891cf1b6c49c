"""ONNX files opened with ONNX Runtime: quiet, deterministic, with the threads it is given, errors in plain words."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.models.onnxfile import read_onnx

PROVIDER_VARIABLE = "SEMSLAM_PROVIDER"
"""Environment variable that names the execution provider, such as CUDAExecutionProvider."""
PREFERRED_PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
"""Taken in this order, from what the installed onnxruntime has."""
_FATAL_ONLY = 4
_HALF = {"tensor(float16)": np.float16}

Array = NDArray[Any]


@dataclass(frozen=True)
class Tensor:
    """An input or output of a model. A dimension is its size, or the name of a dynamic one (empty if nameless)."""

    name: str
    shape: tuple[int | str, ...]
    type: str

    def __str__(self) -> str:
        kind, shape = self.type.removeprefix("tensor").strip("()"), ", ".join(str(size or "?") for size in self.shape)
        return f"{self.name} {kind}[{shape}]"


@dataclass(frozen=True)
class Signature:
    """What a model takes and gives, and what its file says about it."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: Mapping[str, str]
    producer: str
    opsets: tuple[tuple[str, int], ...] = ()
    """Operator sets by domain."""
    operators: tuple[str, ...] | None = None
    """Operator types in the graph; None if they are not to be looked at."""

    def text(self) -> str:
        """Inputs and outputs, one a line."""
        return "\n".join(
            [*(f"  input   {tensor}" for tensor in self.inputs), *(f"  output  {tensor}" for tensor in self.outputs)]
        )


@dataclass(frozen=True)
class Session:
    """An open model."""

    path: Path
    signature: Signature
    provider: str
    _ort: ort.InferenceSession

    def run(self, feeds: Mapping[str, Array]) -> list[Array]:
        """All outputs, in the order of the signature.

        Raises:
            SemslamError: the model fails on this input.
        """
        kinds = {tensor.name: _HALF.get(tensor.type) for tensor in self.signature.inputs}
        cast = {
            name: value.astype(kinds[name], copy=False) if kinds.get(name) else value for name, value in feeds.items()
        }
        try:
            outputs: list[Array] = self._ort.run(None, cast)
        except Exception as error:  # onnxruntime throws a dozen types without a common base
            shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in feeds.items())
            raise SemslamError(
                f"Model `{self.path}` fails on input {shapes}: {_first_line(error)}",
                hint="see what it takes with `semslam models inspect FILE.onnx`, or export it again",
            ) from error
        return outputs


def open_session(path: Path, *, threads: int = 1, what: str = "model") -> Session:
    """Open an ONNX file.

    Args:
        path: the file.
        threads: threads within an operator.
        what: how messages call it, such as `detector`.

    Raises:
        SemslamError: no such file, no ONNX model, one this onnxruntime cannot run, or an unknown provider.
    """
    facts = read_onnx(path, what)
    provider = _provider()
    try:
        session = ort.InferenceSession(str(path), _options(threads), providers=[provider])
    except Exception as error:  # onnxruntime throws a dozen types without a common base
        raise _unreadable(path, what, error) from error
    signature = Signature(
        inputs=_tensors(session.get_inputs()),
        outputs=_tensors(session.get_outputs()),
        metadata=dict(session.get_modelmeta().custom_metadata_map),
        producer=facts.producer,
        opsets=facts.opsets,
        operators=facts.operators,
    )
    used = session.get_providers()[0]
    if os.environ.get(PROVIDER_VARIABLE) and used != provider:
        raise SemslamError(
            f"Execution provider `{provider}` cannot run {what} `{path}` on this machine",
            hint=f"unset {PROVIDER_VARIABLE} to run it on the CPU",
        )
    return Session(path, signature, used, session)


def _options(threads: int) -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = _FATAL_ONLY
    options.use_deterministic_compute = True
    return options


def _provider() -> str:
    available = ort.get_available_providers()
    wanted = os.environ.get(PROVIDER_VARIABLE, "")
    if wanted and wanted not in available:
        raise SemslamError(
            f"Execution provider `{wanted}` is not in this onnxruntime",
            details="available: " + ", ".join(available),
            hint=f"set {PROVIDER_VARIABLE} to one of them, or install the onnxruntime package that has it",
        )
    return wanted or next((name for name in PREFERRED_PROVIDERS if name in available), "CPUExecutionProvider")


def _tensors(values: Sequence[Any]) -> tuple[Tensor, ...]:
    return tuple(Tensor(v.name, tuple(d if isinstance(d, int) else (d or "") for d in v.shape), v.type) for v in values)


def _unreadable(path: Path, what: str, error: Exception) -> SemslamError:
    reason, hint = _first_line(error), "copy or export it again"
    if "opset" in reason.lower() or "IR version" in reason:
        hint = "export with an older opset, or install a newer onnxruntime"
    return SemslamError(f"Cannot open {what} `{path}`: {reason}", hint=hint)


def _first_line(error: Exception) -> str:
    text = str(error).strip().splitlines()
    return (text[0] if text else type(error).__name__)[:300]
