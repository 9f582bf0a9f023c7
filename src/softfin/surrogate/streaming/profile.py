"""What a positioning drive makes of a command: the trapezoidal profile, with coefficients that are read off the logs.

The profile itself is the drive's (`softfin.tank.drive`); gains, zero, delay and the drive's own limits are the log's.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, AnyArray, Command
from softfin.surrogate.streaming.force import Motion
from softfin.tank.drive import delayed, next_velocity

LONGEST_DELAY = 20
"""Ticks."""

STEPS = 2
"""Of the profile in a tick: a corner between two ticks is met within 5 ms."""


class ProfileConfig(Configuration):
    """Coefficients; by default a drive that does what it is told."""

    gain: float = Field(default=1.0, gt=0)
    """Angle that is read over angle that was commanded [-]."""
    zero_rad: float = 0.0
    """Angle that is read where 0 was commanded [rad]."""
    delay_ticks: float = Field(default=0.0, ge=0, le=LONGEST_DELAY)
    """From a command to the first tick that obeys it [10 ms]."""
    velocity_factor: float = Field(default=1.0, gt=0)
    """Velocity of the profile over commanded velocity [-]."""
    velocity_limit_rad_s: float = Field(default=100.0, gt=0)
    """That the profile never exceeds [rad/s]."""
    acceleration_rad_s2: float = Field(default=100.0, gt=0)
    """Speeding up and braking [rad/s2]."""
    lag_s: float = Field(default=0.0, ge=0)
    """Angle that the shaft is behind its profile over its velocity [s]."""


class ProfileState(NamedTuple):
    """Where the profile is, and the commands on their way."""

    angle: Float[AnyArray, ""]
    """[rad]"""
    velocity: Float[AnyArray, ""]
    """[rad/s]"""
    waiting: Command
    """Of the last ticks, newest first."""


class Profile(eqx.Module):
    """Angle and velocity of a drive that follows its profile."""

    gain: Float[Array, ""]
    zero: Float[Array, ""]
    delay: Float[Array, ""]
    velocity_factor: Float[Array, ""]
    velocity_limit: Float[Array, ""]
    acceleration: Float[Array, ""]
    lag: Float[Array, ""]

    def __init__(self, config: ProfileConfig) -> None:
        self.gain, self.zero, self.delay = (
            jnp.asarray(value, jnp.float32) for value in (config.gain, config.zero_rad, config.delay_ticks)
        )
        self.velocity_factor = jnp.asarray(config.velocity_factor, jnp.float32)
        self.velocity_limit = jnp.asarray(config.velocity_limit_rad_s, jnp.float32)
        self.acceleration = jnp.asarray(config.acceleration_rad_s2, jnp.float32)
        self.lag = jnp.asarray(config.lag_s, jnp.float32)

    def start(self, motion: Motion, waiting: Command) -> ProfileState:
        """In motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return ProfileState(motion.angle + self.lag * motion.velocity, motion.velocity, waiting)

    def step(self, state: ProfileState, command: Command) -> tuple[ProfileState, Command]:
        """A tick under a command that is given now; out comes the one that is obeyed, as the log's angles count."""
        queue = Command(*(jnp.append(new, old) for new, old in zip(command, state.waiting, strict=True)))
        obeyed = delayed(queue, self.delay)
        speed = jnp.minimum(self.velocity_factor * obeyed.velocity, self.velocity_limit)
        target = Command(self.gain * obeyed.angle + self.zero, speed)
        seconds = TICK_S / STEPS

        angle, velocity = jnp.asarray(state.angle), jnp.asarray(state.velocity)
        for _ in range(STEPS):
            fresh = next_velocity(angle, velocity, target, self.acceleration, seconds)
            angle, velocity = angle + seconds * (velocity + fresh) / 2, fresh
        return ProfileState(angle, velocity, Command(*(channel[:-1] for channel in queue))), target

    def motion(self, state: ProfileState) -> Motion:
        """Of the shaft that follows."""
        return Motion(state.angle - self.lag * state.velocity, state.velocity)
