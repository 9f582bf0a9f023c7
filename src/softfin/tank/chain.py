"""A planar chain of rigid plates hinged end to end: its pose, its motion, and the effect of loads
on its plates.

Plate i lies from its inner end, nearer the shaft, along d(phi) = (-cos phi, sin phi); its normal is
n = d' = (sin phi, cos phi). The absolute angles phi are the only coordinates, so length is kept
exactly. Loads, momenta and motions of a plate are given along n and d and about its inner end.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

PerPlate = Float[Array, " plates"]
Scalar = Float[Array, ""]
PlanarVector = Float[Array, "2"]
"""(x, y)."""

PlateMatrix = Float[Array, "plates plates"]


class Pose(NamedTuple):
    """Effect of the rotation of plate j on the inner end of plate i > j; rows i, columns j, zero
    elsewhere [m]."""

    normal: PlateMatrix
    along: PlateMatrix


class PlateMotion(NamedTuple):
    """Motion of each plate: velocity of its inner end along n and d [m/s], angular velocity
    [rad/s]."""

    normal: PerPlate
    along: PerPlate
    turning: PerPlate


class PlateWrench(NamedTuple):
    """Force on each plate along n and d [N], moment about the inner end [N m]. Also used for
    momenta [N s, N m s]."""

    normal: PerPlate
    along: PerPlate
    moment: PerPlate


class Moments(NamedTuple):
    """Moments of each plate's mass [kg] or drag [kg/s]: orders 0 to 2 along n, and the total along
    d.

    With m(s) the mass per length along n, they are the integrals of m, m s and m s^2 over the
    plate.
    """

    zeroth: PerPlate
    first: PerPlate
    second: PerPlate
    along: PerPlate

    def times(self, motion: PlateMotion) -> PlateWrench:
        """Return the momentum of a motion, or the force that resists it."""
        return PlateWrench(
            self.zeroth * motion.normal + self.first * motion.turning,
            self.along * motion.along,
            self.first * motion.normal + self.second * motion.turning,
        )


def pose(angles: PerPlate, plate_length: Scalar) -> Pose:
    """Return the pose of a chain whose plates are at absolute `angles` [rad]."""
    cos = jnp.cos(angles)
    sin = jnp.sin(angles)
    lever = jnp.tril(jnp.ones((angles.size, angles.size), angles.dtype), -1) * plate_length
    return Pose(
        lever * (cos[:, None] * cos[None] + sin[:, None] * sin[None]),
        lever * (sin[:, None] * cos[None] - cos[:, None] * sin[None]),
    )


def motion(pose: Pose, rates: PerPlate) -> PlateMotion:
    """Return the motion of plates that rotate at absolute `rates` [rad/s]."""
    return PlateMotion((pose.normal * rates).sum(1), (pose.along * rates).sum(1), rates)


def components(angles: PerPlate, velocity: PlanarVector) -> PlateMotion:
    """Resolve one velocity (x, y) [m/s] along every plate's axes."""
    cos = jnp.cos(angles)
    sin = jnp.sin(angles)
    x, y = velocity
    return PlateMotion(x * sin + y * cos, y * sin - x * cos, jnp.zeros_like(angles))


def project(pose: Pose, wrench: PlateWrench) -> PerPlate:
    """Return the moment of the wrenches about each absolute angle [N m]."""
    levers = pose.normal * wrench.normal[:, None] + pose.along * wrench.along[:, None]
    return levers.sum(0) + wrench.moment


def momentum_matrix(pose: Pose, moments: Moments) -> PlateMatrix:
    """Return the symmetric matrix that maps angular velocities to generalised momenta, or to the
    moments that resist them."""
    normal = pose.normal
    along = pose.along
    outer = normal[:, :, None] * (moments.zeroth[:, None] * normal)[:, None, :]
    outer += along[:, :, None] * (moments.along[:, None] * along)[:, None, :]
    arm = moments.first[:, None] * normal
    return outer.sum(0) + arm + arm.T + jnp.diag(moments.second)


def centripetal(pose: Pose, inertia: Moments, motion: PlateMotion) -> PlateWrench:
    """Return minus the rate of change of each plate's momentum at constant angular velocities
    (Kirchhoff's equations)."""
    squares = motion.turning**2
    rise = (pose.along * squares).sum(1) - motion.along * motion.turning
    slide = motion.normal * motion.turning - (pose.normal * squares).sum(1)
    momentum = inertia.times(motion)
    return PlateWrench(
        -inertia.zeroth * rise - motion.turning * momentum.along,
        -inertia.along * slide + motion.turning * momentum.normal,
        -inertia.first * rise - motion.along * momentum.normal + motion.normal * momentum.along,
    )


def resultant(angles: PerPlate, wrench: PlateWrench) -> PlanarVector:
    """Return the sum of the forces in the axes of the tank, (x, y)."""
    cos = jnp.cos(angles)
    sin = jnp.sin(angles)
    return jnp.stack(
        [
            (wrench.normal * sin - wrench.along * cos).sum(),
            (wrench.normal * cos + wrench.along * sin).sum(),
        ]
    )


def condense(
    matrix: PlateMatrix, right: PerPlate
) -> tuple[Scalar, Scalar, Callable[[Scalar], PerPlate]]:
    """Eliminate all plates but the first from ``matrix @ rates = right``, the matrix symmetric
    positive definite.

    At the root ``inertia * rate = impulse`` remains, to be solved together with whatever holds the
    fin. Returns inertia, impulse, and the function from the first plate's rate to all rates.
    """
    if len(right) == 1:
        return matrix[0, 0], right[0], lambda first: first[None]
    column = matrix[1:, 0]
    inner = matrix[1:, 1:]
    # Its derivative is one more linear solve, not the derivative of each elimination step.
    free, dragged = jax.lax.custom_linear_solve(
        lambda x: x @ inner,
        jnp.stack([right[1:], column]),
        lambda _, b: _eliminated(inner, b),
        symmetric=True,
    )

    def expand(first: Scalar) -> PerPlate:
        return jnp.concatenate([first[None], free - first * dragged])

    return matrix[0, 0] - column @ dragged, right[0] - column @ free, expand


def _eliminated(
    matrix: Float[Array, "n n"], rights: Float[Array, "rights n"]
) -> Float[Array, "rights n"]:
    """Elimination without pivoting, unrolled: a batch of such small systems becomes a few long
    vector operations, while LAPACK would need one call per fin."""
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
