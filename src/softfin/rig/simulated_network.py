"""Connections to emulated devices within the process, in simulated time: a CAN bus, datagrams, web
pages."""

import copy
import itertools
from collections import deque

import can

from softfin.core.clock import Clock
from softfin.core.configuration import Configuration
from softfin.core.errors import DeviceError
from softfin.rig.simulated_clock import SimulatedClock

SIMULATED = "simulated"
"""Interface of a bus in a rig's file."""

RMEM_MAX_BYTES = 212_992
"""Largest receive buffer that a program may ask for: Linux's default of `net.core.rmem_max`. Linux
doubles it."""

TRUESIZE_BYTES = 768
"""Memory that Linux counts for a datagram of one record, most of which is its own bookkeeping."""

DATE = "date"
"""Key in a clock's `shared` of how far the date is ahead of the clock [s]; 0 if it is missing. A
test may set it."""

_free_ports = itertools.count(50_000)


def open_bus(config: Configuration, clock: Clock) -> can.BusABC:
    """Open the bus of an `epos2.config.BusConfig`, whose fields are the arguments of python-can,
    and raise its errors.

    On a simulated clock it is that of this process, whatever the interface.
    """
    settings = config.model_dump()
    if isinstance(clock, SimulatedClock):
        return SimulatedBus(clock, settings["channel"])
    return can.Bus(**settings.pop("options"), **settings)


class SimulatedBus(can.BusABC):
    """Everybody on a channel of a clock gets what the others send, at once and in order."""

    def __init__(self, clock: SimulatedClock, channel: str) -> None:
        super().__init__(channel)
        self._clock = clock
        self._frames: deque[can.Message] = deque()
        self._all: list[SimulatedBus] = clock.shared.setdefault(channel, [])
        self._all.append(self)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; raises CanOperationError once the bus is shut down."""
        self._check_open()
        for bus in self._all:
            if bus is not self:
                message = copy.copy(msg)
                message.timestamp = self._clock()
                bus._frames.append(message)

    def shutdown(self) -> None:
        """Shut down, any number of times; whoever waits for a frame is woken."""
        super().shutdown()
        if self in self._all:
            self._all.remove(self)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, None where none comes in so many seconds; raises CanOperationError once
        it is shut down."""
        self._clock.wait_for(lambda: self._frames or self not in self._all, timeout)
        self._check_open()
        return self._frames.popleft() if self._frames else None

    def _check_open(self) -> None:
        if self not in self._all:
            raise can.CanOperationError("the bus is shut down")


def fetch_simulated_page(clock: SimulatedClock, host: str, port: int, path: str) -> bytes | None:
    """A page of an emulated sensor, None where it has no such page; raises DeviceError without a
    server."""
    pages: dict[str, bytes] | None = clock.shared.get(("http", host, port))
    if pages is None:
        raise DeviceError(
            f"http://{host}:{port}{path}: the force sensor's page cannot be read (nobody serves "
            "it); check its power, cable and address, and http_port"
        )
    return pages.get(path)


class SimulatedSocket:
    """A bound UDP socket, as far as softfin uses one; `receive` waits up to `timeout`.

    As in Linux, the buffer is counted in bytes, a full one drops what is new, and each datagram is
    stamped with the date, which may be set, at which it arrived.
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
        """Whether its buffer takes another datagram."""
        return len(self._received) * TRUESIZE_BYTES <= 2 * RMEM_MAX_BYTES

    def date(self) -> float:
        """Return the date [s]."""
        ahead: float = self._clock.shared.get(DATE, 0.0)
        return self._clock() + ahead

    def fileno(self) -> int:
        """-1 once it is closed."""
        return 0 if self._clock.shared.get(self.address) is self else -1

    def connect(self, address: tuple[str, int]) -> None:
        """Send to this address from now on, and receive only from it."""
        self._peer = address

    def send(self, data: bytes) -> int:
        """Send to the address that it is connected to."""
        assert self._peer is not None
        return self.sendto(data, self._peer)

    def sendto(self, data: bytes, address: tuple[str, int]) -> int:
        """Send a datagram; it is lost where nobody listens, or whoever does has no room."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        receiver: SimulatedSocket | None = self._clock.shared.get(address)
        if receiver is not None and receiver._peer in (None, self.address) and receiver.has_room:
            receiver._received.append((bytes(data), self.date(), self.address))
        return len(data)

    def receive(self) -> tuple[bytes, float, tuple[str, int]]:
        """A datagram, the date of its arrival [s] and its sender; raises BlockingIOError where none
        comes in time."""
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
        """A datagram and its sender; raises BlockingIOError where none comes in time."""
        data, _, sender = self.receive()
        return data[:size], sender

    def close(self) -> None:
        """Close it; any number of times."""
        if self.fileno() != -1:
            del self._clock.shared[self.address]
