"""The step of a policy: observation and memory in, memory and action out (paper Sec. III-C2).

    gates   = [observation, hidden] kernel + bias
    cell'   = s(f) cell + s(i) tanh(g)
    hidden' = s(o) tanh(cell')
    action  = tanh(tanh(hidden' W + b) V + c + atanh(gait))

It is the LSTM of Hochreiter and Schmidhuber (1997) with forget gates, and one layer behind it. Two
things are folded into the weights when they are read: the units and the normalisation of the
observation, and 1/2 for the gates, since the logistic function is s(x) = 1/2 + tanh(x / 2) / 2, so
that one tanh computes all four gates. Policies that did not start from gaits lack this term.
"""

from typing import NamedTuple

import numpy as np
import pydantic

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import GaitTable, NamedArrays

MEASURED = 3
"""Numbers in an observation before the past actions: angle [rad] and reference (x, y) [N]."""

ANGLE_SCALE_RAD = np.pi / 2
"""Unit of observed angles in training."""

GAITS = "gaits"
"""Prefix of the names of a policy's gait arrays."""

MAX_ACTION = np.float32(0.999)
"""Factor of gait actions before their atanh, which has no value at 1."""

MIN_DEVIATION = 0.1
"""Smallest deviation by which observations are divided."""

_TURN = np.arange(CYCLE_ACTIONS, dtype=np.float32) * np.float32(2 * np.pi / CYCLE_ACTIONS)
PHASES = np.stack([np.sin(_TURN), np.cos(_TURN)], axis=1)
"""Sine and cosine of the clock's phase at each of the six actions."""


class PolicyObservation(pydantic.BaseModel, frozen=True):
    """The part of a task's configuration that defines a policy's observations."""

    past_actions: int = pydantic.Field(default=3, ge=0)
    """Number of observed actions before the last one."""
    phase: bool = False
    """Whether the clock's phase is observed."""
    force_scale_n: pydantic.PositiveFloat = 3.0
    """Unit of observed references in training [N]."""

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return MEASURED + 2 * (self.past_actions + 1) + (PHASES.shape[1] if self.phase else 0)

    def units(self) -> np.ndarray:
        """Return the training unit of each number of an observation."""
        units = np.ones(self.size)
        units[:MEASURED] = ANGLE_SCALE_RAD, self.force_scale_n, self.force_scale_n
        return units

    def observe(self, ops: Operations, now: Array, actions: Array, age: Number) -> Array:
        """Return the observation in SI units; it contains the first of the past `actions`, of which
        the last one comes first."""
        parts = [now, actions[: 2 * (self.past_actions + 1)]]
        if self.phase:
            parts.append(ops.row(ops.constant(PHASES), age % CYCLE_ACTIONS))
        return ops.xp.concat(parts)


class PolicyMemory(NamedTuple):
    """State of an LSTM."""

    hidden: Array
    cell: Array


class PolicyNetwork(NamedTuple):
    """Weights as used: gates in the order input, forget, output, cell; those of a grid have a
    leading axis."""

    kernel: Array
    """Weights of observation and hidden state, ``(observations + units, 4 units)``."""
    bias: Array
    hidden: Array
    hidden_bias: Array
    output: Array
    output_bias: Array

    def empty(self) -> PolicyMemory:
        """Return the memory before the first step."""
        units = int(self.bias.shape[-1]) // 4
        return PolicyMemory(np.zeros(units, np.float32), np.zeros(units, np.float32))

    def remember(self, ops: Operations, memory: PolicyMemory, observation: Array) -> PolicyMemory:
        """Do one step of the LSTM."""
        xp = ops.xp
        units = self.bias.shape[-1] // 4
        gates = xp.tanh(ops.dot(xp.concat([observation, memory.hidden]), self.kernel) + self.bias)
        opened = 0.5 * gates[: 3 * units] + 0.5
        cell = opened[units : 2 * units] * memory.cell + opened[:units] * gates[3 * units :]
        return PolicyMemory(opened[2 * units :] * xp.tanh(cell), cell)

    def action(
        self,
        ops: Operations,
        memory: PolicyMemory,
        gaits: GaitTable | None,
        reference: Array,
        age: Number,
    ) -> Array:
        """Compute the deterministic action in [-1, 1]^2, the `age`-th since the start, for a
        reference [N]."""
        tanh = ops.xp.tanh
        inner = tanh(ops.dot(memory.hidden, self.hidden) + self.hidden_bias)
        before = ops.dot(inner, self.output) + self.output_bias
        if gaits is not None:
            before = before + gait_before_tanh(ops, gaits, reference, age)
        return tanh(before)


def gait_before_tanh(ops: Operations, gaits: GaitTable, reference: Array, age: Number) -> Array:
    """Return the atanh of the action, the `age`-th since the start, of the gait for a reference."""
    # The atanh has no value at 1.
    return ops.xp.atanh(MAX_ACTION * ops.row(gaits.gait(reference, ops), age % CYCLE_ACTIONS))


def fold(
    arrays: NamedArrays, observation: PolicyObservation, stack: tuple[int, ...] = ()
) -> tuple[PolicyNetwork, GaitTable | None]:
    """Build a network from a trained policy's named arrays, or from policies stacked along a
    leading axis.

    Returns it with the gaits that its actions are added to, over references in N, if the policy
    started from gaits. Raises ValueError if arrays are missing, unknown or of another shape.
    """
    gait_arrays = {name: array for name, array in arrays.items() if name.startswith(f"{GAITS}.")}
    gaits = _gaits(gait_arrays, observation)
    arrays = {name: array for name, array in arrays.items() if name not in gait_arrays}
    # The first axis of a layer's kernel is as long as its input; a missing array is refused below.
    units, width = (
        sum(np.shape(arrays.get(f"net.{layer}.kernel", ()))[-2:-1])
        for layer in ("hidden", "output")
    )
    size = observation.size
    shapes: dict[str, tuple[int, ...]] = {
        "net.lstm.kernel": (size, 4 * units),
        "net.lstm.recurrent": (units, 4 * units),
        "net.lstm.bias": (4 * units,),
        "net.hidden.kernel": (units, width),
        "net.hidden.bias": (width,),
        "net.output.kernel": (width, 2),
        "net.output.bias": (2,),
        "normalisation.mean": (size,),
        "normalisation.deviation": (size,),
        "normalisation.count": (),
        "log_deviation": (2,),
    }
    if odd := sorted(set(shapes) ^ set(arrays)):
        raise ValueError(f"weights {', '.join(odd)[:200]} are missing or unknown")
    for name, shape in shapes.items():
        if arrays[name].shape != stack + shape:
            raise ValueError(
                f"{name} has shape {arrays[name].shape}; its configuration needs {stack + shape}"
            )
    kernel, mean, deviation, recurrent, bias = (
        arrays[name].astype(float)
        for name in (
            "net.lstm.kernel",
            "normalisation.mean",
            "normalisation.deviation",
            "net.lstm.recurrent",
            "net.lstm.bias",
        )
    )
    # The layer sees (x / unit - mean) / deviation: kernel' = kernel / deviation / unit, and
    # bias' = bias - mean kernel / deviation.
    kernel = kernel / np.maximum(deviation, MIN_DEVIATION)[..., None]
    bias = bias - (mean[..., None, :] @ kernel)[..., 0, :]
    kernel = kernel / observation.units()[:, None]

    def gates(weights: np.ndarray) -> np.ndarray:
        """Reorder from input, forget, cell, output to input, forget, output, cell, and halve the
        first three."""
        i, f, g, o = (weights[..., k * units : (k + 1) * units] for k in range(4))
        return np.ascontiguousarray(np.concatenate([i / 2, f / 2, o / 2, g], axis=-1), np.float32)

    return PolicyNetwork(
        kernel=gates(np.concatenate([kernel, recurrent], axis=-2)),
        bias=gates(bias),
        hidden=arrays["net.hidden.kernel"],
        hidden_bias=arrays["net.hidden.bias"],
        output=arrays["net.output.kernel"],
        output_bias=arrays["net.output.bias"],
    ), gaits


def _gaits(arrays: NamedArrays, observation: PolicyObservation) -> GaitTable | None:
    if not arrays:
        return None
    if {*arrays} != {f"{GAITS}.{name}" for name in GaitTable._fields}:
        raise ValueError(f"a table of gaits is not {', '.join(sorted(arrays))[:200]}")
    low, high, actions = (
        np.asarray(arrays[f"{GAITS}.{name}"], np.float32) for name in GaitTable._fields
    )
    corners = (low.shape, high.shape)
    if actions.ndim != 4 or actions.shape[2:] != (CYCLE_ACTIONS, 2) or corners != ((2,), (2,)):
        raise ValueError(
            f"gaits of shape {actions.shape} from {low.shape} to {high.shape} are not a table of "
            "gaits"
        )
    # Actions were rounded to float32.
    if min(actions.shape[:2]) < 2 or np.abs(actions).max() > 1 + 1e-5:
        raise ValueError(
            "gaits: there are fewer than 2 x 2, or their actions are not within [-1, 1]"
        )
    if not observation.phase:
        raise ValueError("task.phase is false; a policy with gaits observes the phase")
    return GaitTable(low * observation.force_scale_n, high * observation.force_scale_n, actions)


def rest_action(limits: Limits) -> tuple[float, float]:
    """Return the action in [-1, 1]^2 of a fin that stays at angle 0."""
    return 2 * (0.0 - limits.angle_min) / (limits.angle_max - limits.angle_min) - 1, -1.0
