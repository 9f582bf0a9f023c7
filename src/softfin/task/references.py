"""Reference forces for training: the paper's, cells of a grid, and boxes from which references are
drawn at random.

On a command line the cells are ``paper``, a lattice such as ``3x3`` over a range, or a YAML file of
boxes:

    cells: [{low: [0, -1], high: [1, 1]}, {low: [1, -1], high: [3, 1]}]
    allow_gaps: false

Cells never overlap: a reference must have one policy. Those of a file fill their bounding box
unless it allows gaps; the paper's six leave a third of it uncovered.
"""

from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.configuration import Configuration, read_yaml
from softfin.core.errors import ConfigurationError
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Cells, Reachable, bounding_box
from softfin.task.notation import read_cells, read_range

PAPER_CELLS = tuple(Cell.around(reference) for reference in PAPER_REFERENCES)
"""The grid: squares of 1 N around the six references, which touch but do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""Range for which a single controller is trained: the bounding box of the grid."""

SAME_EDGE_N = 1e-6
"""Edges closer than this are the same edge."""

GAP_N2 = 1e-5
"""Total area from which on there is a gap; edges are rounded decimals."""

MOST = 1024
"""Largest number of cells in a lattice; each is a policy to train, so more must be a typing
error."""


ForcePoint = Float[Array, "2"]
ForceBatch = Float[Array, "*batch 2"]
"""(x, y) [N]."""


class References(NamedTuple):
    """A box from which references are drawn, as arrays, so that one program works for many
    boxes."""

    low: Float[Array, "*stack 2"]
    high: Float[Array, "*stack 2"]
    reachable: Reachable | None = None
    """Mean forces that the fin can make, if they are known."""

    @classmethod
    def of(cls, cell: Cell, reachable: Reachable | None = None) -> "References":
        """The references of a cell."""
        return cls(
            jnp.asarray(cell.low, jnp.float32), jnp.asarray(cell.high, jnp.float32), reachable
        )

    def draw(self, key: PRNGKeyArray) -> ForcePoint:
        """Draw one reference, uniform over the box."""
        return self.at(jax.random.uniform(key, (2,)))

    def at(self, place: ForcePoint) -> ForcePoint:
        """Return the reference at a relative position (0 to 1, 0 to 1) of the box; outside the
        fin's reach, the nearest one on its edge."""
        return self.nearest(self.low + place * (self.high - self.low))

    def nearest(self, force: ForceBatch) -> ForceBatch:
        """Return the reference of the box that is nearest to a force; outside the fin's reach, the
        nearest one on its edge."""
        inside = jnp.clip(force, self.low, self.high)
        return inside if self.reachable is None else jnp.asarray(self.reachable.project(inside))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """Return the references of many cells, along a leading axis; all for the same fin."""
    each = [References.of(cell, jax.tree.map(jnp.asarray, reachable)) for cell in cells]
    stacked: References = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return stacked


class CellsFile(Configuration):
    """Content of a YAML file of cells."""

    cells: Cells
    """Boxes of references [N], in the order of the policies."""
    allow_gaps: bool = False
    """Whether references between the cells may lack their own policy; the nearest cell is used for
    them."""


def parse_cells(text: str, within: Cell) -> Cells:
    """Parse the cells; a lattice fills `within`, the others have their own position.

    Raises:
        ConfigurationError: not a lattice or file, or cells that overlap, have no width, or leave
            gaps that are not allowed.
    """
    source = read_cells(text)
    if source is None:
        return PAPER_CELLS
    if isinstance(source, tuple):
        return lattice(*source, within)
    values = CellsFile.build(read_yaml(source), f"--cells {text}")
    check_cells(values.cells, values.allow_gaps, f"--cells {text}")
    return values.cells


def parse_range(text: str) -> Cell:
    """Parse the box ``X0,Y0,X1,Y1`` [N]; raises ConfigurationError for any other text."""
    x0, y0, x1, y1 = read_range(text)
    return Cell.build({"low": (x0, y0), "high": (x1, y1)}, f"--range {text}")


def lattice(columns: int, rows: int, within: Cell) -> Cells:
    """Equal cells, `columns` along x and `rows` along y, that fill a range, in the order of x."""
    asked = f"--cells {columns}x{rows}"
    if not 1 <= columns * rows <= MOST:
        raise ConfigurationError(
            f"{asked}: {columns * rows} cells; give 1 .. {MOST}, one or more along each axis"
        )
    check_width(within, f"{asked}: the range ({within})")
    # Neighbours share exactly the same edge.
    xs = np.linspace(within.low[0], within.high[0], columns + 1).tolist()
    ys = np.linspace(within.low[1], within.high[1], rows + 1).tolist()
    return tuple(
        Cell(low=(x0, y0), high=(x1, y1)) for x0, x1 in pairwise(xs) for y0, y1 in pairwise(ys)
    )


def check_width(cell: Cell, named: str) -> None:
    """Raise ConfigurationError if a box has no width."""
    for axis, low, high in zip("xy", cell.low, cell.high, strict=True):
        if high - low <= SAME_EDGE_N:
            raise ConfigurationError(
                f"{named} has no width in {axis}; give a smaller and a larger force"
            )


def check_apart(cells: Sequence[Cell], source: str) -> None:
    """Raise ConfigurationError if two cells overlap."""
    for (i, one), (j, other) in combinations(enumerate(cells, 1), 2):
        low = np.maximum(one.low, other.low)
        high = np.minimum(one.high, other.high)
        if (high - low > SAME_EDGE_N).all():
            shared = Cell(low=tuple(low.tolist()), high=tuple(high.tolist()))
            raise ConfigurationError(
                f"{source}: cells {i} ({one}) and {j} ({other}) overlap in {shared}; move an edge, "
                "so that each reference has one cell"
            )


def check_cells(cells: Sequence[Cell], allow_gaps: bool, source: str) -> None:
    """Raise ConfigurationError if there are no cells, one has no width, two overlap, or gaps are
    not allowed."""
    if not cells:
        raise ConfigurationError(
            f"{source}: no cells; give at least one {{low: [x, y], high: [x, y]}}"
        )
    for number, cell in enumerate(cells, 1):
        check_width(cell, f"{source}: cell {number} ({cell})")
    check_apart(cells, source)
    # The cells do not overlap, so areas add up.
    box = bounding_box(cells)
    gaps = area(box) - sum(map(area, cells))
    if not allow_gaps and gaps > GAP_N2:
        raise ConfigurationError(
            f"{source}: the cells leave {gaps:.3g} N^2 of their bounding box ({box}) uncovered; "
            "add cells there, or write allow_gaps: true in the file"
        )


def area(cell: Cell) -> float:
    """Area of a cell [N^2]."""
    return float((cell.high[0] - cell.low[0]) * (cell.high[1] - cell.low[1]))
