"""Detection of sensor channels that no longer change, e.g. because one of two load cells is dead or
saturated. Without I/O: values in, names of frozen channels out."""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

FROZEN_RECORDS = 20
"""Minimum number of consecutive equal values that counts as frozen. If the noise of a channel has a
standard deviation of one count, 20 values are equal by chance once in 3e8 records."""


class FrozenChannels:
    """Counts consecutive equal values per channel, because the other channels usually still change
    if one fails."""

    def __init__(
        self, channels: Sequence[str], longest: float, optional: Collection[str] = ()
    ) -> None:
        """A channel is frozen after `longest` consecutive equal values, but at least
        `FROZEN_RECORDS`. `optional` channels count only after two different values other than
        0, because a sensor may not measure them."""
        self._channels = np.array(channels)
        self._longest = max(longest, FROZEN_RECORDS)
        self._is_measured = ~np.isin(self._channels, list(optional))
        self._values = np.full(len(channels), np.nan)
        self._equal = np.zeros(len(channels))

    def put(self, values: Float[np.ndarray, " channels"]) -> None:
        """Register the values of a record."""
        self._equal = np.where(values == self._values, self._equal + 1, 1)
        before = np.nan_to_num(self._values)
        self._is_measured |= (before != 0) & (values != 0) & (values != before)
        self._values = values

    def names(self) -> list[str]:
        """Return the names of the frozen channels."""
        is_frozen = self._is_measured & (self._equal >= self._longest)
        names: list[str] = self._channels[is_frozen].tolist()
        return names
