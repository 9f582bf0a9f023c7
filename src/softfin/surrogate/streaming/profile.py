"""The trapezoidal profile by which a positioning drive obeys a command, with coefficients that are read off the logs.

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
"""Longest delay from a command to the motion that obeys it [ticks]."""

STEPS = 2
"""Steps of the profile in a tick: a corner between two ticks is met within 5 ms."""


class ProfileConfig(Configuration):
    """Coefficients of the profile; by default a drive that does what it is told."""

    gain: float = Field(default=1.0, gt=0)
    """Ratio of the angle that is read to the angle that was commanded [-]."""
    zero_rad: float = 0.0
    """Angle that is read where 0 was commanded [rad]."""
    delay_ticks: float = Field(default=0.0, ge=0, le=LONGEST_DELAY)
    """Ticks from a command to the first that obeys it [10 ms]."""
    velocity_factor: float = Field(default=1.0, gt=0)
    """Ratio of the profile's velocity to the commanded velocity [-]."""
    velocity_limit_rad_s: float = Field(default=100.0, gt=0)
    """Velocity that the profile never exceeds [rad/s]."""
    acceleration_rad_s2: float = Field(default=100.0, gt=0)
    """Acceleration when speeding up and braking [rad/s2]."""
    lag_s: float = Field(default=0.0, ge=0)
    """Angle that the shaft is behind its profile over its velocity [s]."""


class ProfileState(NamedTuple):
    """State of the profile, and the commands on their way."""

    angle: Float[AnyArray, ""]
    """Angle of the profile [rad]."""
    velocity: Float[AnyArray, ""]
    """Velocity of the profile [rad/s]."""
    waiting: Command
    """Commands of the last ticks, newest first."""


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
        values = [jnp.asarray(value, jnp.float32) for _, value in config]
        self.gain, self.zero, self.delay, self.velocity_factor, self.velocity_limit, self.acceleration, self.lag = (
            values
        )

    def config(self) -> ProfileConfig:
        """The coefficients as plain numbers."""
        fields = (
            self.gain,
            self.zero,
            self.delay,
            self.velocity_factor,
            self.velocity_limit,
            self.acceleration,
            self.lag,
        )
        return ProfileConfig(**dict(zip(ProfileConfig.model_fields, map(float, fields), strict=True)))

    def start(self, motion: Motion, waiting: Command) -> ProfileState:
        """State in motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return ProfileState(motion.angle + self.lag * motion.velocity, motion.velocity, waiting)

    def step(self, state: ProfileState, command: Command) -> tuple[ProfileState, Command]:
        """Step by a tick under a new command; also returns the command that is obeyed, as the log's angles count."""
        queue = Command(*(jnp.append(new, old) for new, old in zip(command, state.waiting, strict=True)))
        obeyed = delayed(queue, self.delay)
        speed = jnp.minimum(self.velocity_factor * obeyed.velocity, self.velocity_limit)
        target = Command(self.gain * obeyed.angle + self.zero, speed)
        seconds = TICK_S / STEPS

        angle, velocity = jnp.asarray(state.angle), jnp.asarray(state.velocity)
        for _ in range(STEPS):
            after = next_velocity(angle, velocity, target, self.acceleration, seconds)
            angle, velocity = angle + seconds * (velocity + after) / 2, after
        return ProfileState(angle, velocity, Command(*(channel[:-1] for channel in queue))), target

    def motion(self, state: ProfileState) -> Motion:
        """Motion of the shaft that follows the profile."""
        return Motion(state.angle - self.lag * state.velocity, state.velocity)
