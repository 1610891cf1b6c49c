"""Transformers' detectors and segmentations in small configurations, RF-DETR's own package, torchvision's DeepLab."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from architectures.made import Answer, Feeds, Made, array, enliven, export, parameters, thing_names

SIDE = 256
Processor = Callable[[Any, tuple[int, int]], Answer]


class Named(nn.Module):
    """A model whose answer is a record, as a tuple of some of its fields."""

    def __init__(self, model: nn.Module, fields: tuple[str, ...]) -> None:
        super().__init__()
        self.model, self.fields = model, fields

    def forward(self, pixel_values: Tensor) -> tuple[Tensor, ...]:
        answer = self.model(pixel_values)
        return tuple(answer[field] for field in self.fields)


class Numbers(nn.Module):
    """A segmentation that answers class numbers (B, H, W)."""

    def __init__(self, model: nn.Module, field: str) -> None:
        super().__init__()
        self.model, self.field = model, field

    def forward(self, pixel_values: Tensor) -> Tensor:
        return self.model(pixel_values)[self.field].argmax(1)


class Sized(nn.Module):
    """RT-DETR with a post-processor in the graph, its inputs and outputs as in the authors' export script."""

    def __init__(self, model: nn.Module, classes: int) -> None:
        super().__init__()
        self.model, self.classes = model, classes

    def forward(self, images: Tensor, orig_target_sizes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        answer = self.model(images)
        centre, size = answer.pred_boxes[..., :2], answer.pred_boxes[..., 2:]
        boxes = torch.cat([centre - size / 2, centre + size / 2], -1) * orig_target_sizes.repeat(1, 2)[:, None]
        scores, index = answer.logits.sigmoid().flatten(1).topk(50, dim=-1)
        chosen = (index // self.classes)[..., None].expand(-1, -1, 4)
        return index % self.classes, boxes.gather(1, chosen), scores


def rtdetr_model() -> nn.Module:
    """RT-DETR with a narrow ResNet and two decoder layers."""
    from transformers import RTDetrConfig, RTDetrForObjectDetection
    from transformers.models.rt_detr.configuration_rt_detr_resnet import RTDetrResNetConfig

    backbone = RTDetrResNetConfig(
        embedding_size=32,
        hidden_sizes=[32, 64, 128, 256],
        depths=[1, 1, 1, 1],
        out_features=["stage2", "stage3", "stage4"],
    )
    config = RTDetrConfig(
        backbone_config=backbone,
        encoder_in_channels=[64, 128, 256],
        num_labels=80,
        num_queries=100,
        decoder_layers=2,
        d_model=128,
        encoder_hidden_dim=128,
        decoder_in_channels=[128] * 3,
    )
    return enliven(RTDetrForObjectDetection(config), SIDE)


def detr_model() -> nn.Module:
    """DETR with a narrow ResNet, two layers each way."""
    from transformers import DetrConfig, DetrForObjectDetection, ResNetConfig

    backbone = ResNetConfig(
        out_features=["stage4"], depths=[1] * 4, embedding_size=32, hidden_sizes=[64, 128, 256, 512], layer_type="basic"
    )
    config = DetrConfig(
        use_timm_backbone=False,
        use_pretrained_backbone=False,
        backbone=None,
        backbone_config=backbone,
        encoder_layers=2,
        decoder_layers=2,
        d_model=128,
        num_labels=91,
    )
    return enliven(DetrForObjectDetection(config), SIDE)


def yolos_model() -> nn.Module:
    """YOLOS with three narrow layers."""
    from transformers import YolosConfig, YolosForObjectDetection

    config = YolosConfig(
        hidden_size=96,
        num_hidden_layers=3,
        num_attention_heads=3,
        intermediate_size=192,
        image_size=[SIDE, SIDE],
        num_labels=91,
    )
    return enliven(YolosForObjectDetection(config), SIDE)


def rtdetr(folder: Path) -> Made:
    """Logits and boxes; read by Transformers' RTDetrImageProcessor."""
    from transformers import RTDetrImageProcessor

    return _detector(rtdetr_model(), folder / "rtdetr.onnx", RTDetrImageProcessor(), 80)


def detr(folder: Path) -> Made:
    """Logits and boxes; read by Transformers' DetrImageProcessor."""
    from transformers import DetrImageProcessor

    return _detector(detr_model(), folder / "detr.onnx", DetrImageProcessor(), 91)


def yolos(folder: Path) -> Made:
    """Logits and boxes; read by Transformers' YolosImageProcessor."""
    from transformers import YolosImageProcessor

    return _detector(yolos_model(), folder / "yolos.onnx", YolosImageProcessor(), 91)


def _detector(model: nn.Module, path: Path, processor: Any, classes: int) -> Made:
    wrapped = Named(model, ("logits", "pred_boxes"))
    how = export(wrapped, [torch.rand(1, 3, SIDE, SIDE)], path, ["pixel_values"], ["logits", "pred_boxes"])

    def read(feeds: Feeds, size: tuple[int, int]) -> Answer:
        with torch.no_grad():
            answer = model(torch.from_numpy(feeds["pixel_values"]))
        found = processor.post_process_object_detection(answer, threshold=0.0, target_sizes=[size])[0]
        return best_of_doubles(found)

    return Made(path, how, parameters(model), thing_names(classes), read)


def best_of_doubles(found: dict[str, Tensor]) -> Answer:
    """Some processors list a query once for each class: its best class remains."""
    boxes, scores, labels = (array(found[key]) for key in ("boxes", "scores", "labels"))
    order = np.argsort(-scores, kind="stable")
    _, first = np.unique(np.round(boxes[order], 3), axis=0, return_index=True)
    kept = order[np.sort(first)]
    return Answer(boxes[kept].astype(np.float32), scores[kept].astype(np.float32), labels[kept].astype(np.int64))


def rtdetr_sized(folder: Path) -> Made:
    """The authors' signature around Transformers' network; read by its own graph in torch."""
    network = Sized(rtdetr_model(), 80)
    path = folder / "rtdetr_sized.onnx"
    examples = [torch.rand(1, 3, SIDE, SIDE), torch.tensor([[640, 480]])]
    how = export(network, examples, path, ["images", "orig_target_sizes"], ["labels", "boxes", "scores"])

    def read(feeds: Feeds, _size: tuple[int, int]) -> Answer:
        with torch.no_grad():
            labels, boxes, scores = network(*(torch.from_numpy(feeds[k]) for k in ("images", "orig_target_sizes")))
        return Answer(array(boxes[0]), array(scores[0]), array(labels[0]))

    return Made(path, f"{how}; post-processor written here", parameters(network), thing_names(80), read)


def rfdetr(folder: Path, kind: str = "RFDETRNano") -> Made:
    """RF-DETR by its package: network, export and post-processing; weights random."""
    import rfdetr as package

    model = getattr(package, kind)(pretrain_weights=None)
    network = enliven(model.model.model, model.model.resolution)
    model.export(output_dir=str(folder / kind), verbose=False)
    path = next((folder / kind).glob("*.onnx"))

    def read(feeds: Feeds, size: tuple[int, int]) -> Answer:
        from rfdetr.models.postprocess import PostProcess

        with torch.no_grad():
            answer = network(torch.from_numpy(next(iter(feeds.values()))))
        found = PostProcess(num_select=300)(answer, torch.tensor([size]))[0]
        return best_of_doubles(found)

    columns = int(network.class_embed.out_features)
    return Made(path, "its own export()", parameters(network), thing_names(columns), read)


def segmentation(kind: str, folder: Path, *, numbers: bool = False) -> Made:
    """SegFormer, MobileViT + DeepLabV3, MobileNetV2 + DeepLabV3+ of Transformers, or torchvision's DeepLabV3."""
    model, field = _segmentation(kind)
    path = folder / f"{kind}{'_numbers' if numbers else ''}.onnx"
    wrapped = Numbers(model, field) if numbers else Named(model, (field,))
    how = export(wrapped, [torch.rand(1, 3, SIDE, SIDE)], path, ["pixel_values"], ["classes" if numbers else field])

    def read(feeds: Feeds, size: tuple[int, int]) -> Answer:
        with torch.no_grad():
            logits = model(torch.from_numpy(feeds["pixel_values"]))[field]
        larger = nn.functional.interpolate(logits, size=size, mode="bilinear", align_corners=False)
        return Answer(class_map=array(larger.argmax(1)[0]).astype(np.int64))

    return Made(path, how + (", argmax in the graph" if numbers else ""), parameters(model), thing_names(21), read)


def _segmentation(kind: str) -> tuple[nn.Module, str]:
    if kind == "deeplabv3_mobilenet_v3":
        from torchvision.models.segmentation import deeplabv3_mobilenet_v3_large

        return enliven(deeplabv3_mobilenet_v3_large(weights=None, weights_backbone=None, num_classes=21), SIDE), "out"
    import transformers

    config = getattr(transformers, f"{kind}Config")(num_labels=21)
    return enliven(getattr(transformers, f"{kind}ForSemanticSegmentation")(config), SIDE), "logits"
