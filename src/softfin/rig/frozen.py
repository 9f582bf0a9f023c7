"""Detection of sensor channels that no longer change, e.g. because one of two load cells is dead or
saturated. Without I/O: values in, names of frozen channels out."""

from collections.abc import Collection, Sequence

FROZEN_RECORDS = 20
"""Minimum number of consecutive equal values that counts as frozen. If the noise of a channel has a
standard deviation of one count, 20 values are equal by chance once in 3e8 records."""


class FrozenChannels:
    """Record of how long each channel of a sensor has had its present value.

    Channels are counted separately, because the others usually still change if one of them fails.
    """

    def __init__(
        self, channels: Sequence[str], longest_s: float, optional: Collection[str] = ()
    ) -> None:
        """A channel that stays constant for `longest_s` [s] is frozen. `optional` channels count
        only once they have changed, because a sensor may lack them."""
        self._channels = channels
        self._longest_s = longest_s
        self._unchanged = {channel for channel in channels if channel in optional}
        self._time = 0.0
        """Time of the latest record [s]."""
        self._values: Sequence[float] | None = None
        self._since = [0.0] * len(channels)
        """Time of the first record with the present value [s], for each channel."""
        self._records = [0] * len(channels)
        """Number of consecutive records with the present value, for each channel."""

    def put(self, values: Sequence[float], time: float) -> None:
        """Register the values of a record and its time [s]."""
        before = self._values
        for index, value in enumerate(values):
            if before is None or value != before[index]:
                self._since[index] = time
                self._records[index] = 0
                if before is not None:
                    self._unchanged.discard(self._channels[index])
            self._records[index] += 1
        self._values = values
        self._time = time

    def names(self) -> list[str]:
        """Return the names of the frozen channels."""
        return [
            channel
            for channel, since, records in zip(
                self._channels, self._since, self._records, strict=True
            )
            if channel not in self._unchanged
            and records >= FROZEN_RECORDS
            and self._time - since >= self._longest_s
        ]
