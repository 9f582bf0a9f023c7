"""One policy for a whole range of references (paper Sec. III-C3, first design)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from softfin.control.controller import Measured
from softfin.control.range import check_within
from softfin.core.quantities import Command, Limits
from softfin.gaits.reachable import Reachable
from softfin.learning.lstm import Memory
from softfin.learning.policy import Policy
from softfin.task.references import Cell, Force
from softfin.task.task import TaskConfig, command_of, observation, remember, rest_actions


class SingleState(NamedTuple):
    """What a policy remembers."""

    memory: Memory
    actions: Float[Array, "remembered 2"]
    """The last one first, normalised."""
    age: Int[Array, ""]
    """Actions since the start."""


class SingleController(eqx.Module):
    """Meets the Controller contract."""

    policy: Policy
    task: TaskConfig = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """Of the plant that it was trained in: its commands stay within them."""
    cell: Cell = eqx.field(static=True)
    """References that it was trained for [N]."""
    reachable: Reachable | None = None
    """Mean forces that the fin can make, where that is known."""

    def init(self) -> SingleState:
        """The fin at rest, nothing remembered."""
        return SingleState(self.policy.init(), rest_actions(self.task, self.limits), jnp.int32(0))

    def act(self, state: SingleState, measured: Measured, reference: Float[Array, "2"]) -> tuple[SingleState, Command]:
        """The policy's mean action."""
        seen = observation(self.task, jnp.asarray(measured.angle), jnp.asarray(reference), state.actions, state.age)
        memory, action = self.policy.act(state.memory, seen)
        return SingleState(memory, remember(state.actions, action), state.age + 1), command_of(self.limits, action)

    def check(self, reference: Force) -> None:
        """Raise CoverageError outside the range."""
        check_within((self.cell,), reference)
