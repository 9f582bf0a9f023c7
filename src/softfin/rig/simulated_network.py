"""Datagrams and web pages within the process, in simulated time: the network of an emulated force sensor."""

import itertools
from collections import deque
from collections.abc import Mapping
from weakref import WeakKeyDictionary

from softfin.core.errors import DeviceError
from softfin.rig.simulated_clock import SimulatedClock

CAPACITY = 5461
"""Datagrams that a socket keeps: those of one record for which Linux has room in 4 MiB."""

Address = tuple[str, int]


class SimulatedNetwork:
    """One for each simulated clock: whoever uses the same clock is on the same network."""

    def __init__(self) -> None:
        self.sockets: dict[Address, SimulatedSocket] = {}
        self.pages: dict[Address, Mapping[str, bytes]] = {}
        """Pages of each web server, by path."""
        self.free_ports = itertools.count(50_000)


_networks: WeakKeyDictionary[SimulatedClock, SimulatedNetwork] = WeakKeyDictionary()


def network_of(clock: SimulatedClock) -> SimulatedNetwork:
    """The network of a clock."""
    return _networks.setdefault(clock, SimulatedNetwork())


def fetch_simulated_page(clock: SimulatedClock, host: str, port: int, path: str) -> bytes | None:
    """A page of an emulated sensor, None where it has no such page; raises DeviceError without a server."""
    pages = network_of(clock).pages.get((host, port))
    if pages is None:
        raise DeviceError(
            f"http://{host}:{port}{path}: the force sensor's page cannot be read (nobody serves it); "
            "check its power, cable and address, and http_port"
        )
    return pages.get(path)


class SimulatedSocket:
    """A bound UDP socket, as far as softfin uses one; `receive` waits up to `timeout`."""

    def __init__(self, clock: SimulatedClock, host: str, port: int = 0, timeout: float = 0.0) -> None:
        self._clock, self._network = clock, network_of(clock)
        self.timeout = timeout
        self.address = (host, port or next(self._network.free_ports))
        if self.address in self._network.sockets:
            raise OSError(f"port {port} of {host} is in use")
        self._network.sockets[self.address] = self
        self._peer: Address | None = None
        self._news = clock.event()
        self._received: deque[tuple[bytes, float, Address]] = deque()

    def getsockname(self) -> Address:
        """Its host and port."""
        return self.address

    def fileno(self) -> int:
        """-1 once it is closed."""
        return 0 if self._network.sockets.get(self.address) is self else -1

    def connect(self, address: Address) -> None:
        """Send to this address from now on, and receive only from it."""
        self._peer = address

    def send(self, data: bytes) -> int:
        """Send to the address that it is connected to."""
        assert self._peer is not None
        return self.sendto(data, self._peer)

    def sendto(self, data: bytes, address: Address) -> int:
        """Send a datagram; it is lost where nobody listens, or whoever does has no room."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        receiver = self._network.sockets.get(address)
        if receiver is not None and receiver._peer in (None, self.address) and len(receiver._received) < CAPACITY:
            # In whole nanoseconds, as a kernel's stamp.
            arrived = int(self._clock()) + round(self._clock() % 1 * 1e9) * 1e-9
            receiver._received.append((bytes(data), arrived, self.address))
            receiver._news.set()
        return len(data)

    def receive(self) -> tuple[bytes, float, Address]:
        """A datagram, the time of its arrival [s] and its sender; raises BlockingIOError where none comes in time."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        # Cleared before the look, so that what comes in between wakes it.
        self._news.clear()
        if not self._received and not (self.timeout and self._news.wait(self.timeout)):
            raise BlockingIOError
        return self._received.popleft()

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        """A datagram and its sender; raises BlockingIOError where none comes in time."""
        data, _, sender = self.receive()
        return data[:size], sender

    def close(self) -> None:
        """Close it; any number of times."""
        if self.fileno() != -1:
            del self._network.sockets[self.address]
