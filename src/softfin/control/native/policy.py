"""A policy's step: what is observed and remembered in, what is remembered and the action out (paper Sec. III-C2).

    gates = [seen, hidden] kernel + bias;  cell' = s(f) cell + s(i) tanh(g);  hidden' = s(o) tanh(cell')
    action = tanh(tanh(hidden' W + b) V + c)

It is the LSTM of Hochreiter and Schmidhuber (1997) with forget gates, and one layer behind it. Two things are folded
into the weights when they are read: the units and the normalisation of what is observed, and 1/2 for the gates, since
the logistic function is s(x) = 1/2 + tanh(x / 2) / 2, so that one tanh does all four gates.
"""

from typing import NamedTuple

import numpy as np

from softfin.control.native.operations import Array, Number, Operations
from softfin.core.action_clock import CYCLE_ACTIONS

MEASURED = 3
"""Numbers that are observed before the past actions: angle [rad] and reference (x, y) [N]."""

_TURN = 2 * np.pi * np.arange(CYCLE_ACTIONS) / CYCLE_ACTIONS
PHASES = np.stack([np.sin(_TURN), np.cos(_TURN)], axis=1).astype(np.float32)
"""Sine and cosine of the clock's phase at each of the six actions."""


class Memory(NamedTuple):
    """What an LSTM remembers."""

    hidden: Array
    cell: Array


class Net(NamedTuple):
    """Weights as they are used: gates in the order input, forget, output, cell; those of a grid have a leading axis."""

    kernel: Array
    """``(observations + units, 4 units)``."""
    bias: Array
    hidden: Array
    hidden_bias: Array
    output: Array
    output_bias: Array

    @property
    def units(self) -> int:
        """Of the LSTM."""
        return int(self.bias.shape[-1]) // 4

    def empty(self) -> Memory:
        """Nothing remembered."""
        return Memory(np.zeros(self.units, np.float32), np.zeros(self.units, np.float32))


class Observed(NamedTuple):
    """What of the task the step must know."""

    past: int
    """Actions before the last one that are observed."""
    phase: bool
    """Whether the clock's phase is observed."""

    @property
    def actions(self) -> int:
        """Numbers of the actions that are observed."""
        return 2 * (self.past + 1)


def seen(ops: Operations, observed: Observed, now: Array, actions: Array, age: Number) -> Array:
    """The observation, in SI units; `actions` begins with the last one, of which as many are taken as are observed."""
    parts = [now, actions[: observed.actions]]
    if observed.phase:
        parts.append(ops.row(ops.constant(PHASES), age % CYCLE_ACTIONS))
    return ops.xp.concat(parts)


def remembered(ops: Operations, net: Net, memory: Memory, observation: Array) -> Memory:
    """One step of the LSTM."""
    xp, units = ops.xp, net.units
    gates = xp.tanh(ops.dot(xp.concat([observation, memory.hidden]), net.kernel) + net.bias)
    opened = 0.5 * gates[: 3 * units] + 0.5
    cell = opened[units : 2 * units] * memory.cell + opened[:units] * gates[3 * units :]
    return Memory(opened[2 * units :] * xp.tanh(cell), cell)


def said(ops: Operations, net: Net, memory: Memory) -> Array:
    """The action, in [-1, 1]^2."""
    tanh = ops.xp.tanh
    inner = tanh(ops.dot(memory.hidden, net.hidden) + net.hidden_bias)
    return tanh(ops.dot(inner, net.output) + net.output_bias)
