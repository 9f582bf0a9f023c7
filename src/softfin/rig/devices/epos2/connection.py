"""Connection to the drive: a python-can bus with a receiver thread, and SDO transfers with
timeouts.

The class `Network` of canopen is not used: a malformed frame or a single receive error ends its
thread, after which sending always fails, even for a quick stop. The SDO client of canopen supports
only the real clock. Expedited transfers are sufficient, because every object used here fits into
one frame.
"""

import contextlib
import logging
import socket
import struct
import threading
from collections import Counter
from collections.abc import Callable

import can

from softfin.core.errors import DeviceError, RigError, one_line
from softfin.rig.bus import BusConfig
from softfin.rig.computer import Computer
from softfin.rig.device import RefusedError
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.protocol import Object

SDO_TIMEOUT_S = 0.5
SEND_TIMEOUT_S = 0.05
RECEIVER_CYCLE_S = 0.05

UPLOAD = 0x40
DOWNLOADED = 0x60
ABORTED = 0x80
"""SDO command specifiers: read request, write confirmation, aborted transfer."""

# Otherwise, log messages of python-can would repeat our errors in the terminal.
logging.getLogger("can").addHandler(logging.NullHandler())


class CanConnection:
    """A bus with one drive; `on_frame(cob_id, data)` and `on_problem(line)` are called from the
    receiver thread."""

    def __init__(
        self,
        config: BusConfig,
        node: int,
        on_frame: Callable[[int, bytes], None],
        on_problem: Callable[[str], None],
        clock: Computer,
    ) -> None:
        self._config = config
        self.node = node
        self._clock = clock
        self._on_frame = on_frame
        self._on_problem = on_problem
        self.name = f"CAN bus {config.interface} {config.channel}"
        self._bus: can.BusABC | None = None
        self._receiver: threading.Thread | None = None
        # Re-entrant, because a signal handler that stops the drive may interrupt a send.
        self._sending = clock.lock()
        self._requesting = clock.lock()
        self._answered = clock.event()
        self._request = b""
        self._answer = b""
        self._foreign_ids: set[int] | None = None
        self.counters: Counter[str] = Counter()

    @property
    def in_receiver(self) -> bool:
        """Whether the caller is the receiver thread, which must not wait for an answer."""
        return threading.current_thread() is self._receiver

    def open(self) -> None:
        """Open the bus and start the receiver; raises RigError if the bus cannot be opened."""
        options = self._config.options
        try:
            if self._config.interface == "socketcand":
                # python-can would retry for ten seconds and flood the terminal.
                address = (str(options.get("host", "127.0.0.1")), int(options.get("port", 29536)))
                socket.create_connection(address, timeout=2).close()
            bus = self._bus = self._clock.open_bus(self._config)
            self._clock.spawn(lambda: self._receive(bus), "drive receiver")
        except Exception as error:
            # Each python-can interface raises different exceptions.
            self.close()
            raise RigError(
                f"{self.name} cannot be opened ({one_line(error)}); check bus.interface, "
                "bus.channel and bus.options in the rig file, and check that the adapter is "
                "plugged in and up"
            ) from None

    def close(self) -> None:
        """Close the bus; may be called repeatedly and never raises."""
        bus = self._bus
        # Do this first, because the receiver thread runs until `bus` changes.
        self._bus = None
        if self._receiver is not None and not self.in_receiver:
            self._receiver.join(10 * RECEIVER_CYCLE_S)
        if bus is not None:
            with contextlib.suppress(Exception):
                bus.shutdown()

    def listen(self, seconds: float) -> frozenset[int]:
        """Listen for `seconds` without sending; return the COB-IDs of the frames received."""
        foreign_ids = self._foreign_ids = set[int]()
        self._clock.sleep(seconds)
        self._foreign_ids = None
        return frozenset(foreign_ids)

    def send(self, cob_id: int, data: bytes) -> None:
        """Send one frame; raises DeviceError if the bus does not accept it."""
        bus = self._bus
        if bus is None:
            raise DeviceError(f"{self.name} is closed; open the drive first")
        if not self._sending.acquire(timeout=2 * SEND_TIMEOUT_S):
            raise DeviceError(
                f"{self.name} does not accept frames; check the adapter and its cable"
            )
        try:
            bus.send(
                can.Message(arbitration_id=cob_id, data=data, is_extended_id=False), SEND_TIMEOUT_S
            )
        except Exception as error:
            raise DeviceError(
                f"{self.name} does not accept frames ({one_line(error)}); check the adapter, "
                "cable, termination and bitrate"
            ) from None
        finally:
            self._sending.release()

    def read(self, entry: Object) -> int:
        """Read an object of the drive; raises DeviceError on failure."""
        size = entry.layout.size
        # 0x43 | (unused bytes << 2) indicates the size; 0x42 is an answer without a size.
        allowed = (0x43 | 4 - size << 2, 0x42)
        answer = self._transfer(
            entry, struct.pack("<BHBI", UPLOAD, entry.number, entry.sub, 0), allowed
        )
        return int(entry.layout.unpack(answer[4 : 4 + size])[0])

    def write(self, entry: Object, value: int) -> None:
        """Write an object of the drive; raises DeviceError on failure."""
        self._transfer(entry, download(entry, value), (DOWNLOADED,))

    def _transfer(self, entry: Object, request: bytes, allowed: tuple[int, ...]) -> bytes:
        """Send an SDO request and return the answer, which must start with one of the allowed
        commands."""
        # The receiver thread would wait for an answer that only it can receive.
        if self.in_receiver or not self._requesting.acquire(timeout=2 * SDO_TIMEOUT_S):
            raise DeviceError(
                f"drive object {entry} cannot be accessed: an earlier request is still pending; "
                "try again"
            )
        try:
            # Do this before sending, because the receiver thread may get the answer before `send`
            # returns.
            self._answered.clear()
            self._request = request
            self._answer = b""
            self.send(protocol.SDO_REQUEST + self.node, request)
            self._answered.wait(SDO_TIMEOUT_S)
            answer = self._answer
        finally:
            self._request = b""
            self._requesting.release()
        if not answer:
            raise DeviceError(
                f"drive {self.node} did not respond for {entry} within {SDO_TIMEOUT_S:g} s; check "
                "its supply, the bus cable and the bitrate"
            )
        if answer[0] == ABORTED:
            code = int.from_bytes(answer[4:], "little")
            raise RefusedError(f"drive refused {entry}: {protocol.abort_line(code)}", code)
        if answer[0] not in allowed:
            raise DeviceError(
                f"invalid response from the drive for {entry} ({answer.hex()}); try again"
            )
        return answer

    def _receive(self, bus: can.BusABC) -> None:
        """Run the receiver thread, which no frame or error can end."""
        self._receiver = threading.current_thread()
        while self._bus is bus:
            try:
                message = bus.recv(RECEIVER_CYCLE_S)
                if message is not None and self._bus is bus:
                    self._sort(message)
            except Exception as error:
                if self._bus is bus:
                    self.counters["receiving errors"] += 1
                    self._on_problem(
                        f"{self.name} cannot be read ({one_line(error)}); check the adapter and "
                        "cable"
                    )
                    # A lost bus must not keep a CPU core busy.
                    self._clock.sleep(RECEIVER_CYCLE_S)

    def _sort(self, message: can.Message) -> None:
        if not message.is_rx:
            # Some adapters echo the frames that we send.
            return
        cob_id = message.arbitration_id
        data = bytes(message.data)
        if message.is_error_frame:
            self._count_errors(cob_id, data)
            return
        if message.is_remote_frame or message.is_extended_id:
            return
        foreign_ids = self._foreign_ids
        if foreign_ids is not None:
            foreign_ids.add(cob_id)
        if cob_id != protocol.SDO_ANSWER + self.node:
            self._on_frame(cob_id, data)
        elif len(data) != 8:
            self.counters["malformed frames"] += 1
        # Answers contain the object index, so late answers to earlier requests can be dropped.
        elif self._request and data[1:4] == self._request[1:4]:
            self._answer = data
            self._answered.set()

    def _count_errors(self, classes: int, data: bytes) -> None:
        """Count the errors in an error frame, and report an adapter that is bus-off or close to
        it."""
        names = protocol.bus_errors(classes, data)
        self.counters.update(names)
        # CAN controllers retransmit a frame after an error, which takes a fraction of a millisecond
        # and does not require a stop.
        for name in names:
            if name in protocol.BUS_FAILURES:
                self._on_problem(
                    f"{self.name}: the adapter is {name}; check its cable, termination and bitrate"
                )


def download(entry: Object, value: int) -> bytes:
    """Return the SDO request that writes an object; raises DeviceError if the value is out of
    range."""
    unused = 4 - entry.layout.size
    try:
        data = entry.layout.pack(value) + bytes(unused)
    except struct.error:
        raise DeviceError(
            f"drive setting {entry} cannot be set to {value}, which is out of range; change the "
            "value in the rig file"
        ) from None
    # CiA 301: expedited download that indicates the number of unused bytes.
    return struct.pack("<BHB", 0x23 | unused << 2, entry.number, entry.sub) + data
