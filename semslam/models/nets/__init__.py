"""semslam's own networks, defined in torch (`pip install 'semslam[train]'`); run time opens their ONNX exports."""
