"""The drive: a positioning controller in profile position mode, the command in, the motion of the shaft out.

A trapezoidal velocity profile runs to the target angle at the commanded velocity, within an acceleration limit. It is
planned anew at each step from the present motion, so a command may come at any time, mid-stroke too. The shaft follows
the profile with a first-order lag.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.configuration import Configuration
from softfin.quantities import Command
from softfin.tank.fin import Shaft
from softfin.tank.rounding import to_multiple


class DriveConfig(Configuration):
    """Motor, gearbox and positioning controller."""

    acceleration_rad_s2: float = Field(60.0, gt=0)
    """Of the profile, speeding up and braking [rad/s2]; reaches the fastest command, pi rad/s, in 0.05 s."""
    lag_s: float = Field(0.04, ge=0)
    """Time constant with which the shaft follows the profile [s].

    A fit to the published fin gave 0.16 s, but with commands so fast that this lag was the whole stroke. With the
    profile at the commanded velocity, 0.04 s is left for the following error and the way through the network.
    """
    encoder_step_rad: float = Field(0.0, ge=0)
    """Readings of the shaft are multiples of this [rad]; 0: not quantised, as a geared encoder's step is below 1e-3."""


class DriveState(NamedTuple):
    """Of the profile, angle [rad] and velocity [rad/s]; of the shaft, angle [rad] and rate in the last step [rad/s]."""

    profile_angle: Float[Array, ""]
    profile_velocity: Float[Array, ""]
    shaft_angle: Float[Array, ""]
    shaft_rate: Float[Array, ""]


class Drive(eqx.Module):
    """What a step needs to know of the drive."""

    acceleration: Float[Array, ""]
    lag: Float[Array, ""]
    encoder_step: Float[Array, ""]

    def __init__(self, config: DriveConfig):
        self.acceleration = jnp.asarray(config.acceleration_rad_s2)
        self.lag = jnp.asarray(config.lag_s)
        self.encoder_step = jnp.asarray(config.encoder_step_rad)

    def rest(self) -> DriveState:
        """At angle 0, still."""
        return DriveState(*(jnp.zeros_like(self.lag) for _ in DriveState._fields))

    def step(self, state: DriveState, command: Command, seconds: float) -> tuple[DriveState, Shaft]:
        """One step of time under a command; also the mean motion of the shaft in it."""
        velocity = _next_velocity(state, command, self.acceleration, seconds)
        mean = (velocity + state.profile_velocity) / 2
        angle = state.profile_angle + seconds * mean
        # The exact response of the lag to a profile that moves at constant velocity over the step.
        lead = self.lag * mean
        decay = jnp.exp(-seconds / jnp.maximum(self.lag, np.finfo(np.float32).tiny))
        shaft = angle - lead + (state.shaft_angle - state.profile_angle + lead) * decay
        rate = (shaft - state.shaft_angle) / seconds
        return DriveState(angle, velocity, shaft, rate), Shaft((shaft + state.shaft_angle) / 2, rate)

    def read(self, state: DriveState) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """What the encoder says: angle [rad] and velocity [rad/s] of the shaft."""
        return to_multiple(state.shaft_angle, self.encoder_step), state.shaft_rate


def _next_velocity(
    state: DriveState, command: Command, acceleration: Float[Array, ""], seconds: float
) -> Float[Array, ""]:
    """The fastest velocity from which the profile, in steps of time, still stops at the target without overshoot."""
    ahead = command.angle - state.profile_angle - seconds * state.profile_velocity / 2
    gain = acceleration * seconds
    braking = jnp.sqrt((gain / 2) ** 2 + 2 * acceleration * jnp.abs(ahead)) - gain / 2
    speed = jnp.minimum(jnp.minimum(braking, jnp.abs(ahead) / seconds), command.velocity)
    change = jnp.sign(ahead) * speed - state.profile_velocity
    return state.profile_velocity + jnp.clip(change, -gain, gain)
