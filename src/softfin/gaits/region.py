"""Which references a controller takes: the cells that it was trained for, and what the fin can make within them.

Forces are pairs (x, y) [N] in double precision; the region is star-shaped about its centre.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

from softfin.core.errors import CoverageError

Pair: TypeAlias = tuple[float, float]

EDGE_N = 1e-4
"""References this near to a cell are on its edge: forces are float32, and their decimals seldom come out even."""

TOLERANCE_N = 1e-3
"""Forces this near to the edge of the reach count as reached."""


class Box(NamedTuple):
    """An axis-aligned box of reference forces."""

    low: Pair
    high: Pair

    def clipped(self, force: Pair) -> Pair:
        """The nearest force of the box."""
        x, y = (min(max(f, a), b) for f, a, b in zip(force, self.low, self.high, strict=True))
        return x, y

    def distance(self, force: Pair) -> float:
        """From the box to a force [N]; 0 inside and on the edge."""
        return math.dist(force, self.clipped(force))

    def corners(self) -> Iterator[Pair]:
        """All four."""
        return ((x, y) for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1]))

    def __str__(self) -> str:
        return f"x {self.low[0]:g} .. {self.high[0]:g}, y {self.low[1]:g} .. {self.high[1]:g} N"


def least_box(boxes: Sequence[Box]) -> Box:
    """Round all boxes."""
    lows, highs = [box.low for box in boxes], [box.high for box in boxes]
    return Box((min(x for x, _ in lows), min(y for _, y in lows)), (max(x for x, _ in highs), max(y for _, y in highs)))


class Region(NamedTuple):
    """The mean forces that a fin can make."""

    centre: Pair
    corners: tuple[Pair, ...]
    """Corner k lies from the centre in the direction of 2 pi k / corners, counted from +x."""

    @classmethod
    def of(cls, centre: Pair, radius: Sequence[float]) -> "Region":
        """From the distances of the corners from the centre."""
        turns = [2 * math.pi * k / len(radius) for k in range(len(radius))]
        corners = [
            (centre[0] + r * math.cos(turn), centre[1] + r * math.sin(turn))
            for r, turn in zip(radius, turns, strict=True)
        ]
        return cls(centre, tuple(corners))

    def pulled(self, force: Pair) -> Pair:
        """The force, or where the line from it to the centre meets the edge."""
        (cx, cy), count = self.centre, len(self.corners)
        x, y = force[0] - cx, force[1] - cy
        if max(abs(x), abs(y)) < 1e-6:
            return force
        index = min(int(math.atan2(y, x) / (2 * math.pi) % 1 * count), count - 1)
        (ax, ay), (bx, by) = self.corners[index], self.corners[(index + 1) % count]
        # The ray offset * s meets the side a + (b - a) t where offset x (a - b) s = (a - centre) x (a - b).
        sx, sy = ax - bx, ay - by
        across = x * sy - y * sx
        reach = 0.0 if abs(across) < 1e-9 else ((ax - cx) * sy - (ay - cy) * sx) / across
        return force if reach >= 1 else (cx + x * reach, cy + y * reach)

    def reached(self, force: Pair) -> bool:
        """Whether the fin can make it."""
        near = self.pulled(force)
        return max(abs(near[0] - force[0]), abs(near[1] - force[1])) <= TOLERANCE_N

    def nearest(self, force: Pair) -> Pair:
        """The nearest force of the edge."""
        sides = zip(self.corners, self.corners[1:] + self.corners[:1], strict=True)
        return min((_on_side(a, b, force, 0, 1) for a, b in sides), key=lambda near: math.dist(near, force))

    def nearest_within(self, boxes: Sequence[Box], force: Pair) -> Pair | None:
        """The nearest force that the fin can make and that a box holds; None where there is none."""
        found = [near for box in boxes for near in (*self._on_box(box, force), *self._on_edge(box, force))]
        return min(found, key=lambda near: math.dist(near, force), default=None)

    def _on_box(self, box: Box, force: Pair) -> list[Pair]:
        """The nearest forces of the box and of each of its sides, and its corners, as far as they are reached."""
        (x0, y0), (x1, y1) = box
        x, y = box.clipped(force)
        return [each for each in ((x, y), (x0, y), (x1, y), (x, y0), (x, y1), *box.corners()) if self.reached(each)]

    def _on_edge(self, box: Box, force: Pair) -> Iterator[Pair]:
        """The nearest force of each side of the reach, as far as that side lies in the box."""
        for a, b in zip(self.corners, self.corners[1:] + self.corners[:1], strict=True):
            # Where the side enters and leaves the box, as a part of its length (Liang and Barsky 1984).
            enter, leave = 0.0, 1.0
            for start, end, low, high in zip(a, b, box.low, box.high, strict=True):
                if end == start:
                    enter, leave = (enter, leave) if low <= start <= high else (math.inf, -math.inf)
                else:
                    first, last = sorted(((low - start) / (end - start), (high - start) / (end - start)))
                    enter, leave = max(enter, first), min(leave, last)
            if enter <= leave:
                # Rounding must not lead out of the box.
                yield box.clipped(_on_side(a, b, force, enter, leave))


def _on_side(a: Pair, b: Pair, force: Pair, enter: float | int, leave: float | int) -> Pair:
    """The nearest force on the part of the side from a to b that lies between two shares of its length."""
    sx, sy = b[0] - a[0], b[1] - a[1]
    along = ((force[0] - a[0]) * sx + (force[1] - a[1]) * sy) / max(sx * sx + sy * sy, 1e-12)
    along = min(max(along, enter), leave)
    return a[0] + along * sx, a[1] + along * sy


def admitted(boxes: Sequence[Box], region: Region | None, reference: Pair, strict: bool) -> tuple[Pair, str | None]:
    """The reference to hold, and a warning where it is another: the nearest force that the fin can make.

    Raises CoverageError where the fin cannot make the reference and `strict`, or where the controller was not trained
    for it.
    """
    if not all(map(math.isfinite, reference)):
        raise CoverageError(f"reference ({reference[0]:g}, {reference[1]:g}) N: give two finite numbers [N]")
    if region is None or region.reached(reference):
        _check_within(boxes, reference)
        return reference, None
    near = region.nearest_within(boxes, reference)
    asked = f"reference ({reference[0]:g}, {reference[1]:g}) N: this fin cannot make it"
    if near is None:
        x, y = region.nearest(reference)
        box = min(boxes, key=lambda each: each.distance(reference))
        raise CoverageError(
            f"{asked}, nor any other force that this controller was trained for (nearest cell {box}); the nearest that "
            f"the fin can make is ({x:.3f}, {y:.3f}) N; train it there, within the fin's reach (softfin map shows it)"
        )
    said = f"{asked}; the nearest that it can make in this controller's range is ({near[0]:.3f}, {near[1]:.3f}) N"
    if strict:
        raise CoverageError(f"{said}; ask for that, or leave out --strict")
    return near, f"{said}, which is held instead"


def _check_within(boxes: Sequence[Box], reference: Pair) -> None:
    nearest = min(boxes, key=lambda box: box.distance(reference))
    beyond = nearest.distance(reference)
    if beyond > EDGE_N:
        many = len(boxes) > 1
        raise CoverageError(
            f"reference ({reference[0]:g}, {reference[1]:g}) N: {beyond:.2g} N outside "
            f"{f'the nearest of {len(boxes)} cells' if many else 'what this controller was trained for'} ({nearest}); "
            f"ask within {'a cell' if many else 'it'}, or train with {'a' if many else 'a wider'} cell there"
        )
