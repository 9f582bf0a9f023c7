"""Exports a 10 ms step of a surrogate to ONNX, for Simulink or Gazebo: command and state in,
reading and next state out.

The step is traced from the surrogate's JAX program (`softfin.storage.onnx_graph`). The file is
written only if onnxruntime agrees with JAX over a free run of 30 s with random commands. Requires
the extra ``softfin[onnx]``.
"""

import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from softfin.core.plant import EnsemblePlant, roll
from softfin.core.quantities import RATE_HZ, Command
from softfin.data.excitation import ExcitationConfig
from softfin.storage import artifact as artifacts
from softfin.storage.onnx_file import (
    FORCE_FRAME,
    NEXT,
    Exported,
    encode_model,
    import_extra,
    keep_model,
    open_session,
)
from softfin.surrogate.protocol import SurrogatePlant
from softfin.surrogate.store import SURROGATE_KIND, load_surrogate

CHECK_S = 30
"""Duration of the free run that compares onnxruntime with JAX [s]."""

MAX_READING_DIFFERENCE = 1e-3
"""Maximum difference between onnxruntime and JAX in angle [rad], velocity [rad/s] and force [N]; if
it is larger, no file is written."""

COMPARED_OUTPUTS = ("angle", "velocity", "force")
"""Outputs compared with JAX."""


def export_surrogate(folder: Path, file: Path, overwrite: bool = False) -> Exported:
    """Export one step of the surrogate in a folder, and check the file with onnx and onnxruntime.

    Raises:
        ConfigurationError: the extra is missing.
        ArtifactError: the file already exists, or the folder contains no surrogate.
        RunError: the exported step's outputs differ from JAX's; no file is written.
    """
    artifacts.check_file(file, overwrite, "--onnx")
    import_extra("spox", "onnx", "onnxruntime")
    from softfin.storage.onnx_graph import build_graph

    surrogate = load_surrogate(folder)
    start: PyTree = surrogate.init(jax.random.key(0))
    flat, unpack = ravel_pytree(start[1:])

    def step(command_angle: Array, command_velocity: Array, state: PyTree) -> dict[str, Any]:
        # The exported state omits the first field, the tick counter, which affects only the time.
        now = start._replace(**dict(zip(start._fields[1:], unpack(state), strict=True)))
        command = Command(command_angle, command_velocity)
        after: PyTree
        if isinstance(surrogate, EnsemblePlant):
            after, each = surrogate.advance_members(now, command, 1)
            reading = jax.tree.map(lambda channel: channel.mean(axis=0), each)
            more = {"force_members": each.force[:, 0], "distance": surrogate.distance(after)}
        else:
            after, reading = surrogate.advance(now, command, 1)
            more = {}
        own = {name: getattr(reading, name)[0] for name in COMPARED_OUTPUTS}
        return {**own, **more, f"{NEXT}state": ravel_pytree(after[1:])[0]}

    initial = {"state": np.asarray(flat)}
    number = np.zeros((), np.float32)
    model = build_graph(step, {"command_angle": number, "command_velocity": number} | initial)
    data = encode_model(
        model, f"{surrogate.model} surrogate", initial, _metadata(surrogate, folder)
    )
    return keep_model(
        file, data, "readings", _difference(data, surrogate, initial), MAX_READING_DIFFERENCE
    )


def _metadata(surrogate: SurrogatePlant, folder: Path) -> dict[str, Any]:
    """Return the metadata stored in the file: units, rate, limits and training range."""
    description = artifacts.load_description(folder, SURROGATE_KIND)
    outputs = {
        "angle": "angle of the shaft [rad]",
        "velocity": "angular velocity of the shaft [rad/s]",
        "force": "(x, y) [N]",
    }
    if isinstance(surrogate, EnsemblePlant):
        outputs |= {
            "force_members": "(members, 2), force predicted by each member [N]; force is their "
            "mean",
            "distance": "distance of the motion from the training data; above 1, the motion is out "
            "of distribution",
        }
    return {
        "surrogate": folder.resolve().name,
        "model": surrogate.model,
        "rate_hz": RATE_HZ,
        "limits": surrogate.limits.to_dict(),
        "training_range": description.get("training_range"),
        "interval": description.get("interval"),
        "fin": description.get("fin"),
        "force_frame": FORCE_FRAME,
        "inputs": {
            "command_angle": "target angle, held for the 10 ms of the step [rad]",
            "command_velocity": "profile velocity of the move to the target angle [rad/s]",
        },
        "outputs": outputs,
        "weights_sha256": hashlib.sha256((folder / artifacts.WEIGHTS).read_bytes()).hexdigest(),
    }


def _difference(data: bytes, surrogate: SurrogatePlant, state: dict[str, np.ndarray]) -> float:
    """Return the largest difference between onnxruntime and JAX in a free run.

    Each continues from its own state, so that differences may grow as they do in use.
    """
    commands = Command(*ExcitationConfig()(jax.random.key(0), CHECK_S * RATE_HZ, surrogate.limits))
    start = surrogate.init(jax.random.key(0))
    reading = jax.jit(lambda start, commands: roll(surrogate, start, commands)[1])(start, commands)
    session = open_session(data)
    worst = 0.0
    names = [each.name for each in session.get_outputs()]
    readings = {name: np.asarray(getattr(reading, name)) for name in COMPARED_OUTPUTS}
    angles, velocities = map(np.asarray, commands)
    for index, (angle, velocity) in enumerate(zip(angles, velocities, strict=True)):
        now = {"command_angle": np.asarray(angle), "command_velocity": np.asarray(velocity)}
        values = session.run(None, now | state)
        found = dict(zip(names, values, strict=True))
        state = {name: found[f"{NEXT}{name}"] for name in state}
        for name, rows in readings.items():
            difference = float(np.abs(found[name] - rows[index]).max())
            # max() would ignore NaN, which must fail the check.
            worst = max(worst, difference) if difference == difference else np.inf
    return worst
