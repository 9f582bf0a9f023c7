"""The drive net: commands in, the shaft's angle and velocity out, tick by tick.

Where the profile is known, the net says only how far the shaft is from it (the fin's load, the servo, the play); where
it is not, the net says the change of the velocity, and the angle is its integral.
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
    """Its size and what is known of the drive beforehand."""

    units: PositiveInt = 8
    """Remembered numbers of each parity; twice as many without `mirror`."""
    hidden: PositiveInt = 16
    """Of the layer between memory and what is said."""
    mirror: bool = True
    """Whether the drive goes both ways alike."""
    profile: bool = True
    """Whether the trapezoidal profile is known, and the net says only what is left."""

    def core(self, inputs: Parity, outputs: Parity, key: PRNGKeyArray) -> MirrorCore | PlainCore:
        """With fresh weights."""
        kind, units = (MirrorCore, self.units) if self.mirror else (PlainCore, 2 * self.units)
        return kind(inputs, outputs, units, self.hidden, key)


class FollowingState(NamedTuple):
    """What a net that follows the profile carries from tick to tick."""

    profile: ProfileState
    memory: Parity
    motion: Motion


class FreeState(NamedTuple):
    """What a net that knows no profile carries from tick to tick."""

    memory: Parity
    motion: Motion


DriveState: TypeAlias = Any
"""One of these, whichever its net takes: the type checker cannot tell which belong together."""


class FollowingNet(eqx.Module):
    """Says how far the shaft is from its profile; one fin, no batch axes."""

    core: MirrorCore | PlainCore
    profile: Profile
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, profile: ProfileConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = config.core(Parity(1, 3), Parity(0, 2), key)
        self.profile = Profile(profile)
        self.config, self.scales = config, scales

    def start(self, motion: Motion, waiting: Command) -> FollowingState:
        """In motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return FollowingState(self._follower().start(motion, waiting), self.core.blank(), motion)

    def step(self, state: FollowingState, command: Command) -> FollowingState:
        """One tick under a command; `motion` of the state that comes out is what the shaft has come to."""
        follower = self._follower()
        profile, target = follower.step(state.profile, command)
        before, now = follower.motion(state.profile), follower.motion(profile)
        velocity, change = self.scales.velocity_rad_s, self.scales.change_rad_s
        odd = jnp.stack([
            (target.angle - now.angle) / self.scales.angle_rad,
            now.velocity / velocity,
            (now.velocity - before.velocity) / change,
        ])  # fmt: skip
        memory, said = self.core.step(state.memory, Parity((target.velocity / velocity)[None], odd))
        # About a tick of what the scales say: the net is a correction.
        angle = now.angle + TICK_S * velocity * said.odd[0]
        return FollowingState(profile, memory, Motion(angle, now.velocity + change * said.odd[1]))

    def _follower(self) -> Profile:
        """Read off the logs beforehand, and not learnt: its corners make a poor slope to descend."""
        profile: Profile = jax.lax.stop_gradient(self.profile)
        return profile

    def products(self) -> int:
        """Multiplications of the matrix products of one tick."""
        return self.core.products()


class FreeNet(eqx.Module):
    """Says how the shaft's velocity changes, of a drive of which nothing is known; one fin, no batch axes."""

    core: MirrorCore | PlainCore
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = config.core(Parity(1, 2), Parity(0, 1), key)
        self.config, self.scales = config, scales

    def start(self, motion: Motion, waiting: Command) -> FreeState:
        """In motion; the commands on their way are not used: the memory has to learn what delay there is."""
        return FreeState(self.core.blank(), motion)

    def step(self, state: FreeState, command: Command) -> FreeState:
        """One tick under a command; `motion` of the state that comes out is what the shaft has come to."""
        scales, before = self.scales, state.motion
        speed = jnp.asarray(command.velocity / scales.velocity_rad_s)[None]
        odd = jnp.stack([
            (command.angle - before.angle) / scales.angle_rad,
            before.velocity / scales.velocity_rad_s,
        ])  # fmt: skip
        memory, said = self.core.step(state.memory, Parity(speed, odd))
        velocity = before.velocity + scales.change_rad_s * said.odd[0]
        return FreeState(memory, Motion(before.angle + TICK_S * (before.velocity + velocity) / 2, velocity))

    def products(self) -> int:
        """Multiplications of the matrix products of one tick."""
        return self.core.products()


DriveNet: TypeAlias = FollowingNet | FreeNet


def drive_net(config: DriveNetConfig, profile: ProfileConfig, scales: Scales, key: PRNGKeyArray) -> DriveNet:
    """Of the kind that the configuration says, with fresh weights."""
    return FollowingNet(config, profile, scales, key) if config.profile else FreeNet(config, scales, key)
