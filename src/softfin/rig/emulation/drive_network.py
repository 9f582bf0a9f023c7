"""The emulated drive's end of the bus: canopen's network, what a node has to refuse, and a cable that can be cut."""

import contextlib
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import can
import canopen

from softfin.core.clock import Clock
from softfin.rig.epos2 import objects

SDO_LENGTH = 8
CYCLE_S = 0.05
"""Between two looks of the receiver at whether it is to end."""
NMT_STOP, NMT_RESET_COMMUNICATION = 0x02, 0x82
NMT_COMMANDS = (
    objects.NMT_START,
    NMT_STOP,
    objects.NMT_PRE_OPERATIONAL,
    objects.NMT_RESET,
    NMT_RESET_COMMUNICATION,
)


class DriveNetwork(canopen.Network):
    """`take(cob_id, data)` gets each frame after canopen, `request(cob_id)` each remote frame; no frame can end it."""

    def __init__(
        self, take: Callable[[int, bytes], None], request: Callable[[int], None], state: Callable[[], str], clock: Clock
    ) -> None:
        """`state` is the node's NMT state as canopen calls it."""
        super().__init__()
        self._take, self._request, self._state = take, request, state
        self.counters: Counter[str] = Counter()
        self.silent = False
        self._clock = clock
        self._receiving: threading.Thread | None = None

    def receive(self, bus: can.BusABC) -> None:
        """From now on, in a thread of the clock."""
        self.bus = bus
        self._receiving = self._clock.spawn(lambda: self._receive(bus), "emulated drive's receiver")

    def disconnect(self) -> None:
        """Any number of times."""
        bus, receiving, self.bus, self._receiving = self.bus, self._receiving, None, None
        if receiving is not None:
            receiving.join(2 * CYCLE_S)
        if bus is not None:
            bus.shutdown()

    def send_message(self, can_id: int, data: bytes | bytearray | list[int], remote: bool = False) -> None:
        """Nothing leaves over a cut cable."""
        if not self.silent and self.bus is not None:
            super().send_message(can_id, bytes(data), remote)

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        """A frame at once and then every period [s], in a thread of the clock."""
        return _Periodic(self, can_id, data, period, self._clock)

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """One frame has come."""
        if self.silent or not self._is_taken(can_id, data):
            return
        try:
            super().notify(can_id, data, timestamp)
            self._take(can_id, bytes(data))
        except Exception:
            # Whatever canopen makes of a frame that makes no sense.
            self.counters["refused frames"] += 1

    def request(self, can_id: int) -> None:
        """A remote frame has come."""
        if not self.silent:
            self._request(can_id)

    def _is_taken(self, can_id: int, data: bytearray) -> bool:
        is_sdo = can_id & 0x780 == objects.SDO_REQUEST
        if is_sdo and self._state() == "STOPPED":
            return False
        # canopen's server would print a traceback for the first, and has states of its own for the second.
        wrong_sdo = is_sdo and len(data) != SDO_LENGTH
        wrong_nmt = can_id == objects.NMT and (len(data) != 2 or data[0] not in NMT_COMMANDS)
        self.counters["refused frames"] += wrong_sdo or wrong_nmt
        return not (wrong_sdo or wrong_nmt)

    def _receive(self, bus: can.BusABC) -> None:
        """canopen's own takes 29-bit identifiers for 11-bit ones, and leaves remote frames out."""
        while self.bus is bus:
            try:
                message = bus.recv(CYCLE_S)
            except (can.CanError, OSError):
                return
            if message is None or message.is_error_frame or message.is_extended_id or self.bus is not bus:
                continue
            if message.is_remote_frame:
                self.request(message.arbitration_id)
            else:
                self.notify(message.arbitration_id, message.data, message.timestamp)


class _Periodic:
    """What canopen's heartbeat asks for."""

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
