"""Grid-switching (paper Sec. III-C3, second design): a policy for each cell of reference forces, switched on demand.

The weights of all cells are stacked; an action looks up those of one cell, so it costs the same for any number of them.

A switch is to be felt in the force that was asked for and in nothing else. So the policy in charge stays a little
beyond its cell (hysteresis); the one that takes over remembers what it would have seen during the last six actions, one
cycle of the clock; and its actions are faded in over the beat that it finds, which is those six actions, again and
again (what control engineers call bumpless transfer).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from softfin.control.controller import Measured
from softfin.control.range import check_within
from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.quantities import Command, Limits
from softfin.gaits.reachable import Reachable
from softfin.learning.lstm import Memory, cleared
from softfin.learning.policy import Policy
from softfin.task.references import Cell, Force
from softfin.task.switching import SwitchingConfig
from softfin.task.task import TaskConfig, command_of, observation, remember, rest_actions, stack_references


class GridState(NamedTuple):
    """What the policy in charge remembers, and what any other would need to take over."""

    memory: Memory
    actions: Float[Array, "remembered 2"]
    """The last one first, normalised: those of a cycle, and those that its first action was chosen by."""
    angles: Float[Array, "6"]
    """Of the shaft, at each action of the last cycle, the last one first [rad]."""
    reference: Float[Array, "2"]
    """At the last action [N]."""
    age: Int[Array, ""]
    """Actions since the start."""
    cell: Int[Array, ""]
    """Whose policy is in charge."""
    share: Float[Array, ""]
    """Of the beat before the switch in the next action; 0 where none is being faded out."""


class GridController(eqx.Module):
    """Meets the Controller contract."""

    policies: Policy
    """Leaves ``(cells, ...)``."""
    task: TaskConfig = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """Of the plant that it was trained in: its commands stay within them."""
    cells: tuple[Cell, ...] = eqx.field(static=True)
    """References that the policies were trained for [N], in their order."""
    reachable: Reachable | None = None
    """Mean forces that the fin can make, where that is known."""
    switching: SwitchingConfig = eqx.field(static=True, default=SwitchingConfig())

    def init(self) -> GridState:
        """The fin at rest, nothing remembered."""
        rest = rest_actions(self.task, self.limits)
        actions = jnp.concatenate([jnp.tile(rest[:1], (CYCLE_ACTIONS, 1)), rest])
        return GridState(
            memory=self._policy(jnp.int32(0)).init(),
            actions=actions,
            angles=jnp.zeros(CYCLE_ACTIONS),
            reference=jnp.zeros(2),
            age=jnp.int32(0),
            cell=jnp.int32(0),
            share=jnp.float32(0),
        )

    def act(self, state: GridState, measured: Measured, reference: Float[Array, "2"]) -> tuple[GridState, Command]:
        """The mean action of the policy in charge, faded in where it has just taken over."""
        reference, angle = jnp.asarray(reference), jnp.asarray(measured.angle)
        cell = self.in_charge(state, reference)
        switched = (cell != state.cell) & (state.age > 0)
        policy = self._policy(cell)
        memory = jax.lax.cond(switched, lambda: self._taken_over(policy, state, reference), lambda: state.memory)
        memory, own = policy.act(memory, self._seen(angle, reference, state.actions, state.age))
        share = self._share(state, switched, reference)
        action = (1 - share) * own + share * state.actions[CYCLE_ACTIONS - 1]
        after = GridState(
            memory=memory,
            actions=remember(state.actions, action),
            angles=jnp.concatenate([angle[None], state.angles[:-1]]),
            reference=reference,
            age=state.age + 1,
            cell=cell,
            share=jnp.maximum(share - 1 / max(1, self.switching.fade_actions), 0),
        )
        return after, command_of(self.limits, action)

    def check(self, reference: Force) -> None:
        """Raise CoverageError outside every cell."""
        check_within(self.cells, reference)

    def in_charge(self, state: GridState, reference: Float[Array, "2"]) -> Int[Array, ""]:
        """Index of the cell whose policy acts: the last one, unless another is nearer by more than the margin."""
        distance = self._distances(reference)
        nearest = jnp.argmin(distance)
        stays = (state.age > 0) & (distance[state.cell] <= distance[nearest] + self.switching.margin_n)
        return jnp.where(stays, state.cell, nearest)

    def _policy(self, index: Int[Array, ""]) -> Policy:
        policy: Policy = jax.tree.map(lambda leaf: leaf[index], self.policies)
        return policy

    def _distances(self, reference: Float[Array, "2"]) -> Float[Array, "cells"]:
        low, high, _ = stack_references(self.cells)
        beyond = jnp.maximum(jnp.maximum(low - reference, reference - high), 0)
        return jnp.sqrt(jnp.sum(beyond**2, axis=1))

    def _seen(
        self, angle: Float[Array, ""], reference: Float[Array, "2"], actions: Array, age: Int[Array, ""]
    ) -> Float[Array, "observations"]:
        return observation(self.task, angle, reference, actions[: self.task.past_actions + 1], age)

    def _taken_over(self, policy: Policy, state: GridState, reference: Float[Array, "2"]) -> Memory:
        """What the policy remembers of the last cycle, or of as much of it as there was.

        As if the reference had been this one for long, which is what it knows from its training.
        """
        memory = policy.init()
        if self.switching.replay:
            for ago in range(CYCLE_ACTIONS, 0, -1):
                seen = self._seen(state.angles[ago - 1], reference, state.actions[ago:], state.age - ago)
                memory = policy.act(cleared(memory, state.age <= ago), seen)[0]
        return memory

    def _share(self, state: GridState, switched: Bool[Array, ""], reference: Float[Array, "2"]) -> Float[Array, ""]:
        """Of the beat in this action. At first the beat alone, once there is a whole cycle of it."""
        if not self.switching.fade_actions:
            return jnp.zeros(())
        whole = jnp.where(state.age >= CYCLE_ACTIONS, 1.0, 0.0)
        moved = jnp.sqrt(jnp.sum((reference - state.reference) ** 2))
        share = jnp.where(switched, whole, state.share)
        return jnp.asarray(share * jnp.clip(1 - moved / self.switching.step_n, 0, 1))
