"""The drive net: commands in, the shaft's angle and velocity out, tick by tick.

Where the profile is known, the net gives only the shaft's distance from it (the fin's load, the servo, the play); where
it is not, the net gives the change of the velocity, and the angle is its integral.
"""

from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
from pydantic import PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, Command
from softfin.surrogate.streaming.core import MirrorCore, Parity, PlainCore
from softfin.surrogate.streaming.force import Motion, Scales
from softfin.surrogate.streaming.profile import Profile, ProfileConfig, ProfileState


class DriveNetConfig(Configuration):
    """Size of the drive net, and what is known of the drive beforehand."""

    units: PositiveInt = 8
    """Remembered numbers of each parity; twice as many without `mirror`."""
    hidden: PositiveInt = 16
    """Units of the layer between memory and output."""
    mirror: bool = True
    """Whether the drive goes both ways alike."""
    profile: bool = True
    """Whether the trapezoidal profile is known, and the net gives only the rest."""

    def core(self, inputs: Parity, outputs: Parity, key: PRNGKeyArray) -> MirrorCore | PlainCore:
        """Make the net's recurrent core with fresh weights."""
        kind, units = (MirrorCore, self.units) if self.mirror else (PlainCore, 2 * self.units)
        return kind(inputs, outputs, units, self.hidden, key)


class FollowingState(NamedTuple):
    """State of a `FollowingNet`."""

    profile: ProfileState
    memory: Parity
    motion: Motion


class FreeState(NamedTuple):
    """State of a `FreeNet`."""

    memory: Parity
    motion: Motion


DriveState: TypeAlias = Any
"""One of these, whichever its net takes: the type checker cannot tell which belong together."""


class FollowingNet(eqx.Module):
    """Predicts how far the shaft is from its profile; one fin, no batch axes."""

    core: MirrorCore | PlainCore
    profile: Profile
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, profile: ProfileConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = config.core(Parity(1, 3), Parity(0, 2), key)
        self.profile = Profile(profile)
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


class FreeNet(eqx.Module):
    """Predicts how the shaft's velocity changes, of a drive of which nothing is known; one fin, no batch axes."""

    core: MirrorCore | PlainCore
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = config.core(Parity(1, 2), Parity(0, 1), key)
        self.config, self.scales = config, scales

    def start(self, motion: Motion, waiting: Command) -> FreeState:
        """State in motion; the commands on their way are not used: the memory has to learn what delay there is."""
        return FreeState(self.core.blank(), motion)

    def step(self, state: FreeState, command: Command) -> FreeState:
        """Step by one tick under a command; `motion` of the new state is what the shaft has come to."""
        scales, before = self.scales, state.motion
        speed = jnp.asarray(command.velocity / scales.velocity_rad_s)[None]
        odd = jnp.stack([
            (command.angle - before.angle) / scales.angle_rad,
            before.velocity / scales.velocity_rad_s,
        ])  # fmt: skip
        memory, outputs = self.core.step(state.memory, Parity(speed, odd))
        velocity = before.velocity + scales.change_rad_s * outputs.odd[0]
        return FreeState(memory, Motion(before.angle + TICK_S * (before.velocity + velocity) / 2, velocity))


DriveNet: TypeAlias = FollowingNet | FreeNet


def drive_net(config: DriveNetConfig, profile: ProfileConfig, scales: Scales, key: PRNGKeyArray) -> DriveNet:
    """Make the net that the configuration describes, with fresh weights."""
    return FollowingNet(config, profile, scales, key) if config.profile else FreeNet(config, scales, key)
