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
        half = width_n / 2
        return cls(
            low=(centre[0] - half, centre[1] - half), high=(centre[0] + half, centre[1] + half)
        )

    def expanded(self, margin_n: float) -> "Cell":
        """Build the cell that is larger by the margin on every side."""
        (x0, y0) = self.low
        (x1, y1) = self.high
        return Cell(low=(x0 - margin_n, y0 - margin_n), high=(x1 + margin_n, y1 + margin_n))

    def lattice(self, count: int) -> tuple[ForceVector, ...]:
        """Return `count` x `count` references, each in the middle of an equal part of the cell."""
        steps = [(i + 0.5) / count for i in range(count)]
        (x0, y0) = self.low
        (x1, y1) = self.high
        return tuple((x0 + a * (x1 - x0), y0 + b * (y1 - y0)) for a in steps for b in steps)

    def distance(self, reference: ForceVector) -> float:
        """Distance from the cell to a reference [N]; 0 inside and on the edge."""
        beyond = [
            max(a - r, 0.0, r - b) for a, r, b in zip(self.low, reference, self.high, strict=True)
        ]
        return float((beyond[0] ** 2 + beyond[1] ** 2) ** 0.5)

    def __str__(self) -> str:
        return f"x {self.low[0]:g} .. {self.high[0]:g}, y {self.low[1]:g} .. {self.high[1]:g} N"


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
        centre, radius = (
            np.asarray(description[name], np.float32) for name in ("centre_n", "radius_n")
        )
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
        return {
            f"{name}_n": [round(float(x), 5) for x in part] for name, part in self._asdict().items()
        }

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
        near = np.take_along_axis(points, _find_nearest(points, at)[..., None, None], axis=-2)[
            ..., 0, :
        ]
        return np.where(
            np.isclose(self.project(at), at, atol=1e-5).all(axis=-1)[..., None], at, near
        )

    def nearest_within(self, cells: Sequence[Cell], forces: Forces) -> Forces:
        """Return, for each force, the nearest one that is inside both the region and a cell; NaN if
        there is none.

        It is the nearest point of the cell, of one of its sides or corners, or of the region's
        edge.
        """
        if len(forces) > MAX_CHUNK_FORCES:
            return np.concatenate(
                [
                    self.nearest_within(cells, forces[i : i + MAX_CHUNK_FORCES])
                    for i in range(0, len(forces), MAX_CHUNK_FORCES)
                ]
            )
        forces = forces.astype(float)
        candidates = np.concatenate(
            [
                part
                for cell in cells
                for part in (self._on_cell(cell, forces), self._on_edge(cell, forces))
            ],
            axis=1,
        )
        return np.asarray(
            np.take_along_axis(
                candidates, _find_nearest(candidates, forces)[:, None, None], axis=1
            )[:, 0]
        )

    def _on_cell(
        self, cell: Cell, forces: Float[np.ndarray, "forces 2"]
    ) -> Float[np.ndarray, "forces candidates 2"]:
        x, y = zip(np.clip(forces, cell.low, cell.high).T, cell.low, cell.high, strict=True)
        points = [
            np.stack(np.broadcast_arrays(*point, x[0])[:2], axis=1) for point in product(x, y)
        ]
        candidates = np.stack(points, axis=1)
        return np.where(self.contains(candidates)[..., None], candidates, np.nan)

    def _on_edge(
        self, cell: Cell, forces: Float[np.ndarray, "forces 2"]
    ) -> Float[np.ndarray, "forces candidates 2"]:
        corners = self.corners().astype(float)
        side = np.roll(corners, -1, axis=0) - corners
        # Where each side enters and leaves the cell, as a fraction of its length (Liang and Barsky
        # 1984).
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings = np.stack(
                [(np.asarray(bound) - corners) / side for bound in (cell.low, cell.high)]
            )
        between = (corners >= cell.low) & (corners <= cell.high)
        enter = (
            np.where(side == 0, np.where(between, 0, np.inf), crossings.min(axis=0))
            .max(axis=1)
            .clip(0)
        )
        leave = (
            np.where(side == 0, np.where(between, 1, -np.inf), crossings.max(axis=0))
            .min(axis=1)
            .clip(max=1)
        )
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
        (x0, x1), (y0, y1) = ((float(side.min()), float(side.max())) for side in self.corners().T)
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


def _find_nearest(points: ForcePoints, force: ForcePoints) -> Any:
    """Return the index of the nearest of ``(..., points, 2)`` to each force; points that are NaN
    come last."""
    distance = np.linalg.norm(points - force[..., None, :], axis=-1)
    return np.where(np.isnan(distance), np.inf, distance).argmin(axis=-1)
