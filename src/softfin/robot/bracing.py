"""Bracing: fins push against each other so that no force becomes too weak for a steady direction.
NumPy only.

Converts a wrench to the mean force of each fin [N], once per action: allocation, bracing,
smoothing.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from softfin.robot.allocation import Allocation, Allocator, FinForces, SixVector
from softfin.robot.description import RobotConfig

WAYS = 8
SIZES = (0.5, 1.0, 1.5)
"""Bracings to try: number of directions in the space of forces that cancel, and sizes relative to
`brace_n`."""

EFFORT = 0.02
"""Cost of a squared force relative to the cost of a squared shortfall below `brace_n`."""

BRACE_CHANGE_N2 = 1.0
"""Cost of changing the bracing, which swings fins around, relative to the cost of a squared force
error [N2]."""

SMOOTHING = 0.5
"""Fraction of a force change that is postponed to the next action; a swing spread over two actions
causes half the disturbance and a delay of half an action."""

SAME_N = 1e-6
"""Force difference below which two bracings are treated as the same [N]."""


class BracedAllocation:
    """Allocation of wrenches to a robot's fins, as configured under `allocation` in the robot
    file."""

    def __init__(self, robot: RobotConfig, reach: Sequence[float | int]) -> None:
        """`reach` is the maximum mean force of each fin [N]."""
        self._config = robot.allocation
        self.allocator = Allocator(
            robot.matrix(), np.array(reach, float), np.asarray(self._config.priority, float)
        )
        self.dead: tuple[int, ...] = ()
        self._braces = self._bracing()

    def declare_dead(self, fin: int) -> None:
        """Stop using a fin; the other fins produce as much of the wrench as possible."""
        self.dead = (*self.dead, fin)
        reach = self.allocator.reach.copy()
        reach[fin] = 0
        self.allocator.reach = reach
        self._braces = self._bracing()

    def share(
        self, wrench: SixVector, forces: FinForces, brace: FinForces
    ) -> tuple[Allocation, FinForces]:
        """Allocate a wrench in body axes [N, N m], given the forces and the bracing of the previous
        action.

        Returns:
            The allocation, and its bracing: forces that cancel each other.
        """
        # The force of a dead fin is zero immediately, without smoothing.
        forces = np.where(self.allocator.reach[:, None] > 0, forces, 0.0)
        brace = self._brace(self.allocator.allocate(wrench, start=forces).forces, brace)
        found = self.allocator.allocate(wrench, brace, forces)
        smoothed = SMOOTHING * forces + (1 - SMOOTHING) * found.forces
        return Allocation(smoothed, self.allocator.matrix @ smoothed.ravel(), found.given_up), brace

    def _bracing(self) -> Float[np.ndarray, "braces fins 2"]:
        """Return sets of forces that cancel each other, with magnitudes around `brace_n`; the first
        set is zero."""
        alive = np.repeat(self.allocator.reach > 0, 2)
        _, values, rows = np.linalg.svd(self.allocator.matrix[:, alive])
        # Null space of the matrix: right singular vectors with a singular value of 0.
        free = rows[(values > 1e-6 * values.max(initial=0)).sum() :]
        least = self._config.brace_n
        found = [np.zeros(len(alive))]
        if least and len(free):
            first, second = _axes(free)
            for angle, size in itertools.product(
                np.linspace(0, 2 * np.pi, WAYS, endpoint=False), SIZES
            ):
                way = np.zeros(len(alive))
                way[alive] = first * np.cos(angle) + second * np.sin(angle)
                greatest = np.abs(way.view(complex)).max()
                if greatest > 1e-6:
                    found.append(size * least * way / greatest)
        return np.array(found).reshape(len(found), -1, 2)

    def _brace(self, forces: FinForces, present: FinForces) -> FinForces:
        """Return the bracing with which all fins produce about `brace_n` or more, at low effort."""
        least = self._config.brace_n
        if len(self._braces) == 1:
            return np.zeros_like(forces)
        alive = self.allocator.reach > 0
        together = forces + self._braces
        sizes = np.sqrt((together**2).sum(axis=2))
        lacking = (np.maximum(least - sizes, 0) ** 2)[:, alive].sum(axis=1)
        beyond = (np.maximum(sizes - self.allocator.reach, 0) ** 2)[:, alive].sum(axis=1)
        costs = lacking + 10 * beyond + EFFORT * (together**2).sum(axis=(1, 2))
        # Compare forces instead of indices: after the death of a fin, the directions differ, and
        # the current bracing may not be among them.
        unchanged = np.abs(self._braces - present).max(axis=(1, 2)) < SAME_N
        costs[unchanged] -= BRACE_CHANGE_N2
        # Round, so that the first of several equal costs is chosen regardless of differences in the
        # last digits.
        return np.asarray(self._braces[costs.round(6).argmin()])


def _axes(free: Float[np.ndarray, "ways columns"]) -> Float[np.ndarray, "2 columns"]:
    """Return two directions that produce no wrench: the direction closest to y of the last fin, and
    a perpendicular direction; 0 if no such direction exists.

    The rows of `free` span all such directions, but their rotation within the span depends on the
    linear algebra library.
    """
    # Projection onto the null space; its rows are the projections of the unit vectors.
    left = free.T @ free
    found = np.zeros((2, free.shape[1]))
    for axis in found:
        lengths = np.linalg.norm(left, axis=1)
        if lengths.max() > 1e-6:
            nearest = left[np.flatnonzero(lengths > 1e-6)[-1]]
            axis[:] = nearest / np.linalg.norm(nearest)
            left = left - np.outer(axis, axis)
    return found
