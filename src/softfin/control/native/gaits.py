"""The step of gaits: a table of six actions for each node of a lattice of references, blended in between."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softfin.control.native.operations import Array, Number, Operations
from softfin.core.action_clock import CYCLE_ACTIONS


class GaitState(NamedTuple):
    """Where in the gait the fin is."""

    age: Number
    """Actions since the start. It goes on when the reference moves, so that the beat does not stumble."""


@dataclass(frozen=True)
class Gaits:
    """Meets the Step contract; open loop, so the angle is not looked at."""

    low: np.ndarray
    """Corners of the lattice (x, y) [N]."""
    high: np.ndarray
    actions: np.ndarray
    """``(x, y, 6, 2)``, normalised."""

    def init(self) -> GaitState:
        """The first of the six actions is next."""
        return GaitState(0)

    def act(self, ops: Operations, state: GaitState, now: Array) -> tuple[GaitState, Array]:
        """The next action of the gait for the reference: bilinear, and beyond the lattice that of its edge."""
        rows = self.actions.shape[1]
        table = ops.constant(self.actions.reshape(-1, 2))
        x, i = self._place(ops, now[1], 0)
        y, j = self._place(ops, now[2], 1)
        first = (i * rows + j) * CYCLE_ACTIONS + state.age % CYCLE_ACTIONS
        right = rows * CYCLE_ACTIONS
        action = (1 - x) * ((1 - y) * ops.row(table, first) + y * ops.row(table, first + CYCLE_ACTIONS)) + x * (
            (1 - y) * ops.row(table, first + right) + y * ops.row(table, first + right + CYCLE_ACTIONS)
        )
        return GaitState(state.age + 1), action

    def _place(self, ops: Operations, force: Number, axis: int) -> tuple[Number, Number]:
        """Along one axis: how far behind the node before it, in units of the spacing, and that node."""
        last = self.actions.shape[axis] - 1
        # A box for a single reference has no width, and all its nodes are the same.
        width = (self.high[axis] - self.low[axis]) or np.float32(1)
        place = (force - self.low[axis]) / width
        place = ops.choose(place > 0, lambda: place, lambda: np.float32(0))
        place = ops.choose(place < 1, lambda: place, lambda: np.float32(1)) * np.float32(last)
        whole = ops.whole(place)
        node = ops.choose(whole < last, lambda: whole, lambda: last - 1)
        return place - ops.real(node), node
