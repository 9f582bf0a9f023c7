"""The force net: the shaft's motion, tick by tick, in; the force on the mount out.

In the frame that turns with the shaft the angle has no effect: still water looks alike in all directions. So
the net takes rates alone and gives the force along the fin's axis (thrust, even) and across it (odd). What the water
remembers in the tank's own axes, a wake, is a few vectors that the turning frame turns back at each tick.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, AnyArray
from softfin.surrogate.streaming.core import MirrorCore, Parity


class ForceNetConfig(Configuration):
    """Size of the force net, and what is built into it; the latter cannot be changed, but names the net's structure."""

    units: PositiveInt = 16
    """Remembered numbers of each parity."""
    hidden: PositiveInt = 32
    """Units of the layer between memory and force."""
    wake: int = Field(default=4, ge=0, le=64)
    """Vectors remembered in the tank's axes; they begin with time constants of 0.05 to 1.5 s."""
    mirror: Literal[True] = True
    """The mirrored motion makes the mirrored force."""
    turning: Literal[True] = True
    """The force turns with the fin: the tank is the same in all directions."""
    quasi_steady: Literal[True] = True
    """A force of added mass and drag, with fitted coefficients, stands beside the net."""
    heteroscedastic: Literal[False] = False
    """The net does not learn how far readings scatter about its force."""


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


class ForceNet(eqx.Module):
    """The force net of one fin; no batch axes."""

    core: MirrorCore
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
        self.core = MirrorCore(Parity(config.wake, 3 + config.wake), Parity(1, 1), config.units, config.hidden, key)
        self.along, self.across = (jnp.zeros((config.units, config.wake)) for _ in range(2))
        self.log_time = jnp.log(jnp.geomspace(0.05, 1.5, config.wake))
        self.thrust, self.resistance = jnp.zeros(2), jnp.zeros(3)
        self.mount_turn, self.offset = jnp.zeros(()), jnp.zeros(2)
        self.config, self.scales = config, scales

    def start(self, motion: Motion) -> ForceState:
        """State that remembers nothing but the motion of the tick before."""
        still = jnp.zeros(self.config.wake)
        return ForceState(self.core.blank(), Parity(still, still), motion)

    def step(self, state: ForceState, motion: Motion) -> tuple[ForceState, Float[Array, "2"]]:
        """Step to the motion that the shaft has come to; predicts the force (x, y) that is read with it [N]."""
        # Seen from a fin that has turned, what stands still in the tank has turned the other way.
        wake = Parity(*_turned(state.wake.even, state.wake.odd, state.motion.angle - motion.angle))
        velocity = motion.velocity / self.scales.velocity_rad_s
        change = (motion.velocity - state.motion.velocity) / self.scales.change_rad_s
        drag = velocity * jnp.abs(velocity)
        rates = jnp.stack([velocity, change, drag])
        memory, outputs = self.core.step(state.memory, Parity(wake.even, jnp.concatenate([rates, wake.odd])))
        along = outputs.even[0] + self.thrust @ jnp.stack([velocity**2, velocity * change])
        across = outputs.odd[0] + self.resistance @ jnp.stack([change, drag, velocity])
        x, y = _turned(along, across, self.mount_turn + motion.angle)
        force = self.scales.force_n * (jnp.stack([x, y]) + self.offset)
        kept = jnp.exp(-TICK_S * jnp.exp(-self.log_time))
        pushed = (memory.even @ self.along, memory.odd @ self.across)
        wake = Parity(*(kept * old + (1 - kept) * new for old, new in zip(wake, pushed, strict=True)))
        return ForceState(memory, wake, motion), force


def _turned(along: Array, across: Array, angle: AnyArray) -> tuple[Array, Array]:
    """Components along (cos, -sin) and across (sin, cos) of an angle, in the axes that the angle is counted from."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return along * cos + across * sin, across * cos - along * sin
