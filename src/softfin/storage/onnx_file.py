"""Files of ONNX: versions, metadata, the check before one is kept; a step with its state as inputs
and outputs.

Who runs such a file feeds the outputs ``next_NAME`` back as the inputs NAME. What the names, units
and rates are stands in its metadata, as texts, and as JSON where it is more than a word. Needs the
extra ``softfin[onnx]``.
"""

import importlib
import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softfin.core.errors import ConfigurationError, RunError
from softfin.installation import how_to_add
from softfin.storage.artifact import write_file

OPSET = 17
IR_VERSION = 8
"""Versions of ONNX and of its files: what onnxruntime 1.12 (2022) and everything after it runs."""

NEXT = "next_"
"""Prefix of the outputs that are the state tensors of the next step."""

FORCE_FRAME = (
    "force of the fin on its mount: +x is the thrust that pushes the robot forward; at angle "
    "theta the fin points along (-cos theta, +sin theta) from its shaft"
)


class Exported(NamedTuple):
    """Metadata of an exported file."""

    bytes: int
    worst: float
    """Greatest difference from softfin's own outputs over the check."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def import_extra(*names: str) -> tuple[Any, ...]:
    """Import modules of the extra; raises ConfigurationError where one is missing."""
    try:
        return tuple(importlib.import_module(name) for name in names)
    except ImportError as error:
        raise ConfigurationError(
            f"ONNX needs {error.name}, of an extra: {how_to_add('onnx')}"
        ) from None


def encode_model(
    model: Any, name: str, initial: Mapping[str, np.ndarray], metadata: Mapping[str, Any]
) -> bytes:
    """Bytes of a model, checked by onnx, with its metadata and those of its state, which begins as
    `initial`."""
    (onnx,) = import_extra("onnx")
    version = importlib.metadata.version("softfin")
    model.ir_version = IR_VERSION
    model.producer_name = "softfin"
    model.producer_version = version
    model.graph.name = name
    whole = {"softfin": version, **metadata, "state": {name: f"{NEXT}{name}" for name in initial}}
    whole |= {f"initial_{name}": value.tolist() for name, value in initial.items()}
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in whole.items()
    }
    onnx.helper.set_model_props(model, texts)
    onnx.checker.check_model(model, full_check=True)
    data: bytes = model.SerializeToString()
    return data


def open_session(data: bytes) -> Any:
    """Open the model of a file in onnxruntime, on one thread."""
    (runtime,) = import_extra("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    return runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def keep_model(file: Path, data: bytes, what: str, worst: float, tolerance: float) -> Exported:
    """Write a file whose outputs, called `what`, are softfin's own; raises RunError where they
    differ by more."""
    if not worst <= tolerance:
        raise RunError(
            f"{file}: onnxruntime's {what} differ by {worst:.2g} from softfin's (bar "
            f"{tolerance:g}); not written; export with another version of onnxruntime"
        )
    write_file(file, data)
    session = open_session(data)
    names = tuple(
        tuple(each.name for each in part) for part in (session.get_inputs(), session.get_outputs())
    )
    return Exported(len(data), worst, *names)
