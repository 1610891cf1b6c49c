"""Small ONNX networks for tests: detectors with chosen outputs, and SAM-shaped pairs with random weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

Shape = Sequence[int | str | None]
OPSET, IR_VERSION = 17, 8


def value(name: str, shape: Shape, kind: int = TensorProto.FLOAT) -> Any:
    """Declaration of an input or output."""
    return helper.make_tensor_value_info(name, kind, list(shape))


def save(
    path: Path,
    nodes: Sequence[Any],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    weights: Mapping[str, NDArray[Any]],
    *,
    metadata: Mapping[str, str] | None = None,
    opset: int = OPSET,
    ir_version: int = IR_VERSION,
    external: bool = False,
) -> Path:
    """Write a network; `external` puts its weights into `NAME.onnx.data`."""
    tensors = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(list(nodes), "test", list(inputs), list(outputs), tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=ir_version)
    helper.set_model_props(model, dict(metadata or {}))
    if external:
        onnx.save(model, path, save_as_external_data=True, size_threshold=0, location=path.name + ".data")
    else:
        onnx.save(model, path)
    return path


def constant_detector(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    *,
    input_shape: Shape = (1, 3, 64, 64),
    input_kind: int = TensorProto.FLOAT,
    other_inputs: Mapping[str, Any] | None = None,
    declared: Mapping[str, Shape] | None = None,
    **options: Any,
) -> Path:
    """A network that answers every picture with the given arrays.

    `other_inputs` are shapes by name, or pairs of shape and type; `declared` overrides the shapes its file states.
    """
    nodes = [helper.make_node("Identity", [f"{name}_values"], [name]) for name in outputs]
    declarations = [
        value(name, (declared or {}).get(name, array.shape), helper.np_dtype_to_tensor_dtype(array.dtype))
        for name, array in outputs.items()
    ]
    inputs = [value("images", input_shape, input_kind)]
    for name, what in (other_inputs or {}).items():
        inputs.append(value(name, *what) if isinstance(what[0], tuple) else value(name, what))
    weights = {f"{name}_values": array for name, array in outputs.items()}
    return save(path, nodes, inputs, declarations, weights, **options)


def rgbd_detector(path: Path, *, side: int = 64, **options: Any) -> Path:
    """Inputs `images` and `depth` of open batch; of 84 candidates one box in the middle has the mean depth as score."""
    mask = np.zeros((1, 6, 84), np.float32)
    mask[0, 5, 7] = 1
    columns = np.zeros((1, 6, 84), np.float32)
    columns[0, :4, 7] = [32, 32, 20, 8]
    weights: dict[str, NDArray[Any]] = {"mask": mask, "columns": columns, "flat": np.array([-1, 1, 1], np.int64)}
    nodes = [
        helper.make_node("ReduceMean", ["depth"], ["mean"], axes=[1, 2, 3]),
        helper.make_node("Reshape", ["mean", "flat"], ["means"]),
        helper.make_node("Mul", ["means", "mask"], ["scores"]),
        helper.make_node("Add", ["scores", "columns"], ["output0"]),
    ]
    inputs = [value("images", ("batch", 3, side, side)), value("depth", ("batch", 1, side, side))]
    return save(path, nodes, inputs, [value("output0", ("batch", 6, 84))], weights, **options)


def dense(rows: int, columns: int, filled: Mapping[int, Sequence[float]]) -> NDArray[np.float32]:
    """(1, rows, columns) of zeros, with some rows filled."""
    array = np.zeros((1, rows, columns), np.float32)
    for row, values in filled.items():
        array[0, row, : len(values)] = values
    return array


def sam_encoder(
    path: Path, *, side: int = 64, channels: int = 4, channels_last: bool = False, seed: int = 0, name: str = "images"
) -> Path:
    """A random convolution of stride 16: picture (1, 3, S, S), or (S, S, 3), to embeddings (1, C, S/16, S/16)."""
    weights = {
        "weight": np.random.default_rng(seed).normal(size=(channels, 3, 16, 16)).astype(np.float32) / 16,
        "axes": np.array([0], np.int64),
    }
    nodes = [helper.make_node("Conv", ["picture", "weight"], ["image_embeddings"], strides=[16, 16])]
    shape: Shape = (1, 3, side, side)
    if channels_last:
        shape = (side, side, 3)
        nodes = [
            helper.make_node("Transpose", [name], ["planes"], perm=[2, 0, 1]),
            helper.make_node("Unsqueeze", ["planes", "axes"], ["picture"]),
            *nodes,
        ]
    else:
        nodes = [helper.make_node("Identity", [name], ["picture"]), *nodes]
    cells = side // 16
    return save(path, nodes, [value(name, shape)], [value("image_embeddings", (1, channels, cells, cells))], weights)


def open_height_encoder(path: Path, *, side: int = 1024) -> Path:
    """Pixels (height, width, 3) of open size, filled up with zeros to the side: their means over 16 x 16."""
    weights: dict[str, NDArray[Any]] = {
        "first": np.array([0], np.int64),
        "side": np.array([side, side], np.int64),
        "zeros": np.zeros(6, np.int64),
    }
    nodes = [
        helper.make_node("Shape", ["input_image"], ["size"], start=0, end=2),
        helper.make_node("Sub", ["side", "size"], ["missing"]),
        helper.make_node("Concat", ["zeros", "missing"], ["pads"], axis=0),
        helper.make_node("Transpose", ["input_image"], ["planes"], perm=[2, 0, 1]),
        helper.make_node("Unsqueeze", ["planes", "first"], ["picture"]),
        helper.make_node("Pad", ["picture", "pads"], ["square"]),
        helper.make_node("AveragePool", ["square"], ["image_embeddings"], kernel_shape=[16, 16], strides=[16, 16]),
    ]
    inputs = [value("input_image", ("image_height", "image_width", 3))]
    return save(path, nodes, inputs, [value("image_embeddings", (1, 3, side // 16, side // 16))], weights)


def sam_decoder(
    path: Path,
    *,
    channels: int = 4,
    cells: int = 4,
    low_side: int = 256,
    boxes: bool = False,
    sized: bool = True,
    iou_first: bool = False,
    many: bool = False,
    frozen: tuple[int, int] | None = None,
) -> Path:
    """Fills the prompted box, and weighs in the embeddings: logits 1 inside the box, -1 outside, plus a little of them.

    The signature is that of the Segment Anything export; without `sized` it takes no orig_im_size and gives only
    low_res_masks of the padded square, with `boxes` it takes `boxes` (1, 4) in place of points. The square has the
    side 16 * cells. With `many` it takes any number of boxes at once (and no orig_im_size); with `frozen` it crops
    `masks` as for a picture of that height and width, whatever it is told.
    """
    side = 16 * cells
    centres = (np.arange(low_side, dtype=np.float32) + 0.5) * (side / low_side)
    weights: dict[str, NDArray[Any]] = {
        "xs": centres.reshape(1, 1, 1, -1),
        "ys": centres.reshape(1, 1, -1, 1),
        "corner_shape": np.array([-1, 4, 1, 1, 1], np.int64),
        "two": np.array(2, np.float32),
        "one": np.array(1, np.float32),
        "little": np.array(1e-4, np.float32),
        "liked": np.array([[0.9]], np.float32),
    }
    nodes = [helper.make_node("Reshape", ["boxes" if boxes else "point_coords", "corner_shape"], ["corners"])]
    for index, edge in enumerate("ltrb"):
        weights[f"at_{edge}"] = np.array(index, np.int64)
        nodes.append(helper.make_node("Gather", ["corners", f"at_{edge}"], [edge], axis=1))
    nodes += [
        helper.make_node("GreaterOrEqual", ["xs", "l"], ["in_l"]),
        helper.make_node("Less", ["xs", "r"], ["in_r"]),
        helper.make_node("GreaterOrEqual", ["ys", "t"], ["in_t"]),
        helper.make_node("Less", ["ys", "b"], ["in_b"]),
        helper.make_node("And", ["in_l", "in_r"], ["in_x"]),
        helper.make_node("And", ["in_t", "in_b"], ["in_y"]),
        helper.make_node("And", ["in_x", "in_y"], ["inside"]),
        helper.make_node("Cast", ["inside"], ["filled"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["filled", "two"], ["doubled"]),
        helper.make_node("Sub", ["doubled", "one"], ["plain"]),
        helper.make_node("ReduceMean", ["image_embeddings"], ["mood"], keepdims=1),
        helper.make_node("Mul", ["mood", "little"], ["slight"]),
        helper.make_node("Add", ["plain", "slight"], ["low_res_masks"]),
        helper.make_node("Identity", ["liked"], ["iou_predictions"]),
    ]
    inputs = [value("image_embeddings", (1, channels, cells, cells))]
    if boxes:
        inputs.append(value("boxes", (1, 4)))
    else:
        first = "boxes" if many else 1
        inputs += [value("point_coords", (first, "points", 2)), value("point_labels", (first, "points"))]
        inputs += [value("mask_input", (1, 1, low_side, low_side)), value("has_mask_input", (1,))]
    low = value("low_res_masks", ("boxes" if many else 1, 1, low_side, low_side))
    outputs = [value("iou_predictions", (1, 1)), low] if iou_first else [low, value("iou_predictions", (1, 1))]
    if sized and not boxes and not many:
        nodes += _to_picture(side, weights, frozen)
        inputs.append(value("orig_im_size", (2,)))
        outputs = [value("masks", (1, 1, "height", "width")), value("iou_predictions", (1, 1)), low]
    return save(path, nodes, inputs, outputs, weights)


def _to_picture(side: int, weights: dict[str, NDArray[Any]], frozen: tuple[int, int] | None) -> list[Any]:
    """From the padded square to the picture's size, as the Segment Anything export does inside the graph."""
    weights["square"] = np.array([1, 1, side, side], np.int64)
    weights["side"] = np.array(side, np.float32)
    size = "orig_im_size"
    if frozen:
        size = "frozen"
        weights[size] = np.array(frozen, np.float32)
    weights["half"] = np.array(0.5, np.float32)
    weights["ones"] = np.array([1, 1], np.int64)
    weights["zeros"] = np.array([0, 0], np.int64)
    weights["last_axes"] = np.array([2, 3], np.int64)
    return [
        helper.make_node("Resize", ["low_res_masks", "", "", "square"], ["big"], mode="linear"),
        helper.make_node("ReduceMax", [size], ["longest"], keepdims=0),
        helper.make_node("Div", ["side", "longest"], ["ratio"]),
        helper.make_node("Mul", [size, "ratio"], ["used"]),
        helper.make_node("Add", ["used", "half"], ["rounded_up"]),
        helper.make_node("Cast", ["rounded_up"], ["ends"], to=TensorProto.INT64),
        helper.make_node("Slice", ["big", "zeros", "ends", "last_axes"], ["cropped"]),
        helper.make_node("Cast", ["orig_im_size"], ["size"], to=TensorProto.INT64),
        helper.make_node("Concat", ["ones", "size"], ["whole"], axis=0),
        helper.make_node("Resize", ["cropped", "", "", "whole"], ["masks"], mode="linear"),
    ]
