"""Reference forces for training: the paper's references, the cells of a grid, and boxes from which
references are drawn at random."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Cells, Reachable

PAPER_CELLS = tuple(Cell.around(reference) for reference in PAPER_REFERENCES)
"""The paper's grid: squares of 1 N around the six references, which touch but do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""The paper's range of references: the bounding box of its grid."""


ForcePoint = Float[Array, "2"]
ForceBatch = Float[Array, "*batch 2"]
"""(x, y) [N]."""


class References(NamedTuple):
    """A box from which references are drawn, as arrays, so that one compiled program works for many
    boxes."""

    low: Float[Array, "*stack 2"]
    high: Float[Array, "*stack 2"]
    reachable: Reachable | None = None
    """Reachable mean forces of the fin, if known."""

    @classmethod
    def of(cls, cell: Cell, reachable: Reachable | None = None) -> "References":
        """Build the references of a cell."""
        return cls(
            jnp.asarray(cell.low, jnp.float32), jnp.asarray(cell.high, jnp.float32), reachable
        )

    def draw(self, key: PRNGKeyArray) -> ForcePoint:
        """Draw one reference, uniform over the box; if it is unreachable, return the nearest
        reachable one."""
        force = self.low + jax.random.uniform(key, (2,)) * (self.high - self.low)
        return force if self.reachable is None else jnp.asarray(self.reachable.project(force))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """Stack the references of many cells for the same fin along a leading axis."""
    each = [References.of(cell, jax.tree.map(jnp.asarray, reachable)) for cell in cells]
    stacked: References = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return stacked


def divide(cell: Cell, columns: int, rows: int) -> Cells:
    """Divide a cell into equal cells, `columns` along x and `rows` along y; they are ordered by x,
    then y."""
    # The edge arrays are shared so that neighbours have exactly the same edge.
    xs = np.linspace(cell.low[0], cell.high[0], columns + 1).tolist()
    ys = np.linspace(cell.low[1], cell.high[1], rows + 1).tolist()
    return tuple(
        Cell(low=(x0, y0), high=(x1, y1)) for x0, x1 in pairwise(xs) for y0, y1 in pairwise(ys)
    )
