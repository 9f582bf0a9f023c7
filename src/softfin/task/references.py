"""Reference forces: the six of the paper's Table II, and the cells round them; no JAX here."""

from collections.abc import Sequence
from typing import TypeAlias

from pydantic import model_validator

from softfin.core.configuration import Configuration

Force: TypeAlias = tuple[float | int, float | int]
"""(x, y) [N]."""

PAPER_REFERENCES: tuple[Force, ...] = ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1))
"""Table II."""


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
        """A square cell."""
        half = width_n / 2
        return cls(low=(centre[0] - half, centre[1] - half), high=(centre[0] + half, centre[1] + half))

    def expanded(self, margin_n: float) -> "Cell":
        """The cell, wider by as much on every side."""
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
        """Distance from the cell to a reference [N]; 0 inside and on the edge."""
        beyond = [max(a - r, 0.0, r - b) for a, r, b in zip(self.low, reference, self.high, strict=True)]
        return float((beyond[0] ** 2 + beyond[1] ** 2) ** 0.5)

    def __str__(self) -> str:
        return f"x {self.low[0]:g} .. {self.high[0]:g}, y {self.low[1]:g} .. {self.high[1]:g} N"


PAPER_CELLS = tuple(Cell.around(reference) for reference in PAPER_REFERENCES)
"""The grid: squares of 1 N round the six references; they touch and do not overlap."""

PAPER_RANGE = Cell(low=(0.5, -1.5), high=(3.5, 1.5))
"""What one controller is trained for: the bounding box of the grid."""


def bounding_box(cells: Sequence[Cell]) -> Cell:
    """The smallest box that holds all cells."""
    low, high = zip(*((cell.low, cell.high) for cell in cells), strict=True)
    return Cell(low=(min(x for x, _ in low), min(y for _, y in low)),
                high=(max(x for x, _ in high), max(y for _, y in high)))  # fmt: skip
