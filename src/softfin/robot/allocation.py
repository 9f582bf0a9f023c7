"""Allocation: a wrench on the body becomes one mean force a fin, within what each fin can make. NumPy alone.

Forces f = (x, y of the first fin, of the second, ...) minimise

    |Q^(1/2) (B f - wrench)|^2 / 2 + ridge / 2 sum_i |f_i - p_i|^2 / r_i^2,   |f_i| <= r_i

with the fins' matrix B, priorities Q, preferred forces p and reaches r. Where no fin is at its reach that is linear in
the wrench, and the ridge is so small that all of the wrench is made. Where some are, each has a multiplier, found by
Newton's method on 1/|f_i| - 1/r_i, which is nearly linear in it (as in trust regions: More and Sorensen 1983).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

RIDGE = 1e-5
"""Weight of the distance to the preferred forces; 10,000 times it would miss 0.3 N in the weakest axis."""

MOST_STEPS = 40
"""Steps of Newton's method; four of five saturated wrenches take at most 5. Steps are shortened from the sixth on, as
fins may come to their reach and leave it in turns."""

CLOSE = 0.01
"""Fins are at their reach within this part of it."""

FIRST, LEAST, NOTHING = 0.3, 0.02, 1e-3
"""First multipliers over a fin's stiffness and excess; the most that one falls in a step; what counts as none."""

GIVEN_UP = 0.03
"""An axis counts as given up where more than this part of the wrench is missing [-], and over `SMALL`."""

SMALL = (0.02, 0.02, 0.02, 0.005, 0.005, 0.005)
"""[N, N m]"""

Forces = Float[np.ndarray, "fins 2"]
Columns = Float[np.ndarray, "columns"]
SixVector = Float[np.ndarray, "6"]


class Allocation(NamedTuple):
    """Forces for the fins, and what they make."""

    forces: Forces
    """Mean force of each fin in its own axes [N]."""
    wrench: SixVector
    """Wrench that they make together, in body axes [N, N m]."""
    given_up: Bool[np.ndarray, "6"]
    """Axes in which they make less than was asked for, or something else."""


class Allocator:
    """Shares wrenches among the fins of one robot."""

    def __init__(self, matrix: Float[np.ndarray, "6 columns"], reach: Float[np.ndarray, "fins"],
                 priority: SixVector | None = None) -> None:  # fmt: skip
        self.matrix = np.asarray(matrix, float)
        self._priority = np.ones(6) if priority is None else np.asarray(priority, float)
        self.reach = np.asarray(reach, float)

    @property
    def reach(self) -> Float[np.ndarray, "fins"]:
        """Greatest mean force of each fin [N]; 0 of a dead one. May be set."""
        return self._reach

    @reach.setter
    def reach(self, reach: Float[np.ndarray, "fins"]) -> None:
        self._reach = np.asarray(reach, float)
        self._scale = np.repeat(self._reach, 2)
        scaled = self.matrix * self._scale
        weighted = scaled.T * self._priority
        normal = weighted @ scaled + RIDGE * np.eye(len(self._scale))
        self._share, self._gain = weighted, np.linalg.inv(normal) @ weighted
        # Kept between calls: an allocation is a few dozen calls of NumPy, of which each costs as much as its sums.
        self._work, self._free_diagonal = normal.copy(), normal.diagonal().copy()
        self._diagonal, self._stiffness = self._work.reshape(-1)[:: len(normal) + 1], normal.diagonal()[::2].copy()
        count = len(self._reach)
        self._blocks, self._eye = np.zeros((count, 2 * count)), np.eye(count)
        self._x, self._y = (self._blocks.reshape(-1)[axis :: 2 * count + 2] for axis in (0, 1))

    def reach_along(self, axis: int) -> float:
        """Return the greatest force or moment along one axis with none along the others [N, N m], within 1%."""
        unit = np.eye(6)[axis]
        low, high = 0.0, float(np.abs(self.matrix[axis]) @ self._scale) + 1e-9
        for _ in range(12):
            middle = (low + high) / 2
            missing = np.abs(self.allocate(middle * unit).wrench - middle * unit).max()
            low, high = (middle, high) if missing < 0.01 * middle else (low, middle)
        return low

    def allocate(self, wrench: SixVector, preferred: Forces | None = None) -> Allocation:
        """Share a wrench in body axes [N, N m]; every finite wrench has an answer."""
        near = np.zeros(len(self._scale))
        if preferred is not None:
            np.divide(preferred.ravel(), self._scale, out=near, where=self._scale > 0)
        parts = near + self._gain @ (wrench - self.matrix @ (near * self._scale))
        lengths = np.hypot(parts[::2], parts[1::2])
        if lengths.max() > 1 + CLOSE:
            parts = self._within(self._share @ wrench + RIDGE * near, lengths)
        forces = parts * self._scale
        wrench_of = self.matrix @ forces
        missing = np.abs(wrench_of - wrench)
        given_up = missing > np.maximum(SMALL, GIVEN_UP * np.abs(wrench).max())
        return Allocation(forces.reshape(-1, 2), wrench_of, given_up)

    def _within(self, right: Columns, lengths: Float[np.ndarray, "fins"]) -> Columns:
        """Return the best forces over reaches of which none is longer than 1.

        `right` is the right side of the normal equations, `lengths` are those of the best forces without that bound.
        """
        multipliers: np.ndarray = np.where(lengths > 1, FIRST * self._stiffness * np.minimum(lengths - 1, 2), 0)
        for step in range(MOST_STEPS):
            self._diagonal[:] = self._free_diagonal + np.repeat(multipliers, 2)
            inverse = np.linalg.inv(self._work)
            parts = inverse @ right
            x, y = parts[::2], parts[1::2]
            lengths = np.hypot(x, y) + 1e-12
            active = (multipliers > 0) | (lengths > 1)
            if (np.abs(lengths - 1) * active).max() < CLOSE:
                break
            # slope[i, j]: how 1 / lengths[i] grows with the multiplier of fin j.
            self._x[:], self._y[:] = x, y
            slope = (self._blocks @ inverse @ self._blocks.T) / (lengths**3)[:, None]
            slope = np.where(active[:, None] & active, slope, self._eye)
            change = np.linalg.solve(slope, np.where(active, 1 / lengths - 1, 0))
            wanted, least = multipliers - (1 if step < 5 else 0.6 if step < 15 else 0.35) * change, LEAST * multipliers
            free = (lengths < 1) & (multipliers < NOTHING * self._stiffness)
            multipliers = np.where(wanted > least, wanted, np.where(free, 0, least))
        return np.asarray(parts / np.repeat(np.maximum(lengths, 1), 2))
