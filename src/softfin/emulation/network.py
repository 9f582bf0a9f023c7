"""In-process connections to emulated devices, in simulated time: CAN bus, UDP sockets and serial
lines."""

import copy
import itertools
import socket
from collections import deque

import can

from softfin.core.choices import LOOPBACK
from softfin.emulation.time import SimulatedTime
from softfin.rig.computer import Address
from softfin.rig.devices.axia80.stream import SO_TIMESTAMPNS, STAMP

SIMULATED = "simulated"
"""Value of `bus.interface` in a rig file."""

RMEM_MAX_BYTES = 212_992
"""Maximum receive buffer that a program may request [bytes]: the Linux default for
`net.core.rmem_max`, which Linux then doubles."""

TRUESIZE_BYTES = 768
"""Memory that Linux accounts for a datagram with one record [bytes], most of which is overhead."""

LINE = 1
"""Port at the device end of a serial line; the host is the name of the line."""

_free_ports = itertools.count(50_000)


class SimulatedBus(can.BusABC):
    """A bus on which all participants with the same clock and channel receive each other's frames
    immediately and in order."""

    def __init__(self, clock: SimulatedTime, channel: str) -> None:
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


class SimulatedSocket:
    """A UDP socket on the loopback address, with the methods that softfin uses.

    As on Linux, the buffer size is in bytes, a full buffer drops new datagrams, and each datagram
    has a timestamp from the wall clock, which may be changed.
    """

    def __init__(
        self, clock: SimulatedTime, host: str = LOOPBACK, port: int = 0, timeout: float = 0.0
    ) -> None:
        self._clock = clock
        self.timeout = timeout
        self.address = (host, port or next(_free_ports))
        clock.shared[self.address] = self
        self._peer: Address | None = None
        self._received: deque[tuple[bytes, float, Address]] = deque()

    def bind(self, address: Address) -> None:
        """Move to an address; an empty host is the loopback address, and port 0 a free one."""
        del self._clock.shared[self.address]
        self.address = (address[0] or LOOPBACK, address[1] or next(_free_ports))
        self._clock.shared[self.address] = self

    def getsockname(self) -> Address:
        """Return the address of the socket."""
        return self.address

    def fileno(self) -> int:
        """Return -1 if the socket is closed, otherwise 0."""
        return 0 if self._clock.shared.get(self.address) is self else -1

    def setsockopt(self, level: int, option: int, value: int) -> None:
        """Do nothing: the buffer always has its largest size, and datagrams are timestamped."""

    def settimeout(self, seconds: float | None) -> None:
        """Set the maximum wait for a datagram [s]."""
        self.timeout = seconds or 0.0

    def connect(self, address: Address) -> None:
        """Set the only remote address."""
        self._peer = address

    def send(self, data: bytes) -> int:
        """Send a datagram to the connected address."""
        assert self._peer is not None
        return self.sendto(data, self._peer)

    def sendto(self, data: bytes, address: Address) -> int:
        """Send a datagram, which is lost if there is no receiver or its buffer is full."""
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        receiver: SimulatedSocket | None = self._clock.shared.get(address)
        # A connected socket receives only from its peer.
        if receiver is not None and receiver._peer in (None, self.address):
            buffered_bytes = len(receiver._received) * TRUESIZE_BYTES
            if buffered_bytes <= 2 * RMEM_MAX_BYTES:
                receiver._received.append((bytes(data), self._clock.wall(), self.address))
        return len(data)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        """Return a datagram and its sender; raises BlockingIOError if none arrives in time."""
        data, _, sender = self._receive()
        return data[:size], sender

    def recvmsg(
        self, size: int, ancillary: int
    ) -> tuple[bytes, list[tuple[int, int, bytes]], int, Address]:
        """Return a datagram with the wall-clock time of its arrival, as the kernel does."""
        data, wall_s, sender = self._receive()
        seconds, fraction = divmod(wall_s, 1.0)
        stamp = STAMP.pack(int(seconds), round(fraction * 1e9))
        return data[:size], [(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamp)], 0, sender

    def close(self) -> None:
        """Close the socket; may be called repeatedly."""
        if self.fileno() != -1:
            del self._clock.shared[self.address]

    def _receive(self) -> tuple[bytes, float, Address]:
        if self.fileno() == -1:
            raise OSError("the socket is closed")
        if not (
            self._clock.wait_for(lambda: self._received, self.timeout)
            if self.timeout
            else self._received
        ):
            raise BlockingIOError
        return self._received.popleft()


class SimulatedSerialPort:
    """The program end of a serial line; `SimulatedLine` is the device end.

    Each program has its own buffer: two programs on one line do not take each other's bytes.
    """

    def __init__(self, clock: SimulatedTime, port: str, timeout_s: float) -> None:
        self._socket = SimulatedSocket(clock, port)
        self._socket.connect((port, LINE))
        self._timeout_s = timeout_s
        self._arrived = b""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that have arrived."""
        self._take(0.0)
        return len(self._arrived)

    def read(self, size: int) -> bytes:
        """Return `size` bytes, or fewer if the port times out."""
        if len(self._arrived) < size:
            self._take(self._timeout_s)
        data = self._arrived[:size]
        self._arrived = self._arrived[size:]
        return data

    def write(self, data: bytes) -> int:
        """Send bytes."""
        return self._socket.send(data)

    def set_low_latency_mode(self, is_low: bool) -> None:
        """Do nothing: no byte is ever delayed."""

    def close(self) -> None:
        """Close; may be called repeatedly."""
        self._socket.close()

    def _take(self, timeout_s: float) -> None:
        self._socket.timeout = timeout_s
        while True:
            try:
                self._arrived += self._socket.recvfrom(65_535)[0]
            except BlockingIOError:
                return
            self._socket.timeout = 0.0


class SimulatedLine:
    """The device end of a serial line. Answers go to the most recent sender."""

    def __init__(self, clock: SimulatedTime, name: str) -> None:
        self._socket = SimulatedSocket(clock, name, LINE)
        self._host: Address = (name, LINE)
        self.name = name
        self.is_open = True

    def receive(self, wait_s: float) -> bytes:
        """Wait for bytes for up to `wait_s` [s]."""
        self._socket.timeout = wait_s
        try:
            data, self._host = self._socket.recvfrom(4096)
        except OSError:
            return b""
        return data

    def send(self, data: bytes) -> None:
        """Send bytes; those that nobody reads are lost."""
        if self.is_open:
            self._socket.sendto(data, self._host)

    def close(self) -> None:
        """Unplug; may be called repeatedly."""
        self.is_open = False
        self._socket.close()
