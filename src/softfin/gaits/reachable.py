"""Regions of mean forces: the cells for which controllers are trained, and the region that a fin
can reach.

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
ForcePoints: TypeAlias = Float[np.ndarray, "..."]

PAPER_REFERENCES: tuple[ForceVector, ...] = ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1))
"""Reference forces of the paper's Table II [N]."""

EDGE_FRACTION = 4e-4
"""Distance outside a region within which forces are still treated as inside, as a fraction of its
largest radius; corners are rounded in files."""

PAPER_REACH_N = 2.4
"""Reach of the paper's fin in the virtual tank [N], as `Reachable.reach_n`. Tolerances, scales and
weights were tuned on this fin. For other fins they are multiplied by `Reachable.size`."""

PAPER_PEAK_N = 13.0
"""Peak of the force of the paper's fin on one axis under random commands, in the virtual tank [N].
At a rig, where the reach is unknown before the first logs, the peak determines the fin's size."""

MIN_REACH_SHARE = 0.25
"""Minimum reach, as a fraction of the largest radius of a region. A fin whose forces lie on a line
has a region without area, but its tolerances must still suit the length of the line."""

DECADE_SIZES = (1.0, 2.0, 5.0, 10.0)
"""Fin sizes within a decade. Sizes are rounded to these, so that scaled tolerances are round
numbers and do not depend on a reach's last digits."""

MAX_CHUNK_FORCES = 2048
"""Maximum number of forces that `Reachable.nearest_within` processes together, which limits
memory."""


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
        return cls(low=centre, high=centre).expanded(width_n / 2)

    def expanded(self, margin_n: float) -> "Cell":
        """Build a cell that extends this one by a margin on all sides."""
        x0, y0 = self.low
        x1, y1 = self.high
        return Cell(low=(x0 - margin_n, y0 - margin_n), high=(x1 + margin_n, y1 + margin_n))

    def clipped(self, low: Float[AnyArray, "2"], high: Float[AnyArray, "2"]) -> "Cell":
        """Build the part of the cell between two corners; they must not be apart from it."""
        low = np.maximum(self.low, low).tolist()
        high = np.minimum(self.high, high).tolist()
        return Cell(low=tuple(low), high=tuple(high))

    def lattice(self, count: int) -> tuple[ForceVector, ...]:
        """Return the centres of `count` x `count` equal parts of the cell."""
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
        return f"x {self.low[0]:g} .. {self.high[0]:g}, y {self.low[1]:g} .. {self.high[1]:g} N"


Cells: TypeAlias = tuple[Cell, ...]


def format_force(force: ForceVector | Float[np.ndarray, "2"]) -> str:
    """Format a force as ``(x, y)``, without its unit."""
    return f"({force[0]:g}, {force[1]:g})"


def force_decimals(largest_n: float | int) -> int:
    """Return the number of decimals with which to show forces up to a size [N]: two from 1 to 10 N,
    more for smaller forces."""
    return max(2 - math.floor(math.log10(largest_n)), 0) if largest_n > 0 else 2


def round_size(ratio: float) -> float:
    """Round a force relative to that of the paper's fin to 1, 2 or 5 times a power of ten [-]; 1 if
    it is 0."""
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
    """Mean forces that a fin can produce, as a star-shaped polygon."""

    centre: Float[AnyArray, "2"]
    """Force (x, y) about which the polygon is star-shaped [N]."""
    radius: Float[AnyArray, "directions"]
    """Distance of each corner from the centre [N]; corner k is at the angle 2 pi k / directions
    from +x."""

    @classmethod
    def from_dict(cls, description: object) -> "Reachable":
        """Build a region from the result of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: the data do not describe a region.
        """
        if not isinstance(description, dict):
            raise TypeError(
                f"reachable = {description!r}: must be an object with centre_n and radius_n"
            )
        centre = np.asarray(description["centre_n"], np.float32)
        radius = np.asarray(description["radius_n"], np.float32)
        if centre.shape != (2,) or radius.ndim != 1 or len(radius) < 3:
            raise ValueError(
                f"reachable: centre_n must have 2 numbers and radius_n at least 3; got the shapes "
                f"{centre.shape} and {radius.shape}"
            )
        if not np.isfinite(centre).all() or not (np.isfinite(radius) & (radius >= 0)).all():
            raise ValueError(
                "reachable: centre_n and radius_n must be finite, and no radius negative"
            )
        return cls(centre, radius)

    def to_dict(self) -> JsonObject:
        """Return the centre and the radii [N] for JSON, with six digits of the largest radius."""
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
        """Return each force if it is inside, otherwise the intersection of the edge with the line
        to the centre; works on NumPy and JAX arrays."""
        ops = select_operations(force, self.radius)
        count = self.radius.shape[-1]
        xp = ops.xp
        ways = ops.constant(directions(count))
        radius = ops.constant(self.radius)
        # Transposed, so that the coordinates of a single force are numbers, which are faster than
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
        """Return whether each force is inside, or at most `tolerance_n` from its projection (by
        default `EDGE_FRACTION` of the largest radius)."""
        force = np.asarray(force, float)
        if tolerance_n is None:
            tolerance_n = EDGE_FRACTION * float(np.max(self.radius))
        return np.asarray(np.linalg.norm(self.project(force) - force, axis=-1) <= tolerance_n)

    def nearest(self, force: Any) -> Forces:
        """Return each force if it is inside, otherwise the nearest point on the edge [N]."""
        at = np.asarray(force, float)
        corners = self.corners().astype(float)
        points = _on_sides(corners, at, 0, 1)
        rounding_n = 1e-5 * float(np.max(self.radius))
        inside = np.isclose(self.project(at), at, atol=rounding_n).all(axis=-1)
        return np.where(inside[..., None], at, _choose_nearest(points, at))

    def nearest_within(self, cells: Sequence[Cell], forces: Forces) -> Forces:
        """Return for each force the nearest force inside both the region and a cell; NaN if there
        is none."""
        # The nearest force is the nearest point of a cell, of one of its sides or corners, or of
        # the part of the region's edge inside a cell.
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
        # Each coordinate is clipped to the cell, or is its lower or upper end: the nearest point of
        # the cell, points on its four sides, and its four corners.
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
        # Positions where each side enters and leaves the cell, as fractions of the side (Liang and
        # Barsky 1984).
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (np.asarray(cell.low) - corners) / side
            other = (np.asarray(cell.high) - corners) / side
        # A side parallel to an axis is completely between the two edges of the cell, or completely
        # outside.
        between = (corners >= cell.low) & (corners <= cell.high)
        first = np.where(side == 0, np.where(between, 0, np.inf), np.minimum(one, other))
        last = np.where(side == 0, np.where(between, 1, -np.inf), np.maximum(one, other))
        enter = first.max(axis=1).clip(0)
        leave = last.min(axis=1).clip(max=1)
        crosses = enter <= leave
        # Sides that miss the cell have infinite positions, which must not be multiplied.
        on_side = _on_sides(
            corners, forces, np.where(crosses, enter, 0), np.where(crosses, leave, 0)
        )
        # Clipped, because rounding errors could move a point out of the cell.
        return np.where(crosses[:, None], np.clip(on_side, cell.low, cell.high), np.nan)

    def area(self) -> float:
        """Return the area of the polygon [N^2]."""
        # The sum of the triangles between neighbouring radii, r_k r_{k+1} sin(angle) / 2.
        turn = 2 * np.pi / len(self.radius)
        radius = np.asarray(self.radius, float)
        return float(np.sin(turn) / 2 * (radius * np.roll(radius, -1)).sum())

    @property
    def reach_n(self) -> float:
        """Reach of the fin [N]: the radius of the circle with the area of the region, and at least
        `MIN_REACH_SHARE` of its largest radius."""
        circle_n = float(np.sqrt(self.area() / np.pi))
        return max(circle_n, MIN_REACH_SHARE * float(np.max(self.radius)))

    @property
    def size(self) -> float:
        """Reach of the fin divided by that of the paper's fin, rounded to 1, 2 or 5 times a power
        of ten [-]; 1 for a fin that produces no force."""
        return round_size(self.reach_n / PAPER_REACH_N)

    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the lower and upper corner (x, y) of the bounding box [N]."""
        x0, y0 = self.corners().min(axis=0).tolist()
        x1, y1 = self.corners().max(axis=0).tolist()
        return (x0, y0), (x1, y1)

    def describe(self) -> str:
        """Describe the bounding box, with as many decimals as the size of the fin needs."""
        decimals = force_decimals(self.reach_n)
        low, high = (
            tuple(round(force, decimals) + 0.0 for force in corner) for corner in self.bounds()
        )
        return str(Cell(low=low, high=high))

    def bounding_box(self) -> Cell:
        """Smallest cell that contains the region."""
        low, high = self.bounds()
        return Cell(low=low, high=high)


@cache
def directions(count: int) -> Float[np.ndarray, "directions 2"]:
    """Return equally spaced unit vectors, counterclockwise from +x."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _on_sides(
    corners: Float[np.ndarray, "sides 2"], force: ForcePoints, enter: Any, leave: Any
) -> ForcePoints:
    """Return the point nearest to each force on each side of a polygon, ``(..., sides, 2)``.

    Only the part of a side from the fraction `enter` to `leave` is considered.
    """
    side = np.roll(corners, -1, axis=0) - corners
    along = ((force[..., None, :] - corners) * side).sum(axis=-1) / np.maximum(
        (side**2).sum(axis=-1), 1e-12
    )
    return np.asarray(corners + np.clip(along, enter, leave)[..., None] * side)


def _choose_nearest(points: ForcePoints, force: ForcePoints) -> ForcePoints:
    """Return the one of the points ``(..., points, 2)`` nearest to each force, ignoring NaN."""
    distance = np.linalg.norm(points - force[..., None, :], axis=-1)
    nearest = np.where(np.isnan(distance), np.inf, distance).argmin(axis=-1)
    return np.take_along_axis(points, nearest[..., None, None], axis=-2)[..., 0, :]
