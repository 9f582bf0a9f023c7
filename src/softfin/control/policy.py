"""The step of a policy: it computes an action and a new memory from an observation and a memory
(paper Sec. III-C2).

    gates   = [observation, hidden] kernel + bias
    cell'   = s(f) cell + s(i) tanh(g)
    hidden' = s(o) tanh(cell')
    action  = tanh(tanh(hidden' W + b) V + c)

This is the LSTM of Hochreiter and Schmidhuber (1997) with forget gates, followed by one hidden
layer. When the weights are loaded, the units and the normalisation of the observation are folded
into them. So is the factor 1/2 of the logistic function s(x) = 1/2 + tanh(x / 2) / 2, so that a
single tanh computes all four gates.
"""

from typing import NamedTuple

import numpy as np
import pydantic

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import NamedArrays

MEASURED = 3
"""Number of values that precede the past actions in an observation: angle [rad] and reference
(x, y) [N]."""

ANGLE_SCALE_RAD = np.pi / 2
"""Scale of observed angles in training."""

MIN_DEVIATION = 0.1
"""Minimum standard deviation by which observations are divided."""


class PolicyObservation(pydantic.BaseModel, frozen=True):
    """Definition of a policy's observations, part of the task configuration."""

    past_actions: int = pydantic.Field(default=3, ge=0)
    """Number of observed actions in addition to the last one."""
    force_scale_n: pydantic.PositiveFloat = 3.0
    """Scale of observed references in training [N]."""
    clock: ActionClock = PAPER_CLOCK

    @classmethod
    def from_description(cls, description: JsonObject) -> "PolicyObservation":
        """Build from a controller's description, whose `clock` replaces the clock of its task."""
        return cls.model_validate(description["task"] | {"clock": description["clock"]})

    @property
    def size(self) -> int:
        """Number of values in an observation."""
        return MEASURED + 2 * (self.past_actions + 1)

    def units(self) -> np.ndarray:
        """Return the training scale of each value of an observation."""
        units = np.ones(self.size)
        units[:MEASURED] = ANGLE_SCALE_RAD, self.force_scale_n, self.force_scale_n
        return units

    def observe(self, ops: Operations, now: Array, actions: Array) -> Array:
        """Return the observation in SI units, with as many past `actions` (newest first) as the
        policy observes."""
        observation: Array = ops.xp.concat([now, actions[: 2 * (self.past_actions + 1)]])
        return observation

    def observe_scaled(self, ops: Operations, now: Array, actions: Array) -> Array:
        """Return the observation in the units of training."""
        return self.observe(ops, now, actions) / self.units()


class PolicyMemory(NamedTuple):
    """Memory of an LSTM."""

    hidden: Array
    cell: Array


class PolicyNetwork(NamedTuple):
    """Folded weights; the order of the gates is input, forget, output, cell.

    The weights of a grid have a leading axis of cells.
    """

    kernel: Array
    """Weights for the observation and the hidden state ``(size + units, 4 units)``."""
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
        """Return the memory after one step of the LSTM."""
        xp = ops.xp
        units = self.bias.shape[-1] // 4
        # The weights of the three logistic gates are halved, so s(x) = 0.5 tanh(x / 2) + 0.5.
        gates = xp.tanh(ops.dot(xp.concat([observation, memory.hidden]), self.kernel) + self.bias)
        opened = 0.5 * gates[: 3 * units] + 0.5
        cell = opened[units : 2 * units] * memory.cell + opened[:units] * gates[3 * units :]
        return PolicyMemory(opened[2 * units :] * xp.tanh(cell), cell)

    def action(self, ops: Operations, memory: PolicyMemory) -> Array:
        """Compute the deterministic action in [-1, 1]^2."""
        tanh = ops.xp.tanh
        inner = tanh(ops.dot(memory.hidden, self.hidden) + self.hidden_bias)
        return tanh(ops.dot(inner, self.output) + self.output_bias)


def fold(
    arrays: NamedArrays, observation: PolicyObservation, stack: tuple[int, ...] = ()
) -> PolicyNetwork:
    """Build a network from the named arrays of a trained policy, or of several policies stacked
    along a leading axis.

    Raises ValueError if an array is missing, is unknown or has the wrong shape.
    """
    # The first axis of a layer's kernel is its input size; missing arrays are reported below.
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
        "normalisation.std": (size,),
        "normalisation.count": (),
        "log_std": (2,),
    }
    if odd := sorted(set(shapes) ^ set(arrays)):
        raise ValueError(f"missing or unknown weights: {', '.join(odd)[:200]}")
    for name, shape in shapes.items():
        if arrays[name].shape != stack + shape:
            raise ValueError(
                f"{name} has shape {arrays[name].shape}; the configuration requires {stack + shape}"
            )
    kernel, mean, deviation, recurrent, bias = (
        arrays[name].astype(float)
        for name in (
            "net.lstm.kernel",
            "normalisation.mean",
            "normalisation.std",
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
        """Reorder gates from input, forget, cell, output to input, forget, output, cell, and halve
        the logistic ones."""
        i, f, g, o = (weights[..., k * units : (k + 1) * units] for k in range(4))
        return np.ascontiguousarray(np.concatenate([i / 2, f / 2, o / 2, g], axis=-1), np.float32)

    return PolicyNetwork(
        kernel=gates(np.concatenate([kernel, recurrent], axis=-2)),
        bias=gates(bias),
        hidden=arrays["net.hidden.kernel"],
        hidden_bias=arrays["net.hidden.bias"],
        output=arrays["net.output.kernel"],
        output_bias=arrays["net.output.bias"],
    )


def rest_action(limits: Limits) -> tuple[float, float]:
    """Return the action in [-1, 1]^2 that keeps the fin at its rest angle."""
    return 2 * (limits.rest_angle - limits.angle_min) / (
        limits.angle_max - limits.angle_min
    ) - 1, -1.0
