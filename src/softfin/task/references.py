"""Reference forces: the six of the paper's Table II, the cells round them, and drawing at random from a cell."""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import model_validator

from softfin.core.configuration import Configuration
from softfin.gaits.reachable import Reachable

Force: TypeAlias = tuple[float | int, float | int]
"""(x, y) [N]."""

PAPER_REFERENCES: tuple[Force, ...] = ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1))
"""Table II."""


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
        return reference if self.reachable is None else self.reachable.pulled(reference)


class Cell(Configuration):
    """An axis-aligned box of reference forces."""

    low: Force
    """Least (x, y) [N]."""
    high: Force
    """Greatest (x, y) [N]; not under `low`, equal to it for a single reference."""

    @model_validator(mode="after")
    def _ordered(self) -> "Cell":
        if self.low[0] > self.high[0] or self.low[1] > self.high[1]:
            raise ValueError(f"low {self.low} is above high {self.high}; give the lower corner first")
        return self

    @classmethod
    def around(cls, centre: Force, width_n: float = 1.0) -> "Cell":
        """A square."""
        half = width_n / 2
        return cls(low=(centre[0] - half, centre[1] - half), high=(centre[0] + half, centre[1] + half))

    def grown(self, margin_n: float) -> "Cell":
        """Wider by as much on every side."""
        (x0, y0), (x1, y1) = self.low, self.high
        return Cell(low=(x0 - margin_n, y0 - margin_n), high=(x1 + margin_n, y1 + margin_n))

    @property
    def centre(self) -> Force:
        """The middle [N]."""
        return (self.low[0] + self.high[0]) / 2, (self.low[1] + self.high[1]) / 2

    def lattice(self, count: int) -> tuple[Force, ...]:
        """`count` x `count` references, each in the middle of an equal part of the cell."""
        steps = [(i + 0.5) / count for i in range(count)]
        (x0, y0), (x1, y1) = self.low, self.high
        return tuple((x0 + a * (x1 - x0), y0 + b * (y1 - y0)) for a in steps for b in steps)

    def distance(self, reference: Force) -> float:
        """From the cell to a reference [N]; 0 inside and on the edge."""
        beyond = [max(a - r, 0.0, r - b) for a, r, b in zip(self.low, reference, self.high, strict=True)]
        return float((beyond[0] ** 2 + beyond[1] ** 2) ** 0.5)

    def references(self) -> References:
        """As arrays."""
        return References(jnp.asarray(self.low, jnp.float32), jnp.asarray(self.high, jnp.float32))

    def __str__(self) -> str:
        return f"x {self.low[0]:g} .. {self.high[0]:g}, y {self.low[1]:g} .. {self.high[1]:g} N"


PAPER_CELLS = tuple(Cell.around(reference) for reference in PAPER_REFERENCES)
"""The grid: squares of 1 N round the six references; they touch and do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""What one controller is trained for: the least box round the grid."""


def least_box(cells: Sequence[Cell]) -> Cell:
    """Round all cells."""
    (x0, y0), (x1, y1) = (
        tuple(choose(getattr(cell, corner)[i] for cell in cells) for i in range(2))
        for corner, choose in (("low", min), ("high", max))
    )
    return Cell(low=(x0, y0), high=(x1, y1))


def stack_references(cells: Sequence[Cell], reachable: Reachable | None = None) -> References:
    """The boxes of many lanes, along a leading axis; all of one fin."""
    boxes = [cell.references() for cell in cells]
    low, high = jnp.stack([box.low for box in boxes]), jnp.stack([box.high for box in boxes])
    same = (
        None if reachable is None else Reachable(*(jnp.tile(x, (len(boxes), 1)) for x in map(jnp.asarray, reachable)))
    )
    return References(low, high, same)
