"""An emulated sensor that sends lines, on a pseudo-terminal or over UDP on the loopback address.

Each line contains a counter, force x and force y [N] of an emulated fin, with noise.
"""

import contextlib
from collections.abc import Callable, Iterable

from softfin.core.choices import LOOPBACK
from softfin.core.json_object import JsonObject
from softfin.emulation.fin import SENSOR_MOUNTING, EmulatedFin
from softfin.emulation.stream import Pty, iterate_due, measure
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.machine import rotation


class EmulatedLines:
    """Emulated sensor, running from construction until `close`; faults may be set from any
    thread."""

    def __init__(
        self,
        fin: EmulatedFin,
        rate_hz: float,
        clock: Computer = COMPUTER,
        frame: str = SENSOR_MOUNTING,
        udp_port: int | None = 0,
    ) -> None:
        """The sensor sends to `udp_port`, to a free port if it is 0, and over a pseudo-terminal if
        it is None."""
        self.transmit: Callable[[bytes], Iterable[bytes]] = lambda line: (line,)
        """Function that maps a sent line to the bytes that arrive; tests may cut, double, lose or
        change lines."""
        self.rate_hz = rate_hz
        self.count = 0
        self.are_values_frozen = False
        self._fin = fin
        self._clock = clock
        self._rotation = rotation(frame).T
        self._values = (0.0, 0.0)
        self._silent_until = 0.0
        self._closing = clock.event()
        self._link: _Serial | _Udp = _Serial() if udp_port is None else _Udp(clock, udp_port)
        self._thread = clock.spawn(self._run, "emulated line sensor")

    def address(self) -> JsonObject:
        """Return the port, as in a rig's file."""
        return self._link.address

    def description(self) -> str:
        """Return the port."""
        return ", ".join(f"{name} {value}" for name, value in self.address().items() if value)

    def remembered(self) -> JsonObject:
        """Return nothing: softfin keeps the zero."""
        return {}

    def recall(self, remembered: JsonObject) -> None:
        """Continue; there is nothing to recall."""

    def silence(self, seconds: float = float("inf")) -> None:
        """Send nothing for a time [s]; 0 ends the silence."""
        self._silent_until = self._clock() + seconds

    def reboot(self) -> None:
        """Start the counter again."""
        self.count = 0

    def unplug(self) -> None:
        """Remove the port."""
        self._link.close()

    def close(self) -> None:
        """Stop the sensor; may be called repeatedly."""
        self._closing.set()
        self._thread.join()
        self._link.close()

    def _run(self) -> None:
        for numbers in iterate_due(self._clock, self._closing, lambda: self.rate_hz):
            is_silent = self._clock() < self._silent_until
            for _ in numbers:
                line = self._measure()
                for data in () if is_silent else self.transmit(line):
                    with contextlib.suppress(OSError):
                        self._link.send(data)

    def _measure(self) -> bytes:
        self.count = (self.count + 1) % 2**32
        if not self.are_values_frozen:
            self._values = measure(self._fin, self._rotation, self.count)[:2]
        return f"{self.count},{self._values[0]:.6f},{self._values[1]:.6f}\r\n".encode()


class _Serial(Pty):
    """A pseudo-terminal."""

    def __init__(self) -> None:
        super().__init__()
        self.address: JsonObject = {"port": self.name, "address": None, "udp_port": None}


class _Udp:
    """A socket that sends to this computer."""

    def __init__(self, clock: Computer, port: int) -> None:
        free = clock.udp_socket()
        free.bind((LOOPBACK, port))
        port = int(free.getsockname()[1])
        free.close()
        self._socket = clock.udp_socket()
        self.address: JsonObject = {"address": LOOPBACK, "udp_port": port}

    def send(self, data: bytes) -> None:
        """Send a datagram."""
        self._socket.sendto(data, (LOOPBACK, int(self.address["udp_port"])))

    def close(self) -> None:
        """Close; may be called repeatedly."""
        self._socket.close()
