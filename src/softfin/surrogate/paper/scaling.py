"""Min-max scaling of named channels: ``scaled = x * scale + offset``; numbers, kept with the weights."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, LogError
from softfin.core.quantities import AnyArray


class ChannelScaling(Configuration):
    """Of one channel."""

    scale: float = Field(gt=0, allow_inf_nan=False)
    offset: float = Field(allow_inf_nan=False)
    data_min: float = Field(allow_inf_nan=False)
    """Least value in the training data, in the channel's unit."""
    data_max: float = Field(allow_inf_nan=False)
    """Greatest value in the training data."""


class Scaling(Configuration):
    """Of every channel that a surrogate sees or says."""

    channels: dict[str, ChannelScaling]

    def __hash__(self) -> int:
        return hash(tuple(self.channels.items()))

    @classmethod
    def fit(cls, data: Mapping[str, Float[np.ndarray, "rows"]]) -> "Scaling":
        """Each channel's range in the training data onto 0 .. 1."""
        channels = {}
        for name, values in data.items():
            low, high = float(values.min()), float(values.max())
            if not high > low:
                raise LogError(f"column {name} is {low:g} in every training row: nothing can be learnt from it")
            scale = 1 / (high - low)
            channels[name] = ChannelScaling(scale=scale, offset=-low * scale, data_min=low, data_max=high)
        return cls(channels=channels)

    def require(self, names: Sequence[str], source: str) -> None:
        """Raise ArtifactError where a channel has no scaling."""
        for name in names:
            if name not in self.channels:
                raise ArtifactError(f"{source}: no scaling for {name}; there is one for {', '.join(self.channels)}")

    def scaled(self, name: str, values: AnyArray) -> Any:
        """From the channel's unit."""
        return values * self.channels[name].scale + self.channels[name].offset

    def physical(self, names: Sequence[str], scaled: Float[Array, "*shape {len(names)}"]) -> Array:
        """Back to the channels' units; the last axis runs over `names`."""
        scale = jnp.asarray([self.channels[name].scale for name in names], jnp.float32)
        offset = jnp.asarray([self.channels[name].offset for name in names], jnp.float32)
        return (scaled - offset) / scale
