"""Pace, noise and pseudo-terminal of emulated devices."""

import contextlib
import os
import select
import threading
import tty
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from softfin.core.clock import Clock
from softfin.emulation.fin import EmulatedFin
from softfin.rig.machine import Wrench, rotated

LOAD_NOISE = np.random.default_rng(0).uniform(-1e-3, 1e-3, (1021, 6))
"""Noise of each channel by the number of the record [N, N m]; small, so that tests can compare
forces."""


def iterate_due(
    clock: Clock, closing: threading.Event, rate_hz: Callable[[], float]
) -> Iterator[range]:
    """Yield the numbers of the records that have become due, at a rate that may change, until
    `closing` is set; record k is due (k + 1) / rate after the start."""
    started = clock()
    sent = 0
    while not closing.wait(max(0.002, 1 / rate_hz())):
        due = int((clock() - started) * rate_hz())
        yield range(sent, due)
        sent = due


def measure(fin: EmulatedFin, turn: Float[np.ndarray, "3 3"], number: int) -> Wrench:
    """Return the fin's wrench now in the axes of a sensor, with the noise of a record [N, N m];
    `turn` rotates from softfin's axes."""
    fx, fy, fz, tx, ty, tz = (
        rotated(fin.now().wrench, turn) + LOAD_NOISE[number % len(LOAD_NOISE)]
    ).tolist()
    return fx, fy, fz, tx, ty, tz


class Pty:
    """A pseudo-terminal; its other end is the serial port."""

    def __init__(self) -> None:
        self._own, self._other = os.openpty()
        tty.setraw(self._other)
        os.set_blocking(self._own, False)
        self.name = os.ttyname(self._other)
        self.is_open = True

    def receive(self, wait_s: float) -> bytes:
        """Wait for bytes for up to `wait_s` [s]."""
        with contextlib.suppress(OSError, ValueError):
            if self.is_open and select.select([self._own], [], [], wait_s)[0]:
                return os.read(self._own, 4096)
        return b""

    def send(self, data: bytes) -> None:
        """Send bytes; those that nobody reads are lost, as on a real port."""
        with contextlib.suppress(OSError):
            if self.is_open:
                os.write(self._own, data)

    def close(self) -> None:
        """Unplug; may be called repeatedly."""
        if self.is_open:
            self.is_open = False
            os.close(self._own)
            os.close(self._other)
