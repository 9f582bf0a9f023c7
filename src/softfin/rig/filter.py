"""The anti-alias filter between a sensor's stream and the 100 Hz of the logs: linear phase, so its
delay is exact.

A windowed sinc (Kaiser's window and his formulas for its length and shape; Oppenheim and Schafer,
Discrete-Time Signal Processing, ch. 7; `scipy.signal` would take a second to import in every
command of a rig). Records that are missing for a moment are bridged by a straight line.
"""

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import RATE_HZ

ATTENUATION_DB = 46.0
"""Attenuation of the design. It is at least 44 dB above 50 Hz, so less than 1/150 of a signal there
aliases into the log."""

BRIDGED_S = 0.01
"""Longest gap that is bridged; a signal below 50 Hz is close to straight for as long."""


def design(rate_hz: float, cutoff_hz: float) -> Float[np.ndarray, " taps"]:
    """Taps whose gain is 1/2 at the cut-off; an odd number, symmetric, their sum is 1."""
    # The transition reaches down to a third of the cut-off, or as far up as 50 Hz where that is
    # nearer.
    width = 2 * min(RATE_HZ / 2 - cutoff_hz, 2 / 3 * cutoff_hz) / rate_hz
    half = int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * width) / 2))
    beta = 0.5842 * (ATTENUATION_DB - 21) ** 0.4 + 0.07886 * (ATTENUATION_DB - 21)
    taps = np.sinc(2 * cutoff_hz / rate_hz * np.arange(-half, half + 1)) * np.kaiser(
        2 * half + 1, beta
    )
    return np.asarray(taps / taps.sum())


class AntiAlias:
    """Streaming filter: takes records one by one, and computes its output on request."""

    def __init__(self, rate_hz: float, cutoff_hz: float, channels: int = 6) -> None:
        self.taps = design(rate_hz, cutoff_hz)
        self.delay = len(self.taps) // 2
        """Delay of the output [records], exactly."""
        self.newest = 0
        """Place of the newest record in the stream, missing ones counted."""
        self._longest = max(1, round(BRIDGED_S * rate_hz))
        # Each record stands twice, so that the newest ones are one slice of the ring.
        self._ring = np.zeros((2 * len(self.taps), channels))
        self._held = 0

    def clear(self) -> None:
        """Forget all records: the next ones are unrelated to them."""
        self._held = 0

    def bridges(self, missing: int) -> bool:
        """Whether a gap of this many records is bridged; otherwise the filter refills."""
        return missing <= self._longest

    def put(self, values: Float[np.ndarray, " channels"], missing: int = 0) -> None:
        """Take a record after a number of missing ones; too many of them empty the filter."""
        if not self.bridges(missing):
            self._held = 0
        if not self._held:
            self.newest += missing
        elif missing:
            before = self._ring[self.newest % len(self.taps)].copy()
            for number in range(1, missing + 1):
                self._write(before + number / (missing + 1) * (values - before))
        self._write(values)

    def output(self) -> Float[np.ndarray, " channels"] | None:
        """Return the output for the moment `delay` records before the newest; None where the filter
        is not full."""
        oldest = (self.newest + 1) % len(self.taps)
        return self.taps @ self._ring[oldest : oldest + len(self.taps)] if self.full else None

    @property
    def full(self) -> bool:
        """Whether enough records came without a gap for an output."""
        return self._held >= len(self.taps)

    def _write(self, values: Float[np.ndarray, " channels"]) -> None:
        self.newest += 1
        self._held += 1
        index = self.newest % len(self.taps)
        self._ring[index] = self._ring[index + len(self.taps)] = values
