"""The channels that surrogates take and give, by name, and their min-max scaling: ``scaled = x * scale + offset``."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, LogError
from softfin.core.quantities import AnyArray, Log

COMMANDS = ("command_angle_rad", "command_velocity_rad_s")
ANGLE = "angle_rad"
FORCES = ("force_x_n", "force_y_n")


class ChannelScaling(Configuration):
    """Scaling of one channel."""

    scale: float = Field(gt=0, allow_inf_nan=False)
    offset: float = Field(allow_inf_nan=False)
    data_min: float = Field(allow_inf_nan=False)
    """Least value in the training data, in the channel's unit."""
    data_max: float = Field(allow_inf_nan=False)
    """Greatest value in the training data."""


class Scaling(Configuration):
    """Scaling of every channel of the paper's nets."""

    channels: dict[str, ChannelScaling]

    def __hash__(self) -> int:
        return hash(tuple(self.channels.items()))

    @classmethod
    def fit(cls, logs: Sequence[Log]) -> "Scaling":
        """Map each channel's range in the training logs onto 0 .. 1."""
        channels = {}
        for name, values in joined_channels(logs).items():
            low, high = float(values.min()), float(values.max())
            if not high > low:
                raise LogError(f"column {name} is {low:g} in every training row: nothing can be learnt from it")
            scale = 1 / (high - low)
            channels[name] = ChannelScaling(scale=scale, offset=-low * scale, data_min=low, data_max=high)
        return cls(channels=channels)

    def require(self, source: str) -> None:
        """Raise ArtifactError where a channel of the paper's nets has no scaling."""
        for name in (ANGLE, *COMMANDS, *FORCES):
            if name not in self.channels:
                raise ArtifactError(f"{source}: no scaling for {name}; there is one for {', '.join(self.channels)}")

    def scaled(self, name: str, values: AnyArray) -> Any:
        """Scale values in the channel's unit."""
        return values * self.channels[name].scale + self.channels[name].offset

    def physical(self, names: Sequence[str], scaled: Float[Array, "*shape {len(names)}"]) -> Array:
        """Take scaled values back to the channels' units; the last axis runs over `names`."""
        scale = jnp.asarray([self.channels[name].scale for name in names], jnp.float32)
        offset = jnp.asarray([self.channels[name].offset for name in names], jnp.float32)
        return (scaled - offset) / scale

    def table(self, names: Sequence[str], log: Log) -> Float[np.ndarray, "rows {len(names)}"]:
        """Some columns of a log, scaled, float32."""
        columns = channels_of(log)
        return np.stack([self.scaled(name, columns[name]) for name in names], axis=1).astype(np.float32)


def channels_of(log: Log) -> dict[str, Float[np.ndarray, "rows"]]:
    """The columns of a log by the names of the channels."""
    columns = (log.reading.angle, *log.command, *np.asarray(log.reading.force).T)
    names = (ANGLE, *COMMANDS, *FORCES)
    return {name: np.asarray(values, np.float32) for name, values in zip(names, columns, strict=True)}


def joined_channels(logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "rows"]]:
    """The columns of all logs, one log after the other."""
    each = [channels_of(log) for log in logs]
    return {name: np.concatenate([columns[name] for columns in each]) for name in each[0]}
