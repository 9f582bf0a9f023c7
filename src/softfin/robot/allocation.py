"""Allocation of a wrench on the body to one mean force per fin, within the reach of each fin. NumPy
only.

Forces f = (x, y of the first fin, of the second, ...) minimise

    |Q^(1/2) (B f - wrench)|^2 / 2 + ridge / 2 sum_i |f_i - p_i|^2 / r_i^2,   |f_i| <= r_i

with the allocation matrix B, priorities Q, preferred forces p and reaches r. If no fin is at its
reach, the solution is linear in the wrench, and the ridge is so small that the full wrench is
produced. Otherwise it is a quadratic program over disks, solved by an accelerated projected
gradient method with restarts (Nesterov 1983; O'Donoghue and Candes 2015), with a few steps per
call, starting from the forces of the previous call. From an arbitrary start, these steps come
within 0.1 N of the optimum in nine cases out of ten; while the wrench changes slowly, they reach
it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

RIDGE = 1e-5
"""Weight of the distance from the preferred forces; a weight 10,000 times larger would cause an
error of 0.3 N in the weakest axis."""

GRADIENT_STEPS = 10
"""Number of projected gradient steps per call if the wrench is out of reach."""

TOUCHING = 1e-6
SETTLING = 20

GIVEN_UP = 0.03
"""Fraction of the wrench above which a missing component is treated as given up [-] if it also
exceeds `SMALL`."""

SMALL = (0.02, 0.02, 0.02, 0.005, 0.005, 0.005)
"""[N, N m]"""

FinForces = Float[np.ndarray, "fins 2"]
MatrixColumns = Float[np.ndarray, "columns"]
Reaches = Float[np.ndarray, "fins"]
SixVector = Float[np.ndarray, "6"]


class Allocation(NamedTuple):
    """Forces for the fins, and the resulting wrench."""

    forces: FinForces
    """Mean force of each fin in fin axes [N]."""
    wrench: SixVector
    """Total wrench of these forces, in body axes [N, N m]."""
    given_up: Bool[np.ndarray, "6"]
    """Axes in which the wrench differs from the target wrench."""


class Allocator:
    """Allocator that distributes wrenches among the fins of one robot."""

    def __init__(
        self,
        matrix: Float[np.ndarray, "6 columns"],
        reach: Reaches,
        priority: SixVector | None = None,
    ) -> None:
        self.matrix = np.asarray(matrix, float)
        self._priority = np.ones(6) if priority is None else np.asarray(priority, float)
        self.reach = np.asarray(reach, float)

    @property
    def reach(self) -> Reaches:
        """Maximum mean force of each fin [N]; 0 for a dead one. May be set."""
        return self._reach

    @reach.setter
    def reach(self, reach: Reaches) -> None:
        self._reach = np.asarray(reach, float)
        self._scale = np.repeat(self._reach, 2)
        # The unknowns are x = f / r, so the constraints are |x_i| <= 1. With A = B r, the gradient
        # is (A' Q A + ridge) x - A' Q w - ridge p / r.
        scaled = self.matrix * self._scale
        weighted = scaled.T * self._priority
        normal = weighted @ scaled + RIDGE * np.eye(len(self._scale))
        self._share = weighted
        # Without constraints: x = p / r + (A' Q A + ridge)^-1 A' Q (w - B p).
        self._gain = np.linalg.inv(normal) @ weighted
        # 1 / L, with the Lipschitz constant L of the gradient.
        self._step = 1 / float(np.linalg.eigvalsh(normal)[-1])
        self._descend = np.eye(len(self._scale)) - self._step * normal

    def reach_along(self, axis: int) -> float:
        """Return the maximum force or moment along one axis with none along the other axes [N, N
        m], to within 1%."""
        unit = np.eye(6)[axis]
        low = 0.0
        high = float(np.abs(self.matrix[axis]) @ self._scale) + 1e-9
        # Bisection: 12 halvings reduce the interval to 1/4096.
        for _ in range(12):
            middle = (low + high) / 2
            found = self.allocate(middle * unit)
            # Each call makes only a few steps, so call repeatedly until the forces have converged.
            for _ in range(SETTLING):
                found = self.allocate(middle * unit, start=found.forces)
            missing = np.abs(found.wrench - middle * unit).max()
            low, high = (middle, high) if missing < 0.01 * middle else (low, middle)
        return low

    def allocate(
        self, wrench: SixVector, preferred: FinForces | None = None, start: FinForces | None = None
    ) -> Allocation:
        """Allocate a wrench in body axes [N, N m]; every finite wrench has a solution.

        If the wrench is out of reach, the search starts from the forces `start`, such as the forces
        of the previous action.
        """
        near = self._over_reach(preferred)
        parts = near + self._gain @ (wrench - self.matrix @ (near * self._scale))
        if np.abs(parts.view(complex)).max() > 1 + TOUCHING:
            begin = parts if start is None else self._over_reach(start)
            parts = self._within(self._share @ wrench + RIDGE * near, _clipped(begin))
        forces = parts * self._scale
        together = self.matrix @ forces
        missing = np.abs(together - wrench)
        given_up = missing > np.maximum(SMALL, GIVEN_UP * np.abs(wrench).max())
        return Allocation(forces.reshape(-1, 2), together, given_up)

    def _over_reach(self, forces: FinForces | None) -> MatrixColumns:
        parts = np.zeros(len(self._scale))
        if forces is not None:
            np.divide(forces.ravel(), self._scale, out=parts, where=self._scale > 0)
        return parts

    def _within(self, right: MatrixColumns, parts: MatrixColumns) -> MatrixColumns:
        """Return the forces as fractions of each fin's reach, with magnitudes of at most 1, after a
        few steps towards the optimum."""
        # A gradient step is linear: descend @ x + shift.
        shift = self._step * right
        ahead = parts
        momentum = 1.0
        for _ in range(GRADIENT_STEPS):
            after = _clipped(self._descend.dot(ahead) + shift)
            moved = after - parts
            # Restart if the momentum points uphill (O'Donoghue and Candes, gradient scheme).
            if (ahead - after).dot(moved) > 0:
                momentum = 1.0
            # Nesterov's sequence of momenta.
            following = (1 + (1 + 4 * momentum * momentum) ** 0.5) / 2
            ahead = after + (momentum - 1) / following * moved
            parts = after
            momentum = following
        return parts


def _clipped(parts: MatrixColumns) -> MatrixColumns:
    # View the forces as complex numbers so that NumPy computes all lengths in one call.
    pairs = parts.view(complex)
    return np.asarray((pairs / np.maximum(np.abs(pairs), 1)).view(float))
