"""Grid-switching (paper Sec. III-C3, second design): a policy for each cell of reference forces, switched on demand.

The weights of all cells are stacked; an action looks up those of one cell, so it costs the same for any number of them.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from softfin.control.controller import Measured
from softfin.control.single import SingleController, SingleState
from softfin.errors import CoverageError
from softfin.quantities import Command, Limits
from softfin.tracking.references import Cell, Force, stack_references
from softfin.tracking.task import TaskConfig
from softfin.training.lstm import cleared
from softfin.training.policy import Policy


class GridState(NamedTuple):
    """What the policy in charge remembers, and whose it is."""

    inner: SingleState
    cell: Int[Array, ""]


class GridController(eqx.Module):
    """Meets the Controller contract."""

    policies: Policy
    """Leaves ``(cells, ...)``."""
    task: TaskConfig = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """Of the plant that it was trained in: its commands stay within them."""
    cells: tuple[Cell, ...] = eqx.field(static=True)
    """References that the policies were trained for [N], in their order."""

    def init(self) -> GridState:
        """The fin at rest, nothing remembered."""
        return GridState(self.of_cell(jnp.int32(0)).init(), jnp.int32(0))

    def act(self, state: GridState, measured: Measured, reference: Float[Array, "2"]) -> tuple[GridState, Command]:
        """The mean action of the policy for the reference's cell, the nearest one outside all cells.

        On a switch the memory starts anew, because what one policy remembers means nothing to another; the last
        actions are facts and stay.
        """
        index = self.nearest(jnp.asarray(reference))
        memory = cleared(state.inner.memory, index != state.cell)
        inner, command = self.of_cell(index).act(state.inner._replace(memory=memory), measured, reference)
        return GridState(inner, index), command

    def check(self, reference: Force) -> None:
        """Raise CoverageError outside every cell."""
        nearest = min(self.cells, key=lambda cell: cell.distance(reference))
        beyond = nearest.distance(reference)
        if beyond > 0:
            raise CoverageError(
                f"reference ({reference[0]:g}, {reference[1]:g}) N: {beyond:.2g} N outside the nearest of "
                f"{len(self.cells)} cells ({nearest}); ask within a cell, or train with a cell there"
            )

    def nearest(self, reference: Float[Array, "2"]) -> Int[Array, ""]:
        """Index of the cell that holds the reference, or that is nearest to it; the first of several."""
        low, high = stack_references(self.cells)
        beyond = jnp.maximum(jnp.maximum(low - reference, reference - high), 0)
        return jnp.argmin(jnp.sum(beyond**2, axis=1))

    def of_cell(self, index: Int[Array, ""]) -> SingleController:
        """The controller of one cell."""
        policy = jax.tree.map(lambda leaf: leaf[index], self.policies)
        return SingleController(policy, self.task, self.limits, self.cells[0])
