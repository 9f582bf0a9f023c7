"""Export a controller's step as ONNX: measurements, reference and state in, command and next state
out, three times per second.

The step is traced from the formulas that NumPy runs on the robot, with ndonnx in NumPy's place.
Before the file is written, the commands of onnxruntime and NumPy are compared over an episode.
To run the file, feed the outputs ``next_NAME`` back as the inputs NAME. Its metadata contain names,
units and rates as strings, with JSON for anything longer than a word. Requires the extra
``softfin[onnx]``.
"""

import importlib
import importlib.metadata
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softfin.control.controller import MAX_MEASUREMENT, LoadedController, Measured
from softfin.core.errors import ConfigurationError, RunError
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import action_to_command
from softfin.gaits.reachable import bounding_box
from softfin.installation import how_to_add
from softfin.storage.artifact import check_file, write_file

EXTRA = ("ndonnx", "onnx", "onnxruntime")
"""Modules of the extra that the export uses."""

IR_VERSION = 10
"""Version of the file format; onnxruntime 1.18 (2024) and later can run it."""

NEXT = "next_"
"""Prefix of the outputs that contain the state for the next step."""

FORCE_FRAME = (
    "force of the fin on its mount: +x is the thrust that pushes the robot forward; at angle "
    "theta the fin points along (-cos theta, +sin theta) from its shaft"
)

COMMAND_OUTPUTS = ("command_angle", "command_velocity")
LAST_COMMAND = "last_command"
MEASURED_SHAPES: dict[str, tuple[int, ...]] = {"angle": (), "force": (2,), "reference": (2,)}

MAX_COMMAND_DIFFERENCE = 1e-4
"""Maximum difference from the NumPy commands [rad, rad/s]; if it is larger, no file is written."""

EPISODE = 240
"""Number of actions in the comparison."""


State = dict[str, np.ndarray]
"""State of the file by the names of its inputs."""


class Exported(NamedTuple):
    """Metadata of an exported file."""

    bytes: int
    opset: int
    worst: float
    """Largest difference from the softfin commands during the check [rad, rad/s]."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class OnnxOperations(Operations):
    """Operations with ndonnx, which adds operators to a graph; `choose` computes both values."""

    def __init__(self) -> None:
        import ndonnx

        self.xp = ndonnx
        self._constants: dict[int, tuple[np.ndarray, Array]] = {}

    def row(self, table: Array, index: Number) -> Array:
        """Gather one row."""
        return self.xp.take(table, self.xp.reshape(index, (1,)), axis=0)[0, ...]

    def choose(
        self, condition: Number, then: Callable[[], object], otherwise: Callable[[], object]
    ) -> Any:
        """Select with ``where``, leaf by leaf."""
        one: Any = then()
        other: Any = otherwise()
        return tuple(self.xp.where(condition, a, b) for a, b in zip(one, other, strict=True))

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Multiply with a MatMul operator; the ndonnx function adds branches for empty arrays."""
        operators = importlib.import_module("spox.opset.ai.onnx.v17")
        product = operators.matmul(vector.unwrap_spox(), self.constant(matrix).unwrap_spox())
        return self.xp.asarray(product)

    def whole(self, number: Number) -> Number:
        """Convert to int64."""
        return self.xp.astype(number, self.xp.int64)

    def real(self, number: Number) -> Number:
        """Convert to float32."""
        return self.xp.astype(number, self.xp.float32)

    def clip(self, number: Number, low: Number, high: Number) -> Number:
        """Limit a number."""
        return self.xp.clip(number, low, high)

    def constant(self, values: object) -> Any:
        """Convert each array to a constant of the graph."""
        if isinstance(values, tuple):
            return type(values)(*map(self.constant, values))
        if not isinstance(values, np.ndarray):
            return values
        # The array is kept so that no other array can have the same id.
        return self._constants.setdefault(id(values), (values, self.xp.asarray(values)))[1]


def export_onnx(controller: LoadedController, file: Path, overwrite: bool = False) -> Exported:
    """Write the step to a file, after checking it with onnx and running it with onnxruntime.

    Raises:
        ConfigurationError: If the extra is not installed.
        ArtifactError: If the file already exists.
        RunError: If the exported step's commands differ from NumPy's; nothing is written.
    """
    check_file(file, overwrite, "--onnx")
    _check_extra()
    initial = _initial_state(controller)
    model = _build_graph(controller, initial)
    _describe(model, controller, initial)
    data: bytes = model.SerializeToString()
    worst = _difference(data, controller)
    if not worst <= MAX_COMMAND_DIFFERENCE:
        raise RunError(
            f"{file}: not written: the commands from onnxruntime differ from the softfin commands "
            f"by {worst:.2g} (limit {MAX_COMMAND_DIFFERENCE:g}); use a different version of "
            "onnxruntime"
        )
    write_file(file, data)
    return Exported(
        bytes=len(data),
        opset=model.opset_import[0].version,
        worst=worst,
        inputs=tuple(each.name for each in model.graph.input),
        outputs=tuple(each.name for each in model.graph.output),
    )


def _check_extra() -> None:
    try:
        for name in EXTRA:
            importlib.import_module(name)
    except ImportError as error:
        raise ConfigurationError(
            f"ONNX needs {error.name}, which is not installed; run {how_to_add('onnx')}"
        ) from None


def _initial_state(controller: LoadedController) -> State:
    """Return the initial values of the file's state: that of the step, and the last command."""
    state = {name: np.asarray(value) for name, value in controller.step.init()._asdict().items()}
    at_rest = np.array((controller.limits.rest_angle, controller.limits.velocity_min), np.float32)
    return state | {LAST_COMMAND: at_rest}


def _build_graph(controller: LoadedController, initial: State) -> Any:
    """Return the ONNX model of the step, with the names and shapes of the file's inputs."""
    import ndonnx

    limits = controller.limits
    ranges = ((limits.angle_min, limits.angle_max), (limits.velocity_min, limits.velocity_max))
    measured = {
        name: ndonnx.argument(shape=shape, dtype=ndonnx.float32)
        for name, shape in MEASURED_SHAPES.items()
    }
    state = {
        name: ndonnx.argument(shape=value.shape, dtype=ndonnx.from_numpy_dtype(value.dtype))
        for name, value in initial.items()
    }
    now = ndonnx.concat([ndonnx.reshape(measured["angle"], (1,)), measured["reference"]])
    # Without this, the memory of a policy would keep a NaN forever.
    is_usable = ndonnx.all(ndonnx.abs(now) <= MAX_MEASUREMENT)
    last_command = state[LAST_COMMAND]
    before = type(controller.step.init())(
        **{name: value for name, value in state.items() if name != LAST_COMMAND}
    )
    after, action = controller.step.act(OnnxOperations(), before, now)
    outputs = {}
    command: Any = action_to_command(limits, action)
    for index, name in enumerate(COMMAND_OUTPUTS):
        low, high = map(np.float32, ranges[index])
        # One float32 inwards, because rounding may have moved the ends beyond the limits.
        least = float(np.nextafter(low, high))
        value = ndonnx.clip(command[index], least, float(np.nextafter(high, low)))
        outputs[name] = ndonnx.where(is_usable, value, last_command[index])
    for name, value in after._asdict().items():
        value = ndonnx.reshape(value, initial[name].shape)
        outputs[f"{NEXT}{name}"] = ndonnx.where(is_usable, value, state[name])
    outputs[f"{NEXT}{LAST_COMMAND}"] = ndonnx.stack([outputs[name] for name in COMMAND_OUTPUTS])
    return ndonnx.build(measured | state, outputs)


def _describe(model: Any, controller: LoadedController, initial: State) -> None:
    """Add the metadata and the initial values of the state to a model, and check it."""
    import onnx

    version = importlib.metadata.version("softfin")
    model.ir_version = IR_VERSION
    model.producer_name = "softfin"
    model.producer_version = version
    model.graph.name = f"{controller.kind} controller"
    properties: JsonObject = {"softfin": version, **_metadata(controller), "state": {}}
    for name, value in initial.items():
        properties["state"][name] = f"{NEXT}{name}"
        properties[f"initial_{name}"] = value.tolist()
    for name, entry in properties.items():
        if not isinstance(entry, str):
            properties[name] = json.dumps(entry)
    onnx.helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)


def _metadata(controller: LoadedController) -> JsonObject:
    """Return the metadata that users of the file need."""
    artifact = controller.artifact
    return {
        "controller": artifact.name,
        "kind": controller.kind,
        "action_rate_hz": controller.clock.rate_hz,
        "action_ticks_of_10_ms": list(controller.clock.ticks),
        "window_actions": controller.clock.window_actions,
        "limits": controller.limits.to_dict(),
        "cells_n": [{"low": list(cell.low), "high": list(cell.high)} for cell in controller.cells],
        "reachable": artifact.description.get("reachable"),
        "training_range": artifact.description.get("training_range"),
        "fin": artifact.fin,
        "force_frame": FORCE_FRAME,
        "inputs": {
            "angle": "last reading of the shaft angle [rad]; before the first reading, the angle "
            "at rest",
            "force": "(x, y), mean of the readings since the last action [N]; 0 before the first "
            "action; not used yet",
            "reference": "(x, y), mean force to hold [N]",
        },
        "unusable_inputs": "while the angle or the reference is NaN, infinite or beyond "
        f"{MAX_MEASUREMENT:g}, the last command is repeated and the state does not change",
        "outputs": {
            "command_angle": "[rad]",
            "command_velocity": "velocity limit of the motion to this angle [rad/s]",
        },
        "weights_sha256": artifact.weights_sha256,
    }


def _difference(data: bytes, controller: LoadedController) -> float:
    """Return the largest difference in commands over an episode.

    The reference steps and drifts over all cells and slightly beyond. Each implementation continues
    from its own state, so accumulating errors show up.
    """
    import onnxruntime

    numbers = np.random.default_rng(0)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    native = controller.step.init()
    state = _initial_state(controller)
    box = bounding_box(controller.cells)
    low = np.asarray(box.low)
    high = np.asarray(box.high)
    worst = 0.0
    reference = (low + high) / 2
    for index in range(EPISODE):
        # A step every 5 s, and a random walk in between.
        if index % 15 == 0:
            reference = numbers.uniform(low - 0.2, high + 0.2)
        reference = reference + numbers.uniform(-0.1, 0.1, 2)
        angle = numbers.uniform(*controller.limits[:2])
        force = numbers.normal(size=2)
        fed = {"angle": angle, "force": force, "reference": reference}
        inputs = {name: np.asarray(value, np.float32) for name, value in fed.items()}
        exported_angle, exported_velocity, *after = session.run(None, inputs | state)
        state = dict(zip(state, after, strict=True))
        native, command = controller.act(native, Measured(float(angle), force), reference)
        difference = np.abs(np.array(command) - (exported_angle, exported_velocity)).max()
        # NaN must not be treated as no difference.
        worst = max(worst, float(difference)) if difference == difference else np.inf
    return worst
