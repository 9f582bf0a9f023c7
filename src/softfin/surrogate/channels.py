"""The channels that surrogates take and give, by name: scaling (``scaled = x * scale + offset``), and training range.

The range of a surrogate's training data and the fin they are of go into every controller trained in it: a rig tells by
the range how far its fin is from the training data, and by the name that a controller is for another.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, LogError
from softfin.core.quantities import AnyArray, Limits, Log
from softfin.storage import artifact as artifacts

COMMANDS = ("command_angle_rad", "command_velocity_rad_s")
ANGLE = "angle_rad"
FORCES = ("force_x_n", "force_y_n")
READINGS = (ANGLE, "velocity_rad_s", *FORCES)

SKIPPED = 100
"""Rows at the beginning of a log that Table I does not score: the first window of PosNet and ForceNet."""

Range: TypeAlias = dict[str, list[float] | None]
"""Least and greatest of each channel; None where that is not known."""

UNKNOWN: Mapping[str, Any] = {"training_range": None, "fin": None}
"""Entries of a plant that is not a surrogate, or one without them."""


class NetPrediction(NamedTuple):
    """What a net predicts of the last rows of a log: a row of Table I."""

    channels: tuple[str, ...]
    series: Float[np.ndarray, "predicted channels"]
    """Predicted values [rad or N]."""
    window: int | None
    """Samples of the past that the net sees; None of one with a state."""
    parameters: int
    """Trainable numbers of the net."""


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


def training_range(logs: Sequence[Log]) -> Range:
    """Range of the readings in the logs that a surrogate learns from."""
    columns = joined_channels(logs) | {READINGS[1]: np.concatenate([log.reading.velocity for log in logs])}
    return {name: [float(columns[name].min()), float(columns[name].max())] for name in READINGS}


def command_limits(logs: Sequence[Log]) -> Limits:
    """Range of the commands in the logs: the limits of a surrogate that learns from them."""
    columns = joined_channels(logs)
    return Limits(*(float(end) for name in COMMANDS for end in (columns[name].min(), columns[name].max())))


def learnt_from(plant: object) -> dict[str, Any]:
    """``training_range`` and ``fin`` of a surrogate's folder, where `plant` names one that has them; else unknown.

    Surrogates with min-max scaling, imported ones among them, have kept the range of their channels in it.
    """
    folder = Path(plant) if isinstance(plant, str | Path) else None
    if folder is None or not artifacts.is_kind(folder, "surrogate"):
        return dict(UNKNOWN)
    description = artifacts.load_description(folder, "surrogate")
    entries = {name: description.get(name) for name in UNKNOWN}
    scaling = description.get("scaling")
    if entries["training_range"] is None and isinstance(scaling, dict):
        channels = {name: scaling.get(name) for name in READINGS}
        entries["training_range"] = {
            name: [channel["data_min"], channel["data_max"]] if isinstance(channel, dict) else None
            for name, channel in channels.items()
        }
    return entries
