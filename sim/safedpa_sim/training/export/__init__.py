"""Export of trained networks: ``weights`` writes weights and model files, ``onnx`` writes ONNX graphs."""
