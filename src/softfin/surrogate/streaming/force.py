"""The force net: the shaft's motion, tick by tick, in; the force on the mount out.

In the frame that turns with the shaft the angle has no effect: still water looks alike in all directions. So
the net takes rates alone and gives the force along the fin's axis (thrust, even) and across it (odd). What the water
remembers in the tank's own axes, a wake, is a few vectors that the turning frame turns back at each tick.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, AnyArray
from softfin.surrogate.streaming.core import MirrorCore, Parity, PlainCore


class ForceNetConfig(Configuration):
    """Size of the force net, and what is known of the fin beforehand."""

    units: PositiveInt = 16
    """Remembered numbers of each parity; twice as many without `mirror`."""
    hidden: PositiveInt = 32
    """Units of the layer between memory and force."""
    wake: int = Field(default=4, ge=0, le=64)
    """Vectors remembered in the tank's axes; they begin with time constants of 0.05 to 1.5 s."""
    mirror: bool = True
    """Whether the mirrored motion makes the mirrored force."""
    turning: bool = True
    """Whether the force turns with the fin: the tank is the same in all directions."""
    quasi_steady: bool = True
    """Whether a force of added mass and drag, with fitted coefficients, stands beside the net."""
    heteroscedastic: bool = False
    """Whether the net also learns the standard deviation of the force that is read."""


class Motion(NamedTuple):
    """Motion of the shaft."""

    angle: Float[AnyArray, "*shape"]
    """Angle of the shaft [rad]."""
    velocity: Float[AnyArray, "*shape"]
    """Angular velocity of the shaft [rad/s]."""


class ForceState(NamedTuple):
    """What the net carries from tick to tick."""

    memory: Parity
    wake: Parity
    """Components along and across the fin [1]."""
    motion: Motion
    """Motion of the tick before."""


class Scales(Configuration):
    """Units of the nets' inputs and outputs: standard deviations in the training logs."""

    velocity_rad_s: float = Field(gt=0)
    """Standard deviation of the shaft's velocity [rad/s]."""
    change_rad_s: float = Field(gt=0)
    """Standard deviation of the velocity's change from tick to tick [rad/s]."""
    force_n: float = Field(gt=0)
    """Root mean square of the force on both axes [N]."""
    angle_rad: float = Field(gt=0)
    """Standard deviation of the shaft's angle [rad]."""


class ForcePrediction(NamedTuple):
    """Output of the force net for one tick."""

    force: Float[AnyArray, "*shape 2"]
    """Force in the tank's axes (x, y) [N]."""
    log_std: Float[AnyArray, "*shape"]
    """Logarithm of the standard deviation of what is read, in all directions alike [force scale]; 0 if not learnt."""


class ForceNet(eqx.Module):
    """The force net of one fin; no batch axes."""

    core: MirrorCore | PlainCore
    along: Float[Array, "wake_source wake"]
    """Weights by which the memory pushes the wake along the fin."""
    across: Float[Array, "wake_source wake"]
    """Weights by which the memory pushes the wake across the fin."""
    log_time: Float[Array, "wake"]
    """Logarithm of the wake's time constants [s]."""
    thrust: Float[Array, "2"]
    """Coefficients of velocity squared and velocity times its change."""
    resistance: Float[Array, "3"]
    """Coefficients of the velocity's change (added mass), velocity times speed (drag) and velocity (friction)."""
    mount_turn: Float[Array, ""]
    """Angle of the sensor against the tank's axes [rad]."""
    offset: Float[Array, "2"]
    """What the sensor reads without force [force scale]."""
    config: ForceNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: ForceNetConfig, scales: Scales, key: PRNGKeyArray) -> None:
        inputs = Parity(config.wake + (0 if config.turning else 1), 3 + config.wake + (0 if config.turning else 1))
        outputs = Parity(1 + config.heteroscedastic, 1)
        kind, units = (MirrorCore, config.units) if config.mirror else (PlainCore, 2 * config.units)
        self.core = kind(inputs, outputs, units, config.hidden, key)
        memory = self.core.blank()
        sources = memory if config.mirror else Parity(memory.even, memory.even)
        self.along, self.across = (jnp.zeros((source.size, config.wake)) for source in sources)
        self.log_time = jnp.log(jnp.geomspace(0.05, 1.5, config.wake))
        self.thrust, self.resistance = jnp.zeros(2), jnp.zeros(3)
        self.mount_turn, self.offset = jnp.zeros(()), jnp.zeros(2)
        self.config, self.scales = config, scales

    def start(self, motion: Motion) -> ForceState:
        """State that remembers nothing but the motion of the tick before."""
        still = jnp.zeros(self.config.wake)
        return ForceState(self.core.blank(), Parity(still, still), motion)

    def step(self, state: ForceState, motion: Motion) -> tuple[ForceState, ForcePrediction]:
        """Step to the motion that the shaft has come to; predicts the force that is read with it."""
        turn, wake = motion.angle - state.motion.angle, state.wake
        velocity = motion.velocity / self.scales.velocity_rad_s
        change = (motion.velocity - state.motion.velocity) / self.scales.change_rad_s
        even, odd = [], [velocity, change, velocity * jnp.abs(velocity)]
        if self.config.turning:
            # Seen from a fin that has turned, what stands still in the tank has turned the other way.
            wake = Parity(*_turned(wake.even, wake.odd, -turn))
        else:
            even, odd = [jnp.cos(motion.angle)], [*odd, jnp.sin(motion.angle)]
        inputs = Parity(*(jnp.concatenate([jnp.asarray(own), old]) for own, old in zip((even, odd), wake, strict=True)))
        memory, outputs = self.core.step(state.memory, inputs)
        along, across = outputs.even[0], outputs.odd[0]
        if self.config.quasi_steady:
            thrust = self.thrust @ jnp.stack([velocity**2, velocity * change])
            resistance = self.resistance @ jnp.stack([change, velocity * jnp.abs(velocity), velocity])
            if not self.config.turning:
                # These two are along and across the fin whatever the net's axes are.
                thrust, resistance = _turned(thrust, resistance, motion.angle)
            along, across = along + thrust, across + resistance
        frame = self.mount_turn + (motion.angle if self.config.turning else 0.0)
        x, y = _turned(along, across, frame)
        force = self.scales.force_n * (jnp.stack([x, y]) + self.offset)
        log_std = outputs.even[1] if self.config.heteroscedastic else jnp.zeros(())
        kept = jnp.exp(-TICK_S * jnp.exp(-self.log_time))
        pushed = (memory.even @ self.along, (memory.odd if self.config.mirror else memory.even) @ self.across)
        wake = Parity(*(kept * old + (1 - kept) * new for old, new in zip(wake, pushed, strict=True)))
        return ForceState(memory, wake, motion), ForcePrediction(force, log_std)


def _turned(along: Array, across: Array, angle: AnyArray) -> tuple[Array, Array]:
    """Components along (cos, -sin) and across (sin, cos) of an angle, in the axes that the angle is counted from."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return along * cos + across * sin, across * cos - along * sin
