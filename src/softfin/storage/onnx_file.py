"""ONNX files: versions, metadata, and the check before a file is written. Each file is one step
with its state as inputs and outputs.

To run such a file, feed the outputs ``next_NAME`` back as the inputs NAME. Its metadata contain
names, units and rates as strings, with JSON for anything longer than a word. Requires
``softfin[onnx]``.
"""

import importlib
import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softfin.core.errors import ConfigurationError, RunError
from softfin.core.json_object import JsonObject
from softfin.installation import how_to_add
from softfin.storage.artifact import write_file

OPSET = 17
IR_VERSION = 8
"""Versions of ONNX and of its file format; onnxruntime 1.12 (2022) and later can run them."""

NEXT = "next_"
"""Prefix of the outputs that contain the state for the next step."""

FORCE_FRAME = (
    "force of the fin on its mount: +x is the thrust that pushes the robot forward; at angle "
    "theta the fin points along (-cos theta, +sin theta) from its shaft"
)


class Exported(NamedTuple):
    """Metadata of an exported file."""

    bytes: int
    worst: float
    """Largest difference from softfin's own outputs during the check."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def import_extra(*names: str) -> tuple[Any, ...]:
    """Import modules from the ``onnx`` extra; raises ConfigurationError if one is missing."""
    try:
        return tuple(importlib.import_module(name) for name in names)
    except ImportError as error:
        raise ConfigurationError(
            f"ONNX needs {error.name}, which is not installed; run {how_to_add('onnx')}"
        ) from None


def encode_model(
    model: Any, title: str, initial: Mapping[str, np.ndarray], metadata: Mapping[str, object]
) -> bytes:
    """Return the bytes of a model, checked by onnx, with its metadata and the initial values of its
    state."""
    (onnx,) = import_extra("onnx")
    version = importlib.metadata.version("softfin")
    model.ir_version = IR_VERSION
    model.producer_name = "softfin"
    model.producer_version = version
    model.graph.name = title
    properties: JsonObject = {"softfin": version, **metadata, "state": {}}
    for name, value in initial.items():
        properties["state"][name] = f"{NEXT}{name}"
        properties[f"initial_{name}"] = value.tolist()
    for name, entry in properties.items():
        if not isinstance(entry, str):
            properties[name] = json.dumps(entry)
    onnx.helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)
    data: bytes = model.SerializeToString()
    return data


def open_session(data: bytes) -> Any:
    """Open a model file in onnxruntime, on one thread."""
    (runtime,) = import_extra("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    return runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def keep_model(file: Path, data: bytes, what: str, worst: float, tolerance: float) -> Exported:
    """Write a model file if its outputs, called `what` in messages, equal softfin's own within
    `tolerance`; raises RunError otherwise."""
    if not worst <= tolerance:
        raise RunError(
            f"{file}: not written: onnxruntime's {what} differ from softfin's by {worst:.2g} "
            f"(limit {tolerance:g}); use another version of onnxruntime"
        )
    write_file(file, data)
    session = open_session(data)
    inputs = tuple(each.name for each in session.get_inputs())
    outputs = tuple(each.name for each in session.get_outputs())
    return Exported(len(data), worst, inputs, outputs)
