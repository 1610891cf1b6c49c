"""Networks: ONNX Runtime sessions, detectors and segmenters behind adapters. No torch at run time."""
