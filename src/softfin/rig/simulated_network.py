"""Datagrams and web pages within the process, in simulated time: what an emulated force sensor is reached by."""

import itertools
import socket
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple
from weakref import WeakKeyDictionary

from softfin.core.errors import DeviceError
from softfin.rig.axia80.clock import SO_TIMESTAMPNS, STAMP
from softfin.rig.simulated_clock import SimulatedClock

KEPT_BYTES = 768
"""What Linux counts for a datagram of one record."""

Address = tuple[str, int]


class Network:
    """One for each simulated clock: whoever uses the same clock is on the same network."""

    def __init__(self) -> None:
        self.sockets: dict[Address, SimulatedSocket] = {}
        self.pages: dict[Address, Mapping[str, bytes]] = {}
        """Of each web server, by path."""
        self._ports = itertools.count(50_000)

    def free_port(self) -> int:
        """One that nobody has."""
        return next(self._ports)


_networks: WeakKeyDictionary[SimulatedClock, Network] = WeakKeyDictionary()


def network_of(clock: SimulatedClock) -> Network:
    """That of a clock."""
    return _networks.setdefault(clock, Network())


def fetch_page(clock: SimulatedClock, host: str, port: int, path: str) -> bytes | None:
    """A page of an emulated sensor, None where it has no such page; raises DeviceError where nobody serves any."""
    pages = network_of(clock).pages.get((host, port))
    if pages is None:
        raise DeviceError(
            f"http://{host}:{port}{path}: the force sensor's page cannot be read (nobody serves it); "
            "check its power, cable and address, and http_port"
        )
    return pages.get(path)


class SimulatedPages:
    """Serves bytes by path until it is closed."""

    def __init__(self, clock: SimulatedClock, host: str, port: int, pages: Mapping[str, bytes]) -> None:
        self._served = network_of(clock).pages
        self.port = port or network_of(clock).free_port()
        self.pages = dict(pages)
        """Path: what is there; may be changed at any time."""
        self._address = (host, self.port)
        self._served[self._address] = self.pages

    def close(self) -> None:
        """Any number of times."""
        self._served.pop(self._address, None)


class _Received(NamedTuple):
    data: bytes
    at: float
    sender: Address


class SimulatedSocket:
    """A UDP socket that is bound and does not block, as far as softfin uses one; stamps are the clock's own time."""

    def __init__(self, clock: SimulatedClock, host: str, port: int = 0, buffer_bytes: int = 1 << 22) -> None:
        self._clock, self._network, self._buffer_bytes = clock, network_of(clock), buffer_bytes
        self.address = (host, port or self._network.free_port())
        if self.address in self._network.sockets:
            raise OSError(f"port {port} of {host} is in use")
        self._network.sockets[self.address] = self
        self._news = clock.event()
        self._received: deque[_Received] = deque()
        self._bytes = 0

    def getsockname(self) -> Address:
        """Its host and port."""
        return self.address

    def getsockopt(self, level: int, option: int) -> int:
        """The size of its buffer, the only option there is."""
        return self._buffer_bytes

    def fileno(self) -> int:
        """-1 once it is closed."""
        return 0 if self._network.sockets.get(self.address) is self else -1

    def sendto(self, data: bytes, address: Address) -> int:
        """Lost where nobody listens, or whoever does has no room."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        receiver = self._network.sockets.get(address)
        if receiver is not None:
            receiver._put(data, self.address)
        return len(data)

    def wait(self, timeout: float) -> bool:
        """Until something has arrived, and may be received."""
        # Cleared before the look, so that what comes in between wakes it.
        self._news.clear()
        return bool(self._received) or self._news.wait(timeout)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        """Raises BlockingIOError where nothing has arrived."""
        data, _, _, sender = self.recvmsg(size, 0)
        return data, sender

    def recvmsg(self, size: int, ancillary: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, Address]:
        """With the stamp of its arrival; likewise."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        if not self._received:
            raise BlockingIOError
        data, at, sender = self._received.popleft()
        self._bytes -= _counted(data)
        seconds = int(at)
        stamp = STAMP.pack(seconds, round((at - seconds) * 1e9))
        flags = socket.MSG_TRUNC if len(data) > size else 0
        return data[:size], [(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamp)], flags, sender

    def close(self) -> None:
        """Any number of times."""
        if self.fileno() != -1:
            del self._network.sockets[self.address]

    def _put(self, data: bytes, sender: Address) -> None:
        if self._bytes + _counted(data) <= self._buffer_bytes:
            self._bytes += _counted(data)
            self._received.append(_Received(bytes(data), self._clock(), sender))
            self._news.set()


def _counted(data: bytes) -> int:
    return max(KEPT_BYTES, len(data))
