"""Anti-alias filter between a sensor stream and the 100 Hz logs, with a linear phase and therefore
an exact delay.

The filter is a sinc with a Kaiser window, using Kaiser's formulas for length and shape (Oppenheim
and Schafer, Discrete-Time Signal Processing, ch. 7). `scipy.signal` contains the same design but
would add one second of import time to every rig command. Short gaps are bridged by linear
interpolation.
"""

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import RATE_HZ

ATTENUATION_DB = 46.0
"""Design value of the stop-band attenuation. The actual attenuation is at least 44 dB above 50 Hz,
so less than 1/150 of a signal there aliases into the log."""

BRIDGED_S = 0.01
"""Maximum gap that is bridged [s]; over this time, a signal below 50 Hz is nearly a straight
line."""


def design(rate_hz: float, cutoff_hz: float) -> Float[np.ndarray, " taps"]:
    """Return an odd number of symmetric taps with sum 1 and gain 1/2 at the cut-off frequency."""
    # The transition band is centred at the cut-off. It extends up to 50 Hz or down to a third of
    # the cut-off, whichever is narrower.
    width = 2 * min(RATE_HZ / 2 - cutoff_hz, 2 / 3 * cutoff_hz) / rate_hz
    # Kaiser's design formulas: number of taps - 1 = (A - 7.95) / (14.36 width), with the width in
    # cycles per sample, and the window's shape parameter beta for 21 dB < A < 50 dB.
    half = int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * width) / 2))
    beta = 0.5842 * (ATTENUATION_DB - 21) ** 0.4 + 0.07886 * (ATTENUATION_DB - 21)
    taps = np.sinc(2 * cutoff_hz / rate_hz * np.arange(-half, half + 1)) * np.kaiser(
        2 * half + 1, beta
    )
    return np.asarray(taps / taps.sum())


class AntiAlias:
    """Streaming filter that accepts records one at a time and computes the output on request."""

    def __init__(self, rate_hz: float, cutoff_hz: float, channels: int = 6) -> None:
        self.taps = design(rate_hz, cutoff_hz)
        self.delay = len(self.taps) // 2
        """Exact delay of the output [records]."""
        self.newest = 0
        """Position of the latest record in the stream, counting missing records."""
        self._longest = max(1, round(BRIDGED_S * rate_hz))
        # Each record is stored twice so that the latest records always form one contiguous slice.
        self._ring = np.zeros((2 * len(self.taps), channels))
        self._held = 0

    def bridges(self, missing: int) -> bool:
        """Return whether a gap of `missing` records is bridged; after a longer gap, the filter has
        to refill."""
        return missing <= self._longest

    def put(self, values: Float[np.ndarray, " channels"], missing: int = 0) -> None:
        """Add a record after `missing` lost records; a gap that is too long empties the filter."""
        if not self.bridges(missing):
            self._held = 0
        if not self._held:
            self.newest += missing
        elif missing:
            # Linear interpolation across the gap.
            before = self._ring[self.newest % len(self.taps)].copy()
            for number in range(1, missing + 1):
                self._write(before + number / (missing + 1) * (values - before))
        self._write(values)

    def output(self) -> Float[np.ndarray, " channels"] | None:
        """Return the output at `delay` records before the latest; None if the filter is not
        full."""
        oldest = (self.newest + 1) % len(self.taps)
        return self.taps @ self._ring[oldest : oldest + len(self.taps)] if self.full else None

    @property
    def full(self) -> bool:
        """Whether there are enough records for an output."""
        return self._held >= len(self.taps)

    def _write(self, values: Float[np.ndarray, " channels"]) -> None:
        self.newest += 1
        self._held += 1
        index = self.newest % len(self.taps)
        self._ring[index] = self._ring[index + len(self.taps)] = values
