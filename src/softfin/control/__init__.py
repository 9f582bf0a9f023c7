"""Controllers: a reference force becomes a command three times a second; one implementation for
NumPy, JAX and ONNX."""
