"""An emulated sensor that sends lines, on a pseudo-terminal or over UDP on the loopback address.

Each line contains a counter and channels of the wrench [N, N m].
"""

from collections.abc import Sequence

from softfin.core.choices import LOOPBACK
from softfin.core.json_object import JsonObject
from softfin.emulation.fin import EmulatedFin
from softfin.emulation.stream import EmulatedStream, Pty
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.machine import WRENCH_CHANNELS, Wrench

EMULATED_UDP_PORT = 47_470


class EmulatedLines(EmulatedStream[bytes]):
    """Emulated sensor that sends to `udp_port`, or over a pseudo-terminal if it is None."""

    def __init__(
        self,
        fin: EmulatedFin,
        rate_hz: float,
        clock: Computer = COMPUTER,
        udp_port: int | None = EMULATED_UDP_PORT,
        channels: Sequence[str] = WRENCH_CHANNELS[:2],
    ) -> None:
        self.count = 0
        """Latest counter; 0 after a restart of the sensor."""
        self._pty = None if udp_port is not None else Pty()
        self._udp_port = udp_port or 0
        self._places = [WRENCH_CHANNELS.index(name) for name in channels]
        self.socket = clock.udp_socket()
        super().__init__(fin, rate_hz, clock)

    def address(self) -> JsonObject:
        """Return the port in the format of a rig file."""
        if self._pty is None:
            return {"address": LOOPBACK, "udp_port": self._udp_port}
        return {"port": self._pty.name, "address": None, "udp_port": None}

    def encode(self, age_s: float, wrench: Wrench) -> bytes:
        """Return a line with the next count."""
        self.count = (self.count + 1) % 2**32
        values = ",".join(f"{wrench[place]:.6f}" for place in self._places)
        return f"{self.count},{values}\r\n".encode()

    def send(self, record: bytes) -> None:
        """Send a line, or a part of one."""
        if self._pty is None:
            self.socket.sendto(record, (LOOPBACK, self._udp_port))
        else:
            self._pty.send(record)

    def unplug(self) -> None:
        """Close the socket and the pseudo-terminal; may be called repeatedly."""
        self.socket.close()
        if self._pty is not None:
            self._pty.close()
