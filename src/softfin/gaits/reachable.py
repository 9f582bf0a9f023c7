"""Regions of mean forces: the cells for which controllers are trained, and the reachable region of
a fin.

The reachable region is star-shaped about a force inside it. It is stored as radii in equally spaced
directions, so one division determines whether a force is inside. All functions work on NumPy
arrays; `Reachable.project` also works in JAX programs.
"""

import math
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

PAPER_REFERENCES: tuple[ForceVector, ...] = ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1))
"""Reference forces of the paper's Table II [N]."""

EDGE_FRACTION = 4e-4
"""Distance outside a region within which forces are treated as inside, as a fraction of the largest
radius; needed because corners are rounded in files."""

PAPER_REACH_N = 2.4
"""Reach of the paper's fin in the virtual tank [N], defined as in `Reachable.reach_n`. Tolerances,
scales and weights were tuned on this fin; for other fins, they are multiplied by
`Reachable.size`."""

PAPER_PEAK_N = 13.0
"""Peak force of the paper's fin on one axis under random commands in the virtual tank [N]. On a
rig, the reach is unknown before the first logs, so the peak determines the fin size."""

MIN_REACH_SHARE = 0.25
"""Minimum reach, as a fraction of the largest radius of a region. A fin whose forces lie on a line
has a region without area, but its tolerances must still suit the length of the line."""

DECADE_SIZES = (1.0, 2.0, 5.0, 10.0)
"""Fin sizes within a decade. Sizes are rounded to these values, so that scaled tolerances are round
numbers and do not depend on the last digits of a reach."""

OUTLINE_POINTS = 8192
"""Number of points that represent the edge of a region or cell in the search for the nearest force;
for the paper's fin, they are about 2 mN apart."""


class Cell(Configuration):
    """Axis-aligned box of reference forces."""

    low: ForceVector
    """Lower corner (x, y) [N]."""
    high: ForceVector
    """Upper corner (x, y) [N]; equal to `low` for a single reference."""

    @model_validator(mode="after")
    def _ordered(self) -> "Cell":
        if self.low[0] > self.high[0] or self.low[1] > self.high[1]:
            raise ValueError(
                f"low {self.low} must not be greater than high {self.high}; use the lower corner "
                "first"
            )
        return self

    @classmethod
    def around(cls, centre: ForceVector, width_n: float = 1.0) -> "Cell":
        """Build a square centred on a force."""
        x, y = centre
        half = width_n / 2
        return cls(low=(x - half, y - half), high=(x + half, y + half))

    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Return the corners of the cell in counterclockwise order [N]."""
        x0, y0 = self.low
        x1, y1 = self.high
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)

    def lattice(self, count: int) -> tuple[ForceVector, ...]:
        """Divide the cell into `count` x `count` equal parts and return their centres."""
        x0, y0 = self.low
        x1, y1 = self.high
        steps = [(i + 0.5) / count for i in range(count)]
        return tuple((x0 + a * (x1 - x0), y0 + b * (y1 - y0)) for a, b in product(steps, steps))

    def distance(self, reference: ForceVector) -> float:
        """Return the distance from the cell to a reference [N]; 0 inside and on the edge."""
        x = max(self.low[0] - reference[0], 0.0, reference[0] - self.high[0])
        y = max(self.low[1] - reference[1], 0.0, reference[1] - self.high[1])
        return float((x**2 + y**2) ** 0.5)

    def __str__(self) -> str:
        x0, y0 = self.low
        x1, y1 = self.high
        return f"x {x0:.4g} .. {x1:.4g}, y {y0:.4g} .. {y1:.4g} N"


Cells: TypeAlias = tuple[Cell, ...]


def format_force(force: ForceVector | Float[np.ndarray, "2"]) -> str:
    """Format a force as ``(x, y)``, without its unit; rounding errors are not shown."""
    x, y = np.round(force, 9) + 0.0
    return f"({x:g}, {y:g})"


def force_decimals(largest_n: float | int) -> int:
    """Return the number of decimals for displaying forces up to a size [N]: two from 1 to 10 N,
    more for smaller forces."""
    return max(2 - math.floor(math.log10(largest_n)), 0) if largest_n > 0 else 2


def round_size(ratio: float) -> float:
    """Round a force divided by the force of the paper's fin to 1, 2 or 5 times a power of ten [-];
    returns 1 for 0."""
    if ratio <= 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(ratio))
    nearest = min(DECADE_SIZES, key=lambda size: abs(math.log(ratio / decade / size)))
    return float(f"{nearest * decade:.1g}")


def cell_corners(cells: Sequence[Cell]) -> tuple[Forces, Forces]:
    """Return the lower and upper corners of cells, ``(cells, 2)`` float32 [N]."""
    low = np.array([cell.low for cell in cells], np.float32)
    high = np.array([cell.high for cell in cells], np.float32)
    return low, high


def bounding_box(cells: Sequence[Cell]) -> Cell:
    """Build the smallest cell that contains all cells."""
    low = min(cell.low[0] for cell in cells), min(cell.low[1] for cell in cells)
    high = max(cell.high[0] for cell in cells), max(cell.high[1] for cell in cells)
    return Cell(low=low, high=high)


class Reachable(NamedTuple):
    """Reachable mean forces of a fin, as a star-shaped polygon."""

    centre: Float[AnyArray, "2"]
    """Force (x, y) about which the polygon is star-shaped [N]."""
    radius: Float[AnyArray, "directions"]
    """Distance of each corner from the centre [N]; corner k is at the angle 2 pi k / directions
    from +x."""

    @classmethod
    def from_dict(cls, description: object) -> "Reachable":
        """Build a region from the result of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: If the data do not describe a region.
        """
        if not isinstance(description, dict):
            raise TypeError(
                f"reachable = {description!r}: must be an object with centre_n and radius_n"
            )
        centre = np.asarray(description["centre_n"], np.float32)
        radius = np.asarray(description["radius_n"], np.float32)
        is_region = centre.shape == (2,) and radius.ndim == 1 and len(radius) >= 3
        # Negated so that NaN is also refused.
        if not is_region or not (np.isfinite([*centre, *radius]).all() and (radius >= 0).all()):
            raise ValueError(
                "reachable: centre_n must be 2 finite numbers, and radius_n at least 3, none of "
                "them negative"
            )
        return cls(centre, radius)

    def to_dict(self) -> JsonObject:
        """Return the centre and the radii [N] for JSON, rounded to six digits of the largest
        radius."""
        decimals = force_decimals(float(np.max(self.radius))) + 3
        return {
            "centre_n": [round(float(x), decimals) for x in self.centre],
            "radius_n": [round(float(x), decimals) for x in self.radius],
        }

    def corners(self) -> Float[np.ndarray, "directions 2"]:
        """Return the corners of the polygon in counterclockwise order [N]."""
        return np.asarray(
            self.centre + np.asarray(self.radius)[:, None] * directions(len(self.radius))
        )

    def project(self, force: Any) -> Any:
        """Return each force if it is inside, otherwise the intersection of the edge and the line
        from the force to the centre; accepts NumPy and JAX arrays."""
        ops = select_operations(force, self.radius)
        count = self.radius.shape[-1]
        xp = ops.xp
        ways = ops.constant(directions(count))
        radius = ops.constant(self.radius)
        # Transposed so that the coordinates of a single force are numbers, which are faster than
        # arrays in NumPy.
        along = xp.asarray(force).T
        x = along[0] - self.centre[0]
        y = along[1] - self.centre[1]
        turn = xp.arctan2(y, x) / (2 * np.pi) % 1 * count
        first = turn.astype(np.int32) % count
        # The side of the polygon in the direction of the force, from a to b, relative to the
        # centre.
        second = (first + 1) % count
        ax = radius[first] * ways[first, 0]
        ay = radius[first] * ways[first, 1]
        bx = radius[second] * ways[second, 0]
        by = radius[second] * ways[second, 1]
        # The ray (x, y) * s meets the line a + (b - a) t at (x, y) x (a - b) s = a x (a - b). Both
        # products are negative, and s >= 1 means that the force is inside.
        across = x * (ay - by) - y * (ax - bx)
        reach = (ax * (ay - by) - ay * (ax - bx)) / xp.minimum(across, -1e-9)
        edge = xp.asarray([self.centre[0] + x * reach, self.centre[1] + y * reach])
        return xp.where(reach >= 1, along, edge).T

    def contains(self, force: Any, tolerance_n: float | None = None) -> Bool[np.ndarray, "*forces"]:
        """Return whether each force is inside, or at most `tolerance_n` from its projection
        (default: `EDGE_FRACTION` of the largest radius)."""
        force = np.asarray(force, float)
        if tolerance_n is None:
            tolerance_n = EDGE_FRACTION * float(np.max(self.radius))
        return np.asarray(np.linalg.norm(self.project(force) - force, axis=-1) <= tolerance_n)

    def nearest(self, force: Any) -> Forces:
        """Return each force if it is inside, otherwise the nearest of `OUTLINE_POINTS` points on
        the edge [N]."""
        at = np.asarray(force, float)
        inside = self.contains(at, 1e-5 * float(np.max(self.radius)))
        return np.where(inside[..., None], at, _choose_nearest(_outline(self.corners()), at))

    def nearest_within(self, cells: Sequence[Cell], forces: Forces) -> Forces:
        """For each force, return the nearest force that is inside both the region and a cell, or
        NaN if there is none. The error is up to the spacing of `OUTLINE_POINTS` points on the
        edges."""
        inside = self.contains(forces) & _in_cells(cells, forces)
        # If a force is outside, the nearest force is on the edge of the region or of a cell.
        candidates = np.concatenate(
            [_outline(self.corners()), *(_outline(cell.corners()) for cell in cells)]
        )
        candidates = candidates[self.contains(candidates) & _in_cells(cells, candidates)]
        if not len(candidates):
            candidates = np.full((1, 2), np.nan)
        return np.where(inside[..., None], forces, _choose_nearest(candidates, forces))

    def area(self) -> float:
        """Return the area of the polygon [N^2]."""
        # The sum of the triangles between neighbouring radii, r_k r_{k+1} sin(angle) / 2.
        turn = 2 * np.pi / len(self.radius)
        radius = np.asarray(self.radius, float)
        return float(np.sin(turn) / 2 * (radius * np.roll(radius, -1)).sum())

    @property
    def reach_n(self) -> float:
        """Reach of the fin [N]: the radius of a circle with the same area as the region, but at
        least `MIN_REACH_SHARE` of the largest radius."""
        circle_n = float(np.sqrt(self.area() / np.pi))
        return max(circle_n, MIN_REACH_SHARE * float(np.max(self.radius)))

    @property
    def size(self) -> float:
        """Reach of the fin relative to the paper's fin, rounded to 1, 2 or 5 times a power of ten
        [-]; 1 for a fin that produces no force."""
        return round_size(self.reach_n / PAPER_REACH_N)

    def bounding_box(self) -> Cell:
        """Smallest cell that contains the region."""
        low = self.corners().min(axis=0).tolist()
        high = self.corners().max(axis=0).tolist()
        return Cell(low=tuple(low), high=tuple(high))


@cache
def directions(count: int) -> Float[np.ndarray, "directions 2"]:
    """Return equally spaced unit vectors, counterclockwise from +x."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _outline(corners: Float[np.ndarray, "corners 2"]) -> Forces:
    """Return `OUTLINE_POINTS` points on the sides of a polygon, including its corners."""
    side = np.roll(corners, -1, axis=0) - corners
    count = OUTLINE_POINTS // len(corners)
    points = corners[:, None] + np.arange(count)[:, None] / count * side[:, None]
    return np.asarray(points.reshape(-1, 2), float)


def _in_cells(cells: Sequence[Cell], forces: Forces) -> Bool[np.ndarray, "*forces"]:
    inside = [((forces >= cell.low) & (forces <= cell.high)).all(axis=-1) for cell in cells]
    return np.asarray(np.logical_or.reduce(inside))


def _choose_nearest(points: Float[np.ndarray, "points 2"], forces: Forces) -> Forces:
    """Return the point nearest to each force."""
    # One force at a time, to limit memory use.
    nearest = [
        points[((points - force) ** 2).sum(axis=1).argmin()] for force in forces.reshape(-1, 2)
    ]
    return np.array(nearest).reshape(forces.shape)
