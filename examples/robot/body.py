"""A rigid body in a steady current, in six degrees of freedom (Fossen 2021, ch. 6 to 8).

Body axes are x forward, y left, z up. The twist (velocity of the origin, angular velocity) is
relative to the water, in body axes. In a steady current, its equation of motion does not contain
the current, which only carries the body along.
"""

from typing import NamedTuple

import numpy as np

from softfin.core.quantities import TICK_S
from softfin.robot.description import Three

GRAVITY_M_S2 = 9.81


class BodyDescription(NamedTuple):
    """A rigid body in water, in body axes about the origin: x forward, y left, z up (REP 103)."""

    mass_kg: float
    """Mass [kg]."""
    inertia_kg_m2: Three
    """Principal moments of inertia about the centre of gravity [kg m2]."""
    added_mass: tuple[float, ...] = (0, 0, 0, 0, 0, 0)
    """Added mass along x, y and z [kg], and added inertia about them [kg m2]."""
    centre_of_gravity_m: Three = (0, 0, 0)
    """Centre of gravity [m]."""
    centre_of_buoyancy_m: Three = (0, 0, 0)
    """Centre of buoyancy [m]."""
    buoyancy_n: float | None = None
    """Buoyancy [N]; None means neutral buoyancy."""

    @property
    def upward_n(self) -> float:
        """Buoyancy [N]."""
        return self.mass_kg * GRAVITY_M_S2 if self.buoyancy_n is None else self.buoyancy_n

    def inertia(self) -> np.ndarray:
        """Return the inertia about the origin as a matrix ``(6, 6)``, including the added mass
        (Fossen 2021, 3.3)."""
        x, y, z = self.centre_of_gravity_m
        # M = [[m I, -m S], [m S, I_g - m S S]], with S v = r_g x v.
        lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        mass = self.mass_kg
        own = np.block(
            [
                [mass * np.eye(3), -mass * lever],
                [mass * lever, np.diag(self.inertia_kg_m2) - mass * lever @ lever],
            ]
        )
        return np.asarray(own + np.diag(self.added_mass))


UCAT = BodyDescription(
    mass_kg=18.5,
    inertia_kg_m2=(0.1574, 0.4646, 0.5115),
    added_mass=(40, 21, 149, 0.127, 1.205, 2.306),
    centre_of_gravity_m=(0, 0, -0.02),
    centre_of_buoyancy_m=(0, 0, 0.03),
)
"""U-CAT's body. Inertia: CAD figures in the code of the ARROWS project (the simulator has 0.45, 0.3,
0.70); the rest: its laboratory's simulator eeUVsim_Gazebo, whose axes are y right, z down."""


class BodyState(NamedTuple):
    position: np.ndarray
    """Position of the origin in world axes [m]."""
    rotation: np.ndarray
    """Matrix from body to world axes."""
    twist: np.ndarray
    """Velocity relative to the water [m/s] and angular velocity [rad/s], in body axes."""


REST = BodyState(np.zeros(3), np.eye(3), np.zeros(6))
"""A body that drifts with the water, upright at the world's origin."""


class Body:
    """Inertia, drag, weight and buoyancy of a body."""

    def __init__(
        self, config: BodyDescription, drag_linear: np.ndarray, drag_quadratic: np.ndarray
    ) -> None:
        """The drag coefficients are for surge, sway, heave, roll, pitch and yaw [N s/m, N m s] and
        [N s2/m2, N m s2]."""
        self.inertia = config.inertia()
        self._inverse = np.linalg.inv(self.inertia)
        self._drag_linear = drag_linear
        self._drag_quadratic = drag_quadratic
        weight = config.mass_kg * GRAVITY_M_S2
        self._lift_n = config.upward_n - weight
        # The restoring moment is this lever times the unit vector upwards.
        self._lever_nm = config.upward_n * np.array(
            config.centre_of_buoyancy_m
        ) - weight * np.array(config.centre_of_gravity_m)

    def acceleration(self, state: BodyState, wrench: np.ndarray) -> np.ndarray:
        """Return the rate of change of the twist, for a wrench in body axes [N, N m]."""
        twist = state.twist
        up = state.rotation[2]
        restoring = np.concatenate([self._lift_n * up, np.cross(self._lever_nm, up)])
        drag = -(self._drag_linear + self._drag_quadratic * np.abs(twist)) * twist
        # Kirchhoff's equations with the momentum (p, h) = M (v, omega): p x omega, and h x omega +
        # p x v.
        linear, angular = np.split(self.inertia @ twist, 2)
        gyroscopic = np.concatenate(
            [
                np.cross(linear, twist[3:]),
                np.cross(angular, twist[3:]) + np.cross(linear, twist[:3]),
            ]
        )
        return self._inverse @ (wrench + gyroscopic + drag + restoring)

    def step(self, state: BodyState, acceleration: np.ndarray, current: np.ndarray) -> BodyState:
        """Advance by one tick of 10 ms, in a current in world axes [m/s] (semi-implicit Euler)."""
        twist = state.twist + TICK_S * acceleration
        position = state.position + TICK_S * (state.rotation @ twist[:3] + current)
        return BodyState(position, state.rotation @ rotation(TICK_S * twist[3:]), twist)


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return the matrix of a rotation about a vector by its length [rad] (Rodrigues)."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
