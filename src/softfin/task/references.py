"""Reference forces to train for: the paper's, cells of a grid, and boxes from which references are
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
"""The grid: squares of 1 N round the six references; they touch and do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""Range that one controller is trained for: the bounding box of the grid."""

SAME_EDGE_N = 1e-6
"""Edges nearer than this are the same edge."""

GAP_N2 = 1e-5
"""Area in all that counts as a gap: edges come from decimals."""

MOST = 1024
"""Cells of a lattice; each is a policy to train, so more are a typing error."""


ForcePoint = Float[Array, "2"]
ForceBatch = Float[Array, "*batch 2"]
"""(x, y) [N]."""


class References(NamedTuple):
    """A box from which references are drawn, as arrays: one program serves many boxes."""

    low: Float[Array, "*stack 2"]
    high: Float[Array, "*stack 2"]
    reachable: Reachable | None = None
    """Mean forces that the fin can make, where these are known."""

    @classmethod
    def of(cls, cell: Cell, reachable: Reachable | None = None) -> "References":
        """The references of a cell."""
        return cls(
            jnp.asarray(cell.low, jnp.float32), jnp.asarray(cell.high, jnp.float32), reachable
        )

    def draw(self, key: PRNGKeyArray) -> ForcePoint:
        """One reference, uniform over the box."""
        return self.at(jax.random.uniform(key, (2,)))

    def at(self, place: ForcePoint) -> ForcePoint:
        """The reference at (0 to 1, 0 to 1) of the box; beyond the fin's reach, the one on the edge
        of the reach."""
        return self.nearest(self.low + place * (self.high - self.low))

    def nearest(self, force: ForceBatch) -> ForceBatch:
        """The reference of the box that is nearest to a force; beyond the fin's reach, the one on
        its edge."""
        inside = jnp.clip(force, self.low, self.high)
        return inside if self.reachable is None else jnp.asarray(self.reachable.project(inside))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """The references of many cells, along a leading axis; all of one fin."""
    each = [References.of(cell, jax.tree.map(jnp.asarray, reachable)) for cell in cells]
    stacked: References = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return stacked


class CellsFile(Configuration):
    """Content of a file of cells."""

    cells: Cells
    """Boxes of references [N], in the order of the policies."""
    allow_gaps: bool = False
    """Whether references between the cells may go without a policy of their own; the nearest cell
    answers these."""


def parse_cells(text: str, within: Cell) -> Cells:
    """The cells of a text; a lattice fills `within`, the others have places of their own.

    Raises:
        ConfigurationError: not a lattice or file, or cells that overlap, have no width, or leave
            gaps without leave.
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
    """The box of ``X0,Y0,X1,Y1`` [N]; raises ConfigurationError for any other text."""
    x0, y0, x1, y1 = read_range(text)
    return Cell.build({"low": (x0, y0), "high": (x1, y1)}, f"--range {text}")


def lattice(columns: int, rows: int, within: Cell) -> Cells:
    """Equal cells, `columns` along x and `rows` along y, that fill a range; those of the least x
    first."""
    asked = f"--cells {columns}x{rows}"
    if not 1 <= columns * rows <= MOST:
        raise ConfigurationError(
            f"{asked}: {columns * rows} cells; give 1 .. {MOST}, one or more along each axis"
        )
    check_width(within, f"{asked}: the range ({within})")
    # Neighbours share an edge to the last bit.
    xs = np.linspace(within.low[0], within.high[0], columns + 1).tolist()
    ys = np.linspace(within.low[1], within.high[1], rows + 1).tolist()
    return tuple(
        Cell(low=(x0, y0), high=(x1, y1)) for x0, x1 in pairwise(xs) for y0, y1 in pairwise(ys)
    )


def check_width(cell: Cell, named: str) -> None:
    """Raise ConfigurationError where a box has no width."""
    for axis, low, high in zip("xy", cell.low, cell.high, strict=True):
        if high - low <= SAME_EDGE_N:
            raise ConfigurationError(
                f"{named} has no width in {axis}; let it reach from a lesser to a greater force"
            )


def check_apart(cells: Sequence[Cell], source: str) -> None:
    """Raise ConfigurationError where two cells overlap."""
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
    """Raise ConfigurationError where there are none, one has no width, two overlap, or gaps are not
    allowed."""
    if not cells:
        raise ConfigurationError(
            f"{source}: no cells; give at least one {{low: [x, y], high: [x, y]}}"
        )
    for number, cell in enumerate(cells, 1):
        check_width(cell, f"{source}: cell {number} ({cell})")
    check_apart(cells, source)
    # They do not overlap.
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
