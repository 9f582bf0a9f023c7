"""How a log's commands and readings relate to those of a tank: gains, offsets and units of the recording itself.

In the tank a command of 1 rad at 2 rad/s means that. Where a log says otherwise, because of another unit, an encoder's
zero or a sensor's offset, the difference belongs here, and never to the tank.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.quantities import Command, Reading


class RecordingConfig(Configuration):
    """By default a log means what it says."""

    angle_gain: float = Field(1.0, gt=0)
    """Target angle over commanded angle [-]."""
    angle_offset_rad: float = 0.0
    """Target angle where the command is 0 [rad]."""
    velocity_factor: float = Field(1.0, gt=0)
    """Profile velocity over commanded velocity [-]: the unit of the log."""
    velocity_limit_rad_s: float = Field(12.5, gt=0)
    """Profile velocity that the recorded drive never exceeds, whatever it is told [rad/s]."""
    reading_gain: float = Field(1.0, gt=0)
    """Angle in the log over angle of the shaft [-]; its velocity likewise."""
    reading_offset_rad: float = 0.0
    """Angle in the log where the shaft stands at 0 [rad]: the encoder's zero."""
    force_x_n: float = 0.0
    """Reading of the force sensor without force [N]."""
    force_y_n: float = 0.0
    """Likewise [N]."""


class Recording(eqx.Module):
    """The same as arrays, so that recordings can be stacked beside tanks."""

    angle_gain: Float[Array, ""]
    angle_offset: Float[Array, ""]
    velocity_factor: Float[Array, ""]
    velocity_limit: Float[Array, ""]
    reading_gain: Float[Array, ""]
    reading_offset: Float[Array, ""]
    force: Float[Array, "2"]

    def __init__(self, config: RecordingConfig):
        self.angle_gain = jnp.asarray(config.angle_gain)
        self.angle_offset = jnp.asarray(config.angle_offset_rad)
        self.velocity_factor = jnp.asarray(config.velocity_factor)
        self.velocity_limit = jnp.asarray(config.velocity_limit_rad_s)
        self.reading_gain = jnp.asarray(config.reading_gain)
        self.reading_offset = jnp.asarray(config.reading_offset_rad)
        self.force = jnp.asarray([config.force_x_n, config.force_y_n])

    def issued(self, command: Command) -> Command:
        """What a tank must be told where the log has `command`."""
        angle = self.angle_gain * command.angle + self.angle_offset
        return Command(angle, jnp.minimum(self.velocity_factor * command.velocity, self.velocity_limit))

    def written(self, reading: Reading) -> Reading:
        """What the log has where a tank reads `reading`."""
        return reading._replace(
            angle=self.reading_gain * reading.angle + self.reading_offset,
            velocity=self.reading_gain * reading.velocity,
            force=reading.force + self.force,
        )
