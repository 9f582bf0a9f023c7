"""Regions of mean forces: the cells for which controllers are trained, and the region that a fin
can reach.

The reachable region is star-shaped about a force inside it, stored as a radius in equally spaced
directions, so that one division tells whether a force is inside. It works on NumPy arrays and, for
`project`, within JAX programs.
"""

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from pydantic import model_validator

from softfin.core.configuration import Configuration
from softfin.core.json_object import JsonObject
from softfin.core.operations import select_operations
from softfin.core.quantities import AnyArray

ForceVector: TypeAlias = tuple[float | int, float | int]
"""(x, y) [N]."""

Forces: TypeAlias = Float[np.ndarray, "*forces 2"]
ForcePoints: TypeAlias = Float[np.ndarray, "..."]

PAPER_REFERENCES: tuple[ForceVector, ...] = ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1))
"""Reference forces of the paper's Table II [N]."""

TOLERANCE_N = 1e-3
"""Forces this close to the edge of a region count as inside."""

MAX_CHUNK_FORCES = 2048
"""Number of forces whose nearest ones are computed together, which limits the memory."""


class Cell(Configuration):
    """Axis-aligned box of reference forces."""

    low: ForceVector
    """Least (x, y) [N]."""
    high: ForceVector
    """Upper corner (x, y) [N]; not below `low`, equal to it for a single reference."""

    @model_validator(mode="after")
    def _ordered(self) -> "Cell":
        if self.low[0] > self.high[0] or self.low[1] > self.high[1]:
            raise ValueError(
                f"low {self.low} is above high {self.high}; give the lower corner first"
            )
        return self

    @classmethod
    def around(cls, centre: ForceVector, width_n: float = 1.0) -> "Cell":
        """Build a square about a force."""
        return cls(low=centre, high=centre).expanded(width_n / 2)

    def expanded(self, margin_n: float) -> "Cell":
        """Build the cell that is larger by the margin on every side."""
        x0, y0 = self.low
        x1, y1 = self.high
        return Cell(low=(x0 - margin_n, y0 - margin_n), high=(x1 + margin_n, y1 + margin_n))

    def lattice(self, count: int) -> tuple[ForceVector, ...]:
        """Return `count` x `count` references, each in the middle of an equal part of the cell."""
        x0, y0 = self.low
        x1, y1 = self.high
        steps = [(i + 0.5) / count for i in range(count)]
        return tuple((x0 + a * (x1 - x0), y0 + b * (y1 - y0)) for a, b in product(steps, steps))

    def distance(self, reference: ForceVector) -> float:
        """Distance from the cell to a reference [N]; 0 inside and on the edge."""
        x, y = (
            max(a - r, 0.0, r - b) for a, r, b in zip(self.low, reference, self.high, strict=True)
        )
        return float((x**2 + y**2) ** 0.5)

    def __str__(self) -> str:
        return f"x {self.low[0]:g} .. {self.high[0]:g}, y {self.low[1]:g} .. {self.high[1]:g} N"


Cells: TypeAlias = tuple[Cell, ...]


def format_force(force: ForceVector | Float[np.ndarray, "2"]) -> str:
    """Write a force as ``(x, y)``, without its unit."""
    return f"({force[0]:g}, {force[1]:g})"


def cell_corners(cells: Sequence[Cell]) -> tuple[Forces, Forces]:
    """Return the lower and the upper corners of cells, ``(cells, 2)`` float32 [N]."""
    low = np.array([cell.low for cell in cells], np.float32)
    high = np.array([cell.high for cell in cells], np.float32)
    return low, high


def bounding_box(cells: Sequence[Cell]) -> Cell:
    """Build the smallest cell that contains all cells."""
    low = min(cell.low[0] for cell in cells), min(cell.low[1] for cell in cells)
    high = max(cell.high[0] for cell in cells), max(cell.high[1] for cell in cells)
    return Cell(low=low, high=high)


class Reachable(NamedTuple):
    """Mean forces that a fin can make: a star-shaped polygon."""

    centre: Float[AnyArray, "2"]
    """Force (x, y) about which the polygon is star-shaped [N]."""
    radius: Float[AnyArray, "directions"]
    """Distance of each corner from the centre [N]; corner k lies in the direction of 2 pi k /
    directions from +x."""

    @classmethod
    def from_dict(cls, description: object) -> "Reachable":
        """Build it from the result of `to_dict`; raises KeyError, TypeError or ValueError for
        anything else."""
        if not isinstance(description, dict):
            raise TypeError(
                f"reachable is {description!r}; it must be an object with centre_n and radius_n"
            )
        centre = np.asarray(description["centre_n"], np.float32)
        radius = np.asarray(description["radius_n"], np.float32)
        if centre.shape != (2,) or radius.ndim != 1 or len(radius) < 3:
            raise ValueError(
                f"reachable: centre {centre.shape} and radius {radius.shape} do not describe a "
                "region"
            )
        if not np.isfinite(centre).all() or not (np.isfinite(radius) & (radius >= 0)).all():
            raise ValueError("reachable: centre and radius must be finite, and no radius under 0")
        return cls(centre, radius)

    def to_dict(self) -> JsonObject:
        """Return centre and radii [N] for JSON."""
        centre, radius = ([round(float(x), 5) for x in part] for part in self)
        return {"centre_n": centre, "radius_n": radius}

    def corners(self) -> Float[np.ndarray, "directions 2"]:
        """Corners of the polygon [N], anticlockwise."""
        return np.asarray(
            self.centre + np.asarray(self.radius)[:, None] * directions(len(self.radius))
        )

    def project(self, force: Any) -> Any:
        """Return each force if it is inside, otherwise the point where the line to the centre meets
        the edge; takes NumPy or JAX arrays."""
        ops = select_operations(force, self.radius)
        count = self.radius.shape[-1]
        xp = ops.xp
        ways = ops.constant(directions(count))
        radius = ops.constant(self.radius)
        # Transposed, so that the coordinates of a single force are numbers, which are quicker than
        # arrays.
        along = xp.asarray(force).T
        x = along[0] - self.centre[0]
        y = along[1] - self.centre[1]
        turn = xp.arctan2(y, x) / (2 * np.pi) % 1 * count
        first = turn.astype(np.int32) % count
        (ax, ay), (bx, by) = (
            (radius[k] * ways[k, 0], radius[k] * ways[k, 1]) for k in (first, (first + 1) % count)
        )
        # The ray (x, y) * s meets the side a + (b - a) t where (x, y) x (a - b) s = a x (a - b),
        # both negative.
        across = x * (ay - by) - y * (ax - bx)
        reach = (ax * (ay - by) - ay * (ax - bx)) / xp.minimum(across, -1e-9)
        edge = xp.asarray([self.centre[0] + x * reach, self.centre[1] + y * reach])
        return xp.where(reach >= 1, along, edge).T

    def contains(self, force: Any, tolerance_n: float = TOLERANCE_N) -> Bool[np.ndarray, "*forces"]:
        """Whether each force is inside, or its projection is within the tolerance of it."""
        force = np.asarray(force, float)
        return np.asarray(np.linalg.norm(self.project(force) - force, axis=-1) <= tolerance_n)

    def nearest(self, force: Any) -> Forces:
        """Return each force if it is inside, otherwise the nearest point of the edge [N]."""
        at = np.asarray(force, float)
        corners = self.corners().astype(float)
        points = _on_sides(corners, at, 0, 1)
        inside = np.isclose(self.project(at), at, atol=1e-5).all(axis=-1)
        return np.where(inside[..., None], at, _choose_nearest(points, at))

    def nearest_within(self, cells: Sequence[Cell], forces: Forces) -> Forces:
        """Return, for each force, the nearest one that is inside both the region and a cell; NaN if
        there is none.

        It is the nearest point of the cell, of one of its sides or corners, or of the region's
        edge.
        """
        chunks = []
        for start in range(0, max(len(forces), 1), MAX_CHUNK_FORCES):
            chunk = forces[start : start + MAX_CHUNK_FORCES].astype(float)
            candidates = []
            for cell in cells:
                candidates += [self._on_cell(cell, chunk), self._on_edge(cell, chunk)]
            chunks.append(_choose_nearest(np.concatenate(candidates, axis=1), chunk))
        return np.concatenate(chunks)

    def _on_cell(
        self, cell: Cell, forces: Float[np.ndarray, "forces 2"]
    ) -> Float[np.ndarray, "forces candidates 2"]:
        # Each coordinate is the nearest of the cell, its lower or its upper end.
        x, y = zip(np.clip(forces, cell.low, cell.high).T, cell.low, cell.high, strict=True)
        candidates = np.empty((len(forces), 9, 2))
        for index, point in enumerate(product(x, y)):
            candidates[:, index, 0], candidates[:, index, 1] = point
        return np.where(self.contains(candidates)[..., None], candidates, np.nan)

    def _on_edge(
        self, cell: Cell, forces: Float[np.ndarray, "forces 2"]
    ) -> Float[np.ndarray, "forces candidates 2"]:
        corners = self.corners().astype(float)
        side = np.roll(corners, -1, axis=0) - corners
        # Where each side enters and leaves the cell, as a fraction of its length (Liang and Barsky
        # 1984).
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (np.asarray(cell.low) - corners) / side
            other = (np.asarray(cell.high) - corners) / side
        # A side along an axis is between the cell's edges all the way or nowhere.
        between = (corners >= cell.low) & (corners <= cell.high)
        first = np.where(side == 0, np.where(between, 0, np.inf), np.minimum(one, other))
        last = np.where(side == 0, np.where(between, 1, -np.inf), np.maximum(one, other))
        enter = first.max(axis=1).clip(0)
        leave = last.min(axis=1).clip(max=1)
        on_side = _on_sides(corners, forces, enter, np.maximum(enter, leave))
        # Rounding must not leave the cell.
        return np.where((enter <= leave)[:, None], np.clip(on_side, cell.low, cell.high), np.nan)

    def area(self) -> float:
        """Area of the polygon [N^2]."""
        turn = 2 * np.pi / len(self.radius)
        radius = np.asarray(self.radius, float)
        return float(np.sin(turn) / 2 * (radius * np.roll(radius, -1)).sum())

    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lower and upper corner (x, y) of the bounding box [N]."""
        x0, y0 = self.corners().min(axis=0).tolist()
        x1, y1 = self.corners().max(axis=0).tolist()
        return (x0, y0), (x1, y1)


@cache
def directions(count: int) -> Float[np.ndarray, "directions 2"]:
    """Return equally spaced unit vectors, anticlockwise from +x."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _on_sides(
    corners: Float[np.ndarray, "sides 2"], force: ForcePoints, enter: Any, leave: Any
) -> ForcePoints:
    """Return the nearest point to each force on a part of each side of a polygon, ``(..., sides,
    2)``."""
    side = np.roll(corners, -1, axis=0) - corners
    along = ((force[..., None, :] - corners) * side).sum(axis=-1) / np.maximum(
        (side**2).sum(axis=-1), 1e-12
    )
    return np.asarray(corners + np.clip(along, enter, leave)[..., None] * side)


def _choose_nearest(points: ForcePoints, force: ForcePoints) -> ForcePoints:
    """Return the nearest of ``(..., points, 2)`` to each force; points that are NaN come last."""
    distance = np.linalg.norm(points - force[..., None, :], axis=-1)
    nearest = np.where(np.isnan(distance), np.inf, distance).argmin(axis=-1)
    return np.take_along_axis(points, nearest[..., None, None], axis=-2)[..., 0, :]
