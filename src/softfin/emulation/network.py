"""In-process connections to emulated devices, in simulated time: CAN bus, UDP sockets and web
pages."""

import copy
import itertools
from collections import deque

import can

from softfin.core.clock import Clock
from softfin.core.configuration import Configuration
from softfin.core.errors import DeviceError
from softfin.emulation.clock import SimulatedClock

SIMULATED = "simulated"
"""Value of `bus.interface` in a rig's file."""

RMEM_MAX_BYTES = 212_992
"""Largest receive buffer that a program may request [bytes]: Linux's default for
`net.core.rmem_max`, which Linux then doubles."""

TRUESIZE_BYTES = 768
"""Memory that Linux accounts for a datagram with one record [bytes], most of which is overhead."""

DATE = "date"
"""Key in a clock's `shared` for the offset of the wall clock from the clock [s]; 0 if missing.
Tests may set it."""

_free_ports = itertools.count(50_000)


def open_bus(config: Configuration, clock: Clock) -> can.BusABC:
    """Open the bus of an `rig.bus.BusConfig`, whose fields are arguments of python-can; raises
    python-can's errors.

    On a simulated clock, this is an in-process bus, regardless of the interface.
    """
    settings = config.model_dump()
    if isinstance(clock, SimulatedClock):
        return SimulatedBus(clock, settings["channel"])
    return can.Bus(**settings.pop("options"), **settings)


class SimulatedBus(can.BusABC):
    """A bus on which all participants with the same clock and channel receive each other's frames
    immediately and in order."""

    def __init__(self, clock: SimulatedClock, channel: str) -> None:
        super().__init__(channel)
        self._clock = clock
        self._frames: deque[can.Message] = deque()
        self._all: list[SimulatedBus] = clock.shared.setdefault(channel, [])
        self._all.append(self)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; raises CanOperationError if the bus is shut down."""
        self._check_open()
        for bus in self._all:
            if bus is not self:
                # A copy for each receiver, because its timestamp is set.
                message = copy.copy(msg)
                message.timestamp = self._clock()
                bus._frames.append(message)

    def shutdown(self) -> None:
        """Shut down and wake threads waiting for a frame; may be called repeatedly."""
        super().shutdown()
        if self in self._all:
            self._all.remove(self)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None after `timeout` [s]; raises CanOperationError if the bus
        is shut down."""
        self._clock.wait_for(lambda: self._frames or self not in self._all, timeout)
        self._check_open()
        return self._frames.popleft() if self._frames else None

    def _check_open(self) -> None:
        if self not in self._all:
            raise can.CanOperationError("the bus is shut down")


def fetch_simulated_page(clock: SimulatedClock, host: str, port: int, path: str) -> bytes | None:
    """Return a page of an emulated sensor, or None if it does not exist; raises DeviceError if
    there is no server."""
    pages: dict[str, bytes] | None = clock.shared.get(("http", host, port))
    if pages is None:
        raise DeviceError(
            f"http://{host}:{port}{path}: cannot read the force sensor's page (no server); check "
            "its power, cable, address and http_port"
        )
    return pages.get(path)


class SimulatedSocket:
    """A bound UDP socket with the methods that softfin uses; `receive` waits up to `timeout` [s].

    As on Linux, the buffer size is in bytes, a full buffer drops new datagrams, and each datagram
    has a timestamp from the wall clock, which may be changed.
    """

    def __init__(
        self, clock: SimulatedClock, host: str, port: int = 0, timeout: float = 0.0
    ) -> None:
        self._clock = clock
        self.timeout = timeout
        self.address = (host, port or next(_free_ports))
        clock.shared[self.address] = self
        self._peer: tuple[str, int] | None = None
        self._received: deque[tuple[bytes, float, tuple[str, int]]] = deque()

    @property
    def has_room(self) -> bool:
        """Whether the buffer has space for another datagram."""
        return len(self._received) * TRUESIZE_BYTES <= 2 * RMEM_MAX_BYTES

    def date(self) -> float:
        """Return the wall-clock time [s]."""
        ahead: float = self._clock.shared.get(DATE, 0.0)
        return self._clock() + ahead

    def fileno(self) -> int:
        """Return -1 if the socket is closed, otherwise 0."""
        return 0 if self._clock.shared.get(self.address) is self else -1

    def connect(self, address: tuple[str, int]) -> None:
        """Set the only address to send to and receive from."""
        self._peer = address

    def send(self, data: bytes) -> int:
        """Send a datagram to the connected address."""
        assert self._peer is not None
        return self.sendto(data, self._peer)

    def sendto(self, data: bytes, address: tuple[str, int]) -> int:
        """Send a datagram, which is lost if there is no receiver or its buffer is full."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        receiver: SimulatedSocket | None = self._clock.shared.get(address)
        # A connected socket receives only from its peer.
        if receiver is not None and receiver._peer in (None, self.address) and receiver.has_room:
            receiver._received.append((bytes(data), self.date(), self.address))
        return len(data)

    def receive(self) -> tuple[bytes, float, tuple[str, int]]:
        """Return a datagram, its arrival time on the wall clock [s] and its sender; raises
        BlockingIOError if none arrives in time."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        if not (
            self._clock.wait_for(lambda: self._received, self.timeout)
            if self.timeout
            else self._received
        ):
            raise BlockingIOError
        return self._received.popleft()

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        """Return a datagram and its sender; raises BlockingIOError if none arrives in time."""
        data, _, sender = self.receive()
        return data[:size], sender

    def close(self) -> None:
        """Close the socket; may be called repeatedly."""
        if self.fileno() != -1:
            del self._clock.shared[self.address]
