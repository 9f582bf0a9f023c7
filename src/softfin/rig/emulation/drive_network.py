"""The emulated drive's end of the bus: canopen's network in a thread of our clock, over a cable that can be cut."""

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import can
import canopen

from softfin.core.clock import Clock

CYCLE_S = 0.05
"""Longest time between two looks of the receiver at whether it is to end."""


class DriveNetwork(canopen.Network):
    """`take(message)` gets each frame, in the receiver's thread; it must not raise."""

    def __init__(self, take: Callable[[can.Message], None], clock: Clock) -> None:
        super().__init__()
        self._take, self._clock = take, clock
        self.silent = False
        self._receiving: threading.Thread | None = None

    def receive(self, bus: can.BusABC) -> None:
        """Take frames from now on, in a thread of the clock."""
        self.bus = bus
        self._receiving = self._clock.spawn(lambda: self._receive(bus), "emulated drive's receiver")

    def disconnect(self) -> None:
        """Close the bus; any number of times."""
        bus, receiving, self.bus, self._receiving = self.bus, self._receiving, None, None
        if receiving is not None:
            receiving.join(2 * CYCLE_S)
        if bus is not None:
            bus.shutdown()

    def send_message(self, can_id: int, data: bytes | bytearray | list[int], remote: bool = False) -> None:
        """Send a frame; nothing leaves over a cut cable."""
        if not self.silent and self.bus is not None:
            super().send_message(can_id, bytes(data), remote)

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        """Send a frame at once and then every period [s], in a thread of the clock: canopen's heartbeat."""
        return _Periodic(self, can_id, data, period, self._clock)

    def _receive(self, bus: can.BusABC) -> None:
        """canopen's own takes 29-bit identifiers for 11-bit ones."""
        while self.bus is bus:
            try:
                message = bus.recv(CYCLE_S)
            except (can.CanError, OSError):
                return
            if message is None or self.silent or self.bus is not bus:
                continue
            if not (message.is_error_frame or message.is_extended_id or message.is_remote_frame):
                self._take(message)


class _Periodic:
    def __init__(self, network: DriveNetwork, can_id: int, data: Any, period: float, clock: Clock) -> None:
        self._network, self._can_id, self._data, self._period = network, can_id, data, period
        self._ended = clock.event()
        clock.spawn(self._run, "emulated drive's heartbeat")

    def stop(self) -> None:
        self._ended.set()

    def update(self, data: Any) -> None:
        self._data = data

    def _run(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(can.CanError, RuntimeError):
                self._network.send_message(self._can_id, self._data)
            self._ended.wait(self._period)
