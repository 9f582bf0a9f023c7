"""Reference forces: the six of the paper's Table II, the cells round them, and drawing at random from a cell."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Reachable


class References(NamedTuple):
    """A box from which references are drawn, as arrays: one program serves many boxes."""

    low: Float[Array, "2"]
    high: Float[Array, "2"]
    reachable: Reachable | None = None
    """Mean forces that the fin can make, where that is known."""

    def draw(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        """One reference, uniform over the box."""
        return self.at(jax.random.uniform(key, (2,)))

    def at(self, share: Float[Array, "2"]) -> Float[Array, "2"]:
        """The reference at (0 to 1, 0 to 1) of the box; what lies beyond the fin's reach is brought to its edge."""
        reference = self.low + share * (self.high - self.low)
        return reference if self.reachable is None else self.reachable.project(reference)


PAPER_CELLS = tuple(Cell.around(reference) for reference in PAPER_REFERENCES)
"""The grid: squares of 1 N round the six references; they touch and do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""What one controller is trained for: the smallest box round the grid."""


def references_in(cell: Cell) -> References:
    """Return a cell as the box of arrays from which references are drawn."""
    return References(jnp.asarray(cell.low, jnp.float32), jnp.asarray(cell.high, jnp.float32))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """The boxes of many lanes, along a leading axis; all of one fin."""
    boxes = [references_in(cell) for cell in cells]
    low, high = jnp.stack([box.low for box in boxes]), jnp.stack([box.high for box in boxes])
    same = (
        None if reachable is None else Reachable(*(jnp.tile(x, (len(boxes), 1)) for x in map(jnp.asarray, reachable)))
    )
    return References(low, high, same)
