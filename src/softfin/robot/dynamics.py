"""Dynamics of a rigid body in water in 6 degrees of freedom (Fossen 2021, Handbook of Marine Craft,
ch. 6 to 8).

Body axes are x forward, y left, z up (REP 103); the world's z axis points up. A twist is (velocity
of the body's origin, angular velocity), and a wrench is (force, moment about the origin); both have
six components in body axes. The inertia includes the added mass, and the momentum obeys Kirchhoff's
equations (Lamb 1932, art. 124), which include the Coriolis forces of the body and the water and the
Munk moment. The same formulas run with NumPy on the robot and with JAX in simulations.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.operations import select_operations
from softfin.core.quantities import TICK_S, AnyArray
from softfin.robot.body_config import GRAVITY_M_S2, BodyConfig
from softfin.robot.rotation import (
    IDENTITY,
    Quaternion,
    SixVector,
    Vector,
    cross,
    matrix,
    multiply,
    normalized,
    six,
)


class BodyState(NamedTuple):
    """Position, attitude and twist of the body."""

    position: Vector
    """Position of the body's origin in world axes [m]."""
    attitude: Quaternion
    """Unit quaternion (w, x, y, z) from body to world axes."""
    twist: SixVector
    """Velocity of the origin over ground [m/s] and angular velocity [rad/s], in body axes."""

    @classmethod
    def rest(cls) -> "BodyState":
        """Return the state at rest, upright, at the world's origin."""
        return cls(np.zeros(3), IDENTITY, np.zeros(6))


class Dynamics(NamedTuple):
    """Inertia, drag, weight and buoyancy of a body, as arrays."""

    inertia: Float[AnyArray, "6 6"]
    """Inertia of the body plus added mass, about the body's origin [kg, kg m, kg m2]."""
    inverse: Float[AnyArray, "6 6"]
    drag_linear: SixVector
    drag_quadratic: SixVector
    weight: float
    """[N]"""
    buoyancy: float
    """[N]"""
    centre_of_gravity: Vector
    centre_of_buoyancy: Vector

    @classmethod
    def of(cls, config: BodyConfig) -> "Dynamics":
        """Build the dynamics from a configuration."""
        inertia = config.own_inertia() + np.diag(config.added_mass)
        return cls(
            inertia=inertia,
            inverse=np.linalg.inv(inertia),
            drag_linear=np.asarray(config.drag_linear, float),
            drag_quadratic=np.asarray(config.drag_quadratic, float),
            weight=config.mass_kg * GRAVITY_M_S2,
            buoyancy=config.upward_n,
            centre_of_gravity=np.asarray(config.centre_of_gravity_m, float),
            centre_of_buoyancy=np.asarray(config.centre_of_buoyancy_m, float),
        )

    def relative_twist(self, state: BodyState, current: Vector) -> SixVector:
        """Return the twist relative to a steady current (x, y, z) in world axes [m/s]."""
        return six(state.twist[:3] - current @ matrix(state.attitude), state.twist[3:])

    def drag(self, twist: SixVector) -> SixVector:
        """Return the drag wrench for a twist relative to the water."""
        # -(D1 + D2 |v|) v, for each axis.
        speeds: SixVector = select_operations(twist).xp.abs(twist)
        return -(self.drag_linear + self.drag_quadratic * speeds) * twist

    def restoring(self, attitude: Quaternion) -> SixVector:
        """Return the wrench due to weight and buoyancy at an attitude."""
        up = matrix(attitude)[2]
        # Moment of both forces about the origin: (B r_b - W r_g) x up.
        lever = self.buoyancy * self.centre_of_buoyancy - self.weight * self.centre_of_gravity
        return six((self.buoyancy - self.weight) * up, cross(lever, up))

    @property
    def righting_nm_rad(self) -> float:
        """Righting stiffness due to weight and buoyancy in roll and pitch [N m/rad]; if negative,
        the body tips over."""
        return float(
            self.buoyancy * self.centre_of_buoyancy[2] - self.weight * self.centre_of_gravity[2]
        )

    def gyroscopic(self, twist: SixVector) -> SixVector:
        """Return the gyroscopic wrench due to the momentum of the body and the water, for a twist
        relative to the water."""
        # Kirchhoff's equations with the momentum (p, h) = M (v, omega): p x omega, and h x omega +
        # p x v.
        momentum = self.inertia @ twist
        velocity = twist[:3]
        turn = twist[3:]
        linear = momentum[:3]
        angular = momentum[3:]
        return six(cross(linear, turn), cross(angular, turn) + cross(linear, velocity))

    def acceleration(self, state: BodyState, wrench: SixVector, current: Vector) -> SixVector:
        """Return the rate of change of the twist relative to the water, in body axes."""
        twist = self.relative_twist(state, current)
        return self.inverse @ (
            wrench + self.gyroscopic(twist) + self.drag(twist) + self.restoring(state.attitude)
        )

    def step(
        self, state: BodyState, wrench: SixVector, current: Vector, seconds: float = TICK_S
    ) -> BodyState:
        """Advance by one time step with a constant wrench (fourth-order Runge-Kutta)."""

        def rates(state: BodyState) -> BodyState:
            xp = select_operations(*state, wrench, current).xp
            turn = state.twist[3:]
            # In body axes, a steady current rotates: dc/dt = c x omega.
            seen = cross(current @ matrix(state.attitude), turn)
            return BodyState(
                matrix(state.attitude) @ state.twist[:3],
                # dq/dt = q (0, omega) / 2.
                multiply(state.attitude, xp.concatenate([xp.zeros(1), turn / 2])),
                self.acceleration(state, wrench, current) + six(seen, xp.zeros(3)),
            )

        def after(slope: BodyState, seconds: float) -> BodyState:
            return BodyState(*(x + seconds * rate for x, rate in zip(state, slope, strict=True)))

        first = rates(state)
        second = rates(after(first, seconds / 2))
        third = rates(after(second, seconds / 2))
        fourth = rates(after(third, seconds))
        slopes = zip(first, second, third, fourth, strict=True)
        # Runge-Kutta weights 1/6, 2/6, 2/6, 1/6. The sum leaves the unit sphere, so normalise the
        # quaternion.
        moved = after(BodyState(*((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in slopes)), seconds)
        return moved._replace(attitude=normalized(moved.attitude))
