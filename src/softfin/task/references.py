"""Reference forces to train for: the paper's cells and range, and boxes from which references are drawn at random."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Reachable

PAPER_CELLS = tuple(Cell.around(reference) for reference in PAPER_REFERENCES)
"""The grid: squares of 1 N round the six references; they touch and do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""What one controller is trained for: the bounding box of the grid."""


class References(NamedTuple):
    """A box from which references are drawn, as arrays: one program serves many boxes."""

    low: Float[Array, "*stack 2"]
    high: Float[Array, "*stack 2"]
    reachable: Reachable | None = None
    """Mean forces that the fin can make, where these are known."""

    @classmethod
    def of(cls, cell: Cell, reachable: Reachable | None = None) -> "References":
        """The references of a cell."""
        return cls(jnp.asarray(cell.low, jnp.float32), jnp.asarray(cell.high, jnp.float32), reachable)

    def draw(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        """One reference, uniform over the box."""
        return self.at(jax.random.uniform(key, (2,)))

    def at(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """The reference at (0 to 1, 0 to 1) of the box; beyond the fin's reach, the one on the edge of the reach."""
        reference = self.low + place * (self.high - self.low)
        return reference if self.reachable is None else jnp.asarray(self.reachable.project(reference))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """The references of many cells, along a leading axis; all of one fin."""
    each = [References.of(cell, jax.tree.map(jnp.asarray, reachable)) for cell in cells]
    stacked: References = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return stacked
