"""The drive net: commands in, the shaft's angle and velocity out, tick by tick.

A positioning drive obeys a command by a trapezoidal profile, with coefficients that are read off the logs: the profile
itself is the drive's (`softfin.tank.drive`); gains, zero, delay and the drive's own limits are the log's. The net gives
only the shaft's distance from it: the fin's load, the servo, the play.
"""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, AnyArray, Command
from softfin.surrogate.streaming.core import MirrorCore, Parity
from softfin.surrogate.streaming.force import Motion, Scales
from softfin.tank.drive import delayed, next_velocity

LONGEST_DELAY = 20
"""Longest delay from a command to the motion that obeys it [ticks]."""

STEPS = 2
"""Steps of the profile in a tick: a corner between two ticks is met within 5 ms."""


class DriveNetConfig(Configuration):
    """Size of the drive net, and what is built into it; the latter cannot be changed, but names the net's structure."""

    units: PositiveInt = 8
    """Remembered numbers of each parity."""
    hidden: PositiveInt = 16
    """Units of the layer between memory and output."""
    mirror: Literal[True] = True
    """The drive goes both ways alike."""
    profile: Literal[True] = True
    """The trapezoidal profile is known, and the net gives only the rest."""


class ProfileState(NamedTuple):
    """State of the profile, and the commands on their way."""

    angle: Float[AnyArray, ""]
    """Angle of the profile [rad]."""
    velocity: Float[AnyArray, ""]
    """Velocity of the profile [rad/s]."""
    waiting: Command
    """Commands of the last ticks, newest first."""


def _coefficient(default: float) -> Any:
    return eqx.field(default=default, converter=lambda value: jnp.asarray(value, jnp.float32))


class Profile(eqx.Module):
    """Angle and velocity of a drive that follows its profile; by default one that does what it is told."""

    gain: Float[Array, ""] = _coefficient(1.0)
    """Ratio of the angle that is read to the angle that was commanded [-]."""
    zero: Float[Array, ""] = _coefficient(0.0)
    """Angle that is read where 0 was commanded [rad]."""
    delay: Float[Array, ""] = _coefficient(0.0)
    """Ticks from a command to the first that obeys it, at most `LONGEST_DELAY` [10 ms]."""
    velocity_factor: Float[Array, ""] = _coefficient(1.0)
    """Ratio of the profile's velocity to the commanded velocity [-]."""
    velocity_limit: Float[Array, ""] = _coefficient(100.0)
    """Velocity that the profile never exceeds [rad/s]."""
    acceleration: Float[Array, ""] = _coefficient(100.0)
    """Acceleration when speeding up and braking [rad/s2]."""
    lag: Float[Array, ""] = _coefficient(0.0)
    """Angle that the shaft is behind its profile over its velocity [s]."""

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


class FollowingState(NamedTuple):
    """What the net carries from tick to tick."""

    profile: ProfileState
    memory: Parity
    motion: Motion


class FollowingNet(eqx.Module):
    """Predicts how far the shaft is from its profile; one fin, no batch axes."""

    core: MirrorCore
    profile: Profile
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = MirrorCore(Parity(1, 3), Parity(0, 2), config.units, config.hidden, key)
        self.profile = Profile()
        self.config, self.scales = config, scales

    def start(self, motion: Motion, waiting: Command) -> FollowingState:
        """State in motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return FollowingState(self._fixed_profile().start(motion, waiting), self.core.blank(), motion)

    def step(self, state: FollowingState, command: Command) -> FollowingState:
        """Step by one tick under a command; `motion` of the new state is what the shaft has come to."""
        fixed = self._fixed_profile()
        profile, target = fixed.step(state.profile, command)
        before, now = fixed.motion(state.profile), fixed.motion(profile)
        velocity, change = self.scales.velocity_rad_s, self.scales.change_rad_s
        odd = jnp.stack([
            (target.angle - now.angle) / self.scales.angle_rad,
            now.velocity / velocity,
            (now.velocity - before.velocity) / change,
        ])  # fmt: skip
        memory, outputs = self.core.step(state.memory, Parity((target.velocity / velocity)[None], odd))
        # Outputs of 1 move the shaft by about a tick's motion: the net is a correction.
        angle = now.angle + TICK_S * velocity * outputs.odd[0]
        return FollowingState(profile, memory, Motion(angle, now.velocity + change * outputs.odd[1]))

    def _fixed_profile(self) -> Profile:
        """The profile, identified beforehand and not learnt: its corners make a poor slope to descend."""
        profile: Profile = jax.lax.stop_gradient(self.profile)
        return profile
