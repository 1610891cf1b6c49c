"""Matrix products in float32 by ONNX Runtime on one thread: the same bits whatever numpy's matrix library may use.

A sum in float32 depends on the order of adding, which numpy's library chooses by its number of threads. ONNX Runtime is
told: one. The network is a single `MatMul`, written here byte by byte; the numbers of its fields are those of
onnx.proto (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

_IR_VERSION, _OPSET, _FLOAT = 8, 17, 1


def float_product(left: NDArray[np.float32], right: NDArray[np.float32]) -> NDArray[np.float32]:
    """The matrix product (n, k), (k, m) -> (n, m)."""
    feeds = {"left": np.ascontiguousarray(left), "right": np.ascontiguousarray(right)}
    product: NDArray[np.float32] = _session().run(None, feeds)[0]
    return product


@cache
def _session() -> Any:
    """On the processor even where there is a GPU: matrices this small are not worth the way there."""
    import onnxruntime as ort  # only who multiplies pays for it

    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.use_deterministic_compute = True
    return ort.InferenceSession(_model(), options, providers=["CPUExecutionProvider"])


def _model() -> bytes:
    """An ONNX file that multiplies two matrices of any size."""
    node = _field(1, b"left") + _field(1, b"right") + _field(2, b"product") + _field(4, b"MatMul")
    ends = _field(11, _matrix(b"left")) + _field(11, _matrix(b"right")) + _field(12, _matrix(b"product"))
    graph = _field(1, node) + _field(2, b"product") + ends
    return _number(1, _IR_VERSION) + _field(7, graph) + _field(8, _number(2, _OPSET))


def _matrix(name: bytes) -> bytes:
    """Declaration of a matrix of open size."""
    shape = _field(1, b"") * 2
    tensor = _number(1, _FLOAT) + _field(2, shape)
    return _field(1, name) + _field(2, _field(1, tensor))


def _field(number: int, content: bytes) -> bytes:
    """A protobuf field of less than 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content


def _number(number: int, value: int) -> bytes:
    """A protobuf field that is a number below 128."""
    return bytes([number << 3, value])
