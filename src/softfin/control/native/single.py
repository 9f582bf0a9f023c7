"""The step of one policy for a whole range of references (paper Sec. III-C3, first design)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softfin.control.native.operations import Array, Number, Operations
from softfin.control.native.policy import Memory, Net, Observed, remembered, said, seen


class SingleState(NamedTuple):
    """What a policy remembers."""

    hidden: Array
    cell: Array
    actions: Array
    """The last one first, normalised, side by side."""
    age: Number
    """Actions since the start."""


@dataclass(frozen=True)
class Single:
    """Meets the Step contract."""

    net: Net
    observed: Observed
    rest: np.ndarray
    """The action of a fin that stays where it is, normalised."""

    def init(self) -> SingleState:
        """The fin at rest, nothing remembered."""
        return SingleState(*self.net.empty(), np.tile(self.rest, self.observed.past + 1), 0)

    def act(self, ops: Operations, state: SingleState, now: Array) -> tuple[SingleState, Array]:
        """The policy's mean action."""
        net = Net(*map(ops.constant, self.net))
        observation = seen(ops, self.observed, now, state.actions, state.age)
        memory = remembered(ops, net, Memory(state.hidden, state.cell), observation)
        action = said(ops, net, memory)
        return SingleState(*memory, ops.xp.concat([action, state.actions[:-2]]), state.age + 1), action
