"""The input and output channels of surrogates, by name: their scaling (``scaled = x * scale +
offset``) and their training range.

Every controller trained in a surrogate stores the training range and the fin's name. A rig rejects
controllers for other fins, and stops a controller far outside its training data.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
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
"""Channels of the paper's networks: the inputs of ForceNet, which include PosNet's, then its
outputs."""

SKIPPED = 100
"""Number of rows at the start of a log that Table I does not score: the first window of PosNet and
ForceNet."""

UNKNOWN: Mapping[str, None] = {"training_range": None, "fin": None}
"""Entries for plants that are not surrogates, and for surrogates without this information."""


class NetPrediction(NamedTuple):
    """Predictions of a network for several logs; one row of Table I."""

    title: str
    """Network and its inputs."""
    channels: tuple[str, ...]
    series: Sequence[Float[np.ndarray, "predicted channels"]]
    """Predictions for each log [rad or N]; the first rows of a log may have none."""
    window: int | None
    """Number of past samples in the input; None for recurrent networks."""
    parameters: int
    """Number of trainable parameters."""


class ChannelScaling(Configuration):
    """Scaling of one channel."""

    scale: float = Field(gt=0)
    offset: float
    data_min: float
    """Minimum of the training data, in the unit of the channel."""
    data_max: float
    """Maximum of the training data, in the unit of the channel."""


class Scaling(Configuration):
    """Scaling of each channel of the paper's networks."""

    channels: dict[str, ChannelScaling]

    # A static field of a JAX module must be hashable, and a dictionary is not.
    def __hash__(self) -> int:
        return hash(tuple(self.channels.items()))

    @classmethod
    def fit(cls, logs: Sequence[Log]) -> "Scaling":
        """Return the scaling that maps the range of each channel in the training logs to [0, 1].

        Raises:
            LogError: a channel never changes.
        """
        channels = {}
        for name, (low, high) in ranges(logs, COLUMNS).items():
            # Also true for NaN.
            if not high > low:
                raise LogError(
                    f"training logs: column {name} is {low:g} in every row, so no network can be "
                    "fitted to it; use logs in which it changes"
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
                    f"{source}: missing scaling for {name}; found scaling for "
                    f"{', '.join(self.channels)}"
                )

    def scaled(self, name: str, values: AnyArray) -> Any:
        """Return the scaled values of a channel."""
        return values * self.channels[name].scale + self.channels[name].offset

    def physical(self, names: Sequence[str], scaled: Float[AnyArray, "*shape {len(names)}"]) -> Any:
        """Convert scaled values back to the units of the channels `names`."""
        scale = np.asarray([self.channels[name].scale for name in names], np.float32)
        offset = np.asarray([self.channels[name].offset for name in names], np.float32)
        return (scaled - offset) / scale

    def table(self, names: Sequence[str], log: Log) -> Float[np.ndarray, "rows {len(names)}"]:
        """Return the scaled values of the channels `names` of a log, as float32."""
        columns = to_columns([log])
        return np.stack(
            [self.scaled(name, columns[name]) for name in names], axis=1, dtype=np.float32
        )


def to_columns(logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "rows"]]:
    """Concatenate logs and return their columns by channel name, as float32."""
    return dict(zip((*COMMAND_COLUMNS, *READINGS), stack_channels(logs), strict=True))


def stack_channels(logs: Sequence[Log]) -> Float[np.ndarray, "channels rows"]:
    """Concatenate `Log.columns` of all logs, as float32."""
    return np.concatenate([np.stack(log.columns) for log in logs], axis=1, dtype=np.float32)


def ranges(logs: Sequence[Log], names: Sequence[str] = READINGS) -> dict[str, list[float]]:
    """Return the minimum and maximum of the channels `names` over all logs.

    For the readings of the training logs, this is the training range of a surrogate.
    """
    columns = to_columns(logs)
    return {name: [float(columns[name].min()), float(columns[name].max())] for name in names}


def learnt_from(plant: object) -> JsonObject:
    """Return ``training_range`` and ``fin`` of the surrogate in the folder `plant`; each is None if
    unknown."""
    if not isinstance(plant, str | Path) or not artifacts.is_kind(Path(plant), "surrogate"):
        return dict(UNKNOWN)
    description = artifacts.load_description(Path(plant), "surrogate")
    entries = {name: description.get(name) for name in UNKNOWN}
    # For imported surrogates, only the scaling contains the range of the channels.
    if entries["training_range"] is None and (scaling := description.get("scaling")):
        training_range = {}
        for name in READINGS:
            channel = scaling.get(name)
            training_range[name] = channel and [channel["data_min"], channel["data_max"]]
        entries["training_range"] = training_range
    return entries
