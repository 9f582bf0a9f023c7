"""Controllers: they turn a reference force into a command three times a second; one implementation
for NumPy, JAX and ONNX."""
