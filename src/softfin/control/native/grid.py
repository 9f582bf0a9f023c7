"""The step of grid-switching (paper Sec. III-C3, second design): a policy for each cell, switched on demand.

As when it was trained and judged: the policy in charge stays a little beyond its cell, the one that takes over
remembers what it would have seen during the last cycle, and its actions are faded in.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from softfin.control.native.operations import Array, Number, Operations
from softfin.control.native.policy import Memory, Net, Observed, remembered, said, seen
from softfin.core.action_clock import CYCLE_ACTIONS


class Switching(NamedTuple):
    """How one policy takes over from another."""

    margin_n: float
    fade_actions: int
    step_n: float
    replay: bool


class GridState(NamedTuple):
    """What the policy in charge remembers, and what any other would need to take over."""

    hidden: Array
    cell: Array
    actions: Array
    """The last one first, normalised, side by side: those of a cycle, and those that its first was chosen by."""
    angles: Array
    """Of the shaft, at each action of the last cycle, the last one first [rad]."""
    asked: Array
    """The reference at the last action [N]."""
    age: Number
    """Actions since the start."""
    charge: Number
    """The cell whose policy is in charge."""
    share: Number
    """Of the beat before the switch in the next action; 0 where none is being faded out."""


@dataclass(frozen=True)
class Grid:
    """Meets the Step contract."""

    nets: Net
    """With a leading axis of cells."""
    observed: Observed
    rest: np.ndarray
    """The action of a fin that stays where it is, normalised."""
    low: np.ndarray
    """Corners of the cells ``(cells, 2)`` [N]."""
    high: np.ndarray
    switching: Switching

    def init(self) -> GridState:
        """The fin at rest, nothing remembered."""
        return GridState(
            *self.nets.empty(),
            actions=np.tile(self.rest, CYCLE_ACTIONS + self.observed.past + 1),
            angles=np.zeros(CYCLE_ACTIONS, np.float32),
            asked=np.zeros(2, np.float32),
            age=0,
            charge=0,
            share=np.float32(0),
        )

    def act(self, ops: Operations, state: GridState, now: Array) -> tuple[GridState, Array]:
        """The mean action of the policy in charge, faded in where it has just taken over."""
        xp, reference = ops.xp, now[1:]
        charge = self._in_charge(ops, state, reference)
        switched = (charge != state.charge) & (state.age > 0)
        net = Net(*(ops.row(ops.constant(part), charge) for part in self.nets))
        memory = Memory(
            *ops.choose(
                switched,
                lambda: self._taken_over(ops, net, state, reference),
                lambda: Memory(state.hidden, state.cell),
            )
        )
        memory = remembered(ops, net, memory, seen(ops, self.observed, now, state.actions, state.age))
        share = self._share(ops, state, switched, reference)
        before = state.actions[2 * (CYCLE_ACTIONS - 1) : 2 * CYCLE_ACTIONS]
        action = (1 - share) * said(ops, net, memory) + share * before
        less = share - 1 / max(1, self.switching.fade_actions)
        after = GridState(
            *memory,
            actions=xp.concat([action, state.actions[:-2]]),
            angles=xp.concat([now[:1], state.angles[:-1]]),
            asked=reference,
            age=state.age + 1,
            charge=charge,
            share=ops.choose(less > 0, lambda: less, lambda: np.float32(0)),
        )
        return after, action

    def _in_charge(self, ops: Operations, state: GridState, reference: Array) -> Number:
        """The last cell, unless another is nearer by more than the margin."""
        xp, low, high = ops.xp, ops.constant(self.low), ops.constant(self.high)
        beyond = xp.maximum(xp.maximum(low - reference, reference - high), ops.constant(np.zeros_like(self.low)))
        distance = xp.sqrt(beyond[:, 0] * beyond[:, 0] + beyond[:, 1] * beyond[:, 1])
        nearest = ops.whole(xp.argmin(distance))
        reach = ops.row(distance, nearest) + np.float32(self.switching.margin_n)
        stays = (state.age > 0) & (ops.row(distance, state.charge) <= reach)
        return ops.choose(stays, lambda: state.charge, lambda: nearest)

    def _taken_over(self, ops: Operations, net: Net, state: GridState, reference: Array) -> Memory:
        """What the policy remembers of the last cycle, or of as much of it as there was.

        As if the reference had been this one for long, which is what it knows from its training.
        """
        memory = empty = Memory(*map(ops.constant, net.empty()))
        if self.switching.replay:
            for ago in range(CYCLE_ACTIONS, 0, -1):
                again = partial(self._replayed, ops, net, state, reference, memory, ago)
                memory = Memory(*ops.choose(state.age >= ago, again, lambda: empty))
        return memory

    def _replayed(
        self, ops: Operations, net: Net, state: GridState, reference: Array, memory: Memory, ago: int
    ) -> Memory:
        """With what was seen so many actions ago."""
        now = ops.xp.concat([state.angles[ago - 1 : ago], reference])
        return remembered(ops, net, memory, seen(ops, self.observed, now, state.actions[2 * ago :], state.age - ago))

    def _share(self, ops: Operations, state: GridState, switched: Number, reference: Array) -> Number:
        """Of the beat in this action. At first the beat alone, once there is a whole cycle of it."""
        if not self.switching.fade_actions:
            return 0 * state.share
        whole = ops.choose(state.age >= CYCLE_ACTIONS, lambda: np.float32(1), lambda: np.float32(0))
        share = ops.choose(switched, lambda: whole, lambda: state.share)
        moved = reference - state.asked
        kept = 1 - ops.xp.sqrt(moved[0] * moved[0] + moved[1] * moved[1]) / np.float32(self.switching.step_n)
        return share * ops.choose(kept > 0, lambda: kept, lambda: np.float32(0))
