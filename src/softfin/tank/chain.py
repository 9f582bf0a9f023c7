"""A planar chain of rigid plates hinged end to end: where it is, how it moves, what a load on a plate does to it.

Plate i lies from its inner end, nearer the shaft, along d(phi) = (-cos phi, sin phi); its normal is n = d' =
(sin phi, cos phi). The absolute angles phi are the only coordinates, so length is kept exactly. Loads, momenta and
motions of a plate are given along n and d and about its inner end.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

PerPlate = Float[Array, " plates"]
Scale = Float[Array, ""] | float


class Pose(NamedTuple):
    """How the turning of plate j moves the inner end of plate i > j; rows i, columns j, zero elsewhere [m]."""

    normal: Float[Array, "plates plates"]
    along: Float[Array, "plates plates"]


class Motion(NamedTuple):
    """Motion of each plate: velocity of its inner end along n and d [m/s], rate of turning [rad/s]."""

    normal: PerPlate
    along: PerPlate
    turning: PerPlate

    def less(self, other: "Motion") -> "Motion":
        """Return the motion relative to another one of the same plates."""
        return Motion(self.normal - other.normal, self.along - other.along, self.turning - other.turning)


class Wrench(NamedTuple):
    """On each plate: force along n and d [N], moment about the inner end [N m]. Likewise momenta [N s, N m s]."""

    normal: PerPlate
    along: PerPlate
    moment: PerPlate


class Moments(NamedTuple):
    """Moments of what resists each plate, mass [kg] or drag [kg/s]: order 0 to 2 along n, and the whole along d.

    With m(s) the mass per length along n, they are the integrals of m, m s and m s^2 over the plate.
    """

    zeroth: PerPlate
    first: PerPlate
    second: PerPlate
    along: PerPlate

    def stretched(self, length: Scale, density: Scale = 1.0) -> "Moments":
        """Return the moments of plates longer by a factor, with all per length multiplied by another."""
        return Moments(
            self.zeroth * (density * length),
            self.first * (density * length**2),
            self.second * (density * length**3),
            self.along * (density * length),
        )

    def times(self, motion: Motion) -> Wrench:
        """Return the momentum of that motion, or the force that resists it."""
        return Wrench(
            self.zeroth * motion.normal + self.first * motion.turning,
            self.along * motion.along,
            self.first * motion.normal + self.second * motion.turning,
        )


def pose(angles: PerPlate, plate_length: Float[Array, ""]) -> Pose:
    """Return the pose of a chain whose plates lie at absolute `angles` [rad]."""
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    lever = jnp.tril(jnp.ones((angles.size, angles.size), angles.dtype), -1) * plate_length
    return Pose(
        lever * (cos[:, None] * cos[None] + sin[:, None] * sin[None]),
        lever * (sin[:, None] * cos[None] - cos[:, None] * sin[None]),
    )


def motion(pose: Pose, rates: PerPlate) -> Motion:
    """Return the motion of plates that turn at absolute `rates` [rad/s]."""
    return Motion((pose.normal * rates).sum(1), (pose.along * rates).sum(1), rates)


def components(angles: PerPlate, velocity: Float[Array, "2"]) -> Motion:
    """Resolve one velocity (x, y) [m/s] along every plate's axes."""
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    x, y = velocity
    return Motion(x * sin + y * cos, y * sin - x * cos, jnp.zeros_like(angles))


def project(pose: Pose, wrench: Wrench) -> PerPlate:
    """The moment that the wrenches exert on each absolute angle [N m]."""
    levers = pose.normal * wrench.normal[:, None] + pose.along * wrench.along[:, None]
    return levers.sum(0) + wrench.moment


def matrix(pose: Pose, moments: Moments) -> Float[Array, "plates plates"]:
    """The symmetric matrix that takes rates of turning to generalised momenta, or to the moments that resist them."""
    normal, along = pose.normal, pose.along
    outer = normal[:, :, None] * (moments.zeroth[:, None] * normal)[:, None, :]
    outer += along[:, :, None] * (moments.along[:, None] * along)[:, None, :]
    arm = moments.first[:, None] * normal
    return outer.sum(0) + arm + arm.T + jnp.diag(moments.second)


def centripetal(pose: Pose, inertia: Moments, motion: Motion) -> Wrench:
    """Minus the rate of change of each plate's momentum at constant rates of turning (Kirchhoff's equations)."""
    squares = motion.turning**2
    rise = (pose.along * squares).sum(1) - motion.along * motion.turning
    slide = motion.normal * motion.turning - (pose.normal * squares).sum(1)
    momentum = inertia.times(motion)
    return Wrench(
        -inertia.zeroth * rise - motion.turning * momentum.along,
        -inertia.along * slide + motion.turning * momentum.normal,
        -inertia.first * rise - motion.along * momentum.normal + motion.normal * momentum.along,
    )


def resultant(angles: PerPlate, wrench: Wrench) -> Float[Array, "2"]:
    """The sum of the forces in the axes of the tank, (x, y)."""
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    return jnp.stack(
        [(wrench.normal * sin - wrench.along * cos).sum(), (wrench.normal * cos + wrench.along * sin).sum()]
    )


Root = Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]
"""The first plate's rate of turning [rad/s], where it is impulse / inertia as long as nothing holds the root."""


def solve(matrix: Float[Array, "plates plates"], right: PerPlate, root: Root) -> PerPlate:
    """Rates of the plates, whose own equations are ``matrix @ rates = right``.

    All plates but the first are eliminated, as the matrix is symmetric positive definite; what is left at the root is
    one scalar equation, ``inertia * rate = impulse``, which `root` may solve with whatever holds the fin.
    """
    if len(right) == 1:
        return root(matrix[0, 0], right[0])[None]
    column = matrix[1:, 0]
    free, dragged = _solved(matrix[1:, 1:], jnp.stack([right[1:], column]))
    first = root(matrix[0, 0] - column @ dragged, right[0] - column @ free)
    return jnp.concatenate([first[None], free - first * dragged])


def _solved(matrix: Float[Array, "n n"], rights: Float[Array, "rights n"]) -> Float[Array, "rights n"]:
    """Solve ``matrix @ x = right`` for each right side; the derivative is one more solution, not that of each step."""
    solution: Float[Array, "rights n"] = jax.lax.custom_linear_solve(
        lambda x: x @ matrix, rights, lambda _, b: _eliminated(matrix, b), symmetric=True
    )
    return solution


def _eliminated(matrix: Float[Array, "n n"], rights: Float[Array, "rights n"]) -> Float[Array, "rights n"]:
    """Elimination without pivoting, unrolled: a batch of such small systems is a handful of long vector operations,
    where a call of LAPACK is one call a fin."""
    size = matrix.shape[0]
    rows = [[matrix[i, j] for j in range(size)] for i in range(size)]
    sides = [rights[:, i] for i in range(size)]
    for k in reversed(range(1, size)):
        inverse = 1 / rows[k][k]
        for i in range(k):
            factor = rows[k][i] * inverse
            for j in range(i + 1):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
            sides[i] = sides[i] - factor * sides[k]
    solution: list[Array] = []
    for k in range(size):
        rest = sides[k]
        for j in range(k):
            rest = rest - rows[k][j] * solution[j]
        solution.append(rest / rows[k][k])
    return jnp.stack(solution, axis=1)
