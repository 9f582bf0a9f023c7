"""A controller's step as ONNX: measurements, reference and state in, command and next state out,
three times a second.

The step is traced from the formulas that NumPy runs on the robot, with ndonnx in its place; before
the file is kept, onnxruntime plays an episode from it and the two are compared. Needs the extra
``softfin[onnx]``.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from softfin.control.controller import LoadedController, Measured
from softfin.core.action_clock import ACTION_RATE_HZ, ACTION_TICKS
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import action_to_command
from softfin.storage.artifact import check_file
from softfin.storage.onnx_file import (
    FORCE_FRAME,
    NEXT,
    OPSET,
    Exported,
    encode_model,
    import_extra,
    keep_model,
    open_session,
)

COMMAND_OUTPUTS = ("command_angle", "command_velocity")

NEEDED = ("ndonnx", "onnx", "onnxruntime", "onnx.version_converter", "spox.opset.ai.onnx.v17")
"""Modules of the extra; ndonnx builds graphs with spox."""

MAX_COMMAND_DIFFERENCE = 1e-4
"""A file whose commands differ by more from NumPy's is not written [rad, rad/s]."""

EPISODE = 240
"""Actions that are compared."""


class OnnxOperations(Operations):
    """The operations of ndonnx; both of two choices are in the graph."""

    def __init__(self, ndonnx: Any) -> None:
        self.xp = ndonnx
        self._operators = importlib.import_module(NEEDED[-1])
        self._constants: dict[int, tuple[np.ndarray, Array]] = {}

    def row(self, table: Array, index: Number) -> Array:
        """Add a Gather."""
        if isinstance(index, int):
            return table[index, ...]
        return self.xp.take(table, self.xp.reshape(index, (1,)), axis=0)[0, ...]

    def choose(
        self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]
    ) -> Any:
        """Add a Where for each part, unless the choice is known now."""
        if isinstance(condition, bool | np.bool_):
            return then() if condition else otherwise()
        one = then()
        other = otherwise()
        if isinstance(one, tuple):
            return tuple(self.xp.where(condition, a, b) for a, b in zip(one, other, strict=True))
        return self.xp.where(condition, self.xp.asarray(one), self.xp.asarray(other))

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Add a plain MatMul: that of ndonnx comes with branches for arrays without elements."""
        product = self._operators.matmul(vector.unwrap_spox(), matrix.unwrap_spox())
        return self.xp.asarray(product)

    def whole(self, number: Number) -> Number:
        """Add a Cast."""
        return self.xp.astype(number, self.xp.int64)

    def real(self, number: Number) -> Number:
        """Add a Cast."""
        return self.xp.astype(number, self.xp.float32)

    def clip(self, number: Number, low: Number, high: Number) -> Number:
        """Add a Clip."""
        return self.xp.clip(number, low, high)

    def constant(self, values: Any) -> Any:
        """Add one constant for each array."""
        if isinstance(values, tuple):
            return type(values)(*map(self.constant, values))
        # The array is kept, so that its id stays its own.
        return self._constants.setdefault(id(values), (values, self.xp.asarray(values)))[1]


def export_onnx(controller: LoadedController, file: Path, overwrite: bool = False) -> Exported:
    """Write the step to a file, checked by onnx and run by onnxruntime.

    Raises:
        ConfigurationError: the extra is missing.
        ArtifactError: there is a file already.
        RunError: the exported step gives other commands than NumPy; nothing is written.
    """
    check_file(file, overwrite, "--onnx")
    ndonnx, onnx, *_ = import_extra(*NEEDED)
    initial = {name: np.asarray(value) for name, value in controller.step.init()._asdict().items()}
    model = _traced(ndonnx, onnx, controller)
    data = encode_model(model, f"{controller.kind} controller", initial, _metadata(controller))
    return keep_model(file, data, "commands", _difference(data, controller), MAX_COMMAND_DIFFERENCE)


def _traced(ndonnx: Any, onnx: Any, controller: LoadedController) -> Any:
    """Build the graph, with the names and shapes of the file's signature."""
    initial = controller.step.init()
    start = {name: np.asarray(value) for name, value in initial._asdict().items()}
    state = {
        name: ndonnx.argument(shape=value.shape, dtype=ndonnx.from_numpy_dtype(value.dtype))
        for name, value in start.items()
    }
    shapes = {"angle": (), "force": (2,), "reference": (2,)}
    measured = {
        name: ndonnx.argument(shape=shape, dtype=ndonnx.float32) for name, shape in shapes.items()
    }
    now = ndonnx.concat([ndonnx.reshape(measured["angle"], (1,)), measured["reference"]])
    after, action = controller.step.act(OnnxOperations(ndonnx), type(initial)(**state), now)
    commands = dict(zip(COMMAND_OUTPUTS, action_to_command(controller.limits, action), strict=True))
    for name, low, high in zip(
        COMMAND_OUTPUTS, controller.limits[::2], controller.limits[1::2], strict=True
    ):
        # Rounding must not lead out of the limits: the nearest float32 that is not beyond each.
        least = np.float32(low)
        most = np.float32(high)
        least = np.nextafter(least, np.float32(np.inf)) if least < low else least
        most = np.nextafter(most, np.float32(-np.inf)) if most > high else most
        commands[name] = ndonnx.clip(commands[name], float(least), float(most))
    following = {
        f"{NEXT}{name}": ndonnx.reshape(value, start[name].shape)
        for name, value in after._asdict().items()
    }
    model = onnx.version_converter.convert_version(
        ndonnx.build(measured | state, commands | following), OPSET
    )
    for cast in (node for node in model.graph.node if node.op_type == "Cast"):
        # The converter leaves what concerns numbers of eight bits, which came later and are not
        # here.
        cast.attribute.remove(next(each for each in cast.attribute if each.name == "saturate"))
    return model


def _metadata(controller: LoadedController) -> dict[str, Any]:
    """Facts that a user of the file must know."""
    artifact = controller.artifact
    return {
        "controller": artifact.name,
        "kind": controller.kind,
        "action_rate_hz": ACTION_RATE_HZ,
        "action_ticks_of_10_ms": list(ACTION_TICKS),
        "limits": controller.limits.to_dict(),
        "cells_n": [{"low": list(cell.low), "high": list(cell.high)} for cell in controller.cells],
        "reachable": artifact.description.get("reachable"),
        "training_range": artifact.description.get("training_range"),
        "fin": artifact.fin,
        "force_frame": FORCE_FRAME,
        "inputs": {
            "angle": "angle of the shaft, the last reading [rad]; 0 before the first",
            "force": "(x, y), mean of the readings since the last action [N]; 0 before the first; "
            "not used yet",
            "reference": "(x, y), mean force to hold [N]",
        },
        "outputs": {
            "command_angle": "[rad]",
            "command_velocity": "profile velocity on the way there [rad/s]",
        },
        "weights_sha256": artifact.weights_sha256,
    }


def _difference(data: bytes, controller: LoadedController) -> float:
    """Compare the commands over an episode of steps and drifts all over the cells and a little
    beyond.

    Both carry their own state on, so errors that add up show. Returns the greatest difference.
    """
    numbers = np.random.default_rng(0)
    session = open_session(data)
    native = controller.step.init()
    state = {name: np.asarray(value) for name, value in native._asdict().items()}
    low = np.min([c.low for c in controller.cells], axis=0)
    high = np.max([c.high for c in controller.cells], axis=0)
    worst = 0.0
    reference = (low + high) / 2
    for index in range(EPISODE):
        if index % 15 == 0:
            reference = numbers.uniform(low - 0.2, high + 0.2)
        reference = reference + numbers.uniform(-0.1, 0.1, 2)
        angle = numbers.uniform(*controller.limits[:2])
        force = numbers.normal(size=2)
        fed = {"angle": angle, "force": force, "reference": reference}
        found = session.run(
            None, {name: np.asarray(value, np.float32) for name, value in fed.items()} | state
        )
        state = dict(zip(state, found[len(COMMAND_OUTPUTS) :], strict=True))
        native, command = controller.act(native, Measured(float(angle), force), reference)
        difference = np.abs(np.array(command) - np.array(found[: len(COMMAND_OUTPUTS)])).max()
        # Not a number is a difference, too.
        worst = max(worst, float(difference)) if difference == difference else np.inf
    return worst
