"""The drive net: commands in, the shaft's angle and velocity out, tick by tick.

Where the profile is known, the net says only how far the shaft is from it (the fin's load, the servo, the play); where
it is not, the net says the change of the velocity, and the angle is its integral.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
from pydantic import PositiveInt

from softfin.configuration import Configuration
from softfin.quantities import TICK_S, Command
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


class DriveState(NamedTuple):
    """What the net carries from tick to tick."""

    profile: ProfileState
    memory: Parity
    motion: Motion


class DriveNet(eqx.Module):
    """See the module; one fin, no batch axes."""

    core: MirrorCore | PlainCore
    profile: Profile
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, profile: ProfileConfig, scales: Scales, key: PRNGKeyArray) -> None:
        kind, units = (MirrorCore, config.units) if config.mirror else (PlainCore, 2 * config.units)
        outputs = Parity(0, 2 if config.profile else 1)
        self.core = kind(Parity(1, 3), outputs, units, config.hidden, key)
        self.profile = Profile(profile)
        self.config, self.scales = config, scales

    def start(self, motion: Motion, waiting: Command) -> DriveState:
        """In motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return DriveState(self.profile.start(motion, waiting), self.core.blank(), motion)

    def step(self, state: DriveState, command: Command) -> DriveState:
        """One tick under a command; `motion` of the state that comes out is what the shaft has come to."""
        # Read off the logs beforehand: its corners make a poor slope to descend.
        follower = jax.lax.stop_gradient(self.profile)
        profile, target = follower.step(state.profile, command)
        before, now = follower.motion(state.profile), follower.motion(profile)
        if not self.config.profile:
            before = now = state.motion
        velocity, change = self.scales.velocity_rad_s, self.scales.change_rad_s
        odd = jnp.stack([
            (target.angle - now.angle) / self.scales.angle_rad,
            now.velocity / velocity,
            (now.velocity - before.velocity) / change,
        ])  # fmt: skip
        memory, said = self.core.step(state.memory, Parity((target.velocity / velocity)[None], odd))
        if self.config.profile:
            # About a tick of what the scales say: the net is a correction.
            angle = now.angle + TICK_S * velocity * said.odd[0]
            return DriveState(profile, memory, Motion(angle, now.velocity + change * said.odd[1]))
        fresh = now.velocity + change * said.odd[0]
        return DriveState(profile, memory, Motion(now.angle + TICK_S * (now.velocity + fresh) / 2, fresh))

    def products(self) -> int:
        """Multiplications of the matrix products of one tick."""
        return self.core.products()
