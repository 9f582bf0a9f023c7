"""Bracing: fins push against each other where a weak force would have no steady direction. NumPy alone.

Between a wrench and the mean force of each fin [N], action by action: allocation, bracing, smoothing.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from softfin.robot.allocation import Allocation, Allocator, Forces, SixVector
from softfin.robot.description import RobotConfig

WAYS, SIZES = 8, (0.5, 1.0, 1.5)
"""Bracing that is tried: ways within the forces that cancel, sizes over the least force."""

EFFORT = 0.02
"""Cost of a newton of force, squared, against that of a newton too little."""


class BracedAllocation:
    """Shares wrenches among the fins of a robot, as `allocation` in its file says."""

    def __init__(self, robot: RobotConfig, reach: Sequence[float | int]) -> None:
        """`reach` is the greatest mean force of each fin [N]."""
        self._config = robot.allocation
        self.allocator = Allocator(robot.matrix(), np.array(reach, float), np.asarray(self._config.priority, float))
        self.dead: tuple[int, ...] = ()
        self._braces = self._bracing()

    def declare_dead(self, fin: int) -> None:
        """Ask nothing more of a fin; the others make what they can."""
        self.dead = (*self.dead, fin)
        reach = self.allocator.reach.copy()
        reach[fin] = 0
        self.allocator.reach = reach
        self._braces = self._bracing()

    def share(self, wrench: SixVector, forces: Forces, brace: int) -> tuple[Allocation, int]:
        """Share a wrench in body axes [N, N m], after the forces and the bracing of the last action.

        Returns:
            The allocation and the number of its bracing.
        """
        # Of a dead fin nothing is left to fade out.
        forces = np.where(self.allocator.reach[:, None] > 0, forces, 0.0)
        brace = self._brace(self.allocator.allocate(wrench, start=forces).forces, brace)
        found = self.allocator.allocate(wrench, self._braces[brace], forces)
        smoothing = self._config.smoothing
        smoothed = smoothing * forces + (1 - smoothing) * found.forces
        return Allocation(smoothed, self.allocator.matrix @ smoothed.ravel(), found.given_up), brace

    def _bracing(self) -> Float[np.ndarray, "braces fins 2"]:
        """Forces that cancel one another, about the least force in size; the first is none."""
        reach = self.allocator.reach
        weighted = self.allocator.matrix * np.repeat(reach > 0, 2)
        _, values, rows = np.linalg.svd(weighted)
        rank = int((values > 1e-6 * values[0]).sum())
        # Of the directions that make no wrench, those of dead fins are none.
        free = [row for row in rows[rank:] if np.abs(row[np.repeat(reach > 0, 2)]).max(initial=0) > 1e-6]
        basis = np.array([row * np.repeat(reach > 0, 2) for row in free]).reshape(-1, len(rows))
        least = self._config.brace_n
        found = [np.zeros(len(rows))]
        if least and len(basis):
            for angle, size in itertools.product(np.linspace(0, 2 * np.pi, WAYS, endpoint=False), SIZES):
                way = basis[0] * np.cos(angle) + (basis[1] * np.sin(angle) if len(basis) > 1 else 0)
                greatest = np.sqrt((way.reshape(-1, 2) ** 2).sum(axis=1)).max()
                if greatest > 1e-6:
                    found.append(size * least * way / greatest)
        return np.array(found).reshape(len(found), -1, 2)

    def _brace(self, forces: Forces, present: int) -> int:
        """Return the bracing under which fins make the least force, or nearly so, with little effort."""
        least = self._config.brace_n
        if len(self._braces) == 1:
            return 0
        alive = self.allocator.reach > 0
        together = forces + self._braces
        sizes = np.sqrt((together**2).sum(axis=2))
        lacking = (np.maximum(least - sizes, 0) ** 2)[:, alive].sum(axis=1)
        beyond = (np.maximum(sizes - self.allocator.reach, 0) ** 2)[:, alive].sum(axis=1)
        costs = lacking + 10 * beyond + EFFORT * (together**2).sum(axis=(1, 2))
        costs[present] -= self._config.brace_change
        return int(costs.argmin())
