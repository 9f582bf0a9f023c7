"""The step of a policy, from observation and memory to action and memory (paper Sec. III-C2):

    gates   = [observation, hidden] kernel + bias
    cell'   = s(f) cell + s(i) tanh(g)
    hidden' = s(o) tanh(cell')
    action  = tanh(tanh(hidden' W + b) V + c + atanh(gait))

This is the LSTM of Hochreiter and Schmidhuber (1997) with forget gates, followed by one hidden
layer. Policies that did not start from gaits have no gait term. When the weights are loaded, the
units and the normalisation of the observation are folded into them. So is the factor 1/2 of the
logistic function s(x) = 1/2 + tanh(x / 2) / 2, so that a single tanh computes all four gates.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pydantic
from jaxtyping import Float

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import GaitTable, NamedArrays

MEASURED = 3
"""Number of values that precede the past actions in an observation: angle [rad] and reference
(x, y) [N]."""

ANGLE_SCALE_RAD = np.pi / 2
"""Scale of observed angles in training."""

GAITS = "gaits"
"""Name prefix of a policy's gait arrays."""

MAX_ACTION = np.float32(0.999)
"""Factor applied to gait actions before atanh, which is infinite at 1."""

MIN_DEVIATION = 0.1
"""Minimum standard deviation by which observations are divided."""


@cache
def phases(window_actions: int) -> Float[np.ndarray, "actions 2"]:
    """Return the sine and cosine of the clock's phase at each action of the window."""
    turn = np.arange(window_actions, dtype=np.float32) * np.float32(2 * np.pi / window_actions)
    return np.stack([np.sin(turn), np.cos(turn)], axis=1)


class PolicyObservation(pydantic.BaseModel, frozen=True):
    """Definition of a policy's observations, part of the task configuration."""

    past_actions: int = pydantic.Field(default=3, ge=0)
    """Number of observed actions in addition to the last one."""
    phase: bool = False
    """Whether the phase of the clock is observed."""
    force_scale_n: pydantic.PositiveFloat = 3.0
    """Scale of observed references in training [N]."""
    clock: ActionClock = PAPER_CLOCK

    @classmethod
    def from_description(cls, description: JsonObject) -> "PolicyObservation":
        """Build from a controller's description; its `clock` replaces that of its task."""
        return cls.model_validate(description["task"] | {"clock": description.get("clock", {})})

    @property
    def size(self) -> int:
        """Number of values in an observation."""
        return MEASURED + 2 * (self.past_actions + 1) + (2 if self.phase else 0)

    def units(self) -> np.ndarray:
        """Return the training scale of each value of an observation."""
        units = np.ones(self.size)
        units[:MEASURED] = ANGLE_SCALE_RAD, self.force_scale_n, self.force_scale_n
        return units

    def observe(self, ops: Operations, now: Array, actions: Array, age: Number) -> Array:
        """Return the observation in SI units, with as many of the past `actions` (newest first) as
        the policy observes."""
        parts = [now, actions[: 2 * (self.past_actions + 1)]]
        if self.phase:
            window_actions = self.clock.window_actions
            parts.append(ops.row(ops.constant(phases(window_actions)), age % window_actions))
        return ops.xp.concat(parts)


class PolicyMemory(NamedTuple):
    """Memory of an LSTM."""

    hidden: Array
    cell: Array


class PolicyNetwork(NamedTuple):
    """Folded weights, with gates in the order input, forget, output, cell.

    The weights of a grid have a leading axis of cells.
    """

    kernel: Array
    """Weights of observation and hidden state ``(size + units, 4 units)``."""
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

    def action(
        self,
        ops: Operations,
        memory: PolicyMemory,
        gaits: GaitTable | None,
        reference: Array,
        age: Number,
    ) -> Array:
        """Compute the deterministic action in [-1, 1]^2 for a reference [N], `age` actions after
        the start."""
        tanh = ops.xp.tanh
        inner = tanh(ops.dot(memory.hidden, self.hidden) + self.hidden_bias)
        before = ops.dot(inner, self.output) + self.output_bias
        if gaits is not None:
            before = before + gait_before_tanh(ops, gaits, reference, age)
        return tanh(before)


def gait_before_tanh(ops: Operations, gaits: GaitTable, reference: Array, age: Number) -> Array:
    """Return the atanh of the gait's action for a reference, `age` actions after the start."""
    # The factor keeps the argument below 1, where atanh is infinite.
    return ops.xp.atanh(MAX_ACTION * ops.row(gaits.gait(reference, ops), age % gaits.gait_actions))


def fold(
    arrays: NamedArrays, observation: PolicyObservation, stack: tuple[int, ...] = ()
) -> tuple[PolicyNetwork, GaitTable | None]:
    """Build a network from the named arrays of a trained policy, or of several policies stacked
    along a leading axis.

    Also returns the gaits that the policy started from, if any, for references in newtons. Raises
    ValueError for arrays that are missing, unknown or of the wrong shape.
    """
    gait_arrays = {name: array for name, array in arrays.items() if name.startswith(f"{GAITS}.")}
    gaits = _gaits(gait_arrays, observation)
    arrays = {name: array for name, array in arrays.items() if name not in gait_arrays}
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
        "normalisation.deviation": (size,),
        "normalisation.count": (),
        "log_deviation": (2,),
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
    ), gaits


def _gaits(arrays: NamedArrays, observation: PolicyObservation) -> GaitTable | None:
    if not arrays:
        return None
    if {*arrays} != {f"{GAITS}.{name}" for name in GaitTable._fields}:
        raise ValueError(
            f"gaits: got {', '.join(sorted(arrays))[:200]}; must be {GAITS}.low, {GAITS}.high and "
            f"{GAITS}.actions"
        )
    low, high, actions = (
        np.asarray(arrays[f"{GAITS}.{name}"], np.float32) for name in GaitTable._fields
    )
    corners = (low.shape, high.shape)
    window_actions = observation.clock.window_actions
    if actions.ndim != 4 or actions.shape[2:] != (window_actions, 2) or corners != ((2,), (2,)):
        raise ValueError(
            f"gaits: got actions of shape {actions.shape}, corners of shapes {low.shape} and "
            f"{high.shape}; must be (nodes x, nodes y, {window_actions}, 2) and (2,), (2,)"
        )
    # The tolerance is for actions that were rounded to float32.
    if min(actions.shape[:2]) < 2 or np.abs(actions).max() > 1 + 1e-5:
        raise ValueError("gaits: must have at least 2 x 2 nodes and actions within [-1, 1]")
    if not observation.phase:
        raise ValueError("task.phase is false; must be true for a policy with gaits")
    return GaitTable(low * observation.force_scale_n, high * observation.force_scale_n, actions)


def rest_action(limits: Limits) -> tuple[float, float]:
    """Return the action in [-1, 1]^2 that keeps the fin at its rest angle."""
    return 2 * (limits.rest_angle - limits.angle_min) / (
        limits.angle_max - limits.angle_min
    ) - 1, -1.0
