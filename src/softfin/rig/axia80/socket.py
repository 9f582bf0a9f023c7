"""The socket of an Axia80's stream: sends orders, hands on what the sensor sent, and when the kernel received it."""

import contextlib
import socket
from collections.abc import Callable
from typing import Any, NamedTuple

from softfin.core.errors import DeviceError
from softfin.rig.axia80.clock import stamps_asked, wall_stamp
from softfin.rig.axia80.rdt import Order, Record, decode_records, encode_request
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedSocket

BUFFER_BYTES = 4 * 1024 * 1024
"""Asked of the kernel: seconds of the stream, should the process be held up. Linux gives twice `net.core.rmem_max` at
most."""

MOST_DATAGRAMS = 1024
"""In one drain, so that a flood cannot hold the loop up; the rest waits for the next."""

DATAGRAM_BYTES = 4096
ANCILLARY_BYTES = 256


class Datagram(NamedTuple):
    """What the sensor sent at once."""

    records: tuple[Record, ...]
    ancillary: list[tuple[int, int, bytes]]
    """Of the kernel."""


class RdtSocket:
    """Never blocks; takes datagrams of the sensor's own address and port alone, and counts all others."""

    def __init__(
        self, host: str, port: int, clock: Callable[[], float], wall: Callable[[], float], buffer_bytes: int
    ) -> None:
        """On a simulated clock within the process, with its own time in place of `wall`."""
        self.host, self.port = host, port
        self.foreign = self.refused = self.unsent = self.crowded = 0
        self._clock, self._wall = clock, wall
        self._socket: socket.socket | SimulatedSocket
        self.drained = self._before = clock()
        """When `drain` was last through [s]."""
        self._offset = 0.0
        if isinstance(clock, SimulatedClock):
            self._wall, self._sensor, self._stamped = clock, (host, port), True
            self._socket = SimulatedSocket(clock, host, buffer_bytes=buffer_bytes)
            return
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._sensor = _resolved(host, port)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
            self._socket.bind((_own_address(self._sensor), 0))
            self._socket.setblocking(False)
            self._stamped = stamps_asked(self._socket)
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                f"the force sensor at {host}:{port} cannot be reached ({error}); check its address and the network"
            ) from None

    @property
    def buffer_bytes(self) -> int:
        """What the kernel keeps of the stream while nobody reads; it counts its own overhead."""
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    @property
    def closed(self) -> bool:
        """For good."""
        return self._socket.fileno() == -1

    def send(self, order: Order) -> bool:
        """False, and counted, where the network does not take it."""
        try:
            self._socket.sendto(encode_request(order), self._sensor)
        except OSError:
            self.unsent += 1
            return False
        return True

    def drain(self) -> list[Datagram]:
        """Everything that has arrived, in the order of arrival."""
        datagrams = []
        for _ in range(MOST_DATAGRAMS):
            try:
                data, ancillary, flags, sender = self._received()
            except (BlockingIOError, InterruptedError):
                break
            except OSError:
                # Windows reports here that an earlier request found no listener; the silence will tell.
                self.refused += 1
                continue
            if sender != self._sensor:
                self.foreign += 1
                continue
            records = decode_records(data)
            if flags or isinstance(records, str):
                self.refused += 1
                continue
            datagrams.append(Datagram(records, ancillary))
        else:
            self.crowded += 1
        self._before, self.drained = self.drained, self._clock()
        self._offset = self._wall() - self.drained
        return datagrams

    def received_at(self, datagram: Datagram) -> float:
        """Monotonic time [s] at which a datagram of the latest drain arrived.

        The kernel stamps with the wall clock, which may be set at any moment; so its stamp moves the time between the
        drain before and the latest one, and no further.
        """
        stamp = wall_stamp(datagram.ancillary) if self._stamped else None
        return self.drained if stamp is None else min(max(stamp - self._offset, self._before), self.drained)

    def close(self) -> None:
        """Any number of times."""
        with contextlib.suppress(OSError):
            self._socket.close()

    def _received(self) -> tuple[bytes, list[tuple[int, int, bytes]], int, Any]:
        if not self._stamped:
            data, sender = self._socket.recvfrom(DATAGRAM_BYTES)
            return data, [], 0, sender
        data, ancillary, flags, sender = self._socket.recvmsg(DATAGRAM_BYTES, ANCILLARY_BYTES)
        return data, ancillary, flags & socket.MSG_TRUNC, sender


def _resolved(host: str, port: int) -> tuple[str, int]:
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except UnicodeError as error:
        raise OSError(str(error)) from None
    address, number = found[0][4][:2]
    return str(address), int(number)


def _own_address(sensor: tuple[str, int]) -> str:
    """Of the interface that leads to the sensor, so that nobody on another network reaches the socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(sensor)
        return str(probe.getsockname()[0])
