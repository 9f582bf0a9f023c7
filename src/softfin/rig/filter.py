"""The anti-alias filter between a sensor's stream and the 100 Hz of the logs: linear phase, so its delay is exact.

A windowed sinc (Kaiser's window and his formulas for its length and shape; Oppenheim and Schafer, Discrete-Time Signal
Processing, ch. 7; `scipy.signal` would take a second to import in every command of a rig). Records that are missing for
a moment are bridged by a straight line and counted.
"""

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import RATE_HZ

NYQUIST_HZ = RATE_HZ / 2
ATTENUATION_DB = 46.0
"""Attenuation of the design; 44 dB are kept from 50 Hz on: less than 1/150 of what is there folds into the log."""
BRIDGED_S = 0.01
"""Longest gap that is bridged; a signal below 50 Hz is close to straight for as long."""
SLACK_S = 0.25
"""How much older than the newest an output may be that is asked for."""


def transition_hz(cutoff_hz: float) -> float:
    """Half the width of the transition: down to 50 Hz, or to a third of the cut-off where that is nearer."""
    return min(NYQUIST_HZ - cutoff_hz, 2 / 3 * cutoff_hz)


def design(rate_hz: float, cutoff_hz: float) -> Float[np.ndarray, " taps"]:
    """Taps whose gain is 1/2 at the cut-off; an odd number, symmetric, their sum is 1."""
    width = 2 * transition_hz(cutoff_hz) / rate_hz
    half = int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * width) / 2))
    beta = 0.5842 * (ATTENUATION_DB - 21) ** 0.4 + 0.07886 * (ATTENUATION_DB - 21)
    taps = np.sinc(2 * cutoff_hz / rate_hz * np.arange(-half, half + 1)) * np.kaiser(2 * half + 1, beta)
    return np.asarray(taps / taps.sum())


class AntiAlias:
    """Streaming: records go in by their place in the stream, outputs are computed when they are asked for."""

    def __init__(self, rate_hz: float, cutoff_hz: float, channels: int = 6) -> None:
        self.taps = design(rate_hz, cutoff_hz)
        self.delay = len(self.taps) // 2
        """Delay of the output [records], exactly."""
        self.newest = 0
        """Place of the newest record."""
        self.bridged = 0
        """Records that were missing and lie on a straight line now."""
        self.interrupted = 0
        """Gaps too long for that: nothing comes out until the filter is full again."""
        self._longest = max(1, round(BRIDGED_S * rate_hz))
        self._size = len(self.taps) + 1 + round(SLACK_S * rate_hz)
        # Each record stands twice, so that any window of the ring is one slice.
        self._ring = np.zeros((2 * self._size, channels))
        self._first = 0
        self._empty = True

    def clear(self) -> None:
        """Forget all; what comes next has nothing to do with what came before."""
        self._empty = True

    def put(self, place: int, values: Float[np.ndarray, " channels"]) -> None:
        """Take a record; a late one takes the place of the one that bridged it, where it still matters."""
        missing = place - self.newest - 1
        if self._empty or missing > self._longest:
            self.interrupted += not self._empty
            self._first, self.newest, self._empty = place, place, False
        elif missing >= 0:
            before = self._ring[self.newest % self._size].copy()
            for number in range(1, missing + 1):
                self._write(self.newest + number, before + number / (missing + 1) * (values - before))
            self.bridged += missing
            self.newest = place
        elif place < self._first or place <= self.newest - self._size:
            return
        self._write(place, values)

    def full(self, place: float | int) -> bool:
        """Whether there is an output for a place."""
        oldest = int(np.floor(min(place, self.newest))) - len(self.taps) + 1
        return not self._empty and oldest >= self._first and oldest > self.newest - self._size

    def at(self, place: float | int) -> Float[np.ndarray, " channels"] | None:
        """The output for the moment `delay` records before a place; None where the filter is not full there."""
        if not self.full(place):
            return None
        whole = int(np.floor(min(place, self.newest)))
        fraction = min(place, self.newest) - whole
        start = (whole - len(self.taps) + 1) % self._size
        window = self._ring[start : start + len(self.taps) + 1]
        output = self.taps @ window[:-1]
        if fraction:
            output = (1 - fraction) * output + fraction * (self.taps @ window[1:])
        return np.asarray(output)

    def _write(self, place: int, values: Float[np.ndarray, " channels"]) -> None:
        self._ring[place % self._size] = self._ring[place % self._size + self._size] = values
