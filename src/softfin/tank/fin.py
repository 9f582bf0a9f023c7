"""The soft fin: a tapered silicone plate, bending in the plane of beating, as a chain of plates with sprung joints.

The first joint holds the fin on the shaft, whose motion is prescribed. One step of time takes bending, structural
damping and the water's resistance by the implicit midpoint rule, and what is left of the nonlinearity at a midpoint
that the last acceleration foretells: second order in the step, one linear solve, stable however stiff the fin.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from pydantic import Field

from softfin.configuration import Configuration
from softfin.tank import chain
from softfin.tank.chain import Moments, Motion, PerPlate, Wrench


class FinConfig(Configuration):
    """Geometry and material.

    A fit to the published fin's surrogate gave length 0.20 m, span 0.081 m and 7 MPa, with commands taken to be several
    times faster than logged. Here a command means what it says, so the default fin is larger: it makes the published
    forces at the paper's own velocities, 1 to pi rad/s. Root thickness and taper are the fit's.
    """

    plates: int = Field(6, ge=1, le=32)
    """Rigid plates in the chain [-]; the error of the force falls as their number squared: 2% at 6 (rms)."""
    length_m: float = Field(0.25, gt=0)
    """From the shaft to the tip [m]."""
    span_m: float = Field(0.13, gt=0)
    """Across the plane of beating, constant along the fin [m]."""
    root_thickness_m: float = Field(0.019, gt=0)
    """At the shaft [m]."""
    tip_thickness_ratio: float = Field(0.4, gt=0)
    """Thickness at the tip over that at the root; linear between them."""
    youngs_modulus_pa: float = Field(8e6, gt=0)
    """Effective, with the bracket that stiffens the root [Pa]; the silicone alone, Shore A 22, has about 1e6."""
    density_kg_m3: float = Field(1100.0, gt=0)
    """Of the silicone [kg/m3]."""
    damping_s: float = Field(0.02, ge=0)
    """Kelvin-Voigt time: damping over stiffness of each joint [s]; a loss factor of 0.2 at 1.6 Hz."""


class FinState(NamedTuple):
    """Absolute angles of the plates [rad], their rates [rad/s], and the last step's accelerations [rad/s2]."""

    angles: PerPlate
    rates: PerPlate
    accelerations: PerPlate


class Shaft(NamedTuple):
    """Motion of the shaft over a step: its mean angle [rad] and rate [rad/s]."""

    angle: Float[Array, ""]
    rate: Float[Array, ""]


Loads = Callable[[Motion], tuple[Moments, Wrench]]
"""What the water does besides its inertia: what resists the motion [kg/s], and forces whatever the motion [N]."""


class Fin(eqx.Module):
    """What a step needs to know of the fin."""

    plate_length: Float[Array, ""]
    stiffness: PerPlate
    """Of the joint at the inner end of each plate [N m/rad]."""
    damping: PerPlate
    """Likewise [N m s/rad]."""
    inertia: Moments
    """Of the fin itself, without the water [kg, kg m, kg m2]."""

    def __init__(self, config: FinConfig):
        plate = config.length_m / config.plates
        # The joint between two plates bends as the beam between their middles does; the first plate's inner half bends
        # against the shaft.
        middles = (np.arange(config.plates) + 0.5) * plate
        stiffness = 1 / _compliance(config, np.concatenate([[0.0], middles[:-1]]), middles)
        mass = config.density_kg_m3 * config.span_m * _thickness(config, middles) * plate
        self.plate_length = jnp.asarray(plate)
        self.stiffness = jnp.asarray(stiffness)
        self.damping = jnp.asarray(stiffness * config.damping_s)
        zeroth, first, second = (jnp.asarray(mass * factor) for factor in (1.0, plate / 2, plate**2 / 3))
        self.inertia = Moments(zeroth, first, second, along=zeroth)

    def rest(self) -> FinState:
        """Straight along angle 0, still."""
        return FinState(*(jnp.zeros_like(self.stiffness) for _ in FinState._fields))

    def momentum(self, state: FinState, inertia: Moments) -> Float[Array, "2"]:
        """Of the fin, or with the water's inertia of both, in the axes of the tank [N s]."""
        motion = chain.motion(chain.pose(state.angles, self.plate_length), state.rates)
        return chain.resultant(state.angles, inertia.times(motion))

    def energy(self, state: FinState, shaft_angle: Float[Array, ""], inertia: Moments) -> Float[Array, ""]:
        """Kinetic and elastic [J]."""
        motion = chain.motion(chain.pose(state.angles, self.plate_length), state.rates)
        momentum = inertia.times(motion)
        kinetic = sum((p * v).sum() for p, v in zip(momentum, motion, strict=True)) / 2
        bends = state.angles - jnp.concatenate([shaft_angle[None], state.angles[:-1]])
        return kinetic + (self.stiffness * bends**2).sum() / 2

    def step(
        self, state: FinState, shaft: Shaft, inertia: Moments, loads: Loads, seconds: float
    ) -> tuple[FinState, Float[Array, "2"]]:
        """One step of time; also the mean force of `loads` on the fin in it, in the axes of the tank [N]."""
        half = seconds / 2
        foretold = state.rates + half * state.accelerations
        angles = state.angles + half * (state.rates + foretold) / 2
        pose = chain.pose(angles, self.plate_length)
        motion = chain.motion(pose, foretold)
        resistance, push = loads(motion)
        momentum = inertia.times(chain.motion(pose, state.rates))
        impulse = jax.tree.map(
            lambda p, c, f: p + half * (c + f), momentum, chain.centripetal(pose, inertia, motion), push
        )
        left = chain.matrix(pose, jax.tree.map(lambda m, r: m + half * r, inertia, resistance))
        right = chain.project(pose, impulse) + half * self._spring_moments(state.angles, shaft)
        mean = chain.solve(left + half * _joint_matrix(self.damping + half * self.stiffness), right)
        force = jax.tree.map(lambda f, r: f - r, push, resistance.times(chain.motion(pose, mean)))
        after = FinState(state.angles + seconds * mean, 2 * mean - state.rates, (mean - state.rates) / half)
        return after, chain.resultant(angles, force)

    def _spring_moments(self, angles: PerPlate, shaft: Shaft) -> PerPlate:
        bends = angles - jnp.concatenate([shaft.angle[None], angles[:-1]])
        rates = jnp.concatenate([-shaft.rate[None], jnp.zeros_like(angles[1:])])
        torques = self.stiffness * bends + self.damping * rates
        return jnp.concatenate([torques[1:], jnp.zeros_like(torques[:1])]) - torques


def _joint_matrix(joints: PerPlate) -> Float[Array, "plates plates"]:
    """The tridiagonal matrix that takes absolute angles to the moments of sprung joints."""
    outer = jnp.concatenate([joints[1:], jnp.zeros_like(joints[:1])])
    below = jnp.diag(joints[1:], -1)
    return jnp.diag(joints + outer) - below - below.T


def _thickness(config: FinConfig, along: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    taper = 1 - config.tip_thickness_ratio
    return config.root_thickness_m * (1 - taper * along / config.length_m)


def _compliance(
    config: FinConfig, start: NDArray[np.floating[Any]], stop: NDArray[np.floating[Any]]
) -> NDArray[np.floating[Any]]:
    """The integral of 1/EI between two places on the fin [rad/(N m)]."""
    points = 64
    along = start + (np.arange(points)[:, None] + 0.5) / points * (stop - start)
    bending: NDArray[np.floating[Any]] = config.youngs_modulus_pa * config.span_m * _thickness(config, along) ** 3 / 12
    return np.asarray((stop - start) * (1 / bending).mean(axis=0))
