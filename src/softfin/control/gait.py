"""Gaits as a controller: no net, a table of six actions for each node of a lattice of references, blended in between.

It is the yardstick of the policies, their teacher, and a choice of its own where the controller is a small one: an
action costs 16 multiplications.
"""

from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from softfin.control.controller import Measured
from softfin.control.range import check_within
from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.quantities import Command, Limits
from softfin.gaits.gaits import GaitTable
from softfin.gaits.reachable import Reachable
from softfin.task.references import Cell, Force
from softfin.task.task import command_of

Phase: TypeAlias = Int[Array, ""]
"""Actions since the start. It goes on when the reference moves, so that the beat does not stumble."""


class GaitController(eqx.Module):
    """Meets the Controller contract; open loop, so what is measured is not looked at."""

    table: GaitTable
    limits: Limits = eqx.field(static=True)
    """Of the plant that it was found in: its commands stay within them."""
    reachable: Reachable
    """Mean forces that the fin can make there."""

    def init(self) -> Phase:
        """The first of the six actions is next."""
        return jnp.zeros((), jnp.int32)

    def act(self, state: Phase, measured: Measured, reference: Float[Array, "2"]) -> tuple[Phase, Command]:
        """The next action of the gait for the reference."""
        action = self.table.gait(jnp.asarray(reference))[state % CYCLE_ACTIONS]
        return state + 1, command_of(self.limits, action)

    def check(self, reference: Force) -> None:
        """Raise CoverageError outside the lattice."""
        check_within((self.cell,), reference)

    @property
    def cell(self) -> Cell:
        """The lattice's box."""
        low, high = (tuple(float(x) for x in corner) for corner in (self.table.low, self.table.high))
        return Cell(low=(low[0], low[1]), high=(high[0], high[1]))
