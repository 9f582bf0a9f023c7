"""Sources of the lines (a serial port or UDP), read by a separate thread.

The thread is necessary because the buffer of a serial port holds 4 KB and keeps the oldest bytes.
If the loop read the buffer, the first force after a pause would be old but seem new.
"""

import contextlib
import socket
from collections import deque
from typing import NamedTuple, TypeAlias

from softfin.core.choices import LOOPBACK
from softfin.core.clock import Clock
from softfin.core.errors import DeviceError, one_line
from softfin.rig.computer import Computer
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.streamed_sensor import queue_length

WAIT_S = 0.05
"""Maximum wait for data [s]."""

MAX_LINE_BYTES = 1000


class Received(NamedTuple):
    """Bytes from one source."""

    data: bytes
    source: str = ""
    """Address and port of the sender; empty for a serial port."""
    is_expected: bool = True
    """Whether the bytes come from the configured address."""


class SerialTransport:
    """A serial port, opened exclusively."""

    def __init__(self, port: str, baud: int, clock: Computer) -> None:
        self._serial = clock.open_serial_port(port, baud, timeout_s=WAIT_S)

    def read(self) -> Received:
        """Return the bytes that have arrived, after waiting for at least one until the timeout;
        raises OSError if the sensor is disconnected."""
        return Received(self._serial.read(max(1, self._serial.in_waiting)))

    def close(self) -> None:
        """Close the port."""
        self._serial.close()


class UdpTransport:
    """UDP datagrams; each contains complete lines."""

    def __init__(self, address: str, port: int, clock: Computer) -> None:
        self._socket = clock.udp_socket()
        try:
            self._address = socket.gethostbyname(address)
            # A sensor on this computer is emulated, and other computers need not reach it.
            host = LOOPBACK if self._address.startswith("127.") else ""
            self._socket.bind((host, port))
            self._socket.settimeout(WAIT_S)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise DeviceError(
                f"UDP port {port}: cannot be opened ({one_line(error)}); check address and "
                "udp_port, and close other programs that use the port"
            ) from None

    def read(self) -> Received:
        """Return a datagram, or an empty one if none arrives in time."""
        try:
            data, sender = self._socket.recvfrom(65_535)
        except (TimeoutError, BlockingIOError):
            return Received(b"")
        # Lines do not continue in the next datagram.
        source = f"{sender[0]}:{sender[1]}"
        return Received(data + b"\n", source, sender[0] == self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


Transport: TypeAlias = SerialTransport | UdpTransport


def open_transport(config: LinesConfig, clock: Computer) -> Transport:
    """Open the port of a sensor; raises DeviceError on failure."""
    if config.port is not None:
        return SerialTransport(config.port, config.baud, clock)
    assert config.address is not None
    assert config.udp_port is not None
    return UdpTransport(config.address, config.udp_port, clock)


class TimedLine(NamedTuple):
    """A line without its line end, its arrival time [s], and its source."""

    text: bytes
    time: float
    source: str
    is_expected: bool


class LineReader:
    """Thread that splits arriving bytes into lines."""

    def __init__(self, transport: Transport, rate_hz: float, clock: Clock, is_cut: bool) -> None:
        """Start the thread; set `is_cut` if the first bytes may be the rest of a line."""
        self.trouble: str | None = None
        """Error that ended the thread; None while it runs."""
        self.lines: deque[TimedLine] = deque(maxlen=queue_length(rate_hz))
        """Lines that have arrived, oldest first."""
        self._transport = transport
        self._rate_hz = rate_hz
        self._clock = clock
        self._is_cut = is_cut
        self._rest = b""
        self._closing = clock.event()
        self._thread = clock.spawn(self._run, "line sensor")

    def close(self) -> None:
        """End the thread and close the transport; may be called repeatedly."""
        self._closing.set()
        self._thread.join(10 * WAIT_S)
        with contextlib.suppress(OSError):
            self._transport.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                received = self._transport.read()
            except Exception as error:
                # pyserial raises OSError, or TypeError if the port is closed in the meantime.
                if not self._closing.is_set():
                    self.trouble = one_line(error)
                return
            self._split(received, self._clock())

    def _split(self, received: Received, now: float) -> None:
        *lines, self._rest = (self._rest + received.data).split(b"\n")
        # An endless line must not fill the memory; its remainder is malformed and will be counted.
        self._rest = self._rest[-MAX_LINE_BYTES:]
        if lines and self._is_cut:
            self._is_cut = False
            lines = lines[1:]
        lines = [line for line in lines if line.strip()]
        for index, line in enumerate(lines):
            # Lines that arrive together were sent one after the other.
            time = now - (len(lines) - 1 - index) / self._rate_hz
            self.lines.append(TimedLine(line, time, received.source, received.is_expected))
