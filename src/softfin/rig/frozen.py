"""Detection of sensor channels that no longer change, e.g. because one of two load cells is dead or
saturated. This module has no I/O."""

import numpy as np
from jaxtyping import Float

from softfin.rig.machine import WRENCH_CHANNELS

FROZEN_RECORDS = 20
"""Minimum number of consecutive equal values at which a channel is treated as frozen. If the noise
of a channel has a standard deviation of one count, 20 values are equal by chance once in 3e8
records."""


class FrozenChannels:
    """Counts consecutive equal values per channel, because the other channels usually still change
    if one channel fails."""

    def __init__(self, longest: float) -> None:
        """Start counting. A channel is frozen after `longest` consecutive equal values, but at
        least `FROZEN_RECORDS`. Channels other than the x and y forces are checked only after two
        different non-zero values, because the sensor may not measure them."""
        self._longest = max(longest, FROZEN_RECORDS)
        self._is_measured = np.arange(6) < 2
        self._values = np.full(6, np.nan)
        self._equal = np.zeros(6)

    def put(self, values: Float[np.ndarray, " channels"]) -> None:
        """Register the values of a record."""
        self._equal = np.where(values == self._values, self._equal + 1, 1)
        before = np.nan_to_num(self._values)
        self._is_measured |= (before != 0) & (values != 0) & (values != before)
        self._values = values

    def names(self) -> list[str]:
        """Return the names of the frozen channels."""
        is_frozen = self._is_measured & (self._equal >= self._longest)
        return [WRENCH_CHANNELS[index] for index in np.flatnonzero(is_frozen)]
