"""Networks at run time: ONNX Runtime sessions, and adapters from their outputs to boxes and masks. No torch here."""
