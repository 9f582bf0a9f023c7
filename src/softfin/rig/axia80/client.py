"""The UDP socket of an Axia80's stream: sends commands, returns records with the times of their arrival."""

import contextlib
import socket
import struct
import sys

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.axia80.rdt import RdtCommand, RdtRecord, decode_records, encode_request
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedSocket

BUFFER_BYTES = 4 * 1024 * 1024
"""Size of the kernel's buffer: seconds of the stream, should the process be held up. Linux gives twice
`net.core.rmem_max` at most."""

DATAGRAM_BYTES, ANCILLARY_BYTES = 4096, 256

# Linux' own number, which Python's socket module does not name; the same on x86 and ARM.
SO_TIMESTAMPNS = 35
STAMP = struct.Struct("@ll")


class RdtClient:
    """Never blocks; the socket is connected, so that the kernel passes only what comes from the sensor's port."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        self.refused = self.unsent = 0
        self._clock = clock
        self._socket: socket.socket | SimulatedSocket
        self._stamped = False
        self.drained = clock()
        """When `drain` last ended [s]."""
        # Stamps of a simulated socket are of the monotonic time already.
        self._wall = clock if isinstance(clock, SimulatedClock) else clock.wall
        if isinstance(clock, SimulatedClock):
            self._socket = SimulatedSocket(clock, host)
            self._socket.connect((host, port))
            return
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.connect((host, port))
            self._socket.setblocking(False)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise DeviceError(
                f"the force sensor at {host}:{port} cannot be reached ({error}); check its address and the network"
            ) from None
        if sys.platform.startswith("linux"):
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
                self._stamped = True

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._socket.fileno() == -1

    def send(self, command: RdtCommand) -> bool:
        """Send a command; False, and counted, where the network does not take it."""
        try:
            self._socket.send(encode_request(command))
        except OSError:
            self.unsent += 1
            return False
        return True

    def drain(self) -> list[tuple[tuple[RdtRecord, ...], float]]:
        """The records of each datagram that has arrived, and the monotonic time of its arrival [s], in that order.

        The kernel stamps with the wall clock, which may be set at any moment; so a stamp moves the time of arrival
        between the drain before and this one, and no further.
        """
        arrived: list[tuple[tuple[RdtRecord, ...], float | None]] = []
        while True:
            try:
                data, stamp = self._receive()
            except (BlockingIOError, InterruptedError):
                break
            except OSError:
                # The answer to an earlier request that found no listener; the silence will tell.
                self.refused += 1
                break
            records = decode_records(data)
            if records is None:
                self.refused += 1
            else:
                arrived.append((records, stamp))
        before, self.drained = self.drained, self._clock()
        offset, now = self._wall() - self.drained, self.drained
        return [
            (records, now if stamp is None else min(max(stamp - offset, before), now)) for records, stamp in arrived
        ]

    def close(self) -> None:
        """Close the socket; any number of times."""
        with contextlib.suppress(OSError):
            self._socket.close()

    def _receive(self) -> tuple[bytes, float | None]:
        """A datagram, and the wall clock's time at which it arrived [s] where that is known."""
        if isinstance(self._socket, SimulatedSocket):
            data, arrived, _ = self._socket.receive()
            return data, arrived
        if not self._stamped:
            return self._socket.recv(DATAGRAM_BYTES), None
        data, ancillary, _, _ = self._socket.recvmsg(DATAGRAM_BYTES, ANCILLARY_BYTES)
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(value) >= STAMP.size:
                seconds, nanoseconds = STAMP.unpack_from(value)
                return data, float(seconds + nanoseconds * 1e-9)
        return data, None
