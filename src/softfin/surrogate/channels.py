"""The input and output channels of surrogates, by name: scaling (``scaled = x * scale + offset``),
and training range.

The range and the name of the fin are stored in every controller trained in a surrogate: a rig
refuses a controller for another fin, and stops one far outside its training data.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.quantities import AnyArray, Log
from softfin.storage import artifact as artifacts

COMMAND_COLUMNS = ("command_angle_rad", "command_velocity_rad_s")
ANGLE = "angle_rad"
FORCES = ("force_x_n", "force_y_n")
READINGS = (ANGLE, "velocity_rad_s", *FORCES)
COLUMNS = (ANGLE, *COMMAND_COLUMNS, *FORCES)
"""Channels of the paper's networks: first ForceNet's inputs, which include PosNet's, then
ForceNet's outputs."""

SKIPPED = 100
"""Rows at the start of a log that are not scored in Table I: the first window of PosNet and
ForceNet."""

UNKNOWN: Mapping[str, Any] = {"training_range": None, "fin": None}
"""Entries for a plant that is not a surrogate, or a surrogate without them."""


class NetPrediction(NamedTuple):
    """Predictions of a network for logs: a row of Table I."""

    channels: tuple[str, ...]
    series: Sequence[Float[np.ndarray, "predicted channels"]]
    """Predicted values of the last rows of each log [rad or N]."""
    window: int | None
    """Number of past samples that the network sees; None for a network with a state."""
    parameters: int


class ChannelScaling(Configuration):
    """Scaling of one channel."""

    scale: float = Field(gt=0)
    offset: float
    data_min: float
    """Smallest value in the training data, in the channel's unit."""
    data_max: float
    """Largest value in the training data."""


class Scaling(Configuration):
    """Scaling of every channel of the paper's networks."""

    channels: dict[str, ChannelScaling]

    def __hash__(self) -> int:
        return hash(tuple(self.channels.items()))

    @classmethod
    def fit(cls, logs: Sequence[Log]) -> "Scaling":
        """Build the scaling that maps each channel's range in the training logs onto 0 .. 1."""
        channels = {}
        for name, (low, high) in ranges(logs, COLUMNS).items():
            if not high > low:
                raise LogError(
                    f"column {name} is {low:g} in every training row: no network can be fitted to "
                    "it"
                )
            scale = 1 / (high - low)
            channels[name] = ChannelScaling(
                scale=scale, offset=-low * scale, data_min=low, data_max=high
            )
        return cls(channels=channels)

    def require(self, source: str) -> None:
        """Raise ArtifactError if a channel of the paper's networks has no scaling."""
        for name in COLUMNS:
            if name not in self.channels:
                raise ArtifactError(
                    f"{source}: no scaling for {name}; there is one for {', '.join(self.channels)}"
                )

    def scaled(self, name: str, values: AnyArray) -> Any:
        """Scale values given in the channel's unit."""
        return values * self.channels[name].scale + self.channels[name].offset

    def physical(self, names: Sequence[str], scaled: Float[Array, "*shape {len(names)}"]) -> Array:
        """Convert scaled values back to the channels' units; the last axis runs over `names`."""
        scale = jnp.asarray([self.channels[name].scale for name in names], jnp.float32)
        offset = jnp.asarray([self.channels[name].offset for name in names], jnp.float32)
        return (scaled - offset) / scale

    def table(self, names: Sequence[str], log: Log) -> Float[np.ndarray, "rows {len(names)}"]:
        """Return some columns of a log, scaled, as float32."""
        columns = to_columns([log])
        return np.stack(
            [self.scaled(name, columns[name]) for name in names], axis=1, dtype=np.float32
        )


def to_columns(logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "rows"]]:
    """Return the columns of logs, one log after the other, by channel name."""
    return dict(zip((*COMMAND_COLUMNS, *READINGS), stack_channels(logs), strict=True))


def stack_channels(logs: Sequence[Log]) -> Float[np.ndarray, "channels rows"]:
    """Return `Log.channels` of logs, one log after the other, as float32."""
    return np.concatenate([np.stack(log.channels) for log in logs], axis=1, dtype=np.float32)


def ranges(logs: Sequence[Log], names: Sequence[str] = READINGS) -> dict[str, list[float]]:
    """Return the smallest and largest value of some channels in logs; for the readings this is the
    training range of a surrogate."""
    columns = to_columns(logs)
    return {name: [float(columns[name].min()), float(columns[name].max())] for name in names}


def learnt_from(plant: object) -> JsonObject:
    """``training_range`` and ``fin`` of a surrogate's folder, if `plant` names one that has them;
    otherwise unknown."""
    if not isinstance(plant, str | Path) or not artifacts.is_kind(Path(plant), "surrogate"):
        return dict(UNKNOWN)
    description = artifacts.load_description(Path(plant), "surrogate")
    entries = {name: description.get(name) for name in UNKNOWN}
    # Imported surrogates contain the range of their channels in their scaling.
    if entries["training_range"] is None and (scaling := description.get("scaling")):
        training_range = {}
        for name in READINGS:
            channel = scaling.get(name)
            training_range[name] = channel and [channel["data_min"], channel["data_max"]]
        entries["training_range"] = training_range
    return entries
