"""Segment Anything and MobileSAM: encoders and decoders with random weights, exported by their own wrappers."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from architectures.made import array, enliven, export, parameters

SIDE = 1024


@dataclass(frozen=True)
class Pair:
    """Encoder and decoder as ONNX files."""

    encoder: Path
    decoder: Path
    exported: str
    parameters: int
    masks: Callable[[NDArray[np.uint8], NDArray[np.float32]], NDArray[np.bool_]]
    """The project's masks (n, H, W) of boxes in a picture."""


def sam(folder: Path) -> Pair:
    """Segment Anything with an image encoder of two narrow layers; everything else in full."""
    from segment_anything.modeling import ImageEncoderViT, MaskDecoder, PromptEncoder, Sam, TwoWayTransformer

    encoder = ImageEncoderViT(
        depth=2,
        embed_dim=96,
        img_size=SIDE,
        mlp_ratio=4,
        norm_layer=partial(nn.LayerNorm, eps=1e-6),
        num_heads=3,
        patch_size=16,
        qkv_bias=True,
        use_rel_pos=True,
        global_attn_indexes=[],
        window_size=14,
        out_chans=256,
    )
    prompts = PromptEncoder(
        embed_dim=256, image_embedding_size=(64, 64), input_image_size=(SIDE, SIDE), mask_in_chans=16
    )
    decoder = MaskDecoder(
        num_multimask_outputs=3,
        transformer=TwoWayTransformer(depth=2, embedding_dim=256, mlp_dim=2048, num_heads=8),
        transformer_dim=256,
    )
    return _pair(Sam(encoder, prompts, decoder), folder, "sam", pixels=False, many=False)


def mobile_sam(folder: Path, *, pixels: bool, many: bool) -> Pair:
    """MobileSAM in full (TinyViT), as the samexporter package builds it."""
    with contextlib.redirect_stdout(io.StringIO()):
        from samexporter.mobile_encoder.setup_mobile_sam import setup_model

        network = setup_model()
    return _pair(network, folder, f"mobile_sam_{pixels}_{many}", pixels=pixels, many=many)


def _pair(network: nn.Module, folder: Path, name: str, *, pixels: bool, many: bool) -> Pair:
    """`pixels`: the encoder takes (H, W, 3); `many`: the decoder's prompts have an open first dimension."""
    from samexporter.onnx_utils import ImageEncoderOnnxModel
    from segment_anything.utils.onnx import SamOnnxModel

    enliven(network.image_encoder, SIDE)
    network.eval()
    encoder, decoder = folder / f"{name}_encoder.onnx", folder / f"{name}_decoder.onnx"
    mean, deviation = [123.675, 116.28, 103.53], [58.395, 57.12, 57.375]
    wrapped = ImageEncoderOnnxModel(network, use_preprocess=pixels, pixel_mean=mean, pixel_std=deviation).eval()
    example = torch.rand(SIDE, SIDE, 3) if pixels else torch.rand(1, 3, SIDE, SIDE)
    axes = {"input_image": {0: "image_height", 1: "image_width"}} if pixels else None
    export(wrapped, [example], encoder, ["input_image"], ["image_embeddings"], traced=True, dynamic_axes=axes)
    _export_decoder(SamOnnxModel(network, return_single_mask=not many).eval(), decoder, many=many)
    how = f"encoder {'(H, W, 3)' if pixels else '(1, 3, S, S)'}, decoder of {'many boxes' if many else 'one box'} a run"
    return Pair(encoder, decoder, how, parameters(network), partial(_masks, network, not many))


def _export_decoder(model: Any, path: Path, *, many: bool) -> None:
    """As the project's script does: five points, a landscape picture."""
    examples = {
        "image_embeddings": torch.randn(1, 256, 64, 64),
        "point_coords": torch.randint(0, SIDE, (1, 5, 2)).float(),
        "point_labels": torch.randint(0, 4, (1, 5)).float(),
        "mask_input": torch.randn(1, 1, 256, 256),
        "has_mask_input": torch.tensor([1.0]),
        "orig_im_size": torch.tensor([1500.0, 2250.0]),
    }
    axes = {name: {1: "num_points", **({0: "boxes"} if many else {})} for name in ("point_coords", "point_labels")}
    outputs = ["masks", "iou_predictions", "low_res_masks"]
    export(model, list(examples.values()), path, list(examples), outputs, traced=True, dynamic_axes=axes)


def _masks(network: Any, single: bool, rgb: NDArray[np.uint8], boxes: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Segment Anything's predictor in torch: of the masks the export gives, the one it likes best."""
    from segment_anything import SamPredictor

    predictor = SamPredictor(network)
    predictor.set_image(rgb)
    found = []
    with torch.no_grad():
        prompts = predictor.transform.apply_boxes_torch(torch.from_numpy(boxes), rgb.shape[:2])
        for box in prompts:
            sparse, dense = network.prompt_encoder(points=None, boxes=box[None], masks=None)
            low, liked = network.mask_decoder.predict_masks(
                predictor.features, network.prompt_encoder.get_dense_pe(), sparse, dense
            )
            start = 1 if single else 0  # the wrapper rules the first mask out where the prompt is one box
            best = start + int(liked[0, start:].argmax())
            full = network.postprocess_masks(low[:, best : best + 1], predictor.input_size, rgb.shape[:2])
            found.append(array(full[0, 0] > network.mask_threshold))
    return np.array(found)
