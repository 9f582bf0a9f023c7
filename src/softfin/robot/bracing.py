"""Bracing: fins push against each other where a weak force would have no steady direction. NumPy
alone.

Between a wrench and the mean force of each fin [N], action by action: allocation, bracing,
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
"""Bracing that is tried: ways within the forces that cancel, sizes over the least force."""

EFFORT = 0.02
"""Cost of a newton of force, squared, against that of a newton too little."""

SAME_N = 1e-6
"""Bracing whose forces differ by less is the same [N]."""


class BracedAllocation:
    """Shares wrenches among the fins of a robot, as `allocation` in its file says."""

    def __init__(self, robot: RobotConfig, reach: Sequence[float | int]) -> None:
        """`reach` is the greatest mean force of each fin [N]."""
        self._config = robot.allocation
        self.allocator = Allocator(
            robot.matrix(), np.array(reach, float), np.asarray(self._config.priority, float)
        )
        self.dead: tuple[int, ...] = ()
        self._braces = self._bracing()

    def declare_dead(self, fin: int) -> None:
        """Ask nothing more of a fin; the others make what they can."""
        self.dead = (*self.dead, fin)
        reach = self.allocator.reach.copy()
        reach[fin] = 0
        self.allocator.reach = reach
        self._braces = self._bracing()

    def share(
        self, wrench: SixVector, forces: FinForces, brace: FinForces
    ) -> tuple[Allocation, FinForces]:
        """Share a wrench in body axes [N, N m], after the forces and the bracing of the last
        action.

        Returns:
            The allocation and its bracing: forces that cancel one another.
        """
        # Of a dead fin nothing is left to fade out.
        forces = np.where(self.allocator.reach[:, None] > 0, forces, 0.0)
        brace = self._brace(self.allocator.allocate(wrench, start=forces).forces, brace)
        found = self.allocator.allocate(wrench, brace, forces)
        smoothing = self._config.smoothing
        smoothed = smoothing * forces + (1 - smoothing) * found.forces
        return Allocation(smoothed, self.allocator.matrix @ smoothed.ravel(), found.given_up), brace

    def _bracing(self) -> Float[np.ndarray, "braces fins 2"]:
        """Forces that cancel one another, about the least force in size; the first is none."""
        alive = np.repeat(self.allocator.reach > 0, 2)
        _, values, rows = np.linalg.svd(self.allocator.matrix[:, alive])
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
        """Return the bracing under which fins make the least force, or nearly so, with little
        effort."""
        least = self._config.brace_n
        if len(self._braces) == 1:
            return np.zeros_like(forces)
        alive = self.allocator.reach > 0
        together = forces + self._braces
        sizes = np.sqrt((together**2).sum(axis=2))
        lacking = (np.maximum(least - sizes, 0) ** 2)[:, alive].sum(axis=1)
        beyond = (np.maximum(sizes - self.allocator.reach, 0) ** 2)[:, alive].sum(axis=1)
        costs = lacking + 10 * beyond + EFFORT * (together**2).sum(axis=(1, 2))
        # By its forces, not by a number: after a death there are other ways, and the present one
        # may be none of them.
        unchanged = np.abs(self._braces - present).max(axis=(1, 2)) < SAME_N
        costs[unchanged] -= self._config.brace_change
        # Of ways that cost the same the first, however the last digits are rounded.
        return np.asarray(self._braces[costs.round(6).argmin()])


def _axes(free: Float[np.ndarray, "ways columns"]) -> Float[np.ndarray, "2 columns"]:
    """Two ways to push that make no wrench: as near to y of the last fin as one can, and across; 0
    where there is none.

    The rows of `free` span all ways; how they are turned in their span depends on the library of
    linear algebra.
    """
    left = free.T @ free
    found = np.zeros((2, free.shape[1]))
    for axis in found:
        lengths = np.linalg.norm(left, axis=1)
        if lengths.max() > 1e-6:
            nearest = left[np.flatnonzero(lengths > 1e-6)[-1]]
            axis[:] = nearest / np.linalg.norm(nearest)
            left = left - np.outer(axis, axis)
    return found
