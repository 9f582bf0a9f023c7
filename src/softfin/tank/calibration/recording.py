"""How a log's commands and readings relate to those of a tank: gains, offsets and units of the recording itself.

In the tank a command of 1 rad at 2 rad/s means that. Where a log says otherwise, because of another unit, an encoder's
zero or a sensor's offset, the difference belongs here, and never to the tank.
"""

from typing import NamedTuple

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
    """Reading of the force sensor along x without force [N]."""
    force_y_n: float = 0.0
    """Reading of the force sensor along y without force [N]."""


class Recording(NamedTuple):
    """A recording's configuration as arrays, so that recordings can be stacked beside tanks."""

    angle_gain: Float[Array, "*models"]
    angle_offset: Float[Array, "*models"]
    velocity_factor: Float[Array, "*models"]
    velocity_limit: Float[Array, "*models"]
    reading_gain: Float[Array, "*models"]
    reading_offset: Float[Array, "*models"]
    force_x: Float[Array, "*models"]
    force_y: Float[Array, "*models"]

    @classmethod
    def build(cls, config: RecordingConfig) -> "Recording":
        """Return the arrays of a configuration, whose fields are in the same order."""
        return cls(*(jnp.asarray(value, float) for value in config.model_dump().values()))

    def issued(self, command: Command) -> Command:
        """What a tank must be told where the log has `command`."""
        angle = self.angle_gain * command.angle + self.angle_offset
        return Command(angle, jnp.minimum(self.velocity_factor * command.velocity, self.velocity_limit))

    def written(self, reading: Reading) -> Reading:
        """What the log has where a tank reads `reading`."""
        return reading._replace(
            angle=self.reading_gain * reading.angle + self.reading_offset,
            velocity=self.reading_gain * reading.velocity,
            force=reading.force + jnp.stack([self.force_x, self.force_y]),
        )
