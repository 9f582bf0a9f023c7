"""Reference forces for training: the paper's references, cells of a grid, and boxes from which
references are drawn at random.

On the command line, cells are ``paper``, a uniform grid over a range such as ``3x3``, or a YAML
file of boxes:

    cells: [{low: [0, -1], high: [1, 1]}, {low: [1, -1], high: [3, 1]}]
    allow_gaps: false

Cells never overlap, because each reference must have exactly one policy. The cells of a file must
fill their bounding box unless the file allows gaps; the paper's six cells leave a third of it
uncovered.
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
"""The paper's grid: squares of 1 N around the six references, which touch but do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""Default range of a single controller: the bounding box of the paper's grid."""

SAME_EDGE_N = 1e-6
"""Distance below which two edges are treated as equal [N]."""

GAP_N2 = 1e-5
"""Uncovered area above which the cells count as having a gap [N^2]; smaller areas come from rounded
edges."""

MOST = 1024
"""Maximum number of cells in a uniform grid. Each is a policy to train, so a larger number is
probably a typo."""


ForcePoint = Float[Array, "2"]
ForceBatch = Float[Array, "*batch 2"]
"""(x, y) [N]."""


class References(NamedTuple):
    """A box from which references are drawn, as arrays, so that one compiled program works for many
    boxes."""

    low: Float[Array, "*stack 2"]
    high: Float[Array, "*stack 2"]
    reachable: Reachable | None = None
    """Mean forces that the fin can produce, if known."""

    @classmethod
    def of(cls, cell: Cell, reachable: Reachable | None = None) -> "References":
        """Build the references of a cell."""
        return cls(
            jnp.asarray(cell.low, jnp.float32), jnp.asarray(cell.high, jnp.float32), reachable
        )

    def draw(self, key: PRNGKeyArray) -> ForcePoint:
        """Draw one reference, uniform over the box."""
        return self.at(jax.random.uniform(key, (2,)))

    def at(self, place: ForcePoint) -> ForcePoint:
        """Return the reference at a relative position (0 to 1, 0 to 1) in the box; if it is
        unreachable, the nearest reachable one."""
        return self.nearest(self.low + place * (self.high - self.low))

    def nearest(self, force: ForceBatch) -> ForceBatch:
        """Return the reference in the box that is nearest to a force; if it is unreachable, the
        nearest reachable one."""
        inside = jnp.clip(force, self.low, self.high)
        return inside if self.reachable is None else jnp.asarray(self.reachable.project(inside))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """Stack the references of many cells, for the same fin, along a leading axis."""
    each = [References.of(cell, jax.tree.map(jnp.asarray, reachable)) for cell in cells]
    stacked: References = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return stacked


class CellsFile(Configuration):
    """Contents of a YAML file with cells."""

    cells: Cells
    """Boxes of reference forces [N], in the order of the policies."""
    allow_gaps: bool = False
    """Whether there may be references between the cells, for which the nearest cell is used."""


def parse_cells(text: str, within: Cell) -> Cells:
    """Parse the cells. A uniform grid fills `within`; other cells have fixed positions.

    Raises:
        ConfigurationError: the text is not a grid or file, or the cells overlap, have no width, or
            leave gaps that are not allowed.
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
    """Return equal cells, `columns` along x and `rows` along y, that fill a range, ordered by x,
    then y."""
    asked = f"--cells {columns}x{rows}"
    if not 1 <= columns * rows <= MOST:
        raise ConfigurationError(
            f"{asked}: {columns * rows} cells; use 1 to {MOST} cells, at least one along each axis"
        )
    check_width(within, f"{asked}: the range ({within})")
    # Shared arrays of edges, so that neighbours have exactly the same edge.
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
                f"{named} has no width in {axis}; use a lower and a higher force"
            )


def check_apart(cells: Sequence[Cell], source: str) -> None:
    """Raise ConfigurationError if two cells overlap."""
    for (i, one), (j, other) in combinations(enumerate(cells, 1), 2):
        low = np.maximum(one.low, other.low)
        high = np.minimum(one.high, other.high)
        if (high - low > SAME_EDGE_N).all():
            shared = Cell(low=tuple(low.tolist()), high=tuple(high.tolist()))
            raise ConfigurationError(
                f"{source}: cells {i} ({one}) and {j} ({other}) overlap in {shared}; move an edge "
                "so that each reference has one cell"
            )


def check_cells(cells: Sequence[Cell], allow_gaps: bool, source: str) -> None:
    """Raise ConfigurationError if there are no cells, a cell has no width, two overlap, or there
    are gaps that are not allowed."""
    if not cells:
        raise ConfigurationError(
            f"{source}: no cells; add at least one {{low: [x, y], high: [x, y]}}"
        )
    for number, cell in enumerate(cells, 1):
        check_width(cell, f"{source}: cell {number} ({cell})")
    check_apart(cells, source)
    # The cells do not overlap, so their areas add up to the covered area.
    box = bounding_box(cells)
    gaps = area(box) - sum(map(area, cells))
    if not allow_gaps and gaps > GAP_N2:
        raise ConfigurationError(
            f"{source}: the cells leave {gaps:.3g} N^2 of their bounding box ({box}) uncovered; "
            "add cells there, or set allow_gaps: true in the file"
        )


def area(cell: Cell) -> float:
    """Return the area of a cell [N^2]."""
    return float((cell.high[0] - cell.low[0]) * (cell.high[1] - cell.low[1]))
