"""Controllers, which turn a reference force into a command three times per second.

One implementation serves NumPy, JAX and ONNX.
"""
