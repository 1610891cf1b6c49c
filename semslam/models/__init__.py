"""Networks: ONNX Runtime sessions, detectors and segmenters behind adapters. No torch at run time.

ONNX Runtime 1.29 and later reports usage to its maker by default, on Linux too, and keeps a database of it in the home
folder. An offline tool that reads customers' logs does neither, so it is switched off here, before onnxruntime loads.
"""

import os

TELEMETRY_OFF = "ORT_DISABLE_TELEMETRY"

os.environ[TELEMETRY_OFF] = "1"
