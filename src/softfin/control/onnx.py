"""A controller's step as ONNX: measurements, reference and state in, command and next state out, three times a second.

The step is traced from the very formulas that NumPy runs on the robot, with ndonnx in its place; before the file is
kept, onnxruntime plays an episode from it and the two are compared. Needs the extra ``softfin[onnx]``.
"""

import importlib
import importlib.metadata
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softfin.control.native.controller import NativeController
from softfin.control.native.operations import Array, Number
from softfin.core.action_clock import ACTION_TICKS
from softfin.core.errors import ConfigurationError, RunError
from softfin.storage.artifact import write_file
from softfin.storage.paths import check_onnx

OPSET = 17
"""Of ONNX: what onnxruntime 1.12 (2022) and everything after it runs."""

IR_VERSION = 8
"""Of the file, likewise."""

COMMANDS = ("command_angle", "command_velocity")

NEXT = "next_"
"""Before the name of a state tensor, the output that is its input at the next action."""

NEEDED = ("ndonnx", "onnx", "onnxruntime", "onnx.version_converter", "spox.opset.ai.onnx.v17")
"""Of the extra; spox is what ndonnx builds graphs with."""

TOLERANCE = 1e-4
"""A file whose commands differ by more from the native ones is not written [rad, rad/s]."""

EPISODE = 240
"""Actions that are compared."""


class Exported(NamedTuple):
    """What was written."""

    bytes: int
    worst: float
    """Greatest difference from the native controller over the episode [rad, rad/s]."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class Tracing:
    """The operations of ndonnx: both of two choices are in the graph."""

    def __init__(self, ndonnx: Any) -> None:
        self.xp, self._operators = ndonnx, importlib.import_module(NEEDED[-1])
        self._constants: dict[int, tuple[np.ndarray, Array]] = {}

    def row(self, table: Array, index: Number) -> Array:
        """As a Gather."""
        if isinstance(index, int):
            return table[index, ...]
        return self.xp.take(table, self.xp.reshape(index, (1,)), axis=0)[0, ...]

    def choose(self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """As a Where, one for each part."""
        one, other = then(), otherwise()
        if isinstance(one, tuple):
            return tuple(self.xp.where(condition, a, b) for a, b in zip(one, other, strict=True))
        return self.xp.where(condition, self.xp.asarray(one), self.xp.asarray(other))

    def dot(self, vector: Array, matrix: Array) -> Array:
        """As a plain MatMul: that of ndonnx comes with branches for arrays without elements."""
        product = self._operators.matmul(vector.unwrap_spox(), matrix.unwrap_spox())
        return self.xp.asarray(product)

    def whole(self, number: Number) -> Number:
        """As a Cast."""
        return self.xp.astype(number, self.xp.int64)

    def real(self, number: Number) -> Number:
        """As a Cast."""
        return self.xp.astype(number, self.xp.float32)

    def constant(self, values: np.ndarray) -> Array:
        """One in the graph for each array."""
        # The array is kept, so that its id stays its own.
        return self._constants.setdefault(id(values), (values, self.xp.asarray(values)))[1]


def export_onnx(controller: NativeController, file: Path, overwrite: bool = False) -> Exported:
    """Write the step to a file, checked by onnx and run by onnxruntime.

    Raises:
        ConfigurationError: the extra is missing.
        ArtifactError: there is a file already.
        RunError: the exported step is not the native one; nothing is written.
    """
    check_onnx(file, overwrite)
    ndonnx, onnx, runtime = _extra()
    model = _described(onnx, _traced(ndonnx, onnx, controller), controller)
    onnx.checker.check_model(model, full_check=True)
    data: bytes = model.SerializeToString()
    worst = _difference(runtime, data, controller)
    if not worst <= TOLERANCE:
        raise RunError(f"{file}: onnxruntime's commands differ by {worst:.2g} from softfin's (bar {TOLERANCE:g}); "
                       "not written; export with another version of onnxruntime")  # fmt: skip
    write_file(file, data)
    names = tuple(tuple(each.name for each in part) for part in (model.graph.input, model.graph.output))
    return Exported(len(data), worst, *names)


def _extra() -> tuple[Any, Any, Any]:
    try:
        ndonnx, onnx, runtime, *_ = (importlib.import_module(name) for name in NEEDED)
    except ImportError as error:
        raise ConfigurationError(f"ONNX needs {error.name}, an extra: pip install softfin[onnx]") from None
    return ndonnx, onnx, runtime


def _traced(ndonnx: Any, onnx: Any, controller: NativeController) -> Any:
    """The graph, with names and shapes as on the file's signature."""
    initial = controller.step.init()
    start = {name: np.asarray(value) for name, value in initial._asdict().items()}
    state = {
        name: ndonnx.argument(shape=value.shape, dtype=ndonnx.from_numpy_dtype(value.dtype))
        for name, value in start.items()
    }
    shapes = {"angle": (), "force": (2,), "reference": (2,)}
    measured = {name: ndonnx.argument(shape=shape, dtype=ndonnx.float32) for name, shape in shapes.items()}
    now = ndonnx.concat([ndonnx.reshape(measured["angle"], (1,)), measured["reference"]])
    after, action = controller.step.act(Tracing(ndonnx), type(initial)(**state), now)
    limits, share = controller.limits, (action + 1) / 2
    commands = {
        "command_angle": limits.angle_min + share[0] * (limits.angle_max - limits.angle_min),
        "command_velocity": limits.velocity_min + share[1] * (limits.velocity_max - limits.velocity_min),
    }
    for name, low, high in zip(COMMANDS, limits[::2], limits[1::2], strict=True):
        # Rounding must not lead out of the limits.
        commands[name] = ndonnx.clip(commands[name], _inner(low, up=True), _inner(high, up=False))
    following = {f"{NEXT}{name}": ndonnx.reshape(value, start[name].shape) for name, value in after._asdict().items()}
    model = onnx.version_converter.convert_version(ndonnx.build(measured | state, commands | following), OPSET)
    for cast in (node for node in model.graph.node if node.op_type == "Cast"):
        # The converter leaves what concerns numbers of eight bits, which came later and are not here.
        cast.attribute.remove(next(each for each in cast.attribute if each.name == "saturate"))
    return model


def _inner(limit: float, up: bool) -> float:
    """The nearest float32 that is not beyond the limit."""
    near = np.float32(limit)
    beyond = near < limit if up else near > limit
    return float(np.nextafter(near, np.float32(np.inf if up else -np.inf)) if beyond else near)


def _described(onnx: Any, model: Any, controller: NativeController) -> Any:
    """With what whoever runs it must know, as metadata: texts, and JSON where they are more than a word."""
    model.ir_version = IR_VERSION
    version = importlib.metadata.version("softfin")
    model.producer_name, model.producer_version = "softfin", version
    model.graph.name = f"{controller.kind} controller"
    state = {name: np.asarray(value) for name, value in controller.step.init()._asdict().items()}
    facts = {
        "softfin": version,
        "controller": controller.name,
        "kind": controller.kind,
        "action_rate_hz": controller.action_rate_hz,
        "action_ticks_of_10_ms": list(ACTION_TICKS),
        "limits": controller.limits.described(),
        "cells_n": [{"low": list(cell.low), "high": list(cell.high)} for cell in controller.cells],
        "reachable": controller.description.get("reachable"),
        "training_range": controller.description.get("training_range"),
        "fin": controller.fin,
        "force_frame": "of the fin on its mount: +x is the thrust that pushes the robot forward; at angle theta the "
        "fin points along (-cos theta, +sin theta) from its shaft",
        "inputs": {
            "angle": "of the shaft, the last reading [rad]; 0 before the first",
            "force": "(x, y), mean of the readings since the last action [N]; 0 before the first; not looked at yet",
            "reference": "(x, y), mean force to hold [N]",
        },
        "outputs": {"command_angle": "[rad]", "command_velocity": "of the profile on the way there [rad/s]"},
        "state": {name: f"{NEXT}{name}" for name in state},
        "weights_sha256": controller.weights_sha256,
    }  # fmt: skip
    facts |= {f"initial_{name}": value.tolist() for name, value in state.items()}
    onnx.helper.set_model_props(
        model, {name: fact if isinstance(fact, str) else json.dumps(fact) for name, fact in facts.items()}
    )
    return model


def _difference(runtime: Any, data: bytes, controller: NativeController) -> float:
    """Greatest difference of the commands, over an episode of steps and drifts all over the cells and a little beyond.

    Both carry their own state on, so what adds up shows.
    """
    numbers = np.random.default_rng(0)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    native = controller.step.init()
    state = {name: np.asarray(value) for name, value in native._asdict().items()}
    low, high = np.min([c.low for c in controller.cells], axis=0), np.max([c.high for c in controller.cells], axis=0)
    plain = controller.untrimmed()
    worst, reference = 0.0, (low + high) / 2
    for index in range(EPISODE):
        if index % 15 == 0:
            reference = numbers.uniform(low - 0.2, high + 0.2)
        reference = reference + numbers.uniform(-0.1, 0.1, 2)
        angle, force = numbers.uniform(*controller.limits[:2]), numbers.normal(size=2)
        fed = {"angle": angle, "force": force, "reference": reference}
        found = session.run(None, {name: np.asarray(value, np.float32) for name, value in fed.items()} | state)
        state = dict(zip(state, found[len(COMMANDS) :], strict=True))
        native, target = plain.act(native, angle, (float(force[0]), float(force[1])), tuple(reference.tolist()))
        difference = np.abs(np.array(target) - np.array(found[: len(COMMANDS)])).max()
        # Not a number is a difference, too.
        worst = max(worst, float(difference)) if difference == difference else np.inf
    return worst
