"""A rigid body in water, in 6 degrees of freedom (Fossen 2021, Handbook of Marine Craft, ch. 6 to 8).

Body axes are x forward, y left, z up (REP 103), world axes have z up. A twist is (velocity of the body's origin, angular
velocity) and a wrench (force, moment about the origin), six numbers each, in body axes. The added mass is part of the
inertia, and the body's momentum obeys Kirchhoff's equations (Lamb 1932, art. 124), which hold the Coriolis forces of
body and water and the Munk moment.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S, AnyArray
from softfin.robot.body_config import GRAVITY_M_S2, BodyConfig
from softfin.robot.rotation import IDENTITY, cross, matrix, multiply, normalized

Vector = Float[AnyArray, "3"]
SixVector = Float[AnyArray, "6"]


class BodyState(NamedTuple):
    """Where the body is and how it moves."""

    position: Vector
    """Body's origin in world axes [m]."""
    attitude: Float[AnyArray, "4"]
    """Unit quaternion (w, x, y, z) from body to world axes."""
    twist: SixVector
    """Velocity of the origin [m/s] and angular velocity [rad/s], over ground, in body axes."""

    @classmethod
    def rest(cls) -> "BodyState":
        """At the world's origin, upright, still."""
        return cls(jnp.zeros(3), jnp.asarray(IDENTITY, float), jnp.zeros(6))


class Dynamics(eqx.Module):
    """Inertia, drag and weight as arrays."""

    own_inertia: Float[Array, "6 6"]
    """Inertia of the body without water, about its origin."""
    inertia: Float[Array, "6 6"]
    """The same with the added mass."""
    inverse: Float[Array, "6 6"]
    drag_linear: Float[Array, "6"]
    drag_quadratic: Float[Array, "6"]
    weight: Float[Array, ""]
    """[N]"""
    buoyancy: Float[Array, ""]
    """[N]"""
    centre_of_gravity: Float[Array, "3"]
    centre_of_buoyancy: Float[Array, "3"]

    def __init__(self, config: BodyConfig):
        own = config.own_inertia()
        whole = own + np.diag(config.added_mass)
        self.own_inertia, self.inertia = jnp.asarray(own, float), jnp.asarray(whole, float)
        self.inverse = jnp.asarray(np.linalg.inv(whole), float)
        self.drag_linear = jnp.asarray(config.drag_linear, float)
        self.drag_quadratic = jnp.asarray(config.drag_quadratic, float)
        self.weight = jnp.asarray(config.mass_kg * GRAVITY_M_S2, float)
        self.buoyancy = jnp.asarray(config.upward_n, float)
        self.centre_of_gravity = jnp.asarray(config.centre_of_gravity_m, float)
        self.centre_of_buoyancy = jnp.asarray(config.centre_of_buoyancy_m, float)

    def relative_twist(self, state: BodyState, current: Vector) -> SixVector:
        """Return the twist relative to a steady current (x, y, z) in world axes [m/s]."""
        return jnp.concatenate([state.twist[:3] - current @ matrix(state.attitude), state.twist[3:]])

    def drag(self, twist: SixVector) -> SixVector:
        """Return the wrench of the water's drag at a twist relative to the water."""
        return -(self.drag_linear + self.drag_quadratic * jnp.abs(twist)) * twist

    def restoring(self, attitude: Float[AnyArray, "4"]) -> SixVector:
        """Return the wrench of weight and buoyancy."""
        up = matrix(attitude)[2]
        lifts = ((-self.weight, self.centre_of_gravity), (self.buoyancy, self.centre_of_buoyancy))
        return sum((jnp.concatenate([lift * up, cross(at, lift * up)]) for lift, at in lifts), jnp.zeros(6))

    def gyroscopic(self, twist: SixVector) -> SixVector:
        """Return the wrench by which the momentum of body and water turns along with the body."""
        momentum, velocity, turn = self.inertia @ twist, twist[:3], twist[3:]
        linear, angular = momentum[:3], momentum[3:]
        return jnp.concatenate([cross(linear, turn), cross(angular, turn) + cross(linear, velocity)])

    def acceleration(self, state: BodyState, wrench: SixVector, current: Vector) -> SixVector:
        """Return the rate of change of the twist relative to the water, component by component."""
        twist = self.relative_twist(state, current)
        return self.inverse @ (
            wrench + self.gyroscopic(twist) + self.drag(twist) + self.restoring(state.attitude)
        )

    def step(self, state: BodyState, wrench: SixVector, current: Vector, seconds: float = TICK_S) -> BodyState:
        """Hold a wrench of the fins for a step of time (Runge and Kutta's of fourth order)."""

        def rates(state: BodyState) -> BodyState:
            turn = state.twist[3:]
            # Seen from the body, a steady current turns.
            seen = cross(current @ matrix(state.attitude), turn)
            return BodyState(
                matrix(state.attitude) @ state.twist[:3],
                multiply(state.attitude, jnp.append(0.0, turn / 2)),
                self.acceleration(state, wrench, current).at[:3].add(seen),
            )

        def after(slope: BodyState, seconds: float) -> BodyState:
            moved: BodyState = jax.tree.map(lambda x, rate: x + seconds * rate, state, slope)
            return moved

        first = rates(state)
        second = rates(after(first, seconds / 2))
        third = rates(after(second, seconds / 2))
        fourth = rates(after(third, seconds))
        moved = after(jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, first, second, third, fourth), seconds)
        return moved._replace(attitude=normalized(moved.attitude))
