"""A rigid body in water, in 6 degrees of freedom (Fossen 2021, Handbook of Marine Craft, ch. 6 to
8).

Body axes are x forward, y left, z up (REP 103), world axes have z up. A twist is (velocity of the
body's origin, angular velocity) and a wrench (force, moment about the origin), six numbers each, in
body axes. The added mass is part of the inertia, and the body's momentum obeys Kirchhoff's
equations (Lamb 1932, art. 124), which include the Coriolis forces of body and water and the Munk
moment. The formulas run with NumPy on the robot, and with JAX in simulations.
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
    """Body's origin in world axes [m]."""
    attitude: Quaternion
    """Unit quaternion (w, x, y, z) from body to world axes."""
    twist: SixVector
    """Velocity of the origin [m/s] and angular velocity [rad/s], over ground, in body axes."""

    @classmethod
    def rest(cls) -> "BodyState":
        """At the world's origin, upright, at rest."""
        return cls(np.zeros(3), IDENTITY, np.zeros(6))


class Dynamics(NamedTuple):
    """Inertia, drag and weight as arrays."""

    inertia: Float[AnyArray, "6 6"]
    """Inertia of body and water about the body's origin."""
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
        """Build them from a configuration."""
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
        """Return the wrench of the water's drag at a twist relative to the water."""
        speeds: SixVector = select_operations(twist).xp.abs(twist)
        return -(self.drag_linear + self.drag_quadratic * speeds) * twist

    def restoring(self, attitude: Quaternion) -> SixVector:
        """Return the wrench of weight and buoyancy."""
        up = matrix(attitude)[2]
        lever = self.buoyancy * self.centre_of_buoyancy - self.weight * self.centre_of_gravity
        return six((self.buoyancy - self.weight) * up, cross(lever, up))

    @property
    def righting_nm_rad(self) -> float:
        """Stiffness with which weight and buoyancy right the body in roll and pitch [N m/rad];
        below 0 it tips over."""
        return float(
            self.buoyancy * self.centre_of_buoyancy[2] - self.weight * self.centre_of_gravity[2]
        )

    def gyroscopic(self, twist: SixVector) -> SixVector:
        """Return the wrench that rotates the momentum of body and water with the body."""
        momentum = self.inertia @ twist
        velocity = twist[:3]
        turn = twist[3:]
        linear = momentum[:3]
        angular = momentum[3:]
        return six(cross(linear, turn), cross(angular, turn) + cross(linear, velocity))

    def acceleration(self, state: BodyState, wrench: SixVector, current: Vector) -> SixVector:
        """Return the rate of change of the twist relative to the water, component by component."""
        twist = self.relative_twist(state, current)
        return self.inverse @ (
            wrench + self.gyroscopic(twist) + self.drag(twist) + self.restoring(state.attitude)
        )

    def step(
        self, state: BodyState, wrench: SixVector, current: Vector, seconds: float = TICK_S
    ) -> BodyState:
        """Hold a wrench of the fins for one time step (fourth-order Runge-Kutta)."""

        def rates(state: BodyState) -> BodyState:
            xp = select_operations(*state, wrench, current).xp
            turn = state.twist[3:]
            # Seen from the body, a steady current rotates.
            seen = cross(current @ matrix(state.attitude), turn)
            return BodyState(
                matrix(state.attitude) @ state.twist[:3],
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
        moved = after(BodyState(*((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in slopes)), seconds)
        return moved._replace(attitude=normalized(moved.attitude))
