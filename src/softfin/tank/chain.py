"""A planar chain of rigid plates, hinged end to end: its pose, its motion, and the effect of loads
on the plates.

Plate i extends from its inner end, which is the end nearer to the shaft, along d(phi) = (-cos phi,
sin phi). Its normal is n = d' = (sin phi, cos phi). The absolute angles phi are the only
coordinates, so the length is conserved exactly. The loads, momenta and motions of a plate are
resolved along n and d at the inner end.
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
    """Velocity of the inner end of plate i divided by the angular velocity of plate j [m]: rows i,
    columns j; zero unless j < i."""

    normal: PlateMatrix
    """Component along the normal of plate i."""
    along: PlateMatrix
    """Component along d of plate i."""


class PlateMotion(NamedTuple):
    """Motion of each plate."""

    normal: PerPlate
    """Velocity of the inner end along n [m/s]."""
    along: PerPlate
    """Velocity of the inner end along d [m/s]."""
    turning: PerPlate
    """Angular velocity [rad/s]."""


class PlateWrench(NamedTuple):
    """Force and moment on each plate; also used for momenta [N s, N m s]."""

    normal: PerPlate
    """Force along n [N]."""
    along: PerPlate
    """Force along d [N]."""
    moment: PerPlate
    """Moment about the inner end [N m]."""


class Moments(NamedTuple):
    """Moments of the mass [kg] or drag [kg/s] of each plate about its inner end.

    Mass may differ along n and d, because added mass acts only along n. With the mass per length
    m(s) along n, the moments are the integrals of m, m s and m s^2 over the plate.
    """

    zeroth: PerPlate
    first: PerPlate
    second: PerPlate
    along: PerPlate
    """Integral of the mass per length along d."""

    def times(self, motion: PlateMotion) -> PlateWrench:
        """Return the momentum of a motion, or, for drag, the force that resists the motion."""
        # At s, the velocity along n is normal + s * turning; the velocity along d is the same as at
        # the inner end.
        return PlateWrench(
            self.zeroth * motion.normal + self.first * motion.turning,
            self.along * motion.along,
            self.first * motion.normal + self.second * motion.turning,
        )


def pose(angles: PerPlate, plate_length: Scalar) -> Pose:
    """Return the pose of a chain with plates at the absolute `angles` [rad]."""
    cos = jnp.cos(angles)
    sin = jnp.sin(angles)
    # Plate j moves the inner end of plate i at the velocity l phi_j' n_j. The components are l
    # cos(phi_i - phi_j) along n_i and l sin(phi_i - phi_j) along d_i.
    lever = jnp.tril(jnp.ones((angles.size, angles.size), angles.dtype), -1) * plate_length
    return Pose(
        lever * (cos[:, None] * cos[None] + sin[:, None] * sin[None]),
        lever * (sin[:, None] * cos[None] - cos[:, None] * sin[None]),
    )


def motion(pose: Pose, rates: PerPlate) -> PlateMotion:
    """Return the motion of plates that rotate at the absolute `rates` [rad/s]."""
    return PlateMotion((pose.normal * rates).sum(1), (pose.along * rates).sum(1), rates)


def components(angles: PerPlate, velocity: PlanarVector) -> PlateMotion:
    """Resolve a velocity (x, y) [m/s] into components along the axes of each plate."""
    cos = jnp.cos(angles)
    sin = jnp.sin(angles)
    x, y = velocity
    return PlateMotion(x * sin + y * cos, y * sin - x * cos, jnp.zeros_like(angles))


def project(pose: Pose, wrench: PlateWrench) -> PerPlate:
    """Return the generalized force of the wrenches on each absolute angle [N m]."""
    # By the principle of virtual work, this is the transpose of the map from rates to motion.
    levers = pose.normal * wrench.normal[:, None] + pose.along * wrench.along[:, None]
    return levers.sum(0) + wrench.moment


def momentum_matrix(pose: Pose, moments: Moments) -> PlateMatrix:
    """Return the symmetric matrix that maps angular velocities to generalized momenta, or, for
    drag, to the resisting moments.

    It is the matrix of the map ``project(pose, moments.times(motion(pose, rates)))``.
    """
    normal = pose.normal
    along = pose.along
    # The axes of `outer` are (i, j, k), where j and k are angles and plate i is summed over.
    outer = normal[:, :, None] * (moments.zeroth[:, None] * normal)[:, None, :]
    outer += along[:, :, None] * (moments.along[:, None] * along)[:, None, :]
    arm = moments.first[:, None] * normal
    return outer.sum(0) + arm + arm.T + jnp.diag(moments.second)


def centripetal(pose: Pose, inertia: Moments, motion: PlateMotion) -> PlateWrench:
    """Return the negative rate of change of each plate's momentum at constant angular velocities,
    by Kirchhoff's equations.

    In the axes of a plate, the rate of change of a momentum p includes turning x p. The rate of
    change of the angular momentum about a moving point also includes velocity x p.
    """
    squares = motion.turning**2
    # Rates of change of the velocity components of the inner end along n and d.
    rise = (pose.along * squares).sum(1) - motion.along * motion.turning
    slide = motion.normal * motion.turning - (pose.normal * squares).sum(1)
    momentum = inertia.times(motion)
    return PlateWrench(
        -inertia.zeroth * rise - motion.turning * momentum.along,
        -inertia.along * slide + motion.turning * momentum.normal,
        -inertia.first * rise - motion.along * momentum.normal + motion.normal * momentum.along,
    )


def resultant(angles: PerPlate, wrench: PlateWrench) -> PlanarVector:
    """Return the sum of the forces (x, y) in tank axes."""
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
    """Eliminate all plates except the first from ``matrix @ rates = right``, where the matrix is
    symmetric and positive definite.

    The remaining equation of the first plate, ``inertia * rate = impulse``, is solved together with
    the shaft.

    Returns:
        Inertia, impulse, and the function from the rate of the first plate to all rates.
    """
    if len(right) == 1:
        return matrix[0, 0], right[0], lambda first: first[None]
    column = matrix[1:, 0]
    inner = matrix[1:, 1:]
    # With the blocks [[a, c^T], [c, B]] of the matrix: free = B^-1 right[1:], dragged = B^-1 c. The
    # derivative of a custom linear solve is another solve, not the derivative of each elimination
    # step.
    free, dragged = jax.lax.custom_linear_solve(
        lambda x: x @ inner,
        jnp.stack([right[1:], column]),
        lambda _, b: _eliminated(inner, b),
        symmetric=True,
    )

    def expand(first: Scalar) -> PerPlate:
        return jnp.concatenate([first[None], free - first * dragged])

    # The Schur complement: (a - c^T B^-1 c) rate = right[0] - c^T B^-1 right[1:].
    return matrix[0, 0] - column @ dragged, right[0] - column @ free, expand


def _eliminated(
    matrix: Float[Array, "n n"], rights: Float[Array, "rights n"]
) -> Float[Array, "rights n"]:
    """Solve a symmetric positive definite system by unrolled elimination without pivoting.

    A batch of such small systems becomes a few long vector operations, whereas LAPACK would need
    one call per fin.
    """
    size = matrix.shape[0]
    # Eliminate from tip to root. Only the lower triangle is updated, because the matrix stays
    # symmetric.
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
