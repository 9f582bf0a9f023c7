"""Export a controller's step as ONNX: measurements, reference and state in, command and next state
out, three times per second.

JAX traces the same formulas that NumPy runs on the robot. Before the file is written, the commands
of onnxruntime and NumPy are compared over an episode. Requires the extra ``softfin[onnx]``.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from softfin.control.controller import LoadedController, Measured
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, jax_operations
from softfin.core.quantities import action_to_command
from softfin.gaits.reachable import bounding_box
from softfin.storage.artifact import check_file
from softfin.storage.onnx_file import (
    FORCE_FRAME,
    NEXT,
    Exported,
    encode_model,
    import_extra,
    keep_model,
    open_session,
)

COMMAND_OUTPUTS = ("command_angle", "command_velocity")
MEASURED_SHAPES: dict[str, tuple[int, ...]] = {"angle": (), "force": (2,), "reference": (2,)}

MAX_COMMAND_DIFFERENCE = 1e-4
"""Maximum difference from NumPy's commands [rad, rad/s]; if it is larger, no file is written."""

EPISODE = 240
"""Number of actions in the comparison."""


def export_onnx(controller: LoadedController, file: Path, overwrite: bool = False) -> Exported:
    """Write the step to a file, checked by onnx and run by onnxruntime.

    Raises:
        ConfigurationError: the extra is not installed.
        ArtifactError: the file already exists.
        RunError: the exported step's commands differ from NumPy's; nothing is written.
    """
    check_file(file, overwrite, "--onnx")
    import_extra("spox", "onnx", "onnxruntime")
    from softfin.storage.onnx_graph import build_graph

    initial = _named_state(controller.step.init())
    measured = {name: np.zeros(shape, np.float32) for name, shape in MEASURED_SHAPES.items()}
    model = build_graph(_step_function(controller), measured | initial)
    data = encode_model(model, f"{controller.kind} controller", initial, _metadata(controller))
    return keep_model(file, data, "commands", _difference(data, controller), MAX_COMMAND_DIFFERENCE)


def _named_state(state: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in state._asdict().items()}


def _step_function(controller: LoadedController) -> Callable[..., dict[str, Array]]:
    """Return the step as a JAX function from the file's inputs to its outputs."""
    operations = jax_operations()
    jnp = operations.xp
    limits = controller.limits
    ranges = ((limits.angle_min, limits.angle_max), (limits.velocity_min, limits.velocity_max))

    def step(angle: Array, force: Array, reference: Array, **state: Array) -> dict[str, Array]:
        now = jnp.concatenate([angle[None], reference])
        before = type(controller.step.init())(**state)
        after, action = controller.step.act(operations, before, now)
        outputs = {}
        command = action_to_command(limits, action)
        for name, value, (low, high) in zip(COMMAND_OUTPUTS, command, ranges, strict=True):
            outputs[name] = jnp.clip(value, *_round_inwards(low, high))
        for name, value in after._asdict().items():
            outputs[f"{NEXT}{name}"] = jnp.reshape(value, jnp.shape(state[name]))
        return outputs

    return step


def _round_inwards(low: float, high: float) -> tuple[np.float32, np.float32]:
    """Round the range inwards to float32, so that clipped commands never exceed the limits."""
    first = np.float32(low)
    last = np.float32(high)
    if first < low:
        first = np.nextafter(first, np.float32(np.inf))
    if last > high:
        last = np.nextafter(last, np.float32(-np.inf))
    return first, last


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
            "angle": "angle of the shaft, the last reading [rad]; before the first, "
            "the angle at rest",
            "force": "(x, y), mean of the readings since the last action [N]; 0 before the first; "
            "not used yet",
            "reference": "(x, y), mean force to hold [N]",
        },
        "outputs": {
            "command_angle": "[rad]",
            "command_velocity": "velocity limit of the motion to it [rad/s]",
        },
        "weights_sha256": artifact.weights_sha256,
    }


def _difference(data: bytes, controller: LoadedController) -> float:
    """Return the largest difference in commands over an episode.

    The reference steps and drifts over all cells and slightly beyond. Each implementation continues
    from its own state, so accumulating errors show up.
    """
    numbers = np.random.default_rng(0)
    session = open_session(data)
    native = controller.step.init()
    state = _named_state(native)
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
        # NaN, which is not equal to itself, must not pass as no difference.
        worst = max(worst, float(difference)) if difference == difference else np.inf
    return worst
