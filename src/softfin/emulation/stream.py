"""An emulated sensor that sends noisy records of the force of a fin at a constant rate."""

import contextlib
import os
import select
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

import numpy as np

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.emulation.fin import SENSOR_MOUNTING, EmulatedFin
from softfin.rig.machine import Wrench, rotated, rotation

Record = TypeVar("Record")
"""Record with one wrench in the form in which it is sent."""

LOAD_NOISE = np.random.default_rng(0).uniform(-1e-3, 1e-3, (1021, 6))
"""Noise of each channel by the number of the record [N, N m]; small, so that tests can compare
forces."""


class EmulatedSensor(ABC, Generic[Record]):
    """Emulated sensor, running from construction until `close`; faults may be set from any
    thread."""

    def __init__(self, fin: EmulatedFin, rate_hz: float, clock: Clock, frame: str) -> None:
        """Prepare the sensor; `frame` contains the sensor axes along softfin's axes."""
        self.transmit: Callable[[Record], Iterable[Record]] = lambda record: (record,)
        """Function that maps a record to the records that arrive; tests may truncate, duplicate,
        drop, delay or change records."""
        self.rate_hz = rate_hz
        self.are_values_frozen = False
        """Whether all six channels are frozen while records continue."""
        self._fin = fin
        self._clock = clock
        # The inverse of the rotation in the host: from softfin's axes to the sensor axes.
        self._rotation = rotation(frame).T
        self._silent_until = 0.0
        self._closing = clock.event()
        self._thread = clock.spawn(self._run, "emulated sensor")

    @abstractmethod
    def _run(self) -> None:
        """Run until `_closing` is set."""

    @abstractmethod
    def unplug(self) -> None:
        """Remove the connection; may be called repeatedly."""

    def measure(self) -> Wrench:
        """Return the current wrench in the sensor axes [N, N m]."""
        return rotated(self._fin.now().wrench, self._rotation)

    def silence(self, seconds: float = float("inf")) -> None:
        """Send nothing for a time [s]; 0 ends the silence."""
        self._silent_until = self._clock() + seconds

    def close(self) -> None:
        """Stop the sensor; may be called repeatedly."""
        self._closing.set()
        self._thread.join()
        self.unplug()


class EmulatedStream(EmulatedSensor[Record]):
    """Emulated sensor that sends from the start, whether or not anybody listens."""

    def __init__(self, fin: EmulatedFin, rate_hz: float, clock: Clock) -> None:
        self._wrench: Wrench = (0.0,) * 6
        super().__init__(fin, rate_hz, clock, SENSOR_MOUNTING)

    @abstractmethod
    def encode(self, age_s: float, wrench: Wrench) -> Record:
        """Return a record with a wrench in the sensor axes [N, N m]; `age_s` is the time from the
        start of the sensor to the record [s]."""

    @abstractmethod
    def send(self, record: Record) -> None:
        """Send a record, which is lost if nobody reads it; may raise OSError or DeviceError."""

    def _run(self) -> None:
        for number in self._due_numbers():
            if not self.are_values_frozen:
                noise = LOAD_NOISE[number % len(LOAD_NOISE)]
                load = self.measure() + noise
                self._wrench = tuple(load.tolist())
            record = self.encode((number + 1) / self.rate_hz, self._wrench)
            if self._clock() < self._silent_until:
                continue
            for sent in self.transmit(record):
                # A slow reader, or none, must not end the sensor.
                with contextlib.suppress(OSError, DeviceError):
                    self.send(sent)

    def _due_numbers(self) -> Iterator[int]:
        """Yield the numbers of the records that have become due, at a rate that may change, until
        the sensor is closed; record k is due (k + 1) / rate after the start."""
        started = self._clock()
        sent = 0
        while not self._closing.wait(max(0.002, 1 / self.rate_hz)):
            due = int((self._clock() - started) * self.rate_hz)
            yield from range(sent, due)
            sent = due


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
